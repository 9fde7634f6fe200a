//! Time of one transformer block, forward and backward, on the CPU, and of its matrix products alone.
//!
//! `cargo run --release -p freerange-model --example block_timing [batch tokens width heads]`

use std::{hint::black_box, time::Instant};

use burn::tensor::{Device, Distribution, Tensor};
use freerange_model::{Compute, EncoderConfig, FreeRange, ModelConfig, PatchConfig};
use rand::SeedableRng;

/// Median of several runs, in milliseconds.
fn median(mut f: impl FnMut()) -> f64 {
    (0..3).for_each(|_| f());
    let mut times: Vec<f64> = (0..15)
        .map(|_| {
            let start = Instant::now();
            f();
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

fn main() {
    let arguments: Vec<usize> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let [b, t, d, heads] = arguments.try_into().unwrap_or([8, 300, 256, 4]);
    let device = Device::flex();
    let tracked = device.clone().autodiff();
    let time = |blocks: usize, gradient: bool, compute: Compute| {
        let config = ModelConfig {
            image_size: 32,
            encoder: EncoderConfig::Patch(PatchConfig::default()),
            hidden: d,
            blocks,
            heads,
            registers: 0,
            gaussians_per_token: 1,
            gradient_channels: false,
            ..ModelConfig::default()
        };
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let place = if gradient { &tracked } else { &device };
        let model = FreeRange::new(&config, &mut rng, place).expect("a valid configuration").with_compute(compute);
        let z = Tensor::<3>::random([b, t, 14], Distribution::Default, place);
        let images = Tensor::<3>::zeros([b, 0, config.image_token_width()], place);
        let time = Tensor::<1>::random([b], Distribution::Default, place);
        median(|| {
            let out = model.denoise(z.clone(), None, images.clone(), time.clone());
            if gradient {
                black_box(out.square().mean().backward());
            } else {
                black_box(out.into_data());
            }
        })
    };
    // The difference between five blocks and one leaves embedding and output out.
    let per_block = |gradient, compute| (time(5, gradient, compute) - time(1, gradient, compute)) / 4.0;
    let (forward, both) = (per_block(false, Compute::F32), per_block(true, Compute::F32));
    let (forward_bf16, both_bf16) = (per_block(false, Compute::Bf16), per_block(true, Compute::Bf16));

    let random = |shape: [usize; 2]| Tensor::<2>::random(shape, Distribution::Default, &device);
    let product = |m: usize, k: usize, n: usize| {
        let (x, y) = (random([m, k]), random([k, n]));
        median(|| {
            black_box(x.clone().matmul(y.clone()));
        })
    };
    let rows = b * t;
    let f = 4 * d;
    let shapes = [[d, 3 * d], [d, d], [d, 2 * f], [f, d]];
    let linear_forward: f64 = shapes.iter().map(|&[k, n]| product(rows, k, n)).sum();
    let linear_backward: f64 = shapes.iter().map(|&[k, n]| product(rows, n, k) + product(k, rows, n)).sum();
    let (x, y) = (
        Tensor::<3>::random([b * heads, t, d / heads], Distribution::Default, &device),
        Tensor::<3>::random([b * heads, d / heads, t], Distribution::Default, &device),
    );
    let scores = median(|| {
        black_box(x.clone().matmul(y.clone()));
    });
    let products = linear_forward + linear_backward + 7.0 * scores;
    println!("batch {b}, {t} tokens, width {d}, {heads} heads, {} threads", rayon::current_num_threads());
    let forward_products = linear_forward + 2.0 * scores;
    println!("one block forward            {forward:8.1} ms (products alone {forward_products:.1})");
    let share = 100.0 * products / both;
    println!("one block forward + backward {both:8.1} ms (products alone {products:.1}: {share:.0} %)");
    println!("in bf16: forward {forward_bf16:.1} ms, forward + backward {both_bf16:.1} ms");
}
