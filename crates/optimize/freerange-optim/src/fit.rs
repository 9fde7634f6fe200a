//! The fit from nothing: 3DGS-MCMC.

use crate::{
    Evidence, FitConfig, FitError, FitProgress,
    adam::Adam,
    init::random_cloud,
    mcmc::{add_noise, relocate_and_grow},
    objective::{Objective, check_cloud, normalize_rotations},
    views::Targets,
};
use freerange_gaussians::Gaussians;
use freerange_util::Invalid;
use rand::{Rng, SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;
use std::ops::ControlFlow;

/// Fits Gaussians to posed views, and silhouettes where there are any, by 3DGS-MCMC (Kheradmand et al. 2024): Adam on the photometric loss, with noise that
/// lets faint Gaussians explore and relocation of dead ones, which also grows their number.
///
/// Starts from `initial`, or, without it, from random Gaussians where all views see the object. `progress` hears of
/// every step, and ends the fit with what it has by `ControlFlow::Break`. The same input gives the same bytes.
///
/// # Errors
/// If there are no views, or they differ in size from their camera; if the configuration is impossible,
/// `initial` is empty, not finite or larger than `cap_max`; or if the optimization diverges.
pub fn fit<'a>(
    seen: impl Into<Evidence<'a>>,
    initial: Option<&Gaussians>,
    config: &FitConfig,
    progress: impl FnMut(&FitProgress<'_>) -> ControlFlow<()>,
) -> Result<Gaussians, FitError> {
    config.check()?;
    fit_targets(&Targets::new(seen, config.render_size)?, initial, config, progress)
}

/// [`fit`] of views at the size that they are compared at, with a configuration that is checked.
pub(crate) fn fit_targets(
    targets: &Targets,
    initial: Option<&Gaussians>,
    config: &FitConfig,
    progress: impl FnMut(&FitProgress<'_>) -> ControlFlow<()>,
) -> Result<Gaussians, FitError> {
    let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
    let cloud = match initial {
        Some(cloud) => checked(cloud, config.cap_max)?,
        None => random_cloud(targets, config, &mut rng),
    };
    descend(cloud, |_| (targets, 1.0), config, &mut rng, |_, _| Ok(Vec::new()), progress)
}

/// The optimization itself. `of_step` is what each step compares with, at whatever size, and the part of each side of a view
/// that it looks at ([`OptimizationConfig::window`](crate::OptimizationConfig::window)); `more` are further terms of the objective of a cloud over a background.
pub(crate) fn descend<'t>(
    mut cloud: Gaussians,
    of_step: impl Fn(usize) -> (&'t Targets, f64),
    config: &FitConfig,
    rng: &mut ChaCha8Rng,
    mut more: impl FnMut(&Gaussians, [f32; 3]) -> Result<Vec<Objective>, FitError> + Send,
    mut progress: impl FnMut(&FitProgress<'_>) -> ControlFlow<()>,
) -> Result<Gaussians, FitError> {
    let mut adam = Adam::default();
    // A stream of its own: the views come in the same order with and without windows.
    let mut window_rng = ChaCha8Rng::seed_from_u64(config.seed);
    window_rng.set_stream(2);
    let (mut queue, mut silhouette_queue) = (Vec::new(), Vec::new());
    for step in 0..config.iterations {
        let (targets, window) = of_step(step);
        let silhouettes = targets.cameras.len() - targets.views;
        let done = step as f64 / config.iterations as f64;
        let mean_rate = config.rates.mean * (config.final_mean_rate / config.rates.mean).powf(done);

        // Within the pool: from outside, each of the many small pieces of a step would wait for a thread to wake.
        let loss = rayon::scope(|_| {
            // Every other step looks at silhouettes alone, if there are any and as often as they count.
            let by_silhouette = silhouettes > 0 && step % 2 == 1 && looked_at(targets.weights[targets.views], rng);
            let chosen = match by_silhouette {
                true => next_views(&mut silhouette_queue, silhouettes, config.views_per_step, rng),
                false => next_weighted(&mut queue, &targets.weights[..targets.views], config.views_per_step, rng),
            };
            let background = config.background.draw(rng);
            let windows = (window < 1.0 && !by_silhouette).then(|| targets.windows(&chosen, window, &mut window_rng));
            let own = || match &windows {
                _ if by_silhouette => Objective::silhouettes(&cloud, targets, &chosen),
                Some(windows) => {
                    let all: Vec<usize> = (0..chosen.len()).collect();
                    Objective::photometric(&cloud, windows, &all, background, config.lambda_ssim)
                }
                None => Objective::photometric(&cloud, targets, &chosen, background, config.lambda_ssim),
            };
            let (own, further) = rayon::join(own, || more(&cloud, background));
            let mut objective = own?;
            let loss = objective.loss;
            further?.iter().for_each(|other| objective.add(other));
            objective.add_opacity(&cloud, config.opacity_regularizer);
            objective.add_scale(&cloud, config.scale_regularizer);
            objective.check(step)?;
            adam.step(cloud.rows_mut(), &objective.gradients, &config.rates.by_channel(mean_rate));
            normalize_rotations(&mut cloud);

            let due = step >= config.growth_start && step % config.refine_every == 0;
            if due && done < config.growth_stop {
                relocate_and_grow(&mut cloud, &mut adam, config, rng);
            }
            add_noise(&mut cloud, config.noise_lr * mean_rate, config.dead_opacity, rng);
            check_cloud(&cloud, step)?;
            Ok::<_, FitError>(loss)
        })?;

        let (step, steps, gaussians) = (step + 1, config.iterations, cloud.len());
        if progress(&FitProgress { step, steps, loss, gaussians, cloud: &cloud }).is_break() {
            break;
        }
    }
    cloud.canonicalize_rotations();
    Ok(cloud)
}

/// A cloud to start from.
pub(crate) fn checked(cloud: &Gaussians, most: usize) -> Result<Gaussians, FitError> {
    if cloud.is_empty() {
        return Err(FitError::NoGaussians);
    }
    cloud.check_finite()?;
    if cloud.len() > most {
        let expected = format!("at least the {} Gaussians to start from", cloud.len());
        return Err(Invalid::new("cap_max", expected, most).into());
    }
    let mut cloud = cloud.clone();
    cloud.canonicalize_rotations();
    Ok(cloud)
}

/// The next views to look at: all of them once in random order, then again.
pub(crate) fn next_views(queue: &mut Vec<usize>, count: usize, per_step: usize, rng: &mut ChaCha8Rng) -> Vec<usize> {
    next_weighted(queue, &vec![1.0; count], per_step, rng)
}

/// The same, each as often as its weight says. At least one of them has weight 1.
fn next_weighted(queue: &mut Vec<usize>, weights: &[f64], per_step: usize, rng: &mut ChaCha8Rng) -> Vec<usize> {
    let mut chosen = Vec::new();
    while chosen.len() < per_step.min(weights.len()) {
        if queue.is_empty() {
            *queue = (0..weights.len()).filter(|&i| looked_at(weights[i], rng)).collect();
            queue.shuffle(rng);
        }
        chosen.extend(queue.pop());
    }
    chosen
}

/// Whether what has this weight is looked at now. Draws nothing where it always is.
pub(crate) fn looked_at(weight: f64, rng: &mut ChaCha8Rng) -> bool {
    weight >= 1.0 || rng.random_bool(weight)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_are_looked_at_as_often_as_they_weigh() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let (mut queue, mut times) = (Vec::new(), [0; 4]);
        for _ in 0..4000 {
            let chosen = next_weighted(&mut queue, &[1.0, 0.25, 1.0, 0.0], 2, &mut rng);
            assert_eq!(chosen.len(), 2);
            chosen.into_iter().for_each(|view| times[view] += 1);
        }
        let [full, quarter, other, none] = times;
        assert!(none == 0 && other - full <= 1, "{times:?}");
        assert!((f64::from(quarter) / f64::from(full) - 0.25).abs() < 0.03, "{times:?}");
        // Weights of 1 draw nothing: results are those of a program without weights.
        let mut other = rng.clone();
        let unweighted = next_views(&mut Vec::new(), 5, 1, &mut rng);
        assert!(looked_at(1.0, &mut other));
        assert_eq!(next_weighted(&mut Vec::new(), &[1.0; 5], 1, &mut other), unweighted);
        assert_eq!(rng, other);
    }
}
