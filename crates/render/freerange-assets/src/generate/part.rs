//! Raw closed surfaces, and their assembly into a [`Mesh`] with normals split at creases.

use std::collections::HashMap;

use glam::{Affine3A, Quat, Vec2, Vec3};

use crate::mesh::Material;
use crate::mesh::Mesh;

/// A closed surface under construction: no normals yet.
#[derive(Clone, Debug, Default)]
pub struct Part {
    pub positions: Vec<Vec3>,
    pub uvs: Vec<Vec2>,
    pub triangles: Vec<[u32; 3]>,
    pub materials: Vec<u16>,
}

impl Part {
    pub fn vertex(&mut self, position: Vec3, uv: Vec2) -> u32 {
        self.positions.push(position);
        self.uvs.push(uv);
        (self.positions.len() - 1) as u32
    }

    /// Adds a triangle unless it is degenerate (poles of grids make such).
    pub fn triangle(&mut self, corners: [u32; 3], material: u16) {
        let [a, b, c] = corners.map(|i| self.positions[i as usize]);
        if (b - a).cross(c - a).length_squared() > 1e-20 {
            self.triangles.push(corners);
            self.materials.push(material);
        }
    }

    /// Corners in counter-clockwise order. A quadrilateral is split along its shorter diagonal.
    pub fn quad(&mut self, [a, b, c, d]: [u32; 4], material: u16) {
        let p = |i: u32| self.positions[i as usize];
        if (p(a) - p(c)).length_squared() <= (p(b) - p(d)).length_squared() * 1.000_01 {
            self.triangle([a, b, c], material);
            self.triangle([a, c, d], material);
        } else {
            self.triangle([a, b, d], material);
            self.triangle([b, c, d], material);
        }
    }

    /// A grid of `nu` x `nv` cells over the unit square. Wrapped directions share positions, not texture coordinates.
    pub fn grid(&mut self, [nu, nv]: [usize; 2], wrap: [bool; 2], material: u16, f: impl Fn(f32, f32) -> Vec3) {
        let base = self.positions.len() as u32;
        for j in 0..=nv {
            for i in 0..=nu {
                let (u, v) = (i as f32 / nu as f32, j as f32 / nv as f32);
                let at = |t: f32, wrapped: bool| if wrapped && t == 1.0 { 0.0 } else { t };
                self.vertex(f(at(u, wrap[0]), at(v, wrap[1])), Vec2::new(u, v));
            }
        }
        let id = |i: usize, j: usize| base + (j * (nu + 1) + i) as u32;
        for j in 0..nv {
            for i in 0..nu {
                self.quad([id(i, j), id(i + 1, j), id(i + 1, j + 1), id(i, j + 1)], material);
            }
        }
    }

    pub fn map(&mut self, f: impl Fn(Vec3) -> Vec3) {
        for p in &mut self.positions {
            *p = f(*p);
        }
    }

    pub fn transformed(mut self, transform: Affine3A) -> Self {
        self.map(|p| transform.transform_point3(p));
        self
    }

    pub fn moved(self, offset: Vec3) -> Self {
        self.transformed(Affine3A::from_translation(offset))
    }

    pub fn rotated(self, rotation: Quat) -> Self {
        self.transformed(Affine3A::from_quat(rotation))
    }

    pub fn bounds(&self) -> (Vec3, Vec3) {
        self.positions
            .iter()
            .fold((Vec3::splat(f32::MAX), Vec3::splat(f32::MIN)), |(lo, hi), &p| (lo.min(p), hi.max(p)))
    }

    /// Flips all triangles of a surface that encloses a negative volume, so that they face outwards.
    fn orient_outwards(&mut self) {
        let (lo, hi) = self.bounds();
        let center = 0.5 * (lo + hi);
        let volume: f32 = self
            .triangles
            .iter()
            .map(|t| {
                let [a, b, c] = t.map(|i| self.positions[i as usize] - center);
                a.dot(b.cross(c))
            })
            .sum();
        if volume < 0.0 {
            for t in &mut self.triangles {
                t.swap(1, 2);
            }
        }
    }
}

/// The parts and materials of one object.
#[derive(Default)]
pub struct Assembly {
    parts: Vec<(Part, f32)>,
    materials: Vec<Material>,
}

impl Assembly {
    /// Registers a material and returns its index.
    pub fn material(&mut self, material: Material) -> u16 {
        self.materials.push(material);
        (self.materials.len() - 1) as u16
    }

    /// Adds a closed part. Edges sharper than `crease` degrees stay sharp.
    pub fn add(&mut self, mut part: Part, crease: f32) {
        part.orient_outwards();
        self.parts.push((part, crease));
    }

    pub fn parts(&self) -> impl Iterator<Item = &Part> {
        self.parts.iter().map(|(part, _)| part)
    }

    pub fn triangle_count(&self) -> usize {
        self.parts.iter().map(|(part, _)| part.triangles.len()).sum()
    }

    /// Joins the parts into a normalized mesh, turned by `rotation`.
    pub fn finish(self, rotation: Quat) -> Mesh {
        let mut mesh = Mesh { materials: self.materials, solid: true, ..Mesh::default() };
        for (part, crease) in &self.parts {
            append_with_normals(&mut mesh, part, crease.to_radians().cos());
        }
        mesh.normalize();
        mesh.rest = mesh.positions.clone();
        mesh.rotate(rotation);
        mesh.normalize();
        mesh
    }
}

/// Welds the part by position, averages the normals of adjacent faces that lie within the crease angle (weighted by
/// the corner's angle), and splits vertices where corners disagree.
fn append_with_normals(mesh: &mut Mesh, part: &Part, min_cos: f32) {
    let (lo, hi) = part.bounds();
    let cell = (hi - lo).max_element().max(1e-9) * 1e-5;
    let mut welds: HashMap<[i32; 3], u32> = HashMap::with_capacity(part.positions.len());
    let weld: Vec<u32> = part
        .positions
        .iter()
        .map(|&p| {
            let next = welds.len() as u32;
            *welds.entry(((p - lo) / cell).round().as_ivec3().to_array()).or_insert(next)
        })
        .collect();
    // Faces around each welded vertex, as a compressed list: the corners of vertex w are `corners[start[w]..start[w + 1]]`.
    let mut start = vec![0u32; welds.len() + 1];
    for t in &part.triangles {
        for &i in t {
            start[weld[i as usize] as usize + 1] += 1;
        }
    }
    for w in 0..welds.len() {
        start[w + 1] += start[w];
    }
    let mut fill = start.clone();
    let mut corners = vec![(0u32, 0.0f32); 3 * part.triangles.len()];
    let mut faces = Vec::with_capacity(part.triangles.len());
    for (face, t) in part.triangles.iter().enumerate() {
        let p = t.map(|i| part.positions[i as usize]);
        faces.push((p[1] - p[0]).cross(p[2] - p[0]).normalize_or_zero());
        for k in 0..3 {
            let (a, b) = (p[(k + 1) % 3] - p[k], p[(k + 2) % 3] - p[k]);
            let slot = &mut fill[weld[t[k] as usize] as usize];
            corners[*slot as usize] = (face as u32, a.angle_between(b));
            *slot += 1;
        }
    }
    let mut split: HashMap<(u32, [i16; 3]), u32> = HashMap::with_capacity(part.positions.len());
    for (face, t) in part.triangles.iter().enumerate() {
        let corner_ids = t.map(|i| {
            let w = weld[i as usize] as usize;
            let mut sum = Vec3::ZERO;
            for &(other, angle) in &corners[start[w] as usize..start[w + 1] as usize] {
                if faces[other as usize].dot(faces[face]) >= min_cos {
                    sum += angle * faces[other as usize];
                }
            }
            let normal = sum.try_normalize().unwrap_or(faces[face]);
            let key = (normal * 4000.0).round().as_ivec3();
            *split.entry((i, [key.x as i16, key.y as i16, key.z as i16])).or_insert_with(|| {
                mesh.positions.push(part.positions[i as usize]);
                mesh.normals.push(normal);
                mesh.uvs.push(part.uvs[i as usize]);
                (mesh.positions.len() - 1) as u32
            })
        });
        mesh.triangles.push(corner_ids);
        mesh.triangle_materials.push(part.materials[face]);
    }
}

#[cfg(test)]
impl Part {
    /// Edges that are not passed as often in one direction as in the other; vertices are told apart by position.
    pub fn open_edges(&self) -> usize {
        let id = |v: u32| (self.positions[v as usize] + Vec3::ZERO).to_array().map(f32::to_bits);
        let mut edges: HashMap<_, i32> = HashMap::new();
        for t in &self.triangles {
            for k in 0..3 {
                let (a, b) = (id(t[k]), id(t[(k + 1) % 3]));
                *edges.entry((a.min(b), a.max(b))).or_default() += if a < b { 1 } else { -1 };
            }
        }
        edges.values().filter(|&&n| n != 0).count()
    }
}
