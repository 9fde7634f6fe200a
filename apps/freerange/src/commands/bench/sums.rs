//! Sums over the processes of a launcher.

use burn::tensor::{Device, Distribution, Tensor};
use freerange_model::{ModelInfo, Workload};
use freerange_train::ranks::{AllReduceDtype, Ranks, gather};

use super::{Args, Part, Printer, timer::Timer};
use crate::{error::CliError, ranks::Job, runtime};

/// Runs the command on all ranks; rank 0 prints.
pub fn run(args: &Args) -> Result<(), CliError> {
    let job = Job::start()?;
    let result = measure(args, &job);
    job.end(result)
}

fn measure(args: &Args, job: &Job) -> Result<(), CliError> {
    if args.only != [Part::Sum] || args.json {
        let text = "--only sum: expected no other part and no --json, since all processes have to do the same";
        return job.together(Err(CliError::input(text)));
    }
    let sizes = if args.sizes.is_empty() { vec!["tiny".to_owned(), "base".into()] } else { args.sizes.clone() };
    let device = job.together(job.open(args.device))?;
    let device = freerange::internal::tensor_device(&device);
    let ranks = job.sums(args.sums, device)?;
    let counts = sizes.iter().map(|size| Ok((size.as_str(), numbers(size)?))).collect::<Result<Vec<_>, CliError>>();
    let out = Printer { quiet: !job.first() };
    let hardware = freerange::machine::processor();
    out.line(&format!(
        "machine: {hardware}, {} processes with {} threads each",
        job.world(),
        rayon::current_num_threads()
    ));
    out.line(&format!("program: freerange {}, commit {}", env!("CARGO_PKG_VERSION"), runtime::commit()));
    out.line(&format!("command: {}", std::env::args().collect::<Vec<_>>().join(" ")));
    out.header(&["size", "numbers", "dtype", "MB", "ms"]);
    for (size, count) in job.together(counts)? {
        for (dtype, name, bytes) in [(AllReduceDtype::F32, "f32", 4), (AllReduceDtype::Bf16, "bf16", 2)] {
            let seconds = seconds(&*ranks, count, dtype, device, args.seconds)?;
            let cells = [
                size.to_owned(),
                count.to_string(),
                name.into(),
                format!("{:.1}", (count * bytes) as f64 / 1e6),
                format!("{:.1}", 1e3 * seconds),
            ];
            out.row(&cells);
        }
    }
    Ok(())
}

/// Numbers that training changes.
fn numbers(size: &str) -> Result<usize, CliError> {
    let config = super::whole::load(size)?;
    let workload = Workload { batch: 1, views: 1, gaussians: 1 << config.stages[0].depth };
    Ok(ModelInfo::new(&config.model, workload).trainable as usize)
}

/// Median seconds of a sum, the same number of times on all ranks, which begin each time together.
fn seconds(
    ranks: &dyn Ranks,
    count: usize,
    dtype: AllReduceDtype,
    device: &Device,
    wanted: f64,
) -> Result<f64, CliError> {
    let own = Tensor::<1>::random([count], Distribution::Default, device);
    let timer = Timer { device: device.clone(), seconds: wanted };
    let once = || {
        let flat = own.clone() + 0.0; // a copy: what comes of a backward pass is nobody else's either
        timer.wait()?;
        gather(ranks, &[])?;
        let begin = std::time::Instant::now();
        let sum = ranks.sum(flat, dtype)?;
        timer.wait()?;
        drop(sum);
        Ok::<_, CliError>(begin.elapsed().as_secs_f64())
    };
    let first = once()?.max(once()?);
    let rounds = ((wanted / first) as u16).clamp(3, 100);
    // As many as rank 0 thinks fit.
    let rounds = gather(ranks, &rounds.to_le_bytes())?.swap_remove(0);
    let rounds = u16::from_le_bytes([rounds[0], rounds[1]]);
    let mut times = (0..rounds).map(|_| once()).collect::<Result<Vec<f64>, _>>()?;
    times.sort_by(f64::total_cmp);
    Ok(times[times.len() / 2])
}
