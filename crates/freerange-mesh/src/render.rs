use freerange_camera::Camera;
use glam::{DMat3, Vec3};
use image::{Rgba, RgbaImage};

use crate::scene::Scene;
use crate::texture::linear_to_srgb;

/// Renders a view with `samples_per_axis` squared samples per pixel (at least one): straight alpha, sRGB-encoded,
/// transparent black where nothing is hit. Runs on the calling thread.
pub fn render(scene: &Scene, camera: &Camera, samples_per_axis: u32) -> RgbaImage {
    let n = samples_per_axis.max(1);
    let mut image = RgbaImage::new(camera.width, camera.height);
    let rotation = DMat3::from_mat4(camera.world_to_camera).transpose().as_mat3();
    let origin = camera.center().as_vec3();
    let scale = [1.0 / camera.fx as f32, 1.0 / camera.fy as f32];
    let (cx, cy) = (camera.cx as f32, camera.cy as f32);
    let [x0, y0, x1, y1] = window(scene, camera);
    for y in y0..y1 {
        for x in x0..x1 {
            let (mut sum, mut hits) = (Vec3::ZERO, 0u32);
            for k in 0..n * n {
                let px = x as f32 + ((k % n) as f32 + 0.5) / n as f32;
                let py = y as f32 + ((k / n) as f32 + 0.5) / n as f32;
                let direction = (rotation * Vec3::new((px - cx) * scale[0], (py - cy) * scale[1], 1.0)).normalize();
                if let Some(hit) = scene.intersect(origin, direction) {
                    let surface = scene.surface(hit.triangle as usize, hit.bary);
                    // Clamped per sample: a highlight must not bleed over the silhouette.
                    sum += scene.radiance(&surface, -direction).clamp(Vec3::ZERO, Vec3::ONE);
                    hits += 1;
                }
            }
            if hits > 0 {
                let c = sum / hits as f32;
                let code = |v: f32| (255.0 * linear_to_srgb(v) + 0.5) as u8;
                let alpha = (255.0 * hits as f32 / (n * n) as f32 + 0.5) as u8;
                image.put_pixel(x, y, Rgba([code(c.x), code(c.y), code(c.z), alpha]));
            }
        }
    }
    image
}

/// Pixel rectangle [x0, y0, x1, y1) that holds the object's projection.
fn window(scene: &Scene, camera: &Camera) -> [u32; 4] {
    let (lo, hi) = scene.bounds();
    let (mut min, mut max) = ([f64::MAX; 2], [f64::MIN; 2]);
    for corner in 0..8 {
        let pick = |axis: usize| f64::from(if corner >> axis & 1 == 0 { lo[axis] } else { hi[axis] });
        let p = camera.world_to_camera.transform_point3(glam::DVec3::new(pick(0), pick(1), pick(2)));
        if p.z < 1e-3 {
            return [0, 0, camera.width, camera.height];
        }
        let q = [camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy];
        for axis in 0..2 {
            min[axis] = min[axis].min(q[axis]);
            max[axis] = max[axis].max(q[axis]);
        }
    }
    // Casts saturate, so projections outside the image give an empty or full range.
    let (w, h) = (camera.width, camera.height);
    [
        ((min[0] - 1.0).floor() as u32).min(w),
        ((min[1] - 1.0).floor() as u32).min(h),
        ((max[0] + 1.0).ceil() as u32).min(w),
        ((max[1] + 1.0).ceil() as u32).min(h),
    ]
}
