//! Matrix products of linear layers.

use burn::{backend::ops::FloatTensorOps, tensor::DType};
use burn_cubecl::{
    CubeBackend,
    kernel::{
        cast as burn_cast, into_contiguous,
        matmul::{MatmulStrategy, matmul as burn_matmul},
    },
    ops::numeric,
    tensor::CubeTensor,
};

use super::{dims, empty, shaped};
use crate::Compute;

/// Multiplications from which on it pays to try out which kernel is the fastest, once for each kind of shape.
const TUNED: usize = 1 << 24;

/// The product of the last two axes, in the given type, contiguous. Sums are f32.
pub fn matmul(a: CubeTensor, b: CubeTensor, dtype: DType) -> CubeTensor {
    let (mut shape, columns) = (a.meta.shape().to_vec(), b.meta.shape().to_vec());
    let rank = shape.len();
    shape[rank - 1] = columns[rank - 1];
    let out = empty(&a, &shape, dtype);
    if shape.iter().product::<usize>() == 0 {
        return out;
    }
    let large = shape.iter().product::<usize>() * columns[rank - 2] >= TUNED;
    let strategy = if large { MatmulStrategy::default() } else { MatmulStrategy::Cube };
    burn_matmul(a, b, Some(out), strategy, dtype).expect("a product's shapes fit each other")
}

/// The last two axes exchanged, without moving anything.
pub fn transposed(t: CubeTensor) -> CubeTensor {
    let rank = t.meta.shape().len();
    CubeBackend::float_swap_dims(t, rank - 2, rank - 1)
}

/// In another type; in its own, without doing anything.
pub fn cast(t: CubeTensor, dtype: DType) -> CubeTensor {
    burn_cast(t, dtype)
}

/// `[..., width]` as `[n, width]`.
fn matrix(t: CubeTensor, dtype: DType) -> CubeTensor {
    let t = into_contiguous(cast(t, dtype));
    let shape = t.meta.shape().to_vec();
    let width = shape.last().copied().unwrap_or(1);
    shaped(t, &[shape.iter().product::<usize>() / width.max(1), width])
}

/// `x W^T`, `[..., out]`, in the type of `compute`.
pub fn product(x: CubeTensor, w: CubeTensor, compute: Compute) -> CubeTensor {
    let dtype = compute.dtype();
    let mut shape = x.meta.shape().to_vec();
    let [outputs, inputs] = dims(&w);
    assert_eq!(shape.last(), Some(&inputs), "linear: input width");
    let out = matmul(matrix(x, dtype), transposed(cast(w, dtype)), dtype);
    if let Some(last) = shape.last_mut() {
        *last = outputs;
    }
    shaped(out, &shape)
}

/// See [`super::Kernels::linear_forward`].
pub fn forward(x: CubeTensor, w: CubeTensor, b: CubeTensor, compute: Compute) -> CubeTensor {
    let out = product(x, w, compute);
    let mut shape = vec![1; out.meta.shape().len()];
    shape[out.meta.shape().len() - 1] = out.meta.shape()[out.meta.shape().len() - 1];
    let bias = shaped(into_contiguous(cast(b, compute.dtype())), &shape);
    numeric::add(out, bias)
}

/// Gradients of `x`, where asked for, in the type of `compute`, and of `w`, f32.
pub fn backward(
    x: CubeTensor,
    w: CubeTensor,
    grad: CubeTensor,
    need_x: bool,
    compute: Compute,
) -> (Option<CubeTensor>, CubeTensor) {
    let dtype = compute.dtype();
    let shape = x.meta.shape().to_vec();
    let grad = matrix(grad, dtype);
    let dx = need_x.then(|| shaped(matmul(grad.clone(), cast(w, dtype), dtype), &shape));
    let dw = matmul(transposed(grad), matrix(x, dtype), DType::F32);
    (dx, dw)
}
