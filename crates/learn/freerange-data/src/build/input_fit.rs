//! What a few views of an object tell without a network: where sampling may start, and so what training should see.

use std::ops::ControlFlow;

use crate::InputFit;
use freerange_optim::{Rates, initial_fit, tree_slice};
use freerange_scene::camera::{SelectionConfig, View, select_views};
use glam::DVec3;
use rand::{Rng, SeedableRng, seq::index};
use rand_chacha::ChaCha8Rng;

use crate::build::fitted::adapted;
use crate::build::{BuildError, ObjectConfig};

/// Which views a fit sees.
#[derive(Clone, Copy, Debug)]
enum Spread {
    /// One of each cluster, as evaluation's full observation.
    Around,
    /// Of one cluster, as its partial observation.
    OneSide,
    /// Any.
    Random,
}

/// The sets of an object's fits, over and over: equal for all objects, so that a batch has equally many views of each.
const SETS: [(usize, Spread); 6] = [
    (4, Spread::Around),
    (4, Spread::OneSide),
    (3, Spread::Random),
    (6, Spread::Random),
    (2, Spread::Random),
    (5, Spread::Random),
];

/// Rates of the steps that make the target of a fit, at the start. Twice those of optimizing slices: there is farther to go.
const TARGET_RATES: Rates = Rates { mean: 6e-3, scale: 2e-2, rotation: 2e-3, opacity: 0.1, color: 5e-3 };

/// Views that an object with fits has at least: some cluster of four then holds four.
pub(crate) const MIN_VIEWS: usize = 13;

/// The fits that `config` asks for. Pure.
pub(crate) fn input_fits(views: &[View], config: &ObjectConfig, seed: u64) -> Result<Vec<InputFit>, BuildError> {
    let centers: Vec<DVec3> = views.iter().map(|v| v.camera.center()).collect();
    let depth = config.initial_fit.gaussians.ilog2();
    let one = |number: usize| {
        // A stream of its own: whether something is fitted must not change the rest of the object.
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(16 + number as u64);
        let chosen = draw_set(&centers, SETS[number % SETS.len()], &mut rng)?;
        let inputs: Vec<View> = chosen.iter().map(|&i| views[i].clone()).collect();
        let cloud = initial_fit(&inputs, &config.initial_fit, rng.random(), |_| ControlFlow::Continue(()))?;
        let gaussians = tree_slice(&cloud, depth)?;
        let target = adapted(gaussians.clone(), views, config.target_iterations, TARGET_RATES, seed)?;
        Ok(InputFit { views: chosen, gaussians, target })
    };
    (0..config.input_fits).map(one).collect()
}

fn draw_set(centers: &[DVec3], set: (usize, Spread), rng: &mut ChaCha8Rng) -> Result<Vec<usize>, BuildError> {
    let (count, spread) = set;
    let selection = SelectionConfig { inputs: count, validation: 1, restarts: 2, seed: rng.random() };
    Ok(match spread {
        Spread::Around => select_views(centers, DVec3::ZERO, &selection)?.full,
        Spread::OneSide => select_views(centers, DVec3::ZERO, &selection)?.partial,
        Spread::Random => index::sample(rng, centers.len(), count).into_vec(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::build::generate_object;
    use crate::build::tests::tiny_config;
    use freerange_gaussians::Gaussians;
    use freerange_optim::InitialFitConfig;
    use freerange_optim::psnr_over_white;

    #[test]
    fn fits_come_from_their_views_alone_and_change_nothing_else() {
        let mut config = ObjectConfig { views: MIN_VIEWS, ..tiny_config() };
        let without = generate_object(5, &config, &[3]).unwrap();
        config.input_fits = 4;
        config.target_iterations = 100;
        config.initial_fit = InitialFitConfig { iterations: 20, gaussians: 64, render_size: 32 };
        let with = generate_object(5, &config, &[3]).unwrap();
        assert_eq!((&with.slices, &without.slices), (&without.slices, &with.slices));
        assert_eq!(with.input_fits.iter().map(|f| f.views.len()).collect::<Vec<_>>(), [4, 4, 3, 6]);
        assert_eq!(with.input_fits, generate_object(5, &config, &[3]).unwrap().input_fits);
        for fit in &with.input_fits {
            let mut views = fit.views.clone();
            views.sort_unstable();
            views.dedup();
            assert_eq!(views.len(), fit.views.len(), "no view twice");
            assert!(views.iter().all(|&v| v < MIN_VIEWS));
            assert_eq!(fit.gaussians.len(), 64);
            assert_eq!(fit.depth(), 6);
            // Mended, they are the same ones, and show all views better.
            let psnr = |cloud: &Gaussians| psnr_over_white(cloud, &with.views).unwrap();
            assert!(psnr(&fit.target) > psnr(&fit.gaussians) + 1.0);
            let moved = |i: usize| fit.gaussians.mean(i).distance(fit.target.mean(i));
            assert!((0..64).map(moved).sum::<f64>() / 64.0 < 0.1);
        }
        // One side: closer together than around.
        let spread = |fit: &InputFit| {
            let c = |i: usize| with.views[i].camera.center().normalize();
            let pairs = fit.views.iter().flat_map(|&a| fit.views.iter().map(move |&b| (a, b)));
            pairs.map(|(a, b)| c(a).distance(c(b))).sum::<f64>()
        };
        assert!(spread(&with.input_fits[1]) < spread(&with.input_fits[0]));
    }
}
