//! The colors of the object and of what is around it, common to all views.

use super::mixture::Mixture;
use super::plane::Table;
use super::{Masks, Stage};
use crate::SceneError;
use glam::Vec3;
use rayon::prelude::*;

/// Components of the mixtures.
const OBJECT: usize = 5;
const BACKGROUND: usize = 8;
/// Before there are masks, colors that are certainly the object's stand for all of it if they are this share of what lies about where the
/// cameras look. A handle that stands out is less: what it belongs to may lie flat on the table.
const SURE: f64 = 0.02;
/// How many colors of what is around the object, and of the table beneath it, are looked at, about.
const AROUND: usize = 4000;
const BENEATH: usize = 3000;

/// Pixels that are taken for the same.
#[derive(Clone, Copy)]
enum Kind {
    Object,
    /// Those of the object that do not look like the table.
    Sure,
    Around,
}

/// What pixels are taken for: tables, and masks if there are some.
#[derive(Clone, Copy)]
struct Known<'a> {
    tables: &'a [Option<Table>],
    last: Option<&'a Masks>,
}

/// How far apart those are that are taken of `count` colors in order, so that there are about `wanted`.
fn every(count: usize, wanted: usize) -> usize {
    (count / wanted).max(1)
}

impl Stage<'_> {
    /// Colors of the object and of the rest, from the last masks or from where the cameras look. Some thousand of them, of millions that
    /// are only counted.
    pub(super) fn colors(
        &self,
        tables: &[Option<Table>],
        last: Option<&Masks>,
    ) -> Result<(Mixture, Mixture), SceneError> {
        let known = Known { tables, last };
        // Of each view.
        let count = |kind| -> Vec<usize> {
            (0..self.pictures.len()).into_par_iter().map(|i| self.pixels(kind, i, known).len()).collect()
        };
        let [object, sure, around] = [Kind::Object, Kind::Sure, Kind::Around].map(count);
        let sum = |counts: &[usize]| counts.iter().sum::<usize>();
        let enough = if last.is_some() { 0.3 } else { SURE };
        let (kind, counts) = match sum(&sure) as f64 >= enough * sum(&object) as f64 {
            true => (Kind::Sure, sure),
            false => (Kind::Object, object),
        };
        let which: Vec<usize> = (0..sum(&around)).step_by(every(sum(&around), AROUND)).collect();
        let mut behind = self.colors_of(Kind::Around, &around, &which, known);
        // The table about the object counts as much as all else: its shadows are what objects are mistaken for.
        let beneath = || tables.iter().flatten().flat_map(|table| &table.beneath);
        behind.extend(beneath().step_by(every(beneath().count(), BENEATH)).copied());
        let own = |which: &[usize]| self.colors_of(kind, &counts, which, known);
        match (Mixture::fit_some(sum(&counts), own, OBJECT, 0), Mixture::fit(&behind, BACKGROUND, 1)) {
            (Some(object), Some(behind)) => Ok((object, behind)),
            (None, _) => Err(SceneError::NotCutOut { reason: "nothing differs from what is around the object".into() }),
            (_, None) => Err(SceneError::NotCutOut {
                reason: "the object fills the photos: nothing shows the background".into(),
            }),
        }
    }

    /// The pixels of a view that are of a kind, in order.
    fn pixels(&self, kind: Kind, i: usize, known: Known<'_>) -> Vec<usize> {
        let valid = &self.pictures[i].valid;
        let near = known.last.is_none().then(|| self.nearness(i));
        let inside = |k: usize| match (known.last, &near) {
            (Some(last), _) => last.masks[i][k],
            (None, Some(near)) => near[k] < 0.55,
            (None, None) => false,
        };
        let outside = |k: usize| match &near {
            Some(near) => near[k] > 0.95,
            None => !inside(k),
        };
        // Not what the table looks like there: no shadow, whatever its color.
        let least = if known.last.is_some() { 2.0 } else { 4.0 };
        let table = known.tables[i].as_ref();
        let apart = |k: usize| table.is_some_and(|t| t.trust[k] > 0.3 && t.off[k] > least * t.scale[k]);
        let is = |k: &usize| match kind {
            Kind::Object => inside(*k),
            Kind::Sure => inside(*k) && apart(*k),
            Kind::Around => outside(*k),
        };
        (0..valid.len()).filter(|k| valid[*k] && is(k)).collect()
    }

    /// The colors of all pixels of a kind that have these numbers. `counts`: how many there are in each view.
    fn colors_of(&self, kind: Kind, counts: &[usize], numbers: &[usize], known: Known<'_>) -> Vec<Vec3> {
        let mut order: Vec<(usize, usize)> = numbers.iter().copied().zip(0..).collect();
        order.sort_unstable();
        let (mut parts, mut rest, mut end) = (Vec::new(), &order[..], 0usize);
        for (i, count) in counts.iter().enumerate() {
            let start = end;
            end += count;
            let (own, later) = rest.split_at(rest.partition_point(|(number, _)| *number < end));
            rest = later;
            if !own.is_empty() {
                parts.push((i, start, own));
            }
        }
        let found: Vec<Vec<(usize, Vec3)>> = parts
            .into_par_iter()
            .map(|(i, start, own)| {
                let (picture, pixels) = (self.picture(i), self.pixels(kind, i, known));
                own.iter().map(|(number, place)| (*place, picture.lab[pixels[number - start]])).collect()
            })
            .collect();
        let mut colors = vec![Vec3::ZERO; numbers.len()];
        found.into_iter().flatten().for_each(|(place, color)| colors[place] = color);
        colors
    }
}
