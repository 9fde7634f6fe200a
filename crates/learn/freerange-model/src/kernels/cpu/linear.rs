//! Matrix products, and the linear layer as products that start from the bias.

use burn::backend::flex::FlexTensor;
use gemm::Parallelism;
use multiversion::multiversion;
use rayon::prelude::*;

#[cfg(target_arch = "x86_64")]
use super::tiles;
use super::{
    contiguous, dims, math,
    matrix::{Matrix, matmul},
    tensor, values,
};

/// Below this many multiplications, starting threads costs more than it saves.
fn parallelism(shape: [usize; 3]) -> Parallelism {
    if shape.iter().product::<usize>() < 1 << 20 { Parallelism::None } else { Parallelism::Rayon(0) }
}

/// `bias + a b`, with the bias added to every row; in bf16 where asked for and the CPU can.
fn product(shape @ [m, k, n]: [usize; 3], a: Matrix, b: Matrix, bias: Option<&[f32]>, in_bf16: bool) -> Vec<f32> {
    #[cfg(target_arch = "x86_64")]
    if in_bf16 && tiles::available() {
        return tiles::product(shape, a, b, bias);
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = in_bf16; // no kernel of ours
    if bias.is_none() && k > 0 {
        let mut out = Vec::with_capacity(m * n);
        // SAFETY: `out` has room for m rows of n values, all of which are written.
        unsafe {
            matmul(shape, a, b, 1.0, out.as_mut_ptr(), n, false, parallelism(shape));
            out.set_len(m * n);
        }
        return out;
    }
    let mut out = vec![0f32; m * n];
    if let Some(bias) = bias {
        out.par_chunks_mut(ROWS * n.max(1)).for_each(|piece| {
            piece.chunks_exact_mut(n).for_each(|row| row.copy_from_slice(bias));
        });
    }
    // SAFETY: `out` is ours and has m rows of n values.
    unsafe { matmul(shape, a, b, 1.0, out.as_mut_ptr(), n, bias.is_some(), parallelism(shape)) }
    out
}

/// Rows per piece of work; fixed, so that sums do not depend on the number of threads.
pub const ROWS: usize = 32;

pub fn forward(x: FlexTensor, w: FlexTensor, b: FlexTensor, bf16: bool) -> FlexTensor {
    let (x, w, b) = (contiguous(x), contiguous(w), contiguous(b));
    let [outputs, inputs] = dims(&w);
    let mut shape = x.layout().shape().to_vec();
    assert_eq!(shape.last(), Some(&inputs), "linear: input width");
    let rows = values(&x).len() / inputs;
    let weight = Matrix::rows(values(&w), inputs).transposed();
    let x = Matrix::rows(values(&x), inputs);
    let out = product([rows, inputs, outputs], x, weight, Some(values(&b)), bf16);
    if let Some(last) = shape.last_mut() {
        *last = outputs;
    }
    tensor(out, &shape)
}

pub fn backward(
    x: FlexTensor,
    w: FlexTensor,
    grad: FlexTensor,
    need_x: bool,
    bf16: bool,
) -> (Option<FlexTensor>, FlexTensor) {
    let (x, w, grad) = (contiguous(x), contiguous(w), contiguous(grad));
    let [outputs, inputs] = dims(&w);
    let rows = values(&x).len() / inputs;
    let g = Matrix::rows(values(&grad), outputs);
    let dx = need_x.then(|| {
        let dx = product([rows, outputs, inputs], g, Matrix::rows(values(&w), inputs), None, bf16);
        tensor(dx, &x.layout().shape().to_vec())
    });
    let dw = product([outputs, rows, inputs], g.transposed(), Matrix::rows(values(&x), inputs), None, bf16);
    (dx, tensor(dw, &[outputs, inputs]))
}

/// The gradient of a bias: sums over the rows of `[..., width]`.
pub fn bias(grad: &FlexTensor) -> FlexTensor {
    #[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
    fn sums(rows: &[f32], width: usize) -> Vec<f32> {
        let mut sums = vec![0f32; width];
        rows.chunks_exact(width).for_each(|row| math::add(&mut sums, row));
        sums
    }
    let grad = contiguous(grad.clone());
    let shape = grad.layout().shape().to_vec();
    let [.., tokens, width] = shape[..] else { panic!("a linear layer's result has two axes or more") };
    // The same pieces as of the pointwise operations, so that their sums are the same to the bit.
    let pieces: Vec<Vec<f32>> = values(&grad)
        .par_chunks((tokens * width).max(1))
        .flat_map(|rows| rows.par_chunks(ROWS * width))
        .map(|rows| sums(rows, width))
        .collect();
    let mut total = vec![0f32; width];
    pieces.iter().for_each(|piece| math::add(&mut total, piece));
    tensor(total, &[width])
}
