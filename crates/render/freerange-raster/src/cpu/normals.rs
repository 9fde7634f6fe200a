//! Normals of a depth map.

use freerange_scene::camera::Camera;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Unit normals of the surface that a depth map shows, `[height, width]`, in camera coordinates (x right, y down, z
/// forward), toward the camera; zero where the map has no surface.
///
/// `depth` is camera z per pixel, infinite where nothing is, as [`surface_depth`](crate::surface_depth) returns it.
/// Along each axis of the image the neighbor whose depth is nearer spans the tangent plane, so that a normal does not
/// reach over an edge behind which the surface goes on farther away.
///
/// # Panics
/// If `depth` has not `height * width` values.
pub fn surface_normals(depth: &[f32], camera: &Camera) -> Vec<[f32; 3]> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    assert_eq!(depth.len(), width * height, "one depth per pixel");
    let at = |x: usize, y: usize| -> Option<DVec3> {
        let z = f64::from(*depth.get(y * width + x).filter(|z| x < width && z.is_finite())?);
        let (x, y) = ((x as f64 + 0.5 - camera.cx) / camera.fx, (y as f64 + 0.5 - camera.cy) / camera.fy);
        Some(DVec3::new(x * z, y * z, z))
    };
    let normal = |x: usize, y: usize| -> Option<Vec3> {
        let here = at(x, y)?;
        // Before and behind along one axis: the tangent from the nearer one, in the direction of the axis.
        let tangent = |before: Option<DVec3>, behind: Option<DVec3>| match (before, behind) {
            (Some(a), Some(b)) if (a.z - here.z).abs() < (b.z - here.z).abs() => Some(here - a),
            (_, Some(b)) => Some(b - here),
            (Some(a), None) => Some(here - a),
            (None, None) => None,
        };
        let across = tangent(x.checked_sub(1).and_then(|x| at(x, y)), at(x + 1, y))?;
        let down = tangent(y.checked_sub(1).and_then(|y| at(x, y)), at(x, y + 1))?;
        let normal = down.cross(across).try_normalize()?;
        Some(normal.as_vec3())
    };
    (0..width * height).into_par_iter().map(|i| normal(i % width, i / width).unwrap_or(Vec3::ZERO).to_array()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        Camera::look_at(DVec3::new(0.0, -2.0, 0.0), DVec3::ZERO, DVec3::Z, 0.8, 64, 48)
    }

    /// Depth of the plane `normal . p = offset` in camera coordinates.
    fn plane(camera: &Camera, normal: DVec3, offset: f64) -> Vec<f32> {
        let ray = |i: u32| {
            let (x, y) = (f64::from(i % camera.width) + 0.5, f64::from(i / camera.width) + 0.5);
            DVec3::new((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0)
        };
        (0..camera.width * camera.height).map(|i| (offset / normal.dot(ray(i))) as f32).collect()
    }

    #[test]
    fn a_plane_has_one_normal() {
        let camera = camera();
        for tilt in [DVec3::new(0.0, 0.0, -1.0), DVec3::new(0.5, -0.3, -1.0), DVec3::new(-0.8, 0.7, -1.0)] {
            let tilt = tilt.normalize();
            for found in surface_normals(&plane(&camera, tilt, 2.0 * tilt.z), &camera) {
                assert!(Vec3::from_array(found).as_dvec3().distance(tilt) < 1e-3, "{found:?}, {tilt}");
            }
        }
    }

    #[test]
    fn normals_do_not_reach_over_edges() {
        let camera = camera();
        let mut depth = plane(&camera, DVec3::NEG_Z, -2.0);
        let (width, far) = (camera.width as usize, plane(&camera, DVec3::NEG_Z, -3.0));
        for (i, z) in depth.iter_mut().enumerate() {
            match (i % width, i / width) {
                (x, _) if x >= 40 => *z = far[i],
                (_, y) if y < 10 => *z = f32::INFINITY,
                _ => {}
            }
        }
        let normals = surface_normals(&depth, &camera);
        for (i, (normal, z)) in normals.iter().zip(&depth).enumerate() {
            let expected = if z.is_finite() { Vec3::NEG_Z } else { Vec3::ZERO };
            assert!(Vec3::from_array(*normal).distance(expected) < 1e-4, "pixel {i}: {normal:?}");
        }
    }
}
