//! How fast the rasterizer is. `cargo bench -p freerange-raster --bench raster -- [FILTER] [--threads N]`.
//!
//! The scene: Gaussians as a fitted object has them, flat and small, tiling a bumpy surface of radius 0.5, seen from 1.5
//! away with a field of view of 49 degrees. FILTER keeps rows whose name contains it, such as `n=2048` or `px=64`.
//! A pair is a Gaussian and a pixel at which its opacity is at least 1/255.

use freerange_raster::{CHANNELS, RasterConfig, reference, render, render_backward};
use freerange_scene::camera::Camera;
use glam::{DQuat, DVec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::time::{Duration, Instant};

#[path = "../../../../tools/machine.rs"]
mod machine;

/// `n` Gaussians on the surface, `[n, 14]`.
fn scene(n: usize) -> Vec<f32> {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let spacing = (std::f64::consts::PI / n as f64).sqrt(); // of n points on a sphere of radius 0.5
    let mut rows = Vec::with_capacity(n * CHANNELS);
    for i in 0..n {
        // A Fibonacci lattice, jittered, with bumps.
        let z = 1.0 - 2.0 * (i as f64 + 0.5) / n as f64;
        let phi = i as f64 * std::f64::consts::PI * (3.0 - 5f64.sqrt()) + rng.random_range(-0.3..0.3) * spacing;
        let normal = DVec3::new((1.0 - z * z).sqrt() * phi.cos(), (1.0 - z * z).sqrt() * phi.sin(), z);
        let mean = normal * (0.45 + 0.05 * (7.0 * normal.x).sin() * (5.0 * normal.y).cos());
        let spin = DQuat::from_axis_angle(normal, rng.random_range(0.0..6.0));
        let q = spin * DQuat::from_rotation_arc(DVec3::Z, normal);
        rows.extend(mean.to_array().map(|v| v as f32));
        for flat in [1.0, 1.0, 0.1] {
            rows.push((spacing * flat * rng.random_range(0.4..0.8f64)).ln() as f32);
        }
        rows.extend([q.w, q.x, q.y, q.z].map(|v| v as f32));
        rows.push(rng.random_range(-1.0..4.0));
        rows.extend([0.0; 3].map(|_: f32| rng.random_range(0.0..1.0)));
    }
    rows
}

fn cameras(views: usize, size: u32) -> Vec<Camera> {
    (0..views)
        .map(|i| {
            let eye = DQuat::from_rotation_z(i as f64 * 1.7) * DVec3::new(1.4, 0.0, 0.54);
            Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 49f64.to_radians(), size, size)
        })
        .collect()
}

/// Time of a call: the fastest tenth, since other programs may be running.
fn time(mut f: impl FnMut()) -> Duration {
    f();
    let (start, mut times) = (Instant::now(), vec![]);
    while times.len() < 5 || (times.len() < 2000 && start.elapsed() < Duration::from_millis(600)) {
        let t = Instant::now();
        f();
        times.push(t.elapsed());
    }
    times.sort();
    times[times.len() / 10]
}

fn main() {
    let (mut filter, mut args) = (String::new(), std::env::args().skip(1));
    while let Some(arg) = args.next() {
        if arg == "--threads" {
            let count = args.next().and_then(|v| v.parse().ok()).expect("--threads needs a number");
            rayon::ThreadPoolBuilder::new().num_threads(count).build_global().expect("first use of the pool");
        } else if arg != "--bench" {
            filter = arg;
        }
    }
    println!("{}", machine::machine(rayon::current_num_threads()));
    println!("{:32} {:>9} {:>9} {:>14} {:>14}", "", "fwd ms", "both ms", "fwd Mpair/s/c", "both Mpair/s/c");
    let config = RasterConfig::default();
    for n in [512, 1024, 2048, 8192, 50_000] {
        let gaussians = scene(n);
        for px in [64, 128, 224, 512] {
            for views in [1, 4] {
                let name = format!("n={n} px={px} views={views}");
                if !name.contains(&filter) {
                    continue;
                }
                let cameras = cameras(views, px);
                let backgrounds = vec![[1.0; 3]; views];
                let pairs: usize = cameras.iter().map(|c| reference::count_pairs(&gaussians, c, &config)).sum();
                let render = || render(&gaussians, &cameras, &backgrounds, &config).expect("a valid scene");
                let out = render();
                let d_rgb = vec![1e-3; out.rgb.len()];
                let d_alpha = vec![1e-3; out.alpha.len()];
                let forward = time(|| drop(render()));
                let both = time(|| drop(render_backward(&gaussians, &render(), &d_rgb, &d_alpha, &[])));
                let rate = |t: Duration| pairs as f64 / t.as_secs_f64() / rayon::current_num_threads() as f64 * 1e-6;
                println!(
                    "{name:32} {:9.3} {:9.3} {:14.1} {:14.1}",
                    forward.as_secs_f64() * 1e3,
                    both.as_secs_f64() * 1e3,
                    rate(forward),
                    rate(both)
                );
            }
        }
    }
}
