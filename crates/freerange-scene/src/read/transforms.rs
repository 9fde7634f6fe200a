//! `transforms.json` of NeRF tools and nerfstudio: read by `freerange-camera`, with masks besides.

use super::{Cameras, Format, Intrinsics, Photo};
use crate::SceneError;
use freerange_camera::scene::{Description, Found, FrameDescription, find, image_size};
use std::path::Path;

pub(super) fn read(path: &Path) -> Result<Cameras, SceneError> {
    let found = Found::at(path)?;
    let description = Description::read(&found.inputs)?;
    let (inputs, further) = description.split();
    let mut photos = Vec::new();
    for (frames, is_further) in [(inputs, false), (further, true)] {
        for frame in frames {
            photos.push(photo(frame, is_further)?);
        }
    }
    let (mut files, mut notes) = (vec![found.inputs], found.notes);
    if let Some(file) = found.further {
        let others = Description::read(&file)?;
        for frame in &others.frames {
            photos.push(photo(frame, true)?);
        }
        notes.extend(others.notes);
        files.push(file);
    }
    notes.extend(description.notes);
    Ok(Cameras { format: Format::Transforms, photos, files, notes })
}

fn photo(frame: &FrameDescription, further: bool) -> Result<Photo, SceneError> {
    let image = find(frame)?;
    let size = match frame.size {
        Some(size) => size,
        None => image_size(frame)?,
    };
    Ok(Photo {
        name: frame.name.clone(),
        image,
        mask: frame.mask.clone(),
        intrinsics: Intrinsics::Pixels(frame.camera(size)?),
        lens: frame.lens,
        further,
    })
}
