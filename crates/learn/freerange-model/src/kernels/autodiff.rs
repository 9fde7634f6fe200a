//! [`Kernels`] as differentiable operations, chosen by the tensors' device.

use burn::backend::{
    Autodiff, Backend, Flex,
    autodiff::{
        NodeId,
        checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
        grads::Gradients,
        ops::{Backward, Ops, OpsKind},
    },
    backend_extension,
    tensor::FloatTensor,
};
#[cfg(feature = "gpu")]
use burn_cubecl::CubeBackend;

use super::{
    Grads, Kernels,
    block::{self, BlockSettings, Saved, WEIGHTS, Weights},
};
use crate::Compute;

/// The operations as Burn sees them. Shapes as in [`crate::ops`].
#[backend_extension(Flex, Cube: cfg(feature = "gpu"), Autodiff)]
pub(crate) trait FusedOps: Backend {
    fn linear_bias(
        x: FloatTensor<Self>,
        w: FloatTensor<Self>,
        b: FloatTensor<Self>,
        compute: Compute,
    ) -> FloatTensor<Self>;
    fn modulated_norm(
        x: FloatTensor<Self>,
        shift: FloatTensor<Self>,
        scale: FloatTensor<Self>,
        compute: Compute,
    ) -> FloatTensor<Self>;
    fn gated_add(x: FloatTensor<Self>, gate: FloatTensor<Self>, y: FloatTensor<Self>) -> FloatTensor<Self>;
    fn geglu(x: FloatTensor<Self>) -> FloatTensor<Self>;
    /// With RMS norms of queries and keys.
    fn qk_norm_attention(
        qkv: FloatTensor<Self>,
        q_weight: FloatTensor<Self>,
        k_weight: FloatTensor<Self>,
        heads: usize,
        queries: usize,
        compute: Compute,
    ) -> FloatTensor<Self>;
    /// Without norms.
    fn plain_attention(qkv: FloatTensor<Self>, heads: usize, compute: Compute) -> FloatTensor<Self>;
    /// A whole transformer block, see [`block::forward`].
    fn dit_block(
        x: FloatTensor<Self>,
        modulation: FloatTensor<Self>,
        #[extension_type] weights: Weights<Self>,
        settings: BlockSettings,
    ) -> FloatTensor<Self>;
}

/// What is the same for every backend without gradients.
macro_rules! without_gradients {
    ($backend:ty) => {
        impl FusedOps for $backend {
            fn linear_bias(
                x: FloatTensor<Self>,
                w: FloatTensor<Self>,
                b: FloatTensor<Self>,
                compute: Compute,
            ) -> FloatTensor<Self> {
                Self::linear_forward(x, w, b, compute)
            }

            fn modulated_norm(
                x: FloatTensor<Self>,
                shift: FloatTensor<Self>,
                scale: FloatTensor<Self>,
                compute: Compute,
            ) -> FloatTensor<Self> {
                Self::modulated_norm_forward(x, shift, scale, compute)
            }

            fn gated_add(x: FloatTensor<Self>, gate: FloatTensor<Self>, y: FloatTensor<Self>) -> FloatTensor<Self> {
                Self::gated_add_forward(x, gate, (y, None))
            }

            fn geglu(x: FloatTensor<Self>) -> FloatTensor<Self> {
                Self::geglu_forward((x, None))
            }

            fn qk_norm_attention(
                qkv: FloatTensor<Self>,
                q_weight: FloatTensor<Self>,
                k_weight: FloatTensor<Self>,
                heads: usize,
                queries: usize,
                compute: Compute,
            ) -> FloatTensor<Self> {
                Self::attention_forward((qkv, None), Some([q_weight, k_weight]), heads, queries, false, compute).0
            }

            fn plain_attention(qkv: FloatTensor<Self>, heads: usize, compute: Compute) -> FloatTensor<Self> {
                let tokens = tokens::<Self>(&qkv);
                Self::attention_forward((qkv, None), None, heads, tokens, false, compute).0
            }

            fn dit_block(
                x: FloatTensor<Self>,
                modulation: FloatTensor<Self>,
                weights: Weights<Self>,
                settings: BlockSettings,
            ) -> FloatTensor<Self> {
                block::forward::<Self>(x, &modulation, &weights, settings, false).0
            }
        }
    };
}

without_gradients!(Flex);
#[cfg(feature = "gpu")]
without_gradients!(CubeBackend);

/// Of `[b, t, 3 d]`.
fn tokens<B: Backend>(qkv: &FloatTensor<B>) -> usize {
    burn::backend::TensorMetadata::shape(qkv).dims::<3>()[1]
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
#[derive(Debug)]
struct PlainAttentionBackward;
#[derive(Debug)]
struct BlockBackward;

impl<B: Kernels> Backward<B, 3> for LinearBackward {
    type State = (FloatTensor<B>, FloatTensor<B>, Compute);

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let (x, w, compute) = ops.state;
        let [node_x, node_w, node_b] = ops.parents;
        let (dx, dw, db) = B::linear_backward(x, w, grad, node_x.is_some(), compute);
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
        let parents = ops.parents.map(|p| p.map(|node| node.id));
        let (x, scale) = ops.state;
        register::<B, 3>(grads, parents, B::modulated_norm_backward(x, scale, grad));
    }
}

impl<B: Kernels> Backward<B, 3> for GatedAddBackward {
    type State = (FloatTensor<B>, FloatTensor<B>);

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let parents = ops.parents.map(|p| p.map(|node| node.id));
        let (gate, y) = ops.state;
        let ([dgate, dy], _) = B::gated_add_backward(gate, (y, None), grad.clone());
        register::<B, 3>(grads, parents, [grad, dgate, dy]);
    }
}

impl<B: Kernels> Backward<B, 1> for GegluBackward {
    type State = FloatTensor<B>;

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let parents = ops.parents.map(|p| p.map(|node| node.id));
        register::<B, 1>(grads, parents, [B::geglu_backward((ops.state, None), grad).0]);
    }
}

impl<B: Kernels> Backward<B, 3> for AttentionBackward {
    type State = ([FloatTensor<B>; 5], usize, Compute);

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let parents = ops.parents.map(|p| p.map(|node| node.id));
        let ([qkv, q_weight, k_weight, out, log_sum], heads, compute) = ops.state;
        let d = B::attention_backward((qkv, None), Some([q_weight, k_weight]), out, log_sum, grad, heads, compute);
        let [dq, dk] = d.norms.expect("there were norms");
        register::<B, 3>(grads, parents, [d.qkv, dq, dk]);
    }
}

impl<B: Kernels> Backward<B, 1> for PlainAttentionBackward {
    type State = ([FloatTensor<B>; 3], usize, Compute);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let parents = ops.parents.map(|p| p.map(|node| node.id));
        let ([qkv, out, log_sum], heads, compute) = ops.state;
        let d = B::attention_backward((qkv, None), None, out, log_sum, grad, heads, compute);
        register::<B, 1>(grads, parents, [d.qkv]);
    }
}

/// Inputs of a block: tokens, modulation, weights.
const PARENTS: usize = 2 + WEIGHTS;

impl<B: Kernels> Backward<B, PARENTS> for BlockBackward {
    type State = (FloatTensor<B>, FloatTensor<B>, Weights<B>, Option<Saved<B>>, BlockSettings);

    fn backward(self, ops: Ops<Self::State, PARENTS>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let parents = ops.parents.map(|p| p.map(|node| node.id));
        let (x, modulation, weights, saved, settings) = ops.state;
        let saved = saved.unwrap_or_else(|| {
            block::forward::<B>(x.clone(), &modulation, &weights, settings, true).1.expect("asked to keep it")
        });
        let (dx, dm, dw) = block::backward::<B>(x, &modulation, &weights, saved, grad, settings);
        let [x_node, m_node, w_nodes @ ..] = parents;
        register::<B, 2>(grads, [x_node, m_node], [dx, dm]);
        register::<B, WEIGHTS>(grads, w_nodes, dw.into_array());
    }
}

fn register<B: Backend, const N: usize>(grads: &mut Gradients, parents: [Option<NodeId>; N], gradients: Grads<B, N>) {
    for (node, gradient) in parents.into_iter().zip(gradients) {
        if let Some(node) = node {
            grads.register::<B>(node, gradient);
        }
    }
}

impl<B: Kernels, C: CheckpointStrategy> FusedOps for Autodiff<B, C> {
    fn linear_bias(
        x: FloatTensor<Self>,
        w: FloatTensor<Self>,
        b: FloatTensor<Self>,
        compute: Compute,
    ) -> FloatTensor<Self> {
        let ((x, node_x), (w, node_w), (b, node_b)) = (x.into_parts(), w.into_parts(), b.into_parts());
        match LinearBackward.prepare::<C>([node_x, node_w, node_b]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let out = B::linear_forward(x.clone(), w.clone(), b, compute);
                prep.finish((x, w, compute), out)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::linear_forward(x, w, b, compute)),
        }
    }

    fn modulated_norm(
        x: FloatTensor<Self>,
        shift: FloatTensor<Self>,
        scale: FloatTensor<Self>,
        compute: Compute,
    ) -> FloatTensor<Self> {
        let ((x, nx), (shift, n_shift), (scale, n_scale)) = (x.into_parts(), shift.into_parts(), scale.into_parts());
        match ModulatedNormBackward.prepare::<C>([nx, n_shift, n_scale]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let out = B::modulated_norm_forward(x.clone(), shift, scale.clone(), compute);
                prep.finish((x, scale), out)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::modulated_norm_forward(x, shift, scale, compute)),
        }
    }

    fn gated_add(x: FloatTensor<Self>, gate: FloatTensor<Self>, y: FloatTensor<Self>) -> FloatTensor<Self> {
        let ((x, node_x), (gate, node_gate), (y, node_y)) = (x.into_parts(), gate.into_parts(), y.into_parts());
        match GatedAddBackward.prepare::<C>([node_x, node_gate, node_y]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let out = B::gated_add_forward(x, gate.clone(), (y.clone(), None));
                prep.finish((gate, y), out)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::gated_add_forward(x, gate, (y, None))),
        }
    }

    fn geglu(x: FloatTensor<Self>) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        match GegluBackward.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let out = B::geglu_forward((x.clone(), None));
                prep.finish(x, out)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::geglu_forward((x, None))),
        }
    }

    fn qk_norm_attention(
        qkv: FloatTensor<Self>,
        q_weight: FloatTensor<Self>,
        k_weight: FloatTensor<Self>,
        heads: usize,
        queries: usize,
        compute: Compute,
    ) -> FloatTensor<Self> {
        let ((qkv, n_qkv), (qw, n_qw), (kw, n_kw)) = (qkv.into_parts(), q_weight.into_parts(), k_weight.into_parts());
        match AttentionBackward.prepare::<C>([n_qkv, n_qw, n_kw]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let norms = Some([qw.clone(), kw.clone()]);
                let (out, log_sum) = B::attention_forward((qkv.clone(), None), norms, heads, queries, true, compute);
                let log_sum = log_sum.expect("asked to keep it");
                prep.finish(([qkv, qw, kw, out.clone(), log_sum], heads, compute), out)
            }
            OpsKind::UnTracked(prep) => {
                prep.finish(B::attention_forward((qkv, None), Some([qw, kw]), heads, queries, false, compute).0)
            }
        }
    }

    fn plain_attention(qkv: FloatTensor<Self>, heads: usize, compute: Compute) -> FloatTensor<Self> {
        let (qkv, node) = qkv.into_parts();
        let tokens = tokens::<B>(&qkv);
        match PlainAttentionBackward.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let (out, log_sum) = B::attention_forward((qkv.clone(), None), None, heads, tokens, true, compute);
                prep.finish(([qkv, out.clone(), log_sum.expect("asked to keep it")], heads, compute), out)
            }
            OpsKind::UnTracked(prep) => {
                prep.finish(B::attention_forward((qkv, None), None, heads, tokens, false, compute).0)
            }
        }
    }

    fn dit_block(
        x: FloatTensor<Self>,
        modulation: FloatTensor<Self>,
        weights: Weights<Self>,
        settings: BlockSettings,
    ) -> FloatTensor<Self> {
        let ((x, node_x), (m, node_m)) = (x.into_parts(), modulation.into_parts());
        let (mut tensors, mut nodes) = (Vec::with_capacity(WEIGHTS), vec![node_x, node_m]);
        for weight in weights.into_array() {
            let (tensor, node) = weight.into_parts();
            tensors.push(tensor);
            nodes.push(node);
        }
        let weights = Weights::<B>::from_array(tensors.try_into().expect("one for each weight"));
        let nodes: [_; PARENTS] = nodes.try_into().expect("one for each parent");
        match BlockBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let (out, saved) = block::forward::<B>(x.clone(), &m, &weights, settings, !settings.recompute);
                prep.finish((x, m, weights, saved, settings), out)
            }
            OpsKind::UnTracked(prep) => prep.finish(block::forward::<B>(x, &m, &weights, settings, false).0),
        }
    }
}
