//! The CPU's kernels.
//!
//! Work is split into pieces whose number does not depend on the number of threads, and partial sums are added in
//! order, so that results are the same on every machine with the same instruction set. Half precision means operands
//! of products rounded to bf16, where the processor has instructions for that: a tile unit or vectors of bf16. All tensors
//! are f32.

mod attention;
mod head;
mod linear;
mod math;
mod matrix;
mod pointwise;
#[cfg(target_arch = "x86_64")]
mod tiles;

use burn::{
    backend::{Flex, flex::FlexTensor},
    tensor::{DType, TensorData},
};

use super::{AttentionGrads, Grads, Kernels, Product};
use crate::Compute;

/// Whether this processor multiplies in bf16, which is faster than in f32 then.
pub fn has_bf16() -> bool {
    #[cfg(target_arch = "x86_64")]
    return tiles::available();
    #[cfg(not(target_arch = "x86_64"))]
    return false;
}

/// A buffer that several tasks fill in different places.
#[derive(Clone, Copy)]
struct Shared(*mut f32);
// SAFETY: tasks write to disjoint elements only, see each use.
unsafe impl Send for Shared {}
// SAFETY: as above.
unsafe impl Sync for Shared {}

impl Shared {
    /// # Safety
    /// `offset` must lie within the buffer.
    unsafe fn at(self, offset: usize) -> *mut f32 {
        // SAFETY: the caller's promise.
        unsafe { self.0.add(offset) }
    }
}

/// A tensor whose values lie in memory in the order of its axes.
fn contiguous(t: FlexTensor) -> FlexTensor {
    assert_eq!(t.dtype(), DType::F32, "the CPU computes in f32");
    if t.is_contiguous() { t } else { t.to_contiguous() }
}

/// The values of a [`contiguous`] tensor.
fn values(t: &FlexTensor) -> &[f32] {
    t.as_slice::<f32>().expect("contiguous f32")
}

/// The values of a tensor in the order of its axes; those of which there is no other tensor are not copied.
fn into_values(t: FlexTensor) -> Vec<f32> {
    assert_eq!(t.dtype(), DType::F32, "the CPU computes in f32");
    t.into_data().try_into_vec().expect("f32")
}

fn tensor(values: Vec<f32>, shape: &[usize]) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape.to_vec()))
}

fn dims<const D: usize>(t: &FlexTensor) -> [usize; D] {
    t.layout().shape().dims()
}

/// Products come with their bias added here.
fn complete((t, bias): Product<Flex>) -> FlexTensor {
    assert!(bias.is_none(), "the CPU's products include their bias");
    t
}

impl Kernels for Flex {
    fn linear_forward(x: FlexTensor, w: FlexTensor, b: FlexTensor, compute: Compute) -> FlexTensor {
        linear::forward(x, w, b, compute == Compute::Bf16)
    }

    fn linear_backward(
        x: FlexTensor,
        w: FlexTensor,
        grad: FlexTensor,
        need_x: bool,
        compute: Compute,
    ) -> (Option<FlexTensor>, FlexTensor, FlexTensor) {
        let db = linear::bias(&grad);
        let (dx, dw) = linear::backward(x, w, grad, need_x, compute == Compute::Bf16);
        (dx, dw, db)
    }

    fn product_forward(x: FlexTensor, w: FlexTensor, b: FlexTensor, compute: Compute) -> Product<Self> {
        (Self::linear_forward(x, w, b, compute), None)
    }

    fn product_backward(x: FlexTensor, w: FlexTensor, grad: FlexTensor, compute: Compute) -> Grads<Self, 2> {
        let (dx, dw) = linear::backward(x, w, grad, true, compute == Compute::Bf16);
        [dx.expect("asked for"), dw]
    }

    fn modulated_norm_forward(x: FlexTensor, shift: FlexTensor, scale: FlexTensor, _: Compute) -> FlexTensor {
        pointwise::modulated_norm(x, shift, scale)
    }

    fn modulated_norm_backward(x: FlexTensor, scale: FlexTensor, grad: FlexTensor) -> Grads<Self, 3> {
        pointwise::modulated_norm_backward(x, scale, grad, None)
    }

    fn modulated_norm_and_residual_backward(
        x: FlexTensor,
        scale: FlexTensor,
        grad: FlexTensor,
        residual: FlexTensor,
    ) -> Grads<Self, 3> {
        pointwise::modulated_norm_backward(x, scale, grad, Some(residual))
    }

    fn gated_add_forward(x: FlexTensor, gate: FlexTensor, y: Product<Self>) -> FlexTensor {
        pointwise::gated_add(x, gate, complete(y))
    }

    fn gated_add_backward(
        gate: FlexTensor,
        y: Product<Self>,
        grad: FlexTensor,
    ) -> (Grads<Self, 2>, Option<FlexTensor>) {
        let [d_gate, dy, d_bias] = pointwise::gated_add_backward(gate, complete(y), grad);
        ([d_gate, dy], Some(d_bias))
    }

    fn geglu_forward(x: Product<Self>) -> FlexTensor {
        pointwise::geglu(complete(x))
    }

    fn geglu_backward(x: Product<Self>, grad: FlexTensor) -> Product<Self> {
        let [dx, d_bias] = pointwise::geglu_backward(complete(x), grad);
        (dx, Some(d_bias))
    }

    fn attention_forward(
        qkv: Product<Self>,
        norms: Option<Grads<Self, 2>>,
        heads: usize,
        queries: usize,
        _: bool,
        compute: Compute,
    ) -> (FlexTensor, Option<FlexTensor>) {
        let (out, log_sum) = attention::forward(complete(qkv), norms, heads, queries, compute == Compute::Bf16);
        (out, Some(log_sum))
    }

    fn attention_backward(
        qkv: Product<Self>,
        norms: Option<Grads<Self, 2>>,
        out: FlexTensor,
        log_sum: FlexTensor,
        grad: FlexTensor,
        heads: usize,
        compute: Compute,
    ) -> AttentionGrads<Self> {
        let bf16 = compute == Compute::Bf16;
        let (qkv, norms) = attention::backward(complete(qkv), norms, out, log_sum, grad, heads, bf16);
        AttentionGrads { bias: Some(linear::bias(&qkv)), qkv, norms }
    }
}
