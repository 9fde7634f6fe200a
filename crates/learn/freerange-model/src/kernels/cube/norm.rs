//! Modulated layer norm. A cube takes one row at a time, each unit always the same columns; the backward kernel sums
//! columns on the way.

use burn::tensor::DType;
use burn_cubecl::{kernel::into_contiguous, tensor::CubeTensor};
use cubecl::{self, cube, prelude::*};

use super::{
    ROWS, address, dims, elem, empty, grid, lanes, line, pieces,
    reduce::{across, cube_sum, total},
    spaced, units,
};
use crate::kernels::EPS;

/// A row of `vectors` vectors that starts at `base`, its share of each unit in registers.
#[cube]
fn load<E: Float, N: Size>(
    x: &Tensor<Vector<E, N>>,
    base: usize,
    #[comptime] vectors: usize,
    #[comptime] units: usize,
) -> Array<Vector<f32, N>> {
    let mut row = Array::<Vector<f32, N>>::new(comptime!(vectors.div_ceil(units)));
    #[unroll]
    for i in 0..comptime!(vectors.div_ceil(units)) {
        let column = UNIT_POS as usize + i * units;
        if column < vectors {
            row[i] = Vector::cast_from(x[base + column]);
        }
    }
    row
}

/// Subtracts the mean and returns the reciprocal deviation of a [`load`]ed row.
#[cube]
fn standardise<N: Size>(
    row: &mut Array<Vector<f32, N>>,
    scratch: &mut Shared<[f32]>,
    epsilon: f32,
    #[comptime] vectors: usize,
    #[comptime] units: usize,
) -> f32 {
    let width = f32::cast_from(vectors as u32) * f32::cast_from(N::value() as u32);
    let mut sum = Vector::<f32, N>::new(0.0f32);
    #[unroll]
    for i in 0..comptime!(vectors.div_ceil(units)) {
        sum += row[i];
    }
    let mean = cube_sum(across::<N>(sum), scratch, units) / width;
    let mut squares = Vector::<f32, N>::new(0.0f32);
    #[unroll]
    for i in 0..comptime!(vectors.div_ceil(units)) {
        if UNIT_POS as usize + i * units < vectors {
            let centerd = row[i] - Vector::new(mean);
            row[i] = centerd;
            squares += centerd * centerd;
        }
    }
    let variance = cube_sum(across::<N>(squares), scratch, units) / width;
    1.0f32 / f32::sqrt(variance + epsilon)
}

/// A cube normalizes `rows` rows.
#[cube(launch_unchecked, address_type = "dynamic")]
fn norm_kernel<E: Float, N: Size>(
    x: &Tensor<Vector<f32, N>>,
    shift: &Tensor<Vector<f32, N>>,
    scale: &Tensor<Vector<f32, N>>,
    out: &mut Tensor<Vector<E, N>>,
    tokens: usize,
    rows: usize,
    shift_stride: usize,
    scale_stride: usize,
    epsilon: f32,
    #[comptime] vectors: usize,
    #[comptime] units: usize,
    #[define(E)] _dtype: ElemType,
) {
    let mut scratch = Shared::<[f32]>::new_slice(units);
    let batch = CUBE_POS_Y as usize;
    let first = CUBE_POS_X as usize * rows;
    for token in first..usize::min(first + rows, tokens) {
        let base = (batch * tokens + token) * vectors;
        let mut row = load::<f32, N>(x, base, vectors, units);
        let inverse = standardise::<N>(&mut row, &mut scratch, epsilon, vectors, units);
        #[unroll]
        for i in 0..comptime!(vectors.div_ceil(units)) {
            let column = UNIT_POS as usize + i * units;
            if column < vectors {
                let factor = scale[batch * scale_stride + column] + Vector::new(1.0f32);
                let y = row[i] * Vector::new(inverse) * factor + shift[batch * shift_stride + column];
                out[base + column] = Vector::cast_from(y);
            }
        }
    }
}

/// See [`super::Kernels::modulated_norm_forward`]; the result is of the given type.
pub fn modulated_norm(x: CubeTensor, shift: CubeTensor, scale: CubeTensor, dtype: DType) -> CubeTensor {
    let x = into_contiguous(x);
    let [b, tokens, d] = dims(&x);
    let ((shift, shift_stride), (scale, scale_stride)) = (spaced(shift), spaced(scale));
    let out = empty(&x, &[b, tokens, d], dtype);
    if b * tokens * d == 0 {
        return out;
    }
    let lanes = lanes(&x, &[DType::F32, dtype], &[d, shift_stride, scale_stride]);
    let (rows, count) = pieces(&x, tokens, 1);
    let units = units(&x, d / lanes);
    // SAFETY: cubes stop at the last token and units at the last column; `shift` and `scale` have `b` rows.
    unsafe {
        norm_kernel::launch_unchecked(
            &x.client.clone(),
            grid(count, b),
            line(units),
            address([&x, &shift, &scale, &out]),
            lanes,
            x.into_tensor_arg(),
            shift.into_tensor_arg(),
            scale.into_tensor_arg(),
            out.clone().into_tensor_arg(),
            tokens,
            rows,
            shift_stride / lanes,
            scale_stride / lanes,
            EPS,
            d / lanes,
            units,
            elem(&out),
        );
    }
    out
}

/// A cube writes the gradients of `rows` rows, and the sums over them that make those of shift and scale. With y =
/// (x - mean) / deviation and h = grad (1 + scale): dx = (h - mean(h) - y mean(h y)) / deviation.
#[cube(launch_unchecked, address_type = "dynamic")]
fn norm_backward_kernel<E: Float, N: Size>(
    x: &Tensor<Vector<f32, N>>,
    scale: &Tensor<Vector<f32, N>>,
    grad: &Tensor<Vector<E, N>>,
    dx: &mut Tensor<Vector<f32, N>>,
    d_shift: &mut Tensor<Vector<f32, N>>, // [b, pieces, d]
    d_scale: &mut Tensor<Vector<f32, N>>, // [b, pieces, d]
    tokens: usize,
    rows: usize,
    scale_stride: usize,
    epsilon: f32,
    #[comptime] vectors: usize,
    #[comptime] units: usize,
    #[define(E)] _dtype: ElemType,
) {
    let mut scratch = Shared::<[f32]>::new_slice(units);
    let width = f32::cast_from(vectors as u32) * f32::cast_from(N::value() as u32);
    let batch = CUBE_POS_Y as usize;
    let first = CUBE_POS_X as usize * rows;
    let mut shift_sums = Array::<Vector<f32, N>>::new(comptime!(vectors.div_ceil(units)));
    let mut scale_sums = Array::<Vector<f32, N>>::new(comptime!(vectors.div_ceil(units)));
    for token in first..usize::min(first + rows, tokens) {
        let base = (batch * tokens + token) * vectors;
        let mut row = load::<f32, N>(x, base, vectors, units);
        let mut h = load::<E, N>(grad, base, vectors, units);
        let inverse = standardise::<N>(&mut row, &mut scratch, epsilon, vectors, units);
        let mut sum_h = Vector::<f32, N>::new(0.0f32);
        let mut sum_hy = Vector::<f32, N>::new(0.0f32);
        #[unroll]
        for i in 0..comptime!(vectors.div_ceil(units)) {
            let column = UNIT_POS as usize + i * units;
            if column < vectors {
                let y = row[i] * Vector::new(inverse);
                row[i] = y;
                shift_sums[i] += h[i];
                scale_sums[i] += h[i] * y;
                let factor = scale[batch * scale_stride + column] + Vector::new(1.0f32);
                let scaled = h[i] * factor;
                h[i] = scaled;
                sum_h += scaled;
                sum_hy += scaled * y;
            }
        }
        let mean_h = cube_sum(across::<N>(sum_h), &mut scratch, units) / width;
        let mean_hy = cube_sum(across::<N>(sum_hy), &mut scratch, units) / width;
        #[unroll]
        for i in 0..comptime!(vectors.div_ceil(units)) {
            let column = UNIT_POS as usize + i * units;
            if column < vectors {
                dx[base + column] = (h[i] - Vector::new(mean_h) - row[i] * Vector::new(mean_hy)) * Vector::new(inverse);
            }
        }
    }
    let base = (batch * CUBE_COUNT_X as usize + CUBE_POS_X as usize) * vectors;
    #[unroll]
    for i in 0..comptime!(vectors.div_ceil(units)) {
        let column = UNIT_POS as usize + i * units;
        if column < vectors {
            d_shift[base + column] = shift_sums[i];
            d_scale[base + column] = scale_sums[i];
        }
    }
}

/// See [`super::Kernels::modulated_norm_backward`].
pub fn modulated_norm_backward(x: CubeTensor, scale: CubeTensor, grad: CubeTensor) -> [CubeTensor; 3] {
    let (x, grad) = (into_contiguous(x), into_contiguous(grad));
    let [b, tokens, d] = dims(&x);
    let (scale, stride) = spaced(scale);
    let dx = empty(&x, &[b, tokens, d], DType::F32);
    let (rows, count) = pieces(&x, tokens, ROWS);
    let [d_shift, d_scale] = [(); 2].map(|()| empty(&x, &[b, count, d], DType::F32));
    if b * tokens * d > 0 {
        let lanes = lanes(&x, &[DType::F32, grad.dtype], &[d, stride]);
        let units = units(&x, d / lanes);
        // SAFETY: as in `modulated_norm`; sums have a row for each cube.
        unsafe {
            norm_backward_kernel::launch_unchecked(
                &x.client.clone(),
                grid(count, b),
                line(units),
                address([&x, &scale, &grad, &dx, &d_shift]),
                lanes,
                x.into_tensor_arg(),
                scale.into_tensor_arg(),
                grad.clone().into_tensor_arg(),
                dx.clone().into_tensor_arg(),
                d_shift.clone().into_tensor_arg(),
                d_scale.clone().into_tensor_arg(),
                tokens,
                rows,
                stride / lanes,
                EPS,
                d / lanes,
                units,
                elem(&grad),
            );
        }
    }
    [dx, total(d_shift), total(d_scale)]
}
