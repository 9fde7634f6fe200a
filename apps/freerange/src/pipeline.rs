//! Options of every command that reconstructs: the model, its pipeline, and where to compute.

use std::{path::PathBuf, str::FromStr};

use freerange::{
    Choices, Compute, Detect, Device, DeviceName, EncoderPlaces, Init, Options, Quality, Reconstructor,
    internal::{checkpoint_sha256, shipped},
};

use crate::{
    error::CliError,
    runtime::{local, local_or_shipped},
};

/// Options of every command that reconstructs.
#[derive(Clone, clap::Args)]
#[command(next_help_heading = "Quality and time")]
pub struct PipelineArgs {
    /// Preset of quality and time.
    ///
    /// Steps are for up to four photos. With five to sixteen photos their number grows, up to five times.
    #[arg(long, value_enum, default_value = "default")]
    pub quality: QualityName,
    /// Optimization steps on the photos; 0 returns the network's Gaussians [default: of the preset, 400].
    ///
    /// For up to four photos. With five to sixteen photos the number grows, up to five times.
    #[arg(long, value_name = "STEPS")]
    pub iterations: Option<usize>,
    /// Detect mirror planes and axes of revolution [default: auto; off in draft].
    ///
    /// With up to four photos. A plane adds mirrored photos, an axis adds rotated silhouettes, where the photos agree.
    #[arg(long, value_enum)]
    pub symmetry: Option<SymmetryName>,
    /// Begin with initial fits, flow samples from noise (the paper), or a file of Gaussians [default: fit].
    ///
    /// A file is in the cameras' frame.
    #[arg(long, value_name = "fit|flow|FILE")]
    pub init: Option<InitChoice>,
    /// Set a field of the pipeline, such as propose.count=2; an unknown KEY lists all.
    #[arg(long, value_name = "KEY=VALUE", value_parser = assignment)]
    pub set: Vec<(String, String)>,
    /// Most photos that the network sees, spread around the object [default: 6, or the checkpoint's].
    ///
    /// The optimization sees all photos.
    #[arg(long, value_name = "K", value_parser = clap::value_parser!(u16).range(1..=256), hide_short_help = true)]
    pub network_views: Option<u16>,
    /// Seed of the (first) sample.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Model: a file, or hf:OWNER/NAME[@REVISION] [default: the built-in one].
    ///
    /// The cache keeps the commit that a revision on the Hugging Face hub had at its first use.
    #[arg(long, value_name = "FILE", help_heading = "Model and device")]
    pub checkpoint: Option<PathBuf>,
    /// Weights of the checkpoint's frozen encoder: a folder with config.json and model.safetensors.
    ///
    /// Without it: the folder used in training, then that of `freerange weights fetch`. The built-in model needs none.
    #[arg(
        long,
        value_name = "FOLDER",
        requires = "checkpoint",
        hide_short_help = true,
        help_heading = "Model and device"
    )]
    pub encoder_weights: Option<PathBuf>,
    /// Precision of the network: f32, bf16, f16, or auto for bf16 where the device has it, else f32 [default: auto, or the checkpoint's].
    #[arg(long, value_parser = parse_precision, hide_short_help = true, help_heading = "Model and device")]
    pub precision: Option<Compute>,
    /// Device: auto, cpu, cuda, metal, vulkan or webgpu, with a number as in cuda:1.
    #[arg(long, default_value = "auto", help_heading = "Model and device")]
    pub device: DeviceName,
}

/// Presets of quality and time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum QualityName {
    /// One proposal, no symmetry, 150 steps at 256 pixels (750 at 512 pixels from 16 photos on).
    Draft,
    /// The setting of the main results: 400 steps at up to 512 pixels (2,000 from 16 photos on).
    Default,
    /// Twice the optimization steps: 800 (4,000 from 16 photos on).
    High,
}

impl From<QualityName> for Quality {
    fn from(name: QualityName) -> Self {
        match name {
            QualityName::Draft => Self::Draft,
            QualityName::Default => Self::Default,
            QualityName::High => Self::High,
        }
    }
}

/// Whether symmetries are looked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum SymmetryName {
    /// With up to four photos.
    Auto,
    /// Never.
    Off,
}

/// What a reconstruction begins with.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum InitChoice {
    /// What the pipeline makes.
    Made(Init),
    /// A file of Gaussians.
    File(PathBuf),
}

impl FromStr for InitChoice {
    type Err = std::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(match text {
            "fit" => Self::Made(Init::Fit),
            "flow" => Self::Made(Init::Flow),
            file => Self::File(file.into()),
        })
    }
}

fn assignment(text: &str) -> Result<(String, String), String> {
    let (key, value) = text.split_once('=').ok_or("expected KEY=VALUE, as in propose.count=2")?;
    Ok((key.to_owned(), value.to_owned()))
}

/// `f32`, `bf16`, `f16` or `auto`.
pub fn parse_precision(text: &str) -> Result<Compute, String> {
    serde_json::from_value(text.into()).map_err(|_| "expected f32, bf16, f16 or auto".into())
}

impl PipelineArgs {
    /// The model that the user names, or the shipped one.
    pub fn open(&self, device: &Device) -> Result<Reconstructor, CliError> {
        Ok(match &self.checkpoint {
            Some(path) => Reconstructor::load(&local(path)?, &EncoderPlaces::at(self.encoder_weights.clone()), device)?,
            None => shipped(device)?,
        })
    }

    /// SHA-256 of that model's checkpoint.
    pub fn checkpoint_sha256(&self) -> Result<String, CliError> {
        Ok(checkpoint_sha256(local_or_shipped(self.checkpoint.as_deref())?.as_deref())?)
    }

    /// The file of Gaussians to begin with, if there is one.
    pub fn init_file(&self) -> Option<&PathBuf> {
        match &self.init {
            Some(InitChoice::File(file)) => Some(file),
            _ => None,
        }
    }

    /// The options that are given and say something of the pipeline: for commands where there may be none.
    pub fn given(&self) -> Option<&'static str> {
        let given = [
            (self.quality != QualityName::Default, "--quality"),
            (self.iterations.is_some(), "--iterations"),
            (self.symmetry.is_some(), "--symmetry"),
            (self.init.is_some(), "--init"),
            (!self.set.is_empty(), "--set"),
            (self.precision.is_some(), "--precision"),
            (self.network_views.is_some(), "--network-views"),
            (self.checkpoint.is_some(), "--checkpoint"),
        ];
        given.into_iter().find_map(|(given, name)| given.then_some(name))
    }

    /// What the user chooses.
    pub fn choices(&self) -> Choices {
        Choices {
            quality: self.quality.into(),
            iterations: self.iterations,
            symmetry: self.symmetry.map(|s| if s == SymmetryName::Auto { Detect::Auto } else { Detect::Off }),
            init: match self.init {
                Some(InitChoice::Made(init)) => Some(init),
                _ => None,
            },
            precision: self.precision,
            network_views: self.network_views.map(usize::from),
            set: self.set.clone(),
        }
    }

    /// The model's own pipeline, with what the user chooses, all of which has an effect.
    pub fn options(&self, model: &Reconstructor, samples: u32) -> Result<Options, CliError> {
        let options = self.options_of_jobs(model, samples)?;
        self.choices().check_effect(&options.pipeline, self.init_file().is_some())?;
        Ok(options)
    }

    /// The same for jobs that choose further: what has no effect on one of them has an effect on another.
    pub fn options_of_jobs(&self, model: &Reconstructor, samples: u32) -> Result<Options, CliError> {
        let mut options = model.options_of(&self.choices())?;
        options.seeds = (0..u64::from(samples)).map(|i| self.seed.wrapping_add(i)).collect();
        model.check(&options)?;
        Ok(options)
    }
}
