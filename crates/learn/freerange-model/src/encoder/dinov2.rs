//! DINOv2 (Oquab et al. 2023; registers: Darcet et al. 2023), read from Hugging Face folders.

use std::{path::Path, sync::Arc};

use burn::{
    module::{Module, Param},
    tensor::{
        Device, FloatDType, Tensor, TensorData,
        activation::{gelu, silu},
        module::layer_norm,
    },
};

use freerange_util::sha256;

use super::bicubic;
use crate::{
    Dinov2Config, ModelError,
    compute::{self, Compute},
    layers::{Builder, Init, Linear, Source},
    ops,
    weights::{TensorFile, read_bounded},
};

/// Where published weights came from; checkpoints of models that use them record it.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WeightsOrigin {
    /// What the weights are known by.
    pub name: String,
    /// SHA-256 of the weights' file, hexadecimal.
    pub sha256: String,
}

/// A DINOv2 without its training heads.
#[derive(Module, Debug)]
pub struct Dinov2 {
    cls_token: Param<Tensor<3>>,               // [1, 1, d]
    register_tokens: Option<Param<Tensor<3>>>, // [1, registers, d]
    position: Param<Tensor<3>>,                // [1, 1 + side * side, d]
    projection: Linear,                        // [d, 3 * patch * patch]
    layers: Vec<Layer>,
    norm: LayerNorm,
    /// `position` once more, where it is resampled for other image sizes.
    #[module(skip)]
    stored_position: Arc<[f32]>,
    #[module(skip)]
    config: Dinov2Config,
    #[module(skip)]
    origin: Option<WeightsOrigin>,
}

#[derive(Module, Debug)]
struct LayerNorm {
    weight: Param<Tensor<1>>,
    bias: Param<Tensor<1>>,
}

#[derive(Module, Debug)]
struct Layer {
    norm1: LayerNorm,
    qkv: Linear, // [3 d, d]
    out: Linear,
    scale1: Param<Tensor<1>>,
    norm2: LayerNorm,
    mlp_in: Linear,
    mlp_out: Linear,
    scale2: Param<Tensor<1>>,
}

impl Dinov2 {
    pub(crate) fn build<S: Source>(config: &Dinov2Config, builder: &mut Builder<'_, S>) -> Result<Self, ModelError> {
        let d = config.hidden;
        let side = config.position_side();
        let patch = config.patch_size as usize;
        let small = Init::Normal(0.02);
        // The convolution over whole patches is a linear map of a patch's pixels, channel by channel.
        let conv = "embeddings.patch_embeddings.projection";
        let pixels = 3 * patch * patch;
        let weight = builder.reshaped(&format!("{conv}.weight"), &[d, 3, patch, patch], [d, pixels], small)?;
        let projection = Linear::new(weight, builder.param(&format!("{conv}.bias"), [d], Init::Zeros)?);
        let position_shape = [1, 1 + side * side, d];
        let position = builder.source.values("embeddings.position_embeddings", &position_shape, small)?;
        let position_data = TensorData::new(position.clone(), position_shape);
        Ok(Self {
            cls_token: builder.param("embeddings.cls_token", [1, 1, d], small)?,
            register_tokens: match config.registers {
                0 => None,
                n => Some(builder.param("embeddings.register_tokens", [1, n, d], small)?),
            },
            position: Param::from_tensor(Tensor::from_data(position_data, builder.device)),
            projection,
            layers: (0..config.layers).map(|i| Layer::build(config, i, builder)).collect::<Result<_, _>>()?,
            norm: LayerNorm::build("layernorm", d, builder)?,
            stored_position: position.into(),
            config: config.architecture(),
            origin: None,
        })
    }

    /// Reads a folder of Hugging Face's `transformers`: `config.json` and `model.safetensors` of a `Dinov2Model` or
    /// `Dinov2WithRegistersModel`. The weights are frozen.
    ///
    /// # Errors
    /// Names the file, and the field or tensor that is missing or does not fit.
    pub fn load(folder: &Path, device: &Device) -> Result<Self, ModelError> {
        let name = folder.file_name().unwrap_or(folder.as_os_str()).to_string_lossy();
        Self::load_as(folder, &name, device)
    }

    /// [`load`](Self::load) of weights that are known by `name`: checkpoints record it.
    ///
    /// # Errors
    /// As [`load`](Self::load).
    pub fn load_as(folder: &Path, name: &str, device: &Device) -> Result<Self, ModelError> {
        let config = read_config(&folder.join("config.json"))?;
        let path = folder.join("model.safetensors");
        let bytes = read_bounded(&path)?;
        let mut file = TensorFile::parse(&path, "safetensors file", &bytes)?;
        let mut model = Self::build(&config, &mut Builder { source: &mut file, device })?.freeze();
        model.origin = Some(WeightsOrigin { name: name.to_owned(), sha256: sha256(&bytes) });
        Ok(model)
    }

    /// In which precision the layers compute on a GPU; on a CPU always in f32.
    pub(crate) fn set_compute(&mut self, compute: Compute) {
        let compute = if compute::is_cpu(&self.cls_token.val().device()) { Compute::F32 } else { compute };
        for layer in &mut self.layers {
            for linear in [&mut layer.qkv, &mut layer.out, &mut layer.mlp_in, &mut layer.mlp_out] {
                linear.set_compute(compute);
            }
        }
    }

    /// The architecture.
    pub fn config(&self) -> &Dinov2Config {
        &self.config
    }

    /// Which weights these are; `None` for random ones.
    pub fn origin(&self) -> Option<&WeightsOrigin> {
        self.origin.as_ref()
    }

    /// Width of the features.
    pub fn hidden(&self) -> usize {
        self.config.hidden
    }

    /// Tokens before the first layer: class, registers, patches. Pixels beyond the last whole patch are ignored.
    pub(crate) fn embed(&self, pixels: Tensor<4>) -> Tensor<3> {
        let [b, channels, height, width] = pixels.dims();
        let p = self.config.patch_size as usize;
        let (rows, columns) = (height / p, width / p);
        assert!(channels == 3 && rows > 0 && columns > 0, "DINOv2 takes RGB images of at least one patch");
        let pixels = pixels.narrow(2, 0, rows * p).narrow(3, 0, columns * p);
        let patches = pixels.reshape([b, 3, rows, p, columns, p]).permute([0, 2, 4, 1, 3, 5]);
        let patches = self.projection.forward(patches.reshape([b, rows * columns, 3 * p * p]));
        let class = self.cls_token.val().repeat_dim(0, b);
        let tokens = Tensor::cat(vec![class, patches], 1) + self.position_embedding([rows, columns], height == width);
        let Some(registers) = &self.register_tokens else { return tokens };
        let class = tokens.clone().narrow(1, 0, 1);
        let patches = tokens.narrow(1, 1, rows * columns);
        Tensor::cat(vec![class, registers.val().repeat_dim(0, b), patches], 1)
    }

    /// The position embedding for this many patches, resampled where it is stored for another. `[1, 1 + n, d]`
    fn position_embedding(&self, [rows, columns]: [usize; 2], square: bool) -> Tensor<3> {
        let (d, side) = (self.config.hidden, self.config.position_side());
        let stored = self.position.val();
        if square && rows * columns == side * side {
            return stored;
        }
        let (class, grid) = self.stored_position.split_at(d);
        let mut all = class.to_vec();
        all.extend(bicubic::resample(grid, side, [rows, columns], d, self.config.antialias));
        Tensor::from_data(TensorData::new(all, [1, 1 + rows * columns, d]), &stored.device())
    }

    /// All tokens after the final norm: class, registers, patches row by row.
    ///
    /// `pixels`: `[b, 3, h, w]`, normalized by the mean and deviation of ImageNet. Returns `[b, 1 + registers + patches, d]`.
    ///
    /// # Panics
    /// If the images are not RGB or smaller than a patch.
    pub fn forward(&self, pixels: Tensor<4>) -> Tensor<3> {
        let mut x = self.embed(pixels);
        for layer in &self.layers {
            x = layer.forward(x, &self.config);
        }
        self.norm.forward(x, self.config.layer_norm_eps)
    }

    /// The features of the patches alone, row by row. `[b, 3, h, w]` to `[b, patches, d]`
    ///
    /// # Panics
    /// As [`forward`](Self::forward).
    pub fn patch_features(&self, pixels: Tensor<4>) -> Tensor<3> {
        let all = self.forward(pixels);
        let first = 1 + self.config.registers;
        let n = all.dims()[1] - first;
        all.narrow(1, first, n)
    }
}

/// RGB in 0..1, `[b, 3, h, w]`, to ImageNet's zero mean and unit deviation.
pub(crate) fn imagenet_normalized(images: Tensor<4>) -> Tensor<4> {
    let device = images.device();
    let row = |values: [f32; 3]| Tensor::<1>::from_floats(values, &device).reshape([1, 3, 1, 1]);
    (images - row([0.485, 0.456, 0.406])) / row([0.229, 0.224, 0.225])
}

impl LayerNorm {
    fn build<S: Source>(name: &str, width: usize, builder: &mut Builder<'_, S>) -> Result<Self, ModelError> {
        Ok(Self {
            weight: builder.param(&format!("{name}.weight"), [width], Init::Ones)?,
            bias: builder.param(&format!("{name}.bias"), [width], Init::Zeros)?,
        })
    }

    fn forward(&self, x: Tensor<3>, epsilon: f64) -> Tensor<3> {
        layer_norm(x, self.weight.val(), Some(self.bias.val()), epsilon)
    }
}

impl Layer {
    fn build<S: Source>(config: &Dinov2Config, i: usize, builder: &mut Builder<'_, S>) -> Result<Self, ModelError> {
        let (d, inner) = (config.hidden, config.ffn_width());
        let name = |part: &str| format!("encoder.layer.{i}.{part}");
        let small = Init::Normal(0.02);
        // Three layers in the file, one product here.
        let (mut weight, mut bias) = (Vec::with_capacity(3 * d * d), Vec::with_capacity(3 * d));
        for part in ["query", "key", "value"] {
            let name = name(&format!("attention.attention.{part}"));
            weight.extend(builder.source.values(&format!("{name}.weight"), &[d, d], small)?);
            if config.qkv_bias {
                bias.extend(builder.source.values(&format!("{name}.bias"), &[d], Init::Zeros)?);
            }
        }
        bias.resize(3 * d, 0.0);
        let qkv = Linear::new(
            Param::from_tensor(Tensor::from_data(TensorData::new(weight, [3 * d, d]), builder.device)),
            Param::from_tensor(Tensor::from_data(TensorData::new(bias, [3 * d]), builder.device)),
        );
        let (mlp_in, mlp_out) = match config.swiglu {
            true => (
                builder.linear(&name("mlp.weights_in"), d, 2 * inner, small)?,
                builder.linear(&name("mlp.weights_out"), inner, d, small)?,
            ),
            false => {
                (builder.linear(&name("mlp.fc1"), d, inner, small)?, builder.linear(&name("mlp.fc2"), inner, d, small)?)
            }
        };
        Ok(Self {
            norm1: LayerNorm::build(&name("norm1"), d, builder)?,
            qkv,
            out: builder.linear(&name("attention.output.dense"), d, d, small)?,
            scale1: builder.param(&name("layer_scale1.lambda1"), [d], Init::Ones)?,
            norm2: LayerNorm::build(&name("norm2"), d, builder)?,
            mlp_in,
            mlp_out,
            scale2: builder.param(&name("layer_scale2.lambda1"), [d], Init::Ones)?,
        })
    }

    fn forward(&self, x: Tensor<3>, config: &Dinov2Config) -> Tensor<3> {
        let d = x.dims()[2];
        let y = self.qkv.forward(self.norm1.forward(x.clone(), config.layer_norm_eps));
        let y = full(self.out.forward(ops::plain_attention(y, config.heads, self.qkv.compute())));
        let x = x + y * self.scale1.val().reshape([1, 1, d]);
        let y = full(self.mlp_in.forward(self.norm2.forward(x.clone(), config.layer_norm_eps)));
        let y = match config.swiglu {
            true => {
                let inner = config.ffn_width();
                silu(y.clone().narrow(2, 0, inner)) * y.narrow(2, inner, inner)
            }
            false => gelu(y),
        };
        x + full(self.mlp_out.forward(y)) * self.scale2.val().reshape([1, 1, d])
    }
}

/// In f32, whatever a linear layer computed in.
fn full(x: Tensor<3>) -> Tensor<3> {
    x.cast(FloatDType::F32)
}

/// The fields of a Hugging Face `config.json` that matter here.
#[derive(serde::Deserialize)]
struct HuggingFaceConfig {
    model_type: String,
    hidden_size: usize,
    num_hidden_layers: usize,
    num_attention_heads: usize,
    patch_size: u32,
    image_size: u32,
    mlp_ratio: f64,
    layer_norm_eps: f64,
    #[serde(default = "three")]
    num_channels: usize,
    #[serde(default = "gelu_name")]
    hidden_act: String,
    #[serde(default = "yes")]
    qkv_bias: bool,
    #[serde(default)]
    use_swiglu_ffn: bool,
    #[serde(default)]
    num_register_tokens: Option<usize>,
}

fn three() -> usize {
    3
}

fn gelu_name() -> String {
    "gelu".to_owned()
}

fn yes() -> bool {
    true
}

fn read_config(path: &Path) -> Result<Dinov2Config, ModelError> {
    const KIND: &str = "DINOv2 configuration";
    let bytes = read_bounded(path)?;
    let c: HuggingFaceConfig = serde_json::from_slice(&bytes).map_err(|e| ModelError::format(path, KIND, e))?;
    let unsupported = |field: &str, expected: &str, found: String| {
        Err(ModelError::format(path, KIND, format!("`{field}` is {found}, expected {expected}")))
    };
    let registers = match c.model_type.as_str() {
        "dinov2" => 0,
        "dinov2_with_registers" => c.num_register_tokens.unwrap_or(4),
        other => return unsupported("model_type", "dinov2 or dinov2_with_registers", other.to_owned()),
    };
    if c.num_channels != 3 {
        return unsupported("num_channels", "3", c.num_channels.to_string());
    }
    if c.hidden_act != "gelu" {
        return unsupported("hidden_act", "gelu", c.hidden_act);
    }
    if c.mlp_ratio.fract() != 0.0 || !(1.0..=64.0).contains(&c.mlp_ratio) {
        return unsupported("mlp_ratio", "a whole number between 1 and 64", c.mlp_ratio.to_string());
    }
    let config = Dinov2Config {
        hidden: c.hidden_size,
        layers: c.num_hidden_layers,
        heads: c.num_attention_heads,
        patch_size: c.patch_size,
        image_size: c.image_size,
        mlp_ratio: c.mlp_ratio as usize,
        swiglu: c.use_swiglu_ffn,
        registers,
        layer_norm_eps: c.layer_norm_eps,
        qkv_bias: c.qkv_bias,
        antialias: c.model_type == "dinov2_with_registers",
        weights: None,
        random: false,
    };
    config.validate().map_err(|e| ModelError::format(path, KIND, e))?;
    Ok(config)
}
