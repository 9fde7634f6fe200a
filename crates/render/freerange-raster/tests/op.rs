//! The operation on tensors: shapes, gradients through Burn's autodiff, errors.

mod common;

use burn::tensor::{Device, Tensor, TensorData};
use common::{camera, floats, noise, scene};
use freerange_raster::{CHANNELS, RasterConfig, RasterError, rasterize, render, render_backward};
use freerange_scene::camera::Camera;

const W: u32 = 26;
const H: u32 = 21;

fn views() -> (Vec<Vec<Camera>>, Vec<Vec<[f32; 3]>>) {
    let cameras = [[0.0, 0.9], [0.3, 2.0]].map(|turns| turns.map(|t| camera(t, W, H)).to_vec()).to_vec();
    (cameras, vec![vec![[1.0; 3], [0.0, 0.5, 1.0]], vec![[0.3; 3], [0.1, 0.2, 0.3]]])
}

#[test]
fn equals_the_plain_function_on_every_object() {
    let (n, config, (cameras, backgrounds)) = (30, RasterConfig::default(), views());
    let objects = [scene(1, n), scene(2, n)];
    for device in [Device::flex(), Device::flex().autodiff()] {
        let data = TensorData::new(objects.concat(), [2, n, CHANNELS]);
        let image = rasterize(Tensor::from_data(data, &device), &cameras, &backgrounds, &config).unwrap();
        assert_eq!(image.dims(), [2, 2, H as usize, W as usize, 4]);
        let image = floats(image);
        for (o, gaussians) in objects.iter().enumerate() {
            let out = render(gaussians, &cameras[o], &backgrounds[o], &config).unwrap();
            let expected: Vec<f32> =
                out.rgb.chunks(3).zip(&out.alpha).flat_map(|(c, a)| [c[0], c[1], c[2], *a]).collect();
            assert_eq!(image[o * expected.len()..(o + 1) * expected.len()], expected);
        }
    }
}

#[test]
fn gradient_equals_the_plain_function_also_of_permuted_and_shared_tensors() {
    let (n, config, (cameras, backgrounds)) = (30, RasterConfig::default(), views());
    let objects = [scene(1, n), scene(2, n)];
    let device = Device::flex().autodiff();
    let weights = noise(3, 2 * 2 * (W * H) as usize * 4);
    let shape = [2, 2, H as usize, W as usize, 4];
    let w = Tensor::<5>::from_data(TensorData::new(weights.clone(), shape), &device);

    // The leaf holds the channels first; the operation sees a permuted view of it.
    let data = TensorData::new(objects.concat(), [2, n, CHANNELS]);
    let leaf = Tensor::<3>::from_data(data, &device).swap_dims(1, 2).detach().require_grad();
    let image = rasterize(leaf.clone().swap_dims(1, 2), &cameras, &backgrounds, &config).unwrap();
    let grads = (image * w).sum().backward();
    let found = floats(leaf.grad(&grads).unwrap().swap_dims(1, 2));

    let mut expected = vec![];
    for (o, gaussians) in objects.iter().enumerate() {
        let out = render(gaussians, &cameras[o], &backgrounds[o], &config).unwrap();
        let weights = &weights[o * weights.len() / 2..(o + 1) * weights.len() / 2];
        let d_rgb: Vec<f32> = weights.chunks(4).flat_map(|p| p[..3].to_vec()).collect();
        let d_alpha: Vec<f32> = weights.chunks(4).map(|p| p[3]).collect();
        expected.extend(render_backward(gaussians, &out, &d_rgb, &d_alpha, &[]).unwrap().gaussians);
    }
    assert_eq!(found, expected);
    assert!(found.iter().any(|v| *v != 0.0));
}

#[test]
fn gradient_equals_finite_differences() {
    // All 14 channels of every Gaussian. Each covers the image with more than 1/255 and lets light through: finite
    // differences would see the jumps at the ends of either range.
    let (n, config) = (6, RasterConfig::default());
    let (cameras, backgrounds) = (vec![vec![camera(0.0, W, H), camera(0.4, W, H)]], vec![vec![[0.2, 0.4, 0.6]; 2]]);
    let mut rows = scene(5, n);
    for row in rows.chunks_mut(CHANNELS) {
        row[3..6].iter_mut().for_each(|v| *v = -0.15 * (v.abs() - 1.8)); // wide
        row[10] = row[10].clamp(-1.0, 1.0);
    }
    let weights = noise(6, 2 * (W * H) as usize * 4);
    let device = Device::flex().autodiff();
    let tensor = |rows: &[f32]| Tensor::<3>::from_data(TensorData::new(rows.to_vec(), [1, n, CHANNELS]), &device);
    let w = Tensor::<5>::from_data(TensorData::new(weights.clone(), [1, 2, H as usize, W as usize, 4]), &device);
    let leaf = tensor(&rows).require_grad();
    let image = rasterize(leaf.clone(), &cameras, &backgrounds, &config).unwrap();
    let grads = (image * w).sum().backward();
    let gradient = floats(leaf.grad(&grads).unwrap());

    let loss = |rows: &[f32]| -> f64 {
        let image = floats(rasterize(tensor(rows), &cameras, &backgrounds, &config).unwrap());
        image.iter().zip(&weights).map(|(v, w)| f64::from(*v) * f64::from(*w)).sum()
    };
    let largest: Vec<f32> =
        (0..CHANNELS).map(|c| gradient.chunks(CHANNELS).fold(0.0, |m: f32, row| m.max(row[c].abs()))).collect();
    for i in 0..n * CHANNELS {
        let step = if i % CHANNELS < 3 { 2e-3 } else { 1e-2 };
        let moved = |by: f32| {
            let mut rows = rows.clone();
            rows[i] += by;
            loss(&rows)
        };
        let difference = (moved(step) - moved(-step)) / f64::from(2.0 * step);
        let error = (difference - f64::from(gradient[i])).abs();
        let channel = i % CHANNELS;
        let limit = 0.002 * f64::from(largest[channel]) + 2e-3;
        assert!(error < limit, "Gaussian {}, channel {channel}: {} but {difference}", i / CHANNELS, gradient[i]);
    }
}

#[test]
fn what_does_not_fit_is_an_error() {
    let (config, (cameras, backgrounds), device) = (RasterConfig::default(), views(), Device::flex());
    let zeros = |shape: [usize; 3]| Tensor::<3>::zeros(shape, &device);
    let fails = |shape, cameras: &[Vec<Camera>], backgrounds: &[Vec<[f32; 3]>]| {
        rasterize(zeros(shape), cameras, backgrounds, &config).unwrap_err()
    };
    assert!(matches!(fails([2, 5, 13], &cameras, &backgrounds), RasterError::Shape { .. }));
    assert!(matches!(fails([3, 5, 14], &cameras, &backgrounds), RasterError::Shape { .. }));
    assert!(matches!(fails([2, 5, 14], &cameras, &backgrounds[1..]), RasterError::Length { .. }));
    let uneven = vec![cameras[0].clone(), cameras[1][..1].to_vec()];
    assert!(matches!(fails([2, 5, 14], &uneven, &backgrounds), RasterError::Length { .. }));
    let half = zeros([2, 5, 14]).cast(burn::tensor::DType::F16);
    let error = rasterize(half, &cameras, &backgrounds, &config).unwrap_err();
    assert!(matches!(error, RasterError::DataType { .. }), "{error}");
}
