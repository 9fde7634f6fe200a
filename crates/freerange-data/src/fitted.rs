//! Gaussians that are fitted to an object's views.

use std::ops::ControlFlow;

use freerange_camera::View;
use freerange_fit::{FitConfig, RefineConfig, fit, refine};
use freerange_mesh::Scene;
use freerange_splat::Cloud;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::{DataError, ObjectConfig, SurfaceConfig, surface_gaussians};

/// 3DGS-MCMC on `views`. Starts from points on the surface, which a generated object has and a photographed one lacks.
pub(crate) fn fitted_gaussians(
    scene: &Scene,
    views: &[View],
    config: &ObjectConfig,
    rng: &mut ChaCha8Rng,
) -> Result<Cloud, DataError> {
    let start = SurfaceConfig { points: config.fit.initial.min(config.fit.max_gaussians), ..config.surface.clone() };
    let start = surface_gaussians(scene, &start, rng);
    let config = FitConfig { seed: rng.random(), ..config.fit.clone() };
    Ok(fit(views, Some(&start), &config, |_| ControlFlow::Continue(()))?)
}

/// `slice` after `steps` gradient steps towards `views`; the order of its rows stays.
pub(crate) fn polished(slice: Cloud, views: &[View], steps: usize, seed: u64) -> Result<Cloud, DataError> {
    if steps == 0 {
        return Ok(slice);
    }
    let config = RefineConfig { steps, seed, ..RefineConfig::default() };
    let mut slice = refine(&slice, views, &config, |_| ControlFlow::Continue(()))?;
    slice.canonicalize_rotations();
    Ok(slice)
}
