//! Normals for vertices that have none.

use std::collections::HashMap;

use glam::Vec3;

use crate::mesh::triangles::Mesh;

/// Edges sharper than 45 degrees stay sharp.
const CREASE_COS: f32 = std::f32::consts::FRAC_1_SQRT_2;

/// Around a hub of more faces than this, faces keep their own normals: comparing all pairs would take quadratic time.
const MAX_HUB: usize = 512;

/// Gives vertices whose normal is zero the mean of the normals of the faces around, weighted by the corners' angles.
/// Faces on the other side of a crease do not count; a vertex on a crease is split.
pub fn fill_normals(mesh: &mut Mesh) {
    if mesh.normals.iter().all(|&n| n != Vec3::ZERO) {
        return;
    }
    let missing: Vec<bool> = mesh.normals.iter().map(|&n| n == Vec3::ZERO).collect();
    let mut faces = Vec::with_capacity(mesh.triangles.len());
    let mut angles = Vec::with_capacity(mesh.triangles.len());
    for t in &mesh.triangles {
        let p = t.map(|i| mesh.positions[i as usize]);
        faces.push((p[1] - p[0]).cross(p[2] - p[0]).try_normalize().unwrap_or(Vec3::Z));
        angles.push([0, 1, 2].map(|k: usize| {
            let angle = (p[(k + 1) % 3] - p[k]).angle_between(p[(k + 2) % 3] - p[k]);
            if angle.is_finite() { angle } else { 0.0 }
        }));
    }
    let around = Around::new(mesh);
    let mut split: HashMap<(u32, [i16; 3]), u32> = HashMap::new();
    for face in 0..mesh.triangles.len() {
        for k in 0..3 {
            let vertex = mesh.triangles[face][k];
            if missing.get(vertex as usize) != Some(&true) {
                continue;
            }
            let hub = around.corners(vertex);
            let mut sum = Vec3::ZERO;
            if hub.len() <= MAX_HUB {
                for &(other, corner) in hub {
                    if faces[other as usize].dot(faces[face]) >= CREASE_COS {
                        sum += angles[other as usize][corner as usize] * faces[other as usize];
                    }
                }
            }
            let normal = sum.try_normalize().unwrap_or(faces[face]);
            let key = (normal * 4000.0).round().as_ivec3().to_array().map(|x| x as i16);
            mesh.triangles[face][k] = *split.entry((vertex, key)).or_insert_with(|| {
                // The first normal stays with the vertex; others get a copy of it.
                let i = vertex as usize;
                if mesh.normals[i] == Vec3::ZERO {
                    mesh.normals[i] = normal;
                    return vertex;
                }
                mesh.positions.push(mesh.positions[i]);
                mesh.normals.push(normal);
                mesh.uvs.push(mesh.uvs[i]);
                if let Some(&color) = mesh.colors.get(i) {
                    mesh.colors.push(color);
                }
                (mesh.positions.len() - 1) as u32
            });
        }
    }
}

/// The (triangle, corner) pairs at each place, places being told apart by position alone.
struct Around {
    place: Vec<u32>,
    start: Vec<u32>,
    corners: Vec<(u32, u8)>,
}

impl Around {
    fn new(mesh: &Mesh) -> Self {
        let mut places: HashMap<[i32; 3], u32> = HashMap::with_capacity(mesh.positions.len());
        let place: Vec<u32> = mesh
            .positions
            .iter()
            .map(|&p| {
                let next = places.len() as u32;
                *places.entry((p * 1e6).round().as_ivec3().to_array()).or_insert(next)
            })
            .collect();
        let mut start = vec![0u32; places.len() + 1];
        for &i in mesh.triangles.iter().flatten() {
            start[place[i as usize] as usize + 1] += 1;
        }
        for w in 0..places.len() {
            start[w + 1] += start[w];
        }
        let mut fill = start.clone();
        let mut corners = vec![(0u32, 0u8); 3 * mesh.triangles.len()];
        for (face, t) in mesh.triangles.iter().enumerate() {
            for k in 0..3 {
                let slot = &mut fill[place[t[k] as usize] as usize];
                corners[*slot as usize] = (face as u32, k as u8);
                *slot += 1;
            }
        }
        Self { place, start, corners }
    }

    fn corners(&self, vertex: u32) -> &[(u32, u8)] {
        let w = self.place[vertex as usize] as usize;
        &self.corners[self.start[w] as usize..self.start[w + 1] as usize]
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec2;

    use super::*;

    /// Two triangles that share an edge along y and bend by `angle` there.
    fn bent(angle: f32) -> Mesh {
        let (s, c) = angle.sin_cos();
        let positions = vec![Vec3::ZERO, Vec3::Y, -Vec3::X, Vec3::new(c, 0.0, -s)];
        Mesh {
            normals: vec![Vec3::ZERO; 4],
            uvs: vec![Vec2::ZERO; 4],
            triangles: vec![[0, 1, 2], [0, 3, 1]],
            triangle_materials: vec![0, 0],
            positions,
            ..Mesh::default()
        }
    }

    #[test]
    fn a_soft_edge_is_shared_and_a_sharp_one_split() {
        let mut soft = bent(0.5);
        fill_normals(&mut soft);
        assert_eq!(soft.positions.len(), 4);
        // The mean of the two face normals, as the corners at vertex 0 have equal angles.
        let want = Vec3::new(0.25f32.sin(), 0.0, 0.25f32.cos());
        assert!(soft.normals[0].distance(want) < 1e-5, "{}", soft.normals[0]);
        let mut sharp = bent(1.2);
        fill_normals(&mut sharp);
        assert_eq!(sharp.positions.len(), 6);
        for (t, want) in [(0, Vec3::Z), (1, Vec3::new(1.2f32.sin(), 0.0, 1.2f32.cos()))] {
            for i in sharp.triangles[t] {
                assert!(sharp.normals[i as usize].distance(want) < 1e-5);
            }
        }
    }

    #[test]
    fn given_normals_stay() {
        let mut mesh = bent(0.5);
        mesh.normals[3] = Vec3::Y;
        fill_normals(&mut mesh);
        assert_eq!(mesh.normals[3], Vec3::Y);
        assert!(mesh.normals.iter().all(|n| (n.length() - 1.0).abs() < 1e-5));
    }

    #[test]
    fn a_hub_of_many_faces_takes_linear_time() {
        let n = 100_000u32;
        let mut mesh = Mesh::default();
        mesh.positions.push(Vec3::ZERO);
        for i in 0..=n {
            let a = i as f32 / n as f32;
            mesh.positions.push(Vec3::new(a.cos(), a.sin(), 0.0) * 0.5);
        }
        mesh.normals = vec![Vec3::ZERO; mesh.positions.len()];
        mesh.uvs = vec![Vec2::ZERO; mesh.positions.len()];
        mesh.triangles = (1..=n).map(|i| [0, i, i + 1]).collect();
        let start = std::time::Instant::now();
        fill_normals(&mut mesh);
        assert!(start.elapsed().as_secs_f32() < 5.0);
        assert!(mesh.normals.iter().all(|n| n.distance(Vec3::Z) < 1e-3));
    }
}
