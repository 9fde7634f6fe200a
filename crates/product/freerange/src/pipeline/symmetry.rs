//! Step 2, symmetry. In: the canonical scene with up to four photos, and an initial fit of it. Out: the targets of the
//! steps that follow, photos and what a symmetry adds to them: mirrored photos as further views, rotated silhouettes.
//!
//! A symmetry counts as far as a fit of photos and additions together still agrees with the photos
//! ([`find_mirror`], [`find_axis`]; docs/research/experiments/symmetry.md): its additions have a weight, which falls as the
//! residual grows. Cost: seven seconds of two cores.

use std::ops::ControlFlow;

use freerange_optim::{
    Axis, Evidence, FitError, FoundAxis, FoundMirror, Mirror, PosedImage, axis_steps, find_axis, find_mirror,
    mirror_steps, mirrored, turned,
};
use freerange_scene::camera::View;
use freerange_util::{Note, side_by_side};

use super::{
    CanonicalScene,
    canonical::Photo,
    watch::{Watch, flow},
};
use crate::{Detect, Error, PipelineConfig, Stage, error::Lift};

/// Photos beyond which no symmetry is looked for: so many were measured, and the network sees at most twice as many.
const MOST_PHOTOS: usize = 4;
/// Residuals within which a weight falls from 1 to 0, the threshold in their middle.
const REFLECTION_RAMP: f64 = 0.2;
const REVOLUTION_RAMP: f64 = 0.1;
/// The greatest weight of mirrored photos: a photo counts at least twice as much as its mirror image.
const MIRRORED: f64 = 0.5;

/// The weight of what a symmetry with this residual adds.
fn weight(residual: f64, threshold: f64, ramp: f64) -> f64 {
    (0.5 + (threshold - residual) / ramp).clamp(0.0, 1.0)
}

/// The residual from which that is 0.
fn greatest(threshold: f64, ramp: f64) -> f64 {
    threshold + 0.5 * ramp
}

/// What one of the searches found.
enum Found {
    Axis(Option<FoundAxis>),
    Mirror(Option<FoundMirror>),
}

/// Hears how many steps of a search are done.
type Tell<'a> = dyn FnMut(usize) -> ControlFlow<()> + 'a;
/// A search.
type Job<'a> = Box<dyn FnOnce(&mut Tell<'_>) -> Result<Found, FitError> + Send + 'a>;

/// What was found, with weights above 0.
#[derive(Default)]
pub(crate) struct Symmetry {
    mirror: Option<(Mirror, f64)>,
    axis: Option<(Axis, f64)>,
    notes: Vec<Note>,
}

/// What fits, the network and the optimization should agree with.
pub(crate) struct Targets<'v> {
    /// The network's views, and their mirror images.
    network: Vec<View>,
    /// How many of them are photos.
    network_photos: usize,
    /// All photos.
    photos: Vec<Photo<'v>>,
    /// Their mirror images, and how much these count.
    mirrored: Vec<View>,
    mirrored_weight: f64,
    axis: Option<(Axis, f64)>,
}

/// Looks for symmetries, unless that is switched off or there are more than four photos.
pub(crate) fn detect(
    scene: &CanonicalScene<'_>,
    config: &PipelineConfig,
    watch: &mut Watch<'_>,
) -> Result<Symmetry, Error> {
    let (limits, fit) = (&config.symmetry, &config.propose.fit);
    let Some(own) = scene.fit.as_ref().filter(|_| limits.detect == Detect::Auto) else {
        return Ok(Symmetry::default());
    };
    if scene.photos.len() > MOST_PHOTOS {
        let text = format!("no symmetry is looked for: there are more than {MOST_PHOTOS} photos");
        return Ok(Symmetry { notes: vec![Note::understood(text)], ..Symmetry::default() });
    }
    let shown = &scene.network_views();
    // Beside each other: many small pieces of work that follow one another fill each other's gaps.
    let mut jobs: Vec<(usize, Job<'_>)> = Vec::new();
    if limits.revolution_threshold > 0.0 {
        let find = |tell: &mut Tell<'_>| {
            find_axis(shown, own, fit, greatest(limits.revolution_threshold, REVOLUTION_RAMP), 0, tell).map(Found::Axis)
        };
        jobs.push((axis_steps(fit), Box::new(find)));
    }
    if limits.reflection_threshold > 0.0 {
        let find = |tell: &mut Tell<'_>| {
            find_mirror(shown, own, fit, greatest(limits.reflection_threshold, REFLECTION_RAMP), 0, tell)
                .map(Found::Mirror)
        };
        jobs.push((mirror_steps(fit), Box::new(find)));
    }
    let total = jobs.iter().map(|(steps, _)| steps).sum();
    watch.report(Stage::Symmetry, [0, total], None, None)?;
    let (mut done, mut stopped) = (vec![0; jobs.len()], Ok(()));
    let results = side_by_side(jobs.into_iter().map(|(_, job)| job).collect(), |job, steps| {
        done[job] = steps;
        stopped = watch.report(Stage::Symmetry, [done.iter().sum(), total], None, None);
        flow(&stopped)
    });
    stopped?;
    let (mut axis, mut mirror) = (None, None);
    for result in results {
        match result.lift()? {
            Found::Axis(found) => axis = found,
            Found::Mirror(found) => mirror = found,
        }
    }
    watch.report(Stage::Symmetry, [total, total], None, None)?;
    let mut found = Symmetry::default();
    let weighted = |residual, threshold, ramp| Some(weight(residual, threshold, ramp)).filter(|weight| *weight > 0.0);
    if let Some(FoundAxis { axis, contradiction }) = axis
        && let Some(weight) = weighted(contradiction, limits.revolution_threshold, REVOLUTION_RAMP)
    {
        let [x, y, z] = axis.direction.to_array();
        found.notes.push(Note::assumed(format!(
            "the object is a solid of revolution about an axis in direction ({x:.2}, {y:.2}, {z:.2}): rotated silhouettes are \
             further targets (residual {contradiction:.2}, weight {weight:.2})"
        )));
        found.axis = Some((axis, weight));
    }
    if let Some(FoundMirror { mirror, doubt }) = mirror
        && let Some(weight) = weighted(doubt, limits.reflection_threshold, REFLECTION_RAMP)
    {
        let weight = MIRRORED * weight;
        let [x, y, z] = mirror.normal.to_array();
        found.notes.push(Note::assumed(format!(
            "the object is symmetric about the plane with normal ({x:.2}, {y:.2}, {z:.2}): mirrored photos are further views \
             (residual {doubt:.2}, weight {weight:.2})"
        )));
        found.mirror = Some((mirror, weight));
    }
    Ok(found)
}

impl Symmetry {
    /// The targets, with what the symmetry adds. They take the scene's photos; notes go to the scene; a fit of photos alone is
    /// dropped where there is more.
    pub fn targets<'v>(self, scene: &mut CanonicalScene<'v>) -> Targets<'v> {
        let mut network = scene.network_views();
        let photos = std::mem::take(&mut scene.photos);
        let (network_photos, mut mirror_images) = (network.len(), Vec::new());
        if let Some((mirror, _)) = &self.mirror {
            network.extend(mirrored(&network, mirror));
            let views: Vec<View> = photos.iter().map(Photo::view).collect();
            mirror_images = mirrored(&views, mirror);
        }
        if self.mirror.is_some() || self.axis.is_some() {
            scene.fit = None;
        }
        scene.notes.extend(self.notes);
        let mirrored_weight = self.mirror.map_or(0.0, |(_, weight)| weight);
        Targets { network, network_photos, photos, mirrored: mirror_images, mirrored_weight, axis: self.axis }
    }
}

impl Targets<'_> {
    /// What the network sees for proposal `number` of `count`. As large a part of them as the mirrored photos' weight has these.
    pub fn of_network(&self, number: usize, count: usize) -> &[View] {
        let with_mirrored = (self.mirrored_weight * count as f64).round() as usize;
        if number < with_mirrored { &self.network } else { &self.network[..self.network_photos] }
    }

    /// What initial fits agree with.
    pub fn of_fits(&self) -> Evidence<'_> {
        let mut views: Vec<PosedImage<'_>> = self.network.iter().map(PosedImage::from).collect();
        views[self.network_photos..].iter_mut().for_each(|view| view.weight = self.mirrored_weight);
        Evidence { silhouettes: self.silhouettes(&views[..self.network_photos]), photos: self.network_photos, views }
    }

    /// How many photos there are, without what a symmetry adds.
    pub fn photos(&self) -> usize {
        self.photos.len()
    }

    /// What the optimization agrees with.
    pub fn of_optimization(&self) -> Evidence<'_> {
        let mut views: Vec<PosedImage<'_>> = self.photos.iter().map(Photo::posed).collect();
        let (silhouettes, photos) = (self.silhouettes(&views), views.len());
        let weight = self.mirrored_weight;
        views.extend(self.mirrored.iter().map(|view| PosedImage { weight, ..view.into() }));
        Evidence { views, photos, silhouettes }
    }

    /// Silhouettes of `photos` rotated about the axis, if there is one.
    fn silhouettes<'a>(&self, photos: &[PosedImage<'a>]) -> Vec<PosedImage<'a>> {
        let Some((axis, weight)) = &self.axis else { return Vec::new() };
        turned(photos, axis).into_iter().map(|view| PosedImage { weight: *weight, ..view }).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_weight_falls_about_the_threshold() {
        let weights = [0.5, 1.0, 1.05, 1.1, 1.15, 1.2, 2.0].map(|residual| weight(residual, 1.1, 0.2));
        let expected = [1.0, 1.0, 0.75, 0.5, 0.25, 0.0, 0.0];
        assert!(weights.iter().zip(expected).all(|(found, expected)| (found - expected).abs() < 1e-9), "{weights:?}");
        assert!(weight(greatest(1.1, 0.2), 1.1, 0.2).abs() < 1e-9);
    }

    #[test]
    fn as_many_proposals_see_mirrored_photos_as_these_weigh() {
        let view = View {
            name: "a".into(),
            camera: freerange_scene::camera::Camera::look_at(
                glam::DVec3::X,
                glam::DVec3::ZERO,
                glam::DVec3::Z,
                0.9,
                8,
                8,
            ),
            image: image::RgbaImage::new(8, 8),
        };
        for (mirrored_weight, expected) in [(0.0, 0), (0.1, 0), (0.3, 1), (0.5, 2), (0.9, 4), (1.0, 4)] {
            let targets = Targets {
                network: vec![view.clone(), view.clone()],
                network_photos: 1,
                photos: Vec::new(),
                mirrored: Vec::new(),
                mirrored_weight,
                axis: None,
            };
            let seeing = (0..4).filter(|&number| targets.of_network(number, 4).len() == 2).count();
            assert_eq!(seeing, expected, "weight {mirrored_weight}");
        }
    }
}
