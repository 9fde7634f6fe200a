//! Gradient steps on a cloud that is already good: what a generated sample needs to agree with its input views.

use crate::{
    FitError, FitProgress, RefineConfig,
    adam::Adam,
    fit::checked,
    objective::{Objective, check_cloud, normalize_rotations},
    views::Targets,
};
use freerange_camera::View;
use freerange_splat::{Cloud, channel};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::ops::ControlFlow;

/// Improves a cloud's agreement with posed views by gradient steps: no noise, no relocation, no new Gaussians; row `i`
/// of the result is row `i` of `cloud`, moved. Every step looks at all views.
///
/// Few views say little of the rest of the object. Hence an anchor to where the Gaussians started, and a limit on the
/// change of their sizes. `progress` hears of every step, and ends with what there is by `ControlFlow::Break`. The same
/// input gives the same bytes.
///
/// # Errors
/// If there are no views, or they differ in size from their camera or each other; if the configuration is impossible;
/// if the cloud is empty or not finite; or if the optimisation diverges.
pub fn refine(
    cloud: &Cloud,
    views: &[View],
    config: &RefineConfig,
    mut progress: impl FnMut(&FitProgress) -> ControlFlow<()>,
) -> Result<Cloud, FitError> {
    config.check()?;
    let targets = Targets::new(views, config.render_size)?;
    let start = checked(cloud, usize::MAX)?;
    let mut cloud = start.clone();
    let anchor = anchor_weights(&start, config.anchor);
    let all: Vec<usize> = (0..views.len()).collect();
    let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
    let mut adam = Adam::default();
    for step in 0..config.steps {
        let decay = 0.5 + 0.5 * (std::f64::consts::PI * step as f64 / config.steps as f64).cos();
        let background = config.background.draw(&mut rng);
        let mut objective = Objective::photometric(&cloud, &targets, &all, background, config.lambda_ssim)?;
        let loss = objective.loss;
        objective.add_opacity(&cloud, config.opacity_regularizer);
        if config.anchor > 0.0 {
            objective.add_anchor(&cloud, &start, &anchor);
        }
        objective.check(step)?;
        let rates = config.rates.by_channel(decay * config.rates.mean, decay);
        adam.step(cloud.rows_mut(), &objective.gradients, &rates);
        normalize_rotations(&mut cloud);
        limit_scales(&mut cloud, &start, config.scale_limit.ln() as f32);
        check_cloud(&cloud, step)?;

        let now = FitProgress { step: step + 1, steps: config.steps, loss, gaussians: cloud.len() };
        if progress(&now).is_break() {
            break;
        }
    }
    cloud.canonicalize_rotations();
    Ok(cloud)
}

/// `[n, 14]`: the same for all channels but the centres, which count in units of the Gaussian's size.
fn anchor_weights(start: &Cloud, anchor: f64) -> Vec<f32> {
    let mut out = vec![anchor as f32; start.rows().len()];
    for (i, weights) in out.as_chunks_mut::<{ channel::COUNT }>().0.iter_mut().enumerate() {
        // Bounded, so that the weights stay finite.
        let variance = (start.scale(i).length_squared() / 3.0).clamp(1e-12, 1e12);
        weights[channel::MEAN].fill((anchor / variance) as f32);
    }
    out
}

fn limit_scales(cloud: &mut Cloud, start: &Cloud, limit: f32) {
    for (row, first) in cloud.iter_mut().zip(start) {
        for c in channel::LOG_SCALE {
            row[c] = row[c].clamp(first[c] - limit, first[c] + limit);
        }
    }
}
