//! From a file's triangles to a mesh in the canonical frame.

use glam::{DAffine3, DMat3, DVec3, Mat3, Vec4};

use super::job::{Job, Soup};
use super::normals::fill_normals;
use super::{Loaded, Up};
use crate::mesh::error::MeshError;
use crate::mesh::triangles::Mesh;

/// Drops what does not count (degenerate triangles, unreferenced vertices), turns +z up, centers the bounding box, scales
/// the farthest vertex to 0.5 and fills in missing normals.
pub fn finish(mut job: Job, mut soup: Soup, up: Up) -> Result<Loaded, MeshError> {
    if soup.triangles.is_empty() {
        return Err(job.error("triangles", "at least one", "none"));
    }
    if let Some(&i) = soup.triangles.iter().flatten().find(|&&i| i as usize >= soup.positions.len()) {
        return Err(job.error("indices", format!("below {}", soup.positions.len()), i));
    }
    if let Some(p) = soup.triangles.iter().flatten().map(|&i| soup.positions[i as usize]).find(|p| !is_sane(*p)) {
        return Err(job.error("positions", "finite numbers below 1e30", p));
    }
    let dropped = drop_degenerate(&mut soup);
    if soup.triangles.is_empty() {
        return Err(job.error("triangles", "at least one with an area", format!("{dropped} without")));
    }
    if dropped > 0 {
        job.note(format!("{dropped} triangles without an area dropped"));
    }
    drop_unreferenced(&mut soup);

    let z_up_from_file = match up {
        Up::Y => DMat3::from_cols(DVec3::X, DVec3::Z, -DVec3::Y),
        Up::Z => DMat3::IDENTITY,
    };
    for p in &mut soup.positions {
        *p = z_up_from_file * *p;
    }
    let (lo, hi) = bounds(&soup.positions);
    let center = 0.5 * (lo + hi);
    let radius = soup.positions.iter().map(|&p| (p - center).length()).fold(0.0, f64::max);
    // A hair less than 0.5, so that rounding cannot push a vertex out of the sphere.
    let scale = 0.499_999 / radius;
    let canonical_from_file = DAffine3::from_mat3_translation(z_up_from_file * scale, -center * scale);
    if !scale.is_finite() || !canonical_from_file.is_finite() {
        return Err(job.error("positions", "an extent above zero", radius));
    }

    let rotation: Mat3 = z_up_from_file.as_mat3();
    let mut mesh = Mesh {
        positions: soup.positions.iter().map(|&p| ((p - center) * scale).as_vec3()).collect(),
        normals: soup.normals.iter().map(|&n| (rotation * n).normalize_or_zero()).collect(),
        uvs: soup.uvs,
        triangles: soup.triangles,
        triangle_materials: soup.triangle_materials,
        materials: soup.materials,
        ..Mesh::default()
    };
    drop(soup.positions);
    if soup.colors.iter().any(|&c| c != Vec4::ONE) {
        mesh.colors = soup.colors;
    }
    fill_normals(&mut mesh);
    mesh.rest = mesh.positions.clone();
    mesh.validate()?;
    Ok(Loaded { mesh, notes: job.notes, canonical_from_file })
}

/// Products of two coordinates, as areas need them, must not overflow.
fn is_sane(p: DVec3) -> bool {
    p.abs().max_element() < 1e30 && p.is_finite()
}

fn bounds(positions: &[DVec3]) -> (DVec3, DVec3) {
    positions.iter().fold((DVec3::MAX, DVec3::MIN), |(lo, hi), &p| (lo.min(p), hi.max(p)))
}

/// Removes triangles whose area is nothing beside the object's size; returns how many.
fn drop_degenerate(soup: &mut Soup) -> usize {
    let (lo, hi) = soup
        .triangles
        .iter()
        .flatten()
        .map(|&i| soup.positions[i as usize])
        .fold((DVec3::MAX, DVec3::MIN), |(lo, hi), p| (lo.min(p), hi.max(p)));
    // Single precision cannot tell the normal of a smaller one.
    let least = 1e-13 * (hi - lo).length_squared();
    let keep: Vec<bool> = soup
        .triangles
        .iter()
        .map(|t| {
            let [a, b, c] = t.map(|i| soup.positions[i as usize]);
            (b - a).cross(c - a).length() > least
        })
        .collect();
    let before = soup.triangles.len();
    let mut flags = keep.iter();
    soup.triangles.retain(|_| flags.next() == Some(&true));
    let mut flags = keep.iter();
    soup.triangle_materials.retain(|_| flags.next() == Some(&true));
    before - soup.triangles.len()
}

/// Removes vertices that no triangle uses, keeping the order of the others.
fn drop_unreferenced(soup: &mut Soup) {
    const UNUSED: u32 = u32::MAX;
    let mut new_index = vec![UNUSED; soup.positions.len()];
    for &i in soup.triangles.iter().flatten() {
        new_index[i as usize] = 0;
    }
    let mut kept = 0u32;
    for (old, new) in new_index.iter_mut().enumerate() {
        if *new != UNUSED {
            *new = kept;
            let k = kept as usize;
            soup.positions[k] = soup.positions[old];
            soup.normals[k] = soup.normals[old];
            soup.uvs[k] = soup.uvs[old];
            soup.colors[k] = soup.colors[old];
            kept += 1;
        }
    }
    soup.positions.truncate(kept as usize);
    soup.normals.truncate(kept as usize);
    soup.uvs.truncate(kept as usize);
    soup.colors.truncate(kept as usize);
    for i in soup.triangles.iter_mut().flatten() {
        *i = new_index[*i as usize];
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use glam::{Vec2, Vec3};

    use super::*;
    use crate::mesh::load::LoadLimits;
    use crate::mesh::{Material, Texture};

    fn triangle_soup(points: &[[f64; 3]], triangles: &[[u32; 3]]) -> Soup {
        let mut soup = Soup::default();
        for &p in points {
            soup.vertex(p.into(), Vec3::ZERO, Vec2::ZERO, Vec4::ONE);
        }
        soup.materials.push(Material::matt(Texture::Flat(Vec3::ONE)));
        for &t in triangles {
            soup.triangle(t, 0);
        }
        soup
    }

    fn run(soup: Soup, up: Up) -> Result<Loaded, MeshError> {
        finish(Job::new(Path::new("test"), None, &LoadLimits::default()), soup, up)
    }

    #[test]
    fn the_box_is_centerd_and_the_farthest_vertex_is_at_half() {
        // The last vertex is far away and not used.
        let points = [[10.0, 0.0, 0.0], [14.0, 0.0, 0.0], [10.0, 3.0, 0.0], [1e6, 0.0, f64::NAN]];
        let loaded = run(triangle_soup(&points, &[[0, 1, 2]]), Up::Z).unwrap();
        let mesh = &loaded.mesh;
        assert_eq!(mesh.positions.len(), 3);
        let radius = mesh.positions.iter().map(|p| p.length()).fold(0.0, f32::max);
        assert!((radius - 0.5).abs() < 1e-5, "{radius}");
        // Box (10..14, 0..3): center (12, 1.5), diagonal 5.
        assert!(mesh.positions[1].distance(Vec3::new(0.4, -0.3, 0.0)) < 1e-5);
        assert!(mesh.normals.iter().all(|n| n.distance(Vec3::Z) < 1e-6));
        let moved = loaded.canonical_from_file.transform_point3(points[1].into());
        assert!(moved.as_vec3().distance(mesh.positions[1]) < 1e-6);
    }

    #[test]
    fn y_up_is_turned_to_z_up() {
        let loaded =
            run(triangle_soup(&[[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, 2.0, 0.0]], &[[0, 1, 2]]), Up::Y).unwrap();
        // (x, y, z) goes to (x, -z, y).
        let d = loaded.mesh.positions[1] - loaded.mesh.positions[0];
        assert!(d.normalize().distance(-Vec3::Y) < 1e-6);
        let d = loaded.mesh.positions[2] - loaded.mesh.positions[0];
        assert!(d.normalize().distance(Vec3::Z) < 1e-6);
    }

    #[test]
    fn degenerate_triangles_are_dropped_and_named() {
        let points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.0, 0.0]];
        let loaded = run(triangle_soup(&points, &[[0, 1, 2], [0, 3, 1], [2, 2, 1]]), Up::Z).unwrap();
        assert_eq!(loaded.mesh.triangles.len(), 1);
        assert_eq!(loaded.notes, ["2 triangles without an area dropped"]);
        let error = run(triangle_soup(&points, &[[0, 3, 1]]), Up::Z).unwrap_err().to_string();
        assert!(error.contains("with an area"), "{error}");
    }

    #[test]
    fn broken_coordinates_are_errors() {
        for bad in [f64::NAN, f64::INFINITY, 1e200] {
            let error = run(triangle_soup(&[[0.0; 3], [1.0, 0.0, 0.0], [0.0, bad, 0.0]], &[[0, 1, 2]]), Up::Z);
            assert!(error.unwrap_err().to_string().contains("positions"));
        }
        let error = run(triangle_soup(&[[0.0; 3]], &[[0, 1, 2]]), Up::Z).unwrap_err().to_string();
        assert!(error.contains("indices: expected below 1, found 1"), "{error}");
    }
}
