//! Everything that training needs to know, as one TOML file. `configs/tiny.toml` is a commented example.

use std::path::Path;

use freerange_data::Making;
use freerange_model::{Compute, ModelConfig, ModelKind};
use freerange_util::{Invalid, check};

use serde::{Deserialize, de::Error};

use crate::{TrainError, ValidationConfig, ranks::Wire};
use freerange_diffusion::{
    coupling::Coupling,
    sample::{FlowConfig, GradientAt, RefinerConfig},
};

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
    #[serde(deserialize_with = "data")]
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

/// Where training objects come from, and how they are used.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields, bound(deserialize = "M: Default"))]
pub struct DataConfig<M = ()> {
    /// Shards made by `freerange data build`: a folder (in a file, its path is relative to the file), or a URL (`s3://`,
    /// `gs://`, `https://`). Without it, objects are generated on the fly, without end.
    pub shards: Option<String>,
    /// Train on the shards that are finished by now where the folder is still being made. Resuming takes those finished in
    /// the meantime too: a resumed run is then not bit-identical to an uninterrupted one.
    pub allow_incomplete: bool,
    /// Objects held in memory, from which each batch is drawn.
    pub window: usize,
    /// Objects of the window that are replaced at every step.
    pub fresh: usize,
    /// Threads that make or read objects beside training.
    pub workers: usize,
    /// Virtual ranks. Object i belongs to virtual rank i mod `lanes`; each has its part of window, fresh objects and batch.
    /// Any number of processes that divides it trains the same, and each reads only its own objects.
    pub lanes: usize,
    /// Objects over which the normalization statistics are measured before training.
    pub statistics_objects: usize,
    /// How objects are made. Its fields are beside the others.
    #[serde(flatten, skip_deserializing)]
    pub making: M,
}

impl<M: Default> Default for DataConfig<M> {
    fn default() -> Self {
        Self {
            shards: None,
            allow_incomplete: false,
            window: 64,
            fresh: 2,
            workers: 1,
            lanes: 1,
            statistics_objects: 256,
            making: M::default(),
        }
    }
}

/// Reads `[data]`: its fields of training, and those that belong to whoever makes objects.
fn data<'de, D: serde::Deserializer<'de>, M: Making>(deserializer: D) -> Result<DataConfig<M>, D::Error> {
    let mut training = toml::Table::deserialize(deserializer)?;
    let making: toml::Table = M::FIELDS.iter().filter_map(|field| training.remove_entry(*field)).collect();
    let wrong = |e: toml::de::Error| D::Error::custom(e.to_string().trim_end());
    let making = M::deserialize(making).map_err(wrong)?;
    let training: DataConfig<M> = training.try_into().map_err(wrong)?;
    Ok(DataConfig { making, ..training })
}

/// The training loss (paper, Section 3.3).
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LossConfig {
    /// The flow-matching term.
    pub flow: bool,
    /// The rendering loss over input views, `w(t) R_Seen`.
    pub seen: bool,
    /// The rendering loss over other views, `w(t) R_Held`.
    pub held: bool,
    /// Held-out views per object.
    pub held_views: usize,
    /// Side, in pixels, of the images that the rendering losses compare.
    pub render_size: u32,
    /// Side, in pixels, of the images that the network's gradient channels are taken on.
    pub gradient_size: u32,
    /// Lower bound of `1 - t` in the flow loss.
    pub min_remaining: f32,
    /// Probability that a sample is trained without images, for classifier-free guidance.
    pub unconditional: f32,
    /// How noise is paired with Gaussians.
    pub coupling: Coupling,
    /// Tokens of Gaussians picked at random instead of neighbors in the tree (an ablation of the paper).
    pub random_patches: bool,
    /// Fewest and most input views; the number is drawn for each batch.
    pub input_views: (usize, usize),
    /// Batches that refine initial fits of their input views, which the objects must have; left out: none.
    pub refinement: Option<RefinementLoss>,
    /// Share of the batches in which the network is fed its own estimate, made without a gradient just before
    /// (`model.estimate_channels`).
    pub self_conditioning: f32,
    /// Most estimates made in such a batch, each from the one before; the number is drawn for each batch.
    pub estimates: usize,
    /// Where the gradient that the network sees is taken; at the noisy sample where there is no estimate.
    pub gradient_at: GradientAt,
    /// Fraction of the batches with partial observation: all input views on one side of the object.
    pub one_sided: f32,
    /// Random errors of the canonical frame, since a user's frame is estimated from few views.
    pub frame_jitter: FrameJitter,
    /// Augmentation: a symmetric variant of the object is drawn each time it is used.
    pub symmetries: Symmetries,
}

/// Training of a [`Refiner`](freerange_diffusion::sample::Refiner): batches without noise, at time 0, in which the network is fed an initial
/// fit as an estimate. They have the input views of their fits, and lead to what these should have been:
/// [`InputFit::mended`](freerange_data::InputFit).
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RefinementLoss {
    /// Share of the batches that do; the others start from pure noise, with views drawn anew.
    pub share: f32,
    /// Weight of the rendering losses in them.
    pub render_weight: f32,
}

/// Standard deviations of a training object's frame errors, normal and cut at two of them. 0: none.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FrameJitter {
    /// Of the logarithm of the factor on all lengths.
    pub scale: f32,
    /// Of each coordinate of the center (the object's sphere has radius 0.5).
    pub center: f32,
}

/// Changes that turn an object into an equally likely one: see [`Symmetry`](crate::symmetry::Symmetry).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Symmetries {
    /// Quarter turns about the upright axis, and mirrors that contain it: eight objects of one.
    pub space: bool,
    /// Permutations of red, green and blue: six objects of one.
    pub color: bool,
}

impl Default for LossConfig {
    fn default() -> Self {
        Self {
            flow: true,
            seen: true,
            held: true,
            held_views: 4,
            render_size: 512,
            gradient_size: 512,
            min_remaining: freerange_diffusion::path::MIN_REMAINING,
            unconditional: 0.1,
            coupling: Coupling::Independent,
            random_patches: false,
            input_views: (4, 4),
            refinement: None,
            self_conditioning: 0.0,
            estimates: 1,
            gradient_at: GradientAt::Noisy,
            one_sided: 0.0,
            frame_jitter: FrameJitter::default(),
            symmetries: Symmetries::default(),
        }
    }
}

/// AdamW and its schedule.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OptimizerConfig {
    /// Highest learning rate, reached after the warm-up.
    pub learning_rate: f64,
    /// Learning rate at the end.
    pub final_learning_rate: f64,
    /// Shape of the decrease.
    pub schedule: RateSchedule,
    /// Steps of linear warm-up.
    pub warmup: u64,
    /// Decoupled weight decay.
    pub weight_decay: f32,
    /// Parameters with weight decay.
    pub decay: Decay,
    /// First and second moment decay.
    pub betas: (f32, f32),
    /// Largest joint norm of the gradients.
    pub clip: f32,
    /// Decay of the moving average of the weights (reached gradually over the first steps).
    pub ema: f32,
    /// Precision of the blocks: `f32`, `bf16`, or `auto` for the faster on this device. Weights and sums stay in 32 bits.
    pub compute: Compute,
    /// All-reduce dtype of gradients: `f32`, or `bf16` for half of the bytes.
    pub wire: Wire,
    /// Gradient checkpointing: keep only the input of each block and compute it again for the gradient. A fraction of the memory
    /// for a third more work.
    pub recompute: bool,
}

impl Default for OptimizerConfig {
    fn default() -> Self {
        Self {
            learning_rate: 1e-4,
            final_learning_rate: 5e-6,
            schedule: RateSchedule::Cosine,
            warmup: 2000,
            weight_decay: 0.01,
            decay: Decay::All,
            betas: (0.9, 0.95),
            clip: 1.0,
            ema: 0.9999,
            compute: Compute::F32,
            wire: Wire::F32,
            recompute: false,
        }
    }
}

/// Which parameters decay.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Decay {
    /// All.
    #[default]
    All,
    /// Those of two axes or more: neither biases nor factors of norms.
    Matrices,
}

/// How the learning rate falls after the warm-up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RateSchedule {
    /// Along half a cosine over the whole run.
    #[default]
    Cosine,
    /// Constant until the last `decay` steps, then linear. A run can be made longer at any time before.
    Constant {
        /// Steps of the decrease; 0: none.
        decay: u64,
    },
}

impl OptimizerConfig {
    /// Refuses what no step could be taken with.
    fn validate(&self) -> Result<(), Invalid> {
        let (high, low) = (self.learning_rate, self.final_learning_rate);
        check(high.is_finite() && high > 0.0, "optimizer.learning_rate", "a finite number above 0", high)?;
        check(low.is_finite() && low >= 0.0, "optimizer.final_learning_rate", "a finite number, 0 or more", low)?;
        let decay = self.weight_decay;
        check(decay.is_finite() && decay >= 0.0, "optimizer.weight_decay", "a finite number, 0 or more", decay)?;
        let below_one = |beta: f32| (0.0..1.0).contains(&beta);
        let (first, second) = self.betas;
        check(below_one(first) && below_one(second), "optimizer.betas", "two numbers, 0 to below 1", self.betas)?;
        check(below_one(self.ema), "optimizer.ema", "0 to below 1", self.ema)?;
        check(self.clip > 0.0, "optimizer.clip", "above 0", self.clip)?;
        // Nothing scales the loss here, and without that the gradients of many weights round to zero.
        check(self.compute != Compute::F16, "optimizer.compute", "\"f32\" or \"bf16\"", "f16")
    }

    /// The learning rate of step `step` of `total`: linear warm-up, then the schedule.
    pub fn rate(&self, step: u64, total: u64) -> f64 {
        if step < self.warmup {
            return self.learning_rate * (step + 1) as f64 / self.warmup as f64;
        }
        let left = match self.schedule {
            RateSchedule::Cosine => {
                let progress = (step - self.warmup) as f64 / (total.saturating_sub(self.warmup)).max(1) as f64;
                0.5 * (1.0 + (std::f64::consts::PI * progress.min(1.0)).cos())
            }
            RateSchedule::Constant { decay } => (total.saturating_sub(step) as f64 / decay.max(1) as f64).min(1.0),
        };
        self.final_learning_rate + (self.learning_rate - self.final_learning_rate) * left
    }
}

/// One stage of the curriculum: a depth of the tree, an image size, a number of steps.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// Depth of the level-of-detail tree: 2^depth Gaussians.
    pub depth: u32,
    /// Side, in pixels, of the images that the network sees.
    pub image_size: u32,
    /// Objects per step.
    pub batch: usize,
    /// Objects computed at a time; gradients are averaged over a step's. Left out: all at once.
    #[serde(default)]
    pub micro_batch: Option<usize>,
    /// Side, in pixels, of the images that the rendering losses compare; left out: `loss.render_size`.
    #[serde(default)]
    pub render_size: Option<u32>,
    /// Side, in pixels, of the images that the network's gradient channels are taken on; left out: `loss.gradient_size`.
    #[serde(default)]
    pub gradient_size: Option<u32>,
    /// Steps.
    pub steps: u64,
}

impl Stage {
    /// Objects that are computed at a time, at most.
    pub fn at_a_time(&self) -> usize {
        self.micro_batch.unwrap_or(self.batch)
    }

    /// How many times a step computes for each of `lanes` lanes, which divide the batch.
    pub fn parts_per_lane(&self, lanes: usize) -> usize {
        (self.batch / lanes).div_ceil(self.at_a_time())
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
        let DataConfig { shards, allow_incomplete, window, fresh, workers, lanes, statistics_objects, making } = data;
        let data =
            DataConfig { shards, allow_incomplete, window, fresh, workers, lanes, statistics_objects, making: () };
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

    /// Refuses impossible values.
    pub fn validate(&self) -> Result<(), TrainError> {
        let check = |ok: bool, field: &str, expected: &str, found: String| match ok {
            true => Ok(()),
            false => Err(Invalid::new(field, expected, found)),
        };
        self.model.validate()?;
        self.sample.validate().map_err(|e| e.within("sample"))?;
        let refiner = self.refiner.as_ref().map_or(Ok(()), RefinerConfig::validate);
        refiner.map_err(|e| e.within("refiner"))?;
        check(!self.stages.is_empty(), "stage", "at least one [[stage]]", "none".into())?;
        self.data.making.check(self.seed, &self.depths())?;
        for s in &self.stages {
            check((1..=20).contains(&s.depth), "stage.depth", "1 to 20", s.depth.to_string())?;
            check(s.batch > 0, "stage.batch", "at least 1", s.batch.to_string())?;
            check(
                (1..=s.batch).contains(&s.at_a_time()),
                "stage.micro_batch",
                &format!("1 to {} (stage.batch)", s.batch),
                s.at_a_time().to_string(),
            )?;
            for (field, size) in [("stage.render_size", s.render_size), ("stage.gradient_size", s.gradient_size)] {
                check(size.is_none_or(|s| (8..=4096).contains(&s)), field, "8 to 4096", format!("{size:?}"))?;
            }
            check(s.steps > 0, "stage.steps", "at least 1", s.steps.to_string())?;
            check((8..=2048).contains(&s.image_size), "stage.image_size", "8 to 2048", s.image_size.to_string())?;
            let patch = self.model.encoder.patch_size();
            check(
                s.image_size.is_multiple_of(patch),
                "stage.image_size",
                &format!("a multiple of the encoder's patch, {patch}"),
                s.image_size.to_string(),
            )?;
        }
        let v = &self.validation;
        check((1..=10_000).contains(&v.objects), "validation.objects", "1 to 10000", v.objects.to_string())?;
        let l = &self.loss;
        let (low, high) = l.input_views;
        let views = self.data.making.views();
        check(low >= 1 && low <= high, "loss.input_views", "[fewest, most], at least 1", format!("[{low}, {high}]"))?;
        check(
            views >= high + l.held_views,
            "data.object.views",
            &format!("at least {} (loss.input_views + loss.held_views)", high + l.held_views),
            views.to_string(),
        )?;
        check(l.flow || l.seen || l.held, "loss", "at least one term", "none".into())?;
        check(
            !(l.random_patches && l.coupling == Coupling::Tree),
            "loss.random_patches",
            "false with coupling = \"tree\", which needs the tree's order",
            "true".into(),
        )?;
        check((0.0..=1.0).contains(&l.unconditional), "loss.unconditional", "0 to 1", l.unconditional.to_string())?;
        check((0.0..=1.0).contains(&l.one_sided), "loss.one_sided", "0 to 1", l.one_sided.to_string())?;
        check(
            (0.0..=1.0).contains(&l.self_conditioning),
            "loss.self_conditioning",
            "0 to 1",
            l.self_conditioning.to_string(),
        )?;
        check(
            l.self_conditioning == 0.0 || self.model.estimate_channels,
            "loss.self_conditioning",
            "0 without model.estimate_channels",
            l.self_conditioning.to_string(),
        )?;
        check((1..=16).contains(&l.estimates), "loss.estimates", "1 to 16", l.estimates.to_string())?;
        if let Some(RefinementLoss { share, render_weight }) = l.refinement {
            check((0.0..=1.0).contains(&share), "loss.refinement.share", "0 to 1", share.to_string())?;
            check(
                render_weight.is_finite() && render_weight >= 0.0,
                "loss.refinement.render_weight",
                "a finite number, 0 or more",
                render_weight.to_string(),
            )?;
            check(
                !l.random_patches,
                "loss.random_patches",
                "false with loss.refinement, whose fits are in the tree's order",
                "true".into(),
            )?;
            let made = self.data.shards.is_some() || self.data.making.input_fits() > 0;
            check(made, "data.object.input_fits", "at least 1 with loss.refinement", "0".into())?;
        }
        for (field, value) in
            [("loss.frame_jitter.scale", l.frame_jitter.scale), ("loss.frame_jitter.center", l.frame_jitter.center)]
        {
            check((0.0..=0.2).contains(&value), field, "0 to 0.2", value.to_string())?;
        }
        check(
            (0.0..1.0).contains(&l.min_remaining),
            "loss.min_remaining",
            "0 to below 1",
            l.min_remaining.to_string(),
        )?;
        for (field, size) in [("loss.render_size", l.render_size), ("loss.gradient_size", l.gradient_size)] {
            check((8..=2048).contains(&size), field, "8 to 2048", size.to_string())?;
        }
        self.validate_kind()?;
        self.optimizer.validate()?;
        let lanes = self.data.lanes;
        check((1..=4096).contains(&lanes), "data.lanes", "1 to 4096", lanes.to_string())?;
        let of_lanes = format!("a multiple of data.lanes, {lanes}");
        for (field, value) in [("data.window", self.data.window), ("data.fresh", self.data.fresh)] {
            check(value.is_multiple_of(lanes), field, &of_lanes, value.to_string())?;
        }
        for s in &self.stages {
            check(s.batch.is_multiple_of(lanes), "stage.batch", &of_lanes, s.batch.to_string())?;
        }
        check(self.data.window > 0, "data.window", "at least 1", self.data.window.to_string())?;
        check(self.data.workers > 0, "data.workers", "at least 1", self.data.workers.to_string())?;
        check(self.data.statistics_objects > 0, "data.statistics_objects", "at least 1", "0".into())?;
        let p = self.model.gaussians_per_token;
        for s in &self.stages {
            check((1usize << s.depth) >= p, "stage.depth", "at least one token", s.depth.to_string())?;
        }
        let refined = self.refiner.as_ref().and_then(|r| r.lod_depth);
        for (field, depth) in [("sample.lod_depth", self.sample.lod_depth), ("refiner.lod_depth", refined)] {
            if let Some(depth) = depth {
                check((1usize << depth) >= p, field, "at least one token", depth.to_string())?;
            }
        }
        Ok(())
    }

    /// Refuses losses and sampling that a model of this kind does not have.
    fn validate_kind(&self) -> Result<(), TrainError> {
        let (kind, l) = (self.model.kind, &self.loss);
        self.sample.validate_for(kind).map_err(|e| e.within("sample"))?;
        if !kind.one_pass() {
            return Ok(());
        }
        let check = |ok: bool, field: &str, expected: &str, found: String| match ok {
            true => Ok(()),
            false => {
                let expected = format!("{expected} for a {} model, which predicts in one pass", kind.name());
                Err(TrainError::from(Invalid::new(field, expected, found)))
            }
        };
        check(!l.flow, "loss.flow", "false", "true".into())?;
        check(l.seen || (l.held && l.held_views > 0), "loss", "a rendering loss", "none".into())?;
        check(l.unconditional == 0.0, "loss.unconditional", "0", l.unconditional.to_string())?;
        check(!l.random_patches, "loss.random_patches", "false", "true".into())?;
        check(l.coupling == Coupling::Independent, "loss.coupling", "independent", "tree".into())?;
        check(l.refinement.is_none(), "loss.refinement", "none", "one".into())?;
        check(self.refiner.is_none(), "refiner", "none", "one".into())?;
        if kind == ModelKind::LatentTokens {
            let most = self.model.gaussians(0, 0);
            for s in &self.stages {
                let expected = format!("the depth of {most} Gaussians (model.latent_tokens)");
                check(1usize << s.depth == most, "stage.depth", &expected, s.depth.to_string())?;
            }
        }
        Ok(())
    }
}
