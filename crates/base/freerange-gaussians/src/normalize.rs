//! Per-channel normalization, and the streaming statistics it comes from.

use crate::{Gaussians, SplatError, channel};

/// Smallest standard deviation a channel is divided by: one that varies less counts as constant, and must not blow
/// rounding errors up.
pub const STD_FLOOR: f32 = 1e-4;

/// Mean and standard deviation of every channel over the training set; travels inside checkpoints.
/// Deserializing refuses values that cannot be divided by.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(try_from = "Unchecked")]
pub struct Normalization {
    /// Mean, channel by channel.
    pub mean: [f32; channel::COUNT],
    /// Standard deviation, channel by channel; positive.
    pub std: [f32; channel::COUNT],
}

#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Unchecked {
    mean: [f32; channel::COUNT],
    std: [f32; channel::COUNT],
}

impl TryFrom<Unchecked> for Normalization {
    type Error = SplatError;

    fn try_from(u: Unchecked) -> Result<Self, SplatError> {
        Self::new(u.mean, u.std)
    }
}

impl Normalization {
    /// From given statistics.
    ///
    /// # Errors
    /// [`SplatError::Normalization`] where a mean is not finite, or a standard deviation not finite and positive.
    pub fn new(mean: [f32; channel::COUNT], std: [f32; channel::COUNT]) -> Result<Self, SplatError> {
        let error = |field, channel: usize, expected, found| SplatError::Normalization {
            field,
            channel,
            name: channel::NAMES[channel],
            expected,
            found,
        };
        for c in 0..channel::COUNT {
            if !mean[c].is_finite() {
                return Err(error("mean", c, "a finite number", mean[c]));
            }
            // A subnormal would make the quotient infinite.
            if !(std[c].is_normal() && std[c] > 0.0) {
                return Err(error("std", c, "a finite, positive number", std[c]));
            }
        }
        Ok(Self { mean, std })
    }

    /// Normalized channels, `(x - mean) / std`, row-major `[n, 14]`.
    pub fn normalize(&self, cloud: &Gaussians) -> Vec<f32> {
        let mut rows = cloud.rows().to_vec();
        for row in rows.as_chunks_mut::<{ channel::COUNT }>().0 {
            for c in 0..channel::COUNT {
                row[c] = (row[c] - self.mean[c]) / self.std[c];
            }
        }
        rows
    }

    /// The cloud of normalized channels, `z * std + mean`; `rows` is row-major `[n, 14]`. Quaternions come out as they
    /// are: see [`Gaussians::canonicalize_rotations`].
    ///
    /// # Panics
    /// If the length of `rows` is no multiple of 14.
    pub fn denormalize(&self, rows: &[f32]) -> Gaussians {
        let mut cloud = Gaussians::from_rows(rows.to_vec());
        for row in cloud.iter_mut() {
            for c in 0..channel::COUNT {
                row[c] = row[c] * self.std[c] + self.mean[c];
            }
        }
        cloud
    }
}

/// Running count, mean and sum of squared deviations of every channel, in f64 (Welford 1962). Accumulators of
/// different parts of a data set can be [merged](Self::merge) (Chan, Golub and LeVeque 1979).
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Statistics {
    count: u64,
    mean: [f64; channel::COUNT],
    /// Sum of squared deviations from the mean.
    m2: [f64; channel::COUNT],
}

impl Statistics {
    /// Gaussians seen so far.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Adds every Gaussian of `cloud`.
    ///
    /// # Errors
    /// [`SplatError::Value`] where a channel is not finite; nothing is added then.
    pub fn add(&mut self, cloud: &Gaussians) -> Result<(), SplatError> {
        cloud.check_finite()?;
        for row in cloud {
            self.count += 1;
            let share = 1.0 / self.count as f64;
            for c in 0..channel::COUNT {
                let before = f64::from(row[c]) - self.mean[c];
                self.mean[c] += before * share;
                self.m2[c] += before * (f64::from(row[c]) - self.mean[c]);
            }
        }
        Ok(())
    }

    /// Adds everything that `other` has seen.
    pub fn merge(&mut self, other: &Self) {
        if other.count == 0 {
            return;
        }
        let count = self.count + other.count;
        let share = other.count as f64 / count as f64;
        for c in 0..channel::COUNT {
            let apart = other.mean[c] - self.mean[c];
            self.mean[c] += apart * share;
            self.m2[c] += other.m2[c] + apart * apart * share * self.count as f64;
        }
        self.count = count;
    }

    /// Mean and population standard deviation, the latter at least [`STD_FLOOR`].
    ///
    /// # Errors
    /// [`SplatError::Empty`] if nothing was added; [`SplatError::Normalization`] if the values overflow f32.
    pub fn normalization(&self) -> Result<Normalization, SplatError> {
        if self.count == 0 {
            return Err(SplatError::Empty);
        }
        let std = self.m2.map(|m2| ((m2 / self.count as f64).sqrt() as f32).max(STD_FLOOR));
        Normalization::new(self.mean.map(|m| m as f32), std)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn cloud(values: &[f32]) -> Gaussians {
        Gaussians::from_rows(values[..values.len() / channel::COUNT * channel::COUNT].to_vec())
    }

    proptest! {
        #[test]
        fn statistics_are_those_of_two_passes(values in prop::collection::vec(-1e3f32..1e3, 28..1400), cut in 0.0..1.0) {
            let whole = cloud(&values);
            let at = (whole.len() as f64 * cut) as usize;
            let (mut a, mut b) = (Statistics::default(), Statistics::default());
            a.add(&whole.select(0..at)).unwrap();
            b.add(&whole.select(at..whole.len())).unwrap();
            a.merge(&b);
            let found = a.normalization().unwrap();
            let n = whole.len() as f64;
            prop_assert_eq!(a.count(), whole.len() as u64);
            for c in 0..channel::COUNT {
                let mean = whole.iter().map(|r| f64::from(r[c])).sum::<f64>() / n;
                let std = (whole.iter().map(|r| (f64::from(r[c]) - mean).powi(2)).sum::<f64>() / n).sqrt();
                prop_assert!((f64::from(found.mean[c]) - mean).abs() < 1e-4);
                prop_assert!((f64::from(found.std[c]) - std).abs() < 1e-4 + 1e-6 * std);
            }
            let back = found.denormalize(&found.normalize(&whole));
            for (x, y) in whole.rows().iter().zip(back.rows()) {
                prop_assert!((x - y).abs() < 1e-3);
            }
        }
    }

    #[test]
    fn far_from_zero_the_variance_survives() {
        let values: Vec<f32> = (0..1000).flat_map(|i| [1e6 + (i % 2) as f32; channel::COUNT]).collect();
        let mut s = Statistics::default();
        s.add(&Gaussians::from_rows(values)).unwrap();
        assert!((s.normalization().unwrap().std[0] - 0.5).abs() < 1e-6);
    }

    #[test]
    fn constant_channels_and_bad_input() {
        let mut s = Statistics::default();
        assert!(matches!(s.normalization(), Err(SplatError::Empty)));
        s.add(&Gaussians::from_rows(vec![3.0; 5 * channel::COUNT])).unwrap();
        let n = s.normalization().unwrap();
        assert_eq!((n.mean[4], n.std[4]), (3.0, STD_FLOOR));
        assert!(n.normalize(&Gaussians::from_rows(vec![3.0; channel::COUNT])).iter().all(|v| *v == 0.0));
        let before = s.clone();
        assert!(s.add(&Gaussians::from_rows(vec![f32::INFINITY; channel::COUNT])).is_err());
        assert_eq!(s, before);
        assert!(Normalization::new([0.0; 14], [0.0; 14]).is_err());
        assert!(Normalization::new([f32::NAN; 14], [1.0; 14]).is_err());
    }

    #[test]
    fn checkpoints_with_unusable_statistics_are_refused() {
        let good = Normalization::new([0.5; 14], [2.0; 14]).unwrap();
        let json = serde_json::to_string(&good).unwrap();
        assert_eq!(serde_json::from_str::<Normalization>(&json).unwrap(), good);
        let error = serde_json::from_str::<Normalization>(&json.replace("2.0", "0.0")).unwrap_err();
        assert!(error.to_string().contains("std"), "{error}");
    }
}
