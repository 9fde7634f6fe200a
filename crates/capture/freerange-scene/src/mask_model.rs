//! Segmentation networks of the user's own: which file, and what it takes.

use std::path::PathBuf;

/// A segmentation network: an ONNX file with one input, `[1, 3, height, width]`, whose first output is the object's share of each pixel,
/// `[1, 1, height, width]`: from 0 to 1, or log odds if any number is beyond that. Photos are scaled to its size, whatever their shape; to
/// 320 x 320 where it takes any.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MaskModel {
    /// The file.
    pub file: PathBuf,
    /// What it takes for pixels.
    pub pixels: PixelRange,
}

/// What networks take for the red, green and blue of a pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PixelRange {
    /// 0 to 1, minus ImageNet's mean, divided by its standard deviation: U2-Net, BiRefNet and most others.
    #[default]
    Imagenet,
    /// 0 to 1.
    Unit,
    /// -0.5 to 0.5: IS-Net.
    Centered,
    /// -1 to 1.
    Signed,
}

impl PixelRange {
    /// All, by their names in options.
    pub const ALL: [(&'static str, Self); 4] =
        [("imagenet", Self::Imagenet), ("unit", Self::Unit), ("centered", Self::Centered), ("signed", Self::Signed)];

    /// What is subtracted from values of 0 to 1, and what they are divided by then; red, green, blue.
    pub fn mean_and_deviation(self) -> ([f32; 3], [f32; 3]) {
        match self {
            Self::Imagenet => ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]),
            Self::Unit => ([0.0; 3], [1.0; 3]),
            Self::Centered => ([0.5; 3], [1.0; 3]),
            Self::Signed => ([0.5; 3], [0.5; 3]),
        }
    }
}
