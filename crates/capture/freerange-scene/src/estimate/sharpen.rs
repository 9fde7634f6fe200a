//! Outlines cut again on larger pictures, and what finding masks takes of memory.

use super::{
    INSIDE, KEPT, LARGE, Masks, OUTSIDE, SMALL, Stage,
    leave_one_out::OUTSIDE_HULL,
    mask::{enlarged, grown, shrunk, tidy},
    odds::{cut, odds},
    picture::Picture,
    plane,
    shown::Kept,
};
use crate::{SceneError, camera::image_ops::shrunk_size};
use rayon::prelude::*;

/// Pictures of the larger size that are whole at once, where there are many views.
const AT_ONCE: usize = 8;

/// Bytes that finding the masks of views of these sizes takes at most, beside the views themselves; `tests/reading.rs` measures it for few.
pub(crate) fn memory(sizes: &[(u32, u32)]) -> u64 {
    let pixels = |size: &(u32, u32), side| {
        let (w, h) = shrunk_size(*size, side);
        u64::from(w) * u64::from(h)
    };
    let sum = |side| sizes.iter().map(|size| pixels(size, side)).sum::<u64>();
    let largest = sizes.iter().map(|s| pixels(s, LARGE)).max().unwrap_or(0);
    let whole = largest * WHOLE_BYTES * sizes.len().min(AT_ONCE) as u64;
    let kept = match sizes.len() <= KEPT {
        true => sum(SMALL) * SMALL_BYTES + sum(LARGE) * LARGE_BYTES,
        false => {
            let (turns, others) = (sum(SMALL) * TURNS_BYTES, sum(SMALL) * REST_BYTES + sum(LARGE) * OTHERS_BYTES);
            turns.max(others) + largest * ASKED_BYTES
        }
    };
    kept + whole
}

/// Bytes per pixel: of a small picture with its masks and table, of a large one that others are compared with, of a whole large one.
const SMALL_BYTES: u64 = 96;
const LARGE_BYTES: u64 = 40;
const WHOLE_BYTES: u64 = 48;
/// Where there are more views than are kept whole. Per pixel of a small picture: while views take turns, and afterwards; of a large one: while it
/// is shown by the others; of all large ones together that are asked.
const TURNS_BYTES: u64 = 48;
const REST_BYTES: u64 = 8;
const OTHERS_BYTES: u64 = 13;
const ASKED_BYTES: u64 = 16 * 24;

/// Masks on larger pictures.
pub(super) struct Sharp {
    /// Of many views the cameras alone.
    pub pictures: Vec<Picture>,
    pub masks: Vec<Vec<bool>>,
}

impl Stage<'_> {
    /// Cuts the outlines again on larger pictures.
    pub(super) fn sharpen(&self, small: &Masks) -> Result<Sharp, SceneError> {
        let count = self.views.len();
        let many = count > AT_ONCE.min(self.kept);
        let large = |i: usize| Picture::of(&self.views[i], LARGE);
        let asked = plane::asked(count);
        let seen = |i: usize| match (many, asked[i]) {
            (false, _) => large(i),
            (true, true) => large(i).into_comparable(),
            (true, false) => Picture::unseen(&self.views[i], LARGE),
        };
        let pictures: Vec<Picture> = (0..count).into_par_iter().map(seen).collect();
        let background = |i: usize| match asked[i] {
            true => self.share(i, small, &pictures[i]).iter().map(|v| (1.0 - v).clamp(0.03, 1.0)).collect(),
            false => Vec::new(),
        };
        let background: Vec<Vec<f32>> = (0..count).into_par_iter().map(background).collect();
        let mut whole: Vec<Picture> = Vec::new();
        let masks = (0..count)
            .map(|i| {
                self.stop.check()?;
                if many && i % AT_ONCE == 0 {
                    whole.clear();
                    (i..count.min(i + AT_ONCE)).into_par_iter().map(large).collect_into_vec(&mut whole);
                }
                let picture = if many { &whole[i % AT_ONCE] } else { &pictures[i] };
                Ok(self.sharpened(i, small, picture, &pictures, &background))
            })
            .collect::<Result<_, SceneError>>()?;
        Ok(Sharp { pictures, masks })
    }

    /// The object's share of each pixel of a larger picture, as the small mask has it.
    fn share(&self, i: usize, small: &Masks, to: &Picture) -> Vec<f32> {
        let from = &self.pictures[i];
        let mask: Vec<f32> = small.masks[i].iter().map(|m| f32::from(u8::from(*m))).collect();
        enlarged(&mask, from.width(), from.height(), to.width(), to.height())
    }

    /// The mask of a view on its larger picture. `pictures`, `background`: see [`plane::table`].
    fn sharpened(
        &self,
        i: usize,
        small: &Masks,
        picture: &Picture,
        pictures: &[Picture],
        background: &[Vec<f32>],
    ) -> Vec<bool> {
        let (w, h) = (picture.width(), picture.height());
        let rough: Vec<bool> = self.share(i, small, picture).iter().map(|s| *s > 0.5).collect();
        let outer = grown(&rough, w, h, 8);
        let inner = shrunk(&rough, w, h, 8);
        let open = |k: usize| outer[k] && !inner[k];
        let table = self.plane.as_ref().map(|plane| {
            let (center, distance) = (self.center, self.distance);
            plane::table(pictures, background, i, picture, center, plane, distance, open, |_| false)
        });
        let shown = small.shown.get(i).map(Kept::shown);
        let odds = odds(picture, &small.object, &small.background, table.as_ref(), shown.as_ref(), open);
        let outline: Vec<f32> = small.outlines[i].iter().map(|m| f32::from(u8::from(*m))).collect();
        let from = &self.pictures[i];
        let outline = enlarged(&outline, from.width(), from.height(), w, h);
        let outline: Vec<bool> = outline.iter().map(|o| *o > 0.5).collect();
        let mut biased = odds.clone();
        for (k, o) in biased.iter_mut().enumerate() {
            *o += match &shown {
                Some(shown) => shown.odds(k) - if outline[k] { 0.0 } else { OUTSIDE_HULL },
                None if outline[k] => INSIDE,
                None => -OUTSIDE,
            };
        }
        let mask = cut(picture, &biased, Some((&inner, &outer)));
        tidy(&mask, &odds, Some(&outline), picture)
    }
}
