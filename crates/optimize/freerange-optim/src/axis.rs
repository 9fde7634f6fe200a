//! Axes about which an object may be turned, and keeps its silhouettes: each photo then tells them from where nobody stood.

use std::{f64::consts::TAU, ops::ControlFlow};

use freerange_gaussians::Gaussians;
use freerange_scene::camera::{Camera, View};
use glam::{DMat4, DVec3};

use crate::{
    Evidence, FitError, InitialFitConfig, PosedImage,
    search::{Hull, OUTLINE, PICTURE, Pictures, ROUNDS, Search, Symmetry, UNCOVERED, going_on, normals, place},
    views::Targets,
};

/// A line: what was made on a wheel or a lathe has one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axis {
    /// Any of its points.
    pub point: DVec3,
    /// Of unit length.
    pub direction: DVec3,
}

/// What is turned by so many parts of a turn.
const TURNS: u32 = 8;

impl Axis {
    fn turn(&self, turns: f64) -> DMat4 {
        let turned = DMat4::from_axis_angle(self.direction, TAU * turns);
        DMat4::from_translation(self.point) * turned * DMat4::from_translation(-self.point)
    }

    /// Where the camera stands after so many turns about the axis.
    fn camera(&self, camera: &Camera, turns: f64) -> Camera {
        Camera { world_to_camera: camera.world_to_camera * self.turn(-turns), ..*camera }
    }
}

impl Symmetry for Axis {
    const MIRRORS: bool = false;
    const WAYS: usize = 4;

    // Some of the turns are enough to judge by: the quarters, and one between.
    fn cameras(&self, camera: &Camera) -> Vec<Camera> {
        [2.0, 3.0, 4.0, 6.0].iter().map(|turn| self.camera(camera, turn / f64::from(TURNS))).collect()
    }

    fn moved(&self, way: usize, step: f64) -> Self {
        let a = self.direction.any_orthonormal_vector();
        let b = self.direction.cross(a);
        match way {
            0 | 1 => Self { direction: (self.direction + step * [a, b][way]).normalize(), ..*self },
            _ => Self { point: self.point + 0.5 * step * [a, b][way - 2], ..*self },
        }
    }
}

/// An axis that the photos allow.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FoundAxis {
    /// The axis.
    pub axis: Axis,
    /// How unlike the photos' silhouettes those of a fit of photos and turned silhouettes are, as a part of how unlike those of a fit of the photos alone
    /// are. The former has had twice the steps, half of them for silhouettes: well below 1 where turned silhouettes agree with the photos.
    pub contradiction: f64,
}

/// Axes that are put in place by silhouettes.
const PLACED: usize = 8;

/// How many steps [`find_axis`] tells of.
pub fn axis_steps(config: &InitialFitConfig) -> usize {
    config.iterations + ROUNDS * going_on(config).iterations
}

/// The axis about which an object may be turned and keeps its silhouettes, as far as photos of it tell: none where they contradict it by more than
/// `most` (see [`FoundAxis::contradiction`]), or no axis suits their silhouettes. Colors need not be the same all around. `views` lie in the
/// canonical frame, and may all be from one side; `own` is a [`initial_fit`](crate::initial_fit) of them.
///
/// What lies within all silhouettes, and within all turned ones, has to fill the silhouettes. Axes through the middle of the hull, in all directions,
/// fifteen degrees apart: those that leave most of the silhouettes filled are moved to where they leave more. The best of them is moved to where that
/// fit of the photos, then one of photos and turned silhouettes, looks most like the silhouettes when it is turned.
/// `progress` hears how many of [`axis_steps`] are done, of some more than once, and ends the search, with none, by `ControlFlow::Break`.
///
/// # Errors
/// Those of [`fit`](crate::fit()).
pub fn find_axis(
    views: &[View],
    own: &Gaussians,
    config: &InitialFitConfig,
    most: f64,
    seed: u64,
    mut progress: impl FnMut(usize) -> ControlFlow<()>,
) -> Result<Option<FoundAxis>, FitError> {
    config.check()?;
    let silhouettes = Targets::new(views, Some(OUTLINE))?;
    let hull = Hull::new(&silhouettes);
    let mut search = Search { progress: &mut progress, seed, done: 0 };
    let uncovered = |axis: &Axis| {
        let turns: Vec<DMat4> = (1..TURNS).map(|i| axis.turn(f64::from(i) / f64::from(TURNS))).collect();
        let copies: Vec<_> = turns.iter().map(|turn| |p| turn.transform_point3(p)).collect();
        Ok(hull.uncovered(&copies))
    };
    if hull.points.is_empty() {
        return Ok(None);
    }
    let through = |direction: DVec3| {
        let a = direction.any_orthonormal_vector();
        let b = direction.cross(a);
        Axis { point: hull.middle(a) * a + hull.middle(b) * b, direction }
    };
    let axes = normals().into_iter().map(through).collect();
    let Some(mut judged) = search.each(axes, |axis| Ok((uncovered(&axis)?, axis)))? else { return Ok(None) };
    judged.sort_by(|a, b| a.0.total_cmp(&b.0));
    let judged: Vec<Axis> = judged.into_iter().take(PLACED).map(|(_, axis)| axis).collect();
    let Some(placed) = search.each(judged, |axis| place(axis, [0.12, 0.012], |axis, _| uncovered(axis)))? else {
        return Ok(None);
    };
    let best = placed.into_iter().min_by(|a, b| a.0.total_cmp(&b.0));
    let Some((_, mut axis)) = best.filter(|(uncovered, _)| *uncovered <= UNCOVERED) else { return Ok(None) };

    let pictures = Targets::new(views, Some(PICTURE))?;
    let (outlines, pictures) = (Pictures::new(&silhouettes, false), Pictures::new(&pictures, false));
    let put = |cloud: &Gaussians, axis: Axis, reach| {
        place(axis, reach, |axis, enough| outlines.difference(cloud, Some(axis), enough))
    };
    let before = pictures.difference::<Axis>(own, None, f64::INFINITY)?;
    (_, axis) = put(own, axis, [0.04, 0.004])?;
    let photos: Vec<PosedImage<'_>> = views.iter().map(PosedImage::from).collect();
    let both = |axis: &Axis| Evidence { silhouettes: turned(&photos, axis), ..photos.clone().into() };
    let Some(mut cloud) = search.fitted(None, both(&axis), config)? else { return Ok(None) };
    for _ in 0..ROUNDS {
        (_, axis) = put(&cloud, axis, [0.01, 0.002])?;
        let Some(next) = search.fitted(Some(&cloud), both(&axis), &going_on(config))? else { return Ok(None) };
        cloud = next;
    }
    let contradiction = pictures.difference::<Axis>(&cloud, None, f64::INFINITY)? / before.max(f64::MIN_POSITIVE);
    Ok((contradiction <= most).then_some(FoundAxis { axis, contradiction }))
}

/// The silhouettes of the views, turned all around the axis.
pub fn turned<'a>(views: &[PosedImage<'a>], axis: &Axis) -> Vec<PosedImage<'a>> {
    let turned = |view: &PosedImage<'a>, i: u32| {
        let camera = axis.camera(&view.camera, f64::from(i) / f64::from(TURNS));
        PosedImage { camera, ..*view }
    };
    (1..TURNS).flat_map(|i| views.iter().map(move |view| turned(view, i))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::{cameras, own, photograph, photos};
    use freerange_gaussians::channel;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const AXIS: Axis = Axis { point: DVec3::new(0.04, -0.02, 0.0), direction: DVec3::new(0.48, 0.6, 0.64) };

    /// A vase of rings, each Gaussian of a color of its own: all around its axis or, where it is `half`, on one side of it.
    fn vase(half: bool) -> Gaussians {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut cloud = Gaussians::default();
        let side = AXIS.direction.any_orthonormal_vector();
        for (height, radius) in
            [(-0.3, 0.12), (-0.2, 0.2), (-0.1, 0.24), (0.0, 0.22), (0.1, 0.14), (0.2, 0.08), (0.3, 0.12)]
        {
            for i in 0..if half { 12 } else { 24 } {
                let mean = AXIS.point + height * AXIS.direction + radius * side;
                let mean = AXIS.turn(f64::from(i) / 24.0).transform_point3(mean);
                let mut row = [0.0; channel::COUNT];
                row[channel::MEAN].copy_from_slice(&mean.as_vec3().to_array());
                row[channel::LOG_SCALE].fill(-3.2);
                row[channel::ROTATION.start] = 1.0;
                row[channel::LOGIT_OPACITY] = 4.0;
                row[channel::COLOR].fill_with(|| rng.random_range(0.1..0.9));
                cloud.push(&row);
            }
        }
        cloud
    }

    const QUICK: InitialFitConfig = InitialFitConfig { iterations: 120, gaussians: 150, render_size: 64 };

    #[test]
    fn turned_views_are_views_of_the_turned_object() {
        let cloud = vase(true);
        let camera = cameras(3, 40, 0.0)[1];
        let view = photograph(&cloud, &camera);
        let all = turned(&[(&view).into()], &AXIS);
        assert_eq!(all.len(), 7);
        let height = |camera: &Camera| (camera.center() - AXIS.point).dot(AXIS.direction);
        for (i, seen) in (1..8).zip(&all) {
            assert!((height(&seen.camera) - height(&view.camera)).abs() < 1e-9);
            let mut object = cloud.clone();
            for row in object.iter_mut() {
                let mean = DVec3::from_array([0, 1, 2].map(|k| f64::from(row[channel::MEAN.start + k])));
                let mean = AXIS.turn(f64::from(i) / 8.0).transform_point3(mean);
                row[channel::MEAN].copy_from_slice(&mean.as_vec3().to_array());
            }
            let made = photograph(&object, &seen.camera).image;
            let apart = made.pixels().zip(seen.image.pixels()).map(|(a, b)| a[3].abs_diff(b[3])).max().unwrap();
            assert!(apart <= 2, "{i}: {apart} of 255");
        }
    }

    #[test]
    fn what_keeps_its_silhouettes_is_told_from_what_does_not() {
        let find = |views: &[View], most| {
            find_axis(views, &own(views, &QUICK), &QUICK, most, 0, |_| ControlFlow::Continue(())).unwrap()
        };
        let all = photos(&vase(false));
        let one_side: Vec<View> = [-0.4f64, -0.1, 0.2, 0.5]
            .iter()
            .map(|turn| {
                let eye = 1.5 * DVec3::new(turn.cos(), turn.sin(), 0.5 - 0.6 * turn.abs());
                photograph(&vase(false), &Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.857, 64, 64))
            })
            .collect();
        for (name, views, off) in [("around", &all, 0.06), ("one side", &one_side, 0.12)] {
            let found = find(views, f64::INFINITY).expect(name);
            let direction = found.axis.direction * found.axis.direction.dot(AXIS.direction).signum();
            assert!(direction.angle_between(AXIS.direction) < off, "{name}: {found:?}");
            let between = found.axis.point - AXIS.point;
            let apart = between - between.dot(AXIS.direction) * AXIS.direction;
            assert!(apart.length() < 0.03, "{name}: {found:?}");
            assert!(found.contradiction < 0.95, "{name}: {found:?}");
            assert_eq!(find(views, found.contradiction - 1e-9), None, "{name}");
        }
        assert_eq!(find(&photos(&vase(true)), f64::INFINITY), None, "half a vase has no axis");
    }

    #[test]
    fn the_search_is_told_of_and_ends_where_it_is_told_to() {
        let config = InitialFitConfig { iterations: 7, gaussians: 30, render_size: 32 };
        let views = photos(&vase(false));
        let mut told = Vec::new();
        let own = own(&views, &config);
        find_axis(&views, &own, &config, f64::INFINITY, 0, |done| {
            told.push(done);
            ControlFlow::Continue(())
        })
        .unwrap();
        assert!(told[0] == 0 && told.windows(2).all(|pair| pair[0] <= pair[1]), "{told:?}");
        told.dedup();
        assert!(told.iter().copied().eq(0..=axis_steps(&config)), "{told:?}");
        for last in [0, 1, 9, 16] {
            let mut reached = 0;
            let found = find_axis(&views, &own, &config, f64::INFINITY, 0, |done| {
                reached = done;
                if done == last { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            });
            assert!(found.unwrap().is_none() && reached == last, "{last}: {reached}");
        }
        assert!(find_axis(&[], &own, &config, f64::INFINITY, 0, |_| ControlFlow::Continue(())).is_err());
    }
}
