//! The operation on a GPU: golden vectors, and equality with the CPU path. The device is that of the feature that was
//! chosen, `cuda`, or else whatever wgpu finds; without one, the tests fail.
#![cfg(any(feature = "cuda", feature = "metal", feature = "vulkan", feature = "webgpu"))]

mod common;
#[path = "common/golden.rs"]
mod golden;

use burn::tensor::{Device, Tensor, TensorData};
use common::{POISON, WEIGHTS, assert_same, camera, floats, gpu, noise, on_cpu, scene, tensor};
use freerange_raster::{CHANNELS, RasterConfig, rasterize};
use freerange_scene::camera::Camera;
use glam::DMat4;
use golden::{cases, doubles};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Image and gradient as [`on_cpu`] returns them, through Burn's autodiff.
fn on_gpu(objects: &[Vec<f32>], cameras: &[Vec<Camera>], backgrounds: &[Vec<[f32; 3]>]) -> [Vec<f32>; 2] {
    let device = gpu().autodiff();
    let leaf = tensor(objects, &device).require_grad();
    let image = rasterize(leaf.clone(), cameras, backgrounds, &RasterConfig::default()).unwrap();
    let weights = TensorData::new(noise(WEIGHTS, image.dims().iter().product()), image.dims());
    let grads = (image.clone() * Tensor::from_data(weights, &device)).sum().backward();
    [floats(image), floats(leaf.grad(&grads).unwrap())]
}

#[test]
fn matches_golden_vectors() {
    let device = gpu().autodiff();
    for case in cases() {
        let views = case.cameras.len();
        let leaf = tensor(std::slice::from_ref(&case.gaussians), &device).require_grad();
        let backgrounds = [vec![case.background; views]];
        let image = rasterize(leaf.clone(), std::slice::from_ref(&case.cameras), &backgrounds, &case.config).unwrap();
        let (w_rgb, w_alpha) = (case.tensors.floats("loss/w_rgb"), case.tensors.floats("loss/w_alpha"));
        let weights: Vec<f32> =
            w_rgb.chunks(3).zip(w_alpha).flat_map(|(rgb, alpha)| [rgb[0], rgb[1], rgb[2], *alpha]).collect();
        let weights = Tensor::<5>::from_data(TensorData::new(weights, image.dims()), &device);
        let grads = (image.clone() * weights).sum().backward();
        let image = doubles(&floats(image));
        let rgb: Vec<f64> = image.chunks(4).flat_map(|p| p[..3].to_vec()).collect();
        let alpha: Vec<f64> = image.chunks(4).map(|p| p[3]).collect();
        case.compare_image("out/rgb", &rgb, 0.0, 1e-4);
        case.compare_image("out/alpha", &alpha, 0.0, 1e-4);
        case.compare_gradients(&doubles(&floats(leaf.grad(&grads).unwrap())));
    }
}

#[test]
fn equals_the_cpu_on_random_scenes() {
    // (objects, views, Gaussians, width, height): more than a mask word, a batch, a block of the sort; odd sizes.
    let shapes = [
        (1, 1, 1, 1, 1),
        (2, 3, 33, 17, 15),
        (3, 2, 300, 50, 41),
        (1, 2, 2049, 64, 48),
        (1, 1, 5000, 40, 70),
        (5, 7, 64, 16, 16),
    ];
    for (seed, (o, v, n, width, height)) in shapes.into_iter().enumerate() {
        println!("{o} objects, {v} views, {n} Gaussians, {width} x {height}");
        let seed = 100 * seed as u64;
        let objects: Vec<_> = (0..o).map(|i| scene(seed + i, n)).collect();
        let view = |i: u64, j: u64| camera((i * v + j) as f64 * 0.9, width, height);
        let cameras: Vec<Vec<_>> = (0..o).map(|i| (0..v).map(|j| view(i, j)).collect()).collect();
        let backgrounds: Vec<Vec<[f32; 3]>> =
            noise(seed, (3 * o * v) as usize).chunks(3 * v as usize).map(|b| b.as_chunks().0.to_vec()).collect();
        assert_same(&on_gpu(&objects, &cameras, &backgrounds), &on_cpu(&objects, &cameras, &backgrounds));
    }
}

#[test]
fn more_splats_in_a_tile_than_one_round_of_its_mask_holds() {
    // 256 words of 32 Gaussians are one round. Faint ones, so that all of them are seen.
    let mut rows = scene(3, 9000);
    for row in rows.chunks_mut(CHANNELS) {
        row[10] = -4.5;
        row[3..6].iter_mut().for_each(|v| *v -= 0.5);
    }
    let (cameras, backgrounds) = (vec![vec![camera(0.0, 20, 18)]], vec![vec![[0.1, 0.2, 0.3]]]);
    let objects = [rows];
    assert_same(&on_gpu(&objects, &cameras, &backgrounds), &on_cpu(&objects, &cameras, &backgrounds));
}

#[test]
fn equals_are_drawn_in_index_order() {
    // Camera coordinates are world coordinates plus whole numbers: depths are the same to the bit.
    let view =
        Camera { world_to_camera: DMat4::from_translation(glam::DVec3::new(0.0, 0.0, 2.0)), ..camera(0.0, 33, 30) };
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let mut rows = scene(8, 3000);
    for row in rows.chunks_mut(CHANNELS) {
        row[0] = rng.random_range(-0.6..0.6);
        row[2] = 0.25 * rng.random_range(0..4) as f32;
        row[10] = 2.0;
    }
    let (objects, cameras, backgrounds) = ([rows], vec![vec![view]], vec![vec![[0.0; 3]]]);
    assert_same(&on_gpu(&objects, &cameras, &backgrounds), &on_cpu(&objects, &cameras, &backgrounds));
}

#[test]
fn huge_and_thin_splats() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let mut rows = scene(5, 200);
    for (i, row) in rows.chunks_mut(CHANNELS).enumerate() {
        match i % 4 {
            0 => row[3..6].fill(2.0),                 // covers everything
            1 => row[3..6].fill(-12.0),               // a point
            2 => row[3] = rng.random_range(0.0..4.0), // a needle across the image
            _ => {}
        }
        row[10] = rng.random_range(-4.0..0.0);
    }
    let (objects, cameras) = ([rows], vec![vec![camera(0.0, 45, 70), camera(1.0, 45, 70)]]);
    let backgrounds = vec![vec![[0.3, 0.5, 0.7]; 2]];
    assert_same(&on_gpu(&objects, &cameras, &backgrounds), &on_cpu(&objects, &cameras, &backgrounds));
}

#[test]
fn the_same_image_every_time() {
    let (objects, cameras) = ([scene(1, 3000)], vec![vec![camera(0.3, 60, 40)]]);
    let run = || on_gpu(&objects, &cameras, &[vec![[0.5; 3]]]);
    let first = run();
    for _ in 0..3 {
        let again = run();
        assert_eq!(again[0], first[0]);
        assert_same(&again, &first);
    }
}

#[test]
fn nothing_to_draw() {
    let config = RasterConfig::default();
    for device in [gpu(), gpu().autodiff()] {
        let none = Tensor::<3>::zeros([1, 0, CHANNELS], &device);
        let image = rasterize(none, &[vec![camera(0.0, 5, 4)]], &[vec![[0.25, 0.5, 0.75]]], &config).unwrap();
        assert_eq!(floats(image), [0.25, 0.5, 0.75, 0.0].repeat(20));
        let no_view = rasterize(tensor(&[scene(1, 3)], &device), &[vec![]], &[vec![]], &config).unwrap();
        assert_eq!(no_view.dims(), [1, 0, 0, 0, 4]);
    }
    // All behind the camera: there are Gaussians, but no splats.
    let mut behind = scene(1, 40);
    behind.chunks_mut(CHANNELS).for_each(|row| row[0] -= 10.0);
    let [image, grads] = on_gpu(&[behind], &[vec![camera(0.0, 20, 20)]], &[vec![[0.0; 3]]]);
    assert!(image.iter().chain(&grads).all(|v| *v == 0.0));
}

#[test]
fn permuted_gaussians_and_expanded_gradients() {
    let (n, device, config) = (40, gpu().autodiff(), RasterConfig::default());
    let objects = [scene(1, n), scene(2, n)];
    let cameras = vec![vec![camera(0.2, 30, 20)]; 2];
    let backgrounds = vec![vec![[1.0; 3]]; 2];
    // The gradient of a plain sum is one number, expanded.
    let run = |device: &Device| {
        let leaf = tensor(&objects, device).swap_dims(1, 2).detach().require_grad();
        let image = rasterize(leaf.clone().swap_dims(1, 2), &cameras, &backgrounds, &config).unwrap();
        let grads = image.clone().sum().backward();
        [floats(image), floats(leaf.grad(&grads).unwrap().swap_dims(1, 2))]
    };
    assert_same(&run(&device), &run(&Device::flex().autodiff()));
}

#[test]
fn gradient_equals_finite_differences() {
    // As in `op.rs`: each covers the image with more than 1/255 and lets light through.
    let (n, w, h) = (5, 26, 21);
    let cameras = vec![vec![camera(0.0, w, h), camera(0.4, w, h)]];
    let backgrounds = vec![vec![[0.2, 0.4, 0.6]; 2]];
    let mut rows = scene(5, n);
    for row in rows.chunks_mut(CHANNELS) {
        row[3..6].iter_mut().for_each(|v| *v = -0.15 * (v.abs() - 1.8)); // wide
        row[10] = row[10].clamp(-1.0, 1.0);
    }
    let [_, gradient] = on_gpu(&[rows.clone()], &cameras, &backgrounds);
    let device = gpu();
    // All that moves is one batch: each Gaussian's channels, up and down.
    let step = |i: usize| if i % CHANNELS < 3 { 2e-3f32 } else { 1e-2 };
    let moved: Vec<Vec<f32>> = (0..2 * n * CHANNELS)
        .map(|k| {
            let mut rows = rows.clone();
            rows[k / 2] += step(k / 2) * if k % 2 == 0 { 1.0 } else { -1.0 };
            rows
        })
        .collect();
    let count = moved.len();
    let image = rasterize(
        tensor(&moved, &device),
        &vec![cameras[0].clone(); count],
        &vec![backgrounds[0].clone(); count],
        &RasterConfig::default(),
    );
    let image = floats(image.unwrap());
    let weights = noise(WEIGHTS, image.len() / count);
    let losses: Vec<f64> = image
        .chunks(weights.len())
        .map(|image| image.iter().zip(&weights).map(|(v, w)| f64::from(*v) * f64::from(*w)).sum())
        .collect();
    let largest: Vec<f32> =
        (0..CHANNELS).map(|c| gradient.chunks(CHANNELS).fold(0.0, |m: f32, row| m.max(row[c].abs()))).collect();
    for i in 0..n * CHANNELS {
        let difference = (losses[2 * i] - losses[2 * i + 1]) / f64::from(2.0 * step(i));
        let error = (f64::from(gradient[i]) - difference).abs() / f64::from(largest[i % CHANNELS]);
        assert!(
            error < 0.01,
            "channel {} of {}: {}, by differences {difference}",
            i % CHANNELS,
            i / CHANNELS,
            gradient[i]
        );
    }
}

#[test]
fn poison_does_not_spread() {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let (n, o) = (12, 60);
    let (mut poisoned, mut removed) = (vec![], vec![]);
    for seed in 0..o {
        let mut rows = scene(seed, n);
        for _ in 0..rng.random_range(1..20) {
            rows[rng.random_range(0..n * CHANNELS)] = POISON[rng.random_range(0..POISON.len())];
        }
        // Those that are not finite, again, but far behind the camera.
        let mut without = rows.clone();
        for row in without.chunks_mut(CHANNELS).filter(|row| row.iter().any(|v| !v.is_finite())) {
            row.copy_from_slice(&scene(0, 1));
            row[0] = -1e9;
        }
        poisoned.push(rows);
        removed.push(without);
    }
    let cameras = vec![[0.0, 2.0].map(|turn| camera(turn, 19, 18)).to_vec(); o as usize];
    let backgrounds = vec![vec![[0.3; 3]; 2]; o as usize];
    let [image, grads] = on_gpu(&poisoned, &cameras, &backgrounds);
    assert!(image.iter().all(|v| v.is_finite()));
    let rows = poisoned.iter().flat_map(|rows| rows.chunks(CHANNELS));
    for (row, grad) in rows.zip(grads.chunks(CHANNELS)) {
        assert!(grad.iter().all(|v| v.is_finite()), "{row:?} has gradient {grad:?}");
        if row.iter().any(|v| !v.is_finite()) || row[6..10] == [0.0; 4] {
            assert_eq!(*grad, [0.0; CHANNELS], "{row:?}");
        }
    }
    assert_eq!(image, on_gpu(&removed, &cameras, &backgrounds)[0]);
}
