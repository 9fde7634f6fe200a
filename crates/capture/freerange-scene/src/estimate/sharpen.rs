//! Outlines cut again on larger pictures, and what finding masks takes of memory.

use super::{
    INSIDE, LARGE, Masks, OUTSIDE, SMALL, Stage,
    leave_one_out::OUTSIDE_HULL,
    mask::{enlarged, grown, shrunk, tidy},
    odds::{cut, odds},
    picture::Picture,
    plane,
};
use crate::{
    SceneError,
    camera::{View, image_ops::shrunk_size},
};
use rayon::prelude::*;

/// Pictures of the larger size that are whole at once, where there are many views.
const AT_ONCE: usize = 8;

/// Bytes that finding the masks of views of these sizes takes at most, beside the views themselves; `tests/reading.rs` measures it.
pub(crate) fn memory(sizes: &[(u32, u32)]) -> u64 {
    let pixels = |size: &(u32, u32), side| {
        let (w, h) = shrunk_size(*size, side);
        u64::from(w) * u64::from(h)
    };
    let all = sizes.iter().map(|s| pixels(s, SMALL) * SMALL_BYTES + pixels(s, LARGE) * LARGE_BYTES).sum::<u64>();
    let largest = sizes.iter().map(|s| pixels(s, LARGE)).max().unwrap_or(0);
    all + largest * WHOLE_BYTES * sizes.len().min(AT_ONCE) as u64
}

/// Bytes per pixel: of a small picture with its masks and table, of a large one that others are compared with, of a whole large one.
const SMALL_BYTES: u64 = 96;
const LARGE_BYTES: u64 = 40;
const WHOLE_BYTES: u64 = 48;

/// Masks on larger pictures.
pub(super) struct Sharp {
    pub pictures: Vec<Picture>,
    pub masks: Vec<Vec<bool>>,
}

impl Stage {
    /// Cuts the outlines again on larger pictures.
    pub(super) fn sharpen(&self, views: &[View], small: &Masks) -> Result<Sharp, SceneError> {
        let many = views.len() > AT_ONCE;
        let large = |i: usize| Picture::of(&views[i], LARGE);
        let seen = |i| if many { large(i).into_comparable() } else { large(i) };
        let pictures: Vec<Picture> = (0..views.len()).into_par_iter().map(seen).collect();
        let shares: Vec<Vec<f32>> = (0..views.len())
            .map(|i| {
                let (from, to) = (&self.pictures[i], &pictures[i]);
                let mask: Vec<f32> = small.masks[i].iter().map(|m| f32::from(u8::from(*m))).collect();
                enlarged(&mask, from.width(), from.height(), to.width(), to.height())
            })
            .collect();
        let background: Vec<Vec<f32>> =
            shares.iter().map(|s| s.iter().map(|v| (1.0 - v).clamp(0.03, 1.0)).collect()).collect();
        let mut whole: Vec<Picture> = Vec::new();
        let masks = (0..views.len())
            .map(|i| {
                self.stop.check()?;
                if many && i % AT_ONCE == 0 {
                    whole.clear();
                    (i..views.len().min(i + AT_ONCE)).into_par_iter().map(large).collect_into_vec(&mut whole);
                }
                let picture = if many { &whole[i % AT_ONCE] } else { &pictures[i] };
                let (w, h) = (picture.width(), picture.height());
                let rough: Vec<bool> = shares[i].iter().map(|s| *s > 0.5).collect();
                let outer = grown(&rough, w, h, 8);
                let inner = shrunk(&rough, w, h, 8);
                let open = |k: usize| outer[k] && !inner[k];
                let table = self
                    .plane
                    .as_ref()
                    .map(|plane| plane::table(&pictures, &background, i, self.center, plane, self.distance, open));
                let shown = small.shown.get(i).map(|[_, large]| large);
                let odds = odds(picture, &small.object, &small.background, table.as_ref(), shown, open);
                let outline: Vec<f32> = small.outlines[i].iter().map(|m| f32::from(u8::from(*m))).collect();
                let from = &self.pictures[i];
                let outline = enlarged(&outline, from.width(), from.height(), w, h);
                let outline: Vec<bool> = outline.iter().map(|o| *o > 0.5).collect();
                let mut biased = odds.clone();
                for (k, o) in biased.iter_mut().enumerate() {
                    *o += match shown {
                        Some(shown) => shown.odds(k) - if outline[k] { 0.0 } else { OUTSIDE_HULL },
                        None if outline[k] => INSIDE,
                        None => -OUTSIDE,
                    };
                }
                let mask = cut(picture, &biased, Some((&inner, &outer)));
                Ok(tidy(&mask, &odds, Some(&outline), picture))
            })
            .collect::<Result<_, SceneError>>()?;
        Ok(Sharp { pictures, masks })
    }
}
