//! How far the surface that Gaussians show is from the true one.

use std::{collections::BTreeMap, time::Duration};

use freerange_assets::mesh::Mesh;
use freerange_gaussians::Gaussians;
use freerange_raster::{RasterConfig, surface_depth};
use freerange_scene::camera::{Camera, View};
use glam::{DVec3, Vec3};
use obvhs::{
    BvhBuildParams,
    bvh2::{Bvh2, builder::build_bvh2_from_tris},
    ray::Ray,
    triangle::Triangle,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use crate::{EvalError, statistics::quantile};

/// Longest side, in pixels, of the depth maps that sample a result's surface.
const SIZE: u32 = 128;
/// Smallest cosine between a surface's normal and the direction to a photo's camera at which the photo shows it.
const SEEN: f32 = 0.2;
/// Shadow rays start so far off the surface, in units of the frame.
const OFFSET: f32 = 1e-3;
/// Distances that differ by less are equal, and the plainer normal decides: at edges and corners of triangles.
const EQUAL: f32 = 1e-6;

/// The surface of a mesh: the true one in the frame of the cameras, or a result's.
pub struct MeshSurface {
    triangles: Vec<[Vec3; 3]>, // in the order of the hierarchy's leaves
    bvh: Bvh2,
}

/// The point of a surface that is nearest to another point.
#[derive(Clone, Copy, Debug)]
pub struct Nearest {
    /// Where it is.
    pub point: Vec3,
    /// Unit normal of its triangle, outward.
    pub normal: Vec3,
    /// Its distance; negative where the other point is inside.
    pub distance: f32,
}

impl MeshSurface {
    /// The surface of a mesh with at least one triangle.
    pub fn new(mesh: &Mesh) -> Self {
        Self::of((0..mesh.triangles.len()).map(|i| mesh.corners(i)).collect())
    }

    /// The surface of at least one triangle, by their corners.
    pub(crate) fn of(corners: Vec<[Vec3; 3]>) -> Self {
        let triangle = |&[a, b, c]: &[Vec3; 3]| Triangle { v0: a.into(), v1: b.into(), v2: c.into() };
        let boxes: Vec<Triangle> = corners.iter().map(triangle).collect();
        let params = BvhBuildParams { pre_split: false, ..BvhBuildParams::fast_build() };
        let bvh = build_bvh2_from_tris(&boxes, params, &mut Duration::default());
        let triangles = bvh.primitive_indices.iter().map(|&i| corners[i as usize]).collect();
        Self { triangles, bvh }
    }

    /// The corners of its triangles, in no particular order.
    pub(crate) fn triangles(&self) -> &[[Vec3; 3]] {
        &self.triangles
    }

    /// Its area.
    pub fn area(&self) -> f64 {
        self.triangles.iter().map(area).sum()
    }

    /// Points spread evenly over it by area, the same ones each time, with the unit normals of their triangles.
    pub fn samples(&self, count: usize) -> Vec<(Vec3, Vec3)> {
        let mut sum = 0.0;
        let until: Vec<f64> = self.triangles.iter().map(|t| (sum += area(t), sum).1).collect();
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let point = |i: usize| {
            // One in each of equal parts of the area: less noise than with all of them drawn apart.
            let at = sum * (i as f64 + rng.random::<f64>()) / count as f64;
            let [a, b, c] = self.triangles[until.partition_point(|u| *u < at).min(until.len() - 1)];
            let (u, v): (f32, f32) = (rng.random(), rng.random());
            let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
            (a + u * (b - a) + v * (c - a), (b - a).cross(c - a).normalize_or_zero())
        };
        (0..count).map(point).collect()
    }

    /// The nearest point of the surface.
    pub fn nearest(&self, from: Vec3) -> Nearest {
        let (mut best, mut plainness) = (Nearest { point: from, normal: Vec3::ZERO, distance: f32::INFINITY }, 0.0);
        let mut open = vec![0usize];
        while let Some(node) = open.pop().map(|i| &self.bvh.nodes[i]) {
            let (min, max): (Vec3, Vec3) = (node.aabb.min.into(), node.aabb.max.into());
            if from.distance(from.clamp(min, max)) > best.distance.abs() + EQUAL {
                continue;
            }
            let first = node.first_index as usize;
            if node.prim_count == 0 {
                // The nearer child is looked at first: it is the last on the stack.
                let far = |i: usize| {
                    let aabb = &self.bvh.nodes[i].aabb;
                    from.distance_squared(from.clamp(aabb.min.into(), aabb.max.into()))
                };
                open.extend(if far(first) < far(first + 1) { [first + 1, first] } else { [first, first + 1] });
                continue;
            }
            for corners in &self.triangles[first..first + node.prim_count as usize] {
                let (point, normal) = closest_point(from, corners);
                let (distance, along) = (from.distance(point), (from - point).dot(normal));
                let equal = (distance - best.distance.abs()).abs() <= EQUAL;
                if if equal { along.abs() > plainness } else { distance < best.distance.abs() } {
                    plainness = along.abs();
                    best = Nearest { point, normal, distance: if along < 0.0 { -distance } else { distance } };
                }
            }
        }
        best
    }

    /// Whether a camera at `eye` sees a point of the surface, neither hidden nor at a grazing angle.
    pub fn sees(&self, eye: Vec3, at: &Nearest) -> bool {
        let start = at.point + OFFSET * at.normal;
        let to_eye = eye - start;
        if at.normal.dot(to_eye.normalize_or_zero()) < SEEN {
            return false;
        }
        self.is_free(start, to_eye, 1.0)
    }

    /// Whether nothing of the surface lies on the way from `start` to `start + along * to`.
    pub(crate) fn is_free(&self, start: Vec3, along: Vec3, to: f32) -> bool {
        let ray = Ray::new(start.into(), along.into(), 0.0, to);
        let hit = |ray: &Ray, i: usize| {
            let [a, b, c] = self.triangles[i];
            Triangle { v0: a.into(), v1: b.into(), v2: c.into() }.intersect(ray)
        };
        self.bvh.ray_traverse_miss(ray, hit)
    }
}

fn area([a, b, c]: &[Vec3; 3]) -> f64 {
    0.5 * f64::from((b - a).cross(c - a).length())
}

/// The point of a triangle that is nearest to another point, and the triangle's unit normal. In f64: the normal of a sliver is lost in f32.
fn closest_point(p: Vec3, corners: &[Vec3; 3]) -> (Vec3, Vec3) {
    let (p, [a, b, c]) = (p.as_dvec3(), corners.map(Vec3::as_dvec3));
    let on_edge = |a: DVec3, b: DVec3| {
        let edge = b - a;
        a + edge * ((p - a).dot(edge) / edge.length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0)
    };
    let normal = (b - a).cross(c - a).normalize_or_zero();
    let foot = p - normal * (p - a).dot(normal);
    let inside = |a: DVec3, b: DVec3| (b - a).cross(foot - a).dot(normal) >= 0.0;
    let point = if normal != DVec3::ZERO && inside(a, b) && inside(b, c) && inside(c, a) {
        foot
    } else {
        let edges = [on_edge(a, b), on_edge(b, c), on_edge(c, a)];
        edges.into_iter().min_by(|x, y| p.distance_squared(*x).total_cmp(&p.distance_squared(*y))).unwrap_or(a)
    };
    (point.as_vec3(), normal.as_vec3())
}

/// Metrics of the surface that Gaussians show, by name: from each of `views`, the point of every pixel, 128 pixels a side,
/// at which the transmittance passes a half. Of these points' distances to the true surface in units of the frame:
/// the median, the signed median (negative: inside) and the 90 % quantile, where one of the `inputs` sees the true surface
/// (`surface-seen`, `-signed`, `-90`) and where none does (`surface-unseen` and so on). What has no points has no metrics.
///
/// # Errors
/// If the Gaussians cannot be rendered.
pub fn surface_metrics(
    cloud: &Gaussians,
    truth: &MeshSurface,
    inputs: &[View],
    views: &[View],
) -> Result<BTreeMap<String, f64>, EvalError> {
    let eyes: Vec<Vec3> = inputs.iter().map(|v| v.camera.center().as_vec3()).collect();
    let mut points = Vec::new();
    for view in views {
        points.extend(surface_points(cloud, &view.camera)?);
    }
    let measure = |point: &Vec3| {
        let nearest = truth.nearest(*point);
        (eyes.iter().any(|&eye| truth.sees(eye, &nearest)), f64::from(nearest.distance))
    };
    let distances: Vec<(bool, f64)> = points.par_iter().map(measure).collect();
    let mut metrics = BTreeMap::new();
    for (name, wanted) in [("surface-seen", true), ("surface-unseen", false)] {
        if !distances.iter().any(|(seen, _)| *seen == wanted) {
            continue;
        }
        let mut signed: Vec<f64> = distances.iter().filter(|(seen, _)| *seen == wanted).map(|(_, d)| *d).collect();
        let mut plain: Vec<f64> = signed.iter().map(|d| d.abs()).collect();
        signed.sort_by(f64::total_cmp);
        plain.sort_by(f64::total_cmp);
        metrics.insert(name.to_owned(), quantile(&plain, 0.5));
        metrics.insert(format!("{name}-signed"), quantile(&signed, 0.5));
        metrics.insert(format!("{name}-90"), quantile(&plain, 0.9));
    }
    Ok(metrics)
}

/// The points of the Gaussians' surface that a camera sees, one per pixel.
fn surface_points(cloud: &Gaussians, camera: &Camera) -> Result<Vec<Vec3>, EvalError> {
    let shrink = (f64::from(SIZE) / f64::from(camera.width.max(camera.height))).min(1.0);
    let side = |pixels: u32| ((f64::from(pixels) * shrink).round() as u32).max(1);
    let small = camera.resized(side(camera.width), side(camera.height));
    let depth = surface_depth(cloud.rows(), &small, &RasterConfig::default().shrunk(shrink as f32))?;
    let to_world = small.world_to_camera.inverse();
    let width = small.width as usize;
    let point = |(i, z): (usize, f32)| {
        let (x, y, z) = ((i % width) as f64 + 0.5, (i / width) as f64 + 0.5, f64::from(z));
        let local = DVec3::new((x - small.cx) / small.fx * z, (y - small.cy) / small.fy * z, z);
        to_world.transform_point3(local).as_vec3()
    };
    Ok(depth.into_iter().enumerate().filter(|(_, z)| z.is_finite()).map(point).collect())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use freerange_gaussians::channel;
    use glam::Quat;

    /// A surface of `rows` x `columns` quads from a map of the unit square, which wraps around along u.
    fn mesh(rows: u32, columns: u32, at: impl Fn(f32, f32) -> Vec3) -> Mesh {
        let point = |i: u32| at((i % (columns + 1)) as f32 / columns as f32, (i / (columns + 1)) as f32 / rows as f32);
        let quads = (0..rows * columns).map(|i| i / columns * (columns + 1) + i % columns);
        let triangles = quads.flat_map(|a| [[a, a + 1, a + columns + 2], [a, a + columns + 2, a + columns + 1]]);
        Mesh {
            positions: (0..(rows + 1) * (columns + 1)).map(point).collect(),
            triangles: triangles.collect(),
            ..Mesh::default()
        }
    }

    pub(crate) fn sphere(radius: f32) -> Mesh {
        mesh(60, 120, |u, v| {
            let (a, b) = (std::f32::consts::TAU * u, std::f32::consts::PI * (v - 0.5));
            radius * Vec3::new(a.cos() * b.cos(), a.sin() * b.cos(), b.sin())
        })
    }

    fn torus() -> Mesh {
        mesh(80, 160, |u, v| {
            let (a, b) = (std::f32::consts::TAU * u, std::f32::consts::TAU * v);
            let r = 0.35 + 0.1 * b.cos();
            Vec3::new(r * a.cos(), r * a.sin(), 0.1 * b.sin())
        })
    }

    pub(crate) fn cube() -> Mesh {
        let corner = |i: u32| Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32) - 0.5;
        let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles = faces.into_iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        Mesh { positions: (0..8).map(corner).collect(), triangles, ..Mesh::default() }
    }

    fn points() -> impl Iterator<Item = Vec3> {
        (0..500).map(|i| {
            let wave = |k: f32| 0.6 * (i as f32 * k).sin();
            Vec3::new(wave(1.3), wave(2.7), wave(0.9))
        })
    }

    #[test]
    fn distances_are_those_of_analytic_surfaces() {
        let (ball, ring, block) =
            (MeshSurface::new(&sphere(0.4)), MeshSurface::new(&torus()), MeshSurface::new(&cube()));
        let mut inside = [0; 3];
        for p in points() {
            let q = p.abs() - 0.5;
            let expected = [
                p.length() - 0.4,
                glam::Vec2::new(p.truncate().length() - 0.35, p.z).length() - 0.1,
                q.max(Vec3::ZERO).length() + q.max_element().min(0.0),
            ];
            for (k, (surface, expected)) in [&ball, &ring, &block].into_iter().zip(expected).enumerate() {
                let found = surface.nearest(p);
                assert!((found.distance - expected).abs() < 1e-3, "surface {k}, {p}: {} {expected}", found.distance);
                assert!((p.distance(found.point) - expected.abs()).abs() < 1e-3);
                inside[k] += usize::from(expected < 0.0);
            }
        }
        assert!(inside.iter().all(|n| (5..400).contains(n)), "{inside:?}");
    }

    #[test]
    fn a_camera_sees_what_faces_it_and_is_not_hidden() {
        let ring = MeshSurface::new(&torus());
        let sees = |eye: Vec3, near: Vec3| ring.sees(eye, &ring.nearest(near));
        let eye = Vec3::new(3.0, 0.0, 0.0);
        assert!(sees(eye, Vec3::new(0.45, 0.0, 0.0)));
        // Faces the camera, but behind the near side of the ring.
        assert!(!sees(eye, Vec3::new(-0.25, 0.0, 0.0)));
        assert!(sees(Vec3::new(3.0, 0.0, 3.0), Vec3::new(-0.25, 0.0, 0.0)));
        // Turns away, or nearly so.
        assert!(!sees(eye, Vec3::new(-0.45, 0.0, 0.0)));
        assert!(!sees(eye, Vec3::new(0.35, 0.0, 0.1)));
    }

    /// Flat Gaussians on a sphere.
    pub(crate) fn shell(radius: f32) -> Gaussians {
        let mut cloud = Gaussians::default();
        let count = 12000;
        for i in 0..count {
            let z = 1.0 - (2 * i + 1) as f32 / count as f32;
            let (r, angle) = ((1.0 - z * z).sqrt(), 2.399_963_2 * i as f32);
            let normal = Vec3::new(r * angle.cos(), r * angle.sin(), z);
            let q = Quat::from_rotation_arc(Vec3::Z, normal);
            let mut row = [0.5; channel::COUNT];
            row[channel::MEAN].copy_from_slice(&(radius * normal).to_array());
            row[channel::LOG_SCALE].copy_from_slice(&[-4.8, -4.8, -7.0]);
            row[channel::ROTATION].copy_from_slice(&[q.w, q.x, q.y, q.z]);
            row[channel::LOGIT_OPACITY] = 4.0;
            cloud.push(&row);
        }
        cloud
    }

    fn view(eye: DVec3) -> View {
        let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.8, 200, 160);
        View { name: "v".into(), camera, image: image::RgbaImage::new(200, 160) }
    }

    #[test]
    fn metrics_are_distances_with_their_side_apart_for_what_inputs_see() {
        let truth = MeshSurface::new(&sphere(0.4));
        let around = [DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Y].map(|d| view(1.5 * d));
        for (radius, side) in [(0.41, 0.01), (0.38, -0.02), (0.4, 0.0)] {
            let found = surface_metrics(&shell(radius), &truth, &around[..1], &around).unwrap();
            for name in ["surface-seen", "surface-unseen"] {
                let (median, most) = (found[name], found[&format!("{name}-90")]);
                assert!((median - f64::abs(side)).abs() < 2.5e-3, "{name} {median}, expected {side}");
                assert!(most >= median && most < median + 4e-3, "{median} {most}");
                assert!((found[&format!("{name}-signed")] - side).abs() < 2.5e-3);
            }
        }
        // Cameras on one side, which is what the input sees; nothing at all.
        let seen = surface_metrics(&shell(0.4), &truth, &around[..1], &around[..1]).unwrap();
        assert!(seen.contains_key("surface-seen"));
        assert!(surface_metrics(&Gaussians::default(), &truth, &around, &around).unwrap().is_empty());
    }
}
