//! Depth renders from all around, fused into a grid.

use freerange_gaussians::Splats;
use freerange_raster::{RasterConfig, render};
use freerange_scene::camera::{Camera, pixel_of};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::meshing::{Shape, SurfaceError, decimate::decimate, iso_surface, texture::bake};

/// Settings of [`mesh_of`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeshConfig {
    /// Voxels along the longest side of the object, 8 to 512.
    pub voxels: usize,
    /// Cameras around the object.
    pub views: usize,
    /// Width and height of their renders, in pixels.
    pub pixels: u32,
    /// Most triangles; `None` for as many as the voxels give, or 20,000 with a texture.
    pub triangles: Option<usize>,
    /// Width and greatest height of a texture, in texels; `None` for vertex colors.
    pub texture: Option<usize>,
}

/// Most triangles of a mesh with a texture, if no other number is asked for.
pub const TEXTURED: usize = 20_000;

impl Default for MeshConfig {
    fn default() -> Self {
        Self { voxels: 160, views: 60, pixels: 400, triangles: None, texture: None }
    }
}

/// Widths and heights of renders that a texture is taken from are its own, up to this.
const FINEST: usize = 1024;
/// Distances are cut off at so many voxels.
const BAND: f64 = 4.0;
/// A pixel shows a surface where it is at least so opaque, and the background where it is less than half of that.
const OPAQUE: f32 = 0.5;
/// Parts with less than this share of the largest part's area are left out.
const PART: f64 = 0.01;
/// The cameras' field of view, in radians.
const FIELD_OF_VIEW: f64 = 0.6;

impl MeshConfig {
    fn check(&self) -> Result<(), SurfaceError> {
        let within = |setting, expected: &str, range: std::ops::RangeInclusive<usize>, found| {
            let wrong = SurfaceError::Setting { setting, expected: expected.into(), found };
            if range.contains(&found) { Ok(()) } else { Err(wrong) }
        };
        within("voxels", "8 to 512 along the longest side", 8..=512, self.voxels)?;
        within("triangles", "at least 4", 4..=usize::MAX, self.triangles.unwrap_or(4))?;
        within("texture", "64 to 4096 texels", 64..=4096, self.texture.unwrap_or(64))
    }
}

/// A closed mesh of the Gaussians, seen from all around, with colors.
///
/// # Errors
/// [`SurfaceError::Setting`]; [`SurfaceError::Atlas`]; [`SurfaceError::Nothing`] where nothing is opaque; [`SurfaceError::Raster`].
pub fn mesh_of(splats: &Splats, config: &MeshConfig) -> Result<Shape, SurfaceError> {
    config.check()?;
    // Near the origin, as all of this is in 32 bits.
    let local = Splats { origin: DVec3::ZERO, ..splats.clone() };
    let (low, high) = bounds(&local)?;
    let views = Views::around(&local, low, high, config)?;
    let volume = Volume::fuse(&views, low, high, config.voxels);
    let mut shape = iso_surface(&volume.values, volume.size, volume.low, volume.step)?.without_small_parts(PART);
    if let Some(triangles) = config.triangles.or(config.texture.map(|_| TEXTURED)) {
        shape = decimate(&shape, triangles);
    }
    let color = |position: Vec3, normal: Vec3| views.color(position.as_dvec3(), normal.as_dvec3(), BAND * volume.step);
    match config.texture {
        Some(size) => shape = bake(shape, size, color)?,
        None => shape.colors = shape.positions.par_iter().zip(&shape.normals).map(|(p, n)| color(*p, *n)).collect(),
    }
    shape.origin = splats.origin;
    Ok(shape)
}

/// The box of what is visible: three standard deviations of Gaussians that are not faint.
fn bounds(splats: &Splats) -> Result<(DVec3, DVec3), SurfaceError> {
    let cloud = &splats.cloud;
    let mut corners = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for i in (0..cloud.len()).filter(|i| cloud.opacity(*i) > 0.05) {
        let covariance = cloud.covariance(i);
        let reach = 3.0 * DVec3::new(covariance.x_axis.x, covariance.y_axis.y, covariance.z_axis.z).map(f64::sqrt);
        corners = (corners.0.min(cloud.mean(i) - reach), corners.1.max(cloud.mean(i) + reach));
    }
    let (low, high) = corners;
    if (high - low).max_element() > 0.0 && (high - low).is_finite() {
        Ok(corners)
    } else {
        Err(SurfaceError::Nothing { found: format!("{} Gaussians, all faint", cloud.len()).into() })
    }
}

/// Renders from all around.
struct Views {
    cameras: Vec<Camera>,
    renders: Vec<Picture>,
}

struct Picture {
    /// Red, green, blue, sRGB-encoded, not over any background. `[h * w]`
    rgb: Vec<Vec3>,
    /// `[h * w]`
    alpha: Vec<f32>,
    /// Camera z of the surface; infinite where none shows. `[h * w]`
    depth: Vec<f32>,
    /// How much a pixel counts: the squared cosine between line of sight and surface, since depths of slanted Gaussians,
    /// which are those of their centers, are too near. `[h * w]`
    weight: Vec<f32>,
}

/// What a pixel of the background counts.
const BACKGROUND: f32 = 0.1;

/// The squared cosine at each pixel, of the differences to its neighbors' depths.
fn weights(camera: &Camera, depth: &[f32]) -> Vec<f32> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    // Between pixel `i` and the ones before and after it along an axis, where a surface shows there; per unit of length.
    let slope = |i: usize, step: usize, at: usize, size: usize, focal: f64| {
        let before = if at > 0 && depth[i - step].is_finite() { i - step } else { i };
        let after = if at + 1 < size && depth[i + step].is_finite() { i + step } else { i };
        let pixels = ((after - before) / step).max(1) as f64;
        f64::from(depth[after] - depth[before]) / pixels * focal / f64::from(depth[i])
    };
    let weight = |i: usize| {
        if !depth[i].is_finite() {
            return BACKGROUND;
        }
        let x = slope(i, 1, i % width, width, camera.fx);
        let y = slope(i, width, i / width, height, camera.fy);
        (1.0 / (1.0 + x * x + y * y)) as f32
    };
    (0..depth.len()).map(weight).collect()
}

impl Views {
    fn around(splats: &Splats, low: DVec3, high: DVec3, config: &MeshConfig) -> Result<Self, SurfaceError> {
        let (center, radius) = (0.5 * (low + high), 0.5 * (high - low).length());
        let distance = 1.02 * radius / (0.5 * FIELD_OF_VIEW).sin();
        let (n, pixels) = (config.views.max(1), config.pixels.max(config.texture.unwrap_or(0).min(FINEST) as u32));
        let cameras: Vec<Camera> = (0..n)
            .map(|i| {
                // Evenly spread over the sphere.
                let z = 1.0 - 2.0 * (i as f64 + 0.5) / n as f64;
                let turn = i as f64 * std::f64::consts::PI * (3.0 - 5f64.sqrt());
                let r = (1.0 - z * z).sqrt();
                let eye = center + distance * DVec3::new(r * turn.cos(), r * turn.sin(), z);
                Camera::look_at(eye, center, DVec3::Z, FIELD_OF_VIEW, pixels, pixels)
            })
            .collect();
        let near = (distance - radius).max(1e-6 * distance) as f32;
        let raster = RasterConfig { depth: true, near: 0.5 * near, ..RasterConfig::default() };
        let picture = |camera: &Camera| -> Result<Picture, SurfaceError> {
            let cloud = splats.seen_from(camera.center());
            let out = render(cloud.rows(), &[*camera], &[[0.0; 3]], &raster)?;
            let each = |i: usize| out.alpha[i].max(1e-6);
            let shown = |i: usize| out.alpha[i] >= OPAQUE;
            let count = 0..out.alpha.len();
            let depth: Vec<f32> =
                count.clone().map(|i| if shown(i) { out.depth[i] / each(i) } else { f32::INFINITY }).collect();
            Ok(Picture {
                rgb: count.map(|i| Vec3::from_slice(&out.rgb[3 * i..]) / each(i)).collect(),
                weight: weights(camera, &depth),
                depth,
                alpha: out.alpha,
            })
        };
        let renders = cameras.iter().map(picture).collect::<Result<Vec<_>, _>>()?;
        Ok(Self { cameras, renders })
    }

    /// The color of a point of the surface: the mean over the renders that show it, those that look straight at it most.
    fn color(&self, position: DVec3, normal: DVec3, band: f64) -> Vec3 {
        let (mut sum, mut weights, mut any, mut nearest) = (Vec3::ZERO, 0.0, Vec3::splat(0.5), f64::INFINITY);
        for (camera, picture) in self.cameras.iter().zip(&self.renders) {
            let facing = normal.dot((camera.center() - position).normalize());
            let Some((pixel, z)) = pixel_of(camera, position) else { continue };
            if picture.alpha[pixel] < OPAQUE {
                continue;
            }
            let off = (f64::from(picture.depth[pixel]) - z).abs();
            if off < nearest {
                (nearest, any) = (off, picture.rgb[pixel]);
            }
            if facing > 0.0 && off < band {
                let weight = facing.powi(4) as f32;
                sum += weight * picture.rgb[pixel];
                weights += weight;
            }
        }
        let color = if weights > 0.0 { sum / weights } else { any };
        color.clamp(Vec3::ZERO, Vec3::ONE)
    }
}

/// Mean distances to the surface along the lines of sight, in voxels, cut off; negative inside.
pub struct Volume {
    /// x fastest.
    pub values: Vec<f32>,
    /// Voxels along the axes.
    pub size: [usize; 3],
    /// The center of the first voxel.
    pub low: DVec3,
    /// The distance of two, in world units.
    pub step: f64,
}

impl Volume {
    fn fuse(views: &Views, low: DVec3, high: DVec3, voxels: usize) -> Self {
        let step = (high - low).max_element() / voxels as f64;
        let size = (high - low).to_array().map(|v| (v / step).ceil() as usize + 1);
        let mut values = vec![0f32; size.iter().product()];
        let slice = size[0] * size[1];
        values.par_chunks_mut(slice).enumerate().for_each(|(z, layer)| {
            for (i, value) in layer.iter_mut().enumerate() {
                let at = DVec3::new((i % size[0]) as f64, (i / size[0]) as f64, z as f64);
                *value = distance(views, low + step * at, step);
            }
        });
        Self { values, size, low, step }
    }
}

/// The mean over the views; what none sees is inside.
fn distance(views: &Views, point: DVec3, step: f64) -> f32 {
    let (mut sum, mut weights) = (0.0, 0.0);
    for (camera, picture) in views.cameras.iter().zip(&views.renders) {
        let Some((pixel, z)) = pixel_of(camera, point) else { continue };
        let distance = if picture.alpha[pixel] >= OPAQUE {
            (f64::from(picture.depth[pixel]) - z) / step
        } else if picture.alpha[pixel] < 0.5 * OPAQUE {
            BAND
        } else {
            continue;
        };
        // Far behind a surface nothing is known.
        if distance > -BAND {
            let weight = f64::from(picture.weight[pixel]);
            sum += weight * distance.min(BAND);
            weights += weight;
        }
    }
    if weights == 0.0 { -BAND as f32 } else { (sum / weights) as f32 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use freerange_gaussians::{Gaussians, channel};

    /// Flat Gaussians on a ball, red above and blue below.
    fn ball(n: usize, radius: f64) -> Splats {
        let mut cloud = Gaussians::default();
        for i in 0..n {
            let z = 1.0 - 2.0 * (i as f64 + 0.5) / n as f64;
            let turn = i as f64 * 2.399_963;
            let r = (1.0 - z * z).sqrt();
            let d = DVec3::new(r * turn.cos(), r * turn.sin(), z);
            let q = glam::DQuat::from_rotation_arc(DVec3::Z, d);
            let mut row = [0f32; channel::COUNT];
            row[channel::MEAN].copy_from_slice(&(radius * d).as_vec3().to_array());
            row[channel::LOG_SCALE].copy_from_slice(&[-4.0, -4.0, -6.0]);
            row[channel::ROTATION].copy_from_slice(&[q.w, q.x, q.y, q.z].map(|v| v as f32));
            row[channel::LOGIT_OPACITY] = 4.0;
            row[channel::COLOR].copy_from_slice(if z > 0.0 { &[0.9, 0.1, 0.1] } else { &[0.1, 0.1, 0.9] });
            cloud.push(&row);
        }
        cloud.into()
    }

    #[test]
    fn a_ball_of_gaussians_is_a_closed_ball_with_its_colors() {
        let mut splats = ball(9000, 0.5);
        splats.origin = DVec3::new(1e6, 0.0, 0.0);
        let config = MeshConfig { voxels: 48, views: 40, pixels: 200, ..MeshConfig::default() };
        let shape = mesh_of(&splats, &config).unwrap();
        assert!(shape.is_closed_manifold());
        assert_eq!(shape.origin, splats.origin);
        let volume = 4.0 / 3.0 * std::f64::consts::PI * 0.125;
        assert!((shape.volume() / volume - 1.0).abs() < 0.06, "{}", shape.volume() / volume);
        for (p, color) in shape.positions.iter().zip(&shape.colors) {
            assert!((p.length() - 0.5).abs() < 0.02, "{p}");
            if p.z.abs() > 0.1 {
                let expected = if p.z > 0.0 { Vec3::new(0.9, 0.1, 0.1) } else { Vec3::new(0.1, 0.1, 0.9) };
                assert!(color.abs_diff_eq(expected, 0.06), "{p}: {color}");
            }
        }
    }

    #[test]
    fn faint_gaussians_make_no_mesh() {
        let mut splats = ball(10, 0.5);
        splats.cloud.iter_mut().for_each(|row| row[channel::LOGIT_OPACITY] = -6.0);
        assert!(mesh_of(&splats, &MeshConfig::default()).unwrap_err().to_string().contains("all faint"));
        let refused = |config: MeshConfig| mesh_of(&ball(10, 0.5), &config).unwrap_err().to_string();
        let default = MeshConfig::default();
        assert!(
            refused(MeshConfig { voxels: 4, ..default }).contains("voxels: expected 8 to 512 along the longest side")
        );
        assert!(
            refused(MeshConfig { triangles: Some(3), ..default }).contains("triangles: expected at least 4, found 3")
        );
        assert!(refused(MeshConfig { texture: Some(32), ..default }).contains("texture: expected 64 to 4096 texels"));
    }
}
