//! Gated residual and GEGLU. Backward kernels go through a few rows a cube and sum columns on the way: each unit keeps
//! the same columns.

use burn::tensor::DType;
use burn_cubecl::{kernel::into_contiguous, tensor::CubeTensor};
use cubecl::{self, calculate_cube_count_elemwise, cube, prelude::*};

use super::{
    ROWS, address, dims, elem, empty, grid, lanes, line, max_units, pieces, reduce::total, shaped, spaced, units,
};

/// The normal distribution's cumulative probability and density, both within 3e-7 (Abramowitz and Stegun 7.1.26), as
/// on the CPU.
#[cube]
fn normal(x: f32) -> (f32, f32) {
    let z = f32::abs(x) * 0.707_106_77f32;
    let e = f32::exp(-(z * z));
    let t = 1.0f32 / (1.0f32 + 0.327_591_1f32 * z);
    let p = 1.061_405_4f32;
    let p = p * t - 1.453_152f32;
    let p = p * t + 1.421_413_8f32;
    let p = p * t - 0.284_496_74f32;
    let p = p * t + 0.254_829_6f32;
    let half_tail = 0.5f32 * p * t * e;
    (select(x < 0.0f32, half_tail, 1.0f32 - half_tail), 0.398_942_3f32 * e)
}

/// `out = x + gate (y + bias)`, one vector a unit.
#[cube(launch_unchecked, address_type = "dynamic")]
fn gated_kernel<E: Float, N: Size>(
    x: &Tensor<Vector<f32, N>>,
    gate: &Tensor<Vector<f32, N>>,
    y: &Tensor<Vector<E, N>>,
    bias: ComptimeOption<&[Vector<f32, N>]>,
    out: &mut Tensor<Vector<f32, N>>,
    count: usize,
    tokens: usize,
    gate_stride: usize,
    #[comptime] vectors: usize,
    #[define(E)] _dtype: ElemType,
) {
    let i = ABSOLUTE_POS;
    if i < count {
        let (row, column) = (i / vectors, i % vectors);
        let bias: ComptimeOption<Vector<f32, N>> = bias.map(|bias| bias[column]);
        let y = Vector::<f32, N>::cast_from(y[i]) + bias.unwrap_or_else(|| Vector::new(0.0f32));
        out[i] = x[i] + gate[row / tokens * gate_stride + column] * y;
    }
}

/// See [`super::Kernels::gated_add_forward`].
pub fn gated_add(x: CubeTensor, gate: CubeTensor, (y, bias): (CubeTensor, Option<CubeTensor>)) -> CubeTensor {
    let (x, y, bias) = (into_contiguous(x), into_contiguous(y), bias.map(into_contiguous));
    let [b, tokens, d] = dims(&x);
    let (gate, stride) = spaced(gate);
    let out = empty(&x, &[b, tokens, d], DType::F32);
    let lanes = lanes(&x, &[DType::F32, y.dtype], &[d, stride]);
    let n = b * tokens * d / lanes;
    if n == 0 {
        return out;
    }
    let cube = line(max_units(&x));
    // SAFETY: units stop at the last of `n` vectors, which `x`, `y` and `out` have; `gate` has `b` rows.
    unsafe {
        gated_kernel::launch_unchecked(
            &x.client.clone(),
            calculate_cube_count_elemwise(&x.client, n, cube),
            cube,
            address([&x, &gate, &y, &out]),
            lanes,
            x.into_tensor_arg(),
            gate.into_tensor_arg(),
            y.clone().into_tensor_arg(),
            bias.map(CubeTensor::into_buffer_arg).into(),
            out.clone().into_tensor_arg(),
            n,
            tokens,
            stride / lanes,
            d / lanes,
            elem(&y),
        );
    }
    out
}

/// A unit goes through `rows` rows of one column: `dy = gate grad`, and the sums of `grad (y + bias)` and of `dy`.
#[cube(launch_unchecked, address_type = "dynamic")]
fn gated_backward_kernel<E: Float, N: Size>(
    gate: &Tensor<Vector<f32, N>>,
    y: &Tensor<Vector<E, N>>,
    bias: ComptimeOption<&[Vector<f32, N>]>,
    grad: &Tensor<Vector<f32, N>>,
    dy: &mut Tensor<Vector<E, N>>,
    d_gate: &mut Tensor<Vector<f32, N>>, // [b, pieces, d]
    d_bias: &mut Tensor<Vector<f32, N>>, // [b, pieces, d]
    tokens: usize,
    rows: usize,
    gate_stride: usize,
    #[comptime] vectors: usize,
    #[define(E)] _dtype: ElemType,
) {
    let column = ABSOLUTE_POS_X as usize;
    if column < vectors {
        let (batch, piece) = (CUBE_POS_Z as usize, CUBE_POS_Y as usize);
        let bias: ComptimeOption<Vector<f32, N>> = bias.map(|bias| bias[column]);
        let bias = bias.unwrap_or_else(|| Vector::new(0.0f32));
        let gate = gate[batch * gate_stride + column];
        let mut gate_sum = Vector::<f32, N>::new(0.0f32);
        let mut bias_sum = Vector::<f32, N>::new(0.0f32);
        let first = piece * rows;
        for token in first..usize::min(first + rows, tokens) {
            let i = (batch * tokens + token) * vectors + column;
            let g = grad[i];
            gate_sum += g * (Vector::<f32, N>::cast_from(y[i]) + bias);
            let d = gate * g;
            bias_sum += d;
            dy[i] = Vector::cast_from(d);
        }
        let i = (batch * CUBE_COUNT_Y as usize + piece) * vectors + column;
        d_gate[i] = gate_sum;
        d_bias[i] = bias_sum;
    }
}

/// See [`super::Kernels::gated_add_backward`].
pub fn gated_add_backward(
    gate: CubeTensor,
    (y, bias): (CubeTensor, Option<CubeTensor>),
    grad: CubeTensor,
) -> ([CubeTensor; 2], Option<CubeTensor>) {
    let (y, bias, grad) = (into_contiguous(y), bias.map(into_contiguous), into_contiguous(grad));
    let [b, tokens, d] = dims(&y);
    let (gate, stride) = spaced(gate);
    let dy = empty(&y, &[b, tokens, d], y.dtype);
    let (rows, count) = pieces(&y, tokens, ROWS);
    let [d_gate, d_bias] = [(); 2].map(|()| empty(&y, &[b, count, d], DType::F32));
    let has_bias = bias.is_some();
    if b * tokens * d > 0 {
        let lanes = lanes(&y, &[DType::F32, y.dtype], &[d, stride]);
        let units = units(&y, d / lanes);
        // SAFETY: units stop at the last column and row; sums have a row for each cube along y and z.
        unsafe {
            gated_backward_kernel::launch_unchecked(
                &y.client.clone(),
                CubeCount::Static((d / lanes).div_ceil(units) as u32, count as u32, b as u32),
                line(units),
                address([&gate, &y, &grad, &dy, &d_gate]),
                lanes,
                gate.into_tensor_arg(),
                y.clone().into_tensor_arg(),
                bias.map(CubeTensor::into_buffer_arg).into(),
                grad.into_tensor_arg(),
                dy.clone().into_tensor_arg(),
                d_gate.clone().into_tensor_arg(),
                d_bias.clone().into_tensor_arg(),
                tokens,
                rows,
                stride / lanes,
                d / lanes,
                elem(&y),
            );
        }
    }
    let d_bias = has_bias.then(|| shaped(total(shaped(d_bias, &[1, b * count, d])), &[d]));
    ([total(d_gate), dy], d_bias)
}

/// One vector of `a gelu(g)` a unit.
#[cube(launch_unchecked, address_type = "dynamic")]
fn geglu_kernel<E: Float, N: Size>(
    x: &Tensor<Vector<E, N>>,
    bias: ComptimeOption<&[Vector<f32, N>]>,
    out: &mut Tensor<Vector<E, N>>,
    count: usize,
    #[comptime] vectors: usize,
    #[define(E)] _dtype: ElemType,
) {
    let i = ABSOLUTE_POS;
    if i < count {
        let (row, column) = (i / vectors, i % vectors);
        let bias_a: ComptimeOption<Vector<f32, N>> = bias.map(|bias| bias[column]);
        let bias_g: ComptimeOption<Vector<f32, N>> = bias.map(|bias| bias[column + vectors]);
        let at = 2 * row * vectors + column;
        let a = Vector::<f32, N>::cast_from(x[at]) + bias_a.unwrap_or_else(|| Vector::new(0.0f32));
        let g = Vector::<f32, N>::cast_from(x[at + vectors]) + bias_g.unwrap_or_else(|| Vector::new(0.0f32));
        let mut y = a * g;
        #[unroll]
        for lane in 0..N::value() {
            let (cumulative, _density) = normal(g.extract(lane));
            y.insert(lane, y.extract(lane) * cumulative);
        }
        out[i] = Vector::cast_from(y);
    }
}

/// See [`super::Kernels::geglu_forward`].
pub fn geglu((x, bias): (CubeTensor, Option<CubeTensor>)) -> CubeTensor {
    let (x, bias) = (into_contiguous(x), bias.map(into_contiguous));
    let [b, tokens, f2] = dims(&x);
    let f = f2 / 2;
    let out = empty(&x, &[b, tokens, f], x.dtype);
    let lanes = lanes(&x, &[DType::F32, x.dtype], &[f]);
    let n = b * tokens * f / lanes;
    if n == 0 {
        return out;
    }
    let cube = line(max_units(&x));
    // SAFETY: units stop at the last of `n` vectors, which `out` has, and `x` twice as many.
    unsafe {
        geglu_kernel::launch_unchecked(
            &x.client.clone(),
            calculate_cube_count_elemwise(&x.client, n, cube),
            cube,
            address([&x, &out]),
            lanes,
            x.clone().into_tensor_arg(),
            bias.map(CubeTensor::into_buffer_arg).into(),
            out.clone().into_tensor_arg(),
            n,
            f / lanes,
            elem(&x),
        );
    }
    out
}

/// A unit goes through `rows` rows of one column of both halves. gelu(g) = g P(g), so gelu'(g) = P(g) + g p(g).
#[cube(launch_unchecked, address_type = "dynamic")]
fn geglu_backward_kernel<E: Float, N: Size>(
    x: &Tensor<Vector<E, N>>,
    bias: ComptimeOption<&[Vector<f32, N>]>,
    grad: &Tensor<Vector<E, N>>,
    dx: &mut Tensor<Vector<E, N>>,
    d_bias: &mut Tensor<Vector<f32, N>>, // [pieces, 2 f]
    count: usize,
    rows: usize,
    #[comptime] vectors: usize,
    #[define(E)] _dtype: ElemType,
) {
    let column = ABSOLUTE_POS_X as usize;
    if column < vectors {
        let bias_a: ComptimeOption<Vector<f32, N>> = bias.map(|bias| bias[column]);
        let bias_a = bias_a.unwrap_or_else(|| Vector::new(0.0f32));
        let bias_g: ComptimeOption<Vector<f32, N>> = bias.map(|bias| bias[column + vectors]);
        let bias_g = bias_g.unwrap_or_else(|| Vector::new(0.0f32));
        let mut sum_a = Vector::<f32, N>::new(0.0f32);
        let mut sum_g = Vector::<f32, N>::new(0.0f32);
        let first = CUBE_POS_Y as usize * rows;
        for row in first..usize::min(first + rows, count) {
            let at = 2 * row * vectors + column;
            let a = Vector::<f32, N>::cast_from(x[at]) + bias_a;
            let g = Vector::<f32, N>::cast_from(x[at + vectors]) + bias_g;
            let outer = Vector::<f32, N>::cast_from(grad[row * vectors + column]);
            let mut da = outer * g;
            let mut dg = outer * a;
            #[unroll]
            for lane in 0..N::value() {
                let (cumulative, density) = normal(g.extract(lane));
                da.insert(lane, da.extract(lane) * cumulative);
                dg.insert(lane, dg.extract(lane) * (cumulative + g.extract(lane) * density));
            }
            sum_a += da;
            sum_g += dg;
            dx[at] = Vector::cast_from(da);
            dx[at + vectors] = Vector::cast_from(dg);
        }
        let at = 2 * CUBE_POS_Y as usize * vectors + column;
        d_bias[at] = sum_a;
        d_bias[at + vectors] = sum_g;
    }
}

/// See [`super::Kernels::geglu_backward`].
pub fn geglu_backward(
    (x, bias): (CubeTensor, Option<CubeTensor>),
    grad: CubeTensor,
) -> (CubeTensor, Option<CubeTensor>) {
    let (x, bias, grad) = (into_contiguous(x), bias.map(into_contiguous), into_contiguous(grad));
    let [b, tokens, f2] = dims(&x);
    let f = f2 / 2;
    let dx = empty(&x, &[b, tokens, f2], x.dtype);
    let (rows, count) = pieces(&x, b * tokens, ROWS);
    let d_bias = empty(&x, &[1, count, f2], DType::F32);
    let has_bias = bias.is_some();
    if b * tokens * f > 0 {
        let lanes = lanes(&x, &[DType::F32, x.dtype], &[f]);
        let units = units(&x, f / lanes);
        // SAFETY: units stop at the last column and row; sums have a row for each cube along y.
        unsafe {
            geglu_backward_kernel::launch_unchecked(
                &x.client.clone(),
                grid((f / lanes).div_ceil(units), count),
                line(units),
                address([&x, &grad, &dx, &d_bias]),
                lanes,
                x.clone().into_tensor_arg(),
                bias.map(CubeTensor::into_buffer_arg).into(),
                grad.into_tensor_arg(),
                dx.clone().into_tensor_arg(),
                d_bias.clone().into_tensor_arg(),
                b * tokens,
                rows,
                f / lanes,
                elem(&x),
            );
        }
    }
    (dx, has_bias.then(|| shaped(total(d_bias), &[f2])))
}
