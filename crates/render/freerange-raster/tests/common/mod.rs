//! Random scenes for the tests.
#![allow(dead_code)] // each test file uses its own part

use freerange_raster::CHANNELS;
use freerange_scene::camera::Camera;
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

/// A camera 1.5 from the origin, turned by `turn` radians around it, whose principal point is off center.
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

/// Values that break careless code.
pub const POISON: [f32; 23] = [
    f32::NAN,
    f32::INFINITY,
    f32::NEG_INFINITY,
    f32::MAX,
    f32::MIN,
    f32::MIN_POSITIVE,
    1e-45,
    0.0,
    -0.0,
    1e30,
    -1e30,
    1e20,
    1e10,
    -1e10,
    1e5,
    88.0,
    60.0,
    40.0,
    20.0,
    -20.0,
    -88.0,
    -1e5,
    1e-20,
];

/// The feature says which device the tests of the GPU path run on. They fail if there is none.
#[cfg(any(feature = "cuda", feature = "metal", feature = "vulkan", feature = "webgpu"))]
pub fn gpu() -> burn::tensor::Device {
    use burn::tensor::Device;
    #[cfg(feature = "cuda")]
    return Device::cuda(0);
    #[cfg(not(feature = "cuda"))]
    return Device::wgpu(burn::tensor::DeviceKind::DefaultDevice);
}

/// `[objects, n, 14]` on a device.
#[cfg(feature = "op")]
pub fn tensor(objects: &[Vec<f32>], device: &burn::tensor::Device) -> burn::tensor::Tensor<3> {
    let n = objects[0].len() / CHANNELS;
    let data = burn::tensor::TensorData::new(objects.concat(), [objects.len(), n, CHANNELS]);
    burn::tensor::Tensor::from_data(data, device)
}

/// A tensor's elements in row-major order.
#[cfg(feature = "op")]
pub fn floats<const D: usize>(tensor: burn::tensor::Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec::<f32>().unwrap()
}

/// An image as the operation returns it, and the gradient of its sum weighted with [`noise`], from the plain functions.
pub fn on_cpu(objects: &[Vec<f32>], cameras: &[Vec<Camera>], backgrounds: &[Vec<[f32; 3]>]) -> [Vec<f32>; 2] {
    let (mut image, mut grads) = (vec![], vec![]);
    for ((rows, cameras), backgrounds) in objects.iter().zip(cameras).zip(backgrounds) {
        let out = freerange_raster::render(rows, cameras, backgrounds, &Default::default()).unwrap();
        let start = image.len();
        image.extend(out.rgb.chunks(3).zip(&out.alpha).flat_map(|(c, a)| [c[0], c[1], c[2], *a]));
        let weights = &noise(WEIGHTS, image.len())[start..];
        let d_rgb: Vec<f32> = weights.chunks(4).flat_map(|w| w[..3].to_vec()).collect();
        let d_alpha: Vec<f32> = weights.chunks(4).map(|w| w[3]).collect();
        grads.extend(freerange_raster::render_backward(rows, &out, &d_rgb, &d_alpha, &[]).unwrap().gaussians);
    }
    [image, grads]
}

/// Seed of the weights of the pixels.
pub const WEIGHTS: u64 = 77;

/// Asserts that images and gradients, as [`on_cpu`] returns them, are those of two implementations of the same formulas:
/// equal up to rounding, but for the few pixels where rounding decides whether a splat is drawn.
pub fn assert_same([image, grads]: &[Vec<f32>; 2], expected: &[Vec<f32>; 2]) {
    assert_eq!((image.len(), grads.len()), (expected[0].len(), expected[1].len()));
    let compare = |found: &mut dyn Iterator<Item = (f32, f32)>, limit: f32| {
        let (mut worst, mut many, mut count) = (0f32, 0, 0);
        for (f, e) in found {
            let error = if f.is_finite() { (f - e).abs() } else { f32::INFINITY };
            worst = worst.max(error);
            many += usize::from(error > limit);
            count += 1;
        }
        (worst, many, count)
    };
    let (worst, many, count) = compare(&mut image.iter().copied().zip(expected[0].iter().copied()), 2e-5);
    println!("image: largest difference {worst:.1e}, {many} of {count} above 2e-5");
    assert!(worst < 0.02 && many * 500 <= count, "image: {worst:e}, {many} of {count}");
    for channels in [0..3, 3..6, 6..10, 10..11, 11..14] {
        let pick = |values: &[f32]| -> Vec<f32> {
            values.chunks(CHANNELS).flat_map(|row| row[channels.clone()].to_vec()).collect()
        };
        let (found, expected) = (pick(grads), pick(&expected[1]));
        let largest = expected.iter().fold(0.0, |m: f32, v| m.max(v.abs()));
        let (worst, many, count) = compare(&mut found.into_iter().zip(expected), 1e-4 * largest);
        println!("gradient of {channels:?}: {:.1e} of the largest, {many} of {count} above 1e-4", worst / largest);
        assert!(
            worst <= 0.01 * largest && many * 100 <= count,
            "{channels:?}: {worst:e} of {largest:e}, {many} of {count}"
        );
    }
}
