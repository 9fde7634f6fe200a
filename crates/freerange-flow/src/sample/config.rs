//! How to sample: what a configuration and the options of the command line say.

use freerange_core::Invalid;
use freerange_fit::QuickFitConfig;
use freerange_model::{Compute, ModelKind};

use super::{Background, sampler::PhotometricStep, solver::Solver};
use crate::{FlowError, coupling::Coupling};

/// Number of the meaning of settings in records: of [`SampleConfig`], of fits and of refinement. Raise it whenever the same
/// recorded settings come to mean another computation, or a default changes: results of different numbers are never mixed.
pub const SETTINGS_SCHEMA: u32 = 1;

/// Far above what has been measured (three), so that nobody waits for hours by a slip.
const MOST_DETAIL: usize = 16;

/// How to sample. Records hold every field, whatever its default is.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SampleConfig {
    /// Steps from noise to data.
    pub steps: usize,
    /// How they are taken.
    pub solver: Solver,
    /// Steps of [`Solver::Hold`] after which the estimate's Gaussians are put in the order of a tree of their own, with its
    /// names of their axes, as those of a fit are: they have moved since. 0: never. On a GPU this waits for the steps before.
    pub regroup: usize,
    /// Make `2^depth` Gaussians; left out: as many as at the depth the model was trained at. Tokens carry no position,
    /// so that any number can be drawn, but sizes are those of the trained depth.
    pub depth: Option<u32>,
    /// Start from a quick fit of the input views instead of pure noise.
    pub start: Option<StartConfig>,
    /// Classifier-free guidance scale s: `z_u + s (z_c - z_u)`. 1 switches it off (and halves the work). Only 1 goes with
    /// `start`: a fit is made of the images, and no model is trained to do without them from there.
    #[serde(alias = "guidance")]
    pub cfg_scale: f32,
    /// Photometric guidance scale lambda_PG. 0 switches it off. What it multiplies is told by `photometric_step`. It acts
    /// on what the next step starts from, and on the result where there is one step only.
    #[serde(alias = "photometric")]
    pub lambda_pg: f32,
    /// The gradient that photometric guidance follows.
    pub photometric_step: PhotometricStep,
    /// Photometric steps per step of the solver, each at the estimate that the one before has moved. The paper takes one.
    pub photometric_repeats: usize,
    /// Side, in pixels, of the renders that photometric guidance compares with the images; left out: `gradient_size`.
    pub photometric_size: Option<u32>,
    /// Where the gradient that the network sees as input is taken.
    pub gradient_at: GradientAt,
    /// Side, in pixels, of the renders that the gradient for the network is taken on: as in training.
    pub gradient_size: u32,
    /// Colour behind the object in those renders.
    pub background: Background,
    /// How the starting noise is grouped into tokens: as in training.
    pub coupling: Coupling,
    /// Arithmetic of the transformer's blocks.
    pub compute: Compute,
    /// Most that photos may [doubt](freerange_fit::FoundMirror::doubt) the object's plane of symmetry for photos mirrored about it
    /// to be further input views of everything that follows. 0: none are looked for.
    /// [`reconstruct`](super::reconstruct) itself takes what it is given.
    pub mirror: f32,
    /// Most that photos may [contradict](freerange_fit::FoundAxis::contradiction) an axis about which the object keeps its outlines for turned
    /// outlines to be more of what every fit agrees with. 0: none is looked for. [`reconstruct`](super::reconstruct) itself knows of none.
    pub turn: f32,
    /// Steps of 3DGS-MCMC on up to four input views that follow ([`freerange_fit::refine`]), of more views more
    /// ([`for_photos`](freerange_fit::RefineConfig::for_photos)); [`reconstruct`](super::reconstruct) itself takes none.
    pub refine: usize,
    /// How fine the detail is that refinement looks for: so many times 256 pixels and 8,192 Gaussians, and less of a hold, as far as
    /// photos have these pixels ([`detailed`](freerange_fit::RefineConfig::detailed)).
    pub detail: usize,
    /// How many samples refinement begins with and is held at the mean pictures of, each from a fit and noise of its own.
    /// [`reconstruct`](super::reconstruct) itself draws what it is asked for.
    pub ensemble: usize,
    /// Steps of a [fit](freerange_fit::polish) of the input views, at the size that quick fits have, that follow a sample from pure noise before it is
    /// [mended](Self::mend). [`reconstruct`](super::reconstruct) itself takes none.
    pub polish: usize,
    /// Steps of [`Solver::Hold`] that follow a sample from pure noise, with it in the place of a fit.
    /// [`reconstruct`](super::reconstruct) itself takes none.
    pub mend: usize,
    /// What is different where a model that starts from fits by itself is asked to start from pure noise; left out: nothing.
    pub from_noise: Option<FromNoise>,
}

/// How a model samples from pure noise that by itself starts from fits.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FromNoise {
    /// [`SampleConfig::steps`]
    pub steps: usize,
    /// [`SampleConfig::solver`]
    pub solver: Solver,
    /// [`SampleConfig::lambda_pg`]
    #[serde(alias = "photometric")]
    pub lambda_pg: f32,
    /// [`SampleConfig::polish`]; left out: 800, which on generated objects gain 1.1 dB and more (docs/experiments.md).
    #[serde(default = "FromNoise::polish")]
    pub polish: usize,
    /// [`SampleConfig::mend`]
    #[serde(default)]
    pub mend: usize,
    /// [`SampleConfig::background`]; left out: random colours. Fifty guided steps in front of white alone lose
    /// 2.5 dB (docs/experiments.md).
    #[serde(default)]
    pub background: Background,
}

impl FromNoise {
    fn polish() -> usize {
        800
    }
}

impl Default for SampleConfig {
    fn default() -> Self {
        Self {
            steps: 50,
            solver: Solver::Euler,
            regroup: 0,
            depth: None,
            start: None,
            cfg_scale: 2.0,
            lambda_pg: 50.0,
            photometric_step: PhotometricStep::Gradient,
            photometric_repeats: 1,
            photometric_size: None,
            gradient_at: GradientAt::Noisy,
            gradient_size: 512,
            background: Background::Random,
            coupling: Coupling::Independent,
            compute: Compute::F32,
            mirror: 0.0,
            turn: 0.0,
            refine: 0,
            detail: 2,
            ensemble: 1,
            polish: 0,
            mend: 0,
            from_noise: None,
        }
    }
}

impl SampleConfig {
    /// The same from pure noise: see [`from_noise`](Self::from_noise).
    pub fn without_start(mut self) -> Self {
        if let (Some(_), Some(noise)) = (self.start.take(), self.from_noise) {
            let FromNoise { steps, solver, lambda_pg, polish, mend, background } = noise;
            self = Self { steps, solver, lambda_pg, polish, mend, background, ..self };
        }
        self
    }

    /// How many steps samples from pure noise are [polished](Self::polish); 0 for what starts from a fit.
    pub fn polishing(&self) -> usize {
        if self.start.is_none() { self.polish } else { 0 }
    }

    /// How samples from pure noise are mended: see [`mend`](Self::mend); none if they are not.
    pub fn mending(&self) -> Option<Self> {
        let start = StartConfig { time: 0.0, noise: 0.0, ..StartConfig::default() };
        let (solver, start) = (Solver::Hold, Some(start));
        let held = Self { steps: self.mend, solver, start, cfg_scale: 1.0, lambda_pg: 0.0, ..self.clone() };
        (self.mend > 0 && self.start.is_none()).then_some(held)
    }

    /// Depth of the level-of-detail tree whose slice is made, by a model that was trained at depth `trained`: `2^depth` Gaussians.
    pub fn depth_of(&self, trained: u32) -> u32 {
        self.depth.unwrap_or(trained)
    }

    /// Refuses settings that mean nothing to a model of this kind: one that predicts in one pass has no noise to begin
    /// with, no steps and no guidance.
    ///
    /// # Errors
    /// Names the setting.
    pub fn validate_for(&self, kind: ModelKind) -> Result<(), FlowError> {
        if !kind.one_pass() {
            return Ok(());
        }
        let check = |ok: bool, field: &str, expected: &str, found: String| match ok {
            true => Ok(()),
            false => {
                let expected = format!("{expected} for a {} model, which predicts in one pass", kind.name());
                Err(FlowError::from(Invalid::new(format!("sample.{field}"), expected, found)))
            }
        };
        check(self.steps == 1, "steps", "1", self.steps.to_string())?;
        check(self.solver == Solver::Euler, "solver", "none (euler)", format!("{:?}", self.solver).to_lowercase())?;
        check(self.cfg_scale == 1.0, "cfg_scale", "1", self.cfg_scale.to_string())?;
        check(self.lambda_pg == 0.0, "lambda_pg", "0", self.lambda_pg.to_string())?;
        check(self.start.is_none(), "start", "none", "one".into())?;
        check(self.depth.is_none(), "depth", "none", format!("{:?}", self.depth))?;
        check(self.polish == 0, "polish", "0", self.polish.to_string())?;
        check(self.mend == 0, "mend", "0", self.mend.to_string())?;
        check(self.regroup == 0, "regroup", "0", self.regroup.to_string())?;
        check(self.ensemble == 1, "ensemble", "1", self.ensemble.to_string())
    }

    /// Refuses impossible values.
    pub fn validate(&self) -> Result<(), FlowError> {
        let bad = |field: &str, expected: &str, found: String| {
            Err(Invalid::new(format!("sample.{field}"), expected, found).into())
        };
        if !(1..=10_000).contains(&self.steps) {
            return bad("steps", "1 to 10000", self.steps.to_string());
        }
        if self.depth.is_some_and(|d| !(1..=20).contains(&d)) {
            return bad("depth", "1 to 20", format!("{:?}", self.depth));
        }
        if self.polish > 100_000 {
            return bad("polish", "0 to 100000", self.polish.to_string());
        }
        if self.mend > 10_000 {
            return bad("mend", "0 to 10000", self.mend.to_string());
        }
        for (field, most) in [("mirror", self.mirror), ("turn", self.turn)] {
            if !(0.0..=100.0).contains(&most) {
                return bad(field, "0 to 100", most.to_string());
            }
        }
        if self.refine > 100_000 {
            return bad("refine", "0 to 100000", self.refine.to_string());
        }
        if !(1..=MOST_DETAIL).contains(&self.detail) {
            return bad("detail", &format!("1 to {MOST_DETAIL}"), self.detail.to_string());
        }
        if !(1..=64).contains(&self.ensemble) {
            return bad("ensemble", "1 to 64", self.ensemble.to_string());
        }
        if self.solver == Solver::Hold && self.start.is_none() {
            return bad("solver", "euler, heun or multistep without sample.start", "hold".into());
        }
        if let Some(start) = &self.start {
            if !(0.0..1.0).contains(&start.time) {
                return bad("start.time", "0 to below 1", start.time.to_string());
            }
            if !(0.0..=2.0).contains(&start.noise) {
                return bad("start.noise", "0 to 2", start.noise.to_string());
            }
            start.fit.check().map_err(|e| Invalid::new("sample.start.fit", "settings of a quick fit", e))?;
        }
        if !self.cfg_scale.is_finite() || self.cfg_scale < 0.0 {
            return bad("cfg_scale", "a finite number, 0 or more", self.cfg_scale.to_string());
        }
        if self.cfg_scale != 1.0 && self.start.is_some() {
            return bad(
                "cfg_scale",
                "1 with sample.start (other scales go with a start from noise)",
                self.cfg_scale.to_string(),
            );
        }
        if !self.lambda_pg.is_finite() || self.lambda_pg < 0.0 {
            return bad("lambda_pg", "a finite number, 0 or more", self.lambda_pg.to_string());
        }
        if !(1..=1000).contains(&self.photometric_repeats) {
            return bad("photometric_repeats", "1 to 1000", self.photometric_repeats.to_string());
        }
        for (field, size) in [("gradient_size", Some(self.gradient_size)), ("photometric_size", self.photometric_size)]
        {
            if let Some(size) = size.filter(|s| !(8..=4096).contains(s)) {
                return bad(field, "8 to 4096 pixels", size.to_string());
            }
        }
        Ok(())
    }
}

/// A start from a quick fit of the input views.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StartConfig {
    /// The time to which the fit is mixed with noise, and from which the flow is integrated; 0: noise alone, in the order of
    /// the fit.
    pub time: f32,
    /// Factor on the noise.
    pub noise: f32,
    /// How the fit is made: as in training.
    pub fit: QuickFitConfig,
}

impl Default for StartConfig {
    fn default() -> Self {
        Self { time: 0.3, noise: 1.0, fit: QuickFitConfig::default() }
    }
}

/// Where the photometric gradient that is fed to the network is taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GradientAt {
    /// At the noisy sample itself, rendered as Gaussians.
    #[default]
    Noisy,
    /// At the estimate of the clean sample: the network's in the previous step, at first the quick fit that sampling starts
    /// from; at the noisy sample where there is none.
    Estimate,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A record of [`SETTINGS_SCHEMA`] 1 that lacks a field means these. A default that changes needs another number, and
    /// its old value where records of this one are read (`freerange::sampling`).
    #[test]
    fn defaults_are_those_of_their_schema() {
        assert_eq!(SETTINGS_SCHEMA, 1);
        let found = serde_json::to_value(SampleConfig::default()).unwrap();
        let defaults = serde_json::json!({
            "steps": 50, "solver": "euler", "regroup": 0, "depth": null, "start": null, "cfg_scale": 2.0, "lambda_pg": 50.0,
            "photometric_step": "gradient", "photometric_repeats": 1, "photometric_size": null, "gradient_at": "noisy",
            "gradient_size": 512, "background": "random", "coupling": "independent", "compute": "f32", "mirror": 0.0,
            "turn": 0.0, "refine": 0, "detail": 2, "ensemble": 1, "polish": 0, "mend": 0, "from_noise": null
        });
        for (name, default) in defaults.as_object().unwrap() {
            assert_eq!(&found[name], default, "{name}");
        }
    }

    #[test]
    fn old_names_are_read_and_new_ones_written() {
        let old = serde_json::json!({ "guidance": 1.5, "photometric": 0.25, "from_noise":
            { "steps": 3, "solver": "euler", "photometric": 0.5 } });
        let found: SampleConfig = serde_json::from_value(old).unwrap();
        assert_eq!((found.cfg_scale, found.lambda_pg, found.from_noise.unwrap().lambda_pg), (1.5, 0.25, 0.5));
        let new = serde_json::to_value(&found).unwrap();
        assert_eq!((&new["cfg_scale"], &new["lambda_pg"]), (&1.5.into(), &0.25.into()));
        assert!(new.get("guidance").is_none() && new.get("photometric").is_none());
        assert_eq!(serde_json::from_value::<SampleConfig>(new).unwrap(), found);
    }

    #[test]
    fn a_model_of_fits_starts_from_noise_in_its_own_way() {
        let background = Background::Random;
        let noise = FromNoise { steps: 30, solver: Solver::Multistep, lambda_pg: 0.2, polish: 7, mend: 3, background };
        let fit = SampleConfig {
            background: Background::White,
            steps: 4,
            solver: Solver::Hold,
            start: Some(StartConfig::default()),
            cfg_scale: 1.0,
            lambda_pg: 0.0,
            from_noise: Some(noise),
            ..SampleConfig::default()
        };
        fit.validate().unwrap();
        // Guidance goes with noise only.
        let guided = SampleConfig { cfg_scale: 1.5, ..fit.clone() };
        let message = guided.validate().unwrap_err().to_string();
        assert!(message.contains("sample.cfg_scale: expected 1") && message.contains("sample.start"), "{message}");
        let guided = guided.without_start();
        guided.validate().unwrap();
        assert_eq!((guided.cfg_scale, guided.mending().unwrap().cfg_scale), (1.5, 1.0));
        guided.mending().unwrap().validate().unwrap();
        let found = fit.clone().without_start();
        found.validate().unwrap();
        assert_eq!((found.steps, found.solver, found.lambda_pg, found.polish), (30, Solver::Multistep, 0.2, 7));
        assert!(found.start.is_none() && found.background == Background::Random);
        // What comes of it takes the place of a fit; what starts from a fit has no need.
        let mending = found.mending().unwrap();
        mending.validate().unwrap();
        assert_eq!((mending.steps, mending.solver, mending.lambda_pg), (3, Solver::Hold, 0.0));
        assert!(mending.start.is_some_and(|start| start.time == 0.0 && start.noise == 0.0));
        assert!(fit.mending().is_none());
        assert_eq!(found.clone().without_start(), found);
        let held = SampleConfig { from_noise: None, ..fit }.without_start();
        let message = held.validate().unwrap_err().to_string();
        assert!(message.contains("sample.solver") && message.contains("hold"), "{message}");
    }
}
