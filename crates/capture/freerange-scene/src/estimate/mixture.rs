//! Mixtures of Gaussians over colors, fitted by expectation and maximization.

use glam::{Mat3, Vec3};
use rand::{Rng, SeedableRng, seq::index};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// Added to every variance: colors are whole numbers, and few samples must not make a spike.
const FLOOR: f32 = 2.0;
/// Samples that a fit looks at, at most.
const SAMPLES: usize = 6000;
const ROUNDS: usize = 20;

struct Component {
    mean: Vec3,
    inverse: Mat3,
    /// Logarithm of weight and normalization.
    log_scale: f32,
}

/// A density over Lab colors.
pub struct Mixture(Vec<Component>);

impl Mixture {
    /// Fits `count` components to the colors; none for no colors. The same colors and seed give the same mixture.
    pub fn fit(colors: &[Vec3], count: usize, seed: u64) -> Option<Self> {
        Self::fit_some(colors.len(), |which| which.iter().map(|&i| colors[i]).collect(), count, seed)
    }

    /// The same without all colors at hand: of `all`, `colors` gives those of some numbers.
    pub fn fit_some(all: usize, colors: impl FnOnce(&[usize]) -> Vec<Vec3>, count: usize, seed: u64) -> Option<Self> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let which: Vec<usize> = match all {
            0 => return None,
            n if n <= SAMPLES => (0..n).collect(),
            n => index::sample(&mut rng, n, SAMPLES).into_vec(),
        };
        let samples = colors(&which);
        let mut centers = vec![samples[rng.random_range(0..samples.len())]];
        let mut nearest = vec![f32::INFINITY; samples.len()];
        while centers.len() < count {
            let last = centers[centers.len() - 1];
            nearest.iter_mut().zip(&samples).for_each(|(d, s)| *d = d.min(s.distance_squared(last)));
            let mut left = rng.random::<f32>() * nearest.iter().sum::<f32>();
            let chosen = nearest.iter().position(|d| {
                left -= d;
                left < 0.0
            });
            centers.push(samples[chosen.unwrap_or(samples.len() - 1)]);
        }
        // Shares of the components in each sample; first all to the nearest.
        let mut shares: Vec<Vec<f32>> = samples
            .iter()
            .map(|s| {
                let distance = |c: &usize| s.distance_squared(centers[*c]);
                let own = (0..count).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(0);
                (0..count).map(|c| f32::from(u8::from(c == own))).collect()
            })
            .collect();
        let mut mixture = Self::from_shares(&samples, &shares, count);
        for _ in 0..ROUNDS {
            shares = samples.par_iter().map(|s| mixture.shares(*s)).collect();
            mixture = Self::from_shares(&samples, &shares, mixture.0.len());
        }
        Some(mixture)
    }

    fn from_shares(samples: &[Vec3], shares: &[Vec<f32>], count: usize) -> Self {
        let components = (0..count).filter_map(|c| {
            let weight: f32 = shares.iter().map(|s| s[c]).sum();
            // A component that lost its samples is gone.
            if weight < 1.0 {
                return None;
            }
            let mean = samples.iter().zip(shares).map(|(v, s)| *v * s[c]).sum::<Vec3>() / weight;
            let mut covariance = Mat3::from_diagonal(Vec3::splat(FLOOR));
            for (v, s) in samples.iter().zip(shares) {
                let d = *v - mean;
                covariance += Mat3::from_cols(d * d.x, d * d.y, d * d.z) * (s[c] / weight);
            }
            let share = weight / samples.len() as f32;
            let log_scale = share.ln() - 0.5 * ((std::f32::consts::TAU).powi(3) * covariance.determinant()).ln();
            Some(Component { mean, inverse: covariance.inverse(), log_scale })
        });
        Self(components.collect())
    }

    fn logs(&self, color: Vec3) -> impl Iterator<Item = f32> {
        self.0.iter().map(move |c| {
            let d = color - c.mean;
            c.log_scale - 0.5 * d.dot(c.inverse * d)
        })
    }

    fn shares(&self, color: Vec3) -> Vec<f32> {
        let most = self.logs(color).fold(f32::NEG_INFINITY, f32::max);
        let mut shares: Vec<f32> = self.logs(color).map(|l| (l - most).exp()).collect();
        let sum: f32 = shares.iter().sum();
        shares.iter_mut().for_each(|s| *s /= sum);
        shares
    }

    /// Logarithm of the density at a color.
    pub fn log_density(&self, color: Vec3) -> f32 {
        let most = self.logs(color).fold(f32::NEG_INFINITY, f32::max);
        most + self.logs(color).map(|l| (l - most).exp()).sum::<f32>().ln()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_heaps_are_found() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut heap = |center: Vec3, spread: f32, count: usize| -> Vec<Vec3> {
            let mut noise = || (0..12).map(|_| rng.random::<f32>()).sum::<f32>() - 6.0;
            (0..count).map(|_| center + spread * Vec3::new(noise(), noise(), noise())).collect()
        };
        let (a, b) = (Vec3::new(20.0, 5.0, -3.0), Vec3::new(80.0, -20.0, 30.0));
        let samples = [heap(a, 3.0, 3000), heap(b, 6.0, 1000)].concat();
        let mixture = Mixture::fit(&samples, 2, 0).unwrap();
        // The densities at the heaps' middles, from their weights and variances (with the floor).
        let log = |weight: f32, variance: f32| weight.ln() - 1.5 * (std::f32::consts::TAU * (variance + FLOOR)).ln();
        assert!((mixture.log_density(a) - log(0.75, 9.0)).abs() < 0.1);
        assert!((mixture.log_density(b) - log(0.25, 36.0)).abs() < 0.2);
        assert!(mixture.log_density(Vec3::new(50.0, 0.0, 100.0)) < -30.0);
        assert!(Mixture::fit(&[], 3, 0).is_none());
        // Fewer colors than components.
        assert!(Mixture::fit(&[a; 3], 5, 0).unwrap().log_density(a).is_finite());
    }
}
