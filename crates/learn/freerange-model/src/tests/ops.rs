//! The fused operations against their readable versions.

use burn::tensor::{Device, FloatDType, Gradients, Tensor, TensorData};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use super::{assert_close, devices, half_devices, numbers};
use crate::{Compute, ops};

/// The same random numbers on every device.
struct Random(ChaCha8Rng, Device);

impl Random {
    fn new(device: &Device) -> Self {
        Self(ChaCha8Rng::seed_from_u64(7), device.clone().autodiff())
    }

    fn tensor<const D: usize>(&mut self, shape: [usize; D]) -> Tensor<D> {
        let n: usize = shape.iter().product();
        let values: Vec<f32> = (0..n).map(|_| self.0.sample(StandardNormal)).collect();
        Tensor::from_data(TensorData::new(values, shape), &self.1).require_grad()
    }
}

/// How the operation under test is computed.
#[derive(Clone, Copy, PartialEq)]
enum Way {
    /// Readable, on the CPU, in f32.
    Readable,
    /// Fused.
    Fused(Compute),
}

impl Way {
    fn compute(self) -> Compute {
        match self {
            Self::Readable => Compute::F32,
            Self::Fused(compute) => compute,
        }
    }

    /// As activations are on the device.
    fn activation<const D: usize>(self, t: Tensor<D>) -> Tensor<D> {
        ops::activation(t, self.compute())
    }
}

/// Output, and gradients of what `gradients` picks under a random loss.
fn results<const D: usize>(
    r: &mut Random,
    out: Tensor<D>,
    gradients: impl Fn(&Gradients) -> Vec<Vec<f32>>,
) -> Vec<Vec<f32>> {
    let out = out.cast(FloatDType::F32);
    let loss = r.tensor(out.dims()).detach();
    let found = numbers(out.clone());
    [vec![found], gradients(&(out * loss).sum().backward())].concat()
}

/// Holds output and gradients of the fused operation to the readable one, on every device and, where it has it, in
/// half precision.
fn check(name: &str, run: impl Fn(&mut Random, Way) -> Vec<Vec<f32>>) {
    let truth = run(&mut Random::new(&Device::flex()), Way::Readable);
    let compare = |device: &Device, compute: Compute, tolerances: [f32; 2]| {
        let found = run(&mut Random::new(device), Way::Fused(compute));
        assert_eq!(found.len(), truth.len());
        for (i, (found, truth)) in found.iter().zip(&truth).enumerate() {
            let what = format!("{name} on {device:?} in {compute:?}, {i}");
            // Of one token a gradient is nothing but what rounding leaves, which is each device's own.
            match truth.iter().all(|v| v.abs() < 1e-12) {
                true => {
                    assert!(found.len() == truth.len() && found.iter().all(|v| v.abs() < 1e-6), "{what}: {found:?}")
                }
                false => assert_close(&what, found, truth, tolerances[i.min(1)]),
            }
        }
    };
    for device in devices() {
        compare(&device, Compute::F32, [4e-6, 1e-5]);
    }
    for (device, compute) in half_devices() {
        let rounding = if compute == Compute::F16 { 4e-3 } else { 3e-2 };
        compare(&device, compute, [rounding, 2.0 * rounding]);
    }
}

fn grad<const D: usize>(t: &Tensor<D>, g: &Gradients) -> Vec<f32> {
    numbers(t.grad(g).unwrap())
}

#[test]
fn linear() {
    for [rows, inputs, outputs] in [[1, 1, 1], [3, 5, 7], [130, 33, 65], [300, 100, 90]] {
        check("linear", |r, way| {
            let (x, w, b) = (r.tensor([2, rows, inputs]), r.tensor([outputs, inputs]), r.tensor([outputs]));
            let linear = if way == Way::Readable { ops::reference::linear } else { ops::linear };
            let out = linear(x.clone(), w.clone(), b.clone(), way.compute());
            results(r, out, |g| vec![grad(&x, g), grad(&w, g), grad(&b, g)])
        });
    }
}

/// Numbers that bf16 holds exactly, so that rounding operands changes nothing: the CPU's f32 path is the truth.
#[test]
fn linear_in_bf16() {
    let mut r = Random::new(&Device::flex());
    for [rows, inputs, outputs] in [[1, 1, 1], [3, 5, 7], [12, 32, 16], [131, 33, 65], [97, 1100, 90], [300, 513, 33]] {
        let mut coarse = |shape: [usize; 2]| (r.tensor(shape) * 16.0).round().div_scalar(16.0).detach();
        let (x, w) = (coarse([rows, inputs]).require_grad(), coarse([outputs, inputs]).require_grad());
        let loss = coarse([rows, outputs]);
        let b = r.tensor([outputs]);
        let [fast, exact] = [Compute::Bf16, Compute::F32].map(|compute| {
            let out = ops::linear(x.clone(), w.clone(), b.clone(), compute);
            let g = (out.clone() * loss.clone()).sum().backward();
            [numbers(out), grad(&x, &g), grad(&w, &g), grad(&b, &g)]
        });
        for (fast, exact) in fast.iter().zip(&exact) {
            assert_close("bf16", fast, exact, 1e-5);
        }
    }
    // In general it is off by the rounding of operands, and so is the readable twin.
    let (x, w, b) = (r.tensor([50, 300]), r.tensor([40, 300]), r.tensor([40]));
    let exact = numbers(ops::linear(x.clone(), w.clone(), b.clone(), Compute::F32));
    for linear in [ops::linear, ops::reference::linear] {
        assert_close("rounded", &numbers(linear(x.clone(), w.clone(), b.clone(), Compute::Bf16)), &exact, 1e-2);
    }
}

#[test]
fn modulated_norm() {
    for shape @ [b, _, d] in [[1, 1, 3], [2, 33, 16], [3, 70, 37], [1, 5, 1100]] {
        check("norm", |r, way| {
            let (x, m) = (r.tensor(shape), r.tensor([b, 2 * d]));
            let part = |i: usize| m.clone().narrow(1, i * d, d);
            let out = match way {
                Way::Readable => ops::reference::modulated_norm(x.clone(), part(0), part(1)),
                Way::Fused(compute) => ops::modulated_norm(x.clone(), part(0), part(1), compute),
            };
            results(r, out, |g| vec![grad(&x, g), grad(&m, g)])
        });
    }
}

#[test]
fn gated_add() {
    for shape @ [b, _, d] in [[1, 1, 3], [2, 33, 16], [3, 70, 37], [1, 5, 1100]] {
        check("gate", |r, way| {
            let (x, y, gate) = (r.tensor(shape), r.tensor(shape), r.tensor([b, d]));
            let gated = if way == Way::Readable { ops::reference::gated_add } else { ops::gated_add };
            let out = gated(x.clone(), gate.clone(), way.activation(y.clone()));
            results(r, out, |g| vec![grad(&x, g), grad(&gate, g), grad(&y, g)])
        });
    }
}

#[test]
fn geglu() {
    for [b, t, f] in [[2, 5, 3], [2, 33, 19], [1, 100, 64]] {
        check("geglu", |r, way| {
            let x = (r.tensor([b, t, 2 * f]) * 3.0).detach().require_grad();
            let geglu = if way == Way::Readable { ops::reference::geglu } else { ops::geglu };
            let out = geglu(way.activation(x.clone()));
            results(r, out, |g| vec![grad(&x, g)])
        });
    }
}

#[test]
fn attention() {
    for [b, t, heads, width, queries] in
        [[1, 1, 1, 4, 1], [2, 7, 3, 5, 7], [2, 131, 2, 16, 131], [1, 200, 4, 8, 70], [1, 64, 2, 64, 1]]
    {
        let d = heads * width;
        check("attention", |r, way| {
            let (qkv, wq, wk) = (r.tensor([b, t, 3 * d]), r.tensor([width]), r.tensor([width]));
            let (x, wq_, wk_) = (way.activation(qkv.clone()), wq.clone(), wk.clone());
            let out = match way {
                Way::Readable => ops::reference::attention(x, wq_, wk_, heads, queries),
                Way::Fused(compute) => ops::attention(x, wq_, wk_, heads, queries, compute),
            };
            results(r, out, |g| vec![grad(&qkv, g), grad(&wq, g), grad(&wk, g)])
        });
    }
}

#[test]
fn attention_without_norms() {
    for [b, t, heads, width] in [[1, 1, 1, 4], [2, 67, 3, 5], [1, 130, 2, 32]] {
        check("plain attention", |r, way| {
            let qkv = r.tensor([b, t, 3 * heads * width]);
            let x = way.activation(qkv.clone());
            let out = match way {
                Way::Readable => ops::reference::plain_attention(x, heads),
                Way::Fused(compute) => ops::plain_attention(x, heads, compute),
            };
            results(r, out, |g| vec![grad(&qkv, g)])
        });
    }
}

/// On the CPU, where operands of products are rounded; in f32 if it cannot.
#[test]
fn attention_in_bf16() {
    for [b, t, heads, width, queries] in
        [[2, 7, 3, 5, 7], [2, 131, 2, 16, 131], [1, 200, 4, 64, 70], [1, 96, 2, 40, 1], [1, 408, 1, 64, 408]]
    {
        let run = |compute: Option<Compute>| {
            let mut r = Random::new(&Device::flex());
            let (qkv, wq, wk) = (r.tensor([b, t, 3 * heads * width]), r.tensor([width]), r.tensor([width]));
            let out = match compute {
                None => ops::reference::attention(qkv.clone(), wq.clone(), wk.clone(), heads, queries),
                Some(compute) => ops::attention(qkv.clone(), wq.clone(), wk.clone(), heads, queries, compute),
            };
            results(&mut r, out, |g| vec![grad(&qkv, g), grad(&wq, g), grad(&wk, g)])
        };
        for (found, truth) in run(Some(Compute::Bf16)).iter().zip(&run(None)) {
            assert_close(&format!("{t} tokens, {width} wide"), found, truth, 1.5e-2);
        }
    }
}

/// Where nothing needs a gradient, attention may be another kernel.
#[test]
fn attention_without_gradients() {
    for [b, t, heads, width, queries] in
        [[1, 7, 3, 5, 7], [2, 131, 2, 16, 131], [1, 200, 2, 64, 70], [2, 64, 2, 32, 64]]
    {
        let inputs = |device: &Device| {
            let mut r = Random::new(device);
            let qkv = r.tensor([b, t, 3 * heads * width]);
            (qkv.inner(), r.tensor([width]).inner(), r.tensor([width]).inner())
        };
        let (qkv, wq, wk) = inputs(&Device::flex());
        let truth = numbers(ops::reference::attention(qkv, wq, wk, heads, queries));
        let all = devices().into_iter().map(|device| (device, Compute::F32)).chain(half_devices());
        for (device, compute) in all {
            let (qkv, wq, wk) = inputs(&device);
            let found = numbers(ops::attention(ops::activation(qkv, compute), wq, wk, heads, queries, compute));
            let tolerance = if compute == Compute::F32 { 1e-5 } else { 3e-2 };
            assert_close(&format!("{width} wide on {device:?} in {compute:?}"), &found, &truth, tolerance);
        }
    }
}

#[test]
fn attention_survives_extreme_scores() {
    for device in devices() {
        let mut r = Random::new(&device);
        let (qkv, w) = (r.tensor([1, 65, 48]), Tensor::<1>::full([16], 1e4, &r.1));
        let w = w.require_grad();
        let out = ops::attention(qkv.clone(), w.clone(), w.clone(), 1, 65, Compute::F32);
        let gradients = out.clone().sum().backward();
        assert!(numbers(out).iter().all(|x| x.is_finite()));
        assert!(grad(&qkv, &gradients).iter().all(|x| x.is_finite()));
    }
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let run = || {
        let mut r = Random::new(&Device::flex());
        let x = r.tensor([3, 150, 32]);
        let (w, b) = (r.tensor([96, 32]), r.tensor([96]));
        let (wq, wk) = (r.tensor([8]), r.tensor([8]));
        let (shift, scale) = (r.tensor([3, 32]), r.tensor([3, 32]));
        let y = ops::modulated_norm(x.clone(), shift.clone(), scale, Compute::Bf16);
        let y = ops::attention(ops::linear(y, w.clone(), b, Compute::Bf16), wq.clone(), wk, 4, 150, Compute::Bf16);
        let y = ops::geglu(ops::gated_add(x.clone(), shift.clone(), y));
        let g = (y.clone() * y).sum().backward();
        [grad(&x, &g), grad(&w, &g), grad(&wq, &g), grad(&shift, &g)].concat()
    };
    let pool = |n: usize| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
    let one = pool(1).install(run);
    for threads in [2, 5] {
        assert_eq!(pool(threads).install(run), one, "{threads} threads");
    }
}
