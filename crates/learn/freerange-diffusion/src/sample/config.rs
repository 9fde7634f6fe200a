//! How a model is sampled from, and how it refines.

use freerange_model::{Compute, ModelKind};
use freerange_util::{Background, Invalid, ensure};

use crate::coupling::Coupling;

/// Number of the meaning of settings in records: of a pipeline, a sampler, fits and optimization. Raise it whenever the same
/// recorded settings come to mean another computation, or a default changes: results of different numbers are never mixed.
pub const SETTINGS_SCHEMA: u32 = 6;

/// Settings of a [`FlowSampler`](super::FlowSampler); the defaults are the paper's. Records hold every field.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FlowConfig {
    /// Euler steps from noise to data.
    pub steps: usize,
    /// Make `2^lod_depth` Gaussians; left out: as many as at the depth that the model was trained at. Tokens carry no
    /// position, so that any number can be drawn, but sizes are those of the trained depth.
    pub lod_depth: Option<u32>,
    /// Classifier-free guidance scale s: `z_u + s (z_c - z_u)`. 1 switches it off and halves the work.
    pub cfg_scale: f32,
    /// Photometric guidance scale lambda_PG, which multiplies the gradient of the rendering loss at the estimate. 0
    /// switches it off. It acts on what the next step starts from, and on the result where there is one step only.
    pub lambda_pg: f32,
    /// Where the gradient that the network sees is taken: as in training.
    pub gradient_at: GradientAt,
    /// Side, in pixels, of the renders that gradients are taken on: as in training.
    pub gradient_size: u32,
    /// Color behind the object in those renders.
    pub background: Background,
    /// How the starting noise is grouped into tokens: as in training.
    pub coupling: Coupling,
    /// Precision of the transformer's blocks.
    pub compute: Compute,
}

impl Default for FlowConfig {
    fn default() -> Self {
        Self {
            steps: 50,
            lod_depth: None,
            cfg_scale: 2.0,
            lambda_pg: 50.0,
            gradient_at: GradientAt::Noisy,
            gradient_size: 512,
            background: Background::Random,
            coupling: Coupling::Independent,
            compute: Compute::Auto,
        }
    }
}

/// Settings of a [`Refiner`](super::Refiner). Records hold every field.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RefinerConfig {
    /// Evaluations of the network, each of which sees the estimate of the one before.
    pub passes: usize,
    /// Passes after which the estimate's Gaussians are grouped into tokens again: they have moved, and tokens are neighbors
    /// in a level-of-detail tree. 0: never. On a GPU this waits for queued work.
    pub retokenize_every: usize,
    /// Make `2^lod_depth` Gaussians; left out: as many as at the depth that the model was trained at.
    pub lod_depth: Option<u32>,
    /// Side, in pixels, of the renders that gradients are taken on: as in training.
    pub gradient_size: u32,
    /// Precision of the transformer's blocks.
    pub compute: Compute,
}

impl Default for RefinerConfig {
    fn default() -> Self {
        Self { passes: 12, retokenize_every: 4, lod_depth: None, gradient_size: 128, compute: Compute::Auto }
    }
}

/// Where the photometric gradient that is fed to the network is taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GradientAt {
    /// At the noisy sample itself, rendered as Gaussians.
    #[default]
    Noisy,
    /// At the last estimate of the clean sample; at the noisy sample where there is none.
    Estimate,
}

fn depth(field: &str, depth: Option<u32>) -> Result<(), Invalid> {
    ensure(depth.is_none_or(|d| (1..=20).contains(&d)), field, "1 to 20", format!("{depth:?}"))
}

fn size(field: &str, size: u32) -> Result<(), Invalid> {
    ensure((8..=4096).contains(&size), field, "8 to 4096 pixels", size)
}

impl FlowConfig {
    /// Refuses impossible values.
    ///
    /// # Errors
    /// Names the setting.
    pub fn validate(&self) -> Result<(), Invalid> {
        ensure((1..=10_000).contains(&self.steps), "steps", "1 to 10000", self.steps)?;
        depth("lod_depth", self.lod_depth)?;
        for (field, value) in [("cfg_scale", self.cfg_scale), ("lambda_pg", self.lambda_pg)] {
            ensure(value.is_finite() && value >= 0.0, field, "a finite number, 0 or more", value)?;
        }
        size("gradient_size", self.gradient_size)
    }

    /// Refuses settings without effect on a model of this kind: one that predicts in one pass has no noise to begin with, no
    /// steps, no guidance and no gradients. `own` are the model's settings, which name a value for each all the same.
    ///
    /// # Errors
    /// Names the setting.
    pub fn validate_for(&self, kind: ModelKind, own: &Self) -> Result<(), Invalid> {
        if !kind.one_pass() {
            return Ok(());
        }
        let only = |ok: bool, field: &str, expected: &str, found: String| {
            let expected = format!("{expected} for a {} model, which predicts in one pass", kind.name());
            ensure(ok, field, &expected, found)
        };
        only(self.steps == 1, "steps", "1", self.steps.to_string())?;
        only(self.cfg_scale == 1.0, "cfg_scale", "1", self.cfg_scale.to_string())?;
        only(self.lambda_pg == 0.0, "lambda_pg", "0", self.lambda_pg.to_string())?;
        only(self.lod_depth.is_none(), "lod_depth", "none", format!("{:?}", self.lod_depth))?;
        let gradients = |c: &Self| {
            [
                ("gradient_at", format!("{:?}", c.gradient_at)),
                ("gradient_size", c.gradient_size.to_string()),
                ("background", format!("{:?}", c.background)),
                ("coupling", format!("{:?}", c.coupling)),
            ]
            .map(|(field, value)| (field, value.to_lowercase()))
        };
        for ((field, found), (_, expected)) in gradients(self).into_iter().zip(gradients(own)) {
            only(found == expected, field, &format!("the model's own, {expected},"), found)?;
        }
        Ok(())
    }
}

impl RefinerConfig {
    /// Refuses impossible values.
    ///
    /// # Errors
    /// Names the setting.
    pub fn validate(&self) -> Result<(), Invalid> {
        ensure((1..=1000).contains(&self.passes), "passes", "1 to 1000", self.passes)?;
        let every = self.retokenize_every;
        ensure(every <= 1000, "retokenize_every", "0 to 1000", every)?;
        depth("lod_depth", self.lod_depth)?;
        size("gradient_size", self.gradient_size)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A record that lacks a field means these. A default that changes needs another schema number, and its old value
    /// where records of this one are read ([`Settings`](crate::settings::Settings)).
    #[test]
    fn defaults_are_those_of_their_schema() {
        assert_eq!(SETTINGS_SCHEMA, 6);
        let flow = serde_json::json!({
            "steps": 50, "lod_depth": null, "cfg_scale": 2.0, "lambda_pg": 50.0, "gradient_at": "noisy",
            "gradient_size": 512, "background": "random", "coupling": "independent", "compute": "auto"
        });
        assert_eq!(serde_json::to_value(FlowConfig::default()).unwrap(), flow);
        let refiner = serde_json::json!({
            "passes": 12, "retokenize_every": 4, "lod_depth": null, "gradient_size": 128, "compute": "auto"
        });
        assert_eq!(serde_json::to_value(RefinerConfig::default()).unwrap(), refiner);
    }

    #[test]
    fn impossible_values_are_refused_by_name() {
        let flow = |change: fn(&mut FlowConfig)| {
            let mut config = FlowConfig::default();
            change(&mut config);
            config.validate().unwrap_err().to_string()
        };
        assert!(flow(|c| c.steps = 0).contains("steps: expected 1 to 10000, found 0"));
        assert!(flow(|c| c.cfg_scale = f32::NAN).contains("cfg_scale"));
        assert!(flow(|c| c.lambda_pg = -1.0).contains("lambda_pg"));
        assert!(flow(|c| c.lod_depth = Some(0)).contains("lod_depth"));
        assert!(flow(|c| c.gradient_size = 7).contains("gradient_size"));
        let refiner = |change: fn(&mut RefinerConfig)| {
            let mut config = RefinerConfig::default();
            change(&mut config);
            config.validate().unwrap_err().to_string()
        };
        assert!(refiner(|c| c.passes = 0).contains("passes: expected 1 to 1000, found 0"));
        assert!(refiner(|c| c.retokenize_every = 1001).contains("retokenize_every"));
        assert!(refiner(|c| c.lod_depth = Some(21)).contains("lod_depth"));
    }
}
