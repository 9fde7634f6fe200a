//! Gaussians that are fitted to an object's views.

use std::ops::ControlFlow;

use freerange_gaussians::{Gaussians, OPACITY_RANGE, channel};
use freerange_optim::{FitConfig, Rates, fit};
use freerange_scene::camera::View;
use rand::Rng;

use crate::build::photographed::Photographed;
use crate::build::{BuildError, ObjectConfig, SurfaceConfig, surface_gaussians};

/// Standard deviation along the surface of the Gaussians that a fit starts from, in units of the square root of the area
/// that each stands for. Wide ones, which overlap, end in better fits and slices than those that look best as they are.
const START_SPREAD: f32 = 0.8;

/// 3DGS-MCMC on the views. Starts from points on the surface, which a mesh has and a photographed object lacks, wide and
/// of the opacity `fit.initial_opacity`: faint enough that what is behind them is seen and learns.
pub(crate) fn fitted_gaussians(
    photographed: &mut Photographed,
    config: &ObjectConfig,
) -> Result<Gaussians, BuildError> {
    let start = SurfaceConfig {
        points: config.fit.initial.min(config.fit.cap_max),
        spread: START_SPREAD,
        opacity: config.fit.initial_opacity as f32,
        ..config.surface.clone()
    };
    let start = surface_gaussians(&photographed.scene, &start, &mut photographed.rng);
    let config = FitConfig { seed: photographed.rng.random(), ..config.fit.clone() };
    Ok(fit(&photographed.views, Some(&start), &config, |_| ControlFlow::Continue(()))?)
}

/// `slice` after `steps` gradient steps, each towards one of the `views`; its rows stay what and where they are in the
/// order of the tree. Opacities stay within [`OPACITY_RANGE`].
pub(crate) fn optimized(slice: Gaussians, views: &[View], steps: usize, seed: u64) -> Result<Gaussians, BuildError> {
    adapted(slice, views, steps, POLISH_RATES, seed)
}

/// As [`optimized`], at these rates.
pub(crate) fn adapted(
    slice: Gaussians,
    views: &[View],
    steps: usize,
    rates: Rates,
    seed: u64,
) -> Result<Gaussians, BuildError> {
    if steps == 0 {
        return Ok(slice);
    }
    let config = FitConfig {
        iterations: steps,
        cap_max: slice.len(),
        initial: slice.len(),
        growth_start: usize::MAX,
        noise_lr: 0.0,
        opacity_regularizer: 0.0,
        scale_regularizer: 0.0,
        rates,
        final_mean_rate: 0.01 * rates.mean,
        seed,
        ..FitConfig::default()
    };
    let mut slice = fit(views, Some(&slice), &config, |_| ControlFlow::Continue(()))?;
    let [low, high] = OPACITY_RANGE.map(|o| (o / (1.0 - o)).ln() as f32);
    for row in slice.iter_mut() {
        row[channel::LOGIT_OPACITY] = row[channel::LOGIT_OPACITY].clamp(low, high);
    }
    Ok(slice)
}

/// Rates of [`optimized`], at the start.
const POLISH_RATES: Rates = Rates { mean: 3e-3, scale: 1e-2, rotation: 1e-3, opacity: 0.05, color: 2.5e-3 };

#[cfg(test)]
mod tests {
    use super::*;
    use crate::build::photographed::Seconds;
    use crate::build::tests::tiny_config;
    use freerange_gaussians::LodTree;
    use freerange_optim::psnr_over_white;

    #[test]
    fn optimized_slices_keep_their_rows_and_show_more() {
        let mut config = tiny_config();
        config.views = 12;
        config.cameras.resolution = 64;
        config.fit = FitConfig { iterations: 60, initial: 512, cap_max: 512, ..FitConfig::default() };
        let mesh = freerange_assets::generate::generate(3, &config.generator).unwrap();
        let mut photographed = Photographed::new(mesh, 3, &config, 4, &mut Seconds::default()).unwrap();
        let leaves = fitted_gaussians(&mut photographed, &config).unwrap();
        assert_eq!(leaves.len(), 512);
        let slice = LodTree::build(&leaves, config.alignment).unwrap().slice(6).unwrap();
        assert_eq!(optimized(slice.clone(), &photographed.views, 0, 1).unwrap(), slice);
        let better = optimized(slice.clone(), &photographed.views, 80, 1).unwrap();
        assert_eq!(better, optimized(slice.clone(), &photographed.views, 80, 1).unwrap());
        let [before, after] = [&slice, &better].map(|c| psnr_over_white(c, &photographed.held_out).unwrap());
        assert!(after > before + 0.5, "{before} dB, then {after} dB");
        for i in 0..slice.len() {
            // Where it was, but for a fraction of its own size.
            let moved = slice.mean(i).distance(better.mean(i));
            assert!(moved < slice.scale(i).max_element(), "{i}: {moved}");
            assert!((OPACITY_RANGE[0] - 1e-6..=OPACITY_RANGE[1] + 1e-6).contains(&better.opacity(i)));
        }
    }
}
