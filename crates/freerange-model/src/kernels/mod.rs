//! Fused CPU versions of the operations in [`crate::ops`], with hand-written gradients.
//!
//! Burn's elementwise operations on the CPU run on one thread and pass over memory once each; together they would take
//! as long as the matrix products. Here every operation reads its inputs once, in parallel, and keeps for its gradient
//! nothing but what it was given. Work is split into pieces whose number does not depend on the number of threads, and
//! partial sums are added in order, so that results are the same on every machine with the same instruction set.

mod attention;
mod bf16;
mod linear;
mod math;
mod pointwise;

use burn::{
    backend::{
        Autodiff, Backend, Flex,
        autodiff::{
            checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
            grads::Gradients,
            ops::{Backward, Ops, OpsKind},
        },
        backend_extension,
        flex::FlexTensor,
        tensor::FloatTensor,
    },
    tensor::{DType, TensorData},
};

/// A gradient function's results, one per differentiable input.
type Grads<B, const N: usize> = [FloatTensor<B>; N];

/// Forward and backward of each operation on plain tensors. Shapes as in [`crate::ops`].
pub(crate) trait Kernels: Backend {
    fn linear_forward(
        x: FloatTensor<Self>,
        w: FloatTensor<Self>,
        b: FloatTensor<Self>,
        bf16: bool,
    ) -> FloatTensor<Self>;
    /// Gradients of `x` (where asked for), `w` and `b`.
    fn linear_backward(
        x: FloatTensor<Self>,
        w: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        need_x: bool,
        bf16: bool,
    ) -> (Option<FloatTensor<Self>>, FloatTensor<Self>, FloatTensor<Self>);

    fn modulated_norm_forward(
        x: FloatTensor<Self>,
        shift: FloatTensor<Self>,
        scale: FloatTensor<Self>,
    ) -> FloatTensor<Self>;
    /// Gradients of `x`, `shift`, `scale`.
    fn modulated_norm_backward(
        x: FloatTensor<Self>,
        scale: FloatTensor<Self>,
        grad: FloatTensor<Self>,
    ) -> Grads<Self, 3>;

    fn gated_add_forward(x: FloatTensor<Self>, gate: FloatTensor<Self>, y: FloatTensor<Self>) -> FloatTensor<Self>;
    /// Gradients of `gate` and `y`; that of `x` is `grad` itself.
    fn gated_add_backward(gate: FloatTensor<Self>, y: FloatTensor<Self>, grad: FloatTensor<Self>) -> Grads<Self, 2>;

    fn geglu_forward(x: FloatTensor<Self>) -> FloatTensor<Self>;
    fn geglu_backward(x: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self>;

    /// The mixed values `[b, queries, d]` and the log of each softmax's denominator `[b, heads, queries]`.
    fn attention_forward(
        qkv: FloatTensor<Self>,
        q_weight: FloatTensor<Self>,
        k_weight: FloatTensor<Self>,
        heads: usize,
        queries: usize,
    ) -> (FloatTensor<Self>, FloatTensor<Self>);
    /// Gradients of `qkv`, `q_weight`, `k_weight`, from the inputs, both outputs and the gradient of the first.
    fn attention_backward(
        qkv: FloatTensor<Self>,
        q_weight: FloatTensor<Self>,
        k_weight: FloatTensor<Self>,
        out: FloatTensor<Self>,
        log_sum: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        heads: usize,
    ) -> Grads<Self, 3>;
}

/// The operations as Burn sees them: on the CPU, and differentiable.
#[backend_extension(Flex, Autodiff)]
pub(crate) trait FusedOps: Backend {
    fn linear_bias(x: FloatTensor<Self>, w: FloatTensor<Self>, b: FloatTensor<Self>, bf16: bool) -> FloatTensor<Self>;
    fn modulated_norm(x: FloatTensor<Self>, shift: FloatTensor<Self>, scale: FloatTensor<Self>) -> FloatTensor<Self>;
    fn gated_add(x: FloatTensor<Self>, gate: FloatTensor<Self>, y: FloatTensor<Self>) -> FloatTensor<Self>;
    fn geglu(x: FloatTensor<Self>) -> FloatTensor<Self>;
    fn qk_norm_attention(
        qkv: FloatTensor<Self>,
        q_weight: FloatTensor<Self>,
        k_weight: FloatTensor<Self>,
        heads: usize,
        queries: usize,
    ) -> FloatTensor<Self>;
}

impl FusedOps for Flex {
    fn linear_bias(x: FlexTensor, w: FlexTensor, b: FlexTensor, bf16: bool) -> FlexTensor {
        Self::linear_forward(x, w, b, bf16)
    }

    fn modulated_norm(x: FlexTensor, shift: FlexTensor, scale: FlexTensor) -> FlexTensor {
        Self::modulated_norm_forward(x, shift, scale)
    }

    fn gated_add(x: FlexTensor, gate: FlexTensor, y: FlexTensor) -> FlexTensor {
        Self::gated_add_forward(x, gate, y)
    }

    fn geglu(x: FlexTensor) -> FlexTensor {
        Self::geglu_forward(x)
    }

    fn qk_norm_attention(
        qkv: FlexTensor,
        q_weight: FlexTensor,
        k_weight: FlexTensor,
        heads: usize,
        queries: usize,
    ) -> FlexTensor {
        Self::attention_forward(qkv, q_weight, k_weight, heads, queries).0
    }
}

#[derive(Debug)]
struct LinearBackward;
#[derive(Debug)]
struct ModulatedNormBackward;
#[derive(Debug)]
struct GatedAddBackward;
#[derive(Debug)]
struct GegluBackward;
#[derive(Debug)]
struct AttentionBackward;

impl<B: Kernels> Backward<B, 3> for LinearBackward {
    type State = (FloatTensor<B>, FloatTensor<B>, bool);

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let (x, w, bf16) = ops.state;
        let [node_x, node_w, node_b] = ops.parents;
        let (dx, dw, db) = B::linear_backward(x, w, grad, node_x.is_some(), bf16);
        for (node, gradient) in [(node_x, dx), (node_w, Some(dw)), (node_b, Some(db))] {
            if let (Some(node), Some(gradient)) = (node, gradient) {
                grads.register::<B>(node.id, gradient);
            }
        }
    }
}

impl<B: Kernels> Backward<B, 3> for ModulatedNormBackward {
    type State = (FloatTensor<B>, FloatTensor<B>);

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let (x, scale) = ops.state.clone();
        register::<B, _, 3>(grads, &ops, B::modulated_norm_backward(x, scale, grad));
    }
}

impl<B: Kernels> Backward<B, 3> for GatedAddBackward {
    type State = (FloatTensor<B>, FloatTensor<B>);

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let (gate, y) = ops.state.clone();
        let [dgate, dy] = B::gated_add_backward(gate, y, grad.clone());
        register::<B, _, 3>(grads, &ops, [grad, dgate, dy]);
    }
}

impl<B: Kernels> Backward<B, 1> for GegluBackward {
    type State = FloatTensor<B>;

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        register::<B, _, 1>(grads, &ops, [B::geglu_backward(ops.state.clone(), grad)]);
    }
}

impl<B: Kernels> Backward<B, 3> for AttentionBackward {
    type State = ([FloatTensor<B>; 5], usize);

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let ([qkv, q_weight, k_weight, out, log_sum], heads) = ops.state.clone();
        let gradients = B::attention_backward(qkv, q_weight, k_weight, out, log_sum, grad, heads);
        register::<B, _, 3>(grads, &ops, gradients);
    }
}

fn register<B: Backend, S, const N: usize>(grads: &mut Gradients, ops: &Ops<S, N>, gradients: Grads<B, N>) {
    for (node, gradient) in ops.parents.iter().zip(gradients) {
        if let Some(node) = node {
            grads.register::<B>(node.id, gradient);
        }
    }
}

impl<B: Kernels, C: CheckpointStrategy> FusedOps for Autodiff<B, C> {
    fn linear_bias(x: FloatTensor<Self>, w: FloatTensor<Self>, b: FloatTensor<Self>, bf16: bool) -> FloatTensor<Self> {
        let ((x, node_x), (w, node_w), (b, node_b)) = (x.into_parts(), w.into_parts(), b.into_parts());
        let out = B::linear_forward(x.clone(), w.clone(), b, bf16);
        match LinearBackward.prepare::<C>([node_x, node_w, node_b]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => prep.finish((x, w, bf16), out),
            OpsKind::UnTracked(prep) => prep.finish(out),
        }
    }

    fn modulated_norm(x: FloatTensor<Self>, shift: FloatTensor<Self>, scale: FloatTensor<Self>) -> FloatTensor<Self> {
        let ((x, nx), (shift, n_shift), (scale, n_scale)) = (x.into_parts(), shift.into_parts(), scale.into_parts());
        let out = B::modulated_norm_forward(x.clone(), shift, scale.clone());
        match ModulatedNormBackward.prepare::<C>([nx, n_shift, n_scale]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => prep.finish((x, scale), out),
            OpsKind::UnTracked(prep) => prep.finish(out),
        }
    }

    fn gated_add(x: FloatTensor<Self>, gate: FloatTensor<Self>, y: FloatTensor<Self>) -> FloatTensor<Self> {
        let ((x, node_x), (gate, node_gate), (y, node_y)) = (x.into_parts(), gate.into_parts(), y.into_parts());
        let out = B::gated_add_forward(x, gate.clone(), y.clone());
        match GatedAddBackward.prepare::<C>([node_x, node_gate, node_y]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => prep.finish((gate, y), out),
            OpsKind::UnTracked(prep) => prep.finish(out),
        }
    }

    fn geglu(x: FloatTensor<Self>) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        let out = B::geglu_forward(x.clone());
        match GegluBackward.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => prep.finish(x, out),
            OpsKind::UnTracked(prep) => prep.finish(out),
        }
    }

    fn qk_norm_attention(
        qkv: FloatTensor<Self>,
        q_weight: FloatTensor<Self>,
        k_weight: FloatTensor<Self>,
        heads: usize,
        queries: usize,
    ) -> FloatTensor<Self> {
        let ((qkv, n_qkv), (qw, n_qw), (kw, n_kw)) = (qkv.into_parts(), q_weight.into_parts(), k_weight.into_parts());
        let (out, log_sum) = B::attention_forward(qkv.clone(), qw.clone(), kw.clone(), heads, queries);
        match AttentionBackward.prepare::<C>([n_qkv, n_qw, n_kw]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => prep.finish(([qkv, qw, kw, out.clone(), log_sum], heads), out),
            OpsKind::UnTracked(prep) => prep.finish(out),
        }
    }
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

fn tensor(values: Vec<f32>, shape: &[usize]) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape.to_vec()))
}

fn dims<const D: usize>(t: &FlexTensor) -> [usize; D] {
    t.layout().shape().dims()
}

impl Kernels for Flex {
    fn linear_forward(x: FlexTensor, w: FlexTensor, b: FlexTensor, bf16: bool) -> FlexTensor {
        linear::forward(x, w, b, bf16)
    }

    fn linear_backward(
        x: FlexTensor,
        w: FlexTensor,
        grad: FlexTensor,
        need_x: bool,
        bf16: bool,
    ) -> (Option<FlexTensor>, FlexTensor, FlexTensor) {
        linear::backward(x, w, grad, need_x, bf16)
    }

    fn modulated_norm_forward(x: FlexTensor, shift: FlexTensor, scale: FlexTensor) -> FlexTensor {
        pointwise::modulated_norm(x, shift, scale)
    }

    fn modulated_norm_backward(x: FlexTensor, scale: FlexTensor, grad: FlexTensor) -> Grads<Self, 3> {
        pointwise::modulated_norm_backward(x, scale, grad)
    }

    fn gated_add_forward(x: FlexTensor, gate: FlexTensor, y: FlexTensor) -> FlexTensor {
        pointwise::gated_add(x, gate, y)
    }

    fn gated_add_backward(gate: FlexTensor, y: FlexTensor, grad: FlexTensor) -> Grads<Self, 2> {
        pointwise::gated_add_backward(gate, y, grad)
    }

    fn geglu_forward(x: FlexTensor) -> FlexTensor {
        pointwise::geglu(x)
    }

    fn geglu_backward(x: FlexTensor, grad: FlexTensor) -> FlexTensor {
        pointwise::geglu_backward(x, grad)
    }

    fn attention_forward(
        qkv: FlexTensor,
        q_weight: FlexTensor,
        k_weight: FlexTensor,
        heads: usize,
        queries: usize,
    ) -> (FlexTensor, FlexTensor) {
        attention::forward(qkv, q_weight, k_weight, heads, queries)
    }

    fn attention_backward(
        qkv: FlexTensor,
        q_weight: FlexTensor,
        k_weight: FlexTensor,
        out: FlexTensor,
        log_sum: FlexTensor,
        grad: FlexTensor,
        heads: usize,
    ) -> Grads<Self, 3> {
        attention::backward(qkv, q_weight, k_weight, out, log_sum, grad, heads)
    }
}
