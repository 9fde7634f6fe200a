//! `transforms.json` of NeRF tools and nerfstudio: read by `freerange-scene`, with masks besides.

use super::{Cameras, Format, Intrinsics, Photo, Photos};
use crate::camera::scene::{Description, Found, FrameDescription};
use crate::{SceneError, decode::size_of};
use freerange_util::Note;
use std::path::{Path, PathBuf};

pub(super) fn read(path: &Path) -> Result<Cameras, SceneError> {
    let found = Found::at(path)?;
    let description = Description::read(&found.inputs)?;
    let (inputs, further) = description.split();
    let mut photos = Vec::new();
    let mut notes: Vec<Note> = found.notes.into_iter().map(Note::dropped).collect();
    let mut images = Photos::new(&found.inputs, vec![folder_of(&found.inputs)]);
    for (frames, is_further) in [(inputs, false), (further, true)] {
        for frame in frames {
            photos.extend(photo(frame, is_further, &mut images)?);
        }
    }
    images.finish(&mut notes)?;
    let mut files = vec![found.inputs.clone()];
    if let Some(file) = found.further {
        let others = Description::read(&file)?;
        let mut images = Photos::new(&file, vec![folder_of(&file)]);
        for frame in &others.frames {
            photos.extend(photo(frame, true, &mut images)?);
        }
        images.finish(&mut notes)?;
        notes.extend(others.notes.into_iter().map(Note::understood));
        files.push(file);
    }
    notes.extend(description.notes.iter().map(Note::understood));
    Ok(Cameras { any_up: description.any_up, ..Cameras::new(Format::Transforms, photos, files, notes) })
}

fn folder_of(file: &Path) -> PathBuf {
    file.parent().unwrap_or(Path::new("")).into()
}

fn photo(frame: &FrameDescription, further: bool, images: &mut Photos<'_>) -> Result<Option<Photo>, SceneError> {
    let Some(image) = images.find_at(&frame.image)? else { return Ok(None) };
    let size = match frame.size {
        Some(size) => size,
        None if frame.is_in_pixels() => images.size_for_camera(&frame.name, &image)?,
        None => size_of(&image)?,
    };
    let intrinsics = Intrinsics::Pixels(frame.camera(size)?);
    Ok(Some(Photo { name: frame.name.clone(), image, mask: frame.mask.clone(), intrinsics, lens: frame.lens, further }))
}
