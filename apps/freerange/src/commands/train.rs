//! `freerange train`

mod interrupt;
mod journal;
mod run;

use std::{
    path::{Path, PathBuf},
    sync::Arc,
    time::{Duration, Instant},
};

use burn::tensor::Device;
use freerange::{
    DeviceName, EncoderPlaces,
    internal::{checkpoint_sha256, encoder_for_training, load_checkpoint, tensor_device},
};
use freerange_train::{
    TrainError,
    batch::step_rng,
    trainer::{Among, Initial, Trainer},
};
use freerange_util::sha256_of;

use freerange_model::{Execution, FreeRange, ModelConfig, ModelInfo, Workload};

use self::{interrupt::Interrupt, journal::Journal, run::Run};
use crate::{
    error::CliError,
    ranks::{Job, Sums},
    runtime::{TrainConfig, commit, local_or_shipped},
    signals::Signals,
};

/// Train a model. Run the same command again to continue a stopped run.
///
/// Writes checkpoint.safetensors (averaged weights), log.jsonl (one line per step), events for TensorBoard, and the state to continue
/// from. With `[validation]` in the configuration, best.safetensors has the weights that measured best on other objects. A build with
/// `--features mpi` trains one model with several processes of mpirun or srun.
#[derive(clap::Args)]
pub struct Args {
    /// Configuration: a file such as configs/tiny.toml, or tiny, base or paper.
    config: PathBuf,
    /// Output folder of the run.
    #[arg(short, long, required_unless_present = "dry_run")]
    output: Option<PathBuf>,
    /// Build the model with random weights and print what a step of each stage needs.
    ///
    /// Needs neither data nor encoder weights.
    #[arg(long)]
    dry_run: bool,
    /// Checkpoint whose weights a new run begins with [default: random weights].
    #[arg(long, value_name = "FILE")]
    initial: Option<PathBuf>,
    /// Weights of the frozen encoder: a folder with config.json and model.safetensors.
    ///
    /// Without it, `weights` in [model.encoder] of the configuration is used.
    #[arg(long, value_name = "FOLDER")]
    encoder_weights: Option<PathBuf>,
    /// With --initial: compute normalization statistics from this run's data instead of the checkpoint's.
    #[arg(long, requires = "initial")]
    remeasure: bool,
    /// Stop after this many minutes and save the state, as at Ctrl-C and SIGTERM.
    #[arg(long)]
    minutes: Option<f64>,
    /// Steps between two saved states.
    #[arg(long, default_value_t = 250, value_parser = clap::value_parser!(u64).range(1..))]
    save_every: u64,
    /// Device: auto, cpu, cuda, metal, vulkan or webgpu, with a number as in cuda:1.
    #[arg(long, default_value = "auto")]
    device: DeviceName,
    /// All-reduce backend of several processes.
    #[arg(long, value_enum, default_value_t)]
    sums: Sums,
}

pub fn run(args: &Args) -> Result<(), CliError> {
    let begin = Instant::now();
    let signals = Signals::take();
    let interrupt = Arc::new(Interrupt::default());
    let hear = interrupt.clone();
    signals.on_first(move || hear.ask())?;
    let job = Job::start()?;
    let result = train(args, &job, &interrupt, begin);
    job.end(result)
}

fn train(args: &Args, job: &Job, interrupt: &Arc<Interrupt>, begin: Instant) -> Result<(), CliError> {
    let say = |text: &str| {
        if job.first() {
            eprintln!("{text}");
        }
    };
    let prepared = || {
        let device = job.open(args.device)?;
        let config = TrainConfig::load(&args.config)?;
        device.require(config.optimizer.compute)?;
        Ok((device, config))
    };
    let (opened, config) = job.together(prepared())?;
    let device = tensor_device(&opened);
    let output = match &args.output {
        Some(output) if !args.dry_run => output,
        _ => return job.together(if job.first() { dry_run(&config, device) } else { Ok(()) }),
    };
    let ranks = job.sums(args.sums, device)?;
    let total = config.total_steps();
    let encoders = EncoderPlaces::at(args.encoder_weights.clone());
    let weights = || {
        let encoder = encoder_for_training(&encoders, &config.model.encoder)?;
        let path = local_or_shipped(args.initial.as_deref())?;
        let initial = path.as_ref().map(|path| load_checkpoint(Some(path), &encoders, &opened)).transpose()?;
        let identity = match job.world() {
            1 => Vec::new(),
            _ => identity(path.as_deref(), args.remeasure)?,
        };
        Ok((encoder, initial, identity))
    };
    let (encoder, initial, identity) = job.together(weights())?;
    let initial = initial.as_ref().map(|checkpoint| Initial { checkpoint, remeasure: args.remeasure });
    let among = Among { ranks, identity };
    let trainer = Trainer::open_among(among, config, output, initial, encoder.as_ref(), device, say);
    let mut trainer = job.together(trainer.map_err(CliError::from))?;
    let allowed = args.minutes.and_then(|minutes| Duration::try_from_secs_f64(60.0 * minutes.max(0.0)).ok());
    let over = allowed.and_then(|allowed| begin.checked_add(allowed));
    interrupt.begin(job.world());
    let (asked, at_once) = (interrupt.clone(), interrupt.clone());
    trainer.stop_when(move || asked.is_asked() || over.is_some_and(|time| Instant::now() >= time));
    trainer.interrupt_when(move || at_once.is_asked());
    // Rank 0 speaks and writes for all.
    let journal = || Journal::open(output, &trainer).map_err(CliError::from);
    let journal = job.together(if job.first() { journal().map(Some) } else { Ok(None) })?;
    let mut run = Run::new(&mut trainer, journal, interrupt, args.save_every);
    match run.go_on() {
        // The others cannot be heard any more.
        Err(e @ TrainError::Ranks { .. }) => return Err(e.into()),
        ended => job.together(ended.map_err(CliError::from))?,
    }
    run.finish();
    if job.first() {
        println!("{} of {total} steps; {}", trainer.step_count(), output.join("checkpoint.safetensors").display());
    }
    // A launcher would take it for a failure, and end the others while rank 0 may still be writing.
    if interrupt.is_asked() && !trainer.is_finished() && job.world() == 1 {
        return Err(CliError::asked_to_end("the same command goes on from here"));
    }
    Ok(())
}

/// What has to be the same on all ranks, besides what the trainer compares itself.
fn identity(initial: Option<&Path>, remeasure: bool) -> Result<Vec<(String, String)>, CliError> {
    let program = std::env::current_exe().map_err(CliError::failure)?;
    let hash = std::fs::File::open(&program).and_then(|mut file| sha256_of(&mut file));
    let initial = initial.map_or(Ok("none".into()), |path| checkpoint_sha256(Some(path)))?;
    let values = [
        ("version of freerange", format!("{} ({})", env!("CARGO_PKG_VERSION"), commit())),
        ("program", hash.map_err(|e| CliError::file(&program, e))?),
        ("--initial", initial),
        ("--remeasure", remeasure.to_string()),
    ];
    Ok(values.map(|(what, value)| (what.to_owned(), value)).to_vec())
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
        let workload = Workload {
            batch: stage.at_a_time().min(stage.batch / config.data.virtual_ranks),
            views,
            gaussians: model.gaussians(stage.depth, views),
        };
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
