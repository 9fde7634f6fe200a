//! What geometry could still bring: a result with one layer of Gaussians on the object's true surface.
//!
//! In: a result, the true surface and the photos, all in the frame of the cameras. Out: flat opaque Gaussians wherever a photo
//! sees the surface, in the photos' colors, and the result's own Gaussians elsewhere.

use freerange::View;
use freerange_eval::{MeshSurface, Nearest};
use freerange_gaussians::{Gaussians, channel};
use glam::{DVec3, Quat, Vec3};
use rayon::prelude::*;

/// Points spread over the whole surface: as many as the default has Gaussians.
const POINTS: usize = 16_384;
/// Standard deviations of a Gaussian along the surface and across it, in distances between points.
const ALONG: f64 = 0.6;
const ACROSS: f64 = 0.1;
const OPACITY: f64 = 0.95;
/// Gaussians of the result stay where they are farther from the layer than so many distances between points.
const NEAR: f64 = 2.0;
/// Power of the cosine between normal and line of sight by which photos are weighted.
const POWER: i32 = 4;
/// Alpha of pixels of the object.
const SOLID: u8 = 250;

/// `result` with a layer on the true surface, as far as photos see it.
pub fn on_true_surface(result: &Gaussians, truth: &MeshSurface, photos: &[View]) -> Gaussians {
    let spacing = (truth.area() / POINTS as f64).sqrt();
    let layer =
        |(point, normal): (Vec3, Vec3)| Some(disc(point, normal, color(truth, photos, point, normal)?, spacing));
    let layer: Vec<[f32; channel::COUNT]> = truth.samples(POINTS).into_par_iter().filter_map(layer).collect();
    let kept = |row: &&[f32; channel::COUNT]| {
        let Nearest { point, normal, distance } = truth.nearest(Vec3::from_slice(&row[channel::MEAN]));
        f64::from(distance.abs()) > NEAR * spacing || color(truth, photos, point, normal).is_none()
    };
    let kept: Vec<_> = result.rows().as_chunks().0.par_iter().filter(kept).collect();
    Gaussians::from_rows(layer.iter().chain(kept).flatten().copied().collect())
}

/// The color that photos have of a point of the surface; none if none sees it.
fn color(truth: &MeshSurface, photos: &[View], point: Vec3, normal: Vec3) -> Option<DVec3> {
    let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
    for View { camera, image, .. } in photos {
        let to_eye = (camera.center().as_vec3() - point).normalize_or_zero();
        // Sheets have two sides, and some meshes face inward.
        let facing = if normal.dot(to_eye) < 0.0 { -normal } else { normal };
        if !truth.sees(camera.center().as_vec3(), &Nearest { point, normal: facing, distance: 0.0 }) {
            continue;
        }
        let p = camera.world_to_camera.transform_point3(point.as_dvec3());
        let (x, y) = (p.x / p.z * camera.fx + camera.cx - 0.5, p.y / p.z * camera.fy + camera.cy - 0.5);
        let inside = |at: f64, side: u32| at >= 0.0 && at < f64::from(side - 1);
        if p.z <= 0.0 || !inside(x, image.width()) || !inside(y, image.height()) {
            continue;
        }
        let corners = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| image.get_pixel(x as u32 + dx, y as u32 + dy).0);
        if corners.iter().any(|pixel| pixel[3] < SOLID) {
            continue;
        }
        let [a, b, c, d] = corners.map(|[r, g, b, _]| DVec3::from([r, g, b].map(f64::from)) / 255.0);
        let w = f64::from(facing.dot(to_eye)).powi(POWER);
        sum += w * a.lerp(b, x.fract()).lerp(c.lerp(d, x.fract()), y.fract());
        weight += w;
    }
    (weight > 0.0).then(|| sum / weight)
}

/// A flat Gaussian.
fn disc(point: Vec3, normal: Vec3, color: DVec3, spacing: f64) -> [f32; channel::COUNT] {
    let mut row = [0.0; channel::COUNT];
    row[channel::MEAN].copy_from_slice(&point.to_array());
    let [along, across] = [ALONG, ACROSS].map(|part| (part * spacing).ln() as f32);
    row[channel::LOG_SCALE].copy_from_slice(&[along, along, across]);
    let turn = Quat::from_rotation_arc(Vec3::Z, normal);
    row[channel::ROTATION].copy_from_slice(&[turn.w, turn.x, turn.y, turn.z]);
    row[channel::LOGIT_OPACITY] = (OPACITY / (1.0 - OPACITY)).ln() as f32;
    row[channel::COLOR].copy_from_slice(&color.as_vec3().to_array());
    row
}

#[cfg(test)]
mod tests {
    use freerange_assets::mesh::Mesh;
    use freerange_scene::camera::Camera;
    use image::{Rgba, RgbaImage};

    use super::*;

    /// A cube of side 0.6, of triangles that face outward.
    fn cube() -> MeshSurface {
        let mut mesh = Mesh::default();
        for corner in 0..8u32 {
            mesh.positions.push(Vec3::from_array([0, 1, 2].map(|i| if corner >> i & 1 == 1 { 0.3 } else { -0.3 })));
        }
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        mesh.triangles = quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        MeshSurface::new(&mesh)
    }

    #[test]
    fn what_a_photo_sees_lies_on_the_surface_in_its_colors_and_the_rest_stays() {
        let truth = cube();
        let camera = Camera::look_at(DVec3::new(0.0, -2.0, 0.0), DVec3::ZERO, DVec3::Z, 0.6, 64, 64);
        let image =
            RgbaImage::from_fn(64, 64, |x, _| if x < 32 { Rgba([255, 0, 0, 255]) } else { Rgba([0, 0, 255, 255]) });
        let photo = View { name: "photo".into(), camera, image };
        // In front of the side that is seen, and behind the object.
        let own = [[0.0, -0.301, 0.1], [0.1, 0.3, 0.0]];
        let result: Vec<f32> = own.iter().flat_map(|p| disc(Vec3::from_array(*p), Vec3::Z, DVec3::ZERO, 0.1)).collect();
        let found = on_true_surface(&Gaussians::from_rows(result.clone()), &truth, std::slice::from_ref(&photo));
        let layer = found.len() - 1;
        assert!((layer as f64 - POINTS as f64 / 6.0).abs() < 30.0, "{layer}");
        assert_eq!(found.rows()[layer * channel::COUNT..], result[channel::COUNT..]);
        for i in 0..layer {
            let (at, color) = (found.mean(i), found.color(i));
            assert!((at.y + 0.3).abs() < 1e-6, "{at}");
            assert!((found.rotation(i) * DVec3::Z).y.abs() > 0.999);
            if at.x.abs() > 0.02 {
                let expected = if at.x < 0.0 { DVec3::X } else { DVec3::Z };
                assert!(color.distance(expected) < 1e-6, "{at}: {color}");
            }
        }
        // Where no photo shows the object, nothing is laid.
        let nothing = View { image: RgbaImage::new(64, 64), ..photo };
        assert_eq!(on_true_surface(&Gaussians::from_rows(result.clone()), &truth, &[nothing]).rows(), result);
    }
}
