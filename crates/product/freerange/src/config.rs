//! What a reconstruction should do: [`PipelineConfig`] with its presets, and [`Options`] of one run.

use freerange_diffusion::{
    sample::{FlowConfig, RefinerConfig},
    settings::Settings,
};
use freerange_gaussians::Gaussians;
use freerange_model::{Checkpoint, Compute};
use freerange_optim::InitialFitConfig;
use freerange_scene::camera::FrameConfig;
use freerange_util::ensure;
use serde::{Deserialize, Serialize};

use crate::{
    Error,
    error::{Beneath, Lift},
};

/// Settings of the five steps of the [pipeline](crate::pipeline). Records hold every field, with
/// [`SETTINGS_SCHEMA`](crate::SETTINGS_SCHEMA). [`Reconstructor::options`](crate::Reconstructor::options) makes one for a model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PipelineConfig {
    /// Most photos that the network sees, chosen from all around the object. The optimization sees all.
    pub network_views: usize,
    /// What is assumed of the object's symmetry.
    pub symmetry: SymmetryConfig,
    /// Sets of Gaussians to begin with.
    pub propose: ProposeConfig,
    /// Network refinement of each proposal; none for a model that was not trained to.
    pub refine: Option<RefinerConfig>,
    /// Optimization on the photos.
    pub optimize: OptimizeConfig,
}

/// Whether symmetries are looked for, and how well photos have to agree with one. They are looked for with up to four
/// photos.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SymmetryConfig {
    /// `auto` looks for a mirror plane and for an axis of revolution, `off` does not.
    pub detect: Detect,
    /// [Residual](freerange_optim::FoundMirror::doubt) of a mirror plane at which mirrored photos, which are added to the
    /// targets, have half of their weight: all of it up to 0.1 less, none from 0.1 more. 0: none are added.
    pub reflection_threshold: f64,
    /// [Residual](freerange_optim::FoundAxis::contradiction) of an axis at which rotated silhouettes have half of their
    /// weight: all of it up to 0.05 less, none from 0.05 more. 0: none are added.
    pub revolution_threshold: f64,
}

/// Whether something is looked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Detect {
    /// Where there is reason to.
    #[default]
    Auto,
    /// Never.
    Off,
}

/// Where Gaussians come from at first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Init {
    /// Short fits of the photos.
    #[default]
    Fit,
    /// Samples of the learned flow, from noise: the paper's method.
    Flow,
}

/// Sets of Gaussians to begin with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProposeConfig {
    /// Where they come from.
    pub init: Init,
    /// How many. The optimization begins with several together and is anchored to their mean renders where no photo looks.
    pub count: usize,
    /// Initial fits: of the proposals, and of the object's place in the canonical frame.
    pub fit: InitialFitConfig,
    /// Sampling from noise.
    pub flow: FlowConfig,
}

/// Optimization of Gaussians on the photos (3DGS-MCMC). Values are for four photos of at least `max_resolution` pixels:
/// more photos get more iterations each, up to sixteen; smaller ones fewer Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimizeConfig {
    /// Steps. 0: the network's Gaussians are the result.
    pub iterations: usize,
    /// Longest side, in pixels, at which photos are compared: a multiple of 256.
    pub max_resolution: u32,
}

/// Presets of quality and time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Quality {
    /// A look at the object: one proposal, no symmetry, a short optimization at 256 pixels.
    Draft,
    /// What results are reported for.
    #[default]
    Default,
    /// Twice the optimization steps.
    High,
}

/// Pixels, and Gaussians, of one unit of the optimization's detail.
const UNIT: u32 = 256;
const UNIT_GAUSSIANS: usize = 8192;
/// Far above what has been measured, so that nobody waits for hours by a slip.
const MOST_RESOLUTION: u32 = 16 * UNIT;

impl OptimizeConfig {
    /// Times 256 pixels.
    pub(crate) fn detail(&self) -> usize {
        (self.max_resolution / UNIT) as usize
    }

    /// Gaussians that it ends with at most: above 256 pixels a half and more lie in one layer where photos look.
    pub fn max_gaussians(&self) -> usize {
        match self.detail() {
            0 | 1 => UNIT_GAUSSIANS,
            detail => 2 * detail * UNIT_GAUSSIANS,
        }
    }
}

impl PipelineConfig {
    /// A preset for a model: of one that refines initial fits the whole pipeline, of any other what the network makes by
    /// itself, without symmetry and optimization.
    ///
    /// # Errors
    /// If what the checkpoint says of its use cannot be read.
    pub(crate) fn preset(checkpoint: &Checkpoint, quality: Quality) -> Result<Self, Error> {
        let Settings { network_views, sample, refiner } = Settings::of(&checkpoint.provenance).lift()?;
        let depth = refiner.as_ref().and_then(|r| r.lod_depth).unwrap_or(checkpoint.depth);
        let fit = InitialFitConfig { gaussians: 1 << depth.min(16), ..InitialFitConfig::default() };
        let whole = refiner.is_some();
        let (count, iterations, max_resolution) = match quality {
            _ if !whole => (1, 0, 2 * UNIT),
            Quality::Draft => (1, 150, UNIT),
            Quality::Default => (4, 400, 2 * UNIT),
            Quality::High => (4, 800, 2 * UNIT),
        };
        let detect = if whole && quality != Quality::Draft { Detect::Auto } else { Detect::Off };
        let init = if whole { Init::Fit } else { Init::Flow };
        Ok(Self {
            network_views,
            symmetry: SymmetryConfig { detect, reflection_threshold: 1.1, revolution_threshold: 0.85 },
            propose: ProposeConfig { init, count, fit, flow: sample },
            refine: refiner,
            optimize: OptimizeConfig { iterations, max_resolution },
        })
    }

    /// Sets one field by its path, as `--set` does: `optimize.iterations` to `800`.
    ///
    /// # Errors
    /// Names the fields that there are, or the field and what it expects.
    pub fn set(&mut self, key: &str, value: &str) -> Result<(), Error> {
        let mut json = serde_json::to_value(&*self).map_err(|e| Error::input(key, "a field", e))?;
        let pointer = format!("/{}", key.replace('.', "/"));
        let Some(field) = json.pointer_mut(&pointer).filter(|field| !field.is_object()) else {
            let mut known = Vec::new();
            leaves(&json, String::new(), &mut known);
            return Err(Error::input("--set", format!("one of {}", known.join(", ")), key));
        };
        *field = serde_json::from_str(value).unwrap_or_else(|_| value.into());
        *self = serde_json::from_value(json).map_err(|e| Error::input(format!("--set {key}"), e.to_string(), value))?;
        Ok(())
    }

    /// Refuses impossible values, and those without effect.
    ///
    /// # Errors
    /// Names the field.
    pub fn validate(&self) -> Result<(), Error> {
        let Self { network_views, symmetry, propose, refine, optimize } = self;
        let check = |ok: bool, field: &str, expected: &str, found: String| ensure(ok, field, expected, found).lift();
        check((1..=256).contains(network_views), "network_views", "1 to 256", network_views.to_string())?;
        for (field, value) in [
            ("symmetry.reflection_threshold", symmetry.reflection_threshold),
            ("symmetry.revolution_threshold", symmetry.revolution_threshold),
        ] {
            check((0.0..=100.0).contains(&value), field, "0 to 100", value.to_string())?;
        }
        let count = propose.count;
        check((1..=64).contains(&count), "propose.count", "1 to 64", count.to_string())?;
        let alone = count == 1 || optimize.iterations > 0;
        check(alone, "propose.count", "1 without optimization, which alone uses the others", count.to_string())?;
        propose.fit.check().lift()?;
        propose.flow.validate().map_err(|e| e.within("propose.flow").lift())?;
        refine.as_ref().map_or(Ok(()), RefinerConfig::validate).map_err(|e| e.within("refine").lift())?;
        let (iterations, size) = (optimize.iterations, optimize.max_resolution);
        check(iterations <= 100_000, "optimize.iterations", "0 to 100000", iterations.to_string())?;
        let allowed = size.is_multiple_of(UNIT) && (UNIT..=MOST_RESOLUTION).contains(&size);
        let expected = format!("a multiple of {UNIT}, up to {MOST_RESOLUTION}");
        check(allowed, "optimize.max_resolution", &expected, size.to_string())
    }
}

/// What a user chooses of a pipeline; everything else is the preset's. Program, page and Python fill this in, so that the same
/// choices mean the same everywhere.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Choices {
    /// The preset.
    pub quality: Quality,
    /// [`OptimizeConfig::iterations`]; with 0 there is one proposal, since nothing is made of others.
    pub iterations: Option<usize>,
    /// [`SymmetryConfig::detect`]
    pub symmetry: Option<Detect>,
    /// [`ProposeConfig::init`]
    pub init: Option<Init>,
    /// Precision of the network.
    pub precision: Option<Compute>,
    /// [`PipelineConfig::network_views`]
    pub network_views: Option<usize>,
    /// Further fields by their paths: see [`PipelineConfig::set`].
    pub set: Vec<(String, String)>,
}

impl Choices {
    /// The pipeline that is chosen, for a model.
    ///
    /// # Errors
    /// Names the choice that cannot be followed.
    pub(crate) fn pipeline(&self, checkpoint: &Checkpoint) -> Result<PipelineConfig, Error> {
        let mut pipeline = PipelineConfig::preset(checkpoint, self.quality)?;
        if self.quality != Quality::Default && pipeline.refine.is_none() {
            let expected = "default: a model that only samples has no presets";
            return Err(Error::input("quality", expected, format!("{:?}", self.quality).to_lowercase()));
        }
        if let Some(iterations) = self.iterations {
            pipeline.optimize.iterations = iterations;
            if iterations == 0 {
                pipeline.propose.count = 1;
            }
        }
        pipeline.symmetry.detect = self.symmetry.unwrap_or(pipeline.symmetry.detect);
        pipeline.propose.init = self.init.unwrap_or(pipeline.propose.init);
        pipeline.network_views = self.network_views.unwrap_or(pipeline.network_views);
        if let Some(precision) = self.precision {
            pipeline.propose.flow.compute = precision;
            if let Some(refine) = &mut pipeline.refine {
                refine.compute = precision;
            }
        }
        for (key, value) in &self.set {
            pipeline.set(key, value)?;
        }
        Ok(pipeline)
    }

    /// Refuses a field of [`set`](Self::set) that a run of `pipeline` would not look at. `given`: it begins with Gaussians of
    /// the user's.
    ///
    /// # Errors
    /// Names the field, and what would have to be otherwise.
    pub fn check_effect(&self, pipeline: &PipelineConfig, given: bool) -> Result<(), Error> {
        let PipelineConfig { symmetry, propose, optimize, .. } = pipeline;
        let made = !given;
        let unused = [
            ("propose.flow.", made && propose.init == Init::Flow, "propose.init: flow"),
            ("propose.init", made, "no Gaussians to begin with"),
            ("propose.count", made, "no Gaussians to begin with"),
            ("symmetry.reflection_threshold", symmetry.detect == Detect::Auto, "symmetry.detect: auto"),
            ("symmetry.revolution_threshold", symmetry.detect == Detect::Auto, "symmetry.detect: auto"),
            ("optimize.max_resolution", optimize.iterations > 0, "optimize.iterations: 1 or more"),
        ];
        for (key, value) in &self.set {
            for (field, used, with) in unused {
                let named = key == field || field.ends_with('.') && key.starts_with(field);
                if named && !used {
                    let expected = format!("nothing, since it has no effect here, or {with}");
                    return Err(Error::input(format!("--set {key}"), expected, value));
                }
            }
        }
        Ok(())
    }
}

/// Paths of all fields that hold no others.
fn leaves(value: &serde_json::Value, path: String, found: &mut Vec<String>) {
    match value.as_object() {
        None => found.push(path),
        Some(fields) => {
            for (name, value) in fields {
                let path = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
                leaves(value, path, found);
            }
        }
    }
}

/// What one run should do. [`Reconstructor::options`](crate::Reconstructor::options) gives the model's own.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Options {
    /// The settings of each step.
    pub pipeline: PipelineConfig,
    /// One sample per seed.
    pub seeds: Vec<u64>,
    /// Gaussians to begin with instead of [`ProposeConfig::init`], in the frame of the views.
    pub init: Option<Gaussians>,
    /// Which way is up in the views' frame, and where the object is, if that is known.
    pub frame: FrameConfig,
    /// Leave the network out: the control of comparisons.
    pub(crate) without_network: bool,
}
