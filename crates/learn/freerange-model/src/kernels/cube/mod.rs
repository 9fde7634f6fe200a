//! The kernels of GPUs, in CubeCL: CUDA, ROCm, Metal, Vulkan and WebGPU from one source.
//!
//! Matrix products are CubeCL's, tuned on the device and on its matrix units where it has them; everything between
//! them reads and writes memory once. Nothing reads back to the host, no size depends on data, and sums over rows are
//! taken in two stages in a fixed order, so that results repeat.
//!
//! Rows are read in vectors of up to four numbers by as many units as a row has vectors. Cubes have at most 256 units
//! (WebGPU's limit) and use a few KiB of shared memory; plane instructions are not used, since their width is unknown
//! on some devices.

mod attention;
mod flash;
mod heads;
mod linear;
mod merge;
mod norm;
mod pointwise;
mod reduce;
mod softmax;

use burn::{
    backend::{TensorMetadata, cubecl::dtype_to_storage_type},
    tensor::{DType, Shape},
};
use burn_cubecl::{
    CubeBackend,
    kernel::into_contiguous,
    ops::{numeric::empty_device_contiguous_dtype, reshape},
    tensor::CubeTensor,
};
use cubecl::{ir::ElemType, prelude::*};

use super::{AttentionGrads, Grads, Kernels, Product};
use crate::Compute;

/// Numbers in a vector, at most: 16 bytes of f32.
const LANES: usize = 4;
/// Units in a cube, at most.
const UNITS: usize = 256;
/// Rows that one cube of a backward kernel goes through while it sums columns.
const ROWS: usize = 16;

fn empty(like: &CubeTensor, shape: &[usize], dtype: DType) -> CubeTensor {
    let shape = Shape::from(shape.to_vec());
    empty_device_contiguous_dtype(like.client.clone(), like.device.clone(), shape, dtype)
}

/// The same numbers with other axes.
fn shaped(t: CubeTensor, shape: &[usize]) -> CubeTensor {
    reshape(t, Shape::from(shape.to_vec()))
}

fn elem(t: &CubeTensor) -> ElemType {
    dtype_to_storage_type(t.dtype)
}

fn dims<const D: usize>(t: &CubeTensor) -> [usize; D] {
    t.shape().dims()
}

/// The widest integer that indexes all of these.
fn address<const N: usize>(tensors: [&CubeTensor; N]) -> AddressType {
    tensors.into_iter().map(CubeTensor::required_address_type).max().unwrap_or_default()
}

/// The longest vector, up to [`LANES`], that divides these widths and that the device can load for these types.
fn lanes(like: &CubeTensor, dtypes: &[DType], widths: &[usize]) -> usize {
    let fits = |n: usize| {
        widths.iter().all(|width| width.is_multiple_of(n))
            && dtypes.iter().all(|dtype| like.client.io_optimized_vector_sizes(dtype.size()).any(|size| size == n))
    };
    [LANES, 2].into_iter().find(|&n| fits(n)).unwrap_or(1)
}

/// Units in a cube, at most, on this device; a power of two.
fn max_units(like: &CubeTensor) -> usize {
    let limit = UNITS.min(like.client.properties().hardware.max_units_per_cube as usize).max(1);
    1 << limit.ilog2()
}

/// Units for rows of this many vectors: a power of two.
fn units(like: &CubeTensor, vectors: usize) -> usize {
    let limit = max_units(like);
    vectors.next_power_of_two().clamp(limit.min(32), limit)
}

/// How to split `tokens` rows: rows a cube goes through, at least `rows`, and the number of such pieces, within what
/// the device can launch along one axis.
fn pieces(like: &CubeTensor, tokens: usize, rows: usize) -> (usize, usize) {
    let (x, y, _) = like.client.properties().hardware.max_cube_count;
    let limit = x.min(y).max(1) as usize;
    let rows = rows.max(tokens.div_ceil(limit)).max(1);
    (rows, tokens.div_ceil(rows))
}

/// A two-dimensional grid of cubes.
fn grid(x: usize, y: usize) -> CubeCount {
    CubeCount::Static(x as u32, y as u32, 1)
}

/// So many cubes at least, numbered by `CUBE_POS`, along as many axes as it takes.
fn spread(like: &CubeTensor, cubes: usize) -> CubeCount {
    let limit = like.client.properties().hardware.max_cube_count.0.max(1) as usize;
    grid(cubes.min(limit), cubes.div_ceil(limit))
}

fn line(units: usize) -> CubeDim {
    CubeDim::new_1d(units as u32)
}

/// A tensor `[b, d]` whose rows lie anywhere, and how far apart, in numbers.
fn spaced(t: CubeTensor) -> (CubeTensor, usize) {
    let t = if t.meta.strides()[1] == 1 { t } else { into_contiguous(t) };
    let stride = t.meta.strides()[0];
    (t, stride)
}

impl Kernels for CubeBackend {
    fn linear_forward(x: CubeTensor, w: CubeTensor, b: CubeTensor, compute: Compute) -> CubeTensor {
        linear::forward(x, w, b, compute)
    }

    fn linear_backward(
        x: CubeTensor,
        w: CubeTensor,
        grad: CubeTensor,
        need_x: bool,
        compute: Compute,
    ) -> (Option<CubeTensor>, CubeTensor, CubeTensor) {
        let x_type = x.dtype;
        let grad = into_contiguous(grad);
        let db = reduce::rows(grad.clone());
        let (dx, dw) = linear::backward(x, w, grad, need_x, compute);
        (dx.map(|dx| linear::cast(dx, x_type)), dw, db)
    }

    fn product_forward(x: CubeTensor, w: CubeTensor, b: CubeTensor, compute: Compute) -> Product<Self> {
        (linear::product(x, w, compute), Some(b))
    }

    fn product_backward(x: CubeTensor, w: CubeTensor, grad: CubeTensor, compute: Compute) -> Grads<Self, 2> {
        let (dx, dw) = linear::backward(x, w, grad, true, compute);
        [dx.expect("asked for"), dw]
    }

    fn modulated_norm_forward(x: CubeTensor, shift: CubeTensor, scale: CubeTensor, compute: Compute) -> CubeTensor {
        norm::modulated_norm(x, shift, scale, compute.dtype())
    }

    fn modulated_norm_backward(x: CubeTensor, scale: CubeTensor, grad: CubeTensor) -> Grads<Self, 3> {
        norm::modulated_norm_backward(x, scale, grad)
    }

    fn gated_add_forward(x: CubeTensor, gate: CubeTensor, y: Product<Self>) -> CubeTensor {
        pointwise::gated_add(x, gate, y)
    }

    fn gated_add_backward(
        gate: CubeTensor,
        y: Product<Self>,
        grad: CubeTensor,
    ) -> (Grads<Self, 2>, Option<CubeTensor>) {
        pointwise::gated_add_backward(gate, y, grad)
    }

    fn geglu_forward(x: Product<Self>) -> CubeTensor {
        pointwise::geglu(x)
    }

    fn geglu_backward(x: Product<Self>, grad: CubeTensor) -> Product<Self> {
        pointwise::geglu_backward(x, grad)
    }

    fn attention_forward(
        qkv: Product<Self>,
        norms: Option<Grads<Self, 2>>,
        heads: usize,
        queries: usize,
        keep: bool,
        _: Compute,
    ) -> (CubeTensor, Option<CubeTensor>) {
        attention::forward(qkv, norms, heads, queries, keep)
    }

    fn attention_backward(
        qkv: Product<Self>,
        norms: Option<Grads<Self, 2>>,
        out: CubeTensor,
        log_sum: CubeTensor,
        grad: CubeTensor,
        heads: usize,
        _: Compute,
    ) -> AttentionGrads<Self> {
        attention::backward(qkv, norms, out, log_sum, grad, heads)
    }
}
