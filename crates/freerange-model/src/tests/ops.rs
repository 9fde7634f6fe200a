use burn::tensor::{Device, Tensor, TensorData};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use super::{assert_close, numbers};
use crate::{Compute, ops};

struct Random(ChaCha8Rng, Device);

impl Random {
    fn new() -> Self {
        Self(ChaCha8Rng::seed_from_u64(7), Device::flex().autodiff())
    }

    fn tensor<const D: usize>(&mut self, shape: [usize; D]) -> Tensor<D> {
        let n: usize = shape.iter().product();
        let values: Vec<f32> = (0..n).map(|_| self.0.sample(StandardNormal)).collect();
        Tensor::from_data(TensorData::new(values, shape), &self.1).require_grad()
    }
}

/// Same outputs and, under the same loss, same gradients of the inputs that `gradients` picks.
fn compare<const D: usize>(
    name: &str,
    loss: Tensor<D>,
    fused: Tensor<D>,
    readable: Tensor<D>,
    gradients: impl Fn(&burn::tensor::Gradients) -> Vec<Vec<f32>>,
) {
    assert_close(name, &numbers(fused.clone()), &numbers(readable.clone()), 2e-6);
    let a = gradients(&(fused * loss.clone()).sum().backward());
    let b = gradients(&(readable * loss).sum().backward());
    for (i, (a, b)) in a.iter().zip(&b).enumerate() {
        assert_close(&format!("{name}, gradient {i}"), a, b, 1e-5);
    }
}

fn grad<const D: usize>(t: &Tensor<D>, g: &burn::tensor::Gradients) -> Vec<f32> {
    numbers(t.grad(g).unwrap())
}

#[test]
fn linear() {
    let mut r = Random::new();
    for [rows, inputs, outputs] in [[1, 1, 1], [3, 5, 7], [130, 33, 65], [700, 100, 90]] {
        let (x, w, b) = (r.tensor([2, rows, inputs]), r.tensor([outputs, inputs]), r.tensor([outputs]));
        let fused = ops::linear(x.clone(), w.clone(), b.clone(), Compute::F32);
        let readable = ops::reference::linear(x.clone(), w.clone(), b.clone(), Compute::F32);
        compare("linear", r.tensor([2, rows, outputs]), fused, readable, |g| {
            vec![grad(&x, g), grad(&w, g), grad(&b, g)]
        });
    }
}

/// Numbers that bf16 holds exactly, so that rounding operands changes nothing: the CPU's f32 path is the truth.
#[test]
fn linear_in_bf16() {
    let mut r = Random::new();
    for [rows, inputs, outputs] in [[1, 1, 1], [3, 5, 7], [12, 32, 16], [131, 33, 65], [97, 1100, 90], [300, 513, 33]] {
        let mut coarse = |shape: [usize; 2]| (r.tensor(shape) * 16.0).round().div_scalar(16.0).detach();
        let (x, w) = (coarse([rows, inputs]).require_grad(), coarse([outputs, inputs]).require_grad());
        let loss = coarse([rows, outputs]);
        let b = r.tensor([outputs]);
        let fast = ops::linear(x.clone(), w.clone(), b.clone(), Compute::Bf16);
        let exact = ops::linear(x.clone(), w.clone(), b.clone(), Compute::F32);
        compare("bf16", loss, fast, exact, |g| vec![grad(&x, g), grad(&w, g), grad(&b, g)]);
    }
    // In general it is off by the rounding of operands, and so is the readable twin.
    let (x, w, b) = (r.tensor([50, 300]), r.tensor([40, 300]), r.tensor([40]));
    let exact = numbers(ops::linear(x.clone(), w.clone(), b.clone(), Compute::F32));
    for linear in [ops::linear, ops::reference::linear] {
        assert_close("rounded", &numbers(linear(x.clone(), w.clone(), b.clone(), Compute::Bf16)), &exact, 1e-2);
    }
}

#[test]
fn modulated_norm_and_gated_add() {
    let mut r = Random::new();
    for shape @ [b, _, d] in [[1, 1, 3], [2, 33, 16], [3, 70, 37]] {
        let (x, y, shift, scale) = (r.tensor(shape), r.tensor(shape), r.tensor([b, d]), r.tensor([b, d]));
        let fused = ops::modulated_norm(x.clone(), shift.clone(), scale.clone());
        let readable = ops::reference::modulated_norm(x.clone(), shift.clone(), scale.clone());
        compare("norm", r.tensor(shape), fused, readable, |g| vec![grad(&x, g), grad(&shift, g), grad(&scale, g)]);
        let fused = ops::gated_add(x.clone(), shift.clone(), y.clone());
        let readable = ops::reference::gated_add(x.clone(), shift.clone(), y.clone());
        compare("gate", r.tensor(shape), fused, readable, |g| vec![grad(&x, g), grad(&shift, g), grad(&y, g)]);
    }
}

#[test]
fn geglu() {
    let mut r = Random::new();
    for [b, t, f] in [[2, 5, 3], [2, 33, 19], [1, 100, 64]] {
        let x = r.tensor([b, t, 2 * f]);
        let x = (x * 3.0).detach().require_grad();
        let (fused, readable) = (ops::geglu(x.clone()), ops::reference::geglu(x.clone()));
        compare("geglu", r.tensor([b, t, f]), fused, readable, |g| vec![grad(&x, g)]);
    }
}

#[test]
fn attention() {
    let mut r = Random::new();
    for [b, t, heads, width, queries] in
        [[1, 1, 1, 4, 1], [2, 7, 3, 5, 7], [2, 131, 2, 16, 131], [1, 200, 4, 8, 70], [1, 64, 2, 64, 1]]
    {
        let d = heads * width;
        let (qkv, wq, wk) = (r.tensor([b, t, 3 * d]), r.tensor([width]), r.tensor([width]));
        let fused = ops::attention(qkv.clone(), wq.clone(), wk.clone(), heads, queries);
        let readable = ops::reference::attention(qkv.clone(), wq.clone(), wk.clone(), heads, queries);
        let gradients = |g: &burn::tensor::Gradients| vec![grad(&qkv, g), grad(&wq, g), grad(&wk, g)];
        compare("attention", r.tensor([b, queries, d]), fused, readable, gradients);
    }
}

#[test]
fn attention_survives_extreme_scores() {
    let mut r = Random::new();
    let (qkv, w) = (r.tensor([1, 65, 48]), Tensor::<1>::full([16], 1e4, &Device::flex().autodiff()));
    let w = w.require_grad();
    let out = ops::attention(qkv.clone(), w.clone(), w.clone(), 1, 65);
    let gradients = out.clone().sum().backward();
    assert!(numbers(out).iter().all(|x| x.is_finite()));
    assert!(grad(&qkv, &gradients).iter().all(|x| x.is_finite()));
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let run = || {
        let mut r = Random::new();
        let x = r.tensor([3, 150, 32]);
        let (w, b) = (r.tensor([96, 32]), r.tensor([96]));
        let (wq, wk) = (r.tensor([8]), r.tensor([8]));
        let (shift, scale) = (r.tensor([3, 32]), r.tensor([3, 32]));
        let y = ops::modulated_norm(x.clone(), shift.clone(), scale);
        let y = ops::attention(ops::linear(y, w.clone(), b, Compute::Bf16), wq.clone(), wk, 4, 150);
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
