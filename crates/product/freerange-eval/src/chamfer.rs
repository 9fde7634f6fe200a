//! How far the mesh of a result is from the true one: Chamfer distance and F-score.

use std::collections::BTreeMap;

use freerange_gaussians::Gaussians;
use freerange_optim::meshing::{MeshConfig, Shape, SurfaceError, mesh_of};
use glam::Vec3;
use rayon::prelude::*;

use crate::{EvalError, MeshSurface, statistics::mean};

/// Points that are sampled on each surface.
const POINTS: usize = 30_000;
/// The F-score counts points as right up to this distance, in parts of the object's diameter.
const RIGHT: f64 = 0.01;
/// Directions from which the true surface is looked at: what none of them sees is the object's inside.
const DIRECTIONS: usize = 100;
/// Rays start so far off the surface, in parts of the object's diameter.
const OFFSET: f32 = 1e-4;

/// Metrics of the mesh that [`mesh_of`] makes of Gaussians, by name. Points are sampled evenly on it and on the true
/// surface, where that can be seen from outside, and their distances to the other surface are taken in parts of the
/// object's diameter. `mesh-accuracy` is the mean distance of the mesh's points, `mesh-completeness` that of the true
/// ones, `mesh-chamfer` the mean of both. `mesh-f-score` is the harmonic mean of the shares of both kinds of points
/// that are at most 0.01 away. `None` if the Gaussians show no surface.
///
/// # Errors
/// If the Gaussians cannot be rendered.
pub fn mesh_metrics(cloud: &Gaussians, truth: &MeshSurface) -> Result<Option<BTreeMap<String, f64>>, EvalError> {
    match mesh_of(&cloud.clone().into(), &MeshConfig::default()) {
        Ok(shape) => Ok(compare(&surface_of(&shape), truth)),
        Err(SurfaceError::Nothing { .. }) => Ok(None),
        Err(e) => Err(e.into()),
    }
}

fn surface_of(shape: &Shape) -> MeshSurface {
    MeshSurface::of(shape.triangles.iter().map(|t| t.map(|i| shape.positions[i as usize])).collect())
}

/// `None` if nothing of the true surface can be seen.
fn compare(found: &MeshSurface, truth: &MeshSurface) -> Option<BTreeMap<String, f64>> {
    let diameter = diameter(truth);
    let samples = truth.samples(POINTS);
    let visible: Vec<Vec3> = samples
        .into_par_iter()
        .filter(|(p, normal)| is_visible(truth, *p, *normal, diameter))
        .map(|(p, _)| p)
        .collect();
    let of_found: Vec<Vec3> = found.samples(POINTS).into_iter().map(|(p, _)| p).collect();
    let distances = |points: &[Vec3], to: &MeshSurface| -> Vec<f64> {
        points.par_iter().map(|p| f64::from(to.nearest(*p).distance.abs() / diameter)).collect()
    };
    let (to_truth, to_found) = (distances(&of_found, truth), distances(&visible, found));
    let right = |d: &[f64]| d.iter().filter(|d| **d <= RIGHT).count() as f64 / d.len() as f64;
    let (accuracy, completeness) = (mean(&to_truth)?, mean(&to_found)?);
    let (precision, recall) = (right(&to_truth), right(&to_found));
    let metrics = [
        ("mesh-accuracy", accuracy),
        ("mesh-completeness", completeness),
        ("mesh-chamfer", 0.5 * (accuracy + completeness)),
        ("mesh-f-score", if precision + recall > 0.0 { 2.0 * precision * recall / (precision + recall) } else { 0.0 }),
    ];
    Some(metrics.map(|(name, value)| (name.to_owned(), value)).into())
}

/// Twice the largest distance of a point from the middle of the bounding box.
fn diameter(surface: &MeshSurface) -> f32 {
    let points = || surface.triangles().iter().flatten();
    let (low, high) = points().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(l, h), p| (l.min(*p), h.max(*p)));
    2.0 * points().map(|p| p.distance(0.5 * (low + high))).fold(0.0, f32::max)
}

/// Whether a point of a surface can be seen from far away, on either side.
fn is_visible(surface: &MeshSurface, point: Vec3, normal: Vec3, diameter: f32) -> bool {
    (0..DIRECTIONS).any(|i| {
        let z = 1.0 - (2 * i + 1) as f32 / DIRECTIONS as f32;
        let (r, angle) = ((1.0 - z * z).sqrt(), 2.399_963_2 * i as f32);
        let direction = Vec3::new(r * angle.cos(), r * angle.sin(), z);
        let start = point + OFFSET * diameter * normal * normal.dot(direction).signum();
        surface.is_free(start, direction, 2.0 * diameter)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::tests::{cube, shell, sphere};
    use freerange_assets::mesh::Mesh;

    fn moved(mut mesh: Mesh, at: impl Fn(Vec3) -> Vec3) -> Mesh {
        mesh.positions.iter_mut().for_each(|p| *p = at(*p));
        mesh
    }

    fn check(found: &BTreeMap<String, f64>, expected: [f64; 4], within: f64) {
        let names = ["mesh-accuracy", "mesh-completeness", "mesh-chamfer", "mesh-f-score"];
        for (name, expected) in names.into_iter().zip(expected) {
            assert!((found[name] - expected).abs() < within, "{name}: {} instead of {expected}", found[name]);
        }
    }

    #[test]
    fn concentric_spheres_are_apart_by_their_radii() {
        let truth = MeshSurface::new(&sphere(0.4));
        for (radius, f_score) in [(0.4, 1.0), (0.406, 1.0), (0.41, 0.0), (0.37, 0.0)] {
            let off = f64::abs(radius - 0.4) / 0.8;
            let found = compare(&MeshSurface::new(&sphere(radius as f32)), &truth).unwrap();
            check(&found, [off, off, off, f_score], 5e-4);
        }
        // The unit is the object's: the same at another size.
        let large = |r: f32| MeshSurface::new(&sphere(10.0 * r));
        check(&compare(&large(0.41), &large(0.4)).unwrap(), [0.0125, 0.0125, 0.0125, 0.0], 5e-4);
    }

    /// A cube whose one face is moved out by a tenth. Of the true face's points those nearer to an edge than a tenth are
    /// nearest to a side: the mean of min(0.1, distance to the edge) is 0.081333. Of the 6.4 of the other's area 1 is a
    /// tenth away and 0.4 a twentieth in the mean.
    #[test]
    fn a_longer_box_is_apart_as_integrals_tell() {
        let d = 3f64.sqrt();
        let longer = moved(cube(), |p| if p.x > 0.0 { p + 0.1 * Vec3::X } else { p });
        let found = compare(&MeshSurface::new(&longer), &MeshSurface::new(&cube())).unwrap();
        let (accuracy, completeness) = (0.12 / 6.4 / d, 0.081333 / 6.0 / d);
        // Right: at most 0.017321 away. 5 and a strip of four sides of 6.4; 5 and a rim of the face of 6.
        let rim = 0.01 * d;
        let (precision, recall) = ((5.0 + 4.0 * rim) / 6.4, (6.0 - (1.0 - 2.0 * rim).powi(2)) / 6.0);
        let f_score = 2.0 * precision * recall / (precision + recall);
        check(&found, [accuracy, completeness, 0.5 * (accuracy + completeness), f_score], 2e-3 * f_score);
        assert!((found["mesh-accuracy"] / accuracy - 1.0).abs() < 0.02, "{found:?}");
        assert!((found["mesh-completeness"] / completeness - 1.0).abs() < 0.02, "{found:?}");
    }

    /// The same by brute force: nearest neighbors among many points, which are spread in another way.
    #[test]
    fn nearest_neighbors_of_many_points_agree() {
        let egg = moved(sphere(0.4), |p| p * Vec3::new(1.1, 0.9, 1.0) + 0.02 * Vec3::Z);
        let points = |mesh: &Mesh| -> Vec<(Vec3, f64)> {
            // The middles of triangles, weighted by area.
            let of = |i: usize| {
                let [a, b, c] = mesh.corners(i);
                ((a + b + c) / 3.0, f64::from((b - a).cross(c - a).length()))
            };
            (0..mesh.triangles.len()).map(of).collect()
        };
        let (a, b) = (points(&egg), points(&sphere(0.4)));
        let brute = |from: &[(Vec3, f64)], to: &[(Vec3, f64)]| {
            let nearest = |p: Vec3| to.iter().map(|(q, _)| p.distance(*q)).fold(f32::INFINITY, f32::min);
            let sums: Vec<(f64, f64)> =
                from.par_iter().map(|(p, area)| (f64::from(nearest(*p)) * area, *area)).collect();
            sums.iter().map(|s| s.0).sum::<f64>() / sums.iter().map(|s| s.1).sum::<f64>() / 0.8
        };
        let found = compare(&MeshSurface::new(&egg), &MeshSurface::new(&sphere(0.4))).unwrap();
        // Points lie up to a hundredth of the diameter apart: their distances are somewhat larger.
        for (name, brute) in [("mesh-accuracy", brute(&a, &b)), ("mesh-completeness", brute(&b, &a))] {
            let off = brute - found[name];
            assert!((-1e-4..2e-3).contains(&off), "{name}: {} and {brute}", found[name]);
        }
    }

    #[test]
    fn what_lies_within_an_object_is_not_missed() {
        let mut truth = sphere(0.4);
        let inner = sphere(0.2);
        let first = truth.positions.len() as u32;
        truth.positions.extend(&inner.positions);
        truth.triangles.extend(inner.triangles.iter().map(|t| t.map(|i| i + first)));
        let found = compare(&MeshSurface::new(&sphere(0.4)), &MeshSurface::new(&truth)).unwrap();
        check(&found, [0.0, 0.0, 0.0, 1.0], 5e-4);
        // Seen, whichever way it faces.
        let mut inside_out = sphere(0.4);
        inside_out.triangles.iter_mut().for_each(|t| t.swap(0, 1));
        let found = compare(&MeshSurface::new(&sphere(0.41)), &MeshSurface::new(&inside_out)).unwrap();
        check(&found, [0.0125, 0.0125, 0.0125, 0.0], 5e-4);
    }

    #[test]
    fn gaussians_are_measured_by_their_mesh() {
        let truth = MeshSurface::new(&sphere(0.4));
        for (radius, off, f_score) in [(0.4, 0.0, 1.0), (0.38, 0.025, 0.0)] {
            let found = mesh_metrics(&shell(radius), &truth).unwrap().unwrap();
            check(&found, [off, off, off, f_score], 4e-3);
        }
        assert_eq!(mesh_metrics(&Gaussians::default(), &truth).unwrap(), None);
    }
}
