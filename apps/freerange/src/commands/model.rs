//! `freerange model`

use std::path::PathBuf;

use freerange::{
    Device, EncoderPlaces,
    internal::{Settings, checkpoint_header, find_encoder, load_checkpoint, network_gaussians},
};
use freerange_model::{Compute, Execution, ModelConfig, ModelInfo, WeightsOrigin, Workload};

use crate::{
    error::CliError,
    runtime::{self, TrainConfig},
};

/// Inspect, shrink, average and export models.
#[derive(clap::Subcommand)]
pub enum Command {
    /// Print shapes, parameters per part, operations and memory of a model or a configuration.
    Info(Info),
    /// Write a checkpoint with 16-bit weights: half the size, the same results to three digits.
    Shrink(Shrink),
    /// Write the mean of checkpoints, weight by weight.
    ///
    /// For runs that began with the same trained weights and differ in their seeds.
    Average(Average),
    /// Write a folder in the layout of model hubs: weights, configuration and a card.
    Export(super::export::Args),
}

/// Arguments of `model info`.
#[derive(clap::Args)]
pub struct Info {
    /// Training configuration (.toml) or checkpoint (.safetensors) [default: the built-in checkpoint].
    file: Option<PathBuf>,
    /// Weights of the checkpoint's frozen encoder: see `freerange reconstruct`.
    #[arg(long, value_name = "FOLDER")]
    encoder_weights: Option<PathBuf>,
    /// Objects per batch [default: the last stage's batch, or 1].
    #[arg(long)]
    batch: Option<usize>,
    /// Input images per object.
    #[arg(long, default_value_t = 4)]
    views: usize,
    /// Memory as on a GPU: activations of 16 bits where possible, attention scores in larger pieces.
    #[arg(long)]
    gpu: bool,
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
    /// Weights of the checkpoint's frozen encoder: see `freerange reconstruct`.
    #[arg(long, value_name = "FOLDER")]
    encoder_weights: Option<PathBuf>,
    /// Configuration whose table `sample` becomes the checkpoint's default: a file, or tiny, base or paper.
    #[arg(long, value_name = "CONFIG")]
    sampling: Option<PathBuf>,
}

/// Arguments of `model average`.
#[derive(clap::Args)]
pub struct Average {
    /// Checkpoints to average. Settings are those of the first one.
    #[arg(required = true, value_name = "CHECKPOINT")]
    inputs: Vec<PathBuf>,
    /// Checkpoint to write.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Weights of the checkpoints' frozen encoder: see `freerange reconstruct`.
    #[arg(long, value_name = "FOLDER")]
    encoder_weights: Option<PathBuf>,
}

pub fn run(command: &Command) -> Result<(), CliError> {
    match command {
        Command::Info(args) => info(args),
        Command::Export(args) => super::export::run(args),
        Command::Average(args) => {
            let encoders = EncoderPlaces::at(args.encoder_weights.clone());
            let load = |path: &PathBuf| {
                let checkpoint = load_checkpoint(Some(&runtime::local(path)?), &encoders, &Device::cpu())?;
                Ok((path.clone(), checkpoint))
            };
            let all = args.inputs.iter().map(load).collect::<Result<Vec<_>, CliError>>()?;
            Ok(freerange_train::average(all)?.save(&args.output)?)
        }
        Command::Shrink(args) => {
            let encoders = EncoderPlaces::at(args.encoder_weights.clone());
            let mut checkpoint = load_checkpoint(Some(&runtime::local(&args.input)?), &encoders, &Device::cpu())?;
            if let Some(path) = &args.sampling {
                let config = TrainConfig::load(path)?;
                let Some(provenance) = checkpoint.provenance.as_object_mut() else {
                    let problem = "field `provenance` of the metadata: expected an object";
                    return Err(CliError::file(&args.input, problem));
                };
                let network_views = config.loss.input_views.1;
                Settings { network_views, sample: config.sample, refiner: config.refiner }.write(provenance);
            }
            Ok(checkpoint.save_as(&args.output, freerange_model::Precision::F16)?)
        }
    }
}

/// What `model info --json` prints.
#[derive(serde::Serialize)]
struct InfoJson<'a> {
    #[serde(flatten)]
    info: &'a ModelInfo,
    /// What its tokens stand for.
    kind: &'a str,
    /// Objects that a checkpoint was trained on, counting repetitions.
    #[serde(skip_serializing_if = "Option::is_none")]
    samples: Option<f64>,
    /// How long that took.
    #[serde(skip_serializing_if = "Option::is_none")]
    training_seconds: Option<f64>,
    /// The published weights that a checkpoint's frozen encoder had in training.
    #[serde(skip_serializing_if = "Option::is_none")]
    encoder_weights: Option<&'a WeightsOrigin>,
}

fn info(args: &Info) -> Result<(), CliError> {
    let is_configuration =
        args.file.as_ref().is_some_and(|f| f.extension().is_some_and(|e| e == "toml") || TrainConfig::is_preset(f));
    let (model, depth, batch, compute, recompute, provenance) = match (&args.file, is_configuration) {
        (Some(file), true) => {
            let config = TrainConfig::load(file)?;
            let stage = config.stages.last().ok_or_else(|| CliError::input("a configuration without stages"))?.clone();
            let model = ModelConfig { image_size: stage.image_size, ..config.model };
            (model, stage.depth, stage.at_a_time(), config.optimizer.compute, config.optimizer.recompute, None)
        }
        (file, _) => {
            let c = checkpoint_header(runtime::local_or_shipped(file.as_deref())?.as_deref())?;
            let depth = network_gaussians(&c.config, &c.provenance, c.depth)?.ilog2();
            (c.config, depth, 1, Compute::F32, false, Some((c.provenance, c.encoder_weights)))
        }
    };
    let workload = Workload {
        batch: args.batch.unwrap_or(batch),
        views: args.views,
        gaussians: model.gaussians(depth, args.views),
    };
    let execution = Execution { gpu: args.gpu, compute, recompute };
    let info = ModelInfo::with_execution(&model, workload, execution);
    if args.json {
        let encoder_weights = provenance.as_ref().and_then(|(_, origin)| origin.as_ref());
        let fact = |name: &str| provenance.as_ref().and_then(|(provenance, _)| provenance.get(name)?.as_f64());
        let json = serde_json::to_string_pretty(&InfoJson {
            info: &info,
            kind: model.kind.name(),
            samples: fact("samples"),
            training_seconds: fact("training_seconds"),
            encoder_weights,
        });
        println!("{}", json.map_err(CliError::input)?);
        return Ok(());
    }
    println!("{info}");
    if let Some((provenance, encoder)) = provenance {
        if let Some(origin) = encoder {
            println!("\nencoder weights {} (sha256 {})", origin.name, origin.sha256);
            match find_encoder(&EncoderPlaces::at(args.encoder_weights.clone()), &origin.name) {
                Ok(found) => println!("found in {}", found.folder.display()),
                Err(e) => println!("not found: {e}"),
            }
        }
        println!("\n{}", serde_json::to_string_pretty(&provenance).map_err(CliError::input)?);
    }
    Ok(())
}
