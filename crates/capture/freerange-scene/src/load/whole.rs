//! Whole photos, beside what was cut out of them: small ones, all in memory, or in files.

use std::{
    borrow::Cow,
    path::{Path, PathBuf},
};

use freerange_util::IoError;
use image::{
    RgbaImage,
    codecs::png::{CompressionType, FilterType, PngEncoder},
};
use rayon::prelude::*;

use super::LoadConfig;
use crate::{SceneError, camera::View, estimate};

/// What is kept of whole photos, beside what is cut out of them.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum KeepWhole {
    /// Small ones, of at most 320 pixels a side: enough to find the table.
    #[default]
    Small,
    /// All of them, in memory.
    Memory,
    /// All of them, as PNG files in this folder.
    Folder(PathBuf),
}

/// The whole photo of each view, undistorted.
#[derive(Clone, Debug)]
pub enum Whole {
    /// As images.
    Memory(Vec<RgbaImage>),
    /// As images of at most 320 pixels a side.
    Small(Vec<RgbaImage>),
    /// As PNG files, which hold the same pixels.
    Files(Vec<PathBuf>),
}

impl Default for Whole {
    fn default() -> Self {
        Self::Small(Vec::new())
    }
}

impl Whole {
    /// Keeps the images of views that are not cut out yet.
    pub(super) fn of(views: &[View], config: &LoadConfig) -> Result<Self, SceneError> {
        let folder = match &config.whole {
            KeepWhole::Small => return Ok(Self::Small(views.par_iter().map(estimate::small).collect())),
            KeepWhole::Memory => return Ok(Self::Memory(views.iter().map(|v| v.image.clone()).collect())),
            KeepWhole::Folder(folder) => folder,
        };
        let write = |(k, view): (usize, &View)| {
            config.stop.check()?;
            let path = folder.join(format!("photo-{k:04}.png"));
            write(&view.image, &path).map_err(|e| SceneError::Write(IoError::at(&path)(e)))?;
            Ok(path)
        };
        Ok(Self::Files(views.par_iter().enumerate().map(write).collect::<Result<_, SceneError>>()?))
    }

    /// The whole photo of view `k`, small where no more is kept.
    ///
    /// # Errors
    /// Where its file is not there any more.
    ///
    /// # Panics
    /// Where there is no view `k`.
    pub fn get(&self, k: usize) -> Result<Cow<'_, RgbaImage>, SceneError> {
        match self {
            Self::Memory(images) | Self::Small(images) => Ok(Cow::Borrowed(&images[k])),
            Self::Files(files) => match image::open(&files[k]) {
                Ok(image) => Ok(Cow::Owned(image.into_rgba8())),
                Err(e) => Err(SceneError::Image { file: files[k].clone(), source: Box::new(e) }),
            },
        }
    }
}

/// Fast rather than small: these files are read on the same machine. Written at once: a buffer that is dropped does not report a full disk.
fn write(image: &RgbaImage, path: &Path) -> std::io::Result<()> {
    let mut bytes = Vec::new();
    let png = PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive);
    image.write_with_encoder(png).map_err(std::io::Error::other)?;
    std::fs::write(path, bytes)
}
