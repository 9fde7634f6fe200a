//! A trained model in one `.safetensors` file: weights, and everything needed to use them.
//!
//! Tensors have PyTorch-like names (`dit.*`, `encoder.*`); the header's metadata hold the format's version, the
//! configuration, the normalization, the gradient's RMS, the tree depth and the provenance as JSON. Frozen DINOv2
//! weights are named, with their hash, and not stored.

use std::{
    collections::{BTreeMap, HashMap},
    io::Write,
    path::Path,
};

use burn::tensor::{Device, f16};
use freerange_gaussians::{Normalization, channel};
use freerange_util::{IoError, write_atomically};
use safetensors::{Dtype, tensor::TensorView};

use crate::{
    CHANNELS, Dinov2, EncoderConfig, FreeRange, ModelConfig, ModelError, WeightsOrigin,
    layers::Builder,
    model::check_dinov2,
    weights::{TensorFile, read_bounded},
};

/// What the metadata call this kind of file.
const FORMAT: &str = "freerange-checkpoint";
/// The version that is written, and the only one that is read.
const VERSION: &str = "1";
const KIND: &str = "free-range checkpoint";
/// Most Gaussians are 2 to this: a million.
const MAX_DEPTH: u32 = 20;

/// A trained model with everything that sampling needs.
#[derive(Clone, Debug)]
pub struct Checkpoint {
    /// Sizes of the network.
    pub config: ModelConfig,
    /// The network.
    pub model: FreeRange,
    /// How Gaussians were normalized in training.
    pub normalization: Normalization,
    /// RMS per channel of the photometric gradients seen in training; the input gradient is divided by it.
    pub gradient_rms: [f32; channel::COUNT],
    /// Tree depth of the training targets: the model makes 2^depth Gaussians.
    pub depth: u32,
    /// Free-form: data, steps, hardware.
    pub provenance: serde_json::Value,
}

/// How weights are stored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// 32 bits.
    #[default]
    F32,
    /// 16 bits: half the size, three significant digits.
    F16,
}

impl Checkpoint {
    /// Writes the checkpoint, 32 bits a weight. A killed process leaves either the old file or the new.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), ModelError> {
        self.save_as(path, Precision::F32)
    }

    /// [`save`](Self::save) with a choice of precision.
    ///
    /// # Errors
    /// If the file cannot be written, or a weight is not finite (in 16 bits: is beyond 65504).
    pub fn save_as(&self, path: &Path, precision: Precision) -> Result<(), ModelError> {
        let parameters = self.model.parameters();
        let mut stored: Vec<(String, Vec<usize>, Vec<u8>)> = Vec::with_capacity(parameters.len());
        for p in parameters {
            let finite = match precision {
                Precision::F32 => p.values.iter().all(|x| x.is_finite()),
                Precision::F16 => p.values.iter().all(|&x| f16::from_f32(x).is_finite()),
            };
            if !finite {
                return Err(ModelError::NotFinite { path: path.to_owned(), name: p.name });
            }
            let bytes = match precision {
                Precision::F32 => p.values.iter().flat_map(|x| x.to_le_bytes()).collect(),
                Precision::F16 => p.values.iter().flat_map(|&x| f16::from_f32(x).to_le_bytes()).collect(),
            };
            stored.push((p.name, p.shape, bytes));
        }
        let dtype = match precision {
            Precision::F32 => Dtype::F32,
            Precision::F16 => Dtype::F16,
        };
        let views = stored
            .iter()
            .map(|(name, shape, bytes)| Ok((name.as_str(), TensorView::new(dtype, shape.clone(), bytes)?)))
            .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()
            .map_err(|e| ModelError::format(path, KIND, e))?;
        let bytes =
            safetensors::serialize(views, Some(self.metadata(path)?)).map_err(|e| ModelError::format(path, KIND, e))?;
        Ok(write_atomically(path, |file| file.write_all(&bytes)).map_err(IoError::at(path))?)
    }

    fn metadata(&self, path: &Path) -> Result<HashMap<String, String>, ModelError> {
        let json = |value: serde_json::Result<String>| value.map_err(|e| ModelError::format(path, KIND, e));
        let mut metadata = HashMap::from([
            ("format".to_owned(), FORMAT.to_owned()),
            ("version".to_owned(), VERSION.to_owned()),
            ("config".to_owned(), json(serde_json::to_string(&self.config.architecture()))?),
            ("normalization".to_owned(), json(serde_json::to_string(&self.normalization))?),
            ("gradient_rms".to_owned(), json(serde_json::to_string(&self.gradient_rms))?),
            ("depth".to_owned(), self.depth.to_string()),
            ("provenance".to_owned(), self.provenance.to_string()),
        ]);
        if let Some(origin) = self.model.encoder().dinov2().and_then(Dinov2::origin) {
            metadata.insert("encoder_weights".to_owned(), json(serde_json::to_string(origin))?);
        }
        Ok(metadata)
    }

    /// Reads a checkpoint of a model without outside weights.
    ///
    /// # Errors
    /// Names the file and what is wrong with it; a model that needs DINOv2 weights says which.
    pub fn load(path: &Path, device: &Device) -> Result<Self, ModelError> {
        Self::load_with(path, None, device)
    }

    /// Reads a checkpoint of a model whose encoder is the given DINOv2.
    ///
    /// # Errors
    /// As [`load`](Self::load); also where the DINOv2 is not the one the model was trained with.
    pub fn load_with_dinov2(path: &Path, dinov2: Dinov2, device: &Device) -> Result<Self, ModelError> {
        Self::load_with(path, Some(dinov2), device)
    }

    /// Reads a checkpoint that is in memory already, with the DINOv2 of its encoder if it has one. `name` stands for the file
    /// in messages.
    ///
    /// # Errors
    /// As [`load`](Self::load) and [`load_with_dinov2`](Self::load_with_dinov2).
    pub fn from_bytes(bytes: &[u8], name: &Path, dinov2: Option<Dinov2>, device: &Device) -> Result<Self, ModelError> {
        Self::parse(name, bytes, dinov2, device)
    }

    /// What the metadata of a checkpoint that is in memory say; its weights stay unread, and need no encoder. `name` stands
    /// for the file in messages.
    ///
    /// # Errors
    /// As [`load`](Self::load).
    pub fn header(bytes: &[u8], name: &Path) -> Result<Header, ModelError> {
        Header::read(name, bytes)
    }

    fn load_with(path: &Path, dinov2: Option<Dinov2>, device: &Device) -> Result<Self, ModelError> {
        Self::parse(path, &read_bounded(path)?, dinov2, device)
    }

    fn parse(path: &Path, bytes: &[u8], dinov2: Option<Dinov2>, device: &Device) -> Result<Self, ModelError> {
        let header = Header::read(path, bytes)?;
        header.check_encoder(path, dinov2.as_ref())?;
        let mut file = TensorFile::parse(path, KIND, bytes)?;
        let model = FreeRange::build(&header.config, dinov2, &mut Builder { source: &mut file, device })?;
        file.check_all_used()?;
        let Header { config, normalization, gradient_rms, depth, provenance, .. } = header;
        Ok(Self { config, model, normalization, gradient_rms, depth, provenance })
    }
}

/// The configuration in a checkpoint's metadata. Earlier ones name two more fields, which had one useful value each: that is
/// passed over, any other refused as unknown.
fn configuration(text: &str) -> serde_json::Result<ModelConfig> {
    let mut json: serde_json::Value = serde_json::from_str(text)?;
    for (table, field, value) in [("", "final_layer", "adaln".into()), ("/encoder", "patch_hidden", 0.into())] {
        let table = json.pointer_mut(table).and_then(serde_json::Value::as_object_mut);
        if let Some(table) = table.filter(|table| table.get(field) == Some(&value)) {
            table.remove(field);
        }
    }
    serde_json::from_value(json)
}

/// What the metadata of a checkpoint say.
#[derive(Clone, Debug)]
pub struct Header {
    /// Sizes of the network.
    pub config: ModelConfig,
    normalization: Normalization,
    gradient_rms: [f32; CHANNELS],
    /// Tree depth of the training targets.
    pub depth: u32,
    /// Free-form: data, steps, hardware.
    pub provenance: serde_json::Value,
    /// The frozen encoder weights that it was trained with; none where it has no such encoder, or trained on random ones.
    pub encoder_weights: Option<WeightsOrigin>,
}

impl Header {
    fn read(path: &Path, bytes: &[u8]) -> Result<Self, ModelError> {
        let bad = |reason: String| ModelError::format(path, KIND, reason);
        let (_, header) = safetensors::SafeTensors::read_metadata(bytes).map_err(|e| bad(e.to_string()))?;
        let empty = HashMap::new();
        let metadata: BTreeMap<&str, &str> =
            header.metadata().as_ref().unwrap_or(&empty).iter().map(|(k, v)| (k.as_str(), v.as_str())).collect();
        let get = |key: &str| metadata.get(key).copied().ok_or_else(|| bad(format!("the metadata lack `{key}`")));
        if get("format")? != FORMAT {
            return Err(bad(format!("format is `{}`, expected `{FORMAT}`", get("format")?)));
        }
        if get("version")? != VERSION {
            return Err(bad(format!("version is `{}`, this program reads {VERSION}", get("version")?)));
        }
        let invalid = |key: &str, e: serde_json::Error| bad(format!("metadata `{key}`: {e}"));
        let config = configuration(get("config")?).map_err(|e| invalid("config", e))?;
        config.validate().map_err(|e| bad(e.to_string()))?;
        let gradient_rms: [f32; CHANNELS] =
            serde_json::from_str(get("gradient_rms")?).map_err(|e| invalid("gradient_rms", e))?;
        if !gradient_rms.iter().all(|x| x.is_normal() && *x > 0.0) {
            return Err(bad(format!("metadata `gradient_rms`: {gradient_rms:?}, expected positive numbers")));
        }
        let text = get("depth")?;
        // Sampling starts with noise for all Gaussians: what is impossible is refused before it fills the memory.
        let depths = config.gaussians_per_token.ilog2()..=MAX_DEPTH;
        let depth = text.parse().ok().filter(|d| depths.contains(d)).ok_or_else(|| {
            let [first, last] = [depths.start(), depths.end()];
            bad(format!("metadata `depth` is `{text}`, expected a whole number from {first} to {last}"))
        })?;
        Ok(Self {
            config,
            gradient_rms,
            normalization: serde_json::from_str(get("normalization")?).map_err(|e| invalid("normalization", e))?,
            depth,
            provenance: serde_json::from_str(get("provenance")?).map_err(|e| invalid("provenance", e))?,
            encoder_weights: metadata
                .get("encoder_weights")
                .map(|text| serde_json::from_str(text).map_err(|e| invalid("encoder_weights", e)))
                .transpose()?,
        })
    }

    fn check_encoder(&self, path: &Path, dinov2: Option<&Dinov2>) -> Result<(), ModelError> {
        let bad = |reason: String| Err(ModelError::format(path, KIND, reason));
        let wanted = match &self.encoder_weights {
            Some(origin) => format!("`{}` (sha256 {})", origin.name, origin.sha256),
            None => "DINOv2 (which ones is not recorded: it was trained on random ones)".to_owned(),
        };
        match (&self.config.encoder, dinov2) {
            (EncoderConfig::Patch(_), None) => Ok(()),
            (EncoderConfig::Patch(_), Some(_)) => bad("this model has its own encoder and takes no DINOv2".to_owned()),
            (EncoderConfig::Dinov2(_), None) => bad(format!("this model needs the encoder weights {wanted}")),
            (EncoderConfig::Dinov2(_), Some(given)) => {
                check_dinov2(&self.config, given)?;
                match (&self.encoder_weights, given.origin()) {
                    (Some(a), Some(b)) if a.sha256 != b.sha256 => {
                        bad(format!("trained with the encoder weights {wanted}, given sha256 {}", b.sha256))
                    }
                    _ => Ok(()),
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_that_are_gone_may_have_their_one_value() {
        let of = |last: &str, hidden: u32| {
            let encoder = format!(r#"{{ "kind": "patch", "patch_size": 8, "patch_hidden": {hidden} }}"#);
            configuration(&format!(r#"{{ "hidden": 64, "final_layer": "{last}", "encoder": {encoder} }}"#))
        };
        let config = of("adaln", 0).unwrap();
        assert_eq!((config.hidden, config.encoder.patch_size()), (64, 8));
        assert!(of("linear", 0).unwrap_err().to_string().contains("final_layer"));
        assert!(of("adaln", 4).unwrap_err().to_string().contains("patch_hidden"));
    }
}
