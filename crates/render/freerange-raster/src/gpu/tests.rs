//! All ways to go through the kernels give the same. What they give: `tests/gpu.rs`.

#[path = "../../tests/common/mod.rs"]
mod common;

use crate::job::{Job, Tuning};
use crate::{RasterConfig, op};
use burn::backend::Dispatch;
use burn::tensor::{Device, Tensor, TensorData};
use common::{WEIGHTS, assert_same, camera, floats, gpu, noise, on_cpu, scene, tensor};
use op::RasterOps;
use std::sync::Arc;

/// Image and gradient, as `on_cpu` returns them, of 3 objects from 2 views, through `tuning` and by the CPU.
fn compare(n: usize, tuning: Tuning) {
    println!("{tuning:?}");
    let device = gpu().autodiff();
    let objects = [1, 2, 3].map(|seed| scene(seed, n));
    let cameras: Vec<_> = (0..3).map(|i| [0.0, 1.3].map(|turn| camera(turn + f64::from(i), 37, 29)).to_vec()).collect();
    let backgrounds = vec![vec![[1.0, 0.5, 0.0], [0.2; 3]]; 3];
    let leaf = tensor(&objects, &device).require_grad();
    let image = op::run(leaf.clone(), &cameras, &backgrounds, &RasterConfig::default(), tuning).unwrap();
    let weights = TensorData::new(noise(WEIGHTS, image.dims().iter().product()), image.dims());
    let grads = (image.clone() * Tensor::from_data(weights, &device)).sum().backward();
    let found = [floats(image), floats(leaf.grad(&grads).unwrap())];
    assert_same(&found, &on_cpu(&objects, &cameras, &backgrounds));
}

#[test]
fn devices_that_cannot_add_floats_atomically() {
    compare(300, Tuning { float_atomics: false, ..Tuning::default() });
}

#[test]
fn small_blocks_are_merged() {
    for sort_block in [2, 8, 64] {
        compare(130, Tuning { sort_block, ..Tuning::default() });
    }
}

#[test]
fn images_in_groups() {
    // One image at a time, and groups that end within an object.
    let image_bytes = 4 * (200 * 24 + 6 * 7);
    for images in [0, 1, 4, 5] {
        compare(200, Tuning { group_bytes: images * image_bytes, ..Tuning::default() });
    }
}

#[test]
fn grids_wrap_where_an_axis_is_full() {
    // 36 tiles take 3 layers.
    compare(130, Tuning { grid_limit: 4, sort_block: 8, ..Tuning::default() });
}

#[test]
fn the_gradient_without_a_forward_pass_before() {
    let (width, height) = (20, 30);
    let job = Arc::new(Job {
        objects: 1,
        views: 1,
        width,
        height,
        cameras: vec![camera(0.0, width as u32, height as u32)],
        backgrounds: vec![[0.5; 3]],
        config: RasterConfig::default(),
        tuning: Tuning::default(),
    });
    let run = |device: Device| {
        let d_image = Tensor::<5>::ones([1, 1, height, width, 4], &device);
        let gaussians = tensor(&[scene(1, 50)], &device);
        let [gaussians, d_image] = [gaussians.into_dispatch(), d_image.into_dispatch()];
        let grads = Dispatch::rasterize_backward(gaussians, d_image, job.clone(), Default::default());
        [vec![], floats(Tensor::<3>::from_dispatch(grads))]
    };
    assert_same(&run(gpu()), &run(Device::flex()));
}
