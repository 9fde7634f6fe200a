//! The diffusion transformer: one sequence of registers, image tokens and Gaussian tokens.
//!
//! Blocks are DiT's (Peebles and Xie 2023, adaLN-Zero) with QK RMS norm and GEGLU. The network predicts the clean
//! Gaussians. Gaussian tokens carry no position: which Gaussian is which follows from its noise alone.

use burn::{
    module::{Module, Param},
    tensor::{Device, Tensor, TensorData, activation::silu},
};

use crate::{
    ModelConfig, ModelError,
    compute::Compute,
    config::{CHANNELS, ModelKind, PLACE},
    kernels::block::BlockSettings,
    layers::{Builder, Init, Linear, NormWeight, Source},
    lift::{CellViews, Lift},
    ops,
};

/// The diffusion transformer.
#[derive(Module, Debug)]
pub struct Dit {
    registers: Param<Tensor<2>>, // [registers, d]
    img_in: Linear,
    gs_in: Option<Linear>, // of flow matching, as is the time
    t_mlp: Option<TimeMlp>,
    lift: Option<Lift>,                // of voxel-aligned models
    latents: Option<Param<Tensor<2>>>, // learned tokens instead, [tokens, d]
    blocks: Vec<Block>,
    output: Output,
    gaussians_per_token: usize,
    gradient_channels: bool,
    estimate_channels: bool,
    observed: usize,
    time_features: usize,
    #[module(skip)]
    preconditioning: Option<[f32; CHANNELS]>,
    #[module(skip)]
    compute: Compute,
    #[module(skip)]
    recompute: bool,
}

#[derive(Module, Debug)]
struct TimeMlp {
    first: Linear,
    second: Linear,
}

/// What the network is told of the Gaussians besides their noisy selves. What is missing is zeros.
#[derive(Clone, Debug, Default)]
pub struct Feedback {
    /// The photometric gradient at the noisy Gaussians or at an estimate of the clean ones, each channel scaled to unit
    /// RMS. `[b, n, 14]`
    pub gradient: Option<Tensor<3>>,
    /// An earlier estimate of the clean Gaussians, normalized. `[b, n, 14]`
    pub estimate: Option<Tensor<3>>,
    /// What the input views show of that estimate. `[b, n, 9]`
    pub observation: Option<Tensor<3>>,
}

/// A gradient alone, if any.
impl From<Option<Tensor<3>>> for Feedback {
    fn from(gradient: Option<Tensor<3>>) -> Self {
        Self { gradient, ..Self::default() }
    }
}

/// One transformer block.
#[derive(Module, Debug)]
pub(crate) struct Block {
    adaln: Option<Linear>,
    norms: Option<Param<Tensor<2>>>, // without a time: learned shift and scale of both norms, [4, d]; gates are 1
    attn: Attention,
    ffn: FeedForward,
}

#[derive(Module, Debug)]
struct Attention {
    qkv: Linear,
    q_norm: NormWeight,
    k_norm: NormWeight,
    out: Linear,
    heads: usize,
}

#[derive(Module, Debug)]
struct FeedForward {
    proj_in: Linear,
    proj_out: Linear,
}

#[derive(Module, Debug)]
struct Output {
    adaln: Option<Linear>,
    norm: Option<Param<Tensor<2>>>, // without a time: learned shift and scale, [2, d]
    linear: Linear,
}

/// Sinusoidal embedding of the time: cosines, then sines, of 1000 t at periods from 2 pi to 2 pi x 10^4 (DiT).
///
/// `t`: `[b]` in 0..1; returns `[b, features]`.
pub fn time_embedding(t: Tensor<1>, features: usize) -> Tensor<2> {
    let half = features / 2;
    let frequencies: Vec<f32> =
        (0..half).map(|i| (1000.0 * (-(10_000f64.ln()) * i as f64 / half as f64).exp()) as f32).collect();
    let frequencies = Tensor::<1>::from_data(TensorData::new(frequencies, [half]), &t.device());
    let angle = t.unsqueeze_dim::<2>(1) * frequencies.unsqueeze_dim::<2>(0); // [b, half]
    Tensor::cat(vec![angle.clone().cos(), angle.sin()], 1)
}

impl Block {
    pub(crate) fn build<S: Source>(
        config: &ModelConfig,
        name: &str,
        builder: &mut Builder<'_, S>,
    ) -> Result<Self, ModelError> {
        let (d, f) = (config.hidden, config.ffn_width());
        let name = |part: &str| format!("{name}.{part}");
        Ok(Self {
            adaln: match config.kind.one_pass() {
                false => Some(builder.linear(&name("adaln"), d, 6 * d, Init::Zeros)?),
                true => None,
            },
            norms: match config.kind.one_pass() {
                false => None,
                true => Some(builder.param(&name("norms"), [4, d], Init::Zeros)?),
            },
            attn: Attention {
                qkv: builder.linear(&name("attn.qkv"), d, 3 * d, Init::Xavier)?,
                q_norm: builder.norm_weight(&name("attn.q_norm"), config.head_width())?,
                k_norm: builder.norm_weight(&name("attn.k_norm"), config.head_width())?,
                out: builder.linear(&name("attn.out"), d, d, Init::Xavier)?,
                heads: config.heads,
            },
            ffn: FeedForward {
                proj_in: builder.linear(&name("ffn.proj_in"), d, 2 * f, Init::Xavier)?,
                proj_out: builder.linear(&name("ffn.proj_out"), f, d, Init::Xavier)?,
            },
        })
    }

    /// Shift, scale and gate of attention, then of the feed-forward network: `[b, 6 d]`, from `[b, d]`.
    fn modulation(&self, silu_c: Tensor<2>) -> Tensor<2> {
        if let Some(adaln) = &self.adaln {
            return adaln.forward(silu_c);
        }
        let norms = self.norms.as_ref().expect("built with either").val(); // [4, d]
        let [b, d] = [silu_c.dims()[0], norms.dims()[1]];
        let gate = Tensor::ones([1, d], &norms.device());
        let half = |i: usize| norms.clone().narrow(0, i, 2);
        Tensor::cat(vec![half(0), gate.clone(), half(2), gate], 0).reshape([1, 6 * d]).repeat_dim(0, b)
    }

    /// `x` `[b, t, d]`, `silu_c` `[b, d]`; returns the last `queries` tokens, `[b, queries, d]`.
    pub(crate) fn forward(
        &self,
        x: Tensor<3>,
        silu_c: Tensor<2>,
        queries: usize,
        compute: Compute,
        recompute: bool,
    ) -> Tensor<3> {
        let Attention { qkv, q_norm, k_norm, out, heads } = &self.attn;
        let FeedForward { proj_in, proj_out } = &self.ffn;
        let settings = BlockSettings { heads: *heads, queries, compute, recompute };
        let matrices = [&qkv.weight, &out.weight, &proj_in.weight, &proj_out.weight].map(|w| w.val());
        let vectors = [&qkv.bias, &q_norm.weight, &k_norm.weight, &out.bias, &proj_in.bias, &proj_out.bias];
        ops::dit_block(x, self.modulation(silu_c), matrices, vectors.map(|w| w.val()), settings)
    }

    /// The weights of both norms of the attention.
    pub(crate) fn norms(&self) -> [Tensor<1>; 2] {
        [self.attn.q_norm.weight.val(), self.attn.k_norm.weight.val()]
    }

    /// The same as single operations, which say what a block computes.
    pub(crate) fn forward_by_parts(&self, x: Tensor<3>, silu_c: Tensor<2>, queries: usize, parts: &Parts) -> Tensor<3> {
        let [_, tokens, _] = x.dims();
        let linear = |layer: &Linear, x: Tensor<3>| (parts.linear)(x, layer.weight.val(), layer.bias.val());
        let [shift_a, scale_a, gate_a, shift_f, scale_f, gate_f] = chunks(self.modulation(silu_c));
        let Attention { qkv, q_norm, k_norm, out, heads } = &self.attn;
        let y = linear(qkv, (parts.norm)(x.clone(), shift_a, scale_a)); // [b, t, 3 d]
        let y = (parts.attention)(y, q_norm.weight.val(), k_norm.weight.val(), *heads, queries);
        let x = if queries == tokens { x } else { x.narrow(1, tokens - queries, queries) };
        let x = (parts.gated)(x, gate_a, linear(out, y));
        let y = linear(&self.ffn.proj_in, (parts.norm)(x.clone(), shift_f, scale_f)); // [b, t, 2 ffn]
        let y = linear(&self.ffn.proj_out, (parts.geglu)(y));
        (parts.gated)(x, gate_f, y)
    }
}

/// The operations of a block, one by one: fused ones, or their readable twins.
pub(crate) struct Parts {
    pub linear: fn(Tensor<3>, Tensor<2>, Tensor<1>) -> Tensor<3>,
    pub norm: fn(Tensor<3>, Tensor<2>, Tensor<2>) -> Tensor<3>,
    pub gated: fn(Tensor<3>, Tensor<2>, Tensor<3>) -> Tensor<3>,
    pub geglu: fn(Tensor<3>) -> Tensor<3>,
    pub attention: fn(Tensor<3>, Tensor<1>, Tensor<1>, usize, usize) -> Tensor<3>,
}

impl Parts {
    /// The fused operations, in f32.
    pub(crate) fn fused() -> Self {
        Self {
            linear: |x, w, b| ops::linear(x, w, b, Compute::F32),
            norm: |x, shift, scale| ops::modulated_norm(x, shift, scale, Compute::F32),
            gated: ops::gated_add,
            geglu: ops::geglu,
            attention: |qkv, q, k, heads, queries| ops::attention(qkv, q, k, heads, queries, Compute::F32),
        }
    }

    /// Burn's own operations, in f32.
    pub(crate) fn readable() -> Self {
        Self {
            linear: |x, w, b| ops::reference::linear(x, w, b, Compute::F32),
            norm: ops::reference::modulated_norm,
            gated: ops::reference::gated_add,
            geglu: ops::reference::geglu,
            attention: ops::reference::attention,
        }
    }
}

/// What `noisy`, at time `t`, tells of clean Gaussians that are normal about `estimate` with standard `deviations`, or
/// without an estimate about zero with deviation 1: their mean and their deviation, both `[b, n, 14]` or broadcast to it.
///
/// With `z = t x + (1 - t) eps` and deviation s of x these are `e + t s^2 (z - t e) / v` and `s (1 - t) / sqrt(v)`, where
/// `v = t^2 s^2 + (1 - t)^2`.
fn best_linear(
    noisy: Tensor<3>,
    estimate: Option<Tensor<3>>,
    deviations: [f32; CHANNELS],
    t: Tensor<1>,
) -> (Tensor<3>, Tensor<3>) {
    let t = t.unsqueeze_dims::<3>(&[1, 2]); // [b, 1, 1]
    let rest = t.clone().neg().add_scalar(1.0);
    let deviations = if estimate.is_some() { deviations } else { [1.0; CHANNELS] };
    let s = Tensor::<1>::from_floats(deviations, &noisy.device()).reshape([1, 1, CHANNELS]);
    let signal = t.clone() * s.clone(); // [b, 1, 14]
    let variance = signal.clone().square() + rest.clone().square();
    let gain = signal * s.clone() / variance.clone();
    let deviation = rest * s / variance.sqrt();
    let mean = match estimate {
        Some(estimate) => estimate.clone() + (noisy - estimate * t) * gain,
        None => noisy * gain,
    };
    (mean, deviation)
}

/// `[b, n d]` to n times `[b, d]`.
fn chunks<const N: usize>(m: Tensor<2>) -> [Tensor<2>; N] {
    let d = m.dims()[1] / N;
    std::array::from_fn(|i| m.clone().narrow(1, i * d, d))
}

impl Dit {
    pub(crate) fn build<S: Source>(
        config: &ModelConfig,
        image_channels: usize,
        prefix: &str,
        builder: &mut Builder<'_, S>,
    ) -> Result<Self, ModelError> {
        let d = config.hidden;
        let name = |part: &str| format!("{prefix}{part}");
        // As DiT: modulations and output start at zero, so that every block starts as the identity.
        Ok(Self {
            registers: builder.param(&name("registers"), [config.registers, d], Init::Normal(0.02))?,
            img_in: builder.linear(&name("img_in"), image_channels, d, Init::Xavier)?,
            gs_in: match config.kind {
                ModelKind::FlowMatching => {
                    Some(builder.linear(&name("gs_in"), config.gaussian_channels(), d, Init::Xavier)?)
                }
                _ => None,
            },
            t_mlp: match config.kind {
                ModelKind::FlowMatching => Some(TimeMlp {
                    first: builder.linear(&name("t_mlp.0"), config.time_features, d, Init::Normal(0.02))?,
                    second: builder.linear(&name("t_mlp.2"), d, d, Init::Normal(0.02))?,
                }),
                _ => None,
            },
            lift: match config.cell_channels() {
                0 => None,
                channels => Some(Lift::build(d, channels, &name("lift"), builder)?),
            },
            latents: match config.learned_tokens() {
                0 => None,
                tokens => Some(builder.param(&name("latents"), [tokens, d], Init::Normal(1.0))?),
            },
            blocks: (0..config.blocks)
                .map(|i| Block::build(config, &format!("{prefix}blocks.{i}"), builder))
                .collect::<Result<_, ModelError>>()?,
            output: Output {
                adaln: match config.kind.one_pass() {
                    false => Some(builder.linear(&name("final.adaln"), d, 2 * d, Init::Zeros)?),
                    true => None,
                },
                norm: match config.kind.one_pass() {
                    false => None,
                    true => Some(builder.param(&name("final.norm"), [2, d], Init::Zeros)?),
                },
                linear: builder.linear(&name("final.linear"), d, config.output_channels(), Init::Zeros)?,
            },
            gaussians_per_token: config.gaussians_per_token,
            gradient_channels: config.gradient_channels,
            estimate_channels: config.estimate_channels,
            observed: config.observed(),
            preconditioning: config.preconditioning,
            time_features: config.time_features,
            compute: Compute::F32,
            recompute: false,
        })
    }

    /// In which precision the blocks compute; the few layers outside of them stay in f32.
    pub fn set_compute(&mut self, compute: Compute) {
        self.compute = compute;
    }

    pub(crate) fn device(&self) -> Device {
        self.registers.val().device()
    }

    pub(crate) fn compute(&self) -> Compute {
        self.compute
    }

    /// Whether blocks keep only their inputs for the gradient, and compute the rest again: a third more arithmetic,
    /// for about a tenth of the activations.
    pub fn set_recompute(&mut self, recompute: bool) {
        self.recompute = recompute;
    }

    /// Width of the time's sinusoidal embedding.
    pub fn time_features(&self) -> usize {
        self.time_features
    }

    /// Whether [`forward`](Self::forward) takes the photometric gradient.
    pub fn gradient_channels(&self) -> bool {
        self.gradient_channels
    }

    /// Whether [`forward`](Self::forward) takes an earlier estimate.
    pub fn estimate_channels(&self) -> bool {
        self.estimate_channels
    }

    /// Channels of what the input views show of that estimate that [`forward`](Self::forward) takes; 0: none.
    pub fn observed(&self) -> usize {
        self.observed
    }

    /// The same network with [`PLACE`] more channels of this kind, of which it knows nothing yet.
    pub(crate) fn with_place_channels(mut self) -> Self {
        let p = self.gaussians_per_token;
        let gs_in = self.gs_in.as_mut().expect("a model of flow matching");
        gs_in.weight = gs_in.weight.clone().map(|weight| {
            let [d, columns] = weight.dims();
            let weight = weight.reshape([d, p, columns / p]); // those of what views show are last
            let none = Tensor::zeros([d, p, PLACE], &weight.device());
            Tensor::cat(vec![weight, none], 2).reshape([d, columns + p * PLACE])
        });
        self.observed += PLACE;
        self
    }

    /// The conditioning vector of the time: `t` `[b]` in 0..1 to `[b, d]`.
    ///
    /// # Panics
    /// If the model predicts in one pass: it has no time.
    pub fn condition(&self, t: Tensor<1>) -> Tensor<2> {
        let TimeMlp { first, second } = self.t_mlp.as_ref().expect("a model of flow matching");
        second.forward(silu(first.forward(time_embedding(t, self.time_features))))
    }

    /// The sequence before the first block: registers, image tokens, Gaussian tokens. `[b, t, d]`
    pub(crate) fn tokens(&self, noisy: Tensor<3>, feedback: Feedback, image_tokens: Tensor<3>) -> Tensor<3> {
        let [b, n, c] = noisy.dims();
        let p = self.gaussians_per_token;
        assert_eq!(c, CHANNELS, "the noisy Gaussians have {CHANNELS} channels");
        assert!(n.is_multiple_of(p), "{n} Gaussians do not fill tokens of {p}");
        let kinds = [
            ("gradient", self.gradient_channels, feedback.gradient, CHANNELS),
            ("estimate", self.estimate_channels, feedback.estimate, CHANNELS),
            ("observation", self.observed > 0, feedback.observation, self.observed),
        ];
        let mut gaussians = vec![noisy.clone()];
        for (name, wanted, given, width) in kinds {
            assert!(wanted || given.is_none(), "this model is configured without {name} channels");
            if wanted {
                gaussians.push(given.unwrap_or_else(|| Tensor::zeros([b, n, width], &noisy.device())));
            }
        }
        let gaussians = Tensor::cat(gaussians, 2);
        let width = gaussians.dims()[2] * p;
        let gs_in = self.gs_in.as_ref().expect("a model of flow matching");
        let gaussians = gs_in.forward(gaussians.reshape([b, n / p, width]));
        self.sequence(b, self.image_inputs(image_tokens), Some(gaussians))
    }

    /// Registers, image tokens, and the tokens that become Gaussians where these are others. `[b, t, d]`
    fn sequence(&self, b: usize, images: Option<Tensor<3>>, others: Option<Tensor<3>>) -> Tensor<3> {
        let mut parts = Vec::with_capacity(3);
        let registers = self.registers.val(); // [r, d]
        if registers.dims()[0] > 0 {
            parts.push(registers.unsqueeze_dim::<3>(0).repeat_dim(0, b));
        }
        parts.extend(images);
        parts.extend(others);
        Tensor::cat(parts, 1)
    }

    /// Image tokens as the first block takes them, if there are any. `[b, m, d]`
    fn image_inputs(&self, image_tokens: Tensor<3>) -> Option<Tensor<3>> {
        (image_tokens.dims()[1] > 0).then(|| self.img_in.forward(image_tokens))
    }

    /// All blocks, and the output layer on the last `queries` tokens: `[b, queries, output channels]`.
    fn blocks_and_output(&self, mut x: Tensor<3>, silu_c: Tensor<2>, queries: usize) -> Tensor<3> {
        for (i, block) in self.blocks.iter().enumerate() {
            // Only tokens that become Gaussians leave the last block, so only they need computing there.
            let queries = if i + 1 == self.blocks.len() { queries } else { x.dims()[1] };
            x = block.forward(x, silu_c.clone(), queries, self.compute, self.recompute);
        }
        let [b, _, d] = x.dims();
        let modulation = match (&self.output.adaln, &self.output.norm) {
            (Some(adaln), _) => adaln.forward(silu_c),
            (None, norm) => {
                let norm = norm.as_ref().expect("a model without a time has a norm of its own");
                norm.val().reshape([1, 2 * d]).repeat_dim(0, b)
            }
        };
        let [shift, scale] = chunks(modulation);
        self.output.linear.forward(ops::modulated_norm(x, shift, scale, Compute::F32))
    }

    /// What a model that predicts in one pass says of each token that becomes Gaussians, before decoding.
    ///
    /// `image_tokens`: `[b, m, image_channels]`; `cells` for a voxel-aligned model and no other. Returns
    /// `[b, tokens, channels]`: one row per learned token, or per image token of a pixel-aligned model.
    ///
    /// # Panics
    /// If this is a model of flow matching, or cells are missing or not wanted.
    pub fn predict(&self, image_tokens: Tensor<3>, cells: Option<CellViews>) -> Tensor<3> {
        assert!(self.gs_in.is_none(), "a model of flow matching predicts from noise");
        let [b, m, _] = image_tokens.dims();
        let latents = self.latents.as_ref().map(|l| l.val().unsqueeze_dim::<3>(0).repeat_dim(0, b)); // [b, tokens, d]
        let queries = latents.as_ref().map_or(m, |l| l.dims()[1]);
        let no_time = Tensor::zeros([b, 1], &image_tokens.device());
        let images = self.image_inputs(image_tokens);
        assert_eq!(self.lift.is_some(), cells.is_some(), "views of cells belong to a voxel-aligned model");
        let lifted =
            self.lift.as_ref().zip(images.clone()).zip(cells).map(|((l, images), cells)| l.forward(images, cells));
        let latents = latents.into_iter().chain(lifted).reduce(|sum, more| sum + more);
        let x = self.sequence(b, images, latents);
        self.blocks_and_output(x, no_time, queries)
    }

    /// The tokens after the first block, for tests.
    #[cfg(test)]
    pub(crate) fn first_block(&self, tokens: Tensor<3>, t: Tensor<1>) -> Tensor<3> {
        let n = tokens.dims()[1];
        self.blocks[0].forward(tokens, silu(self.condition(t)), n, self.compute, self.recompute)
    }

    /// Predicts the clean Gaussians from noisy ones.
    ///
    /// - `noisy`: `[b, n, 14]`, normalized; `n` a multiple of `gaussians_per_token`
    /// - `feedback`: what is known besides; of what the model is configured for
    /// - `image_tokens`: `[b, m, image_channels]`; zeros for the unconditional prediction
    /// - `t`: `[b]`, 0 is noise, 1 is data
    ///
    /// Returns the clean Gaussians, normalized, `[b, n, 14]`.
    ///
    /// # Panics
    /// If shapes do not fit each other, or something is fed back to a model without channels for it.
    pub fn forward(
        &self,
        noisy: Tensor<3>,
        feedback: impl Into<Feedback>,
        image_tokens: Tensor<3>,
        t: Tensor<1>,
    ) -> Tensor<3> {
        let [b, n, _] = noisy.dims();
        let gaussian_tokens = n / self.gaussians_per_token;
        let feedback = feedback.into();
        let known = self.preconditioning.map(|d| best_linear(noisy.clone(), feedback.estimate.clone(), d, t.clone()));
        let x = self.tokens(noisy, feedback, image_tokens);
        let silu_c = silu(self.condition(t)); // [b, d]
        let out = self.blocks_and_output(x, silu_c, gaussian_tokens).reshape([b, n, CHANNELS]);
        match known {
            Some((mean, deviation)) => mean + out * deviation,
            None => out,
        }
    }
}
