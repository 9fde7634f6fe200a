//! What a mesh from a file needs before light is baked onto its vertices.

use std::collections::HashMap;

use glam::Vec3;

use crate::mesh::Mesh;
use crate::mesh::{AlphaMode, Material, Texture};

/// Splits edges longer than `max_edge` at their midpoints until none is left or a further pass would exceed
/// `max_triangles`. Whether and where an edge is split depends on its end points only, so the triangles on both sides
/// agree and no crack opens, even where vertices are split.
pub fn refine(mesh: &mut Mesh, max_edge: f32, max_triangles: usize) {
    loop {
        let longest = (0..mesh.triangles.len()).flat_map(|i| sides(mesh.corners(i))).fold(0.0, f32::max);
        if !longest.is_finite() || longest <= max_edge {
            return;
        }
        // The longest edges first: the cap then leaves edges of similar length.
        let limit = max_edge.max(0.7 * longest);
        let long: Vec<[bool; 3]> =
            (0..mesh.triangles.len()).map(|i| sides(mesh.corners(i)).map(|l| l > limit)).collect();
        let added: usize = long.iter().flatten().filter(|&&l| l).count();
        if mesh.triangles.len() + added > max_triangles {
            return;
        }
        split(mesh, &long);
    }
}

/// Lengths of the edges from each corner to the next.
fn sides([a, b, c]: [Vec3; 3]) -> [f32; 3] {
    [(a - b).length(), (b - c).length(), (c - a).length()]
}

/// Splits the marked edges at their midpoints.
fn split(mesh: &mut Mesh, long: &[[bool; 3]]) {
    let old = std::mem::take(&mut mesh.triangles);
    let materials = std::mem::take(&mut mesh.triangle_materials);
    let mut known: HashMap<[u32; 2], u32> = HashMap::new();
    for ((t, long), material) in old.into_iter().zip(long).zip(materials) {
        let middle: [Option<u32>; 3] = std::array::from_fn(|k| {
            let (a, b) = (t[k], t[(k + 1) % 3]);
            long[k].then(|| *known.entry([a.min(b), a.max(b)]).or_insert_with(|| midpoint(mesh, a, b)))
        });
        let count = middle.iter().flatten().count();
        // Turn the triangle so that one split edge comes first, or two come first and second.
        let turn = match count {
            1 => middle.iter().position(Option::is_some).unwrap_or(0),
            2 => (middle.iter().position(Option::is_none).unwrap_or(0) + 1) % 3,
            _ => 0,
        };
        let [a, b, c]: [u32; 3] = std::array::from_fn(|k| t[(k + turn) % 3]);
        let m: [Option<u32>; 3] = std::array::from_fn(|k| middle[(k + turn) % 3]);
        match m {
            [Some(ab), Some(bc), Some(ca)] => {
                mesh.triangles.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
            }
            [Some(ab), Some(bc), None] => {
                let p = |i: u32| mesh.positions[i as usize];
                mesh.triangles.push([ab, b, bc]);
                if p(a).distance_squared(p(bc)) <= p(ab).distance_squared(p(c)) {
                    mesh.triangles.extend([[a, ab, bc], [a, bc, c]]);
                } else {
                    mesh.triangles.extend([[a, ab, c], [ab, bc, c]]);
                }
            }
            [Some(ab), None, None] => mesh.triangles.extend([[a, ab, c], [ab, b, c]]),
            _ => mesh.triangles.push(t),
        }
        mesh.triangle_materials.resize(mesh.triangles.len(), material);
    }
}

fn midpoint(mesh: &mut Mesh, a: u32, b: u32) -> u32 {
    let (a, b) = (a as usize, b as usize);
    mesh.positions.push(0.5 * (mesh.positions[a] + mesh.positions[b]));
    mesh.rest.push(0.5 * (mesh.rest[a] + mesh.rest[b]));
    mesh.uvs.push(0.5 * (mesh.uvs[a] + mesh.uvs[b]));
    mesh.normals.push((mesh.normals[a] + mesh.normals[b]).try_normalize().unwrap_or(mesh.normals[a]));
    if !mesh.colors.is_empty() {
        mesh.colors.push(0.5 * (mesh.colors[a] + mesh.colors[b]));
    }
    (mesh.positions.len() - 1) as u32
}

/// Turns triangles over whose winding contradicts their vertex normals.
pub fn orient(mesh: &mut Mesh) {
    for i in 0..mesh.triangles.len() {
        let [a, b, c] = mesh.corners(i);
        let normals: Vec3 = mesh.triangles[i].iter().map(|&v| mesh.normals[v as usize]).sum();
        if (b - a).cross(c - a).dot(normals) < 0.0 {
            mesh.triangles[i].swap(1, 2);
        }
    }
}

/// Calls materials opaque whose alpha is one everywhere, so that no ray looks for what lies behind them.
pub fn simplify_alpha(mesh: &mut Mesh) {
    let faded = mesh.colors.iter().any(|c| c.w < 1.0);
    for Material { alpha, texture, factor, .. } in &mut mesh.materials {
        let picture = matches!(texture, Texture::Image(map) if map.picture.has_alpha());
        let always_one = !picture && !faded && factor.w >= 1.0;
        if always_one && !matches!(alpha, AlphaMode::Mask { cutoff } if *cutoff > 1.0) {
            *alpha = AlphaMode::Opaque;
        }
    }
}

/// Per triangle: true if it belongs to a closed, opaque surface that faces outwards, so that its back is never seen.
/// Surfaces are joined where positions agree.
pub fn solid_triangles(mesh: &Mesh) -> Vec<bool> {
    let weld = weld(mesh);
    let mut parent: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    for t in &mesh.triangles {
        for k in [1, 2] {
            let (a, b) = (root(&mut parent, weld[t[0] as usize]), root(&mut parent, weld[t[k] as usize]));
            parent[a.max(b) as usize] = a.min(b);
        }
    }
    let mut closed = vec![true; parent.len()];
    let mut volume = vec![0.0f64; parent.len()];
    let mut edges = Vec::with_capacity(3 * mesh.triangles.len());
    for (i, t) in mesh.triangles.iter().enumerate() {
        let w = t.map(|v| weld[v as usize]);
        let of = root(&mut parent, w[0]) as usize;
        let [a, b, c] = mesh.corners(i).map(|p| p.as_dvec3());
        volume[of] += a.dot(b.cross(c));
        closed[of] &= mesh.materials[usize::from(mesh.triangle_materials[i])].alpha == AlphaMode::Opaque;
        for k in 0..3 {
            let (a, b) = (w[k], w[(k + 1) % 3]);
            if a != b {
                edges.push((a.min(b), a.max(b), if a < b { 1i32 } else { -1 }));
            }
        }
    }
    edges.sort_unstable();
    for edge in edges.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        if edge.iter().map(|e| e.2).sum::<i32>() != 0 {
            let of = root(&mut parent, edge[0].0) as usize;
            closed[of] = false;
        }
    }
    mesh.triangles
        .iter()
        .map(|t| {
            let of = root(&mut parent, weld[t[0] as usize]) as usize;
            closed[of] && volume[of] > 1e-9
        })
        .collect()
}

/// Per vertex, the first vertex at its place. Places agree that share a cell of one of two grids, half a cell apart.
fn weld(mesh: &Mesh) -> Vec<u32> {
    let mut parent: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    for shift in [0.0, 0.5] {
        let mut known: HashMap<[i32; 3], u32> = HashMap::with_capacity(mesh.positions.len());
        for (i, p) in mesh.positions.iter().enumerate() {
            let cell = (*p * 1e5 + shift).round().as_ivec3().to_array();
            let first = *known.entry(cell).or_insert(i as u32);
            let (a, b) = (root(&mut parent, first), root(&mut parent, i as u32));
            parent[a.max(b) as usize] = a.min(b);
        }
    }
    (0..parent.len() as u32).map(|i| root(&mut parent, i)).collect()
}

fn root(parent: &mut [u32], mut i: u32) -> u32 {
    while parent[i as usize] != i {
        parent[i as usize] = parent[parent[i as usize] as usize];
        i = parent[i as usize];
    }
    i
}

#[cfg(test)]
mod tests {
    use glam::{Vec2, Vec4};

    use super::*;
    use crate::generate::{GeneratorConfig, generate};

    /// A tetrahedron of four separate faces.
    fn tetrahedron() -> Mesh {
        let p = [
            Vec3::new(0.3, 0.3, 0.3),
            Vec3::new(0.3, -0.3, -0.3),
            Vec3::new(-0.3, 0.3, -0.3),
            Vec3::new(-0.3, -0.3, 0.3),
        ];
        let mut mesh = Mesh { materials: vec![Material::default()], ..Mesh::default() };
        for (n, face) in [[1, 3, 2], [0, 2, 3], [0, 3, 1], [0, 1, 2]].iter().enumerate() {
            for (k, &v) in face.iter().enumerate() {
                mesh.positions.push(p[v]);
                mesh.normals.push(-p[n].normalize());
                mesh.uvs.push(Vec2::new(k as f32, (k / 2) as f32));
                mesh.colors.push(Vec4::new(k as f32, 1.0, 1.0, 1.0));
            }
            mesh.triangles.push([0, 1, 2].map(|k| (3 * n + k) as u32));
            mesh.triangle_materials.push(0);
        }
        mesh.rest.clone_from(&mesh.positions);
        mesh
    }

    #[test]
    fn refined_meshes_stay_closed_and_keep_area_and_coordinates() {
        let mut mesh = tetrahedron();
        orient(&mut mesh);
        assert!(solid_triangles(&mesh).iter().all(|&s| s));
        let area: f32 = (0..4).map(|i| mesh.area(i)).sum();
        refine(&mut mesh, 0.04, 100_000);
        assert!(mesh.validate().is_ok());
        assert!(mesh.triangles.len() > 1000, "{}", mesh.triangles.len());
        let longest = (0..mesh.triangles.len()).flat_map(|i| sides(mesh.corners(i))).fold(0.0, f32::max);
        assert!(longest <= 0.04, "{longest}");
        assert!((area - (0..mesh.triangles.len()).map(|i| mesh.area(i)).sum::<f32>()).abs() < 1e-4 * area);
        // Every edge has its counterpart: no cracks.
        assert!(solid_triangles(&mesh).iter().all(|&s| s));
        for (uv, color) in mesh.uvs.iter().zip(&mesh.colors) {
            assert!((uv.x - color.x).abs() < 1e-5 && color.w == 1.0);
        }
    }

    #[test]
    fn the_cap_on_triangles_holds_and_leaves_no_crack() {
        let mut mesh = tetrahedron();
        orient(&mut mesh);
        refine(&mut mesh, 0.001, 3000);
        assert!((800..=3000).contains(&mesh.triangles.len()), "{}", mesh.triangles.len());
        assert!(solid_triangles(&mesh).iter().all(|&s| s));
    }

    #[test]
    fn open_inverted_and_see_through_surfaces_are_not_solid() {
        let solid = |change: &dyn Fn(&mut Mesh)| {
            let mut mesh = tetrahedron();
            orient(&mut mesh);
            change(&mut mesh);
            solid_triangles(&mesh).iter().any(|&s| s)
        };
        assert!(solid(&|_| {}));
        assert!(!solid(&|m| {
            m.triangles.pop();
            m.triangle_materials.pop();
        }));
        assert!(!solid(&|m| m.triangles.iter_mut().for_each(|t| t.swap(1, 2))));
        assert!(!solid(&|m| m.materials[0].alpha = AlphaMode::Blend));
    }

    #[test]
    fn generated_objects_are_solid() {
        for seed in 0..5 {
            let mesh = generate(seed, &GeneratorConfig::default()).unwrap();
            let mut turned = mesh.clone();
            for t in turned.triangles.iter_mut().step_by(3) {
                t.swap(0, 2);
            }
            orient(&mut turned);
            let differ = (0..mesh.triangles.len()).filter(|&i| {
                let normal = |m: &Mesh| {
                    let [a, b, c] = m.corners(i);
                    (b - a).cross(c - a)
                };
                normal(&mesh).dot(normal(&turned)) < 0.0
            });
            assert_eq!(differ.count(), 0, "seed {seed}");
        }
    }
}
