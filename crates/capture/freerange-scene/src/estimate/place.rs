//! Where the cameras look, and how large what they look at may be.

use super::Hints;
use super::picture::Picture;
use crate::camera::{View, cameras_up};
use glam::{DMat3, DVec3};

/// The point nearest to the optical axes, in front of all cameras.
pub(super) fn meeting_point(views: &[View]) -> Option<DVec3> {
    let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for view in views {
        let d = DMat3::from_mat4(view.camera.world_to_camera).transpose().z_axis;
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        normal += across;
        right += across * view.camera.center();
    }
    // The determinant falls with the squared angle between the axes; 1e-4 is about one degree.
    if normal.determinant() < 1e-4 * (views.len() as f64).powi(3) {
        return None;
    }
    let point = normal.inverse() * right;
    let ahead = |v: &View| (v.camera.world_to_camera * point.extend(1.0)).z > 0.0;
    (point.is_finite() && views.iter().all(ahead)).then_some(point)
}

/// Which way is up, as far as the cameras tell.
pub(super) fn mean_up(views: &[View]) -> DVec3 {
    cameras_up(views).unwrap_or(DVec3::Z)
}

/// How far the ray through a pixel passes by `center`.
fn passes_by(picture: &Picture, center: DVec3, x: f64, y: f64) -> f64 {
    (center - picture.camera.center()).cross(picture.camera.ray_direction(x, y)).length()
}

/// The radius of the sphere about `center` that the object is expected in: the hint's and a little more, or of the largest that half of the
/// views show whole, as objects are shown whole. None where most views do not show its middle.
pub(super) fn expected_radius(pictures: &[Picture], center: DVec3, hints: &Hints) -> Option<f64> {
    let mut radii: Vec<f64> = pictures
        .iter()
        .map(|p| {
            let (w, h) = (p.width() as f64, p.height() as f64);
            let (x, y, z) = p.project(center);
            if z <= 0.0 || x <= 0.0 || y <= 0.0 || x >= w || y >= h {
                return 0.0;
            }
            let border = [(0.0, y), (w, y), (x, 0.0), (x, h)];
            border.iter().map(|(x, y)| passes_by(p, center, *x, *y)).fold(f64::INFINITY, f64::min)
        })
        .collect();
    radii.sort_by(f64::total_cmp);
    let radius = hints.radius.map_or(radii[radii.len() / 2], |r| 1.1 * r);
    (radius > 0.0).then_some(radius)
}

pub(super) fn nearness(picture: &Picture, center: DVec3, radius: f64) -> Vec<f32> {
    let (w, h) = (picture.width(), picture.height());
    let at = |k: usize| passes_by(picture, center, (k % w) as f64 + 0.5, (k / w) as f64 + 0.5);
    (0..w * h).map(|k| (at(k) / radius) as f32).collect()
}
