//! A fit of seconds: what a few views tell without a network, for sampling and training to start from.

use std::ops::ControlFlow;

use freerange_gaussians::{Alignment, Gaussians, LodTree};
use freerange_util::ensure;
use serde::{Deserialize, Serialize};

use crate::{
    Evidence, FitConfig, FitError, FitProgress,
    fit::{fit, fit_targets},
    views::Targets,
};

/// Settings of [`initial_fit`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct InitialFitConfig {
    /// Optimization steps, one view each.
    pub iterations: usize,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Longest side, in pixels, at which views are compared; larger ones are shrunk.
    pub render_size: u32,
}

impl Default for InitialFitConfig {
    fn default() -> Self {
        Self { iterations: 200, gaussians: 1024, render_size: 128 }
    }
}

impl InitialFitConfig {
    /// Refuses values that no fit can work with.
    pub fn check(&self) -> Result<(), FitError> {
        ensure((1..=100_000).contains(&self.iterations), "iterations", "1 to 100000", self.iterations)?;
        ensure((1..=65_536).contains(&self.gaussians), "gaussians", "1 to 65536", self.gaussians)?;
        Ok(ensure((8..=4096).contains(&self.render_size), "render_size", "8 to 4096 pixels", self.render_size)?)
    }

    fn config(&self, seed: u64) -> FitConfig {
        FitConfig {
            iterations: self.iterations,
            cap_max: self.gaussians,
            initial: self.gaussians,
            // Relocation alone: the number does not grow.
            growth_start: 50,
            refine_every: 50,
            growth: 1.0,
            render_size: Some(self.render_size),
            seed,
            ..FitConfig::default()
        }
    }
}

/// A short 3DGS-MCMC fit of what is `seen`, which lies in the canonical frame, from the visual hull of the masks.
///
/// # Errors
/// Those of [`fit`](crate::fit()).
pub fn initial_fit<'a>(
    seen: impl Into<Evidence<'a>>,
    config: &InitialFitConfig,
    seed: u64,
    progress: impl FnMut(&FitProgress<'_>) -> ControlFlow<()>,
) -> Result<Gaussians, FitError> {
    fit_from(None, seen, config, seed, progress)
}

/// The same from `start`, where there is one: it keeps its number of Gaussians, whatever `config` says of that.
pub(crate) fn fit_from<'a>(
    start: Option<&Gaussians>,
    seen: impl Into<Evidence<'a>>,
    config: &InitialFitConfig,
    seed: u64,
    progress: impl FnMut(&FitProgress<'_>) -> ControlFlow<()>,
) -> Result<Gaussians, FitError> {
    config.check()?;
    let gaussians = start.map_or(config.gaussians, Gaussians::len);
    fit(seen, start, &InitialFitConfig { gaussians, ..config.clone() }.config(seed), progress)
}

/// For each of some views an [`initial_fit`] of all the others. They are shrunk once for all of these fits, and not needed any more.
pub struct LeaveOneOut {
    targets: Targets,
    config: InitialFitConfig,
}

impl LeaveOneOut {
    /// # Errors
    /// Those of [`fit`](crate::fit()).
    pub fn new<'a>(seen: impl Into<Evidence<'a>>, config: &InitialFitConfig) -> Result<Self, FitError> {
        config.check()?;
        Ok(Self { targets: Targets::new(seen, Some(config.render_size))?, config: config.clone() })
    }

    /// The fit of all views but number `left_out`: the bytes of [`initial_fit`] of them.
    ///
    /// # Errors
    /// Those of [`fit`](crate::fit()).
    pub fn fit(
        &self,
        left_out: usize,
        seed: u64,
        progress: impl FnMut(&FitProgress<'_>) -> ControlFlow<()>,
    ) -> Result<Gaussians, FitError> {
        let (targets, config) = (self.targets.without(left_out), self.config.config(seed));
        if targets.views == 0 {
            return Err(FitError::NoViews);
        }
        fit_targets(&targets, None, &config, progress)
    }
}

/// `cloud` as `2^depth` Gaussians in the order of its level-of-detail tree, axes labeled by the world's: as the network
/// takes and makes them.
///
/// # Errors
/// For a cloud that is empty or not finite.
pub fn tree_slice(cloud: &Gaussians, depth: u32) -> Result<Gaussians, FitError> {
    Ok(LodTree::build_to_depth(cloud, depth, Alignment::Identity)?.slice(depth)?)
}
