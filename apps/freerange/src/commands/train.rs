//! `freerange train`

use std::{path::PathBuf, time::Instant};

use burn::tensor::Device;
use freerange::{DeviceName, EncoderPlaces, load_checkpoint, require};
use freerange_flow::{
    batch::step_rng,
    config::TrainConfig,
    events::Events,
    log::Log,
    trainer::{Initial, StepReport, Trainer, Validated},
};

use freerange_model::{Compute, Execution, FreeRange, ModelConfig, ModelInfo, Workload};

use crate::{error::CliError, progress::Progress, runtime::local_or_shipped};

/// Train a model. Run the same command again to go on where it was stopped.
///
/// Writes checkpoint.safetensors (averaged weights), log.jsonl (one line per step), the same for TensorBoard (events.out.tfevents.*, with
/// pictures of validation samples) and the state to go on from; with `[validation]` in the configuration also best.safetensors, the weights that measured best on other objects.
#[derive(clap::Args)]
pub struct Args {
    /// Configuration: a file such as configs/tiny.toml, or tiny, base or paper.
    config: PathBuf,
    /// Folder of the run.
    #[arg(short, long, required_unless_present = "dry_run")]
    output: Option<PathBuf>,
    /// Build the whole model with random weights, say what a step of each stage needs, and end: neither data nor encoder
    /// weights are looked for.
    #[arg(long)]
    dry_run: bool,
    /// Checkpoint whose weights a new run starts from.
    #[arg(long, value_name = "FILE")]
    initial: Option<PathBuf>,
    /// Folder of the weights (config.json, model.safetensors) of the frozen encoder [default: what `weights` in the
    /// configuration's [model.encoder] names].
    #[arg(long, value_name = "FOLDER")]
    encoder_weights: Option<PathBuf>,
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

pub fn run(args: &Args) -> Result<(), CliError> {
    let begin = Instant::now();
    let device = args.device.open()?;
    let config = TrainConfig::load(&args.config)?;
    require(config.optimizer.compute, &device)?;
    let output = match &args.output {
        Some(output) if !args.dry_run => output,
        _ => return dry_run(&config, &device),
    };
    if config.optimizer.compute == Compute::Auto {
        eprintln!("computing in {}", config.optimizer.compute.on(&device));
    }
    let total = config.total_steps();
    let encoders = EncoderPlaces::at(args.encoder_weights.clone());
    let encoder = encoders.for_training(&config.model.encoder)?;
    let initial = local_or_shipped(args.initial.as_deref())?;
    let initial = initial.map(|path| load_checkpoint(Some(&path), &encoders, &device)).transpose()?;
    let initial = initial.as_ref().map(|checkpoint| Initial { checkpoint, remeasure: args.remeasure });
    let mut trainer = Trainer::open_with(config, output, initial, encoder.as_ref(), &device, |m| eprintln!("{m}"))?;
    let mut log = Log::open(&output.join("log.jsonl"), trainer.step_count())?;
    let mut events = Events::open(output, trainer.step_count())?;
    let mut bar = Progress::new("training", total);
    while trainer.step_count() < total {
        let report = match trainer.step() {
            Ok(report) => report,
            Err(e) => {
                // What was learned before is not lost; if it cannot be saved either, the first error is the one to tell.
                let saved = log.sync().and_then(|()| events.sync()).and_then(|()| trainer.save());
                eprintln!(
                    "{}",
                    saved.map_or_else(|e| e.to_string(), |_| format!("saved step {}", trainer.step_count()))
                );
                return Err(e.into());
            }
        };
        log.add(&report)?;
        events.scalars(report.step, "train", &report)?;
        bar.at(report.step, &line(&report));
        if let Some(validated) = trainer.validate()? {
            log.add(&validated)?;
            events.scalars(validated.step, "validation", &validated.validation)?;
            for (i, picture) in validated.validation.pictures.iter().enumerate() {
                events.picture(validated.step, &format!("validation/sample {i}"), picture)?;
            }
            let Validated { step, validation: v, best, .. } = validated;
            eprintln!(
                "validation after {step} steps: flow {:.3} held {:.4} PSNR {:.2} dB of {} samples (best {:.2} dB after {} steps)",
                v.flow, v.held, v.psnr, v.samples, best.psnr, best.step
            );
        }
        let out_of_time = args.minutes.is_some_and(|m| begin.elapsed().as_secs_f64() > 60.0 * m);
        if report.step % args.save_every == 0 || report.step == total || out_of_time {
            log.sync()?;
            events.sync()?;
            trainer.save()?;
        }
        if out_of_time {
            break;
        }
    }
    bar.finish();
    println!("{} of {total} steps; {}", trainer.step_count(), output.join("checkpoint.safetensors").display());
    Ok(())
}

/// Builds the model, and tells what its training needs.
fn dry_run(config: &TrainConfig, device: &Device) -> Result<(), CliError> {
    let built = FreeRange::new(&config.model, &mut step_rng(config.seed, 0), device)?;
    let trained = built.parameters();
    println!(
        "built with random weights: {} tensors, {} numbers that are trained",
        trained.len(),
        trained.iter().map(|p| p.values.len()).sum::<usize>()
    );
    let views = config.loss.input_views.1;
    for (number, stage) in config.stages.iter().enumerate() {
        let model = ModelConfig { image_size: stage.image_size, ..config.model.clone() };
        let workload = Workload { batch: stage.at_a_time(), views, gaussians: 1 << stage.depth };
        let o = &config.optimizer;
        let execution = Execution { gpu: *device != Device::flex(), compute: o.compute, recompute: o.recompute };
        let size = |own: Option<u32>, all: u32| own.unwrap_or(all);
        println!(
            "\nstage {} of {}: {} steps of {} objects, {} at a time; images of {} px, rendering losses {} px, gradient {} px",
            number + 1,
            config.stages.len(),
            stage.steps,
            stage.batch,
            stage.at_a_time(),
            stage.image_size,
            size(stage.render_size, config.loss.render_size),
            size(stage.gradient_size, config.loss.gradient_size),
        );
        println!("{}", ModelInfo::with_execution(&model, workload, execution));
    }
    Ok(())
}

/// What the progress says of a step.
fn line(report: &StepReport) -> String {
    let StepReport { loss, flow, held, seconds, .. } = report;
    let mut line = format!("loss {loss:.3} flow {flow:.3} held {held:.4} {seconds:.2} s");
    for (count, what) in [(report.skipped, "steps not finite"), (report.broken, "objects unreadable")] {
        if count > 0 {
            line += &format!(", {count} {what}");
        }
    }
    line
}
