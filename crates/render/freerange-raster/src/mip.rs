//! Gaussians fitted as Mip-Splatting does, which lowers opacities by as much as the blur in the image widens.

use freerange_scene::camera::Camera;
use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::CHANNELS;

/// The channel of the opacity's logit.
const LOGIT_OPACITY: usize = 10;

/// The blur that such Gaussians are drawn with, in square pixels.
pub const MIP_BLUR: f32 = 0.1;

/// `gaussians`, `[n, 14]`, with the opacities that they are drawn with from `camera` under a blur of `blur` square
/// pixels: times the root of the ratio of the projected areas' squares without and with the blur.
pub fn mip_compensated(gaussians: &[f32], camera: &Camera, blur: f32) -> Vec<f32> {
    let mut out = gaussians.to_vec();
    for row in out.as_chunks_mut::<CHANNELS>().0 {
        let opacity = 1.0 / (1.0 + (-f64::from(row[LOGIT_OPACITY])).exp());
        let lowered = (opacity * factor(row, camera, blur.into())).clamp(1e-12, 1.0 - 1e-12);
        row[LOGIT_OPACITY] = (lowered / (1.0 - lowered)).ln() as f32;
    }
    out
}

/// The factor of one Gaussian; 1 of one behind the camera, which is not drawn.
fn factor(row: &[f32; CHANNELS], camera: &Camera, blur: f64) -> f64 {
    let at = |c: usize| f64::from(row[c]);
    let p = camera.world_to_camera.transform_point3(DVec3::new(at(0), at(1), at(2)));
    if p.z <= 0.0 {
        return 1.0;
    }
    // Linearised at the mean, but not further out than the rasterizer does.
    let size = DVec2::new(camera.width.into(), camera.height.into());
    let (focal, center) = (DVec2::new(camera.fx, camera.fy), DVec2::new(camera.cx, camera.cy));
    let slope = (p.truncate() / p.z).clamp(-(center + 0.15 * size) / focal, (size - center + 0.15 * size) / focal);
    let rotation = DQuat::from_xyzw(at(7), at(8), at(9), at(6)).normalize();
    let scale = DVec3::new(at(3), at(4), at(5)).exp();
    let axes = DMat3::from_mat4(camera.world_to_camera) * DMat3::from_quat(rotation) * DMat3::from_diagonal(scale);
    let rows = axes.transpose();
    let x = (rows.x_axis - slope.x * rows.z_axis) * focal.x / p.z;
    let y = (rows.y_axis - slope.y * rows.z_axis) * focal.y / p.z;
    // The determinant of a sum of squares, without cancellation for needles.
    let plain = x.cross(y).length_squared();
    let blurred = plain + blur * (x.length_squared() + y.length_squared() + blur);
    if blurred > 0.0 { (plain / blurred).sqrt() } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RasterConfig, render};

    #[test]
    fn a_small_gaussian_far_away_keeps_its_light_however_it_is_blurred() {
        let camera = Camera::look_at(DVec3::new(0.0, -4.0, 0.5), DVec3::ZERO, DVec3::Z, 0.9, 64, 64);
        // Deviations of a quarter to one and a half pixels, turned.
        let row: Vec<f32> = [0.03, 0.02, -0.05, -4.5, -3.4, -2.9, 0.8, 0.3, -0.4, 0.3, 0.0, 1.0, 1.0, 1.0].into();
        let light = |blur: f32, rows: &[f32]| -> f64 {
            let config = RasterConfig { blur, ..RasterConfig::default() };
            let image = render(rows, &[camera], &[[0.0; 3]], &config).unwrap();
            image.rgb.iter().map(|v| f64::from(*v)).sum()
        };
        let plain = light(1e-4, &row);
        for blur in [0.1, 0.3, 1.0] {
            let kept = light(blur, &mip_compensated(&row, &camera, blur));
            let without = light(blur, &row);
            assert!((kept / plain - 1.0).abs() < 0.05, "{blur}: {kept} of {plain}");
            assert!(without > 1.1 * kept || blur < 0.2, "{blur}: {without} {kept}");
        }
        assert_eq!(mip_compensated(&row, &camera, 0.0)[..10], row[..10]);
    }
}
