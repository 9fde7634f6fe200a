//! The five differentiable operations that a transformer block is made of.
//!
//! Each has two implementations: [`reference`], a few lines of tensor operations that run on any device and say what
//! is computed, and [`crate::kernels`], fused Rust for the CPU with hand-written gradients. Tests hold the second to
//! the first.

use burn::{
    backend::Dispatch,
    tensor::{Device, Tensor},
};

use crate::kernels::FusedOps;

/// Epsilon of both norms.
pub(crate) const EPS: f32 = 1e-6;

/// Whether a tensor lives where the fused operations run.
fn is_cpu(device: &Device) -> bool {
    device == &Device::flex()
}

/// How the products of linear layers are computed. Everything else is in f32 always.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Compute {
    /// In f32.
    #[default]
    F32,
    /// Operands rounded to bf16, sums in f32. On a CPU without AVX-512 BF16 instructions: in f32.
    Bf16,
}

/// `x W^T + b`; `x` `[..., in]`, `w` `[out, in]`, `b` `[out]`.
pub(crate) fn linear<const D: usize>(x: Tensor<D>, w: Tensor<2>, b: Tensor<1>, compute: Compute) -> Tensor<D> {
    if is_cpu(&x.device()) {
        let (x, w, b) = (x.into_dispatch(), w.into_dispatch(), b.into_dispatch());
        return Tensor::from_dispatch(Dispatch::linear_bias(x, w, b, compute == Compute::Bf16));
    }
    reference::linear(x, w, b, compute)
}

/// Layer norm without weights, then `y (1 + scale) + shift`; `x` `[b, t, d]`, `shift` and `scale` `[b, d]`.
pub(crate) fn modulated_norm(x: Tensor<3>, shift: Tensor<2>, scale: Tensor<2>) -> Tensor<3> {
    if is_cpu(&x.device()) {
        let (x, shift, scale) = (x.into_dispatch(), shift.into_dispatch(), scale.into_dispatch());
        return Tensor::from_dispatch(Dispatch::modulated_norm(x, shift, scale));
    }
    reference::modulated_norm(x, shift, scale)
}

/// `x + gate y`; `x` and `y` `[b, t, d]`, `gate` `[b, d]`.
pub(crate) fn gated_add(x: Tensor<3>, gate: Tensor<2>, y: Tensor<3>) -> Tensor<3> {
    if is_cpu(&x.device()) {
        let (x, gate, y) = (x.into_dispatch(), gate.into_dispatch(), y.into_dispatch());
        return Tensor::from_dispatch(Dispatch::gated_add(x, gate, y));
    }
    reference::gated_add(x, gate, y)
}

/// The halves `(a, g)` of the last axis as `a gelu(g)`, exact GELU; `[b, t, 2 f]` to `[b, t, f]`.
pub(crate) fn geglu(x: Tensor<3>) -> Tensor<3> {
    if is_cpu(&x.device()) {
        return Tensor::from_dispatch(Dispatch::geglu(x.into_dispatch()));
    }
    reference::geglu(x)
}

/// Self-attention with RMS norm of queries and keys per head.
///
/// `qkv` `[b, t, 3 d]` with columns ordered `[3, heads, d / heads]`, `q_weight` and `k_weight` `[d / heads]`. The
/// result is computed for the last `queries` tokens: `[b, queries, d]`.
pub(crate) fn attention(
    qkv: Tensor<3>,
    q_weight: Tensor<1>,
    k_weight: Tensor<1>,
    heads: usize,
    queries: usize,
) -> Tensor<3> {
    if is_cpu(&qkv.device()) {
        let (qkv, q_weight, k_weight) = (qkv.into_dispatch(), q_weight.into_dispatch(), k_weight.into_dispatch());
        return Tensor::from_dispatch(Dispatch::qk_norm_attention(qkv, q_weight, k_weight, heads, queries));
    }
    reference::attention(qkv, q_weight, k_weight, heads, queries)
}

/// The same operations from Burn's own: any device, differentiated by Burn.
pub(crate) mod reference {
    use burn::tensor::{
        FloatDType, Tensor,
        activation::gelu,
        module::{attention as scaled_dot_product, linear as burn_linear},
        ops::AttentionModuleOptions,
    };

    use super::{Compute, EPS};

    pub fn linear<const D: usize>(x: Tensor<D>, w: Tensor<2>, b: Tensor<1>, compute: Compute) -> Tensor<D> {
        match compute {
            Compute::F32 => burn_linear(x, w.transpose(), Some(b)),
            Compute::Bf16 => {
                let (x, w) = (x.cast(FloatDType::BF16), w.cast(FloatDType::BF16));
                burn_linear(x, w.transpose(), None).cast(FloatDType::F32) + b.unsqueeze::<D>()
            }
        }
    }

    pub fn modulated_norm(x: Tensor<3>, shift: Tensor<2>, scale: Tensor<2>) -> Tensor<3> {
        let centred = x.clone() - x.mean_dim(2);
        let variance = centred.clone().square().mean_dim(2);
        let y = centred / (variance + EPS).sqrt();
        y * (scale + 1.0).unsqueeze_dim::<3>(1) + shift.unsqueeze_dim::<3>(1)
    }

    pub fn gated_add(x: Tensor<3>, gate: Tensor<2>, y: Tensor<3>) -> Tensor<3> {
        x + y * gate.unsqueeze_dim::<3>(1)
    }

    pub fn geglu(x: Tensor<3>) -> Tensor<3> {
        let f = x.dims()[2] / 2;
        x.clone().narrow(2, 0, f) * gelu(x.narrow(2, f, f))
    }

    pub fn rms_norm<const D: usize>(x: Tensor<D>, weight: Tensor<1>) -> Tensor<D> {
        let mean_square = x.clone().square().mean_dim(D - 1);
        x / (mean_square + EPS).sqrt() * weight.unsqueeze::<D>()
    }

    pub fn attention(
        qkv: Tensor<3>,
        q_weight: Tensor<1>,
        k_weight: Tensor<1>,
        heads: usize,
        queries: usize,
    ) -> Tensor<3> {
        let [b, t, d3] = qkv.dims();
        let width = d3 / 3 / heads;
        let part = |i: usize| {
            qkv.clone().narrow(2, i * heads * width, heads * width).reshape([b, t, heads, width]).swap_dims(1, 2)
        };
        let q = rms_norm(part(0).narrow(2, t - queries, queries), q_weight); // [b, heads, queries, width]
        let k = rms_norm(part(1), k_weight);
        let mixed = scaled_dot_product(q, k, part(2), None, None, AttentionModuleOptions::default());
        mixed.swap_dims(1, 2).reshape([b, queries, heads * width])
    }
}
