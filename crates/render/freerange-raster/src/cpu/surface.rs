//! Where the surface is that Gaussians show: the depth at which a ray has lost half of its light.

use super::{
    Pinhole,
    bin::BAND,
    check, prepare,
    project::{LOG2_255, Splat},
};
use crate::{CHANNELS, RasterConfig, RasterError};
use freerange_scene::camera::Camera;
use glam::{DMat3, DQuat, DVec3, Mat3, Vec3};
use rayon::prelude::*;

/// Highest opacity of a splat at a pixel, as in [`crate::render`].
const MAX_ALPHA: f32 = 0.99;
/// What lies behind where so little light is left does not move the surface.
const DARK: f32 = 0.05;
/// Halvings of the stretch of a ray in which the surface is: to a thousandth of it.
const HALVINGS: usize = 10;

/// Camera z of the surface at each pixel, `[height, width]`; infinite where half of the light or more passes.
///
/// Gaussians are seen as by [`crate::render`], but each takes its light from the ray gradually: before the place where it
/// is densest along the ray, as much less as it is less dense there. The surface is where half of the light is left. It agrees
/// with the outlines that the same Gaussians show: Gaussians that fill an outline have their centers inside the surface
/// by about their own thickness. Hence neither the mean depth nor that of the center that takes the light below a half will do.
///
/// # Errors
/// As [`crate::render`].
pub fn surface_depth(gaussians: &[f32], camera: &Camera, config: &RasterConfig) -> Result<Vec<f32>, RasterError> {
    let [width, height] = check(gaussians, &[*camera], &[[0.0; 3]], config)?;
    let bands = prepare(gaussians, &Pinhole::new(camera), [width, height], config);
    let mut depth = vec![f32::INFINITY; width * height];
    let rows = depth.par_chunks_mut(width * BAND).zip(bands).enumerate();
    rows.for_each(|(band, (depth, splats))| {
        let top = band * BAND;
        let mut pixels = vec![Pixel { light: 1.0, veils: Vec::new() }; depth.len()];
        for splat in &splats {
            let shape = Shape::new(&gaussians[splat.index as usize * CHANNELS..][..CHANNELS], camera);
            cover(splat, [width, depth.len() / width], top, |x, y, alpha| {
                let pixel = &mut pixels[(y - top) * width + x];
                if pixel.light >= DARK {
                    pixel.light *= 1.0 - alpha;
                    pixel.veils.push(shape.veil(camera, x, y, alpha));
                }
            });
        }
        depth.iter_mut().zip(&pixels).filter(|(_, p)| p.light < 0.5).for_each(|(depth, p)| *depth = p.half());
    });
    Ok(depth)
}

/// Calls `f(x, y, alpha)` for every pixel of a band, `[width, height]` from row `top` on, at which a splat has an opacity of at least 1/255.
fn cover(s: &Splat, [width, height]: [usize; 2], top: usize, mut f: impl FnMut(usize, usize, f32)) {
    for y in usize::from(s.rows[0]).max(top)..=usize::from(s.rows[1]).min(top + height - 1) {
        let dy = y as f32 + 0.5 - s.y;
        let half = s.half_width * (1.0 - (dy / s.half_height).powi(2)).max(0.0).sqrt();
        let middle = s.x + s.slope * dy - 0.5;
        let left = (middle - half).ceil().max(0.0) as usize;
        let right = ((middle + half).floor() + 1.0).clamp(0.0, width as f32) as usize;
        for x in left..right {
            let dx = x as f32 + 0.5 - s.x;
            let (u, v) = (s.l11 * dx + s.l21 * dy, s.l22 * dy);
            let exponent = s.log2_opacity - u * u - v * v;
            if exponent >= -LOG2_255 {
                f(x, y, exponent.exp2().min(MAX_ALPHA));
            }
        }
    }
}

/// What a Gaussian does to the light of one ray.
#[derive(Clone, Copy)]
struct Veil {
    /// The part that it takes in all.
    alpha: f32,
    /// Camera z at which it is densest.
    middle: f32,
    /// Its standard deviation along the ray, in camera z.
    deviation: f32,
}

#[derive(Clone)]
struct Pixel {
    light: f32,
    veils: Vec<Veil>,
}

impl Pixel {
    /// The light at camera z.
    fn light_at(&self, z: f32) -> f32 {
        let left = |v: &Veil| {
            let before = ((v.middle - z) / v.deviation).max(0.0);
            1.0 - v.alpha * (-0.5 * before * before).exp()
        };
        self.veils.iter().map(left).product()
    }

    /// Camera z at which half of the light is left, which it is somewhere.
    fn half(&self) -> f32 {
        let first = self.veils.iter().map(|v| v.middle - 3.0 * v.deviation).fold(f32::INFINITY, f32::min);
        let last = self.veils.iter().map(|v| v.middle).fold(f32::NEG_INFINITY, f32::max);
        let (mut low, mut high) = (first, last);
        for _ in 0..HALVINGS {
            let z = 0.5 * (low + high);
            *(if self.light_at(z) < 0.5 { &mut high } else { &mut low }) = z;
        }
        0.5 * (low + high)
    }
}

/// A Gaussian in camera coordinates.
struct Shape {
    /// From camera coordinates to where it is a standard normal distribution about `center`.
    to_local: Mat3,
    center: Vec3,
    /// Camera z of its center, and three of its largest standard deviations: what a ray that passes a flat one far from its center says
    /// of it ends there.
    z: f32,
    reach: f32,
}

impl Shape {
    fn new(row: &[f32], camera: &Camera) -> Self {
        let value = |c: usize| f64::from(row[c]);
        let to_camera = DMat3::from_mat4(camera.world_to_camera);
        let mean = camera.world_to_camera.transform_point3(DVec3::new(value(0), value(1), value(2)));
        let scale = DVec3::new(value(3), value(4), value(5)).exp().max(DVec3::splat(1e-6));
        let local = DMat3::from_quat(DQuat::from_xyzw(value(7), value(8), value(9), value(6)).normalize());
        let to_local = DMat3::from_diagonal(scale.recip()) * (to_camera * local).transpose();
        Self {
            to_local: to_local.as_mat3(),
            center: (to_local * mean).as_vec3(),
            z: mean.z as f32,
            reach: 3.0 * scale.max_element() as f32,
        }
    }

    fn veil(&self, camera: &Camera, x: usize, y: usize, alpha: f32) -> Veil {
        let ray = [(x as f64 + 0.5 - camera.cx) / camera.fx, (y as f64 + 0.5 - camera.cy) / camera.fy, 1.0];
        let ray = self.to_local * DVec3::from_array(ray).as_vec3();
        let length = ray.length();
        let middle = ray.dot(self.center) / (length * length);
        Veil { alpha, middle: middle.clamp(self.z - self.reach, self.z + self.reach), deviation: 1.0 / length }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: u32 = 96;

    fn camera() -> Camera {
        Camera::look_at(DVec3::new(0.3, -2.0, 0.6), DVec3::ZERO, DVec3::Z, 0.7, SIZE, SIZE)
    }

    /// Flat Gaussians on a sphere of radius 0.5.
    fn sphere(thickness: f32, logit: f32) -> Vec<f32> {
        let count = 6000;
        let row = |i| {
            let z = 1.0 - f64::from(2 * i + 1) / f64::from(count);
            let (r, angle) = ((1.0 - z * z).sqrt(), 2.399_963_2 * f64::from(i));
            let normal = DVec3::new(r * angle.cos(), r * angle.sin(), z);
            let q = DQuat::from_rotation_arc(DVec3::Z, normal).as_quat();
            let [x, y, z] = (0.5 * normal).as_vec3().to_array();
            let (wide, thin) = (0.015f32.ln(), thickness.ln());
            [x, y, z, wide, wide, thin, q.w, q.x, q.y, q.z, logit, 0.5, 0.5, 0.5]
        };
        (0..count).flat_map(row).collect()
    }

    #[test]
    fn a_sphere_of_flat_gaussians_is_where_it_is() {
        for logit in [4.0, 0.0] {
            let (camera, mut hit) = (camera(), 0);
            let depth = surface_depth(&sphere(1e-3, logit), &camera, &RasterConfig::default()).unwrap();
            let eye = camera.center();
            for (i, z) in depth.iter().enumerate().filter(|(_, z)| z.is_finite()) {
                let (x, y) = (i as u32 % SIZE, i as u32 / SIZE);
                let ray = camera.ray_direction(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let b = eye.dot(ray);
                // Not near the outline, where any error is large along the ray.
                let Some(root) = Some(b * b - eye.length_squared() + 0.25).filter(|d| *d > 0.05) else { continue };
                let truth = camera.world_to_camera.transform_point3(eye + ray * (-b - root.sqrt())).z;
                hit += 1;
                assert!((f64::from(*z) - truth).abs() < 0.007, "{z} {truth} at logit {logit}");
            }
            assert!(hit > 2000, "{hit} pixels");
        }
    }

    /// Thick Gaussians show an outline outside their centers, and so is their surface.
    #[test]
    fn the_surface_is_between_the_centers_and_the_outline() {
        let (rows, camera) = (sphere(0.01, 2.0), camera());
        let middle = (SIZE / 2 * SIZE) as usize;
        let z = surface_depth(&rows, &camera, &RasterConfig::default()).unwrap()[middle + SIZE as usize / 2];
        let front = camera.center().length() - f64::from(z);
        let alpha = crate::render(&rows, &[camera], &[[0.0; 3]], &RasterConfig::default()).unwrap().alpha;
        let row = &alpha[middle..middle + SIZE as usize];
        let first = row.iter().position(|a| *a >= 0.5).unwrap();
        let edge = first as f64 + 0.5 - f64::from((row[first] - 0.5) / (row[first] - row[first - 1]));
        let outline = ((camera.cx - edge) / camera.fx).atan().sin() * camera.center().length();
        assert!(front > 0.505 && front < outline + 0.003, "{front} {outline}");
        assert!(outline < 0.55, "{outline}");
    }

    #[test]
    fn what_half_of_the_light_passes_has_no_surface() {
        let row = |y: f32, logit: f32| [0.0, y, 0.0, -2.0, -2.0, -2.0, 1.0, 0.0, 0.0, 0.0, logit, 0.5, 0.5, 0.5];
        let camera = Camera::look_at(DVec3::new(0.0, -2.0, 0.0), DVec3::ZERO, DVec3::Z, 0.7, 9, 9);
        let at =
            |rows: &[[f32; 14]]| surface_depth(rows.as_flattened(), &camera, &RasterConfig::default()).unwrap()[40];
        assert_eq!(at(&[]), f32::INFINITY);
        assert_eq!(at(&[row(0.0, -0.1)]), f32::INFINITY);
        // In whatever order, and whatever lies behind.
        let (first, second, last) = (row(-0.5, -0.1), row(0.25, -0.1), row(0.8, 5.0));
        // 0.525 of the light is left behind the first; 0.5 is where the second has taken a tenth of its part, 2.16 standard deviations
        // before its center, and the last one a twentieth, 2.46 before.
        let z = at(&[last, second, first]);
        assert!((z - (2.25 - 2.16 * (-2f32).exp())).abs() < 0.005 && z == at(&[first, second, last]), "{z}");
        assert!((at(&[last, first]) - (2.8 - 2.46 * (-2f32).exp())).abs() < 0.005);
        assert!(surface_depth(&[0.0; 13], &camera, &RasterConfig::default()).is_err());
    }
}
