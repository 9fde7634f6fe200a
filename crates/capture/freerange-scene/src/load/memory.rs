//! What photos will take of memory, before they do.

use super::{KeepWhole, LoadConfig, MaskSource};
use crate::{
    SceneError,
    camera::{View, image_ops::shrunk_size},
    decode::size_of,
    estimate,
    read::Cameras,
};

/// Bytes per pixel of a photo at the size used: the photo that is cut out, the whole one where it is held, its mask or where its backdrop is.
const CUT: u64 = 4;
const WHOLE: u64 = 4;
const MASK: u64 = 1;
/// Bytes per pixel of a file while it is decoded, turned and undistorted; one of 16 bits per channel takes most, a JPEG half of it.
const DECODED: u64 = 16;
/// Share of the memory that files which are decoded at once may take. One is always decoded.
const AT_ONCE: u64 = 4;
/// Files that are decoded at once have no more pixels, whatever memory there is: five photos of 12 megapixels.
const MOST_AT_ONCE: u64 = 1 << 26;

/// Most pixels of the files that are decoded at once, but for one.
pub(super) fn at_once(config: &LoadConfig) -> u64 {
    (config.memory / AT_ONCE / DECODED).min(MOST_AT_ONCE)
}

/// Bytes of the whole photo beside a view of this size.
fn whole(size: (u32, u32), config: &LoadConfig) -> u64 {
    let (w, h) = match &config.whole {
        KeepWhole::Folder(_) => return 0,
        KeepWhole::Memory => size,
        KeepWhole::Small => shrunk_size(size, estimate::SMALL),
    };
    u64::from(w) * u64::from(h) * WHOLE
}

fn within(needed: u64, photos: usize, config: &LoadConfig) -> Result<(), SceneError> {
    match needed <= config.memory {
        true => Ok(()),
        false => Err(SceneError::Memory { photos, limit: config.memory >> 20, needed: needed.div_ceil(1 << 20) }),
    }
}

/// Refuses photos, those that are only compared with among them, that will take too much; before any of them is decoded.
pub(super) fn check_photos(cameras: &Cameras, config: &LoadConfig) -> Result<(), SceneError> {
    let (mut held, mut pixels, mut largest, mut sizes) = (0, 0, 0, Vec::new());
    for photo in &cameras.photos {
        let file = size_of(&photo.image)?;
        let in_file = u64::from(file.0) * u64::from(file.1);
        (pixels, largest) = (pixels + in_file, largest.max(in_file));
        let (w, h) = match photo.lens.is_wide() {
            // Such a lens is seen through a square camera.
            true => (config.max_side, config.max_side),
            false => shrunk_size(file, config.max_side),
        };
        sizes.push((w, h));
        held += u64::from(w) * u64::from(h) * (CUT + MASK);
        held += if photo.further { 0 } else { whole((w, h), config) };
    }
    let decoded = DECODED * pixels.min(at_once(config).max(largest));
    // Whoever asks for estimated masks need not wait for all photos to be decoded to hear of it.
    let found = if config.masks == MaskSource::Estimate { estimate::memory(&sizes) } else { 0 };
    within(held + decoded.max(found), cameras.photos.len(), config)
}

/// Refuses to estimate masks of views where that will take too much.
pub(super) fn check_estimate(views: &[View], config: &LoadConfig) -> Result<(), SceneError> {
    let sizes: Vec<(u32, u32)> = views.iter().map(|v| v.image.dimensions()).collect();
    // Each gets a mask of its own size.
    let bytes = |&(w, h): &(u32, u32)| u64::from(w) * u64::from(h) * (CUT + MASK) + whole((w, h), config);
    let held = sizes.iter().map(bytes).sum::<u64>();
    within(held + estimate::memory(&sizes), views.len(), config)
}
