//! Objects as pictures on one sheet.

use crate::Object;
use freerange_gaussians::Gaussians;
use freerange_optim::{over_white, render_over_white};
use freerange_util::Invalid;
use image::{Rgb, RgbImage, RgbaImage};

use crate::build::BuildError;

/// Gap between pictures on a contact sheet, in pixels.
const GAP: u32 = 2;
/// Largest side of a contact sheet, in pixels.
const MAX_SHEET: u64 = 16384;

/// Objects on one white sheet, `columns` of them side by side. Each is a row of pictures in front of white: two views,
/// then, as seen from the first view, the coarsest, the middle and the finest slice, then, where they are given, the
/// Gaussians before the tree.
///
/// # Errors
/// [`BuildError::Config`] for a sheet of no or too many pixels; the errors of `objects`.
pub fn contact_sheet(
    objects: impl ExactSizeIterator<Item = Result<(Object, Option<Gaussians>), BuildError>>,
    columns: u64,
) -> Result<RgbaImage, BuildError> {
    let count = objects.len() as u64;
    let refused = |found: String| {
        BuildError::from(Invalid::new(
            "contact sheet",
            format!("at least one object and column, and at most {MAX_SHEET} pixels either way"),
            found,
        ))
    };
    if count == 0 || columns == 0 {
        return Err(refused(format!("{count} objects in {columns} columns")));
    }
    let columns = columns.min(count);
    let mut sheet = RgbaImage::default();
    let mut cell = [0; 2];
    let mut per_object = 0;
    // One object after the other, so that memory does not grow with their number.
    for (i, object) in (0..).zip(objects) {
        let (object, leaves) = object?;
        let pictures = pictures(&object, leaves.as_ref())?;
        if i == 0 {
            let (w, h) = pictures[0].dimensions();
            per_object = pictures.len();
            cell = [per_object as u64 * u64::from(w + GAP) + u64::from(GAP), u64::from(h + GAP)];
            let [width, height] = [columns.saturating_mul(cell[0]), count.div_ceil(columns).saturating_mul(cell[1])];
            if width > MAX_SHEET || height > MAX_SHEET {
                return Err(refused(format!("{width} x {height} pixels")));
            }
            sheet = RgbaImage::from_pixel(width as u32, height as u32, image::Rgba([255; 4]));
        }
        let (x, y) = (i % columns * cell[0], i / columns * cell[1]);
        for (k, picture) in pictures.into_iter().take(per_object).enumerate() {
            let x = x + k as u64 * u64::from(picture.width() + GAP);
            let picture = image::DynamicImage::ImageRgb8(picture).into_rgba8();
            image::imageops::replace(&mut sheet, &picture, x as i64, y as i64);
        }
    }
    Ok(sheet)
}

/// The pictures of an object on a contact sheet, at least one.
fn pictures(object: &Object, leaves: Option<&Gaussians>) -> Result<Vec<RgbImage>, BuildError> {
    let depths: Vec<u32> = object.slices.keys().copied().collect();
    let no = |what: &str| {
        BuildError::from(Invalid::new(
            format!("object {}", object.id),
            "at least one view and one slice",
            format!("no {what}"),
        ))
    };
    let camera = object.views.first().ok_or_else(|| no("view"))?.camera;
    let (coarse, fine) = depths.first().zip(depths.last()).ok_or_else(|| no("slice"))?;
    let [w, h] = [camera.width, camera.height];
    // Objects of one source have as many pictures each, also where two of these are the same.
    let second = object.views.len().div_ceil(2).min(object.views.len() - 1);
    let mut pictures = vec![
        picture(&over_white(&object.views[0].image), w, h),
        picture(&over_white(&object.views[second].image), w, h),
    ];
    for &depth in [coarse, &depths[depths.len() / 2], fine] {
        pictures.push(picture(&render_over_white(object.slice(depth)?, &camera)?, w, h));
    }
    if let Some(leaves) = leaves {
        pictures.push(picture(&render_over_white(leaves, &camera)?, w, h));
    }
    Ok(pictures)
}

/// An image from values 0..1, `[h, w, 3]`.
fn picture(values: &[f32], width: u32, height: u32) -> RgbImage {
    let pixels = values.as_chunks::<3>().0;
    RgbImage::from_fn(width, height, |x, y| Rgb(pixels[(y * width + x) as usize].map(|v| (v * 255.0).round() as u8)))
}
