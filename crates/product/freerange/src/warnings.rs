//! What may go wrong with photos and cameras, before anything is computed.

use freerange_scene::camera::{Camera, FrameConfig, View};
use freerange_scene::{Loaded, inspect::view_warnings};
use freerange_util::Note;
use glam::DVec3;

use crate::{Error, choose_views, frame};

/// Poses that differ by no more than this, of radians and of the distances between cameras, are the same.
const SAME: f64 = 1e-6;
/// Principal points farther from the middle than this part of the side are pointed out. Intrinsics of photos of half
/// the size are off by a quarter.
const OFF_CENTER: f64 = 0.24;

/// What may go wrong with these photos and masks, where the network sees up to `network_views` of them. `frame` says
/// what is known of the object's place, as [`Scene::frame`](crate::Scene::frame).
///
/// # Errors
/// If the views do not show one object from different places.
pub fn warnings_of(loaded: &Loaded, frame: &FrameConfig, network_views: usize) -> Result<Vec<Note>, Error> {
    let views = &loaded.views;
    let place = frame::place(views, frame)?;
    let shown = choose_views(views, network_views)?;
    let told = view_warnings(loaded, &place, &shown).into_iter();
    Ok(told.chain(same_poses(views)).chain(off_center(views)).map(Note::warning).collect())
}

/// Different photos with the same pose.
fn same_poses(views: &[View]) -> Option<String> {
    let centers: Vec<DVec3> = views.iter().map(|v| v.camera.center()).collect();
    let size = centers.iter().map(|c| c.distance(*centers.first().unwrap_or(c))).fold(0.0, f64::max);
    let axes = |c: &Camera, o: &Camera| {
        [(c.world_to_camera.x_axis, o.world_to_camera.x_axis), (c.world_to_camera.z_axis, o.world_to_camera.z_axis)]
    };
    let same = |i: usize, j: usize| {
        centers[i].distance(centers[j]) <= SAME * size
            && axes(&views[i].camera, &views[j].camera).iter().all(|(a, b)| a.distance(*b) <= SAME)
            && views[i].image != views[j].image
    };
    let pairs = || (0..views.len()).flat_map(|j| (0..j).map(move |i| (i, j)));
    let mut found = pairs().filter(|(i, j)| same(*i, *j));
    let (i, j) = found.next()?;
    let more = match found.count() {
        0 => String::new(),
        n => format!(", and {n} further pairs"),
    };
    Some(format!("different photos have the same pose: {} and {}{more}", views[i].name, views[j].name))
}

/// Most photos whose principal point lies far from the middle.
fn off_center(views: &[View]) -> Option<String> {
    let off = |v: &&View| {
        let part = |c: f64, side: u32| (c / f64::from(side.max(1)) - 0.5).abs();
        part(v.camera.cx, v.camera.width).max(part(v.camera.cy, v.camera.height)) > OFF_CENTER
    };
    let found: Vec<&View> = views.iter().filter(off).collect();
    let first = found.first().filter(|_| 2 * found.len() > views.len())?;
    let Camera { cx, cy, width, height, .. } = first.camera;
    Some(format!(
        "the principal point is far from the middle of {} of {} photos, ({cx:.1}, {cy:.1}) in {width} x {height} \
         pixels of {}: are the intrinsics of photos of another size?",
        found.len(),
        views.len(),
        first.name
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{Rgba, RgbaImage};

    fn view(i: u32, shade: u8) -> View {
        let (sin, cos) = f64::from(i).sin_cos();
        let camera = Camera::look_at(DVec3::new(1.5 * cos, 1.5 * sin, 0.5), DVec3::ZERO, DVec3::Z, 0.8, 16, 8);
        View { name: format!("v{i}"), camera, image: RgbaImage::from_pixel(16, 8, Rgba([shade; 4])) }
    }

    #[test]
    fn one_pose_of_two_photos_is_pointed_out() {
        let mut views: Vec<View> = (0..4).map(|i| view(i, i as u8)).collect();
        assert_eq!(same_poses(&views), None);
        assert_eq!(same_poses(&[]), None);
        views[3].camera = views[1].camera;
        assert_eq!(same_poses(&views).unwrap(), "different photos have the same pose: v1 and v3");
        views[2].camera = views[1].camera;
        assert!(same_poses(&views).unwrap().contains("v1 and v2, and 2 further pairs"));
        // The same photo twice says nothing false.
        assert_eq!(same_poses(&[view(0, 7), view(1, 7), view(0, 7)]), None);
    }

    #[test]
    fn intrinsics_of_another_size_are_pointed_out() {
        let scaled = |factor: f64, count: usize| {
            let mut views: Vec<View> = (0..4).map(|i| view(i, 0)).collect();
            for v in &mut views[..count] {
                let c = v.camera;
                v.camera = Camera { fx: factor * c.fx, fy: factor * c.fy, cx: factor * c.cx, cy: factor * c.cy, ..c };
            }
            off_center(&views)
        };
        assert_eq!((scaled(1.0, 4), scaled(0.5, 2), off_center(&[])), (None, None, None));
        assert!(scaled(0.5, 3).unwrap().contains("3 of 4 photos, (4.0, 2.0) in 16 x 8 pixels of v0"));
        assert!(scaled(2.0, 4).is_some() && scaled(1.3, 4).is_none());
    }
}
