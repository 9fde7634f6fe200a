//! `freerange train`

use std::{path::PathBuf, time::Instant};

use freerange_flow::{
    config::TrainConfig,
    log::Log,
    trainer::{Initial, Report, Trainer},
};

use crate::{
    device::{DeviceName, require},
    error::CliError,
    progress::Progress,
    runtime::checkpoint,
};

/// Train a model. Run the same command again to go on where it was stopped.
///
/// Writes checkpoint.safetensors (averaged weights), log.jsonl (one line per step) and the state to go on from.
#[derive(clap::Args)]
pub struct Args {
    /// Configuration: a file such as configs/tiny.toml, or tiny, base or paper.
    config: PathBuf,
    /// Folder of the run.
    #[arg(short, long)]
    output: PathBuf,
    /// Checkpoint whose weights a new run starts from.
    #[arg(long, value_name = "FILE")]
    initial: Option<PathBuf>,
    /// With --initial: normalise by the statistics of this run's data instead of the checkpoint's, for data made otherwise.
    #[arg(long, requires = "initial")]
    remeasure: bool,
    /// Stop after so many minutes (the state is saved).
    #[arg(long)]
    minutes: Option<f64>,
    /// Steps between two saved states.
    #[arg(long, default_value_t = 250, value_parser = clap::value_parser!(u64).range(1..))]
    save_every: u64,
    /// Where to compute: auto, cpu, or cuda, metal, vulkan, webgpu with a number if there are several, as in cuda:1.
    #[arg(long, default_value = "auto")]
    device: DeviceName,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), CliError> {
    let begin = Instant::now();
    let device = args.device.open()?;
    let config = TrainConfig::load(&args.config)?;
    require(config.optimizer.compute, &device)?;
    let total = config.total_steps();
    let initial = args.initial.as_deref().map(|path| checkpoint(Some(path), &device)).transpose()?;
    let initial = initial.as_ref().map(|checkpoint| Initial { checkpoint, remeasure: args.remeasure });
    let mut trainer = Trainer::open(config, &args.output, initial, &device, |m| eprintln!("{m}"))?;
    let mut log = Log::open(&args.output.join("log.jsonl"), trainer.step_count())?;
    let mut bar = Progress::new("training", total);
    while trainer.step_count() < total {
        let report = match trainer.step() {
            Ok(report) => report,
            Err(e) => {
                // What was learned before is not lost; if it cannot be saved either, the first error is the one to tell.
                let saved = log.sync().and_then(|()| trainer.save());
                eprintln!(
                    "{}",
                    saved.map_or_else(|e| e.to_string(), |_| format!("saved step {}", trainer.step_count()))
                );
                return Err(e.into());
            }
        };
        log.add(&report)?;
        bar.at(report.step, &line(&report));
        let out_of_time = args.minutes.is_some_and(|m| begin.elapsed().as_secs_f64() > 60.0 * m);
        if report.step % args.save_every == 0 || report.step == total || out_of_time {
            log.sync()?;
            trainer.save()?;
        }
        if out_of_time {
            break;
        }
    }
    bar.finish();
    println!("{} of {total} steps; {}", trainer.step_count(), args.output.join("checkpoint.safetensors").display());
    Ok(())
}

/// What the progress says of a step.
fn line(report: &Report) -> String {
    let Report { loss, flow, held, seconds, .. } = report;
    let mut line = format!("loss {loss:.3} flow {flow:.3} held {held:.4} {seconds:.2} s");
    for (count, what) in [(report.skipped, "steps not finite"), (report.broken, "objects unreadable")] {
        if count > 0 {
            line += &format!(", {count} {what}");
        }
    }
    line
}
