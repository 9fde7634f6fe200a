//! A whole transformer block, forward and backward, from the operations of [`Kernels`].
//!
//! One operation instead of nine lets the backward pass start from the block's input alone (gradient checkpointing),
//! lets biases be added where their products are read (which is where their gradients come from), and writes the six parts
//! of the modulation's gradient once.

use burn::{
    backend::{Backend, ExtensionType, TensorMetadata, tensor::FloatTensor},
    tensor::{FloatDType, Shape, Slice},
};

use super::{Kernels, Product};
use crate::Compute;

/// Weights of a block. Matrices are `[out, in]`.
#[derive(Clone, Debug, ExtensionType)]
pub(crate) struct Weights<B: Backend> {
    pub qkv: FloatTensor<B>,
    pub qkv_bias: FloatTensor<B>,
    pub q_norm: FloatTensor<B>,
    pub k_norm: FloatTensor<B>,
    pub out: FloatTensor<B>,
    pub out_bias: FloatTensor<B>,
    pub inner: FloatTensor<B>,
    pub inner_bias: FloatTensor<B>,
    pub down: FloatTensor<B>,
    pub down_bias: FloatTensor<B>,
}

/// Their number.
pub(crate) const WEIGHTS: usize = 10;

impl<B: Backend> Weights<B> {
    /// In the order of the fields.
    pub fn into_array(self) -> [FloatTensor<B>; WEIGHTS] {
        let Self { qkv, qkv_bias, q_norm, k_norm, out, out_bias, inner, inner_bias, down, down_bias } = self;
        [qkv, qkv_bias, q_norm, k_norm, out, out_bias, inner, inner_bias, down, down_bias]
    }

    /// The reverse of [`into_array`](Self::into_array).
    pub fn from_array(weights: [FloatTensor<B>; WEIGHTS]) -> Self {
        let [qkv, qkv_bias, q_norm, k_norm, out, out_bias, inner, inner_bias, down, down_bias] = weights;
        Self { qkv, qkv_bias, q_norm, k_norm, out, out_bias, inner, inner_bias, down, down_bias }
    }
}

/// What a block needs to know besides tensors.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BlockSettings {
    pub heads: usize,
    /// How many of the last tokens leave the block.
    pub queries: usize,
    pub compute: Compute,
    /// Keep the input alone for the gradient, and compute the rest again.
    pub recompute: bool,
}

/// What the gradient needs besides the inputs. Shapes of `t` tokens, `q` of them queries.
#[derive(Clone, Debug)]
pub(crate) struct Saved<B: Backend> {
    normed_a: FloatTensor<B>, // [b, t, d]
    qkv: Product<B>,          // [b, t, 3 d]
    mixed: FloatTensor<B>,    // [b, q, d]
    log_sum: FloatTensor<B>,  // [b, heads, q]
    attended: Product<B>,     // [b, q, d]
    middle: FloatTensor<B>,   // [b, q, d]
    normed_f: FloatTensor<B>, // [b, q, d]
    inner: Product<B>,        // [b, q, 2 f]
    hidden: FloatTensor<B>,   // [b, q, f]
    down: Product<B>,         // [b, q, d]
}

/// Part `i` of `n` of the last axis of `[b, n d]`.
fn part<B: Backend>(t: &FloatTensor<B>, i: usize, n: usize) -> FloatTensor<B> {
    let [_, width] = t.shape().dims();
    let d = width / n;
    B::float_slice(t.clone(), &[Slice::full(), Slice::from(i * d..(i + 1) * d)])
}

/// The last `n` tokens of `[b, t, d]`.
fn last<B: Backend>(t: FloatTensor<B>, n: usize) -> FloatTensor<B> {
    let [_, tokens, _] = t.shape().dims();
    if n == tokens {
        return t;
    }
    B::float_slice(t, &[Slice::full(), Slice::from(tokens - n..tokens), Slice::full()])
}

/// `x` `[b, t, d]` and `modulation` `[b, 6 d]` (shift, scale and gate of attention and of the feed-forward network) to
/// the last `queries` tokens `[b, queries, d]`; if `keep`, also what [`backward`] needs.
pub(crate) fn forward<B: Kernels>(
    x: FloatTensor<B>,
    modulation: &FloatTensor<B>,
    w: &Weights<B>,
    settings: BlockSettings,
    keep: bool,
) -> (FloatTensor<B>, Option<Saved<B>>) {
    let BlockSettings { heads, queries, compute, .. } = settings;
    let m = |i: usize| part::<B>(modulation, i, 6);
    // What is not kept is freed as soon as it has been used.
    fn kept<T: Clone>(keep: bool, t: &T) -> Option<T> {
        keep.then(|| t.clone())
    }

    let normed_a = B::modulated_norm_forward(x.clone(), m(0), m(1), compute);
    let saved_normed_a = kept(keep, &normed_a);
    let qkv = B::product_forward(normed_a, w.qkv.clone(), w.qkv_bias.clone(), compute);
    let saved_qkv = kept(keep, &qkv);
    let norms = Some([w.q_norm.clone(), w.k_norm.clone()]);
    let (mixed, log_sum) = B::attention_forward(qkv, norms, heads, queries, keep, compute);
    let saved_mixed = kept(keep, &mixed);
    let attended = B::product_forward(mixed, w.out.clone(), w.out_bias.clone(), compute);
    let saved_attended = kept(keep, &attended);
    let middle = B::gated_add_forward(last::<B>(x, queries), m(2), attended);

    let normed_f = B::modulated_norm_forward(middle.clone(), m(3), m(4), compute);
    let saved_normed_f = kept(keep, &normed_f);
    let inner = B::product_forward(normed_f, w.inner.clone(), w.inner_bias.clone(), compute);
    let saved_inner = kept(keep, &inner);
    let hidden = B::geglu_forward(inner);
    let saved_hidden = kept(keep, &hidden);
    let down = B::product_forward(hidden, w.down.clone(), w.down_bias.clone(), compute);
    let saved_down = kept(keep, &down);
    let saved_middle = kept(keep, &middle);
    let out = B::gated_add_forward(middle, m(5), down);

    let saved = || {
        Some(Saved {
            normed_a: saved_normed_a?,
            qkv: saved_qkv?,
            mixed: saved_mixed?,
            log_sum: log_sum?,
            attended: saved_attended?,
            middle: saved_middle?,
            normed_f: saved_normed_f?,
            inner: saved_inner?,
            hidden: saved_hidden?,
            down: saved_down?,
        })
    };
    (out, if keep { saved() } else { None })
}

/// Gradients of `x`, `modulation` and the weights.
pub(crate) fn backward<B: Kernels>(
    x: FloatTensor<B>,
    modulation: &FloatTensor<B>,
    w: &Weights<B>,
    saved: Saved<B>,
    grad: FloatTensor<B>,
    settings: BlockSettings,
) -> (FloatTensor<B>, FloatTensor<B>, Weights<B>) {
    let BlockSettings { heads, queries, compute, .. } = settings;
    let m = |i: usize| part::<B>(modulation, i, 6);
    let bias = |gradient: Option<FloatTensor<B>>| gradient.expect("all products have a bias");

    let ([d_gate_f, d_down_out], d_down_bias) = B::gated_add_backward(m(5), saved.down, grad.clone());
    let [d_hidden, d_down] = B::product_backward(saved.hidden, w.down.clone(), d_down_out, compute);
    let (d_inner, d_in_bias) = B::geglu_backward(saved.inner, d_hidden);
    let [d_normed_f, d_in] = B::product_backward(saved.normed_f, w.inner.clone(), d_inner, compute);
    let [d_middle, d_shift_f, d_scale_f] =
        B::modulated_norm_and_residual_backward(saved.middle, m(4), d_normed_f, grad);

    let ([d_gate_a, d_attended], d_out_bias) = B::gated_add_backward(m(2), saved.attended, d_middle.clone());
    let [d_mixed, d_out] = B::product_backward(saved.mixed.clone(), w.out.clone(), d_attended, compute);
    let norms = Some([w.q_norm.clone(), w.k_norm.clone()]);
    let d = B::attention_backward(saved.qkv, norms, saved.mixed, saved.log_sum, d_mixed, heads, compute);
    let [d_normed_a, d_qkv] = B::product_backward(saved.normed_a, w.qkv.clone(), d.qkv, compute);
    let [d_q_norm, d_k_norm] = d.norms.expect("there were norms");
    let residual = first_padded::<B>(d_middle, x.shape(), queries);
    let [dx, d_shift_a, d_scale_a] = B::modulated_norm_and_residual_backward(x, m(1), d_normed_a, residual);

    let dm = B::float_cat(vec![d_shift_a, d_scale_a, d_gate_a, d_shift_f, d_scale_f, d_gate_f], 1);
    let dw = Weights {
        qkv: d_qkv,
        qkv_bias: bias(d.bias),
        q_norm: d_q_norm,
        k_norm: d_k_norm,
        out: d_out,
        out_bias: bias(d_out_bias),
        inner: d_in,
        inner_bias: bias(d_in_bias),
        down: d_down,
        down_bias: bias(d_down_bias),
    };
    (dx, dm, dw)
}

/// `[b, n, d]` as the last tokens of `[b, t, d]`, after zeros.
fn first_padded<B: Backend>(t: FloatTensor<B>, shape: Shape, n: usize) -> FloatTensor<B> {
    let [_, tokens, _] = shape.dims();
    if n == tokens {
        return t;
    }
    let zeros = B::float_zeros(shape, &t.device(), FloatDType::F32);
    B::float_slice_assign(zeros, &[Slice::full(), Slice::from(tokens - n..tokens), Slice::full()], t)
}
