//! Metrics that need a network, and one object that computes all metrics of pairs of images.

mod conv;
mod dino;
mod dreamsim;
mod inception;
mod lpips;
mod resize;
mod source;
mod vit;

use burn::tensor::{Device, Tensor, TensorData};
use freerange_raster::metrics::{
    CHANNELS, ImageError, capped_psnr, check_size, ssim_3dgs, ssim_skimage_gauss, ssim_skimage_sample,
};

use crate::metrics::{
    Metric, MetricsError,
    weights::{UsedFile, Weights},
};
use dino::Dino;
use dreamsim::DreamSim;
pub use inception::Inception;
pub use lpips::{Lpips, LpipsNet};
use resize::Image8;

/// What an [`Evaluator`] computes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EvaluatorConfig {
    /// The metrics; repetitions are ignored.
    pub metrics: Vec<Metric>,
    /// The set of weights of [`Metric::Dino`]: `dinov2-small`, `dinov2-base` or `dinov2-large`.
    pub dino: String,
    /// Pairs that pass through a network at once. More fill a GPU better and take more memory; on the CPU 1 is best.
    pub batch: usize,
}

impl Default for EvaluatorConfig {
    /// Every metric, DINOv2-Base, one pair at a time.
    fn default() -> Self {
        Self { metrics: Metric::ALL.to_vec(), dino: "dinov2-base".to_owned(), batch: 1 }
    }
}

/// A metric that was asked for and has no network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NotComputed {
    /// Which.
    pub metric: Metric,
    /// Which file is missing and how to get it.
    pub reason: String,
}

/// Two images to compare, `[height, width, 3]` in 0..1.
#[derive(Clone, Copy, Debug)]
pub struct Pair<'a> {
    /// What was made.
    pub render: &'a [f32],
    /// What it should be.
    pub truth: &'a [f32],
}

/// Features of VGG16's last convolution.
pub const VGG_WIDTH: usize = 512;
/// Side, in pixels, of the images that VGG16 was trained on.
const VGG_SIDE: usize = 224;

/// What one pair gave.
#[derive(Clone, Debug, PartialEq)]
pub struct Scores {
    /// One value per metric of a pair, in the order of [`Evaluator::metrics`]. PSNR of equal images is infinite.
    pub values: Vec<(Metric, f64)>,
    /// If FID was asked for: Inception's features of the render and of the true image, [`Inception::WIDTH`] each. Add
    /// them to two [`FeatureStatistics`](crate::metrics::FeatureStatistics); FID is their [`frechet_distance`](crate::metrics::frechet_distance).
    pub inception: Option<[Vec<f32>; 2]>,
}

/// All metrics of pairs of images.
///
/// LPIPS sees the values as they are. DINO, DreamSim and Inception see images of 8 bits per channel, because that is
/// what their authors' programs read: values are clamped and rounded first.
pub struct Evaluator {
    metrics: Vec<Metric>,
    batch: usize,
    device: Device,
    lpips: Vec<(Metric, Lpips)>,
    dino: Option<Dino>,
    dreamsim: Vec<(Metric, DreamSim)>,
    inception: Option<Inception>,
    vgg: Option<Lpips>,
    used: Vec<UsedFile>,
}

impl Evaluator {
    /// Reads the networks of the metrics. Metrics whose weights are nowhere are left out and returned beside it.
    ///
    /// # Errors
    /// If a file is there but broken, or a set of weights is unknown.
    pub fn open(
        config: &EvaluatorConfig,
        weights: &Weights,
        device: &Device,
    ) -> Result<(Self, Vec<NotComputed>), MetricsError> {
        let mut out = Self {
            metrics: Vec::new(),
            batch: config.batch.max(1),
            device: device.clone(),
            lpips: Vec::new(),
            dino: None,
            dreamsim: Vec::new(),
            inception: None,
            vgg: None,
            used: Vec::new(),
        };
        let mut missing = Vec::new();
        for &metric in &config.metrics {
            if out.metrics.contains(&metric) {
                continue;
            }
            match out.add(metric, config, weights) {
                Ok(()) => out.metrics.push(metric),
                Err(e @ MetricsError::NotFound { .. }) => missing.push(NotComputed { metric, reason: e.to_string() }),
                Err(e) => return Err(e),
            }
        }
        Ok((out, missing))
    }

    fn add(&mut self, metric: Metric, config: &EvaluatorConfig, weights: &Weights) -> Result<(), MetricsError> {
        let device = self.device.clone();
        let mut files = |set: &str| weights.open(set, &mut self.used);
        match metric {
            Metric::Psnr | Metric::Ssim | Metric::SsimCropped | Metric::SsimSample => {}
            Metric::LpipsAlex => {
                let f = files("lpips-alex")?;
                self.lpips.push((metric, Lpips::load(LpipsNet::Alex, &f[0], &f[1], &device)?));
            }
            Metric::LpipsVgg => {
                let f = files("lpips-vgg")?;
                self.lpips.push((metric, Lpips::load(LpipsNet::Vgg, &f[0], &f[1], &device)?));
            }
            Metric::Dino => {
                let f = files(&config.dino)?;
                let folder = f[0].parent().unwrap_or(&f[0]); // a file has a folder
                self.dino = Some(Dino::load(folder, &device)?);
            }
            Metric::DreamSim => {
                let f = files("dreamsim")?;
                self.dreamsim.push((metric, DreamSim::load_ensemble(&f[0], &f[1], &f[2], &f[3], &device)?));
            }
            Metric::DreamSimDino => {
                let f = files("dreamsim-dino")?;
                self.dreamsim.push((metric, DreamSim::load_dino(&f[0], &f[1], &device)?));
            }
            Metric::Fid => self.inception = Some(Inception::load(&files("fid")?[0], &device)?),
            Metric::FrechetVgg => {
                let f = files("lpips-vgg")?;
                self.vgg = Some(Lpips::load(LpipsNet::Vgg, &f[0], &f[1], &device)?);
            }
        }
        Ok(())
    }

    /// The metrics that are computed, in the order they were asked for.
    pub fn metrics(&self) -> &[Metric] {
        &self.metrics
    }

    /// The files of weights that were read, for reports.
    pub fn used_files(&self) -> &[UsedFile] {
        &self.used
    }

    /// VGG16's features of an image, `[height, width, 3]` in 0..1, for [`Metric::FrechetVgg`]; none if that was not asked for:
    /// activations of the last convolution, averaged over its pixels, [`VGG_WIDTH`] numbers. The image is rounded to 8 bits and
    /// resized to 224 x 224 bilinearly, as Inception's are to theirs.
    ///
    /// # Errors
    /// If the image has another size, or a value that is no finite number.
    pub fn vgg_features(&self, image: &[f32], width: usize, height: usize) -> Result<Option<Vec<f32>>, MetricsError> {
        let Some(vgg) = &self.vgg else { return Ok(None) };
        check_size(image, image, width, height)?;
        if let Some(index) = image.iter().position(|v| !v.is_finite()) {
            return Err(ImageError::NotFinite { image: "image", index, value: image[index].to_string() }.into());
        }
        let mut planes = Vec::with_capacity(CHANNELS * VGG_SIDE * VGG_SIDE);
        Image8::quantized(image, width, height).append_bilinear(VGG_SIDE, VGG_SIDE, &mut planes);
        let pixels = Tensor::from_data(TensorData::new(planes, [1, CHANNELS, VGG_SIDE, VGG_SIDE]), &self.device);
        Ok(Some(host(vgg.deepest((pixels + 1.0) / 2.0))))
    }

    /// The scores of pairs of one size.
    ///
    /// # Errors
    /// If an image has another size or a pixel that is no finite number, or is too small for a metric
    /// ([`Metric::smallest_side`]; for DINO also narrower than a sixteenth of its length).
    pub fn score(&self, pairs: &[Pair<'_>], width: usize, height: usize) -> Result<Vec<Scores>, MetricsError> {
        for pair in pairs {
            check_size(pair.render, pair.truth, width, height)?;
            for (image, values) in [("first image", pair.render), ("second image", pair.truth)] {
                if let Some(index) = values.iter().position(|v| !v.is_finite()) {
                    return Err(ImageError::NotFinite { image, index, value: values[index].to_string() }.into());
                }
            }
        }
        let narrow = width.max(height).div_ceil(16);
        for metric in &self.metrics {
            let needed = metric.smallest_side().max(if *metric == Metric::Dino { narrow } else { 1 });
            if width.min(height) < needed {
                return Err(ImageError::TooSmall { needed, height, width }.into());
            }
        }
        let mut out = Vec::with_capacity(pairs.len());
        for pairs in pairs.chunks(self.batch) {
            out.extend(self.score_batch(pairs, width, height)?);
        }
        Ok(out)
    }

    fn score_batch(&self, pairs: &[Pair<'_>], width: usize, height: usize) -> Result<Vec<Scores>, MetricsError> {
        let mut columns: Vec<(Metric, Vec<f64>)> = Vec::new();
        for (metric, lpips) in &self.lpips {
            let renders = self.planes(pairs.iter().map(|p| p.render), [height, width]);
            let truths = self.planes(pairs.iter().map(|p| p.truth), [height, width]);
            let distance = lpips.distance(renders, truths);
            columns.push((*metric, host(distance).into_iter().map(f64::from).collect()));
        }
        let needs_files = self.dino.is_some() || !self.dreamsim.is_empty() || self.inception.is_some();
        let images: Vec<Image8> = match needs_files {
            // Renders, then true images.
            true => pairs
                .iter()
                .map(|p| p.render)
                .chain(pairs.iter().map(|p| p.truth))
                .map(|v| Image8::quantized(v, width, height))
                .collect(),
            false => Vec::new(),
        };
        let cosines = |features: Vec<Vec<f32>>| -> Vec<f64> {
            let (renders, truths) = features.split_at(pairs.len());
            renders.iter().zip(truths).map(|(a, b)| cosine_similarity(a, b)).collect()
        };
        if let Some(dino) = &self.dino {
            columns.push((Metric::Dino, cosines(dino.embed(&images))));
        }
        for (metric, dreamsim) in &self.dreamsim {
            columns.push((*metric, cosines(dreamsim.embed(&images)).into_iter().map(|c| 1.0 - c).collect()));
        }
        let inception = self.inception.as_ref().map(|network| inception_features(network, &images, &self.device));
        pairs
            .iter()
            .enumerate()
            .map(|(i, pair)| {
                let (a, b) = (pair.render, pair.truth);
                let value = |metric: Metric| -> Result<f64, MetricsError> {
                    Ok(match metric {
                        Metric::Psnr => capped_psnr(a, b)?,
                        Metric::Ssim => ssim_3dgs(a, b, width, height)?,
                        Metric::SsimCropped => ssim_skimage_gauss(a, b, width, height)?,
                        Metric::SsimSample => ssim_skimage_sample(a, b, width, height)?,
                        other => columns.iter().find(|(m, _)| *m == other).expect("computed above").1[i],
                    })
                };
                let metrics = self.metrics.iter().filter(|m| m.is_per_pair());
                Ok(Scores {
                    values: metrics.map(|&m| Ok((m, value(m)?))).collect::<Result<_, MetricsError>>()?,
                    inception: inception.as_ref().map(|all| [all[i].clone(), all[pairs.len() + i].clone()]),
                })
            })
            .collect()
    }

    /// Images as planes. `[b, 3, h, w]`
    fn planes<'a>(&self, images: impl Iterator<Item = &'a [f32]>, [height, width]: [usize; 2]) -> Tensor<4> {
        let mut values: Vec<f32> = Vec::new();
        let mut count = 0;
        for image in images {
            for channel in 0..CHANNELS {
                values.extend(image[channel..].iter().step_by(CHANNELS));
            }
            count += 1;
        }
        Tensor::from_data(TensorData::new(values, [count, CHANNELS, height, width]), &self.device)
    }
}

/// Inception's features of images of any size.
fn inception_features(network: &Inception, images: &[Image8], device: &Device) -> Vec<Vec<f32>> {
    const SIDE: usize = Inception::SIDE;
    let mut values = Vec::with_capacity(images.len() * CHANNELS * SIDE * SIDE);
    images.iter().for_each(|image| image.append_bilinear(SIDE, SIDE, &mut values));
    let pixels = TensorData::new(values, [images.len(), CHANNELS, SIDE, SIDE]);
    rows(network.features(Tensor::from_data(pixels, device)))
}

/// `a . b / (|a| |b|)` in double precision, each length at least 1e-8 (a zero vector is similar to nothing).
///
/// # Panics
/// If the lengths differ.
pub fn cosine_similarity(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len(), "the features differ in length");
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(&x, &y)| f64::from(x) * f64::from(y)).sum::<f64>();
    dot(a, b) / (dot(a, a).sqrt().max(1e-8) * dot(b, b).sqrt().max(1e-8))
}

/// A tensor's values on the host.
fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().convert::<f32>().try_into_vec::<f32>().expect("converted to f32")
}

/// The rows of a matrix on the host.
fn rows(tensor: Tensor<2>) -> Vec<Vec<f32>> {
    let width = tensor.dims()[1];
    host(tensor).chunks_exact(width).map(<[f32]>::to_vec).collect()
}

#[cfg(test)]
mod tests;
