//! Whole photos, beside what was cut out of them: in memory, or in files.

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
use crate::{SceneError, camera::View};

/// The whole photo of each view, undistorted.
#[derive(Clone, Debug)]
pub enum Whole {
    /// As images.
    Memory(Vec<RgbaImage>),
    /// As PNG files, which hold the same pixels.
    Files(Vec<PathBuf>),
}

impl Default for Whole {
    fn default() -> Self {
        Self::Memory(Vec::new())
    }
}

impl Whole {
    /// Keeps the images of views that are not cut out yet.
    pub(super) fn of(views: &[View], config: &LoadConfig) -> Result<Self, SceneError> {
        let Some(folder) = &config.whole_folder else {
            return Ok(Self::Memory(views.iter().map(|v| v.image.clone()).collect()));
        };
        let write = |(k, view): (usize, &View)| {
            config.stop.check()?;
            let path = folder.join(format!("photo-{k:04}.png"));
            write(&view.image, &path).map_err(|e| SceneError::Write(IoError::at(&path)(e)))?;
            Ok(path)
        };
        Ok(Self::Files(views.par_iter().enumerate().map(write).collect::<Result<_, SceneError>>()?))
    }

    /// The whole photo of view `k`.
    ///
    /// # Errors
    /// Where its file is not there any more.
    ///
    /// # Panics
    /// Where there is no view `k`.
    pub fn get(&self, k: usize) -> Result<Cow<'_, RgbaImage>, SceneError> {
        match self {
            Self::Memory(images) => Ok(Cow::Borrowed(&images[k])),
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
