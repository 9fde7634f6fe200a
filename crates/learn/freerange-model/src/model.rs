//! The whole network as one module.

use burn::{
    module::{Module, ModuleMapper, ModuleVisitor, Param},
    tensor::{Device, Tensor, TensorData},
};
use rand::Rng;

use crate::{
    Alignment, Dinov2, Dit, EncoderConfig, Feedback, ImageEncoder, ModelConfig, ModelError, ModelKind,
    compute::Compute,
    layers::{Builder, RandomSource, Source},
    one_pass::Decoder,
};

/// Image encoder and transformer.
#[derive(Module, Debug)]
pub struct FreeRange {
    encoder: ImageEncoder,
    dit: Dit,
    #[module(skip)]
    kind: ModelKind,
    #[module(skip)]
    decoder: Decoder,
}

/// One trainable tensor of a model: its PyTorch-like name, its shape, its values.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameter {
    /// For instance `dit.blocks.0.attn.qkv.weight`.
    pub name: String,
    /// Linear weights are `[out, in]`.
    pub shape: Vec<usize>,
    /// Row-major.
    pub values: Vec<f32>,
}

impl FreeRange {
    /// A model with random weights. It lives on `device` and is trainable if that is an autodiff device. A DINOv2
    /// encoder is random too (for dry runs) until it is [replaced](Self::with_dinov2) by a published one.
    ///
    /// # Errors
    /// A configuration that does not make sense.
    pub fn new(config: &ModelConfig, rng: &mut impl Rng, device: &Device) -> Result<Self, ModelError> {
        config.validate()?;
        let mut source = RandomSource(rng);
        let mut builder = Builder { source: &mut source, device };
        let dinov2 = match &config.encoder {
            EncoderConfig::Dinov2(c) => Some(Dinov2::build(c, &mut builder)?.freeze()),
            EncoderConfig::Patch(_) => None,
        };
        Self::build(config, dinov2, &mut builder)
    }

    pub(crate) fn build<S: Source>(
        config: &ModelConfig,
        dinov2: Option<Dinov2>,
        builder: &mut Builder<'_, S>,
    ) -> Result<Self, ModelError> {
        Ok(Self {
            encoder: ImageEncoder::new(config, dinov2),
            dit: Dit::build(config, config.image_token_width(), "dit.", builder)?,
            kind: config.kind,
            decoder: Decoder::new(config),
        })
    }

    /// The same model with published, frozen DINOv2 weights.
    ///
    /// # Errors
    /// If the model is configured for another encoder.
    pub fn with_dinov2(mut self, config: &ModelConfig, dinov2: Dinov2) -> Result<Self, ModelError> {
        check_dinov2(config, &dinov2)?;
        self.encoder.replace_dinov2(Some(dinov2));
        self.encoder.set_compute(self.dit.compute());
        Ok(self)
    }

    /// What is trained, and the frozen DINOv2 apart from it if there is one. Without it no image can be encoded until it is
    /// [put back](Self::put_dinov2).
    pub fn take_dinov2(mut self) -> (Self, Option<Dinov2>) {
        let dinov2 = self.encoder.replace_dinov2(None);
        (self, dinov2)
    }

    /// Undoes [`take_dinov2`](Self::take_dinov2).
    pub fn put_dinov2(mut self, dinov2: Option<Dinov2>) -> Self {
        self.encoder.replace_dinov2(dinov2);
        self
    }

    /// The same model, computing this way: the transformer's blocks, and on a GPU a frozen DINOv2 too. Whether a
    /// device can, [`Compute::supported`] tells.
    pub fn with_compute(mut self, compute: Compute) -> Self {
        let compute = compute.on(&self.dit.device());
        self.dit.set_compute(compute);
        self.encoder.set_compute(compute);
        self
    }

    /// The same model, whose blocks keep only their inputs for the gradient: see [`Dit::set_recompute`].
    pub fn with_recompute(mut self, recompute: bool) -> Self {
        self.dit.set_recompute(recompute);
        self
    }

    /// The same model with [place channels](ModelConfig::place_channels), of which it knows nothing yet: it says the same whatever they tell.
    pub fn with_place_channels(mut self) -> Self {
        self.dit = self.dit.with_place_channels();
        self
    }

    /// The image encoder.
    pub fn encoder(&self) -> &ImageEncoder {
        &self.encoder
    }

    /// The transformer.
    pub fn dit(&self) -> &Dit {
        &self.dit
    }

    /// Image tokens: see [`ImageEncoder::forward`]. `[b, views, h, w, channels]`, `[b, views, rows, columns, 6]` to
    /// `[b, views * rows * columns, width]`. Zeros of that shape stand for "no images".
    pub fn encode(&self, images: Tensor<5>, plucker: Tensor<5>) -> Tensor<3> {
        self.encoder.forward(images, plucker)
    }

    /// The clean Gaussians: see [`Dit::forward`]. `[b, n, 14]`
    pub fn denoise(
        &self,
        noisy: Tensor<3>,
        feedback: impl Into<Feedback>,
        image_tokens: Tensor<3>,
        t: Tensor<1>,
    ) -> Tensor<3> {
        self.dit.forward(noisy, feedback, image_tokens, t)
    }

    /// What its tokens stand for.
    pub fn kind(&self) -> ModelKind {
        self.kind
    }

    /// The Gaussians of a model that predicts in one pass: `[b, n, 14]`, normalized for
    /// [latent tokens](ModelKind::LatentTokens), else as they are in the canonical frame.
    ///
    /// `image_tokens` as [`encode`](Self::encode) gives them; `alignment` for a model whose Gaussians are bound to pixels
    /// or cells.
    ///
    /// # Panics
    /// If this is a model of flow matching, or the alignment is missing, not wanted or of another kind.
    pub fn predict(&self, image_tokens: Tensor<3>, alignment: Option<Alignment>) -> Tensor<3> {
        let (rays, cells) = match alignment {
            Some(Alignment::Rays(rays)) => (Some(rays), None),
            Some(Alignment::Cells(cells)) => (None, Some(cells)),
            None => (None, None),
        };
        self.decoder.decode(self.dit.predict(image_tokens, cells), rays)
    }

    /// Every trainable tensor, in a fixed order.
    pub fn parameters(&self) -> Vec<Parameter> {
        let mut visitor = Collector { path: Vec::new(), out: Vec::new() };
        self.visit(&mut visitor);
        visitor.out
    }

    /// The same model with other values, in the order of [`parameters`](Self::parameters).
    ///
    /// # Errors
    /// If the number of tensors or a tensor's number of values differs.
    pub fn set_parameters(self, values: &[Vec<f32>]) -> Result<Self, ModelError> {
        let mut mapper = Setter { path: Vec::new(), values: values.iter(), problem: None };
        let model = self.map(&mut mapper);
        if let Some(problem) = mapper.problem {
            return Err(ModelError::Parameters(problem));
        }
        match mapper.values.len() {
            0 => Ok(model),
            n => Err(ModelError::Parameters(format!("{n} tensors too many"))),
        }
    }
}

/// Refuses DINOv2 weights of another architecture than the configuration names.
pub(crate) fn check_dinov2(config: &ModelConfig, dinov2: &Dinov2) -> Result<(), ModelError> {
    match &config.encoder {
        EncoderConfig::Dinov2(c) if c.architecture() == *dinov2.config() => Ok(()),
        other => {
            let expected = format!("the architecture of the given weights, {:?}", dinov2.config());
            Err(ModelError::config("encoder", expected, format!("{:?}", other.architecture())))
        }
    }
}

/// PyTorch would call these layers of a `Sequential` by number, and our field cannot be called `final`.
pub(crate) fn torch_name(path: &[String]) -> String {
    let mut name = path.join(".");
    for (ours, torch) in [
        ("dit.t_mlp.first.", "dit.t_mlp.0."),
        ("dit.t_mlp.second.", "dit.t_mlp.2."),
        ("dit.lift.first.", "dit.lift.0."),
        ("dit.lift.second.", "dit.lift.2."),
        ("dit.output.", "dit.final."),
    ] {
        if let Some(rest) = name.strip_prefix(ours) {
            name = format!("{torch}{rest}");
        }
    }
    name
}

/// Frozen weights are no parameters.
fn is_frozen(path: &[String]) -> bool {
    path.starts_with(&["encoder", "dinov2"].map(str::to_owned))
}

struct Collector {
    path: Vec<String>,
    out: Vec<Parameter>,
}

impl ModuleVisitor for Collector {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        if is_frozen(&self.path) {
            return;
        }
        let tensor = param.val();
        let shape = tensor.dims().to_vec();
        let values = tensor.into_data().convert::<f32>().try_into_vec::<f32>().expect("converted to f32");
        self.out.push(Parameter { name: torch_name(&self.path), shape, values });
    }
}

struct Setter<'a> {
    path: Vec<String>,
    values: std::slice::Iter<'a, Vec<f32>>,
    problem: Option<String>,
}

impl ModuleMapper for Setter<'_> {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        if is_frozen(&self.path) || self.problem.is_some() {
            return param;
        }
        let name = torch_name(&self.path);
        let shape = param.val().dims();
        let Some(values) = self.values.next() else {
            self.problem = Some(format!("no values for `{name}`"));
            return param;
        };
        if values.len() != shape.iter().product::<usize>() {
            self.problem = Some(format!("`{name}` of shape {shape:?} was given {} values", values.len()));
            return param;
        }
        param.map(|old| {
            let tracked = old.is_require_grad();
            let data = TensorData::new(values.clone(), shape);
            Tensor::from_data(data, &old.device()).set_require_grad(tracked)
        })
    }
}
