//! Gaussians that are fitted to an object's views.

use std::ops::ControlFlow;

use freerange_camera::View;
use freerange_fit::{FitConfig, RefineConfig, fit, refine};
use freerange_splat::Cloud;
use rand::Rng;

use crate::object::Photographed;
use crate::{DataError, ObjectConfig, SurfaceConfig, surface_gaussians};

/// 3DGS-MCMC on the views. Starts from points on the surface, which a mesh has and a photographed object lacks.
pub(crate) fn fitted_gaussians(shot: &mut Photographed, config: &ObjectConfig) -> Result<Cloud, DataError> {
    let start = SurfaceConfig { points: config.fit.initial.min(config.fit.max_gaussians), ..config.surface.clone() };
    let start = surface_gaussians(&shot.scene, &start, &mut shot.rng);
    let config = FitConfig { seed: shot.rng.random(), ..config.fit.clone() };
    Ok(fit(&shot.views, Some(&start), &config, |_| ControlFlow::Continue(()))?)
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
