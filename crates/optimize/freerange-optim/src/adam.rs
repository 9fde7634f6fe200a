//! Adam on the flat rows of a cloud (Kingma and Ba 2015).

use crate::Rates;
use freerange_gaussians::channel;
use rayon::prelude::*;

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
/// As in 3DGS: practically none, so that Gaussians with tiny gradients move as fast as others.
const EPSILON: f32 = 1e-15;

/// One rate per channel.
pub(crate) type ChannelRates = [f32; channel::COUNT];

impl Rates {
    /// The rate of every channel, `mean` being that of the centers.
    pub(crate) fn by_channel(&self, mean: f64) -> ChannelRates {
        let mut out = [0.0; channel::COUNT];
        out[channel::MEAN].fill(mean as f32);
        out[channel::LOG_SCALE].fill(self.scale as f32);
        out[channel::ROTATION].fill(self.rotation as f32);
        out[channel::LOGIT_OPACITY] = self.opacity as f32;
        out[channel::COLOR].fill(self.color as f32);
        out
    }
}

/// After so many numbers, whole Gaussians and whole vectors begin together.
const PERIOD: usize = 8 * channel::COUNT;

/// One step of numbers that start with a Gaussian. Products and sums are not fused, so that all machines agree.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn update(
    rows: &mut [f32],
    gradients: &[f32],
    first: &mut [f32],
    second: &mut [f32],
    rates: &[f32; PERIOD],
    correction: f32,
) {
    let blocks = rows.chunks_mut(PERIOD).zip(gradients.chunks(PERIOD));
    for ((x, g), (m, v)) in blocks.zip(first.chunks_mut(PERIOD).zip(second.chunks_mut(PERIOD))) {
        let n = x.len();
        let (x, g, m, v, rates) = (&mut x[..n], &g[..n], &mut m[..n], &mut v[..n], &rates[..n]);
        for i in 0..n {
            m[i] += (1.0 - BETA1) * (g[i] - m[i]);
            v[i] += (1.0 - BETA2) * (g[i] * g[i] - v[i]);
            x[i] -= rates[i] * m[i] / (v[i].sqrt() / correction + EPSILON);
        }
    }
}

/// The optimizer's state: first and second moments of the gradients.
#[derive(Default)]
pub(crate) struct Adam {
    first: Vec<f32>,  // [n, 14]
    second: Vec<f32>, // [n, 14]
    steps: i32,
}

impl Adam {
    /// Changes `rows` by one step along `gradients`, both `[n, 14]`. Rows beyond those of the last call start at rest.
    pub fn step(&mut self, rows: &mut [f32], gradients: &[f32], rates: &ChannelRates) {
        self.steps = self.steps.saturating_add(1);
        self.first.resize(rows.len(), 0.0);
        self.second.resize(rows.len(), 0.0);
        let correction1 = (1.0 - f64::from(BETA1).powi(self.steps)) as f32;
        let correction2 = (1.0 - f64::from(BETA2).powi(self.steps)).sqrt() as f32;
        let rates = rates.map(|r| r / correction1);
        let rates: [f32; PERIOD] = std::array::from_fn(|i| rates[i % channel::COUNT]);
        const TASK: usize = 128 * PERIOD;
        rows.par_chunks_mut(TASK)
            .zip(gradients.par_chunks(TASK))
            .zip(self.first.par_chunks_mut(TASK))
            .zip(self.second.par_chunks_mut(TASK))
            .for_each(|(((rows, gradients), first), second)| {
                update(rows, gradients, first, second, &rates, correction2);
            });
    }

    /// Forgets the moments of Gaussian `i`.
    pub fn forget(&mut self, i: usize) {
        for moments in [&mut self.first, &mut self.second] {
            if let Some(row) = moments.get_mut(i * channel::COUNT..(i + 1) * channel::COUNT) {
                row.fill(0.0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rates() -> ChannelRates {
        let r = Rates { mean: 1.0, scale: 2.0, rotation: 3.0, opacity: 4.0, color: 5.0 };
        r.by_channel(r.mean)
    }

    #[test]
    fn rates_reach_their_channels() {
        assert_eq!(rates(), [1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 3.0, 3.0, 3.0, 3.0, 4.0, 5.0, 5.0, 5.0]);
    }

    #[test]
    fn two_steps_by_hand() {
        let mut adam = Adam::default();
        let mut x = vec![1.0; channel::COUNT];
        let (g1, g2) = (0.5f64, -0.2f64);
        adam.step(&mut x, &[g1 as f32; channel::COUNT], &rates());
        // The corrected moments are g and g^2: a step of the rate's size, against the gradient's sign.
        for (x, r) in x.iter().zip(rates()) {
            assert!((x - (1.0 - r)).abs() < 1e-5, "{x} {r}");
        }
        adam.step(&mut x, &[g2 as f32; channel::COUNT], &rates());
        let m = (0.9 * 0.1 * g1 + 0.1 * g2) / (1.0 - 0.81);
        let v = (0.999 * 0.001 * g1 * g1 + 0.001 * g2 * g2) / (1.0 - 0.999f64 * 0.999);
        for (x, r) in x.iter().zip(rates()) {
            let expected = 1.0 - f64::from(r) * (1.0 + m / v.sqrt());
            assert!((f64::from(*x) - expected).abs() < 1e-4, "{x} {expected}");
        }
    }

    #[test]
    fn zero_gradients_move_nothing_and_new_rows_start_at_rest() {
        let mut adam = Adam::default();
        let mut x = vec![0.25; channel::COUNT];
        adam.step(&mut x, &[0.0; channel::COUNT], &rates());
        assert_eq!(x, [0.25; channel::COUNT]);
        adam.step(&mut x, &[1.0; channel::COUNT], &rates());
        adam.forget(0);
        adam.forget(7); // beyond the end: nothing to forget
        let before = x.clone();
        x.extend_from_slice(&before);
        adam.step(&mut x, &[0.0; 2 * channel::COUNT], &rates());
        assert_eq!(x[..channel::COUNT], before);
        assert_eq!(x[channel::COUNT..], before);
    }
}
