//! The canonical frame: views into it, Gaussians out of it, and which of the views the network sees.

use freerange_gaussians::Gaussians;
use freerange_scene::camera::{CanonicalFrame, FrameConfig, Similarity, View, canonical_from_user, inputs_around};

use crate::{Error, error::Lift};

/// Restarts of k-means, as in the evaluation.
const RESTARTS: usize = 10;

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
    let frame = canonical_from_user(views, config).lift()?;
    let moved = |v: &View| View { camera: v.camera.transformed(&frame.canonical_from_user), ..v.clone() };
    let canonical = views.iter().map(moved).collect();
    Ok((frame, canonical))
}

/// Takes Gaussians from the canonical frame to the user's.
pub fn to_user(cloud: &Gaussians, canonical_from_user: &Similarity) -> Gaussians {
    let back = canonical_from_user.inverse();
    let mut cloud = cloud.clone();
    cloud.transform(back.scale, back.rotation, back.translation);
    cloud
}
