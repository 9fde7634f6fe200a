//! Random scenes for the tests.
#![allow(dead_code)] // each test file uses its own part

use freerange_camera::Camera;
use freerange_raster::CHANNELS;
use glam::DVec3;
use rand::{Rng, SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;

/// `n` Gaussians of all shapes around the origin, `[n, 14]`. Seen by [`camera`] with `turn` 0, no two are nearly equally
/// far away, so that the depth order is the same in f32 and f64.
pub fn scene(seed: u64, n: usize) -> Vec<f32> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut depths: Vec<usize> = (0..n).collect();
    depths.shuffle(&mut rng);
    let mut rows = Vec::with_capacity(n * CHANNELS);
    for depth in depths {
        let along = (depth as f32 + 0.5) / n as f32 * 1.4 - 0.7; // the camera looks along x
        rows.extend([along, rng.random_range(-0.6..0.6), rng.random_range(-0.6..0.6)]);
        rows.extend([0; 3].map(|_| rng.random_range(-5.0..-1.8f32)));
        rows.extend([0; 4].map(|_| rng.random_range(-1.0..1.0f32)));
        rows.push(rng.random_range(-3.0..5.0));
        rows.extend([0; 3].map(|_| rng.random_range(-0.2..1.2f32)));
    }
    rows
}

/// A camera 1.5 from the origin, turned by `turn` radians around it, whose principal point is off centre.
pub fn camera(turn: f64, width: u32, height: u32) -> Camera {
    let eye = DVec3::new(-1.5 * turn.cos(), -1.5 * turn.sin(), 0.0);
    let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.855, width, height);
    Camera { cx: camera.cx + 1.7, cy: camera.cy - 0.6, fy: 1.1 * camera.fy, ..camera }
}

/// `n` numbers from -1 to 1.
pub fn noise(seed: u64, n: usize) -> Vec<f32> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    (0..n).map(|_| rng.random_range(-1.0..1.0)).collect()
}
