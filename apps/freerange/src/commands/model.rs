//! `freerange model`

use std::path::PathBuf;

use freerange_flow::config::TrainConfig;
use freerange_model::{ModelConfig, ModelInfo, Workload};

use crate::{error::CliError, runtime};

/// Look at models.
#[derive(clap::Subcommand)]
pub enum Command {
    /// Shapes, parameters per part, arithmetic and memory. Of a configuration, nothing is allocated.
    Info(Info),
    /// Write a checkpoint with weights of 16 bits: half the size, the same results to three digits.
    Shrink(Shrink),
}

/// Arguments of `model info`.
#[derive(clap::Args)]
pub struct Info {
    /// Training configuration (.toml) or checkpoint (.safetensors) [default: the shipped checkpoint].
    file: Option<PathBuf>,
    /// Samples at once [default: the last stage's batch, or 1].
    #[arg(long)]
    batch: Option<usize>,
    /// Input images per sample.
    #[arg(long, default_value_t = 4)]
    views: usize,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Arguments of `model shrink`.
#[derive(clap::Args)]
pub struct Shrink {
    /// Checkpoint to read.
    input: PathBuf,
    /// Checkpoint to write.
    output: PathBuf,
}

/// Runs the command.
pub fn run(command: &Command) -> Result<(), CliError> {
    match command {
        Command::Info(args) => info(args),
        Command::Shrink(args) => {
            let checkpoint = runtime::checkpoint(Some(&args.input), &burn::tensor::Device::flex())?;
            Ok(checkpoint.save_as(&args.output, freerange_model::Precision::F16)?)
        }
    }
}

fn info(args: &Info) -> Result<(), CliError> {
    let is_configuration = args.file.as_ref().is_some_and(|f| f.extension().is_some_and(|e| e == "toml"));
    let (model, depth, batch, provenance) = match (&args.file, is_configuration) {
        (Some(file), true) => {
            let config = TrainConfig::load(file)?;
            let stage = config.stages.last().ok_or_else(|| CliError::input("a configuration without stages"))?.clone();
            (ModelConfig { image_size: stage.image_size, ..config.model }, stage.depth, stage.batch, None)
        }
        (file, _) => {
            let c = runtime::checkpoint(file.as_deref(), &burn::tensor::Device::flex())?;
            (c.config, c.depth, 1, Some(c.provenance))
        }
    };
    let workload = Workload { batch: args.batch.unwrap_or(batch), views: args.views, gaussians: 1 << depth };
    let info = ModelInfo::new(&model, workload);
    if args.json {
        println!("{}", serde_json::to_string_pretty(&info).map_err(CliError::input)?);
        return Ok(());
    }
    println!("{:28} {:>14}  shape", "part", "parameters");
    for part in &info.parts {
        println!("{:28} {:>14}  {}", part.name, part.parameters, part.shape);
    }
    println!("{:28} {:>14}", "trained", info.trainable);
    println!("{:28} {:>14}", "frozen", info.frozen);
    let w = info.workload;
    println!(
        "\n{} sample(s), {} views of {} px, {} Gaussians: {} tokens",
        w.batch, w.views, model.image_size, w.gaussians, info.tokens
    );
    println!("encoding the images  {:10.3} TFLOP", info.encoder_flops / 1e12);
    println!("one forward pass     {:10.3} TFLOP (a training step about three times that)", info.forward_flops / 1e12);
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    println!("weights, gradients, Adam: {:.2} GiB", gib(info.state_bytes));
    println!(
        "activations of a training step: {:.2} GiB; {:.2} GiB if blocks are computed again in the backward pass",
        gib(info.activation_bytes),
        gib(info.recomputed_activation_bytes)
    );
    if let Some(provenance) = provenance {
        println!("\n{}", serde_json::to_string_pretty(&provenance).map_err(CliError::input)?);
    }
    Ok(())
}
