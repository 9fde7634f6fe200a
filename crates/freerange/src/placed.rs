//! Views in the canonical frame, and the quick fits that put them there more exactly.

use std::ops::ControlFlow;

use freerange_camera::{CanonicalFrame, FrameConfig, Similarity, View, Window};
use freerange_core::side_by_side;
use freerange_fit::{
    Axis, Evidence, FitProgress, FoundAxis, FoundMirror, Outline, QuickFitConfig, axis_steps, find_axis, find_mirror,
    frame_of, mirror_steps, mirrored, quick_fit, turned,
};
use freerange_flow::sample::SampleConfig;
use freerange_splat::Cloud;

use crate::{
    Error, Progress, Stage,
    progress::Known,
    reconstructor::{choose_views, moved, to_canonical},
};

/// The views of an object, and those of them that the model is shown.
pub(crate) struct Placed {
    pub frame: CanonicalFrame,
    /// All of them, in the canonical frame, photos [framed](Window::framed).
    pub canonical: Vec<View>,
    /// Which of them the model is shown, ascending.
    pub chosen: Vec<usize>,
    /// These, in the canonical frame, and what is added to them.
    pub shown: Vec<View>,
    /// About which its outlines may be turned.
    axis: Option<Axis>,
    /// How many views there were, before anything was added to them.
    pub photos: usize,
    /// Whether they are where they are to stay.
    pub settled: bool,
}

impl Placed {
    /// At most `most` views are shown.
    pub fn new(views: &[View], config: &FrameConfig, most: usize) -> Result<Self, Error> {
        let (mut frame, mut canonical) = to_canonical(views, config)?;
        let mut framed = 0;
        for view in &mut canonical {
            if let Some(window) = Window::framed(view) {
                *view = window.cut(view).into_owned();
                framed += 1;
            }
        }
        if framed > 0 {
            let all = views.len();
            frame.notes.push(format!("{framed} of {all} views are cut to squares about the object"));
        }
        let chosen = choose_views(views, most)?;
        if chosen.len() < views.len() {
            let names: Vec<&str> = chosen.iter().map(|&i| views[i].name.as_str()).collect();
            let (shown, all) = (chosen.len(), views.len());
            frame.notes.push(format!("the model is shown {shown} of {all} views: {}", names.join(", ")));
        }
        let shown: Vec<View> = chosen.iter().map(|&i| canonical[i].clone()).collect();
        let uneven = shown.iter().filter(|v| v.image.width() != v.image.height()).count();
        if uneven > 0 {
            let all = shown.len();
            frame.notes.push(format!(
                "{uneven} of {all} views that the model is shown are not square: it sees squares, cut or padded"
            ));
        }
        let settled = frame.kept;
        Ok(Self { frame, canonical, chosen, shown, axis: None, photos: views.len(), settled })
    }

    /// Gaussians of the user's frame in the canonical one; those that are not of the object, which lies within a radius
    /// of 0.5, are left out.
    pub fn canonical_init(&mut self, init: &Cloud) -> Result<Cloud, Error> {
        const RADIUS: f64 = 0.6;
        let Similarity { scale, rotation, translation } = self.frame.canonical_from_user;
        let mut cloud = init.clone();
        cloud.transform(scale, rotation, translation);
        let kept: Vec<usize> = (0..cloud.len()).filter(|i| cloud.mean(*i).length() <= RADIUS).collect();
        let (all, left) = (cloud.len(), cloud.len() - kept.len());
        if kept.is_empty() {
            return Err(Error::input("init", "Gaussians where the cameras look", format!("none of {all} there")));
        }
        if left > 0 {
            self.frame
                .notes
                .push(format!("{left} of {all} Gaussians to start from lie beside the object, and are left out"));
        }
        Ok(cloud.select(kept))
    }

    /// Looks for what leaves the object as it is, and adds what that shows of it: mirrored photos as further views, turned outlines as further
    /// outlines, each where photos contradict it by no more than `sample` allows.
    pub fn symmetries(
        &mut self,
        sample: &SampleConfig,
        tell: &mut impl FnMut(&Progress<'_>) -> Result<(), Error>,
    ) -> Result<(), Error> {
        if self.shown.len() > MOST_PHOTOS {
            return Ok(());
        }
        let config = &sample.start.as_ref().map_or_else(QuickFitConfig::default, |start| start.fit.clone());
        let turning = if sample.turn > 0.0 { axis_steps(config) } else { 0 };
        let mirroring = if sample.mirror > 0.0 { mirror_steps(config) } else { 0 };
        let total = config.iterations + turning + mirroring;
        tell(&Progress::new(Stage::Mirror, 0, total))?;
        let mut stopped = Ok(());
        let mut told = |done, stopped: &mut Result<(), Error>| {
            *stopped = tell(&Progress::new(Stage::Mirror, done, total));
            if stopped.is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
        };
        let mut own = quick_fit(&self.shown, config, 0, |p| told(p.step, &mut stopped))?;
        stopped?;
        stopped = Ok(());
        if !self.settled {
            self.follow(&mut own)?;
        }
        let mut axis = None;
        if turning > 0 {
            let most = sample.turn.into();
            axis = find_axis(&self.shown, &own, config, most, 0, |done| told(config.iterations + done, &mut stopped))?;
            stopped?;
            stopped = Ok(());
        }
        let mut mirror = None;
        if mirroring > 0 {
            let most = sample.mirror.into();
            let tell = |done| told(config.iterations + turning + done, &mut stopped);
            mirror = find_mirror(&self.shown, &own, config, most, 0, tell)?;
            stopped?;
        }
        tell(&Progress::new(Stage::Mirror, total, total))?;
        if let Some(FoundAxis { axis, contradiction }) = axis {
            let [x, y, z] = axis.direction.to_array();
            let most = sample.turn;
            self.frame.notes.push(format!(
                "the object is taken to keep its outlines however it is turned about an axis in direction ({x:.2}, {y:.2}, {z:.2}): turned \
                 outlines are fitted to (contradiction {contradiction:.2}, at most {most})"
            ));
            self.axis = Some(axis);
        }
        if let Some(FoundMirror { mirror, doubt }) = mirror {
            let [x, y, z] = mirror.normal.to_array();
            let most = sample.mirror;
            self.frame.notes.push(format!(
                "the object is taken to be its own mirror image about the plane with normal ({x:.2}, {y:.2}, {z:.2}): mirrored photos are \
                 further views (doubt {doubt:.2}, at most {most})"
            ));
            self.shown.extend(mirrored(&self.shown, &mirror));
            self.canonical.extend(mirrored(&self.canonical, &mirror));
        }
        Ok(())
    }

    /// What fits of what the model is shown agree with.
    pub fn seen(&self) -> Evidence<'_> {
        Evidence { views: &self.shown, outlines: self.outlines(&self.shown[..self.chosen.len()]) }
    }

    /// What a fit of all views agrees with.
    pub fn all(&self) -> Evidence<'_> {
        Evidence { views: &self.canonical, outlines: self.outlines(&self.canonical[..self.photos]) }
    }

    fn outlines<'a>(&self, photos: &'a [View]) -> Vec<Outline<'a>> {
        self.axis.as_ref().map_or_else(Vec::new, |axis| turned(photos, axis))
    }

    /// A quick fit for each member of the ensemble of each seed, `[members][seeds]`. The first of seed 0 moves frame and views, of
    /// whatever seed samples are: they do not depend on what is drawn beside them.
    pub fn quick_fits(
        &mut self,
        config: &QuickFitConfig,
        seeds: &[u64],
        members: usize,
        tell: &mut impl FnMut(&Progress<'_>) -> Result<(), Error>,
    ) -> Result<Vec<Vec<Cloud>>, Error> {
        let of_members = |member| seeds.iter().map(move |seed| seed.wrapping_mul(MOST_MEMBERS).wrapping_add(member));
        let numbers: Vec<u64> = (0..members as u64).flat_map(of_members).collect();
        let framing = !self.settled && !numbers.contains(&0);
        let total = (numbers.len() + usize::from(framing)) * config.iterations;
        // The fit knows better than the masks where the object is; it moves along, so that one is enough.
        let mut first = None;
        if !self.settled {
            let place = &self.frame.canonical_from_user;
            let mut moved = watched(Stage::Fit, 0, place, tell, total, |p| quick_fit(self.seen(), config, 0, p))?;
            self.follow(&mut moved)?;
            first = Some(moved);
        }
        let mut done = if first.is_some() { config.iterations } else { 0 };
        if done == 0 {
            tell(&Progress::new(Stage::Fit, 0, total))?;
        }
        let (seen, first) = (&self.seen(), first.as_ref());
        let jobs = numbers.iter().enumerate().map(|(i, &number)| {
            // One fit is enough to look at.
            let shown = first.is_none() && i == 0;
            move |tell: &mut dyn FnMut((f64, Option<Cloud>)) -> ControlFlow<()>| match first {
                Some(first) if number == 0 => Ok(first.clone()),
                _ => quick_fit(seen.clone(), config, number, |p| tell((p.loss, shown.then(|| p.cloud.clone())))),
            }
        });
        let mut stopped = Ok(());
        let fits = side_by_side(jobs.collect(), |_, (loss, cloud)| {
            done += 1;
            let estimate = cloud.as_ref().map(|cloud| (Known::Fitted(cloud), &self.frame.canonical_from_user));
            stopped = tell(&Progress { loss: Some(loss), estimate, ..Progress::new(Stage::Fit, done, total) });
            if stopped.is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
        });
        stopped?;
        let fits = fits.into_iter().collect::<Result<Vec<_>, _>>()?;
        Ok(fits.chunks(seeds.len().max(1)).map(<[Cloud]>::to_vec).collect())
    }

    /// Moves frame and views, and the fit itself, to where a quick fit says that the object is.
    fn follow(&mut self, fit: &mut Cloud) -> Result<(), Error> {
        let correction = &frame_of(fit, &self.shown)?;
        fit.transform(correction.scale, correction.rotation, correction.translation);
        self.canonical = moved(&self.canonical, correction);
        self.shown = moved(&self.shown, correction);
        self.frame.canonical_from_user = correction.after(&self.frame.canonical_from_user);
        self.settled = true;
        let (shift, scale) = (correction.translation.length(), correction.scale);
        self.frame.notes.push(format!("the quick fit moved it by {shift:.3} and scaled it by {scale:.3}"));
        Ok(())
    }
}

/// Photos beyond which no symmetries are looked for: so many were measured, and the model is shown no more than twice as many.
const MOST_PHOTOS: usize = 4;

/// Numbers that the fits of one seed have for its members: as many as `sample.ensemble` allows.
const MOST_MEMBERS: u64 = 64;

/// A fit whose steps are told, as those of so many; what it has when it is stopped is of no use.
pub(crate) fn watched(
    stage: Stage,
    sample: usize,
    canonical_from_user: &Similarity,
    tell: &mut impl FnMut(&Progress<'_>) -> Result<(), Error>,
    total: usize,
    fit: impl FnOnce(&mut dyn FnMut(&FitProgress<'_>) -> ControlFlow<()>) -> Result<Cloud, freerange_fit::FitError>,
) -> Result<Cloud, Error> {
    tell(&Progress { sample, ..Progress::new(stage, 0, total) })?;
    let mut stopped = Ok(());
    let cloud = fit(&mut |p| {
        let estimate = Some((Known::Fitted(p.cloud), canonical_from_user));
        let loss = Some(p.loss);
        stopped = tell(&Progress { sample, loss, estimate, ..Progress::new(stage, p.step, total) });
        if stopped.is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    });
    stopped?;
    Ok(cloud?)
}
