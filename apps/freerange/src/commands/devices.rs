//! `freerange devices`

use freerange::{Device, GpuApi};

use crate::error::CliError;

/// List the devices that this program can compute on, the best first.
#[derive(clap::Args)]
pub struct Args {
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<(), CliError> {
    let devices = Device::list();
    if args.json {
        println!("{}", serde_json::to_string_pretty(&devices).map_err(CliError::input)?);
        return Ok(());
    }
    for d in &devices {
        let p = &d.properties;
        if let Some(problem) = &d.problem {
            println!("{:10} cannot be used: {problem}", d.name);
            continue;
        }
        println!("{:10} {}", d.name, p.hardware);
        if let Some(bytes) = p.memory_bytes {
            println!("{:10} {:.1} GiB", "", bytes as f64 / f64::from(1 << 30));
        }
        if d.name == "cpu" {
            continue;
        }
        let yes = |what: bool, name: &str| if what { name.to_owned() } else { format!("no {name}") };
        let units = match p.matrix_units.is_empty() {
            true => "no matrix units".to_owned(),
            false => format!("matrix units ({})", p.matrix_units.join(", ")),
        };
        let planes = p.plane.map_or("no subgroups".into(), |n| format!("subgroups of {n}"));
        println!(
            "{:10} {}, {}, {units}, {planes}, {}, {} KiB shared{}",
            "",
            yes(p.bf16, "bf16"),
            yes(p.f16, "f16"),
            yes(p.float_atomics, "float atomics"),
            p.shared_memory_bytes / 1024,
            if d.gpu { "" } else { "; a processor that plays a GPU: for tests" }
        );
    }
    let missing: Vec<&str> = GpuApi::ALL.into_iter().filter(|api| !api.compiled()).map(GpuApi::name).collect();
    if !missing.is_empty() {
        println!("not built in (cargo build --release --features NAME): {}", missing.join(", "));
    }
    Ok(())
}
