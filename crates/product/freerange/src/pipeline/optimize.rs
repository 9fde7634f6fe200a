//! Step 5, optimize. In: refined proposals and all targets. Out: one set of Gaussians, up to
//! [`max_gaussians`](crate::OptimizeConfig::max_gaussians), by 3DGS-MCMC on the photos from all proposals together. Where no
//! photo looks, the mean renders of the proposals anchor it ([`freerange_optim::optimize`]; docs/research/experiments/proposals.md).
//!
//! Cost: half of the pipeline's time; memory of the photos at `max_resolution`, and at half of it.

use freerange_gaussians::Gaussians;
use freerange_optim::{AnchorConfig, OptimizationConfig};

use super::{CanonicalScene, symmetry::Targets, watch::Watch};
use crate::{Error, OptimizeConfig, Stage};

/// Optimizes the proposals on the photos; without iterations the first of them is the result.
pub(crate) fn optimize(
    scene: &CanonicalScene<'_>,
    targets: &Targets<'_>,
    config: &OptimizeConfig,
    proposals: &[Gaussians],
    seed: u64,
    watch: &mut Watch<'_>,
) -> Result<Gaussians, Error> {
    let (first, others) = proposals.split_first().expect("at least one proposal");
    if config.iterations == 0 {
        return Ok(first.clone());
    }
    // What several agree on is held more firmly than a guess.
    let anchors = match others.is_empty() {
        true => AnchorConfig::default(),
        false => AnchorConfig { weight: 0.3, views: 24, ..AnchorConfig::default() },
    };
    let steps = OptimizationConfig { steps: config.iterations, anchors, seed, ..OptimizationConfig::default() };
    let evidence = targets.of_optimization();
    let side = evidence.views.iter().map(|view| view.camera.width.max(view.camera.height)).max().unwrap_or(0);
    let steps = steps.detailed(config.detail(), side).for_photos(targets.photos());
    watch.fit(Stage::Optimize, steps.steps, &scene.canonical_from_user, |progress| {
        freerange_optim::optimize(first, others, evidence, &steps, progress)
    })
}
