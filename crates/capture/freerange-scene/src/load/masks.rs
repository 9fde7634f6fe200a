//! Mask files: which belong to which photo, and whether they can be what they are taken for.

use super::{LoadConfig, MaskSource, picture::Picture};
use crate::camera::{
    CANONICAL_RADIUS, FrameConfig, View, canonical_from_user,
    scene::{ImageFiles, Located},
};
use crate::{
    SceneError,
    error::In,
    estimate,
    read::{Cameras, IMAGES, Photo, entries, has_extension, inside},
};
use freerange_util::Note;
use glam::DVec3;
use std::{
    collections::{BTreeSet, HashMap},
    path::{Path, PathBuf},
};

/// Folders of masks that are taken without being named: nerfstudio's and COLMAP's, others', nvs2colmap's.
const FOLDERS: [&str; 3] = ["masks", "mask", "image_masks"];
/// Share of a mask's border from which it is no outline of something within the photo.
const ALONG_BORDER: f64 = 0.5;
/// The same from which it may be the negative of one.
const ALL_ALONG_BORDER: f64 = 0.98;
/// Mean agreement with their common hull from which black parts of masks are the object.
const ONE_OBJECT: f64 = 0.8;

/// The masks of a scene's photos.
pub(super) struct MaskFiles {
    /// Of each photo.
    pub of: Vec<Option<PathBuf>>,
    /// The folders that they lie in, of those that were searched.
    pub folders: BTreeSet<PathBuf>,
}

/// Looks for the mask file of each photo; inputs have all or none. A folder that has some and lacks others is an error.
pub(super) fn mask_files(
    cameras: &Cameras,
    config: &LoadConfig,
    notes: &mut Vec<Note>,
) -> Result<MaskFiles, SceneError> {
    let photos = &cameras.photos;
    let mut found = MaskFiles { of: vec![None; photos.len()], folders: BTreeSet::new() };
    let given = match &config.masks {
        MaskSource::Files(folder) => {
            std::fs::read_dir(folder).map_err(|e| In(folder).read(e))?;
            Some(folder.clone())
        }
        MaskSource::Auto => None,
        _ => return Ok(found),
    };
    let mut files = ImageFiles::default();
    let mut searched: HashMap<PathBuf, Vec<PathBuf>> = HashMap::new();
    for (photo, mask) in photos.iter().zip(&mut found.of) {
        if given.is_none() && photo.mask.is_some() {
            mask.clone_from(&photo.mask);
            continue;
        }
        let folder = photo.image.parent().unwrap_or(Path::new(""));
        let folders = searched.entry(folder.into()).or_insert_with(|| match &given {
            Some(given) => vec![given.clone()],
            None => folders_beside(folder, &cameras.root),
        });
        for folder in folders {
            if let Some(path) = mask_in(folder, photo, &mut files)? {
                *mask = Some(path);
                found.folders.insert(folder.clone());
                break;
            }
        }
    }
    only_once(photos, &found.of)?;
    all_or_none(photos, &found.of, given.is_some())?;
    for folder in searched.values().flatten().collect::<BTreeSet<_>>() {
        let count = entries(folder).map_or(0, |f| f.iter().filter(|p| has_extension(p, &IMAGES)).count());
        if count > 0 && !found.folders.contains(folder) && found.of.iter().all(Option::is_none) {
            notes.push(Note::warning(format!(
                "{}: none of its {count} images has a photo's name (as in NAME.png, NAME.jpg.png, NAME.jpg.mask.png): not used as masks",
                cameras.short(folder)
            )));
        }
    }
    Ok(found)
}

/// Folders of masks in a photo's own folder and those above it, as far as the scene goes.
fn folders_beside(folder: &Path, root: &Path) -> Vec<PathBuf> {
    let absolute = std::fs::canonicalize(folder).unwrap_or_else(|_| folder.into());
    let within = absolute.ancestors().take_while(|f| f.starts_with(root));
    // A folder that lies outside of the scene was named by the user: what is in it was, too.
    let own = (!absolute.starts_with(root)).then_some(absolute.as_path());
    own.into_iter().chain(within).flat_map(|f| FOLDERS.map(|name| f.join(name))).filter(|f| f.is_dir()).collect()
}

/// The mask of a photo: `NAME.png` with the image's whole name, as COLMAP has it, the same name with any extension, or `.mask` after
/// either, as RealityScan has it.
fn mask_in(folder: &Path, photo: &Photo, files: &mut ImageFiles) -> Result<Option<PathBuf>, SceneError> {
    let parts: Vec<String> =
        photo.image.components().rev().take(3).map(|c| c.as_os_str().to_string_lossy().into_owned()).collect();
    // With the folders that it is in, then without.
    let paths = (1..=parts.len()).rev().map(|n| parts[..n].iter().rev().cloned().collect::<Vec<_>>().join("/"));
    let names: Vec<String> = std::iter::once(photo.name.clone()).chain(paths).collect();
    for name in names {
        let stem = match name.rsplit_once('.') {
            Some((stem, end)) if IMAGES.iter().any(|e| end.eq_ignore_ascii_case(e)) => stem,
            _ => name.as_str(),
        };
        for candidate in [
            format!("{name}.png"),
            format!("{stem}.png"),
            format!("{name}.mask.png"),
            format!("{stem}.mask.png"),
            format!("{stem}_mask.png"),
        ] {
            let Some(path) = inside(folder, &candidate) else { continue };
            match files.locate(&path) {
                // Beside its photo a file of the same name is the photo.
                Located::There(path) | Located::Renamed(path) if path != photo.image => return Ok(Some(path)),
                Located::Several(first, second) => {
                    return Err(SceneError::Mask {
                        name: photo.name.clone(),
                        expected: "one mask".into(),
                        found: format!("{} and {}", first.display(), second.display()),
                    });
                }
                Located::Unreadable(path, kind) => return Err(In(&path).unreadable(kind)),
                _ => {}
            }
        }
    }
    Ok(None)
}

/// Masks that were found by name belong to one photo each. (A file of cameras may name one for all.)
fn only_once(photos: &[Photo], masks: &[Option<PathBuf>]) -> Result<(), SceneError> {
    let mut seen: HashMap<&Path, &Photo> = HashMap::new();
    for (photo, mask) in photos.iter().zip(masks).filter(|(p, _)| p.mask.is_none()) {
        let Some(mask) = mask else { continue };
        if let Some(other) = seen.insert(mask, photo).filter(|other| other.image != photo.image) {
            return Err(SceneError::Mask {
                name: mask.display().to_string(),
                expected: "the mask of one photo (masks of one name need the photos' folders)".into(),
                found: format!("that of {} and {}", other.image.display(), photo.image.display()),
            });
        }
    }
    Ok(())
}

fn all_or_none(photos: &[Photo], masks: &[Option<PathBuf>], needed: bool) -> Result<(), SceneError> {
    let inputs: Vec<(&Photo, bool)> =
        photos.iter().zip(masks).filter(|(p, _)| !p.further).map(|(p, m)| (p, m.is_some())).collect();
    let there = inputs.iter().filter(|(_, there)| *there).count();
    match inputs.iter().find(|(_, there)| !there) {
        Some((photo, _)) if there > 0 || needed => Err(SceneError::Mask {
            name: photo.name.clone(),
            expected: format!("a mask for every photo, such as {}.png", photo.name),
            found: format!("{there} masks for {} photos, none for this one", inputs.len()),
        }),
        _ => Ok(()),
    }
}

/// What mask files mean, going by how they look.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Meaning {
    /// White is the object.
    Object,
    /// Black is the object: black parts have one hull.
    Inverted,
    /// White is what may be looked at, as nerfstudio and COLMAP have it: almost all of the photos.
    Usable,
}

/// What the masks of `pictures` mean.
pub(super) fn meaning(pictures: &mut [Picture]) -> Meaning {
    let looks: Vec<(f64, f64)> = pictures.iter().map(|p| p.mask_covers).collect();
    let many = |ok: &dyn Fn(&(f64, f64)) -> bool| 5 * looks.iter().filter(|l| ok(l)).count() >= 4 * looks.len();
    if !many(&|(along, _)| *along >= ALONG_BORDER) {
        return Meaning::Object;
    }
    let negative = many(&|(along, all)| *along >= ALL_ALONG_BORDER && (0.1..0.998).contains(all));
    match negative && have_one_hull(pictures) {
        true => Meaning::Inverted,
        false => Meaning::Usable,
    }
}

/// Whether the black parts of masks belong to one thing in space.
fn have_one_hull(pictures: &mut [Picture]) -> bool {
    let (mut masked, mut alphas, mut views) = (Vec::new(), Vec::new(), Vec::new());
    // The images themselves, for as long with another alpha: copies would take as much memory again.
    for picture in pictures {
        let Some(mask) = &picture.mask else { continue };
        let mut image = std::mem::take(&mut picture.image);
        alphas.push(image.pixels().map(|pixel| pixel[3]).collect::<Vec<u8>>());
        for (pixel, share) in image.pixels_mut().zip(mask.pixels()) {
            pixel[3] = pixel[3].min(255 - share[0]);
        }
        views.push(View { name: String::new(), camera: picture.camera, image });
        masked.push(picture);
    }
    let one = are_one_object(&views);
    for ((picture, view), alpha) in masked.into_iter().zip(views).zip(alphas) {
        picture.image = view.image;
        picture.image.pixels_mut().zip(alpha).for_each(|(pixel, alpha)| pixel[3] = alpha);
    }
    one
}

/// Whether masks, the views' alpha, agree with their common hull.
fn are_one_object(views: &[View]) -> bool {
    let Ok(frame) = canonical_from_user(views, &FrameConfig::default()) else { return false };
    let back = frame.canonical_from_user.inverse();
    let agreement = estimate::agreement(views, back.apply(DVec3::ZERO), 1.5 * CANONICAL_RADIUS * back.scale);
    agreement.iter().sum::<f64>() >= ONE_OBJECT * agreement.len() as f64
}
