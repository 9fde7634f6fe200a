//! What was done with photos on the way in, for the user to read.

use super::{aim::Aim, picture::Picture};
use crate::{
    camera::Lens,
    read::{Cameras, Intrinsics, Photo},
};
use freerange_util::Note;

/// What was done with the photos `inputs`.
pub(super) fn tell(
    pictures: &[Picture],
    cameras: &Cameras,
    inputs: &[usize],
    aim: Option<&Aim>,
    notes: &mut Vec<Note>,
) {
    let lenses = inputs.iter().filter(|i| cameras.photos[**i].lens != Lens::Ideal).count();
    if lenses > 0 {
        notes.push(Note::changed(format!("lens distortion was removed from {lenses} photos")));
    }
    let aimed = pictures.iter().filter(|p| p.aimed).count();
    if aimed > 0 && aim.is_some_and(|aim| aim.by_axes) {
        notes.push(Note::assumed(format!(
            "{aimed} photos of wide lenses are seen by a pinhole that looks where the cameras' axes meet, as nothing \
             says where the object is (masks or --center X,Y,Z do)"
        )));
    } else if aimed > 0 {
        notes.push(Note::changed(format!(
            "{aimed} photos of wide lenses are seen by a pinhole that looks at the object"
        )));
    }
    let turned = pictures.iter().filter(|p| p.turned).count();
    if turned > 0 {
        notes.push(Note::changed(format!("{turned} photos were turned as their EXIF data says")));
    }
    let converted = pictures.iter().filter(|p| p.converted).count();
    if converted > 0 {
        notes.push(Note::changed(format!("the colors of {converted} photos were converted to sRGB")));
    }
    if let Some(p) = pictures.iter().find(|p| !p.aimed && p.image.dimensions() != p.size) {
        let (w, h) = p.image.dimensions();
        notes.push(Note::changed(format!("photos are used at {w} x {h} pixels and alike, smaller than they are")));
    }
    let wide = pictures.iter().filter(|p| p.size.0 > p.size.1).count();
    let high = pictures.iter().filter(|p| p.size.0 < p.size.1).count();
    if wide > 0 && high > 0 {
        notes.push(Note::understood(format!("{wide} photos are wide, {high} are high")));
    }
}

/// What was taken to be so of the files of photos and masks: one note of a kind, with the first of its photos. `what`:
/// what notes call the photos.
pub(super) fn tell_files(pictures: &[Picture], cameras: &Cameras, which: &[usize], what: &str, notes: &mut Vec<Note>) {
    let found = |of: &dyn Fn(&Picture, &Photo) -> Option<String>| {
        let photos = pictures.iter().zip(which.iter().map(|i| &cameras.photos[*i]));
        let mut all = photos.filter_map(|(p, photo)| Some(format!("{}{}", photo.name, of(p, photo)?)));
        let first = all.next()?;
        Some(format!("{} {what} ({first})", 1 + all.count()))
    };
    let scaled = |p: &Picture, photo: &Photo| match photo.intrinsics {
        Intrinsics::Pixels(c) if (c.width, c.height) != p.size => {
            Some(format!(": {} x {} instead of {} x {}", p.size.0, p.size.1, c.width, c.height))
        }
        _ => None,
    };
    if let Some(found) = found(&scaled) {
        notes.push(Note::assumed(format!(
            "intrinsics were scaled: {found} have another size than their cameras, and are taken for reduced or \
             enlarged, not cropped"
        )));
    }
    if let Some(found) = found(&|p, _| Some(format!(": {}", p.profile?))) {
        notes.push(Note::dropped(format!(
            "the color profile of {found} is not used: only those of red, green and blue are, and the colors are \
             taken for sRGB"
        )));
    }
    if let Some(found) = found(&|p, _| p.unused_alpha.then(String::new)) {
        notes.push(Note::dropped(format!("the transparency of {found} is not used: mask files stand in for it")));
    }
    if let Some(found) = found(&|p, _| Some(format!(": {}", p.mask_label?))) {
        notes.push(Note::assumed(format!(
            "masks without white: the one value in those of {found} is taken for the object"
        )));
    }
    if let Some(found) = found(&|p, _| p.mask_resized.map(|(w, h)| format!(": from {w} x {h}"))) {
        notes.push(Note::changed(format!("the masks of {found} were resized to the size of the photo")));
    }
}
