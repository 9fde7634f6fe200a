//! Sums: over the units of a cube, over groups of units, over the rows of a matrix.

use burn::tensor::DType;
use burn_cubecl::{kernel::into_contiguous, tensor::CubeTensor};
use cubecl::{self, cube, prelude::*};

use super::{address, dims, elem, empty, grid, lanes, line, max_units, pieces, shaped};

/// The sum of a vector's numbers.
#[cube]
pub fn across<N: Size>(v: Vector<f32, N>) -> f32 {
    let mut sum = 0.0f32;
    #[unroll]
    for i in 0..N::value() {
        sum += v.extract(i);
    }
    sum
}

/// The largest of a vector's numbers.
#[cube]
pub fn largest<N: Size>(v: Vector<f32, N>) -> f32 {
    let mut largest = v.extract(0usize);
    #[unroll]
    for i in 1usize..N::value() {
        largest = f32::max(largest, v.extract(i));
    }
    largest
}

/// The sum over all units of a cube, for each of them. `units`, a power of two, is the size of cube and scratch.
#[cube]
pub fn cube_sum(value: f32, scratch: &mut Shared<[f32]>, #[comptime] units: usize) -> f32 {
    let unit = UNIT_POS as usize;
    sync_cube();
    scratch[unit] = value;
    sync_cube();
    #[unroll]
    for step in 0..comptime!(units.ilog2()) {
        let half = comptime!(units >> (step + 1));
        if unit < half {
            let other = scratch[unit + half];
            scratch[unit] += other;
        }
        sync_cube();
    }
    scratch[0]
}

/// As [`cube_sum`], the largest.
#[cube]
pub fn cube_max(value: f32, scratch: &mut Shared<[f32]>, #[comptime] units: usize) -> f32 {
    let unit = UNIT_POS as usize;
    sync_cube();
    scratch[unit] = value;
    sync_cube();
    #[unroll]
    for step in 0..comptime!(units.ilog2()) {
        let half = comptime!(units >> (step + 1));
        if unit < half {
            let other = scratch[unit + half];
            scratch[unit] = f32::max(scratch[unit], other);
        }
        sync_cube();
    }
    scratch[0]
}

/// The sum over each `size` neighboring units of a cube, for each of them.
#[cube]
pub fn group_sum(value: f32, scratch: &mut Shared<[f32]>, #[comptime] size: usize) -> f32 {
    let unit = UNIT_POS as usize;
    sync_cube();
    scratch[unit] = value;
    sync_cube();
    let first = unit - unit % size;
    let mut sum = 0.0f32;
    for i in 0..size {
        sum += scratch[first + i];
    }
    sum
}

/// Units that share one column in [`total_kernel`].
const SLICES: usize = 8;
/// Columns of one of its cubes.
const COLUMNS: usize = 32;

/// One cube sums `COLUMNS` columns of one matrix `[n, width]` of `x` `[groups, n, width]`.
#[cube(launch_unchecked, address_type = "dynamic")]
fn total_kernel(
    x: &Tensor<f32>,
    out: &mut Tensor<f32>,
    n: usize,
    width: usize,
    #[comptime] slices: usize,
    #[comptime] columns: usize,
) {
    let mut scratch = Shared::<[f32]>::new_slice(comptime!(slices * columns));
    let (unit, slice) = (UNIT_POS_X as usize, UNIT_POS_Y as usize);
    let column = CUBE_POS_X as usize * columns + unit;
    let group = CUBE_POS_Y as usize;
    let mut sum = 0.0f32;
    if column < width {
        let mut row = slice;
        while row < n {
            sum += x[(group * n + row) * width + column];
            row += slices;
        }
    }
    scratch[slice * columns + unit] = sum;
    sync_cube();
    if slice == 0 && column < width {
        let mut total = 0.0f32;
        #[unroll]
        for i in 0..slices {
            total += scratch[i * columns + unit];
        }
        out[group * width + column] = total;
    }
}

/// Sums the matrices of `[groups, n, width]` over their rows: `[groups, width]`, f32.
pub fn total(x: CubeTensor) -> CubeTensor {
    let [groups, n, width] = dims(&x);
    let out = empty(&x, &[groups, width], DType::F32);
    if groups * width == 0 {
        return out;
    }
    let slices = SLICES.min(max_units(&x) / COLUMNS).max(1);
    // SAFETY: every index is checked against the sizes of both tensors.
    unsafe {
        total_kernel::launch_unchecked(
            &x.client.clone(),
            grid(width.div_ceil(COLUMNS), groups),
            CubeDim::new_2d(COLUMNS as u32, slices as u32),
            address([&x, &out]),
            x.into_tensor_arg(),
            out.clone().into_tensor_arg(),
            n,
            width,
            slices,
            COLUMNS,
        );
    }
    out
}

/// Sums pieces of `rows` rows of `x` `[n, width]`: `out` `[pieces, width]`.
#[cube(launch_unchecked, address_type = "dynamic")]
fn rows_kernel<E: Float, N: Size>(
    x: &Tensor<Vector<E, N>>,
    out: &mut Tensor<Vector<f32, N>>,
    count: usize,
    vectors: usize,
    rows: usize,
    #[define(E)] _dtype: ElemType,
) {
    let column = ABSOLUTE_POS_X as usize;
    let piece = CUBE_POS_Y as usize;
    if column < vectors {
        let last = usize::min((piece + 1) * rows, count);
        let mut sum = Vector::<f32, N>::new(0.0f32);
        for row in piece * rows..last {
            sum += Vector::cast_from(x[row * vectors + column]);
        }
        out[piece * vectors + column] = sum;
    }
}

/// Sums `[..., width]` over all but the last axis: `[width]`, f32.
pub fn rows(x: CubeTensor) -> CubeTensor {
    let x = into_contiguous(x);
    let shape = x.meta.shape().to_vec();
    let width = shape.last().copied().unwrap_or(1);
    let n = shape.iter().product::<usize>() / width.max(1);
    let lanes = lanes(&x, &[x.dtype, DType::F32], &[width]);
    let (rows, count) = pieces(&x, n, 64);
    let partial = empty(&x, &[1, count, width], DType::F32);
    if n * width > 0 {
        let units = max_units(&x).min(64);
        // SAFETY: the last piece and the last cube stop at the sizes of both tensors.
        unsafe {
            rows_kernel::launch_unchecked(
                &x.client.clone(),
                grid((width / lanes).div_ceil(units), count),
                line(units),
                address([&x, &partial]),
                lanes,
                x.clone().into_tensor_arg(),
                partial.clone().into_tensor_arg(),
                n,
                width / lanes,
                rows,
                elem(&x),
            );
        }
    }
    shaped(total(partial), &[width])
}
