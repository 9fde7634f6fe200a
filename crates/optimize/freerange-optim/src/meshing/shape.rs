//! Triangles with colors.

use std::collections::HashMap;

use glam::{DVec3, Vec2, Vec3};
use image::RgbImage;

/// A triangle mesh with shared vertices, counter-clockwise seen from outside.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shape {
    /// Positions, in the unit of the Gaussians, relative to `origin`. `[vertices]`
    pub positions: Vec<Vec3>,
    /// Unit normals, outwards. `[vertices]`
    pub normals: Vec<Vec3>,
    /// Colors, sRGB-encoded, 0..1. `[vertices]`, or empty
    pub colors: Vec<Vec3>,
    /// Numbers of vertices. `[triangles]`
    pub triangles: Vec<[u32; 3]>,
    /// A texture in place of colors. Vertices are doubled where its charts end.
    pub texture: Option<Baked>,
    /// What positions are relative to.
    pub origin: DVec3,
}

/// A texture of a mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Baked {
    /// Places in the picture, 0..1; (0, 0) is its upper left corner. `[vertices]`
    pub uvs: Vec<Vec2>,
    /// Colors, sRGB-encoded.
    pub image: RgbImage,
}

impl Shape {
    /// Whether every edge is that of exactly two triangles, in opposite directions: closed and manifold along edges.
    pub fn is_closed_manifold(&self) -> bool {
        let mut edges: HashMap<(u32, u32), u32> = HashMap::new();
        for [a, b, c] in &self.triangles {
            for edge in [(*a, *b), (*b, *c), (*c, *a)] {
                *edges.entry(edge).or_default() += 1;
            }
        }
        !edges.is_empty() && edges.iter().all(|((a, b), count)| *count == 1 && edges.contains_key(&(*b, *a)))
    }

    /// The volume within; negative where triangles face inwards.
    pub fn volume(&self) -> f64 {
        let at = |i: u32| self.positions[i as usize].as_dvec3();
        self.triangles.iter().map(|[a, b, c]| at(*a).dot(at(*b).cross(at(*c))) / 6.0).sum()
    }

    /// The area of all triangles.
    pub fn area(&self) -> f64 {
        self.triangles.iter().map(|t| self.area_of(t)).sum()
    }

    fn area_of(&self, [a, b, c]: &[u32; 3]) -> f64 {
        let at = |i: &u32| self.positions[*i as usize].as_dvec3();
        0.5 * (at(b) - at(a)).cross(at(c) - at(a)).length()
    }

    /// Leaves out connected parts whose area is less than `share` of the largest one's, and a texture.
    pub fn without_small_parts(&self, share: f64) -> Self {
        let mut parents: Vec<usize> = (0..self.positions.len()).collect();
        fn root(parents: &mut [usize], mut i: usize) -> usize {
            while parents[i] != i {
                parents[i] = parents[parents[i]];
                i = parents[i];
            }
            i
        }
        for [a, b, c] in &self.triangles {
            for other in [b, c] {
                let (p, q) = (root(&mut parents, *a as usize), root(&mut parents, *other as usize));
                parents[p.max(q)] = p.min(q);
            }
        }
        let roots: Vec<usize> = (0..parents.len()).map(|i| root(&mut parents, i)).collect();
        let mut areas: HashMap<usize, f64> = HashMap::new();
        for t in &self.triangles {
            *areas.entry(roots[t[0] as usize]).or_default() += self.area_of(t);
        }
        let most = areas.values().copied().fold(0.0, f64::max);
        let kept: Vec<bool> = roots.iter().map(|r| areas.get(r).is_some_and(|a| *a >= share * most)).collect();
        let mut numbers = vec![0u32; kept.len()];
        for (next, (number, _)) in (0..).zip(numbers.iter_mut().zip(&kept).filter(|(_, kept)| **kept)) {
            *number = next;
        }
        let pick = |values: &[Vec3]| values.iter().zip(&kept).filter(|(_, k)| **k).map(|(v, _)| *v).collect();
        let triangles = self.triangles.iter().filter(|t| kept[t[0] as usize]);
        Self {
            positions: pick(&self.positions),
            normals: pick(&self.normals),
            colors: pick(&self.colors),
            triangles: triangles.map(|t| t.map(|i| numbers[i as usize])).collect(),
            texture: None,
            origin: self.origin,
        }
    }
}
