//! Rims of nothing that undistorting leaves around photos, told from outlines of the object.
//!
//! A rim belongs to a lens: photos of one lens have the same one, turned where a photo is on its side. Outlines differ
//! from photo to photo, and fill few of them. So what fills most photos is a rim where photos share it; else it is
//! taken for the outline, with a warning.

use super::{LoadConfig, MaskSource, picture::Picture};
use crate::camera::scene::{fills_frame, find_backdrop, within_black};
use freerange_util::Note;
use rayon::prelude::*;

/// What a rim of nothing leaves of a photo at least.
const RIM_FILL: f64 = 0.6;
/// Shapes are compared at so many points along each axis; an odd number, which turns onto itself.
const GRID: usize = 127;
/// Shapes that differ at no more points than one of so many are the same.
const SAME: usize = 500;

/// What a photo may have around what it shows.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Around {
    /// Transparent pixels.
    Clear,
    /// Opaque black pixels.
    Black,
}

impl Around {
    /// How notes call it, and the option that says that it lies around the object.
    fn words(self) -> (&'static str, &'static str) {
        match self {
            Self::Clear => ("transparent", " (--masks alpha if it is)"),
            Self::Black => ("black", " (--masks plain if it is)"),
        }
    }
}

/// What a photo shows, at a few points.
struct Shape {
    size: (u32, u32),
    shown: Vec<bool>,
}

impl Shape {
    fn of(shown: &[bool], size: (u32, u32)) -> Self {
        let (w, h) = (size.0 as usize, size.1 as usize);
        let at = |i: usize, side: usize| (2 * i + 1) * side / (2 * GRID);
        let shown = (0..GRID * GRID).map(|k| shown[at(k / GRID, h) * w + at(k % GRID, w)]).collect();
        Self { size, shown }
    }

    /// Whether both are the rim of one lens, turned by any number of right angles.
    fn is_same(&self, other: &Self) -> bool {
        let (w, h) = self.size;
        let differ = |turned: &dyn Fn(usize, usize) -> (usize, usize)| {
            let mut off = (0..GRID * GRID).filter(|k| {
                let (x, y) = turned(k % GRID, k / GRID);
                self.shown[*k] != other.shown[y * GRID + x]
            });
            off.nth(GRID * GRID / SAME).is_some()
        };
        let last = GRID - 1;
        other.size == (w, h) && !(differ(&|x, y| (x, y)) && differ(&|x, y| (last - x, last - y)))
            || other.size == (h, w) && !(differ(&|x, y| (y, last - x)) && differ(&|x, y| (last - y, x)))
    }
}

/// A photo with something around what it shows.
struct Candidate {
    /// Which one.
    photo: usize,
    /// What it shows, where that fills it.
    shape: Option<Shape>,
    /// Whether that is the object before a plain backdrop.
    backdrop: bool,
}

/// Rims that were found, to know them again.
#[derive(Default)]
pub(super) struct Rims(Vec<Shape>);

impl Rims {
    /// Takes rims for what the lens did not show: their pixels are empty, and tell nothing of the object. `names`: of
    /// the photos; `what`: what notes call them.
    pub fn take_away(
        &mut self,
        pictures: &mut [Picture],
        names: &[&str],
        what: &str,
        config: &LoadConfig,
        notes: &mut Vec<Note>,
    ) {
        if config.masks == MaskSource::Auto {
            self.of_kind(Around::Clear, pictures, names, what, notes);
            self.of_kind(Around::Black, pictures, names, what, notes);
        }
    }

    fn of_kind(&mut self, around: Around, pictures: &mut [Picture], names: &[&str], what: &str, notes: &mut Vec<Note>) {
        let candidates: Vec<Candidate> =
            pictures.par_iter().enumerate().filter_map(|(photo, p)| candidate(photo, p, around)).collect();
        let filled: Vec<(&Candidate, &Shape)> =
            candidates.iter().filter_map(|c| Some((c, c.shape.as_ref()?))).collect();
        if 2 * filled.len() <= candidates.len() {
            return;
        }
        let shared = |(c, shape): &&(&Candidate, &Shape)| {
            let others = filled.iter().filter(|(other, _)| other.photo != c.photo).map(|(_, s)| *s);
            others.chain(&self.0).any(|other| other.is_same(shape))
        };
        let of_lenses = 2 * filled.par_iter().filter(shared).count() >= filled.len();
        let (rims, outlines): (Vec<&Candidate>, Vec<&Candidate>) =
            filled.iter().map(|(c, _)| *c).partition(|c| of_lenses || c.backdrop);
        let (color, option) = around.words();
        let named = |list: &[&Candidate]| format!("{} {what} ({})", list.len(), names[list[0].photo]);
        if !rims.is_empty() {
            notes.push(Note::assumed(format!(
                "the {color} rim of {} is what undistorting them left, not the object's outline{option}",
                named(&rims)
            )));
        }
        if !outlines.is_empty() {
            notes.push(Note::warning(format!(
                "what is not {color} reaches all sides of {}: it is taken for the object (--masks estimate if the \
                 {color} rim is what undistorting left)",
                named(&outlines)
            )));
        }
        let rims: Vec<usize> = rims.iter().map(|c| c.photo).collect();
        for candidate in candidates.into_iter().filter(|c| rims.contains(&c.photo)) {
            empty(&mut pictures[candidate.photo], around);
            self.0.extend(candidate.shape);
        }
    }
}

/// What of a photo may be within a rim of this kind; none where it has none, or where a mask says what is the object.
fn candidate(photo: usize, picture: &Picture, around: Around) -> Option<Candidate> {
    let image = &picture.image;
    let shown = match around {
        _ if picture.mask.is_some() => return None,
        Around::Clear if picture.alpha => image.pixels().map(|p| p[3] >= 128).collect(),
        Around::Black if !picture.alpha => within_black(image)?,
        _ => return None,
    };
    let (w, h) = image.dimensions();
    let shape = fills_frame(&shown, w, h, RIM_FILL).then(|| Shape::of(&shown, (w, h)));
    let backdrop = around == Around::Clear && shape.is_some() && find_backdrop(image).is_ok();
    Some(Candidate { photo, shape, backdrop })
}

/// A photo without its rim.
fn empty(picture: &mut Picture, around: Around) {
    picture.alpha = false;
    if around == Around::Black
        && let Some(shown) = within_black(&picture.image)
    {
        picture.image.pixels_mut().zip(shown).filter(|(_, shown)| !shown).for_each(|(p, _)| p.0 = [0; 4]);
    }
}
