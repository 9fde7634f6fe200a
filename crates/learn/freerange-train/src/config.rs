//! Everything that training needs to know, as one TOML file. `configs/tiny.toml` is a commented example.

mod checks;
mod data;
mod loss;
mod optimizer;
mod stage;

use std::path::Path;

use freerange_data::Making;
use freerange_diffusion::sample::{FlowConfig, RefinerConfig};
use freerange_model::ModelConfig;

pub use self::{
    data::DataConfig,
    loss::{FrameJitter, LossConfig, RefinementLoss, Symmetries},
    optimizer::{Decay, OptimizerConfig, RateSchedule},
    stage::Stage,
};
use crate::TrainError;

/// A training run, with `M` for how its objects are made.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, bound(deserialize = "M: Making"))]
pub struct TrainConfig<M = ()> {
    /// Seed of everything random: initial weights, objects, noise, times, views.
    #[serde(default)]
    pub seed: u64,
    /// The network.
    pub model: ModelConfig,
    /// The objects to train on.
    #[serde(deserialize_with = "data::with_making")]
    pub data: DataConfig<M>,
    /// The loss and its terms; each can be switched off (the paper's ablations).
    #[serde(default)]
    pub loss: LossConfig,
    /// The optimizer.
    #[serde(default)]
    pub optimizer: OptimizerConfig,
    /// The curriculum, coarse to fine.
    #[serde(rename = "stage")]
    pub stages: Vec<Stage>,
    /// Measuring on other objects while training.
    #[serde(default)]
    pub validation: ValidationConfig,
    /// How the finished model is sampled from, unless the user says otherwise; kept in the checkpoint.
    #[serde(default)]
    pub sample: FlowConfig,
    /// How the finished model refines initial fits, if it learns to (`loss.refinement`); kept in the checkpoint.
    #[serde(default)]
    pub refiner: Option<RefinerConfig>,
}

/// Measuring while training.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ValidationConfig {
    /// Steps between two measurements; 0: none.
    pub every: u64,
    /// Number of objects: of the shards' validation split, or generated from seeds of their own.
    pub objects: usize,
}

impl Default for ValidationConfig {
    fn default() -> Self {
        Self { every: 0, objects: 8 }
    }
}

impl<M> TrainConfig<M> {
    /// Whether this names a configuration of the repository.
    pub fn is_preset(path: &Path) -> bool {
        crate::inherit::PRESETS.iter().any(|(name, _)| path.as_os_str() == *name)
    }

    /// All steps of all stages.
    pub fn total_steps(&self) -> u64 {
        self.stages.iter().map(|s| s.steps).sum()
    }

    /// The stage that step `step` belongs to; the last one from the end on.
    pub fn stage(&self, step: u64) -> &Stage {
        let mut end = 0;
        let found = self.stages.iter().find(|s| {
            end += s.steps;
            step < end
        });
        found.unwrap_or_else(|| self.stages.last().expect("validated: at least one stage"))
    }

    /// Every depth of the curriculum.
    pub fn depths(&self) -> Vec<u32> {
        let mut depths: Vec<u32> = self.stages.iter().map(|s| s.depth).collect();
        depths.sort_unstable();
        depths.dedup();
        depths
    }

    /// The same without how objects are made, and that.
    pub fn apart(self) -> (TrainConfig, M) {
        let Self { seed, model, data, loss, optimizer, stages, validation, sample, refiner } = self;
        let DataConfig { shards, allow_incomplete, window, fresh, workers, virtual_ranks, statistics_objects, making } =
            data;
        let data = DataConfig {
            shards,
            allow_incomplete,
            window,
            fresh,
            workers,
            virtual_ranks,
            statistics_objects,
            making: (),
        };
        (TrainConfig { seed, model, data, loss, optimizer, stages, validation, sample, refiner }, making)
    }
}

impl<M: Making> TrainConfig<M> {
    /// Reads and checks a configuration: a file, or one of the repository's by its name (`tiny`, `base`, `paper`).
    ///
    /// A file may hold only what differs from another one, its `parent`: the name of one of the repository's, or a path
    /// relative to the file. Tables are merged key by key; lists, the stages among them, are replaced whole.
    ///
    /// # Errors
    /// [`TrainError::Io`]; [`TrainError::State`] where a file is no configuration or parents go in a circle; those of
    /// [`validate`](Self::validate).
    pub fn load(path: &Path) -> Result<Self, TrainError> {
        let table = crate::inherit::load(path)?;
        let config: Self = table
            .try_into()
            .map_err(|e: toml::de::Error| TrainError::State { path: path.into(), problem: e.to_string() })?;
        config.validate()?;
        Ok(config)
    }
}
