//! What the page asks of the program behind it.

use std::{ops::ControlFlow, path::Path};

use freerange_gaussians::Gaussians;
use freerange_scene::camera::{Camera, FrameConfig, View};
use freerange_scene::estimate::LeaveOneOut;
use freerange_util::Stop;
use image::RgbaImage;
use serde::{Deserialize, Serialize};

/// What computes. The server knows no more of it.
pub trait Engine: Send + Sync + 'static {
    /// The model and where it computes, for people.
    fn name(&self) -> String;

    /// What jobs have where they choose nothing, as far as it is known: for people.
    fn defaults(&self) -> JobOptions {
        JobOptions::default()
    }

    /// Which of the views the model would be shown, ascending.
    ///
    /// # Errors
    /// A sentence for the user, where the cameras do not allow a choice.
    fn choose(&self, views: &[View]) -> Result<Vec<usize>, String>;

    /// What masks that are estimated are edited with; none: they are not.
    fn leave_one_out(&self) -> Option<LeaveOneOut>;

    /// Reconstructs. `tell` hears of every step, and ends the work by `ControlFlow::Break`.
    ///
    /// # Errors
    /// Says whose fault it is.
    fn run(
        &self,
        scene: &Scene,
        options: &JobOptions,
        tell: &mut dyn FnMut(&Step<'_>) -> ControlFlow<()>,
    ) -> Result<Outcome, EngineError>;

    /// A picture of `cloud` on white.
    ///
    /// # Errors
    /// A sentence for the log.
    fn picture(&self, cloud: &Gaussians, camera: &Camera) -> Result<RgbaImage, String>;

    /// The program that finds the cameras of photos that have none, for people.
    ///
    /// # Errors
    /// Where there is none: why, in a sentence for the user.
    fn camera_finder(&self) -> Result<String, String>;

    /// Finds the cameras of photos, and writes a scene with them into `search.scene`. `tell` hears of every step.
    ///
    /// # Errors
    /// Says whose fault it is: doubtful cameras are the input's. [`EngineError::Cancelled`] where `search.stop` says so.
    fn find_cameras(&self, search: &Search<'_>, tell: &mut dyn FnMut(SearchStep)) -> Result<FoundCameras, EngineError>;
}

/// Photos without cameras.
pub struct Search<'a> {
    /// The folder of the photos, or one with `images` and perhaps `masks` in it.
    pub photos: &'a Path,
    /// Where the scene goes: there is nothing yet.
    pub scene: &'a Path,
    /// Where temporary files go: there is nothing yet.
    pub work: &'a Path,
    /// The photos are not at even steps of one turn.
    pub uneven: bool,
    /// When to end early.
    pub stop: &'a Stop,
    /// Most bytes of memory of a program that is run.
    pub memory: u64,
    /// Most bytes of memory of the photos that are looked at.
    pub photos_memory: u64,
}

/// How far a search has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SearchStep {
    /// One word: `features`, `matches`, `model` or `checks`.
    pub stage: &'static str,
    /// Steps that are done.
    pub done: usize,
    /// All steps.
    pub total: usize,
}

/// What came of a search.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FoundCameras {
    /// What was done, in a sentence.
    pub notes: Vec<String>,
    /// What may be wrong.
    pub warnings: Vec<String>,
}

/// What is reconstructed from.
#[derive(Clone, Debug)]
pub struct Scene {
    /// The photos: alpha is the object's mask.
    pub views: Vec<View>,
    /// Which way is up, and where the object is, as far as that is known.
    pub frame: FrameConfig,
}

/// What a client may choose.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct JobOptions {
    /// Number of samples; 1 where it is left out.
    pub samples: Option<u32>,
    /// Seed of the first; 0 where it is left out. The others follow.
    pub seed: Option<u64>,
    /// Preset of quality and time; the server's where it is left out.
    pub quality: Option<Quality>,
    /// Optimization steps on the photos; the preset's where it is left out.
    pub iterations: Option<usize>,
    /// Whether symmetries are looked for; the preset's where it is left out.
    pub symmetry: Option<Symmetry>,
    /// What the reconstruction begins with; the model's own way where it is left out.
    pub init: Option<Init>,
}

/// Presets of quality and time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Quality {
    /// The quickest.
    Draft,
    /// What results are reported for.
    Default,
    /// More optimization.
    High,
}

/// Whether symmetries are looked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Symmetry {
    /// Where there is reason to.
    Auto,
    /// Never.
    Off,
}

/// What a reconstruction begins with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Init {
    /// Initial fits of the photos.
    Fit,
    /// Samples from noise.
    Flow,
}

/// Most samples of a job.
pub(crate) const MOST_SAMPLES: usize = 8;

impl JobOptions {
    /// Refuses what would take too long, with a sentence for the user.
    pub(crate) fn check(&self) -> Result<(), String> {
        let within = |name: &str, value: Option<u64>, low: u64, high: u64| match value {
            Some(v) if !(low..=high).contains(&v) => Err(format!("{name}: expected {low} to {high}, found {v}")),
            _ => Ok(()),
        };
        within("samples", self.samples.map(u64::from), 1, MOST_SAMPLES as u64)?;
        // Numbers of JavaScript are exact up to here.
        within("seed", self.seed, 0, (1 << 53) - 1)?;
        within("iterations", self.iterations.map(|v| v as u64), 0, 5000)
    }

    /// One per sample.
    pub fn seeds(&self) -> Vec<u64> {
        (0..u64::from(self.samples.unwrap_or(1))).map(|i| self.seed.unwrap_or(0) + i).collect()
    }
}

/// How far a run has come.
pub struct Step<'a> {
    /// One word.
    pub stage: &'static str,
    /// Which sample is worked on.
    pub sample: usize,
    /// Steps of the stage that are done.
    pub done: usize,
    /// All its steps.
    pub total: usize,
    /// The loss of a fit.
    pub loss: Option<f64>,
    /// The Gaussians of that sample by now, in the frame of the views; nothing where there are none yet. May cost something: it is
    /// called for those steps only that are shown.
    pub preview: &'a dyn Fn() -> Result<Option<Gaussians>, String>,
}

/// What came of a run.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// Seed and Gaussians of each sample, in the frame of the views.
    pub samples: Vec<(u64, Gaussians)>,
    /// The direction of up in that frame.
    pub up: [f64; 3],
    /// What the user should know.
    pub notes: Vec<String>,
    /// Seconds per stage.
    pub seconds: Vec<(String, f64)>,
}

/// Why nothing came of a run.
#[derive(Clone, Debug, thiserror::Error)]
pub enum EngineError {
    /// `tell` said so.
    #[error("cancelled")]
    Cancelled,
    /// The photos or the options cannot be used: a sentence for the user.
    #[error("{0}")]
    Input(String),
    /// The device or the program failed: a sentence for the log.
    #[error("{0}")]
    Failed(String),
}
