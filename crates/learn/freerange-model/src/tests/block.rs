//! The fused block against its readable version.

use burn::{
    module::{Module, ModuleVisitor, Param},
    tensor::{Device, Gradients, Tensor},
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use super::{assert_close, devices, half_devices, numbers};
use crate::{
    Compute, ModelConfig, ModelError,
    dit::{Block, Parts},
    layers::{Builder, Init, Source},
};

/// Weights that leave nothing at zero.
struct Noise(ChaCha8Rng);

impl Noise {
    fn tensor<const D: usize>(&mut self, shape: [usize; D], device: &Device) -> Tensor<D> {
        let values: Vec<f32> = (0..shape.iter().product()).map(|_| self.0.sample(StandardNormal)).collect();
        Tensor::from_data(burn::tensor::TensorData::new(values, shape), device)
    }
}

impl Source for Noise {
    fn values(&mut self, _: &str, shape: &[usize], init: Init) -> Result<Vec<f32>, ModelError> {
        let middle = if matches!(init, Init::Ones) { 1.0 } else { 0.0 };
        Ok((0..shape.iter().product()).map(|_| middle + 0.2 * self.0.sample::<f32, _>(StandardNormal)).collect())
    }
}

#[derive(Clone, Copy)]
enum Way {
    Whole { compute: Compute, recompute: bool },
    Parts(fn() -> Parts),
}

const PLAIN: Way = Way::Whole { compute: Compute::F32, recompute: false };
const RECOMPUTED: Way = Way::Whole { compute: Compute::F32, recompute: true };

/// The gradient of every weight.
struct Collect<'a>(&'a Gradients, Vec<Vec<f32>>);

impl ModuleVisitor for Collect<'_> {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.1.push(numbers(param.val().grad(self.0).expect("every weight has a gradient")));
    }
}

/// Output and all gradients of a block of the last `queries` of `tokens` tokens.
fn run(device: &Device, way: Way, batch: usize, tokens: usize, queries: usize) -> Vec<Vec<f32>> {
    let device = device.clone().autodiff();
    let mut noise = Noise(ChaCha8Rng::seed_from_u64(5));
    let config = ModelConfig { hidden: 24, heads: 3, ffn: Some(36), ..ModelConfig::default() };
    let block = Block::build(&config, "block", &mut Builder { source: &mut noise, device: &device }).unwrap();
    let x = noise.tensor([batch, tokens, 24], &device).require_grad();
    let c = noise.tensor([batch, 24], &device).require_grad();
    let out = match way {
        Way::Whole { compute, recompute } => block.forward(x.clone(), c.clone(), queries, compute, recompute),
        Way::Parts(parts) => block.forward_by_parts(x.clone(), c.clone(), queries, &parts()),
    };
    let loss = noise.tensor(out.dims(), &device);
    let gradients = (out.clone() * loss).sum().backward();
    let mut collect = Collect(&gradients, Vec::new());
    block.visit(&mut collect);
    let inputs = [numbers(x.grad(&gradients).unwrap()), numbers(c.grad(&gradients).unwrap())];
    [vec![numbers(out)], inputs.to_vec(), collect.1].concat()
}

const SIZES: [[usize; 3]; 3] = [[1, 9, 9], [2, 70, 70], [3, 33, 8]];

#[test]
fn on_the_cpu_a_block_is_its_parts_to_the_bit() {
    for [batch, tokens, queries] in SIZES {
        let whole = run(&Device::flex(), PLAIN, batch, tokens, queries);
        assert!(whole.len() == 15 && whole.iter().all(|g| g.iter().any(|&x| x != 0.0)));
        assert_eq!(whole, run(&Device::flex(), Way::Parts(Parts::fused), batch, tokens, queries));
        assert_eq!(whole, run(&Device::flex(), RECOMPUTED, batch, tokens, queries));
    }
}

fn close(name: &str, found: &[Vec<f32>], truth: &[Vec<f32>], tolerance: f32) {
    assert_eq!(found.len(), truth.len());
    for (i, (found, truth)) in found.iter().zip(truth).enumerate() {
        assert_close(&format!("{name}, {i}"), found, truth, tolerance);
    }
}

#[test]
fn a_block_is_the_same_on_every_device() {
    for [batch, tokens, queries] in SIZES {
        let truth = run(&Device::flex(), Way::Parts(Parts::readable), batch, tokens, queries);
        for device in devices() {
            let plain = run(&device, PLAIN, batch, tokens, queries);
            close(&format!("{device:?}"), &plain, &truth, 2e-5);
            close("recomputed", &run(&device, RECOMPUTED, batch, tokens, queries), &plain, 1e-6);
        }
        for (device, compute) in half_devices() {
            let tolerance = if compute == Compute::F16 { 1e-2 } else { 6e-2 };
            for recompute in [false, true] {
                let found = run(&device, Way::Whole { compute, recompute }, batch, tokens, queries);
                close(&format!("{device:?} in {compute:?}"), &found, &truth, tolerance);
            }
        }
    }
}
