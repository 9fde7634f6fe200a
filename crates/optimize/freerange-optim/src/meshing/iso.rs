//! From a grid of signed distances to triangles.

use glam::{DVec3, Vec3};
use isomesh::{MeshBuffer, RuntimeShape3, construct::SampledField, marching_cubes::MarchingCubes};

use crate::meshing::{Shape, SurfaceError};

/// The surface where `values` (negative inside, x fastest, `size` along the axes) cross zero, closed at the border of
/// the grid. `low` is the place of the first value, `step` the distance of two.
///
/// # Errors
/// [`SurfaceError::Nothing`] where there is no surface, or the grid cannot be marched through.
pub fn iso_surface(values: &[f32], size: [usize; 3], low: DVec3, step: f64) -> Result<Shape, SurfaceError> {
    let nothing = |found: String| SurfaceError::Nothing { found: found.into() };
    let failed = |e: isomesh::Error| nothing(format!("{e:?}"));
    // A layer of outside around it all.
    let padded = size.map(|n| n + 2);
    let mut field = vec![1f32; padded.iter().product()];
    for (row, line) in values.chunks_exact(size[0]).enumerate() {
        let (y, z) = (row % size[1], row / size[1]);
        let at = 1 + padded[0] * (y + 1 + padded[1] * (z + 1));
        field[at..at + size[0]].copy_from_slice(line);
    }
    // In units of the grid: differences for normals are taken over a fixed part of a cell.
    let shape = RuntimeShape3::new(padded.map(|n| n as u32)).map_err(failed)?;
    let sampled = SampledField::new(&field, &shape, [-1.0; 3], 1.0).map_err(failed)?;
    let mut mesh = MeshBuffer::<f32>::new();
    MarchingCubes::<f32>::new().extract(&sampled, &shape, [-1.0; 3], 1.0, &mut mesh).map_err(failed)?;
    if mesh.indices.is_empty() {
        return Err(nothing("none".into()));
    }
    let place = |p: &[f32; 3]| (low + step * Vec3::from_array(*p).as_dvec3()).as_vec3();
    Ok(Shape {
        positions: mesh.positions.iter().map(place).collect(),
        normals: mesh.normals.iter().map(|n| Vec3::from_array(*n).normalize_or(Vec3::Z)).collect(),
        colors: Vec::new(),
        texture: None,
        triangles: mesh.indices.as_chunks::<3>().0.to_vec(),
        origin: DVec3::ZERO,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn a_ball_is_closed_outward_and_of_the_right_volume() {
        let (n, radius) = (41usize, 0.8);
        let at = |i: usize| -1.0 + 0.05 * DVec3::new((i % n) as f64, (i / n % n) as f64, (i / n / n) as f64);
        let place = |i: usize| at(i) + DVec3::splat(0.0);
        let values: Vec<f32> = (0..n.pow(3)).map(|i| (place(i).length() - radius) as f32).collect();
        let shape = iso_surface(&values, [n; 3], DVec3::splat(-1.0), 0.05).unwrap();
        assert!(shape.is_closed_manifold());
        let volume = 4.0 / 3.0 * std::f64::consts::PI * radius.powi(3);
        assert!((shape.volume() / volume - 1.0).abs() < 0.01, "{}", shape.volume() / volume);
        for (p, normal) in shape.positions.iter().zip(&shape.normals) {
            assert!((f64::from(p.length()) - radius).abs() < 0.002 && normal.dot(p.normalize()) > 0.99);
        }
    }

    #[test]
    fn noise_is_closed_and_manifold_and_so_is_what_the_border_cuts() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let size = [24, 17, 20];
        let values: Vec<f32> = (0..size.iter().product()).map(|_| rng.random_range(-1.0..1.0)).collect();
        let shape = iso_surface(&values, size, DVec3::ZERO, 1.0).unwrap();
        assert!(shape.is_closed_manifold() && shape.volume() > 0.0);
        let all_inside = iso_surface(&[-1.0; 27], [3; 3], DVec3::ZERO, 1.0).unwrap();
        assert!(all_inside.is_closed_manifold() && all_inside.volume() > 8.0);
        assert!(iso_surface(&[1.0; 27], [3; 3], DVec3::ZERO, 1.0).is_err());
    }
}
