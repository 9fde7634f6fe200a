//! What a folder of shards is told.

use std::sync::Arc;

use crate::layout::MAX_DEPTH;
use crate::{DataError, ImageFormat, Making, ObjectSource};
use freerange_assets::mesh::LoadLimits;
use freerange_scene::camera::SelectionConfig;
use freerange_util::{Invalid, check};

use crate::build::{BuildError, Generated, ObjectConfig};

/// What is stored of each object, and how objects are divided.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ShardConfig {
    /// Objects per shard; the last one may have fewer.
    pub objects_per_shard: u64,
    /// Format of the views.
    pub images: ImageFormat,
    /// Whether the full fit is stored, too. Slices at other depths then need no other fit.
    pub leaves: bool,
    /// Views per object, from cameras of their own, that Gaussians are measured against and that are not stored. 0
    /// measures nothing.
    pub held_out: usize,
    /// Objects whose full fit has less PSNR than this, in dB, are flagged: they stay in the shard, but statistics and training
    /// leave them out.
    pub min_psnr: f64,
    /// Fraction of objects for validation, chosen by their ids.
    pub validation: f64,
    /// Fraction of objects for testing.
    pub test: f64,
    /// View sets for evaluation: inputs and validation views. Its seed is replaced by the object's. Objects with fewer than
    /// `2 inputs + validation` views get none.
    pub selection: SelectionConfig,
}

impl Default for ShardConfig {
    fn default() -> Self {
        Self {
            objects_per_shard: 64,
            images: ImageFormat::Webp,
            leaves: false,
            held_out: 4,
            min_psnr: 20.0,
            validation: 0.01,
            test: 0.01,
            selection: SelectionConfig::default(),
        }
    }
}

impl ShardConfig {
    /// Checks every field.
    ///
    /// # Errors
    /// [`Invalid`] with the field's name.
    pub fn validate(&self) -> Result<(), Invalid> {
        let per = self.objects_per_shard;
        check((1..=1 << 20).contains(&per), "objects_per_shard", "1 to 2^20", per)?;
        check(self.held_out <= 100, "held_out", "0 to 100", self.held_out)?;
        check((0.0..=100.0).contains(&self.min_psnr), "min_psnr", "0 to 100", self.min_psnr)?;
        let [v, t] = [self.validation, self.test];
        let shares = (0.0..=1.0).contains(&v) && (0.0..=1.0).contains(&t) && v + t <= 1.0;
        check(shares, "validation, test", "shares of at most 1 together", (v, t))?;
        let s = &self.selection;
        let counts = (2..=64).contains(&s.inputs) && (1..=1000).contains(&s.validation);
        check(counts, "selection", "2 to 64 inputs and 1 to 1000 validation views", (s.inputs, s.validation))
    }
}

/// Everything that decides on the bytes of a folder of shards, besides what its objects are made of.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BuildConfig {
    /// Seed of what is drawn for the objects: cameras, light, fits, splits.
    pub seed: u64,
    /// Depths of the slices to keep, ascending.
    pub depths: Vec<u32>,
    /// What is stored.
    pub shard: ShardConfig,
    /// How an object is made.
    pub object: ObjectConfig,
    /// What mesh files may be like.
    pub mesh: LoadLimits,
}

impl Default for BuildConfig {
    fn default() -> Self {
        Self {
            seed: 0,
            depths: vec![8, 9, 10, 11, 12],
            shard: ShardConfig::default(),
            object: ObjectConfig::default(),
            mesh: LoadLimits::default(),
        }
    }
}

impl BuildConfig {
    /// Checks every field.
    ///
    /// # Errors
    /// As [`ObjectConfig::validate`].
    pub fn validate(&self) -> Result<(), BuildError> {
        let ascending = self.depths.is_sorted_by(|a, b| a < b) && self.depths.iter().all(|d| *d <= MAX_DEPTH);
        let expected = format!("one or more ascending depths up to {MAX_DEPTH}");
        check(ascending && !self.depths.is_empty(), "depths", &expected, &self.depths)?;
        self.shard.validate()?;
        self.object.validate()
    }
}

/// What the `[data]` of a training configuration says of how objects are made, on the fly and in shards.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MakingConfig {
    /// How an object is made: its Gaussians, views and cameras.
    pub object: ObjectConfig,
    /// What shards keep of each object, and how objects are divided.
    pub shard: ShardConfig,
    /// Values of `object` that are different for objects in shards.
    pub build: BuildOverrides,
    /// Depths of the slices in shards, ascending; empty: those of training.
    pub depths: Vec<u32>,
    /// What mesh files may be like.
    pub mesh: LoadLimits,
}

/// Fields of [`ObjectConfig`] that are different for objects in shards.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BuildOverrides {
    /// Views per object.
    pub views: Option<usize>,
    /// Optimization steps on each slice.
    pub slice_iterations: Option<usize>,
    /// Initial fits of a few views per object.
    pub input_fits: Option<usize>,
}

impl MakingConfig {
    /// How shards are made for training with this seed and slices at these depths.
    pub fn build_config(&self, seed: u64, depths: &[u32]) -> BuildConfig {
        let mut object = self.object.clone();
        object.views = self.build.views.unwrap_or(object.views);
        object.slice_iterations = self.build.slice_iterations.unwrap_or(object.slice_iterations);
        object.input_fits = self.build.input_fits.unwrap_or(object.input_fits);
        BuildConfig {
            seed,
            depths: if self.depths.is_empty() { depths.to_vec() } else { self.depths.clone() },
            shard: self.shard.clone(),
            object,
            mesh: self.mesh.clone(),
        }
    }
}

impl Making for MakingConfig {
    const FIELDS: &[&str] = &["object", "shard", "build", "depths", "mesh"];

    fn check(&self, seed: u64, depths: &[u32]) -> Result<(), DataError> {
        let shards = || self.build_config(seed, depths).validate();
        self.object.validate().and_then(|()| shards()).map_err(DataError::from_source)
    }

    fn views(&self) -> usize {
        self.object.views
    }

    fn input_fits(&self) -> usize {
        self.object.input_fits
    }

    fn source(&self, depths: Vec<u32>, seed: u64) -> Arc<dyn ObjectSource> {
        Arc::new(Generated { config: self.object.clone(), depths, seed })
    }
}
