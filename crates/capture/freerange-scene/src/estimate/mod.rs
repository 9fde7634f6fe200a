//! Masks from poses and colors alone.
//!
//! What is used, in short: the cameras look at the object, so that their axes meet in it (Campbell et al. 2010); what lies at the borders
//! of the photos is not the object; objects stand on something flat, whose look is known from the views that see past the object
//! (`plane`); colors of object and background are mixtures of Gaussians, common to all views, and each view is cut at least cost
//! (GrabCut, Rother et al. 2004); what no other view confirms is not the object (`hull`). These take turns until nothing changes. Then,
//! where there is something that makes Gaussians of views ([`LeaveOneOut`]), each mask is refined with what all the others make of its view:
//! print in the table's color, a foot in its own shadow, the opening of a handle. Work is done on small pictures, and only the outline is
//! cut again on larger ones.

mod colors;
mod confirm;
mod evidence;
mod hull;
mod leave_one_out;
mod mask;
mod maxflow;
mod mixture;
mod odds;
mod picture;
mod place;
mod plane;
mod sharpen;
mod shown;

pub use confirm::confirmed;
pub use evidence::{Compared, Evidence};
pub use hull::overlap;
pub use leave_one_out::LeaveOneOut;
pub(crate) use sharpen::memory;

use crate::SceneError;
use crate::camera::View;
use freerange_util::Stop;
use glam::DVec3;
use hull::{Floor, Hull, reaches_border};
use image::RgbaImage;
use leave_one_out::{LEAST_VIEWS, ROUNDS};
use mask::{grown, smooth, soft, tidy};
use mixture::Mixture;
use odds::{cut, odds};
use picture::Picture;
use place::{expected_radius, mean_up, meeting_point, nearness};
use plane::{Plane, Table};
use rayon::prelude::*;
use shown::Kept;
use std::borrow::Cow;

/// Longer side of the pictures that take turns, and of those that the outline is cut on.
pub(crate) const SMALL: u32 = 320;
const LARGE: u32 = 640;
/// What can be made again of a view is kept of up to so many; 300 photos would take gigabytes.
const KEPT: usize = 32;
/// Turns, at most.
const TURNS: usize = 10;
/// Turns end when masks change by less than this share.
const SETTLED: f64 = 0.002;
/// Log odds against what lies outside of the other views' hull.
const OUTSIDE: f32 = 5.0;
/// Log odds for what lies within it.
const INSIDE: f32 = 1.0;
/// How far from where the cameras look, in radii of the sphere about it, the table is not believed before there are masks, and from where it
/// is. Less, and the foot of what has one color is taken for a print on the table, on which all views agree.
const UNSEEN: f32 = 0.7;
const SEEN: f32 = 0.95;
/// Voxels along the hull's longest side: while masks change, and to judge them.
const ROUGH: usize = 56;
const FINE: usize = 120;

/// What is known beforehand.
#[derive(Clone, Copy, Debug, Default)]
pub struct Hints {
    /// What masks are refined with; none: they are not.
    pub others: Option<LeaveOneOut>,
    /// The object's middle, in the world.
    pub center: Option<DVec3>,
    /// The radius of a sphere about it that holds the object.
    pub radius: Option<f64>,
}

/// Masks that were found, and how far to rely on them.
#[derive(Clone, Debug)]
pub struct Estimate {
    /// The object's share of each pixel, for every view at its image's own size, `[h, w]`. None once they are the views' alpha.
    pub alpha: Vec<Vec<u8>>,
    /// For every view: how far its mask agrees with the hull of all masks (intersection over union).
    pub agreement: Vec<f64>,
    /// For every view: the share of pixels about the object whose own color speaks for the side that they were put on.
    pub clearness: Vec<f64>,
    /// The direction in which the plane that the object stands on faces, where one was found.
    pub up: Option<DVec3>,
    /// What speaks for the poses.
    pub evidence: Evidence,
    /// What was found, for the user to read.
    pub notes: Vec<String>,
}

impl Estimate {
    /// How sure it is, 0 to 1: the least of mean agreement and mean clearness.
    pub fn sureness(&self) -> f64 {
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len().max(1) as f64;
        mean(&self.agreement).min(mean(&self.clearness))
    }

    /// Why these masks should not be used, if views and poses do not belong together.
    fn contradiction(&self, views: &[View]) -> Option<String> {
        let mean = self.agreement.iter().sum::<f64>() / self.agreement.len() as f64;
        let found = if mean < LEAST_AGREEMENT {
            format!("masks and their common hull agree to {:.0} %", 100.0 * mean)
        } else {
            self.evidence.against()?
        };
        let worst = (0..views.len()).min_by(|a, b| self.agreement[*a].total_cmp(&self.agreement[*b])).unwrap_or(0);
        Some(format!(
            "the views contradict each other ({found}; {} agrees least): the poses may be wrong or belong to other photos, or the object \
             moved, or it looks like the background",
            views[worst].name
        ))
    }
}

/// Mean agreement below which views are taken to contradict each other.
const LEAST_AGREEMENT: f64 = 0.7;

/// Finds the object's masks. The views' own alpha only says what they show (corners of undistorted photos are empty).
pub fn masks(views: &[View], hints: &Hints) -> Result<Estimate, SceneError> {
    masks_until(views, hints, &Stop::default())
}

/// [`masks`], unless it is stopped.
pub(crate) fn masks_until(views: &[View], hints: &Hints, stop: &Stop) -> Result<Estimate, SceneError> {
    let found = search(views, hints, stop, KEPT)?;
    match found.contradiction(views) {
        Some(reason) => Err(SceneError::NotCutOut { reason }),
        None => Ok(found),
    }
}

/// [`masks`] also where the views contradict each other. For tests.
#[doc(hidden)]
pub fn unjudged(views: &[View], hints: &Hints) -> Result<Estimate, SceneError> {
    search(views, hints, &Stop::default(), KEPT)
}

/// [`unjudged`] for views of which no more than `kept` are kept whole. For tests.
#[doc(hidden)]
pub fn unjudged_keeping(kept: usize, views: &[View], hints: &Hints) -> Result<Estimate, SceneError> {
    search(views, hints, &Stop::default(), kept)
}

fn search(views: &[View], hints: &Hints, stop: &Stop, kept: usize) -> Result<Estimate, SceneError> {
    let refuse = |reason: String| Err(SceneError::NotCutOut { reason });
    if views.len() < 3 {
        return refuse(format!("expected at least 3 views, found {}", views.len()));
    }
    let mut stage = Stage::new(views, hints, stop, kept)?;
    let mut notes = Vec::new();
    match &stage.plane {
        Some(plane) => notes.push(format!(
            "the object stands on a plane that faces ({:.3}, {:.3}, {:.3})",
            plane.normal.x, plane.normal.y, plane.normal.z
        )),
        None => notes.push("no plane beneath the object stands out: masks rest on colors and silhouettes alone".into()),
    }
    let mut small = stage.take_turns()?;
    // Poses are judged by what photos say themselves.
    let evidence = stage.evidence(&small);
    stage.forget();
    if let Some(others) = hints.others.filter(|_| views.len() >= LEAST_VIEWS) {
        for _ in 0..ROUNDS {
            stop.check()?;
            match stage.shown_by_others(&small, others) {
                Ok(shown) => small = stage.refine(small, shown)?,
                Err(reason) => {
                    stop.check()?;
                    notes.push(format!("masks are not corrected by the other views: {reason}"));
                    break;
                }
            }
        }
    }
    let large = stage.sharpen(&small)?;
    let clearness = std::mem::take(&mut small.clearness);
    drop(small);
    stop.check()?;
    let hull = Hull::carve(&large.pictures, &large.masks, stage.center, 1.3 * stage.radius, stage.floor(), 0, FINE);
    let agreement: Vec<f64> = match &hull {
        Some(hull) => large.pictures.iter().zip(&large.masks).map(|(p, m)| overlap(&hull.outline(p), m)).collect(),
        None => vec![0.0; views.len()],
    };
    for (view, mask) in views.iter().zip(&large.masks) {
        let share = mask.iter().filter(|m| **m).count() as f64 / mask.len() as f64;
        if share < 1e-3 {
            return refuse(format!("nothing in {} differs from what is around the object", view.name));
        }
    }
    let alpha = views
        .iter()
        .zip(large.pictures.iter().zip(&large.masks))
        .map(|(view, (picture, mask))| soft(mask, picture, view.image.dimensions()))
        .collect();
    let up = stage.plane.as_ref().map(|p| p.normal);
    Ok(Estimate { alpha, agreement, clearness, up, evidence, notes })
}

/// The scene as far as it does not change while masks are looked for.
struct Stage<'a> {
    views: &'a [View],
    /// Of how many views everything is kept.
    kept: usize,
    /// Small ones: whole, or of more views than are kept what others are compared with.
    pictures: Vec<Picture>,
    /// See [`Self::nearness`]; none of more views than are kept.
    near: Vec<Vec<f32>>,
    /// Where the cameras look, and the sphere about it that the object is expected in.
    center: DVec3,
    radius: f64,
    /// Mean distance of the cameras.
    distance: f64,
    plane: Option<Plane>,
    /// The plane on which the views agree best, whether it stands out or not.
    best: Option<Plane>,
    stop: Stop,
}

/// Masks in the making.
struct Masks {
    /// `[h, w]` for each view.
    masks: Vec<Vec<bool>>,
    clearness: Vec<f64>,
    object: Mixture,
    background: Mixture,
    /// The hull's outlines, `[h, w]`.
    outlines: Vec<Vec<bool>>,
    /// What the other views show of each; empty before masks are refined.
    shown: Vec<Kept>,
}

impl<'a> Stage<'a> {
    fn new(views: &'a [View], hints: &Hints, stop: &Stop, kept: usize) -> Result<Self, SceneError> {
        let all = views.len() <= kept;
        let picture = |view: &View| match Picture::of(view, SMALL) {
            picture if all => picture,
            picture => picture.into_comparable(),
        };
        let pictures: Vec<Picture> = views.par_iter().map(picture).collect();
        let Some(center) = hints.center.or_else(|| meeting_point(views)) else {
            let reason = "the cameras do not look at one common point; if the poses are right, say where the object is (--center X,Y,Z)";
            return Err(SceneError::NotCutOut { reason: reason.into() });
        };
        let distance = views.iter().map(|v| v.camera.center().distance(center)).sum::<f64>() / views.len() as f64;
        let Some(radius) = expected_radius(&pictures, center, hints) else {
            let reason =
                "the point that the cameras look at is not in the photos; say where the object is (--center X,Y,Z)";
            return Err(SceneError::NotCutOut { reason: reason.into() });
        };
        let near = pictures.iter().filter(|_| all).map(|p| nearness(p, center, radius)).collect();
        let (plane, best, stop) = (None, None, stop.clone());
        let mut stage = Self { views, kept, pictures, near, center, radius, distance, plane, best, stop };
        let object: Vec<Vec<bool>> =
            (0..views.len()).map(|i| stage.nearness(i).iter().map(|d| *d < 0.6).collect()).collect();
        let found = plane::find(&stage.pictures, &object, center, mean_up(views), distance, &stage.stop);
        stage.stop.check()?;
        stage.plane = found.filter(|(_, stands_out)| *stands_out).map(|(plane, _)| plane);
        stage.best = found.map(|(plane, _)| plane);
        Ok(stage)
    }

    /// The whole small picture of view `i`.
    fn picture(&self, i: usize) -> Cow<'_, Picture> {
        match self.views.len() <= self.kept {
            true => Cow::Borrowed(&self.pictures[i]),
            false => Cow::Owned(Picture::of(&self.views[i], SMALL)),
        }
    }

    /// Once poses are judged, only views that are asked are compared with: of many, what the others look like is forgotten.
    fn forget(&mut self) {
        if self.views.len() > self.kept {
            let asked = plane::asked(self.views.len());
            let others = self.pictures.iter_mut().zip(asked).filter(|(_, asked)| !asked);
            others.for_each(|(picture, _)| picture.smooth = Vec::new());
        }
    }

    fn evidence(&self, found: &Masks) -> Evidence {
        let reach = 1.3 * self.radius;
        let missing = usize::from(self.pictures.len() >= 6);
        let hull = Hull::carve(&self.pictures, &found.masks, self.center, reach, self.floor(), missing, 2 * ROUGH);
        let (masks, plane) = (&found.masks, self.best.as_ref());
        evidence::gather(&self.pictures, masks, hull.as_ref(), self.center, reach, plane, self.distance)
    }

    fn floor(&self) -> Floor {
        self.plane.as_ref().map(|p| (p.normal, p.height))
    }

    /// How far each pixel's ray passes by the center, in radii: `[h, w]`.
    fn nearness(&self, i: usize) -> Cow<'_, [f32]> {
        match self.near.get(i) {
            Some(near) => Cow::Borrowed(near.as_slice()),
            None => Cow::Owned(nearness(&self.pictures[i], self.center, self.radius)),
        }
    }

    /// The tables of all views. `background`: see [`Self::background`].
    fn tables(&self, background: &[Vec<f32>]) -> Result<Vec<Option<Table>>, SceneError> {
        let one = |i: usize| {
            self.stop.check()?;
            let Some(plane) = &self.plane else { return Ok(None) };
            let (picture, near, distance) = (self.picture(i), self.nearness(i), self.distance);
            let about = |k: usize| picture.valid[k] && near[k] < 1.0;
            let pictures = &self.pictures;
            Ok(Some(plane::table(pictures, background, i, &picture, self.center, plane, distance, |_| true, about)))
        };
        (0..self.pictures.len()).map(one).collect()
    }

    /// Cuts all views in turns until their masks stay as they are.
    fn take_turns(&self) -> Result<Masks, SceneError> {
        let count = self.pictures.len();
        let unseen =
            |i: usize| self.nearness(i).iter().map(|d| ((d - UNSEEN) / (SEEN - UNSEEN)).clamp(0.0, 1.0)).collect();
        let mut background: Vec<Vec<f32>> = self.of_asked(unseen);
        let mut last: Option<Masks> = None;
        for _ in 0..TURNS {
            let tables = self.tables(&background)?;
            let (object, behind) = self.colors(&tables, last.as_ref())?;
            let cut: Vec<(Vec<bool>, f64)> = (0..count)
                .into_par_iter()
                .map(|i| {
                    self.stop.check()?;
                    let (picture, near) = (self.picture(i), self.nearness(i));
                    let odds = odds(&picture, &object, &behind, tables[i].as_ref(), None, |_| true);
                    let biased = |k: usize| match &last {
                        Some(last) if last.outlines[i][k] => odds[k] + INSIDE,
                        Some(_) => odds[k] - OUTSIDE,
                        None => odds[k],
                    };
                    let outline = last.as_ref().map(|l| &l.outlines[i][..]);
                    let mask = cut_small(&picture, &near, &odds, outline, biased);
                    let about = (0..mask.len()).filter(|k| near[*k] < 1.0);
                    let (right, all) = about.fold((0usize, 0usize), |(right, all), k| {
                        (right + usize::from(mask[k] == (odds[k] > 0.0)), all + 1)
                    });
                    Ok((mask, right as f64 / all.max(1) as f64))
                })
                .collect::<Result<_, SceneError>>()?;
            drop(tables);
            let (masks, clearness): (Vec<Vec<bool>>, Vec<f64>) = cut.into_iter().unzip();
            let outlines = self.outlines(&masks).ok_or_else(|| SceneError::NotCutOut {
                reason:
                    "no point of space lies within the masks of all views: the poses may be wrong, or the object moved"
                        .into(),
            })?;
            background = self.background(&masks);
            let change = last.as_ref().map_or(1.0, |l| {
                l.masks.iter().zip(&masks).map(|(a, b)| 1.0 - overlap(a, b)).sum::<f64>() / count as f64
            });
            last = Some(Masks { masks, clearness, object, background: behind, outlines, shown: Vec::new() });
            if change < SETTLED {
                break;
            }
        }
        last.ok_or_else(|| SceneError::NotCutOut { reason: "no turns".into() })
    }

    /// Where the hull of small masks appears in each picture, and a little around it.
    fn outlines(&self, masks: &[Vec<bool>]) -> Option<Vec<Vec<bool>>> {
        let missing = usize::from(masks.len() >= 6);
        let hull = Hull::carve(&self.pictures, masks, self.center, 1.3 * self.radius, self.floor(), missing, ROUGH)?;
        Some(self.pictures.par_iter().map(|p| grown(&hull.outline(p), p.width(), p.height(), 2)).collect())
    }

    /// How likely each pixel of small pictures is not the object, of those that others ask.
    fn background(&self, masks: &[Vec<bool>]) -> Vec<Vec<f32>> {
        self.of_asked(|i| {
            let (mask, picture) = (&masks[i], &self.pictures[i]);
            smooth(mask, picture.width(), picture.height()).iter().map(|v| (1.0 - v).clamp(0.03, 1.0)).collect()
        })
    }

    /// Values of the views that others ask; of the rest none.
    fn of_asked(&self, values: impl Fn(usize) -> Vec<f32>) -> Vec<Vec<f32>> {
        let asked = plane::asked(self.pictures.len());
        asked.iter().enumerate().map(|(i, asked)| if *asked { values(i) } else { Vec::new() }).collect()
    }
}

/// A small picture cut at these log odds, tidied by what colors alone and the hull's outline say. `near`: see [`Stage::nearness`].
fn cut_small(
    picture: &Picture,
    near: &[f32],
    odds: &[f32],
    outline: Option<&[bool]>,
    biased: impl Fn(usize) -> f32,
) -> Vec<bool> {
    let beyond = |k: usize| near[k] > 1.3 || !picture.valid[k];
    let biased: Vec<f32> = (0..odds.len()).map(|k| if beyond(k) { -50.0 } else { biased(k) }).collect();
    tidy(&cut(picture, &biased, None), odds, outline, picture)
}

/// A view's image at the small size.
pub(crate) fn small(view: &View) -> RgbaImage {
    picture::shrunk(view, SMALL).image
}

/// Whether masks at full size reach the border of their views.
pub(crate) fn cut_off(alpha: &[u8], w: u32, h: u32) -> bool {
    let mask: Vec<bool> = alpha.iter().map(|a| *a >= 128).collect();
    reaches_border(&mask, w as usize, h as usize)
}

/// How far masks (the views' alpha) agree with their common hull, for each view: intersection over union. The hull is looked for in the
/// sphere of this `radius` about `center`.
pub fn agreement(views: &[View], center: DVec3, radius: f64) -> Vec<f64> {
    let pictures: Vec<Picture> = views.par_iter().map(|v| Picture::outlined(v, SMALL)).collect();
    let masks: Vec<Vec<bool>> = pictures.iter().map(|p| p.valid.clone()).collect();
    match Hull::carve(&pictures, &masks, center, radius, None, 0, FINE) {
        Some(hull) => pictures.iter().zip(&masks).map(|(p, m)| overlap(&hull.outline(p), m)).collect(),
        None => vec![0.0; views.len()],
    }
}

/// How far each mask (the views' alpha) and those of the others contradict each other, 0 to 1: the share of it that lies outside of the
/// others' hull, or the share of the others that it alone keeps out of the hull, on average; the larger of both. For three views or more.
pub fn contradictions(views: &[View], center: DVec3, radius: f64) -> Vec<f64> {
    let pictures: Vec<Picture> = views.par_iter().map(|v| Picture::outlined(v, SMALL)).collect();
    let masks: Vec<Vec<bool>> = pictures.iter().map(|p| p.valid.clone()).collect();
    evidence::contradictions(&pictures, &masks, center, radius)
}

/// The direction in which the plane faces that the object stands on, where one stands out. `views`: the object cut out; `whole`: the
/// photos with what is around it, by number.
pub fn table_faces(views: &[View], whole: impl Fn(usize) -> Option<RgbaImage> + Sync) -> Option<DVec3> {
    let center = meeting_point(views).filter(|_| views.len() >= 3)?;
    let distance = views.iter().map(|v| v.camera.center().distance(center)).sum::<f64>() / views.len() as f64;
    let object: Vec<Vec<bool>> = views
        .par_iter()
        .map(|v| {
            let p = Picture::outlined(v, SMALL);
            grown(&p.valid, p.width(), p.height(), 4)
        })
        .collect();
    let pictures: Vec<Picture> = views
        .par_iter()
        .enumerate()
        .map(|(k, v)| {
            let whole = View { name: String::new(), camera: v.camera, image: whole(k)? };
            Some(Picture::of(&whole, SMALL).into_comparable())
        })
        .collect::<Option<_>>()?;
    let (plane, stands_out) = plane::find(&pictures, &object, center, mean_up(views), distance, &Stop::default())?;
    stands_out.then_some(plane.normal)
}
