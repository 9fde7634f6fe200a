//! `freerange data estimate`

use std::path::Path;
use std::sync::Mutex;

use freerange_data::build::{GaussianSource, Items, estimate};

use super::build::{InputArgs, Settings, psnr_line, seconds_line};
use crate::{error::CliError, progress::Progress};

/// Arguments of `data estimate`.
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    input: InputArgs,
    #[command(flatten)]
    settings: Settings,
    /// Objects to measure, evenly spread over the input.
    #[arg(long, default_value_t = 8)]
    sample: u64,
    /// Objects to estimate the cost of [default: those of the input].
    #[arg(long)]
    objects: Option<u64>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<(), CliError> {
    let items = match args.input.is_generated() {
        true => Items::generated(args.objects.unwrap_or(args.sample).max(args.sample), 0),
        false => args.input.items()?,
    };
    let config = args.settings.build_config(Some(GaussianSource::Fit))?;
    let bar = Mutex::new(Progress::new("measuring", args.sample.min(items.len())));
    let cost = estimate(&config, &items, args.sample, |done| {
        if let Ok(mut bar) = bar.lock() {
            bar.at(done.count[0], done.id);
        }
    })?;
    let objects = args.objects.unwrap_or(items.len());
    let (hours, gigabytes) = (cost.core_hours(objects), cost.gigabytes(objects));
    if args.json {
        let value = serde_json::json!({
            "measured": cost, "objects": objects, "core_hours": hours, "gigabytes": gigabytes,
        });
        println!("{}", serde_json::to_string_pretty(&value).map_err(CliError::input)?);
        return Ok(());
    }
    println!(
        "measured on {} objects ({} failed, {} flagged) on {} cores",
        cost.sampled, cost.failed, cost.flagged, cost.cores
    );
    println!("per object, on one core: {}; {:.2} MB", seconds_line(&cost.seconds), cost.bytes / 1e6);
    if let Some(psnr) = &cost.psnr {
        println!("PSNR on held-out views: {}", psnr_line(psnr));
    }
    println!("for {objects} objects: {hours:.1} core-hours, {gigabytes:.1} GB");
    println!("| cores | {} |", [2, 64, 1024, 4096].map(|n| n.to_string()).join(" | "));
    println!("| hours | {} |", [2.0, 64.0, 1024.0, 4096.0].map(|n| format!("{:.1}", hours / n)).join(" | "));
    Ok(())
}

impl InputArgs {
    /// Whether generated objects are meant.
    fn is_generated(&self) -> bool {
        self.path() == Path::new("generated")
    }
}
