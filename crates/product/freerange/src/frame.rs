//! The canonical frame: views into it, Gaussians out of it, and which of the views the network sees.

use freerange_gaussians::Gaussians;
use freerange_scene::camera::{
    CANONICAL_RADIUS, CanonicalFrame, FrameConfig, Similarity, View, canonical_from_user, inputs_around, nearest_point,
};
use glam::DVec3;

use crate::{Error, error::Lift};

/// Restarts of k-means, as in the evaluation.
const RESTARTS: usize = 10;
/// Cameras whose distances are no larger than this part of that to the origin may be at one place, and rounded.
const ONE_PLACE: f64 = 1e-3;
/// The same where nothing but the arithmetic can tell them apart.
const EXACTLY: f64 = 1e-12;

/// At most `most` views from all around the object, as the paper's protocol chooses them; ascending.
///
/// # Errors
/// If the cameras do not allow a choice.
pub fn choose_views(views: &[View], most: usize) -> Result<Vec<usize>, Error> {
    let centers: Vec<_> = views.iter().map(|v| v.camera.center()).collect();
    if views.len() <= most {
        return Ok((0..views.len()).collect());
    }
    // Of views from one place the first is enough.
    let size = centers.iter().map(|c| c.distance(centers[0])).fold(0.0, f64::max);
    let mut places: Vec<usize> = Vec::new();
    for i in 0..views.len() {
        if places.iter().all(|&j| centers[i].distance(centers[j]) > 1e-6 * size) {
            places.push(i);
        }
    }
    match places.len() <= most {
        true => Ok(places),
        false => inputs_around(&centers, &places, most, RESTARTS, 0).lift(),
    }
}

/// The views in the canonical frame, and how they got there.
///
/// # Errors
/// If there are fewer than two views, or they do not show one object from different places.
pub fn to_canonical(views: &[View], config: &FrameConfig) -> Result<(CanonicalFrame, Vec<View>), Error> {
    let frame = place(views, config)?;
    let moved = |v: &View| View { camera: v.camera.transformed(&frame.canonical_from_user), ..v.clone() };
    let canonical = views.iter().map(moved).collect();
    Ok((frame, canonical))
}

/// Where the object is, as [`canonical_from_user`] finds it.
///
/// # Errors
/// As there, and where the cameras or the object are next to nothing.
pub(crate) fn place(views: &[View], config: &FrameConfig) -> Result<CanonicalFrame, Error> {
    check_cameras(views)?;
    let frame = canonical_from_user(views, config).lift()?;
    let back = frame.canonical_from_user.inverse();
    let (center, radius) = (back.apply(DVec3::ZERO), CANONICAL_RADIUS * back.scale);
    let pixels = |v: &View| radius * v.camera.fx.max(v.camera.fy) / v.camera.center().distance(center);
    if views.iter().map(pixels).fold(0.0, f64::max) < 1.0 {
        let nearest = views.iter().map(|v| v.camera.center().distance(center)).fold(f64::MAX, f64::min);
        let field = if config.radius.is_some() { "radius" } else { "cameras" };
        let expected = "an object of a pixel or more, seen from around it";
        let found = format!("one of radius {radius:.2e} at a distance of {nearest:.2e} or more");
        return Err(Error::input(field, expected, found));
    }
    Ok(frame)
}

/// Refuses cameras that all stand at one place. Of cameras that look at one point world to camera, taken for camera to
/// world, is just that.
///
/// # Errors
/// Says where.
pub(crate) fn check_cameras(views: &[View]) -> Result<(), Error> {
    let centers: Vec<DVec3> = views.iter().map(|v| v.camera.center()).collect();
    let spread = |points: &[DVec3]| points.iter().map(|p| p.distance(points[0])).fold(0.0, f64::max);
    if views.len() < 2 || centers.iter().any(|c| !c.is_finite()) {
        return Ok(());
    }
    let (apart, reach) = (spread(&centers), centers[0].length());
    // The other way round, do they stand around something? Scenes far away from their origin do not.
    let inverted = || {
        let pose = |v: &View| (v.camera.world_to_camera.w_axis.truncate(), v.camera.world_to_camera.z_axis.truncate());
        let lines: Vec<(DVec3, DVec3)> = views.iter().map(pose).collect();
        let origins: Vec<DVec3> = lines.iter().map(|(origin, _)| *origin).collect();
        spread(&origins) > 0.1 * reach && nearest_point(&lines).is_ok()
    };
    if apart > EXACTLY * reach && (apart > ONE_PLACE * reach || !inverted()) {
        return Ok(());
    }
    let rounded = centers[0].map(|v| (v * 1e4).round() / 1e4 + 0.0);
    let found = format!("all of them at one place, {rounded}: are these world-to-camera matrices?");
    Err(Error::input("cameras", "cameras that stand around one object", found))
}

/// Takes Gaussians from the canonical frame to the user's.
pub fn to_user(cloud: &Gaussians, canonical_from_user: &Similarity) -> Gaussians {
    let back = canonical_from_user.inverse();
    let mut cloud = cloud.clone();
    cloud.transform(back.scale, back.rotation, back.translation);
    cloud
}
