//! The metrics by name.

use std::{fmt, str::FromStr};

use crate::metrics::MetricsError;

/// A measure of how alike two images are (of [`Fid`](Self::Fid) and [`FrechetVgg`](Self::FrechetVgg) two sets of images).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Metric {
    /// [`psnr`](freerange_raster::metrics::psnr), in dB.
    Psnr,
    /// [`ssim_3dgs`](freerange_raster::metrics::ssim_3dgs), the one of the Gaussian splatting papers.
    Ssim,
    /// [`ssim_skimage_gauss`](freerange_raster::metrics::ssim_skimage_gauss): scikit-image's, with Gaussian weights, border cropped.
    SsimCropped,
    /// [`ssim_skimage_sample`](freerange_raster::metrics::ssim_skimage_sample): the same with sample covariances, as pixelSplat reports it.
    SsimSample,
    /// LPIPS 0.1 on AlexNet.
    LpipsAlex,
    /// LPIPS 0.1 on VGG16.
    LpipsVgg,
    /// Cosine of the class features of a DINOv2.
    Dino,
    /// DreamSim, the ensemble of three transformers (what its authors use by default).
    DreamSim,
    /// DreamSim, the single DINO ViT-B/16.
    DreamSimDino,
    /// Frechet distance of Inception-v3 features between the set of renders and the set of true images.
    Fid,
    /// The same distance of VGG16's deepest features (those of LPIPS). Not FID, and no number of one compares with the other:
    /// a stand-in where Inception's weights cannot be had.
    FrechetVgg,
}

impl Metric {
    /// Every metric.
    pub const ALL: [Self; 11] = [
        Self::Psnr,
        Self::Ssim,
        Self::SsimCropped,
        Self::SsimSample,
        Self::LpipsAlex,
        Self::LpipsVgg,
        Self::Dino,
        Self::DreamSim,
        Self::DreamSimDino,
        Self::Fid,
        Self::FrechetVgg,
    ];

    /// The name in commands and in JSON.
    pub fn name(self) -> &'static str {
        match self {
            Self::Psnr => "psnr",
            Self::Ssim => "ssim",
            Self::SsimCropped => "ssim-cropped",
            Self::SsimSample => "ssim-sample",
            Self::LpipsAlex => "lpips-alex",
            Self::LpipsVgg => "lpips-vgg",
            Self::Dino => "dino",
            Self::DreamSim => "dreamsim",
            Self::DreamSimDino => "dreamsim-dino",
            Self::Fid => "fid",
            Self::FrechetVgg => "frechet-vgg",
        }
    }

    /// The name in tables.
    pub fn label(self) -> &'static str {
        match self {
            Self::Psnr => "PSNR",
            Self::Ssim => "SSIM",
            Self::SsimCropped => "SSIM (cropped)",
            Self::SsimSample => "SSIM (sample)",
            Self::LpipsAlex => "LPIPS (AlexNet)",
            Self::LpipsVgg => "LPIPS (VGG)",
            Self::Dino => "DINO",
            Self::DreamSim => "DreamSim",
            Self::DreamSimDino => "DreamSim (DINO)",
            Self::Fid => "FID",
            Self::FrechetVgg => "Frechet distance (VGG16)",
        }
    }

    /// Whether a larger value means more alike.
    pub fn higher_is_better(self) -> bool {
        matches!(self, Self::Psnr | Self::Ssim | Self::SsimCropped | Self::SsimSample | Self::Dino)
    }

    /// Whether one pair of images has a value; else only two sets of images have one.
    pub fn is_per_pair(self) -> bool {
        !matches!(self, Self::Fid | Self::FrechetVgg)
    }

    /// Whether the metric needs a network and its weights.
    pub fn needs_network(self) -> bool {
        !matches!(self, Self::Psnr | Self::Ssim | Self::SsimCropped | Self::SsimSample)
    }

    /// The smallest width and height that the metric is defined for, in pixels.
    pub fn smallest_side(self) -> usize {
        match self {
            Self::SsimCropped | Self::SsimSample => 11,
            Self::LpipsAlex => 31, // two poolings of 3 after a convolution of 11 in steps of 4
            Self::LpipsVgg => 16,  // four halvings
            _ => 1,
        }
    }
}

impl fmt::Display for Metric {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Metric {
    type Err = MetricsError;

    fn from_str(text: &str) -> Result<Self, MetricsError> {
        Self::ALL.into_iter().find(|m| m.name() == text).ok_or_else(|| MetricsError::UnknownMetric {
            found: text.to_owned(),
            expected: Self::ALL.map(Self::name).join(", "),
        })
    }
}
