//! What a user's file of Gaussians lacks. In: the file and an initial fit, both in the canonical frame, and the photos. Out: the
//! file, and those Gaussians of the fit that stand where photos show the object and the file does not.
//!
//! A part of an object is a poor proposal by itself: the network corrects what is there, and does not fill what is missing
//! (docs/research/experiments/initial-fits.md).

use freerange_gaussians::{Gaussians, channel};
use freerange_raster::{RasterConfig, render};
use freerange_scene::camera::{View, pixel_of};
use glam::DVec3;

use crate::{Error, error::Lift};

/// Cells along each side of the cube in which places are compared, and half of that side: the object has a radius of 0.5.
const CELLS: usize = 40;
const HALF: f64 = 0.6;
/// Fainter Gaussians fill no place.
const FAINT: f32 = 0.1;

/// `own`, and after it those Gaussians of `fit` that
/// - at least one photo shows at a pixel of the object at which `own` lets more than half of the light through, and
/// - have no Gaussian of `own` in their cell or in one beside it. Cells are 0.03 wide.
///
/// # Errors
/// If a camera cannot be rendered from.
pub(super) fn completed(own: Gaussians, fit: &Gaussians, photos: &[View]) -> Result<Gaussians, Error> {
    let filled = filled(&own);
    let mut wanted = vec![false; fit.len()];
    for photo in photos {
        let camera = &photo.camera;
        let shown = render(own.rows(), &[*camera], &[[0.0; 3]], &RasterConfig::default()).lift()?;
        let masks = photo.image.as_raw().as_chunks::<4>().0;
        let missing = |(pixel, _): (usize, f64)| masks[pixel][3] >= 128 && shown.alpha[pixel] < 0.5;
        for (i, wanted) in wanted.iter_mut().enumerate() {
            *wanted |= pixel_of(camera, fit.mean(i)).is_some_and(missing);
        }
    }
    let empty = |i: &usize| wanted[*i] && cell(fit.mean(*i)).is_some_and(|at| !filled[index(at)]);
    let added = fit.select((0..fit.len()).filter(empty));
    Ok(Gaussians::from_rows(own.rows().iter().chain(added.rows()).copied().collect()))
}

/// Cells with a Gaussian, and those beside them.
fn filled(own: &Gaussians) -> Vec<bool> {
    let mut filled = vec![false; CELLS.pow(3)];
    let faint = (FAINT / (1.0 - FAINT)).ln();
    for (i, row) in own.iter().enumerate() {
        let Some([x, y, z]) = cell(own.mean(i)).filter(|_| row[channel::LOGIT_OPACITY] > faint) else { continue };
        let beside = |at: usize| at.saturating_sub(1)..(at + 2).min(CELLS);
        for x in beside(x) {
            for y in beside(y) {
                beside(z).for_each(|z| filled[index([x, y, z])] = true);
            }
        }
    }
    filled
}

/// The cell of a point; none outside of the cube.
fn cell(point: DVec3) -> Option<[usize; 3]> {
    let at = (point / HALF + 1.0) * (0.5 * CELLS as f64);
    let within = at.min_element() >= 0.0 && at.max_element() < CELLS as f64;
    within.then(|| at.to_array().map(|v| v as usize))
}

fn index([x, y, z]: [usize; 3]) -> usize {
    (x * CELLS + y) * CELLS + z
}

#[cfg(test)]
mod tests {
    use freerange_scene::camera::Camera;
    use image::{Rgba, RgbaImage};

    use super::*;

    fn at(points: &[[f32; 3]], logit: f32) -> Gaussians {
        let mut all = Gaussians::default();
        for point in points {
            let mut row = [0.0; channel::COUNT];
            row[channel::MEAN].copy_from_slice(point);
            row[channel::LOG_SCALE].fill(-3.0);
            row[channel::ROTATION.start] = 1.0;
            row[channel::LOGIT_OPACITY] = logit;
            all.push(&row);
        }
        all
    }

    /// A photo along y, of an object that fills `of` of its columns.
    fn photo(of: std::ops::Range<u32>) -> View {
        let camera = Camera::look_at(DVec3::new(0.0, -1.5, 0.0), DVec3::ZERO, DVec3::Z, 0.9, 64, 64);
        let image = RgbaImage::from_fn(64, 64, |x, _| Rgba([200, 200, 200, if of.contains(&x) { 255 } else { 0 }]));
        View { name: "photo".into(), camera, image }
    }

    #[test]
    fn a_fit_is_added_where_photos_show_what_the_file_lacks() {
        let all = photo(0..64);
        let fit = at(&[[0.2, 0.0, 0.0], [0.22, 0.01, 0.0], [-0.2, 0.0, 0.0], [0.9, 0.0, 0.0]], 1.0);
        let own = at(&[[0.21, 0.0, 0.0]], 3.0);
        let more = completed(own.clone(), &fit, std::slice::from_ref(&all)).unwrap();
        assert_eq!(more.len(), 2);
        assert_eq!((more.mean(0), more.mean(1)), (own.mean(0), fit.mean(2)), "the file first; nothing far outside");
        let count = |own: &Gaussians, photos: &[View]| completed(own.clone(), &fit, photos).unwrap().len() - own.len();
        // What nobody sees fills nothing.
        assert_eq!(count(&at(&[[0.21, 0.0, 0.0]], -5.0), std::slice::from_ref(&all)), 3);
        // Only the object is completed, and only what a photo shows.
        assert_eq!(count(&own, &[photo(32..64)]), 0);
        assert_eq!(count(&own, &[photo(32..64), all]), 1);
        assert_eq!(count(&own, &[]), 0);
    }

    #[test]
    fn behind_what_the_file_shows_nothing_is_missing() {
        let wall: Vec<[f32; 3]> =
            (0..400).map(|i| [(i % 20) as f32 * 0.04 - 0.38, -0.3, (i / 20) as f32 * 0.04 - 0.38]).collect();
        let (own, fit) = (at(&wall, 5.0), at(&[[0.0, 0.2, 0.0]], 1.0));
        assert_eq!(completed(own, &fit, &[photo(0..64)]).unwrap().len(), 400);
    }
}
