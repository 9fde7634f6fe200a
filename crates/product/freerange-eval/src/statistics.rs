//! Means, and how far they can be trusted.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// Resamples of every bootstrap here.
pub const RESAMPLES: usize = 10_000;

/// A mean and the interval in which it would lie 95 times of 100 if other objects of the same kind had been drawn.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// The mean.
    pub mean: f64,
    /// Lower end: the 2.5 % quantile of the resampled means.
    pub low: f64,
    /// Upper end: the 97.5 % quantile.
    pub high: f64,
}

/// The mean of `values`; `None` of no values.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The standard deviation with `n - 1` in the denominator; `None` of fewer than two values.
pub fn deviation(values: &[f64]) -> Option<f64> {
    let mean = mean(values).filter(|_| values.len() > 1)?;
    let sum: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
    Some((sum / (values.len() - 1) as f64).sqrt())
}

/// The value below which the share `q` of the sorted values lies, linear between neighbors. `sorted` is not empty.
pub fn quantile(sorted: &[f64], q: f64) -> f64 {
    let at = q.clamp(0.0, 1.0) * (sorted.len() - 1) as f64;
    let (low, high) = (at.floor() as usize, at.ceil() as usize);
    sorted[low] + (at - low as f64) * (sorted[high] - sorted[low])
}

/// The mean of `values` with the percentile interval of [`RESAMPLES`] resamples with replacement (Efron 1979); `None` of
/// no values. The same values and seed give the same interval.
pub fn bootstrap(values: &[f64], seed: u64) -> Option<Interval> {
    let center = mean(values)?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let n = values.len();
    let mut means: Vec<f64> =
        (0..RESAMPLES).map(|_| (0..n).map(|_| values[rng.random_range(0..n)]).sum::<f64>() / n as f64).collect();
    means.sort_unstable_by(f64::total_cmp);
    Some(Interval { mean: center, low: quantile(&means, 0.025), high: quantile(&means, 0.975) })
}

#[cfg(test)]
mod tests {
    use rand_distr_free::normal;

    use super::*;

    /// Normal values by the sum of twelve uniform ones: enough for these tests, and no further dependency.
    mod rand_distr_free {
        use rand::Rng;
        pub fn normal(rng: &mut impl Rng) -> f64 {
            (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0
        }
    }

    #[test]
    fn quantiles_means_and_deviations_of_known_values() {
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.5), 2.0);
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.75), 3.0);
        assert_eq!(quantile(&[5.0], 0.3), 5.0);
        assert_eq!(mean(&[]), None);
        assert_eq!(deviation(&[1.0]), None);
        assert!((deviation(&[1.0, 2.0, 3.0, 4.0]).unwrap() - (5.0f64 / 3.0).sqrt()).abs() < 1e-12);
    }

    /// Resampled means of n values have the standard deviation s / sqrt(n), s with n in the denominator, and are nearly
    /// normal: 1.96 of those on either side.
    #[test]
    fn the_interval_agrees_with_the_closed_form() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let values: Vec<f64> = (0..400).map(|_| 20.0 + 3.0 * normal(&mut rng)).collect();
        let interval = bootstrap(&values, 7).unwrap();
        let n = values.len() as f64;
        let half = 1.96 * deviation(&values).unwrap() * ((n - 1.0) / n).sqrt() / n.sqrt();
        assert!((interval.mean - mean(&values).unwrap()).abs() < 1e-12);
        for (found, expected) in [(interval.low, interval.mean - half), (interval.high, interval.mean + half)] {
            assert!((found - expected).abs() < 0.05 * half, "{found} {expected}");
        }
        assert_eq!(bootstrap(&values, 7), Some(interval));
        assert_ne!(bootstrap(&values, 8), Some(interval));
    }

    /// Two values: the resampled mean is either of them with probability 1/4 each, so both ends are reached.
    #[test]
    fn two_values_one_value_and_none() {
        assert_eq!(bootstrap(&[1.0, 3.0], 0), Some(Interval { mean: 2.0, low: 1.0, high: 3.0 }));
        assert_eq!(bootstrap(&[1.5], 0), Some(Interval { mean: 1.5, low: 1.5, high: 1.5 }));
        assert_eq!(bootstrap(&[], 0), None);
    }
}
