//! The differentiable operations that a transformer is made of.
//!
//! Each has two implementations: [`reference`], a few lines of tensor operations that say what is computed, and
//! [`crate::kernels`], fused, with hand-written gradients. Tests hold the second to the first.

use burn::{
    backend::Dispatch,
    tensor::{Device, FloatDType, Tensor},
};

use crate::compute::{Compute, is_cpu};
use crate::kernels::{
    autodiff::FusedOps,
    block::{BlockSettings, Weights},
};

impl Compute {
    /// What [`Auto`](Self::Auto) means on a device; the others mean themselves: bf16 on a GPU that has it, and on a CPU with
    /// Intel's tiles or AVX-512 BF16 instructions, else f32. The same on the same machine always, however busy it is.
    pub fn on(self, device: &Device) -> Self {
        match self {
            Self::Auto if is_cpu(device) && crate::kernels::cpu_has_bf16() => Self::Bf16,
            Self::Auto if !is_cpu(device) && Self::Bf16.supported(device) => Self::Bf16,
            Self::Auto => Self::F32,
            chosen => chosen,
        }
    }
}

/// As activations between operations are on a GPU.
pub(crate) fn activation<const D: usize>(t: Tensor<D>, compute: Compute) -> Tensor<D> {
    match compute {
        Compute::F32 | Compute::Auto => t,
        Compute::Bf16 => t.cast(FloatDType::BF16),
        Compute::F16 => t.cast(FloatDType::F16),
    }
}

/// `x W^T + b`; `x` `[..., in]`, `w` `[out, in]`, `b` `[out]`.
pub(crate) fn linear<const D: usize>(x: Tensor<D>, w: Tensor<2>, b: Tensor<1>, compute: Compute) -> Tensor<D> {
    let (x, w, b) = (x.into_dispatch(), w.into_dispatch(), b.into_dispatch());
    Tensor::from_dispatch(Dispatch::linear_bias(x, w, b, compute))
}

/// Layer norm without weights, then `y (1 + scale) + shift`; `x` `[b, t, d]`, `shift` and `scale` `[b, d]`.
pub(crate) fn modulated_norm(x: Tensor<3>, shift: Tensor<2>, scale: Tensor<2>, compute: Compute) -> Tensor<3> {
    let (x, shift, scale) = (x.into_dispatch(), shift.into_dispatch(), scale.into_dispatch());
    Tensor::from_dispatch(Dispatch::modulated_norm(x, shift, scale, compute))
}

/// `x + gate y`; `x` and `y` `[b, t, d]`, `gate` `[b, d]`.
pub(crate) fn gated_add(x: Tensor<3>, gate: Tensor<2>, y: Tensor<3>) -> Tensor<3> {
    let (x, gate, y) = (x.into_dispatch(), gate.into_dispatch(), y.into_dispatch());
    Tensor::from_dispatch(Dispatch::gated_add(x, gate, y))
}

/// The halves `(a, g)` of the last axis as `a gelu(g)`, exact GELU; `[b, t, 2 f]` to `[b, t, f]`.
pub(crate) fn geglu(x: Tensor<3>) -> Tensor<3> {
    Tensor::from_dispatch(Dispatch::geglu(x.into_dispatch()))
}

/// Self-attention with RMS norm of queries and keys per head.
///
/// `qkv` `[b, t, 3 d]` with columns ordered `[3, heads, d / heads]`, `q_weight` and `k_weight` `[d / heads]`. The
/// result is computed for the last `queries` tokens: `[b, queries, d]`. On a GPU, `qkv` is of the type to compute in.
pub(crate) fn attention(
    qkv: Tensor<3>,
    q_weight: Tensor<1>,
    k_weight: Tensor<1>,
    heads: usize,
    queries: usize,
    compute: Compute,
) -> Tensor<3> {
    let (qkv, q_weight, k_weight) = (qkv.into_dispatch(), q_weight.into_dispatch(), k_weight.into_dispatch());
    Tensor::from_dispatch(Dispatch::qk_norm_attention(qkv, q_weight, k_weight, heads, queries, compute))
}

/// Self-attention of all tokens, without norms; `qkv` as in [`attention`].
pub(crate) fn plain_attention(qkv: Tensor<3>, heads: usize, compute: Compute) -> Tensor<3> {
    Tensor::from_dispatch(Dispatch::plain_attention(qkv.into_dispatch(), heads, compute))
}

/// A whole transformer block, see [`crate::kernels::block`]. Of the attention's and the feed-forward network's layers:
/// `matrices` are qkv, out, in, down, and `vectors` qkv's bias, both norms' weights, the biases of out, in, down.
pub(crate) fn dit_block(
    x: Tensor<3>,
    modulation: Tensor<2>,
    matrices: [Tensor<2>; 4],
    vectors: [Tensor<1>; 6],
    settings: BlockSettings,
) -> Tensor<3> {
    let [qkv, out, inner, down] = matrices.map(Tensor::into_dispatch);
    let [qkv_bias, q_norm, k_norm, out_bias, inner_bias, down_bias] = vectors.map(Tensor::into_dispatch);
    let weights = Weights { qkv, qkv_bias, q_norm, k_norm, out, out_bias, inner, inner_bias, down, down_bias };
    Tensor::from_dispatch(Dispatch::dit_block(x.into_dispatch(), modulation.into_dispatch(), weights, settings))
}

/// The same operations from Burn's own: any device, differentiated by Burn.
pub(crate) mod reference {
    use burn::tensor::{
        FloatDType, Tensor,
        activation::gelu,
        module::{attention as scaled_dot_product, linear as burn_linear},
        ops::AttentionModuleOptions,
    };

    use super::Compute;
    use crate::kernels::EPS;

    pub fn linear<const D: usize>(x: Tensor<D>, w: Tensor<2>, b: Tensor<1>, compute: Compute) -> Tensor<D> {
        match compute {
            Compute::F32 | Compute::Auto => burn_linear(x, w.transpose(), Some(b)),
            Compute::Bf16 => half_linear(x, w, b, FloatDType::BF16),
            Compute::F16 => half_linear(x, w, b, FloatDType::F16),
        }
    }

    fn half_linear<const D: usize>(x: Tensor<D>, w: Tensor<2>, b: Tensor<1>, half: FloatDType) -> Tensor<D> {
        burn_linear(x.cast(half), w.cast(half).transpose(), None).cast(FloatDType::F32) + b.unsqueeze::<D>()
    }

    pub fn modulated_norm(x: Tensor<3>, shift: Tensor<2>, scale: Tensor<2>) -> Tensor<3> {
        let centerd = x.clone() - x.mean_dim(2);
        let variance = centerd.clone().square().mean_dim(2);
        let y = centerd / (variance + EPS).sqrt();
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

    /// Of all tokens, without norms.
    #[cfg(test)]
    pub fn plain_attention(qkv: Tensor<3>, heads: usize) -> Tensor<3> {
        let [b, t, d3] = qkv.dims();
        let width = d3 / 3 / heads;
        let [q, k, v] = std::array::from_fn(|i| {
            qkv.clone().narrow(2, i * heads * width, heads * width).reshape([b, t, heads, width]).swap_dims(1, 2)
        });
        let mixed = scaled_dot_product(q, k, v, None, None, AttentionModuleOptions::default());
        mixed.swap_dims(1, 2).reshape([b, t, heads * width])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_automatic_is_chosen_by_the_device() {
        let device = Device::flex();
        for chosen in [Compute::F32, Compute::Bf16, Compute::F16] {
            assert_eq!(chosen.on(&device), chosen);
        }
        let found = Compute::Auto.on(&device);
        assert!([Compute::F32, Compute::Bf16].contains(&found) && found.supported(&device));
        assert_eq!(Compute::Auto.on(&device.autodiff()), found);
        assert_eq!(found == Compute::Bf16, crate::kernels::cpu_has_bf16());
        for name in ["f32", "bf16", "f16", "auto"] {
            let compute: Compute = serde_json::from_value(name.into()).unwrap();
            assert_eq!(compute.to_string(), name);
        }
    }
}
