//! A mesh projected triangle by triangle, with depth, normals and shading at each sample.

use std::sync::LazyLock;

use freerange_scene::camera::Camera;
use glam::{DMat3, DVec3, Vec3, Vec4};
use image::{Rgba, RgbaImage};

use crate::mesh::linear_to_srgb;
use crate::render::scene::Scene;

/// Points closer to the camera plane than this are not projected.
const NEAR: f64 = 1e-3;

/// How far, in weights of the corners, a sample may lie beyond an edge.
const SLACK: f64 = 1e-9;

/// No triangle at a sample.
const NOTHING: u32 = u32::MAX;

/// Renders a view with `samples_per_axis` squared samples per pixel (at least one): straight alpha, sRGB-encoded,
/// transparent black where nothing is hit. Runs on the calling thread.
pub fn render(scene: &Scene, camera: &Camera, samples_per_axis: u32) -> RgbaImage {
    render_in_steps(scene, camera, samples_per_axis, false, |_| {})
}

/// [`render`], by rays only if `by_rays`; calls `done` after each of "visibility", "shading" and "encoding". For benches.
#[doc(hidden)]
pub fn render_in_steps(
    scene: &Scene,
    camera: &Camera,
    samples_per_axis: u32,
    by_rays: bool,
    mut done: impl FnMut(&'static str),
) -> RgbaImage {
    let grid = Grid::new(scene, camera, samples_per_axis.max(1));
    let projected = if by_rays { None } else { grid.rasterize(scene) };
    let visible = projected.unwrap_or_else(|| grid.trace(scene));
    done("visibility");
    let shaded = grid.shade(scene, &visible);
    done("shading");
    let image = grid.encode(&shaded);
    done("encoding");
    image
}

/// The samples of the pixels that the object can cover, row by row.
struct Grid<'a> {
    camera: &'a Camera,
    rotation: glam::Mat3,
    origin: Vec3,
    /// First pixel.
    x0: u32,
    y0: u32,
    /// Samples per row and column.
    columns: usize,
    rows: usize,
    per_axis: u32,
}

impl<'a> Grid<'a> {
    fn new(scene: &Scene, camera: &'a Camera, per_axis: u32) -> Self {
        let [x0, y0, x1, y1] = window(scene, camera);
        let size = |a: u32, b: u32| (b.saturating_sub(a) * per_axis) as usize;
        Self {
            camera,
            rotation: DMat3::from_mat4(camera.world_to_camera).transpose().as_mat3(),
            origin: camera.center().as_vec3(),
            x0,
            y0,
            columns: size(x0, x1),
            rows: size(y0, y1),
            per_axis,
        }
    }

    /// Unit direction of the ray through a sample.
    fn direction(&self, column: usize, row: usize) -> Vec3 {
        let n = self.per_axis as f32;
        let x = self.x0 as f32 + (column as f32 + 0.5) / n - self.camera.cx as f32;
        let y = self.y0 as f32 + (row as f32 + 0.5) / n - self.camera.cy as f32;
        (self.rotation * Vec3::new(x / self.camera.fx as f32, y / self.camera.fy as f32, 1.0)).normalize()
    }

    /// The nearest triangle per sample, by one ray each. `[rows, columns]`
    fn trace(&self, scene: &Scene) -> Vec<u32> {
        (0..self.rows * self.columns)
            .map(|i| {
                let direction = self.direction(i % self.columns, i / self.columns);
                scene.intersect(self.origin, direction).map_or(NOTHING, |hit| hit.triangle)
            })
            .collect()
    }

    /// The nearest triangle per sample, by projecting the triangles: the same answer as [`Self::trace`], many times
    /// faster. None if a vertex lies behind or too close to the camera plane. `[rows, columns]`
    fn rasterize(&self, scene: &Scene) -> Option<Vec<u32>> {
        let (camera, n) = (self.camera, f64::from(self.per_axis));
        // Grid coordinates, in which samples lie at whole numbers, and inverse depth (linear over the image).
        let projected: Vec<DVec3> = scene
            .mesh()
            .positions
            .iter()
            .map(|p| {
                let q = camera.world_to_camera.transform_point3(p.as_dvec3());
                let w = 1.0 / q.z;
                let x = (camera.fx * q.x * w + camera.cx - f64::from(self.x0)) * n - 0.5;
                let y = (camera.fy * q.y * w + camera.cy - f64::from(self.y0)) * n - 0.5;
                (q.z > NEAR).then_some(DVec3::new(x, y, w))
            })
            .collect::<Option<_>>()?;
        let mut nearest = vec![0.0f32; self.rows * self.columns];
        let mut visible = vec![NOTHING; self.rows * self.columns];
        for (id, t) in scene.mesh().triangles.iter().enumerate() {
            let [a, b, c] = t.map(|v| projected[v as usize]);
            let area = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
            if area == 0.0 {
                continue;
            }
            let (lo, hi) = (a.min(b).min(c), a.max(b).max(c));
            let (x0, x1) =
                (lo.x.ceil().max(0.0) as usize, (hi.x + 1.0).floor().clamp(0.0, self.columns as f64) as usize);
            let (y0, y1) = (lo.y.ceil().max(0.0) as usize, (hi.y + 1.0).floor().clamp(0.0, self.rows as f64) as usize);
            // Weights of b, c and a as affine functions of the grid coordinates; slack keeps shared edges closed.
            let (ub, vb) = ((c.y - a.y) / area, (a.x - c.x) / area);
            let (uc, vc) = ((a.y - b.y) / area, (b.x - a.x) / area);
            let (ua, va) = (-ub - uc, -vb - vc);
            let slopes = [(ub, vb, 0.0), (uc, vc, 0.0), (ua, va, 1.0)];
            let (db, dc) = (b.z - a.z, c.z - a.z);
            for y in y0..y1 {
                let dy = y as f64 - a.y;
                // The part of the row on the inner side of all three edges.
                let (mut first, mut last) = (x0 as f64, x1 as f64 - 1.0);
                for (u, v, w) in slopes {
                    let at_a = w + dy * v + SLACK;
                    if u > 0.0 {
                        first = first.max(a.x - at_a / u);
                    } else if u < 0.0 {
                        last = last.min(a.x - at_a / u);
                    } else if at_a < 0.0 {
                        last = f64::MIN;
                    }
                }
                if last < first {
                    continue;
                }
                let (first, last) = (first.ceil() as usize, last.floor() as usize);
                let dx = first as f64 - a.x;
                let start = a.z + (dx * ub + dy * vb) * db + (dx * uc + dy * vc) * dc;
                let step = ub * db + uc * dc;
                let row = y * self.columns;
                for x in first..=last {
                    let (w, i) = ((start + (x - first) as f64 * step) as f32, row + x);
                    if w > nearest[i] {
                        nearest[i] = w;
                        visible[i] = id as u32;
                    }
                }
            }
        }
        Some(visible)
    }

    /// The samples of each pixel, shaded: mean linear color times opacity, and mean opacity. `[rows, columns]`
    /// of pixels
    fn shade(&self, scene: &Scene, visible: &[u32]) -> Vec<Vec4> {
        let n = self.per_axis as usize;
        let cone = 1.0 / (self.camera.fx as f32 * self.per_axis as f32);
        let share = 1.0 / (n * n) as f32;
        let mut pixels = Vec::with_capacity(visible.len() / (n * n));
        for y in (0..self.rows).step_by(n) {
            for x in (0..self.columns).step_by(n) {
                let mut sum = Vec4::ZERO;
                for row in y..y + n {
                    for column in x..x + n {
                        let id = visible[row * self.columns + column];
                        if id != NOTHING {
                            sum += scene.along(id as usize, self.origin, self.direction(column, row), cone);
                        }
                    }
                }
                pixels.push(sum * share);
            }
        }
        pixels
    }

    /// Straight alpha and sRGB.
    fn encode(&self, pixels: &[Vec4]) -> RgbaImage {
        let mut image = RgbaImage::new(self.camera.width, self.camera.height);
        let columns = self.columns / self.per_axis as usize;
        for (i, pixel) in pixels.iter().enumerate().filter(|(_, p)| p.w > 0.0) {
            let [r, g, b] = (pixel.truncate() / pixel.w).to_array().map(srgb_code);
            let (x, y) = (self.x0 + (i % columns) as u32, self.y0 + (i / columns) as u32);
            image.put_pixel(x, y, Rgba([r, g, b, (255.0 * pixel.w + 0.5) as u8]));
        }
        image
    }
}

/// `(255 * linear_to_srgb(v) + 0.5) as u8`, by a table.
fn srgb_code(v: f32) -> u8 {
    /// The least value of each code, and a first guess for each part of [0, 1].
    static TABLE: LazyLock<([f32; 256], [u8; CELLS + 1])> = LazyLock::new(|| {
        let code = |v: f32| (255.0 * linear_to_srgb(v) + 0.5) as u8;
        let least = std::array::from_fn(|i| {
            // The smallest number with this code, by bisection over the bits of positive numbers.
            let (mut low, mut high) = (0u32, 1f32.to_bits());
            while low < high {
                let middle = (low + high) / 2;
                if usize::from(code(f32::from_bits(middle))) >= i { high = middle } else { low = middle + 1 }
            }
            f32::from_bits(low)
        });
        (least, std::array::from_fn(|i| code(i as f32 / CELLS as f32)))
    });
    const CELLS: usize = 4096;
    let (least, guess) = &*TABLE;
    let v = v.clamp(0.0, 1.0);
    let mut code = guess[(v * CELLS as f32) as usize];
    while code < 255 && v >= least[usize::from(code) + 1] {
        code += 1;
    }
    code
}

/// Pixel rectangle [x0, y0, x1, y1) that holds the object's projection.
fn window(scene: &Scene, camera: &Camera) -> [u32; 4] {
    let (lo, hi) = scene.bounds();
    let (mut min, mut max) = ([f64::MAX; 2], [f64::MIN; 2]);
    for corner in 0..8 {
        let pick = |axis: usize| f64::from(if corner >> axis & 1 == 0 { lo[axis] } else { hi[axis] });
        let p = camera.world_to_camera.transform_point3(DVec3::new(pick(0), pick(1), pick(2)));
        if p.z < NEAR {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::generate::{GeneratorConfig, generate};
    use crate::render::Lighting;

    #[test]
    fn the_table_of_codes_is_exact() {
        for i in 0..1_000_000u32 {
            let v = i as f32 / 900_000.0 - 0.02;
            assert_eq!(srgb_code(v), (255.0 * linear_to_srgb(v) + 0.5) as u8, "{v}");
        }
    }

    #[test]
    fn projected_triangles_and_rays_see_the_same() {
        for seed in 0..6 {
            let mesh = generate(seed, &GeneratorConfig::default()).unwrap();
            let scene = Scene::new(mesh, &Lighting { rays: 1, ..Lighting::default() }).unwrap();
            let eye = DVec3::new(1.1, -0.8 + 0.3 * seed as f64, 0.6);
            let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.8, 96, 80);
            let grid = Grid::new(&scene, &camera, 2);
            let (a, b) = (grid.rasterize(&scene).unwrap(), grid.trace(&scene));
            let covered = b.iter().filter(|&&id| id != NOTHING).count();
            assert!(covered > 300, "seed {seed}: {covered}");
            // Samples on an edge may choose either neighbor, and a silhouette either side.
            let differ = a.iter().zip(&b).filter(|(a, b)| a != b).count();
            let holes = a.iter().zip(&b).filter(|&(&a, &b)| (a == NOTHING) != (b == NOTHING)).count();
            assert!(differ * 200 <= covered, "seed {seed}: {differ} of {covered} differ");
            assert!(holes * 1000 <= covered, "seed {seed}: {holes} of {covered} holes");
        }
    }

    #[test]
    fn a_camera_inside_the_object_falls_back_to_rays() {
        let mesh = generate(1, &GeneratorConfig::default()).unwrap();
        let scene = Scene::new(mesh, &Lighting { rays: 1, ..Lighting::default() }).unwrap();
        let camera = Camera::look_at(DVec3::new(0.01, 0.02, 0.0), DVec3::X, DVec3::Z, 1.0, 16, 16);
        assert!(Grid::new(&scene, &camera, 1).rasterize(&scene).is_none());
        assert_eq!(render(&scene, &camera, 1).dimensions(), (16, 16));
    }
}
