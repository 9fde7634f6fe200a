//! Arguments that `eval` and `eval ablations` share.

use std::{path::PathBuf, sync::Arc};

use freerange::{Device, SETTINGS_SCHEMA, internal, machine};
use freerange_eval::metrics::Metric;
use freerange_eval::{
    Environment, Scorer, ScorerConfig,
    record::ViewSet,
    runner::{self, Shared},
};
use freerange_util::Share;
use serde_json::{Value, json};

use super::{
    methods::{Method, MethodName, fit_config},
    sources::{Source, SourceArgs},
};
use crate::{error::CliError, photos::UpChoice, pipeline::PipelineArgs, ranks::Job, runtime::commit};

const FIT_ITERATIONS: usize = 2000;
const FIT_SIZE: u32 = 128;

/// What is evaluated, and how.
#[derive(clap::Args)]
pub struct RunArgs {
    #[command(flatten)]
    pub source: SourceArgs,
    /// Observation: input views from all around, from one side, or both.
    #[arg(long, value_enum, default_value = "both")]
    pub views: Views,
    /// Numbers of input views.
    ///
    /// Four are the sets that the data name. Others are chosen among the views that do not score.
    #[arg(long, value_delimiter = ',', default_value = "4", value_parser = clap::value_parser!(u16).range(2..=64))]
    pub inputs: Vec<u16>,
    /// Method that makes the Gaussians.
    #[arg(long, value_enum, default_value = "model")]
    pub method: MethodName,
    /// With `--method ply`: folder with NAME.ply of each object, in the frame of its cameras.
    ///
    /// Different files for the two view sets may be in its folders `full` and `partial`.
    #[arg(long, value_name = "DIR")]
    pub ply: Option<PathBuf>,
    /// Steps of `--method fit`.
    #[arg(long, default_value_t = FIT_ITERATIONS)]
    pub fit_iterations: usize,
    /// Longest side in pixels of the images of `--method fit`.
    #[arg(long, default_value_t = FIT_SIZE)]
    pub fit_size: u32,
    #[command(flatten)]
    pub pipeline: PipelineArgs,
    /// Up axis of the objects: auto (z), z, y, cameras (tops of the photos), or a direction X,Y,Z.
    #[arg(long, default_value = "auto", allow_hyphen_values = true, help_heading = "Photos and cameras")]
    pub up: UpChoice,
    /// Samples per object; reports have their means and their disagreement.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64))]
    pub samples: u32,
    /// Metrics. All but psnr and ssim need a build with `--features networks`. The report names those without weights.
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "NAMES",
        default_value = "psnr,ssim,ssim-cropped,lpips-vgg,lpips-alex,dino,dreamsim,fid"
    )]
    pub metrics: Vec<Metric>,
    /// Folder of the metrics' weights [default: that of `freerange weights fetch`].
    #[arg(long, value_name = "DIR")]
    pub weights: Option<PathBuf>,
    /// Weights of the DINO similarity: dinov2-small, dinov2-base or dinov2-large.
    #[arg(long, value_name = "NAME", default_value = "dinov2-base")]
    pub dino: String,
    /// Delete an earlier run's results in the output folder.
    #[arg(long)]
    pub overwrite: bool,
    /// Image strips of objects: none, or one each, with the extremes or all in report.html.
    #[arg(long, value_enum, default_value = "extremes")]
    pub pictures: Pictures,
    /// Measure only part I of N of the objects, I from 0 to N - 1, and write no report.
    ///
    /// Several processes can fill one folder. Run the command without it at the end.
    #[arg(long, value_name = "I/N")]
    pub shard: Option<Share>,
}

/// From where the input views look.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Views {
    /// From all around the object.
    Full,
    /// All from one side.
    Partial,
    /// Both.
    Both,
}

impl Views {
    /// The view sets.
    pub fn sets(self) -> Vec<ViewSet> {
        match self {
            Self::Full => vec![ViewSet::Full],
            Self::Partial => vec![ViewSet::Partial],
            Self::Both => vec![ViewSet::Full, ViewSet::Partial],
        }
    }
}

/// Which picture strips there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Pictures {
    /// None.
    None,
    /// One per object; the worst and best ones in report.html.
    Extremes,
    /// One per object, all in report.html.
    All,
}

impl From<Pictures> for runner::Pictures {
    fn from(pictures: Pictures) -> Self {
        match pictures {
            Pictures::None => Self::None,
            Pictures::Extremes => Self::Extremes,
            Pictures::All => Self::All,
        }
    }
}

impl RunArgs {
    /// The method, and whatever it needs.
    pub fn open_method(&self, device: &Device) -> Result<Method, CliError> {
        let refuse = |problem: &str| Err(CliError::input(problem));
        match (self.method, &self.ply) {
            (MethodName::Ply, None) => return refuse("--method ply: expected --ply DIR as well"),
            (MethodName::Ply, Some(folder)) if !folder.is_dir() => {
                return Err(CliError::file(folder, "expected a folder of .ply files"));
            }
            (_, Some(_)) if self.method != MethodName::Ply => {
                return refuse("--ply DIR goes with --method ply only");
            }
            _ => {}
        }
        let samples = matches!(self.method, MethodName::Model | MethodName::Start | MethodName::Oracle);
        let drawn = samples || self.method == MethodName::Fit;
        if !drawn && (self.samples > 1 || self.inputs.len() > 1) {
            return refuse("--method white and ply: expected one sample and one number of inputs, they change nothing");
        }
        if !drawn && (self.pipeline.seed != 0 || self.up != UpChoice::Auto) {
            return refuse("--seed and --up go with --method model, start, oracle and fit only");
        }
        if let Some(option) = self.pipeline.given().filter(|_| !samples) {
            return refuse(&format!("{option} goes with --method model, start and oracle only"));
        }
        if let Some(file) = self.pipeline.init_file() {
            let text = format!("--init: expected fit or flow for many objects, found {}", file.display());
            return Err(CliError::input(text));
        }
        if self.method != MethodName::Fit && (self.fit_iterations, self.fit_size) != (FIT_ITERATIONS, FIT_SIZE) {
            return refuse("--fit-iterations and --fit-size go with --method fit only");
        }
        Ok(match self.method {
            MethodName::Model | MethodName::Start | MethodName::Oracle => {
                let model = self.pipeline.open(device)?;
                let mut options = self.pipeline.options(&model, self.samples)?;
                options.frame.up = self.up.or_z();
                if self.method == MethodName::Start {
                    let of_network = self.pipeline.set.iter().find(|(key, _)| key.starts_with("refine."));
                    let option = of_network.map(|(key, _)| format!("--set {key}"));
                    if let Some(option) = option.or_else(|| self.pipeline.precision.map(|_| "--precision".into())) {
                        return refuse(&format!(
                            "{option} goes with --method model and oracle only: start leaves the network out"
                        ));
                    }
                }
                options = internal::without_network(options, self.method == MethodName::Start);
                model.check(&options)?;
                let sha256 = self.pipeline.checkpoint_sha256()?;
                let oracle = self.method == MethodName::Oracle;
                if oracle && options.pipeline.optimize.iterations == 0 {
                    return refuse("--method oracle: expected one or more --iterations");
                }
                Method::Model { model: Arc::new(model), options: Box::new(options), sha256, oracle }
            }
            MethodName::Fit => {
                let seeds = (0..u64::from(self.samples)).map(|i| self.pipeline.seed.wrapping_add(i)).collect();
                let config = Box::new(fit_config(self.fit_iterations, self.fit_size));
                Method::Fit { config, seeds, up: self.up.or_z() }
            }
            MethodName::White => Method::White,
            MethodName::Ply => Method::Ply(self.ply.clone().unwrap_or_default()),
        })
    }

    /// Opens everything that runs share, and what the objects' numbers depend on.
    pub fn open_shared(&self, device: &Device, job: &Job) -> Result<(Shared, Value), CliError> {
        let (index, count) = job.share();
        let share = self.shard.unwrap_or(Share { index: index as u64, count: count as u64 });
        let source: Source = self.source.open()?;
        let settings = source.settings().clone();
        let config = ScorerConfig {
            metrics: self.metrics.clone(),
            weights: self.weights.iter().cloned().chain(machine::weights_folder()).collect(),
            dino: self.dino.clone(),
        };
        #[cfg(feature = "networks")]
        let scorer = Scorer::open(&config, internal::tensor_device(device))?;
        #[cfg(not(feature = "networks"))]
        let scorer = {
            let _ = device; // of the networks
            Scorer::open(&config)?
        };
        if scorer.metrics().is_empty() {
            let reasons: Vec<&String> = scorer.missing().values().collect();
            return Err(CliError::input(format!("no metric can be computed: {reasons:?}")));
        }
        let shared =
            Shared { objects: Box::new(source), scorer, pictures: self.pictures.into(), share, commit: commit() };
        Ok((shared, settings))
    }

    /// Numbers of inputs, each once.
    pub fn inputs(&self) -> Vec<usize> {
        let mut inputs: Vec<usize> = self.inputs.iter().map(|&n| n.into()).collect();
        inputs.sort_unstable();
        inputs.dedup();
        inputs
    }

    /// What the numbers of a run depend on.
    pub fn settings(&self, method: &Method, inputs: &[usize], shared: &Shared, source: &Value) -> Value {
        json!({
            "settings_schema": SETTINGS_SCHEMA, "source": source, "method": method.settings(), "views": self.views.sets(),
            "inputs": inputs, "metrics": shared.scorer.metrics(), "weights": shared.scorer.used_files(),
        })
    }

    /// Where and how this process runs.
    pub fn environment(&self, device: &Device) -> Environment {
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,".contains(c);
        let quoted = |a: String| if !a.is_empty() && a.chars().all(plain) { a } else { format!("{a:?}") };
        let arguments = std::env::args_os().skip(1).map(|a| quoted(a.to_string_lossy().into_owned()));
        Environment {
            command: std::iter::once("freerange".to_owned()).chain(arguments).collect::<Vec<_>>().join(" "),
            commits: Vec::new(),
            processor: machine::processor(),
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            memory_bytes: machine::memory(),
            device: device.to_string(),
        }
    }
}
