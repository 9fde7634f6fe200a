//! Planes about which an object is its own mirror image: each photo is then one more, from where nobody stood.

use std::ops::ControlFlow;

use freerange_gaussians::Gaussians;
use freerange_scene::camera::{Camera, View};
use freerange_util::side_by_side;
use glam::{DMat3, DMat4, DVec3};
use image::imageops::flip_horizontal;
use rayon::prelude::*;

use crate::{
    FitError, InitialFitConfig,
    search::{Hull, OUTLINE, PICTURE, Pictures, ROUNDS, Search, Symmetry, UNCOVERED, going_on, normals, place},
    views::Targets,
};

/// A plane: the points p with `normal . p = offset`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mirror {
    /// Of unit length.
    pub normal: DVec3,
    /// Signed distance from the origin.
    pub offset: f64,
}

impl Mirror {
    /// The point on the other side.
    pub fn point(&self, p: DVec3) -> DVec3 {
        p - 2.0 * (self.normal.dot(p) - self.offset) * self.normal
    }

    /// The same view from the other side, of an object that is its own mirror image: the picture is mirrored, too.
    pub fn view(&self, view: &View) -> View {
        let name = format!("{} mirrored", view.name);
        View { name, camera: self.camera(&view.camera), image: flip_horizontal(&view.image) }
    }

    /// The camera of that view.
    fn camera(&self, camera: &Camera) -> Camera {
        let axes = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| axis - 2.0 * self.normal.dot(axis) * self.normal);
        let shift = 2.0 * self.offset * self.normal;
        let reflection = DMat4::from_mat3(DMat3::from_cols(axes[0], axes[1], axes[2]));
        let reflection = DMat4::from_translation(shift) * reflection;
        // Mirrored twice, the camera is one again.
        let flip = DMat4::from_scale(DVec3::new(-1.0, 1.0, 1.0));
        let world_to_camera = flip * camera.world_to_camera * reflection;
        Camera { cx: f64::from(camera.width) - camera.cx, world_to_camera, ..*camera }
    }
}

impl Symmetry for Mirror {
    const MIRRORS: bool = true;
    const WAYS: usize = 3;

    fn cameras(&self, camera: &Camera) -> Vec<Camera> {
        vec![self.camera(camera)]
    }

    fn moved(&self, way: usize, step: f64) -> Self {
        let a = self.normal.any_orthonormal_vector();
        let b = self.normal.cross(a);
        let moved = |tilt: DVec3| Self { normal: (self.normal + step * tilt).normalize(), ..*self };
        match way {
            0 => moved(a),
            1 => moved(b),
            _ => Self { offset: self.offset + 0.5 * step, ..*self },
        }
    }
}

/// A plane that the photos allow.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FoundMirror {
    /// The plane.
    pub mirror: Mirror,
    /// How unlike the photos a fit of them together with the mirrored ones is, as a part of how unlike a fit of them alone is (it has
    /// had twice the steps: below 1 where mirrored photos agree with the photos, twice that and more where they do not); less 0.4 times
    /// how far mirrored photos are from the photos, as 1 less the cosine between directions, since what is new may contradict a little.
    pub doubt: f64,
}

/// Planes whose normals are closer than this, in radians, are one.
const APART: f64 = 0.2;
/// Least cosine of the angle between a mirrored photo's direction and the nearest photo's, mean over the photos: where they share nothing,
/// they cannot contradict each other.
const BESIDE: f64 = 0.5;
/// How much a plane may be contradicted more whose mirrored photos are far from the photos: one that falls on a photo tells nothing new.
const NEW: f64 = 0.4;
/// Longest mean of the directions towards the cameras, as unit vectors: photos from one side do not tell how deep the object is, and so not
/// where a plane lies.
const ONE_SIDED: f64 = 0.75;
/// Planes that are put in their place by a fit of the photos alone.
const PLACED: usize = 6;
/// Planes that are fitted to.
const FITTED: usize = 3;

/// How many steps [`find_mirror`] tells of.
pub fn mirror_steps(config: &InitialFitConfig) -> usize {
    FITTED * (config.iterations + ROUNDS * going_on(config).iterations)
}

/// The plane about which an object is its own mirror image, as far as photos of it tell: none where they doubt every plane by more than `most`
/// (see [`FoundMirror::doubt`]), no plane suits their silhouettes, or they are all from one side. Of several the one that they doubt least.
/// `views` lie in the canonical frame; `own` is a [`initial_fit`](crate::initial_fit) of them.
///
/// Three questions, each asked of fewer planes than the one before. Can what lies within all silhouettes and within all mirrored ones fill the silhouettes?
/// (All directions, fifteen degrees apart, but for those from which mirrored photos share nothing with the photos.) From behind which of these planes does that fit of the photos look most like them? And how much do photos
/// and mirrored photos contradict each other, in a fit of both that moves the plane as well?
/// `progress` hears how many of [`mirror_steps`] are done, of some more than once, and ends the search, with none, by `ControlFlow::Break`.
///
/// # Errors
/// Those of [`fit`](crate::fit()).
pub fn find_mirror(
    views: &[View],
    own: &Gaussians,
    config: &InitialFitConfig,
    most: f64,
    seed: u64,
    mut progress: impl FnMut(usize) -> ControlFlow<()>,
) -> Result<Option<FoundMirror>, FitError> {
    config.check()?;
    let silhouettes = Targets::new(views, Some(OUTLINE))?;
    let planes = planes(&Hull::new(&silhouettes), &silhouettes);
    let targets = Targets::new(views, Some(PICTURE))?;
    let pictures = Pictures::new(&targets, true);
    let mut search = Search { progress: &mut progress, seed, done: 0 };
    let put = |cloud: &Gaussians, plane: Mirror, reach| {
        place(plane, [reach, 0.001], |plane, enough| pictures.difference(cloud, Some(plane), enough))
    };
    let judge = |plane: Mirror| Ok((pictures.difference(own, Some(&plane), f64::INFINITY)?, plane));
    let Some(judged) = search.each(planes, judge)? else { return Ok(None) };
    let judged: Vec<Mirror> = best(judged, PLACED).into_iter().map(|(_, plane)| plane).collect();
    let Some(placed) = search.each(judged, |plane| put(own, plane, 0.04))? else { return Ok(None) };
    let before = pictures.difference::<Mirror>(own, None, f64::INFINITY)?;
    let fitted = |mut plane: Mirror, tell: &mut dyn FnMut(()) -> ControlFlow<()>| {
        let both = |plane: &Mirror| [views, &mirrored(views, plane)[..]].concat();
        let mut search = Search { progress: &mut |_| tell(()), seed, done: 0 };
        let Some(mut cloud) = search.fitted(None, &both(&plane), config)? else { return Ok(None) };
        for _ in 0..ROUNDS {
            (_, plane) = put(&cloud, plane, 0.01)?;
            let Some(next) = search.fitted(Some(&cloud), &both(&plane), &going_on(config))? else { return Ok(None) };
            cloud = next;
        }
        let contradiction = pictures.difference::<Mirror>(&cloud, None, f64::INFINITY)? / before.max(f64::MIN_POSITIVE);
        let doubt = contradiction - NEW * (1.0 - beside(&targets, plane.normal));
        Ok::<_, FitError>(Some(FoundMirror { mirror: plane, doubt }))
    };
    let fitted = &fitted;
    let jobs = best(placed, FITTED)
        .into_iter()
        .map(|(_, plane)| move |tell: &mut dyn FnMut(()) -> ControlFlow<()>| fitted(plane, tell))
        .collect();
    let mut told = ControlFlow::Continue(());
    let fitted = side_by_side(jobs, |_, ()| {
        search.done += 1;
        told = (search.progress)(search.done);
        told
    });
    // All may be done before anyone hears of it.
    if told.is_break() {
        return Ok(None);
    }
    let mut least: Option<FoundMirror> = None;
    for found in fitted {
        if let Some(found) = found?.filter(|found| found.doubt <= least.map_or(most, |least| least.doubt)) {
            least = Some(found);
        }
    }
    Ok(least)
}

/// At most `most` of the planes, those of the smallest values, no two of which are one.
fn best(mut planes: Vec<(f64, Mirror)>, most: usize) -> Vec<(f64, Mirror)> {
    planes.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut chosen: Vec<(f64, Mirror)> = Vec::with_capacity(most);
    for plane in planes {
        if chosen.len() < most && chosen.iter().all(|c| c.1.normal.dot(plane.1.normal).abs() < APART.cos()) {
            chosen.push(plane);
        }
    }
    chosen
}

/// The views from behind the mirror.
pub fn mirrored(views: &[View], mirror: &Mirror) -> Vec<View> {
    views.iter().map(|view| mirror.view(view)).collect()
}

/// Planes whose mirrored silhouettes leave enough of the hull to fill the silhouettes.
fn planes(hull: &Hull, targets: &Targets) -> Vec<Mirror> {
    if hull.points.is_empty() || one_sided(targets) {
        return Vec::new();
    }
    let normals = normals().into_par_iter().filter(|&normal| beside(targets, normal) >= BESIDE);
    let through = |normal: DVec3| {
        let middle = hull.middle(normal);
        let planes = (-4..=4).map(move |shift| Mirror { normal, offset: middle + 0.02 * f64::from(shift) });
        planes.filter(|plane| hull.uncovered(&[|p| plane.point(p)]) <= UNCOVERED).collect::<Vec<_>>()
    };
    normals.flat_map_iter(through).collect()
}

fn directions(targets: &Targets) -> Vec<DVec3> {
    targets.cameras.iter().map(|c| c.center().normalize_or_zero()).collect()
}

fn one_sided(targets: &Targets) -> bool {
    let directions = directions(targets);
    directions.iter().sum::<DVec3>().length() > ONE_SIDED * directions.len() as f64
}

/// How near mirrored photos are to the photos: see [`BESIDE`].
fn beside(targets: &Targets, normal: DVec3) -> f64 {
    let directions = directions(targets);
    let through = Mirror { normal, offset: 0.0 };
    let nearest = |d: DVec3| directions.iter().map(|other| other.dot(through.point(d))).fold(-1.0, f64::max);
    directions.iter().map(|&d| nearest(d)).sum::<f64>() / directions.len() as f64
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;
    use crate::tests::{ball, cameras, own, photograph, photos};
    use freerange_gaussians::channel;

    /// Round Gaussians, so that turning them is no matter.
    fn round(n: usize, seed: u64) -> Gaussians {
        let mut cloud = ball(n, seed);
        for row in cloud.iter_mut() {
            row[channel::LOG_SCALE].fill(-2.4);
            row[channel::LOGIT_OPACITY] = 4.0;
        }
        cloud
    }

    fn behind(cloud: &Gaussians, mirror: &Mirror) -> Gaussians {
        let mut cloud = cloud.clone();
        for row in cloud.iter_mut() {
            let mean = DVec3::from_array([0, 1, 2].map(|i| f64::from(row[channel::MEAN.start + i])));
            row[channel::MEAN].copy_from_slice(&mirror.point(mean).as_vec3().to_array());
        }
        cloud
    }

    /// Its own mirror image.
    fn twins(n: usize, seed: u64, mirror: &Mirror) -> Gaussians {
        let half = round(n, seed);
        let both = half.iter().chain(behind(&half, mirror).iter()).copied().collect::<Vec<_>>();
        Gaussians::from_rows(both.into_iter().flatten().collect())
    }

    const MIRROR: Mirror = Mirror { normal: DVec3::new(0.6, 0.64, 0.48), offset: 0.05 };

    #[test]
    fn a_mirrored_photo_is_one_of_the_mirrored_object() {
        let cloud = round(12, 5);
        let mut camera = cameras(3, 40, 0.0)[1];
        camera.cx += 1.5;
        let seen = MIRROR.view(&photograph(&cloud, &camera));
        let rotation = DMat3::from_mat4(seen.camera.world_to_camera);
        assert!((rotation.determinant() - 1.0).abs() < 1e-12, "a camera is never mirrored");
        assert!(seen.camera.center().abs_diff_eq(MIRROR.point(camera.center()), 1e-12));
        let made = photograph(&behind(&cloud, &MIRROR), &seen.camera);
        let solid =
            |view: &View| view.image.pixels().map(|p| p.0.map(|v| i32::from(v) * i32::from(p[3]) / 255)).collect();
        let (seen, made): (Vec<_>, Vec<_>) = (solid(&seen), solid(&made));
        let apart = |(a, b): (&[i32; 4], &[i32; 4])| (0..4).map(|i| (a[i] - b[i]).abs()).max().unwrap();
        let worst = seen.iter().zip(&made).map(apart).max().unwrap();
        assert!(worst <= 2, "{worst} of 255");
        assert!(MIRROR.point(MIRROR.point(DVec3::new(0.1, 0.2, -0.3))).abs_diff_eq(DVec3::new(0.1, 0.2, -0.3), 1e-12));
    }

    #[test]
    fn what_is_its_own_mirror_image_is_told_from_what_is_not() {
        let config = InitialFitConfig { iterations: 120, gaussians: 150, render_size: 64 };
        let find = |cloud: &Gaussians| {
            find_mirror(&photos(cloud), &own(&photos(cloud), &config), &config, f64::INFINITY, 0, |_| {
                ControlFlow::Continue(())
            })
            .unwrap()
            .unwrap()
        };
        let found = find(&twins(20, 3, &MIRROR));
        let (normal, side) = (found.mirror.normal, found.mirror.normal.dot(MIRROR.normal).signum());
        assert!(normal.angle_between(side * MIRROR.normal) < 0.06, "{found:?}");
        assert!((side * found.mirror.offset - MIRROR.offset).abs() < 0.02, "{found:?}");
        let other = find(&round(40, 7));
        assert!(other.doubt > found.doubt + 0.3, "{other:?} {found:?}");
        let most = other.doubt - 0.01;
        let views = photos(&round(40, 7));
        let none = find_mirror(&views, &own(&views, &config), &config, most, 0, |_| ControlFlow::Continue(()));
        assert!(none.unwrap().is_none_or(|found| found.doubt <= most));
    }

    #[test]
    fn a_mirrored_photo_is_new_where_it_falls_between_photos() {
        let cloud = round(5, 3);
        let at = |quarter: u32| {
            let angle = f64::from(quarter) * PI / 2.0;
            let eye = DVec3::new(1.5 * angle.cos(), 1.5 * angle.sin(), 0.0);
            photograph(&cloud, &Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.857, 16, 16))
        };
        let targets = Targets::new(&[0, 1, 2, 3].map(at), None).unwrap();
        for (turn, cosine) in [(0.0f64, 1.0), (PI / 8.0, 0.5f64.sqrt()), (PI / 4.0, 1.0)] {
            let found = beside(&targets, DVec3::new(turn.cos(), turn.sin(), 0.0));
            assert!((found - cosine).abs() < 1e-9, "{turn}: {found}");
        }
    }

    #[test]
    fn a_comparison_that_ends_early_changes_no_place() {
        let cloud = twins(20, 3, &MIRROR);
        let targets = Targets::new(&photos(&cloud), Some(32)).unwrap();
        let pictures = Pictures::new(&targets, true);
        let near = MIRROR.moved(0, 0.05).moved(2, 0.04);
        let reach = [0.04, 0.001];
        let whole = place(near, reach, |plane, _| pictures.difference(&cloud, Some(plane), f64::INFINITY)).unwrap();
        let early = place(near, reach, |plane, enough| pictures.difference(&cloud, Some(plane), enough)).unwrap();
        assert_eq!(early, whole);
        assert!(early.1.normal.angle_between(MIRROR.normal) < 0.02, "{early:?}");
        // It did end early.
        let part = pictures.difference(&cloud, Some(&near), 0.5 * whole.0).unwrap();
        assert!(part < pictures.difference(&cloud, Some(&near), f64::INFINITY).unwrap());
    }

    #[test]
    fn the_search_is_told_of_and_ends_where_it_is_told_to() {
        let config = InitialFitConfig { iterations: 7, gaussians: 30, render_size: 32 };
        let views = photos(&twins(10, 3, &MIRROR));
        let mut told = Vec::new();
        let own = own(&views, &config);
        find_mirror(&views, &own, &config, f64::INFINITY, 0, |done| {
            told.push(done);
            ControlFlow::Continue(())
        })
        .unwrap();
        assert!(told.len() > told.iter().max().map_or(0, |&last| last), "planes are told of, too");
        assert!(told.windows(2).all(|pair| pair[0] <= pair[1]), "{told:?}");
        told.dedup();
        assert!(told.iter().copied().eq(0..told.len()) && told.len() <= mirror_steps(&config) + 1, "{told:?}");
        for last in [0, 1, 9, 16] {
            let mut reached = 0;
            let found = find_mirror(&views, &own, &config, f64::INFINITY, 0, |done| {
                reached = done;
                if done == last { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            });
            assert!(found.unwrap().is_none() && reached == last, "{last}: {reached}");
        }
        assert!(find_mirror(&[], &own, &config, f64::INFINITY, 0, |_| ControlFlow::Continue(())).is_err());
    }
}
