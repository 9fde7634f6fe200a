//! What makes it 3DGS-MCMC (Kheradmand et al. 2024): dead Gaussians are put where others are in a way that changes the
//! image little, the number of Gaussians grows in the same way, and noise moves the faint ones about.

use crate::{FitConfig, adam::Adam};
use freerange_gaussians::{Gaussians, channel};
use glam::DVec3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal, weighted::WeightedIndex};

/// Range of the opacity of a Gaussian that was split.
const OPACITY: std::ops::RangeInclusive<f64> = 0.005..=1.0 - f32::EPSILON as f64;
/// More Gaussians than these are not put in one place at once: the sums alternate in sign.
const MAX_COPIES: usize = 51;

/// How to replace one Gaussian of opacity `opacity` by `copies` equal ones in the same place: their opacity, and the
/// factor on their standard deviations that keeps the integral of the alpha along a line through the center (eq. 9).
/// The opacity is brought into its range only after the factor is computed, as the paper's authors do.
pub(crate) fn relocation(opacity: f64, copies: usize) -> (f64, f64) {
    // At an opacity of 1 the copies' would be 1 as well, and the sum below has terms up to 1e14.
    let opacity = opacity.min(*OPACITY.end());
    let each = -((-opacity).ln_1p() / copies as f64).exp_m1(); // 1 - (1 - o)^(1 / n)
    let mut sum = 0.0;
    for i in 0..copies {
        let mut term = each; // C(i, k) (-1)^k o'^(k + 1)
        for k in 0..=i {
            sum += term / ((k + 1) as f64).sqrt();
            term *= -each * (i - k) as f64 / (k + 1) as f64;
        }
    }
    (each.clamp(*OPACITY.start(), *OPACITY.end()), opacity / sum)
}

/// Makes Gaussian `i` one of `copies` that look together as it does.
pub(crate) fn split(cloud: &mut Gaussians, i: usize, copies: usize) {
    let (opacity, factor) = relocation(cloud.opacity(i), copies.min(MAX_COPIES));
    let row = row_mut(cloud, i);
    row[channel::LOGIT_OPACITY] = (opacity / (1.0 - opacity)).ln() as f32;
    row[channel::LOG_SCALE].iter_mut().for_each(|s| *s += factor.ln() as f32);
}

/// The number of Gaussians after one round of growth; grows to the limit and not beyond.
pub(crate) fn grown(count: usize, config: &FitConfig) -> usize {
    // Few Gaussians would never grow by rounding down alone.
    let by_one = count + usize::from(config.growth > 1.0);
    by_one.max((count as f64 * config.growth) as usize).min(config.cap_max).max(count)
}

/// Moves dead Gaussians to live ones, then adds new ones, both drawn in proportion to opacity.
pub(crate) fn relocate_and_grow(cloud: &mut Gaussians, adam: &mut Adam, config: &FitConfig, rng: &mut ChaCha8Rng) {
    let opacities: Vec<f64> = (0..cloud.len()).map(|i| cloud.opacity(i)).collect();
    let alive: Vec<f64> = opacities.iter().map(|&o| if o > config.dead_opacity { o } else { 0.0 }).collect();
    let dead: Vec<usize> = (0..cloud.len()).filter(|&i| alive[i] == 0.0).collect();
    if dead.len() == cloud.len() {
        return; // there is no better place for any of them
    }
    place(cloud, adam, &alive, &dead, rng);

    let first = cloud.len();
    let fresh: Vec<usize> = (first..grown(first, config)).collect();
    let opacities: Vec<f64> = (0..first).map(|i| cloud.opacity(i)).collect();
    fresh.iter().for_each(|_| cloud.push(&[0.0; channel::COUNT]));
    place(cloud, adam, &opacities, &fresh, rng);
}

/// Puts the Gaussians `targets` where others are, drawn by `weights`; these and the targets share the opacity.
fn place(cloud: &mut Gaussians, adam: &mut Adam, weights: &[f64], targets: &[usize], rng: &mut ChaCha8Rng) {
    let Ok(draw) = WeightedIndex::new(weights) else { return }; // not numbers: the caller's check says so
    let mut copies = vec![1; weights.len()];
    let sources: Vec<usize> = targets.iter().map(|_| draw.sample(rng)).collect();
    sources.iter().for_each(|&source| copies[source] += 1);
    for (source, &copies) in copies.iter().enumerate().filter(|(_, copies)| **copies > 1) {
        split(cloud, source, copies);
        adam.forget(source);
    }
    for (&target, &source) in targets.iter().zip(&sources) {
        let row = *cloud.row(source);
        *row_mut(cloud, target) = row;
        adam.forget(target);
    }
}

/// Variances times less than this move nothing that f32 could tell.
const STILL: f64 = 1e-9;

/// Moves each center by `Sigma xi sigmoid(-100 (o - dead)) strength`, with `xi` standard normal: along the Gaussian's own
/// shape, and only where it is faint. `strength` is the noise of the configuration times the centers' learning rate.
pub(crate) fn add_noise(cloud: &mut Gaussians, strength: f64, dead_opacity: f64, rng: &mut ChaCha8Rng) {
    // Gaussians from this opacity on stay where they are, the most: nothing is drawn for them.
    let still = dead_opacity + 0.01 * (strength / STILL).ln(); // -inf without noise
    if still <= 0.0 {
        return;
    }
    let still = if still < 1.0 { (still / (1.0 - still)).ln() as f32 } else { f32::INFINITY };
    for i in 0..cloud.len() {
        if cloud.row(i)[channel::LOGIT_OPACITY] >= still {
            continue;
        }
        let xi = DVec3::from_array(std::array::from_fn(|_| rng.sample(StandardNormal)));
        let moved = cloud.mean(i) + noise(cloud, i, xi, strength, dead_opacity);
        row_mut(cloud, i)[channel::MEAN].copy_from_slice(&moved.as_vec3().to_array());
    }
}

fn noise(cloud: &Gaussians, i: usize, xi: DVec3, strength: f64, dead_opacity: f64) -> DVec3 {
    let gate = 1.0 / (1.0 + (100.0 * (cloud.opacity(i) - dead_opacity)).exp());
    cloud.covariance(i) * (xi * (gate * strength))
}

/// The channels of Gaussian `i`, to change in place.
fn row_mut(cloud: &mut Gaussians, i: usize) -> &mut [f32; channel::COUNT] {
    &mut cloud.iter_mut().into_slice()[i]
}

#[cfg(test)]
mod tests {
    use super::*;
    use freerange_vectors::Vectors;
    use rand_chacha::rand_core::SeedableRng;

    #[test]
    fn relocation_matches_the_vectors() {
        let file = Vectors::read("mcmc/relocation.safetensors");
        let (opacity, scales, counts) = (file.floats("in/opacity"), file.floats("in/scales"), file.ints("in/n"));
        let (expected_o, expected_s) = (file.floats("out/opacity_ubc"), file.floats("out/scales_ubc"));
        assert!(counts.len() * opacity.len() == expected_o.len() && !expected_o.is_empty());
        for (r, &copies) in counts.iter().enumerate() {
            for (i, &o) in opacity.iter().enumerate() {
                let (new, factor) = relocation(f64::from(o), copies as usize);
                let at = r * opacity.len() + i;
                let close = |a: f64, b: f32| (a - f64::from(b)).abs() <= 1e-5 * f64::from(b).abs();
                assert!(close(new, expected_o[at]), "n {copies}, o {o}: {new} {}", expected_o[at]);
                for k in 0..3 {
                    let new = f64::from(scales[3 * i + k]) * factor;
                    assert!((new / f64::from(expected_s[3 * at + k]) - 1.0).abs() < 2e-3, "n {copies}, o {o}: {new}");
                }
            }
        }
    }

    /// Eq. 9 of the paper from its definition: the integral of the alpha of `n` Gaussians over a line is kept.
    #[test]
    fn relocation_keeps_the_integral() {
        for opacity in [0.01, 0.3, 0.9, 0.999_999] {
            for copies in [1, 2, 7, 30, MAX_COPIES] {
                let (_, factor) = relocation(opacity, copies);
                let each = 1.0 - (1.0 - opacity).powf(1.0 / copies as f64);
                let integral =
                    |alpha: &dyn Fn(f64) -> f64| (-8000..=8000).map(|i| alpha(f64::from(i) * 1e-3)).sum::<f64>();
                let before = integral(&|x| opacity * (-0.5 * x * x).exp());
                let after = factor * integral(&|x| 1.0 - (1.0 - each * (-0.5 * x * x).exp()).powi(copies as i32));
                assert!((after / before - 1.0).abs() < 1e-6, "o {opacity}, n {copies}: {before} {after}");
            }
        }
    }

    #[test]
    fn noise_matches_the_vectors() {
        let file = Vectors::read("mcmc/noise.safetensors");
        let (quats, scales) = (file.floats("in/quats"), file.floats("in/log_scales"));
        let (logits, xi, expected) =
            (file.floats("in/logit_opacities"), file.floats("in/xi"), file.floats("out/delta_means"));
        let largest = expected.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        for i in 0..logits.len() {
            let mut row = [0.0; channel::COUNT];
            row[channel::LOG_SCALE].copy_from_slice(&scales[3 * i..][..3]);
            row[channel::ROTATION].copy_from_slice(&quats[4 * i..][..4]);
            row[channel::LOGIT_OPACITY] = logits[i];
            let xi = DVec3::from_array(std::array::from_fn(|k| f64::from(xi[3 * i + k])));
            let found = noise(&Gaussians::from_rows(row.to_vec()), 0, xi, f64::from(1.6e-4f32) * 5e5, 0.005);
            for k in 0..3 {
                let truth = expected[3 * i + k];
                let tolerance = 2e-3 * f64::from(truth.abs()) + 1e-9 * f64::from(largest);
                assert!((found[k] - f64::from(truth)).abs() <= tolerance, "{i}: {found} {truth}");
            }
        }
    }

    #[test]
    fn only_faint_gaussians_move() {
        let faint = [-9.0, -6.0, -4.0, -2.5];
        let bright = [-0.5, 0.0, 2.0, 9.0];
        let before = example(&[faint, bright].concat());
        let mut cloud = before.clone();
        add_noise(&mut cloud, 5e5 * 1.6e-4, 0.005, &mut ChaCha8Rng::seed_from_u64(5));
        for i in 0..before.len() {
            assert_eq!(cloud.row(i)[3..], before.row(i)[3..]);
            // What is left out would not have moved by what f32 can tell.
            let still = noise(&before, i, DVec3::ONE, 5e5 * 1.6e-4, 0.005).length() < 1e-9;
            assert_eq!(still, i >= faint.len(), "{i}");
            assert_eq!(cloud.row(i) == before.row(i), still, "{i}");
        }
        let moved = cloud.clone();
        add_noise(&mut cloud, 0.0, 0.005, &mut ChaCha8Rng::seed_from_u64(5));
        assert_eq!(cloud, moved);
    }

    #[test]
    fn growth_reaches_the_limit_and_stays() {
        let config = FitConfig { cap_max: 1000, ..Default::default() };
        let mut counts = vec![7];
        while counts.len() < 120 {
            counts.push(grown(counts[counts.len() - 1], &config));
        }
        assert!(counts.windows(2).all(|w| w[1] > w[0] || w[0] == 1000));
        assert!(counts.windows(2).all(|w| w[1] <= w[0] + 1 || w[1] as f64 <= 1.05 * w[0] as f64));
        assert_eq!(counts[119], 1000);
        assert_eq!(grown(500, &FitConfig { growth: 1.0, ..config.clone() }), 500);
        assert_eq!(grown(990, &config), 1000);
    }

    fn example(logits: &[f32]) -> Gaussians {
        let mut cloud = Gaussians::default();
        for (i, &logit) in logits.iter().enumerate() {
            let x = i as f32;
            cloud.push(&[x, -x, 1.0, -3.0, -2.0, -4.0, 1.0, 0.0, 0.0, 0.0, logit, 0.1 * x, 0.5, 0.5]);
        }
        cloud
    }

    #[test]
    fn the_dead_join_the_living() {
        let mut cloud = example(&[2.0, -9.0, 0.0, -7.0, -9.0]);
        let (mut adam, mut rng) = (Adam::default(), ChaCha8Rng::seed_from_u64(5));
        let config = FitConfig { cap_max: 5, initial: 5, ..Default::default() };
        relocate_and_grow(&mut cloud, &mut adam, &config, &mut rng);
        assert_eq!(cloud.len(), 5);
        let mut kept = 1.0;
        for i in 0..5 {
            assert!(cloud.opacity(i) > config.dead_opacity);
            let x = cloud.row(i)[0];
            assert!(x == 0.0 || x == 2.0, "{x}");
            if x == 0.0 {
                kept *= 1.0 - cloud.opacity(i);
            }
        }
        // Equal Gaussians behind each other let through what the one before did.
        assert!((kept - (1.0 - example(&[2.0]).opacity(0))).abs() < 1e-6);
    }

    #[test]
    fn all_dead_changes_nothing() {
        let mut cloud = example(&[-9.0, -12.0]);
        let before = cloud.clone();
        let config = FitConfig::default();
        relocate_and_grow(&mut cloud, &mut Adam::default(), &config, &mut ChaCha8Rng::seed_from_u64(5));
        assert_eq!(cloud, before);
    }
}
