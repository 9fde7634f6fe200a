//! Photos at even steps around an object, taken without poses.

use super::{Cameras, Format, IMAGES, Intrinsics, Photo, entries, has_extension};
use crate::camera::{Camera, Lens, scene::unreadable_kind};
use crate::{SceneError, error::In};
use freerange_util::Note;
use glam::DVec3;
use std::{
    collections::HashSet,
    ffi::OsString,
    path::{Path, PathBuf},
    str::FromStr,
};

/// How the photos were taken: one full turn in even steps, the camera on one height and aimed at the object's middle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Turntable {
    /// Angle of the camera above the object's middle, degrees.
    pub elevation: f64,
    /// Field of view across the photo's longer side, degrees.
    pub fov: f64,
    /// Whether the object turns clockwise as seen from above, instead of counterclockwise.
    pub clockwise: bool,
}

impl FromStr for Turntable {
    type Err = String;

    /// `ELEVATION,FOV` or `ELEVATION,FOV,cw`.
    fn from_str(text: &str) -> Result<Self, String> {
        let wrong =
            || "expected ELEVATION,FOV in degrees, as in 20,60 (and ,cw for an object that turns clockwise)".to_owned();
        let parts: Vec<&str> = text.split(',').map(str::trim).collect();
        let clockwise = match parts.get(2) {
            None | Some(&"ccw") => false,
            Some(&"cw") => true,
            _ => return Err(wrong()),
        };
        let number = |i: usize| parts.get(i).and_then(|p| p.parse::<f64>().ok()).ok_or_else(wrong);
        let (elevation, fov) = (number(0)?, number(1)?);
        if parts.len() > 3 || !(-85.0..=85.0).contains(&elevation) || !(1.0..=150.0).contains(&fov) {
            return Err(format!("{}, with -85 to 85 and 1 to 150", wrong()));
        }
        Ok(Self { elevation, fov, clockwise })
    }
}

/// Distance of the cameras from the object: any will do, as nothing tells sizes.
const DISTANCE: f64 = 1.75;

/// The photos of a folder, or of its `images`. One of a kind that is not read is an error: it would be missing among the others. Raw files
/// beside photos of the same name are passed over.
pub fn photos_in(folder: &Path) -> Result<Vec<PathBuf>, SceneError> {
    let inner = folder.join("images");
    let folder = if inner.is_dir() { inner } else { folder.to_path_buf() };
    let there = entries(&folder)?;
    let images: Vec<_> = there.iter().filter(|p| p.is_file() && has_extension(p, &IMAGES)).cloned().collect();
    let stem = |path: &PathBuf| path.file_stem().unwrap_or_default().to_ascii_lowercase();
    let known: HashSet<OsString> = images.iter().map(stem).collect();
    let mut unread = there.iter().filter(|f| !known.contains(&stem(f)));
    match unread.find_map(|f| Some((f, unreadable_kind(f)?))) {
        Some((file, kind)) => Err(In(file).unreadable(kind)),
        None if images.len() < 3 => Err(SceneError::TooFew { file: folder, expected: 3, found: images.len() }),
        None => Ok(images),
    }
}

/// Photos in the order of their names, numbers in them by value: that in which cameras take them.
pub fn in_order(photos: &[PathBuf]) -> Vec<PathBuf> {
    let mut photos = photos.to_vec();
    photos.sort_by_cached_key(|p| by_value(&p.file_name().unwrap_or_default().to_string_lossy()));
    photos
}

/// The photos of a folder (or of its `images`), by name, numbers in names by value.
pub(super) fn read(folder: &Path, turntable: &Turntable) -> Result<Cameras, SceneError> {
    let images = in_order(&photos_in(folder)?);
    let folder = images[0].parent().unwrap_or(folder).to_path_buf();
    let (count, elevation) = (images.len(), turntable.elevation.to_radians());
    let photos = images
        .into_iter()
        .enumerate()
        .map(|(i, image)| {
            // An object that turns counterclockwise sees its camera go round clockwise.
            let step = std::f64::consts::TAU * i as f64 / count as f64;
            let azimuth = if turntable.clockwise { step } else { -step };
            let direction =
                DVec3::new(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin());
            let world_to_camera =
                Camera::look_at(DISTANCE * direction, DVec3::ZERO, DVec3::Z, 1.0, 1, 1).world_to_camera;
            let focal = 0.5 / (0.5 * turntable.fov.to_radians()).tan();
            Photo {
                name: image.file_name().unwrap_or_default().to_string_lossy().into_owned(),
                image,
                mask: None,
                intrinsics: Intrinsics::Relative { focal, offset: [0.0; 2], world_to_camera, upright: true },
                lens: Lens::Ideal,
                further: false,
            }
        })
        .collect();
    let way = if turntable.clockwise { "clockwise" } else { "counterclockwise" };
    let notes = vec![Note::assumed(format!(
        "{count} photos in order of their names are taken as one {way} turn of the object in even steps of {:.1} degrees; \
         sizes are relative to the cameras' distance, {DISTANCE}",
        360.0 / count as f64
    ))];
    Ok(Cameras::new(Format::Turntable, photos, vec![folder], notes))
}

/// A name cut into texts and numbers, so that `9` comes before `10`.
fn by_value(name: &str) -> Vec<(String, u128)> {
    let mut parts = vec![(String::new(), 0u128)];
    let mut in_number = false;
    for c in name.chars() {
        match c.to_digit(10) {
            Some(digit) => {
                in_number = true;
                if let Some((_, n)) = parts.last_mut() {
                    *n = n.saturating_mul(10).saturating_add(u128::from(digit));
                }
            }
            None => {
                if std::mem::take(&mut in_number) {
                    parts.push((String::new(), 0));
                }
                if let Some((text, _)) = parts.last_mut() {
                    text.push(c);
                }
            }
        }
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_read() {
        assert_eq!("20,60".parse(), Ok(Turntable { elevation: 20.0, fov: 60.0, clockwise: false }));
        assert_eq!(" -5, 45.5, cw".parse(), Ok(Turntable { elevation: -5.0, fov: 45.5, clockwise: true }));
        for bad in ["", "20", "20,0", "95,60", "20,60,left", "20,60,cw,1", "a,b", "nan,60"] {
            assert!(bad.parse::<Turntable>().is_err(), "{bad}");
        }
    }

    #[test]
    fn numbers_in_names_count() {
        let mut names = ["b2", "a10.jpg", "a9.jpg", "a9b3", "a09b2"];
        names.sort_by_cached_key(|n| by_value(n));
        assert_eq!(names, ["a9.jpg", "a09b2", "a9b3", "a10.jpg", "b2"]);
    }
}
