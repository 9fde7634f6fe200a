//! Masks that were found in each photo by itself, held against each other: what stands beside the object is seldom marked in all of them.

use super::hull::Hull;
use super::mask::grown;
use super::picture::Picture;
use super::place::{expected_radius, meeting_point};
use super::{FINE, Hints, SMALL};
use crate::camera::View;
use image::GrayImage;
use rayon::prelude::*;

/// One view in this many may miss a part of the object, but one in any case.
const MISSING: usize = 4;
/// How far the outlines of hulls, which are made of cubes and of rounded masks, may lie within the object's, in pixels of small pictures.
const MARGIN: usize = 3;
/// Where less of a mask than this is confirmed, it is left as it is: then the others are wrong, or its pose.
const LEAST: f64 = 0.5;

/// For each view (`views`: the object cut out, as far as its own photo tells) what of its mask the others confirm: 255 where they do, 0 where
/// they do not, `[h, w]`; None for views whose masks are left as they are. None of all where there are fewer than three views, or
/// where the masks have no point of space in common.
pub fn confirmed(views: &[View], hints: &Hints) -> Option<Vec<Option<Vec<u8>>>> {
    if views.len() < 3 {
        return None;
    }
    let pictures: Vec<Picture> = views.par_iter().map(|v| Picture::outlined(v, SMALL)).collect();
    let masks: Vec<Vec<bool>> = pictures.iter().map(|p| p.valid.clone()).collect();
    let center = hints.center.or_else(|| meeting_point(views))?;
    let radius = expected_radius(&pictures, center, hints)?;
    let hull = Hull::carve(&pictures, &masks, center, 1.3 * radius, None, (views.len() / MISSING).max(1), FINE)?;
    let keep = views.par_iter().zip(&pictures).zip(&masks).map(|((view, picture), mask)| {
        let (w, h) = (picture.width(), picture.height());
        let there = grown(&hull.outline(picture), w, h, MARGIN);
        let count = |f: &dyn Fn(usize) -> bool| (0..mask.len()).filter(|k| mask[*k] && f(*k)).count();
        let (all, kept) = (count(&|_| true), count(&|k| there[k]));
        (kept < all && kept as f64 >= LEAST * all as f64).then(|| {
            let small = GrayImage::from_fn(w as u32, h as u32, |x, y| {
                image::Luma([255 * u8::from(there[y as usize * w + x as usize])])
            });
            let (w, h) = view.image.dimensions();
            image::imageops::resize(&small, w, h, image::imageops::FilterType::Nearest).into_raw()
        })
    });
    Some(keep.collect())
}
