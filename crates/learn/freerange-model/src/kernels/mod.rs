//! Fused versions of the operations in [`crate::ops`], with hand-written gradients: Rust for the CPU ([`cpu`]), CubeCL
//! for everything else (`cube`).
//!
//! Burn's elementwise operations pass over memory once each; together they would take as long as the matrix products.
//! Here every operation reads its inputs once, and keeps for its gradient nothing but what it was given.
//!
//! [`Kernels`] are forward and backward of each on plain tensors, [`autodiff`] makes differentiable operations of them,
//! and [`block`] one operation of a whole transformer block.

pub(crate) mod autodiff;
pub(crate) mod block;
mod cpu;
#[cfg(feature = "gpu")]
mod cube;

pub(crate) use cpu::has_bf16 as cpu_has_bf16;

use burn::backend::{Backend, tensor::FloatTensor};

use crate::Compute;

/// Epsilon of both norms.
pub(crate) const EPS: f32 = 1e-6;

/// A gradient function's results, one per differentiable input.
pub(crate) type Grads<B, const N: usize> = [FloatTensor<B>; N];

/// The product of a linear layer, and the bias if it is still to be added by whoever reads the product next: a GPU
/// saves a pass over memory that way, a CPU's product starts from the bias.
pub(crate) type Product<B> = (FloatTensor<B>, Option<FloatTensor<B>>);

/// Gradients of an attention's inputs.
pub(crate) struct AttentionGrads<B: Backend> {
    /// `[b, t, 3 d]`
    pub qkv: FloatTensor<B>,
    /// `[3 d]`, as of [`Kernels::gated_add_backward`].
    pub bias: Option<FloatTensor<B>>,
    /// Both `[width]`, if there were norms.
    pub norms: Option<Grads<B, 2>>,
}

/// Forward and backward of each operation on plain tensors. Shapes as in [`crate::ops`].
///
/// On a GPU that computes in half precision, results of norms, products, GEGLU and attention are of that type, and
/// gradients are of their tensor's type; residuals, weights and their gradients, and statistics are f32 always.
pub(crate) trait Kernels: Backend {
    fn linear_forward(
        x: FloatTensor<Self>,
        w: FloatTensor<Self>,
        b: FloatTensor<Self>,
        compute: Compute,
    ) -> FloatTensor<Self>;
    /// Gradients of `x` (where asked for), `w` and `b`.
    fn linear_backward(
        x: FloatTensor<Self>,
        w: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        need_x: bool,
        compute: Compute,
    ) -> (Option<FloatTensor<Self>>, FloatTensor<Self>, FloatTensor<Self>);

    /// A linear layer whose reader adds the bias where the result says so.
    fn product_forward(
        x: FloatTensor<Self>,
        w: FloatTensor<Self>,
        b: FloatTensor<Self>,
        compute: Compute,
    ) -> Product<Self>;
    /// Gradients of `x` and `w`; that of the bias comes from the product's reader.
    fn product_backward(
        x: FloatTensor<Self>,
        w: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        compute: Compute,
    ) -> Grads<Self, 2>;

    fn modulated_norm_forward(
        x: FloatTensor<Self>,
        shift: FloatTensor<Self>,
        scale: FloatTensor<Self>,
        compute: Compute,
    ) -> FloatTensor<Self>;
    /// Gradients of `x`, `shift`, `scale`.
    fn modulated_norm_backward(
        x: FloatTensor<Self>,
        scale: FloatTensor<Self>,
        grad: FloatTensor<Self>,
    ) -> Grads<Self, 3>;

    /// The same for an `x` that is also added to something later: its gradient from there is `residual`.
    fn modulated_norm_and_residual_backward(
        x: FloatTensor<Self>,
        scale: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        residual: FloatTensor<Self>,
    ) -> Grads<Self, 3> {
        let [dx, d_shift, d_scale] = Self::modulated_norm_backward(x, scale, grad);
        [Self::float_add(residual, dx), d_shift, d_scale]
    }

    fn gated_add_forward(x: FloatTensor<Self>, gate: FloatTensor<Self>, y: Product<Self>) -> FloatTensor<Self>;
    /// Gradients of `gate`, `y` and its bias (on a CPU always, on others if it was to be added); that of `x` is `grad`
    /// itself.
    fn gated_add_backward(
        gate: FloatTensor<Self>,
        y: Product<Self>,
        grad: FloatTensor<Self>,
    ) -> (Grads<Self, 2>, Option<FloatTensor<Self>>);

    fn geglu_forward(x: Product<Self>) -> FloatTensor<Self>;
    /// Gradients of `x` and its bias, as there.
    fn geglu_backward(x: Product<Self>, grad: FloatTensor<Self>) -> Product<Self>;

    /// The mixed values `[b, queries, d]` and, if `keep`, the log of each softmax's denominator `[b, heads, queries]`.
    /// `norms` are the weights of the RMS norms of queries and keys; without, there are none. On a GPU, activations are
    /// of the type to compute in already.
    fn attention_forward(
        qkv: Product<Self>,
        norms: Option<Grads<Self, 2>>,
        heads: usize,
        queries: usize,
        keep: bool,
        compute: Compute,
    ) -> (FloatTensor<Self>, Option<FloatTensor<Self>>);
    /// Gradients from the inputs, both outputs and the gradient of the first.
    fn attention_backward(
        qkv: Product<Self>,
        norms: Option<Grads<Self, 2>>,
        out: FloatTensor<Self>,
        log_sum: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        heads: usize,
        compute: Compute,
    ) -> AttentionGrads<Self>;
}
