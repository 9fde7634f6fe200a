//! Masks refined with what the other views show: an initial fit of all the others says where the object is in a view, and in which color.

use super::mask::{enlarged, smooth};
use super::odds::odds;
use super::picture;
use super::shown::{Kept, Shown};
use super::{LARGE, Masks, Stage, cut_small};
use crate::SceneError;
use crate::camera::{View, image_ops::resize_area};
use freerange_util::Stop;
use image::RgbaImage;
use rayon::prelude::*;

/// Times that masks are refined, and the fewest views of which the others know enough for it.
pub(super) const ROUNDS: usize = 2;
pub(super) const LEAST_VIEWS: usize = 5;
/// Log odds against what lies outside of the hull, beside what the other views show.
pub(super) const OUTSIDE_HULL: f32 = 1.0;

/// Shows each view as all the others have it, by whatever makes a shape of views: straight color and alpha, in the order and size of the
/// views, whose alpha is the masks as they are so far. Or says why not. It need not keep the views until it is done.
/// It ends early, by an error, when it is stopped.
pub type LeaveOneOut = fn(Vec<View>, &Stop) -> Result<Vec<RgbaImage>, String>;

impl Stage<'_> {
    /// Each view as the others have it, on a larger picture.
    pub(super) fn shown_by_others(&self, last: &Masks, show: LeaveOneOut) -> Result<Vec<RgbaImage>, String> {
        let cut_out = |i: usize| {
            let (picture, mut view) = (&self.pictures[i], picture::shrunk(&self.views[i], LARGE));
            let (w, h) = (view.camera.width as usize, view.camera.height as usize);
            let mask = smooth(&last.masks[i], picture.width(), picture.height());
            let alpha = enlarged(&mask, picture.width(), picture.height(), w, h);
            view.image.pixels_mut().zip(alpha).for_each(|(p, a)| p[3] = (255.0 * a).round() as u8);
            view
        };
        let cut_out: Vec<View> = (0..self.views.len()).into_par_iter().map(cut_out).collect();
        let sizes: Vec<(u32, u32)> = cut_out.iter().map(|view| view.image.dimensions()).collect();
        let shown = show(cut_out, &self.stop)?;
        match shown.iter().map(RgbaImage::dimensions).eq(sizes.iter().copied()) {
            true => Ok(shown),
            false => Err(format!("expected {} images of the views' sizes, found others", sizes.len())),
        }
    }

    /// Cuts all views once more, with what the other views show of each.
    pub(super) fn refine(&self, mut last: Masks, shown: Vec<RgbaImage>) -> Result<Masks, SceneError> {
        // What they showed the last time is not needed any more.
        last.shown = Vec::new();
        let mut shown: Vec<Kept> = shown.into_iter().map(|image| Kept::of(&image)).collect();
        let background = self.background(&last.masks);
        let tables = self.tables(&background)?;
        let (object, behind) = self.colors(&tables, Some(&last))?;
        let cut: Vec<(Vec<bool>, f32)> = (0..shown.len())
            .into_par_iter()
            .map(|i| {
                self.stop.check()?;
                let picture = self.picture(i);
                let small = resize_area(&shown[i].image(), picture.camera.width, picture.camera.height);
                let mut small = Shown::of(&small, 0.0);
                let sure = (0..small.alpha.len()).filter(|k| small.alpha[*k] > 0.9 && last.masks[i][*k]);
                let mut off: Vec<f32> = sure.map(|k| picture.smooth[k].distance(small.color[k])).collect();
                off.sort_by(f32::total_cmp);
                // Where they show nothing, any color may be expected.
                small.scale = 2.0 + 1.5 * off.get(off.len() / 2).copied().unwrap_or(20.0);
                let odds = odds(&picture, &object, &behind, tables[i].as_ref(), Some(&small), |_| true);
                let outline = &last.outlines[i];
                let outside = |k: usize| if outline[k] { 0.0 } else { OUTSIDE_HULL };
                let biased = |k: usize| odds[k] + small.odds(k) - outside(k);
                Ok((cut_small(&picture, &self.nearness(i), &odds, Some(&outline[..]), biased), small.scale))
            })
            .collect::<Result<_, SceneError>>()?;
        let (masks, scales): (Vec<Vec<bool>>, Vec<f32>) = cut.into_iter().unzip();
        shown.iter_mut().zip(scales).for_each(|(shown, scale)| shown.scale = scale);
        let outlines = self.outlines(&masks).ok_or_else(|| SceneError::NotCutOut {
            reason: "no point of space lies within all masks once they are corrected by the other views".into(),
        })?;
        Ok(Masks { masks, clearness: last.clearness, object, background: behind, outlines, shown })
    }
}
