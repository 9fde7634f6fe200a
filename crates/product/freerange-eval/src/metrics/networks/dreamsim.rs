//! DreamSim (Fu et al. 2023): the cosine distance of transformers' features, fine-tuned on people's judgements.
//!
//! The package's default is an ensemble of DINO (class token as it leaves the last block), OpenAI's CLIP and OpenCLIP
//! (projected class tokens), all ViT-B/16, side by side: 1792 values, of which the mean is taken off before the cosine.
//! The fine-tuning is a low-rank adapter (LoRA) of some linear layers, merged into the weights when they are read.
//! Papers seldom say which variant their figures are of; we take the default to be meant.

use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};

use super::{
    resize::Image8,
    source::{Source, TensorFile},
    vit::{Vit, VitConfig},
};
use crate::metrics::MetricsError;

pub(crate) const IMAGENET: ([f32; 3], [f32; 3]) = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]);
pub(crate) const CLIP: ([f32; 3], [f32; 3]) =
    ([0.48145466, 0.4578275, 0.40821073], [0.26862954, 0.261_302_6, 0.275_777_1]);

/// ViT-B/16 for 224 pixels.
pub(crate) const DINO_B16: VitConfig = VitConfig {
    width: 768,
    depth: 12,
    heads: 12,
    patch: 16,
    side: 224,
    quick_gelu: false,
    pre_norm: false,
    epsilon: 1e-6,
    projection: None,
};

/// OpenCLIP's of the same size.
pub(crate) const OPEN_CLIP_B16: VitConfig =
    VitConfig { pre_norm: true, epsilon: 1e-5, projection: Some(512), ..DINO_B16 };

/// OpenAI's of the same size.
pub(crate) const CLIP_B16: VitConfig = VitConfig { quick_gelu: true, ..OPEN_CLIP_B16 };

/// One transformer with its preprocessing.
struct Branch {
    vit: Vit,
    mean_and_deviation: ([f32; 3], [f32; 3]),
}

pub(crate) struct DreamSim {
    branches: Vec<Branch>,
    side: usize,
    device: Device,
}

/// A transformer's file: its path, the dictionary of the tensors inside, the architecture, mean and deviation of images.
pub(crate) struct BranchFile<'a> {
    pub path: &'a Path,
    pub key: Option<&'a str>,
    pub config: VitConfig,
    pub mean_and_deviation: ([f32; 3], [f32; 3]),
}

impl DreamSim {
    /// The single DINO: its public checkpoint, and the folder of the adapter.
    pub fn load_dino(dino: &Path, adapter: &Path, device: &Device) -> Result<Self, MetricsError> {
        let file = BranchFile { path: dino, key: None, config: DINO_B16, mean_and_deviation: IMAGENET };
        Self::load(&[file], adapter, device)
    }

    /// The ensemble.
    pub fn load_ensemble(
        dino: &Path,
        clip: &Path,
        open_clip: &Path,
        adapter: &Path,
        device: &Device,
    ) -> Result<Self, MetricsError> {
        let key = Some("state_dict");
        let files = [
            BranchFile { path: dino, key: None, config: DINO_B16, mean_and_deviation: IMAGENET },
            BranchFile { path: clip, key, config: CLIP_B16, mean_and_deviation: CLIP },
            BranchFile { path: open_clip, key, config: OPEN_CLIP_B16, mean_and_deviation: CLIP },
        ];
        Self::load(&files, adapter, device)
    }

    pub(crate) fn load(files: &[BranchFile<'_>], adapter: &Path, device: &Device) -> Result<Self, MetricsError> {
        let mut adapter = Adapter::open(adapter)?;
        let mut branches = Vec::new();
        for (i, file) in files.iter().enumerate() {
            let base = TensorFile::open(file.path, file.key)?;
            let mut source =
                Adapted { base, prefix: format!("base_model.model.extractor_list.{i}.model."), adapter: &mut adapter };
            let vit = Vit::build(&mut source, file.config, device)?;
            branches.push(Branch { vit, mean_and_deviation: file.mean_and_deviation });
        }
        adapter.check_all_used()?;
        Ok(Self { branches, side: files[0].config.side, device: device.clone() })
    }

    /// The embeddings: the branches' features side by side, less their mean.
    pub fn embed(&self, images: &[Image8]) -> Vec<Vec<f32>> {
        let resized: Vec<Image8> = images.iter().map(|image| image.bicubic(self.side, self.side)).collect();
        let mut out = vec![Vec::new(); images.len()];
        for branch in &self.branches {
            let (mean, deviation) = branch.mean_and_deviation;
            let mut values = Vec::with_capacity(images.len() * 3 * self.side * self.side);
            resized.iter().for_each(|image| image.append_normalized(mean, deviation, &mut values));
            let pixels = TensorData::new(values, [images.len(), 3, self.side, self.side]);
            let features = branch.vit.forward(Tensor::from_data(pixels, &self.device));
            for (all, row) in out.iter_mut().zip(super::rows(features)) {
                all.extend(row);
            }
        }
        for embedding in &mut out {
            let mean = embedding.iter().map(|&x| f64::from(x)).sum::<f64>() / embedding.len() as f64;
            embedding.iter_mut().for_each(|x| *x = (f64::from(*x) - mean) as f32);
        }
        out
    }
}

/// What matters of `adapter_config.json` of the package `peft`.
#[derive(serde::Deserialize)]
struct AdapterConfig {
    r: usize,
    lora_alpha: f64,
    #[serde(default)]
    use_rslora: bool,
    #[serde(default)]
    use_dora: bool,
    #[serde(default)]
    fan_in_fan_out: bool,
}

/// A low-rank adapter: `W + alpha / r B A` in place of `W`.
struct Adapter {
    path: std::path::PathBuf,
    file: TensorFile,
    rank: usize,
    scale: f64,
    unused: std::collections::BTreeSet<String>,
}

impl Adapter {
    fn open(folder: &Path) -> Result<Self, MetricsError> {
        const KIND: &str = "adapter configuration";
        let path = folder.join("adapter_config.json");
        let text = std::fs::read(&path).map_err(|e| MetricsError::io(&path, e))?;
        let config: AdapterConfig = serde_json::from_slice(&text).map_err(|e| MetricsError::format(&path, KIND, e))?;
        if config.use_rslora || config.use_dora || config.fan_in_fan_out {
            let reason = "`use_rslora`, `use_dora` and `fan_in_fan_out` have to be false";
            return Err(MetricsError::format(&path, KIND, reason));
        }
        if config.r == 0 || config.r > 4096 || !config.lora_alpha.is_finite() {
            let reason =
                format!("`r` is {}, `lora_alpha` {}, expected 1..=4096 and a number", config.r, config.lora_alpha);
            return Err(MetricsError::format(&path, KIND, reason));
        }
        let safe = folder.join("adapter_model.safetensors");
        let path = if safe.is_file() { safe } else { folder.join("adapter_model.bin") };
        let file = TensorFile::open(&path, None)?;
        let unused = file.names().into_iter().map(str::to_owned).collect();
        Ok(Self { path, file, rank: config.r, scale: config.lora_alpha / config.r as f64, unused })
    }

    /// Adds the adapter's part to `weight`, `[outputs, inputs]`, if it has one for this name.
    fn add_to(&mut self, weight: &mut [f32], name: &str, outputs: usize, inputs: usize) -> Result<(), MetricsError> {
        let (a_name, b_name) = (format!("{name}.lora_A.weight"), format!("{name}.lora_B.weight"));
        if !self.unused.remove(&a_name) {
            return Ok(());
        }
        self.unused.remove(&b_name);
        let a = self.file.values(&a_name, &[self.rank, inputs])?;
        let b = self.file.values(&b_name, &[outputs, self.rank])?;
        for (row, b) in weight.chunks_exact_mut(inputs).zip(b.chunks_exact(self.rank)) {
            for (&b, a) in b.iter().zip(a.chunks_exact(inputs)) {
                let factor = (self.scale * f64::from(b)) as f32;
                row.iter_mut().zip(a).for_each(|(w, a)| *w += factor * a);
            }
        }
        Ok(())
    }

    /// Refuses an adapter with parts that no network took: it is another variant's.
    fn check_all_used(&self) -> Result<(), MetricsError> {
        match self.unused.first() {
            None => Ok(()),
            Some(name) => Err(MetricsError::Tensor {
                path: self.path.clone(),
                tensor: name.clone(),
                expected: "one of a linear layer of the configured networks".to_owned(),
                found: "something else".to_owned(),
            }),
        }
    }
}

/// A file's tensors with the adapter merged in.
struct Adapted<'a> {
    base: TensorFile,
    prefix: String,
    adapter: &'a mut Adapter,
}

impl Source for Adapted<'_> {
    fn values(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, MetricsError> {
        let mut values = self.base.values(name, shape)?;
        if let (&[outputs, inputs], Some(layer)) = (shape, name.strip_suffix(".weight")) {
            self.adapter.add_to(&mut values, &format!("{}{layer}", self.prefix), outputs, inputs)?;
        }
        Ok(values)
    }
}
