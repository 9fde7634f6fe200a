//! From posed images to image tokens.
//!
//! A token is one patch: appearance features, sin-cos position, mean color, Plücker ray, side by side.

pub(crate) mod bicubic;
pub(crate) mod dinov2;

use std::path::PathBuf;

use burn::{
    module::Module,
    tensor::{Tensor, TensorData},
};

pub use dinov2::{Dinov2, WeightsOrigin};

use crate::{EncoderConfig, ModelConfig, PLUCKER, compute::Compute};

/// Turns posed images into image tokens.
#[derive(Module, Debug)]
pub struct ImageEncoder {
    /// The frozen, published network whose features a patch is turned into; none while that is taken out.
    dinov2: Option<Dinov2>,
    /// Whether there is one; a patch is its pixels otherwise.
    published: bool,
    patch_size: usize,
    channels: usize,
    position_features: usize,
}

impl ImageEncoder {
    pub(crate) fn new(config: &ModelConfig, dinov2: Option<Dinov2>) -> Self {
        let published = matches!(config.encoder, EncoderConfig::Dinov2(_));
        Self {
            dinov2: dinov2.filter(|_| published),
            published,
            patch_size: config.encoder.patch_size() as usize,
            channels: config.encoder.channels(),
            position_features: config.position_features,
        }
    }

    /// The frozen DINOv2, if this encoder has one.
    pub fn dinov2(&self) -> Option<&Dinov2> {
        self.dinov2.as_ref()
    }

    pub(crate) fn set_compute(&mut self, compute: Compute) {
        if let Some(dinov2) = &mut self.dinov2 {
            dinov2.set_compute(compute);
        }
    }

    pub(crate) fn replace_dinov2(&mut self, dinov2: Option<Dinov2>) -> Option<Dinov2> {
        match self.published {
            true => std::mem::replace(&mut self.dinov2, dinov2),
            false => None,
        }
    }

    /// Image tokens.
    ///
    /// - `images`: `[b, views, h, w, channels]` in 0..1; `h` and `w` multiples of the patch
    /// - `plucker`: rays of the patch centers, `[b, views, rows, columns, 6]`
    ///
    /// Returns `[b, views * rows * columns, features + position + 3 + 6]`; view by view, row by row.
    ///
    /// # Panics
    /// If shapes do not fit each other or the configuration, or the DINOv2 is taken out.
    pub fn forward(&self, images: Tensor<5>, plucker: Tensor<5>) -> Tensor<3> {
        let [b, views, h, w, channels] = images.dims();
        let p = self.patch_size;
        let (rows, columns) = (h / p, w / p);
        assert_eq!(channels, self.channels, "channels of the images");
        assert!(h == rows * p && w == columns * p, "{h} x {w} images are not whole patches of {p}");
        assert_eq!(plucker.dims(), [b, views, rows, columns, PLUCKER], "one ray per patch");
        let tokens = views * rows * columns;

        let patches = patches(images.clone(), p) * 2.0 - 1.0; // [b, tokens, p * p * channels]
        let color = patches.clone().reshape([b, tokens, p * p, channels]).mean_dim(2).reshape([b, tokens, channels]);
        let features = match self.published {
            true => {
                let dinov2 = self.dinov2.as_ref().expect("the frozen encoder is in its place");
                let images = images.reshape([b * views, h, w, channels]).permute([0, 3, 1, 2]);
                let features = dinov2.patch_features(dinov2::imagenet_normalized(images)).detach();
                features.reshape([b, tokens, dinov2.hidden()])
            }
            false => patches,
        };
        let position = position_embedding(rows, columns, self.position_features);
        let position = TensorData::new(position, [1, rows * columns, self.position_features]);
        let position = Tensor::<3>::from_data(position, &features.device()).repeat(&[b, views, 1]);
        let rays = plucker.reshape([b, tokens, PLUCKER]);
        Tensor::cat(vec![features, position, color.narrow(2, 0, 3), rays], 2)
    }
}

/// `[b, views, h, w, c]` to `[b, views * h/p * w/p, p * p * c]`: view by view, row by row; pixels of a patch row by row.
pub(crate) fn patches(images: Tensor<5>, p: usize) -> Tensor<3> {
    let [b, views, h, w, c] = images.dims();
    let (rows, columns) = (h / p, w / p);
    let x = images.reshape([b * views * rows, p, columns, p * c]).swap_dims(1, 2); // [b v rows, columns, p, p c]
    x.reshape([b, views * rows * columns, p * p * c])
}

/// Sin-cos embedding of each patch's row and column (Vaswani et al. 2017, in two dimensions), `[rows * columns,
/// features]`: sines then cosines of the row, sines then cosines of the column, at a quarter of the features each.
pub fn position_embedding(rows: usize, columns: usize, features: usize) -> Vec<f32> {
    let quarter = features / 4;
    let frequencies: Vec<f64> = (0..quarter).map(|i| 10_000f64.powf(-(i as f64) / quarter as f64)).collect();
    let mut out = Vec::with_capacity(rows * columns * features);
    for row in 0..rows {
        for column in 0..columns {
            for place in [row as f64, column as f64] {
                out.extend(frequencies.iter().map(|f| (place * f).sin() as f32));
                out.extend(frequencies.iter().map(|f| (place * f).cos() as f32));
            }
        }
    }
    out
}

/// Published weights of a frozen encoder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EncoderWeights {
    /// What they are known by: see [`Dinov2Config::weights`](crate::Dinov2Config::weights).
    pub name: String,
    /// Where they lie.
    pub folder: PathBuf,
}
