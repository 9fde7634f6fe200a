//! Masks refined with what the other views show: an initial fit of all the others says where the object is in a view, and in which color.

use super::mask::{enlarged, smooth};
use super::odds::odds;
use super::picture;
use super::shown::Shown;
use super::{LARGE, Masks, Stage};
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
/// views, whose alpha is the masks as they are so far. Or says why not.
/// It ends early, by an error, when it is stopped.
pub type LeaveOneOut = fn(&[View], &Stop) -> Result<Vec<RgbaImage>, String>;

impl Stage {
    /// Each view as the others have it, on a larger picture.
    pub(super) fn shown_by_others(
        &self,
        views: &[View],
        last: &Masks,
        show: LeaveOneOut,
    ) -> Result<Vec<RgbaImage>, String> {
        let cut_out: Vec<View> = (0..views.len())
            .map(|i| {
                let (picture, mut view) = (&self.pictures[i], picture::shrunk(&views[i], LARGE));
                let (w, h) = (view.camera.width as usize, view.camera.height as usize);
                let mask = smooth(&last.masks[i], picture.width(), picture.height());
                let alpha = enlarged(&mask, picture.width(), picture.height(), w, h);
                view.image.pixels_mut().zip(alpha).for_each(|(p, a)| p[3] = (255.0 * a).round() as u8);
                view
            })
            .collect();
        let shown = show(&cut_out, &self.stop)?;
        let fits = |(image, view): (&RgbaImage, &View)| image.dimensions() == view.image.dimensions();
        match shown.len() == views.len() && shown.iter().zip(&cut_out).all(fits) {
            true => Ok(shown),
            false => Err(format!("expected {} images of the views' sizes, found others", views.len())),
        }
    }

    /// Cuts all views once more, with what the other views show of each.
    pub(super) fn refine(&self, last: &Masks, shown: Vec<RgbaImage>) -> Result<Masks, SceneError> {
        let count = self.pictures.len();
        let near: Vec<Vec<f32>> = (0..count).map(|i| self.nearness(i)).collect();
        let background = self.background(&last.masks);
        let tables = self.tables(&background)?;
        let (object, behind) = self.colors(&near, &tables, Some(last))?;
        let shown: Vec<[Shown; 2]> = (0..count)
            .map(|i| {
                let picture = &self.pictures[i];
                let small = resize_area(&shown[i], picture.camera.width, picture.camera.height);
                let mut small = Shown::of(&small, 0.0);
                let sure = (0..small.alpha.len()).filter(|k| small.alpha[*k] > 0.9 && last.masks[i][*k]);
                let mut off: Vec<f32> = sure.map(|k| picture.smooth[k].distance(small.color[k])).collect();
                off.sort_by(f32::total_cmp);
                // Where they show nothing, any color may be expected.
                small.scale = 2.0 + 1.5 * off.get(off.len() / 2).copied().unwrap_or(20.0);
                let large = Shown::of(&shown[i], small.scale);
                [small, large]
            })
            .collect();
        let masks: Vec<Vec<bool>> = (0..count)
            .into_par_iter()
            .map(|i| {
                self.stop.check()?;
                let [shown, _] = &shown[i];
                let odds = odds(&self.pictures[i], &object, &behind, tables[i].as_ref(), Some(shown), |_| true);
                let outside = |k: usize| if last.outlines[i][k] { 0.0 } else { OUTSIDE_HULL };
                Ok(self.cut(i, &near[i], &odds, Some(&last.outlines[i]), |k| odds[k] + shown.odds(k) - outside(k)))
            })
            .collect::<Result<_, SceneError>>()?;
        let outlines = self.outlines(&masks).ok_or_else(|| SceneError::NotCutOut {
            reason: "no point of space lies within all masks once they are corrected by the other views".into(),
        })?;
        Ok(Masks { masks, clearness: last.clearness.clone(), object, background: behind, outlines, shown })
    }
}
