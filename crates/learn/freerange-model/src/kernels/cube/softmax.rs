//! Softmax of a piece of the scores, forward and backward. A cube takes one row.

use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::{self, cube, prelude::*};

use super::{
    address, dims, elem, empty, grid, lanes, line,
    reduce::{across, cube_max, cube_sum, largest},
    units,
};

/// `p = exp(score - largest)`, with 1 / sum and the log of the softmax's denominator.
#[cube(launch_unchecked, address_type = "dynamic")]
fn softmax_kernel<E: Float, N: Size>(
    scores: &Tensor<Vector<f32, N>>, // [pairs, n, tokens]
    p: &mut Tensor<Vector<E, N>>,    // [pairs, n, tokens]
    inverse: &mut Tensor<f32>,       // [pairs, n]
    log_sum: &mut Tensor<f32>,       // [all pairs, queries]
    first_pair: usize,
    first_query: usize,
    queries: usize,
    vectors: usize,
    #[comptime] units: usize,
    #[define(E)] _dtype: ElemType,
) {
    let mut scratch = Shared::<[f32]>::new_slice(units);
    let (query, pair) = (CUBE_POS_X as usize, CUBE_POS_Y as usize);
    let row = pair * CUBE_COUNT_X as usize + query;
    let base = row * vectors;
    let mut top = Vector::<f32, N>::new(-3.0e38f32);
    let mut i = UNIT_POS as usize;
    while i < vectors {
        top = max(top, scores[base + i]);
        i += units;
    }
    let top = cube_max(largest::<N>(top), &mut scratch, units);
    let mut sum = Vector::<f32, N>::new(0.0f32);
    let mut i = UNIT_POS as usize;
    while i < vectors {
        let e = Vector::exp(scores[base + i] - Vector::new(top));
        sum += e;
        p[base + i] = Vector::cast_from(e);
        i += units;
    }
    let sum = cube_sum(across::<N>(sum), &mut scratch, units);
    if UNIT_POS == 0 {
        inverse[row] = 1.0f32 / sum;
        log_sum[(first_pair + pair) * queries + first_query + query] = top + f32::ln(sum);
    }
}

/// Softmax of `scores` `[pairs, n, tokens]` without its division: `p` of the given type, and 1 / sum `[pairs, n]`. The
/// logs of the denominators go to `log_sum` `[all pairs, queries]`, from the given pair and query on.
pub fn softmax(
    scores: CubeTensor,
    log_sum: &CubeTensor,
    first_pair: usize,
    first_query: usize,
    dtype: DType,
) -> (CubeTensor, CubeTensor) {
    let [pairs, n, tokens] = dims(&scores);
    let [_, queries] = dims(log_sum);
    let p = empty(&scores, &[pairs, n, tokens], dtype);
    let inverse = empty(&scores, &[pairs, n], DType::F32);
    let lanes = lanes(&scores, &[DType::F32, dtype], &[tokens]);
    let units = units(&scores, tokens / lanes);
    // SAFETY: units stop at the end of their row; the caller's piece lies within `log_sum`.
    unsafe {
        softmax_kernel::launch_unchecked(
            &scores.client.clone(),
            grid(n, pairs),
            line(units),
            address([&scores, &p, log_sum]),
            lanes,
            scores.into_tensor_arg(),
            p.clone().into_tensor_arg(),
            inverse.clone().into_tensor_arg(),
            log_sum.clone().into_tensor_arg(),
            first_pair,
            first_query,
            queries,
            tokens / lanes,
            units,
            elem(&p),
        );
    }
    (p, inverse)
}

/// `p = exp(score - log_sum)` and `ds = p (dp - delta)`.
#[cube(launch_unchecked, address_type = "dynamic")]
fn softmax_backward_kernel<E: Float, N: Size>(
    scores: &Tensor<Vector<f32, N>>, // [pairs, n, tokens], as the next three
    dp: &Tensor<Vector<f32, N>>,
    p: &mut Tensor<Vector<E, N>>,
    ds: &mut Tensor<Vector<E, N>>,
    log_sum: &Tensor<f32>, // [all pairs, queries]
    delta: &Tensor<f32>,   // [all pairs, queries]
    first_pair: usize,
    first_query: usize,
    queries: usize,
    vectors: usize,
    #[comptime] units: usize,
    #[define(E)] _dtype: ElemType,
) {
    let (query, pair) = (CUBE_POS_X as usize, CUBE_POS_Y as usize);
    let base = (pair * CUBE_COUNT_X as usize + query) * vectors;
    let at = (first_pair + pair) * queries + first_query + query;
    let (log_sum, delta) = (log_sum[at], delta[at]);
    let mut i = UNIT_POS as usize;
    while i < vectors {
        let e = Vector::exp(scores[base + i] - Vector::new(log_sum));
        p[base + i] = Vector::cast_from(e);
        ds[base + i] = Vector::cast_from(e * (dp[base + i] - Vector::new(delta)));
        i += units;
    }
}

/// The probabilities and the gradients of the scores, both of the given type, `[pairs, n, tokens]`.
pub fn softmax_backward(
    scores: CubeTensor,
    dp: CubeTensor,
    log_sum: &CubeTensor,
    delta: &CubeTensor,
    first_pair: usize,
    first_query: usize,
    dtype: DType,
) -> (CubeTensor, CubeTensor) {
    let [pairs, n, tokens] = dims(&scores);
    let [_, queries] = dims(log_sum);
    let [p, ds] = [(); 2].map(|()| empty(&scores, &[pairs, n, tokens], dtype));
    let lanes = lanes(&scores, &[DType::F32, dtype], &[tokens]);
    let units = units(&scores, tokens / lanes);
    // SAFETY: units stop at the end of their row; the caller's piece lies within `log_sum` and `delta`.
    unsafe {
        softmax_backward_kernel::launch_unchecked(
            &scores.client.clone(),
            grid(n, pairs),
            line(units),
            address([&scores, &dp, &p, log_sum]),
            lanes,
            scores.into_tensor_arg(),
            dp.into_tensor_arg(),
            p.clone().into_tensor_arg(),
            ds.clone().into_tensor_arg(),
            log_sum.clone().into_tensor_arg(),
            delta.clone().into_tensor_arg(),
            first_pair,
            first_query,
            queries,
            tokens / lanes,
            units,
            elem(&p),
        );
    }
    (p, ds)
}
