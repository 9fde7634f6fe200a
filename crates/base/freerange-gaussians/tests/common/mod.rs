//! An object without any symmetry, and how near two clouds are.
#![allow(dead_code, reason = "each test uses a part")]

use freerange_gaussians::{Gaussians, channel};
use glam::DQuat;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Three arms of different lengths and colors along +x, +y and +z, of Gaussians of all shapes.
pub fn object(n: usize) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut cloud = Gaussians::default();
    for i in 0..n {
        let arm = i % 3;
        let along = rng.random_range(0.0..[0.45f32, 0.3, 0.2][arm]);
        let mut row: [f32; channel::COUNT] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
        row[channel::MEAN].iter_mut().for_each(|v| *v *= 0.02);
        row[arm] += along;
        row[channel::LOG_SCALE].iter_mut().for_each(|v| *v -= 4.5);
        row[channel::LOGIT_OPACITY] = 2.0 + 3.0 * row[channel::LOGIT_OPACITY];
        for (k, v) in row[channel::COLOR].iter_mut().enumerate() {
            *v = if k == arm { 0.9 } else { 0.15 } + 0.1 * *v;
        }
        cloud.push(&row);
    }
    cloud.canonicalize_rotations();
    cloud
}

/// The largest differences of two clouds' Gaussians, one by one.
#[derive(Debug)]
pub struct Difference {
    pub mean: f64,
    pub log_scale: f64,
    /// Angle in radians.
    pub rotation: f64,
    pub opacity: f64,
    pub color: f64,
}

pub fn difference(a: &Gaussians, b: &Gaussians) -> Difference {
    assert_eq!(a.len(), b.len());
    let most = |f: &dyn Fn(usize) -> f64| (0..a.len()).map(f).fold(0.0, f64::max);
    Difference {
        mean: most(&|i| (a.mean(i) - b.mean(i)).abs().max_element()),
        log_scale: most(&|i| (a.scale(i).map(f64::ln) - b.scale(i).map(f64::ln)).abs().max_element()),
        rotation: most(&|i| angle(a.rotation(i), b.rotation(i))),
        opacity: most(&|i| (a.opacity(i) - b.opacity(i)).abs()),
        color: most(&|i| (a.color(i) - b.color(i)).abs().max_element()),
    }
}

/// Of the rotation between two orientations, of which half turns about a Gaussian's own axes change nothing. 2 asin is
/// exact for small ones, where acos is not.
fn angle(a: DQuat, b: DQuat) -> f64 {
    let d = (a.inverse() * b).to_array();
    let largest = d.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
    2.0 * (d.iter().map(|v| v * v).sum::<f64>() - largest * largest).max(0.0).sqrt().min(1.0).asin()
}

impl Difference {
    pub fn assert_within(&self, mean: f64, log_scale: f64, rotation: f64, opacity: f64, color: f64) {
        let ok = self.mean <= mean
            && self.log_scale <= log_scale
            && self.rotation <= rotation
            && self.opacity <= opacity
            && self.color <= color;
        assert!(ok, "{self:?}");
    }
}
