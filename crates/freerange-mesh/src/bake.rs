//! Light that arrives indirectly, per surface point: visible environment plus interreflection (radiosity).

use std::collections::HashMap;
use std::f32::consts::TAU;

use glam::Vec3;

use crate::lighting::Lighting;
use crate::mesh::Mesh;
use crate::noise;
use crate::trace::{RawHit, Tracer};

/// Distance by which secondary rays start off the surface.
pub const OFFSET: f32 = 4e-4;

/// Passes of interreflection, after a first guess.
const BOUNCES: usize = 4;

const MISS: u32 = u32::MAX;
const INSIDE: u32 = u32::MAX - 1;

/// The result of [`bake`].
pub struct Baked {
    /// Indirect light per vertex: radiance that a white diffuse surface would show, without the direct sun. `[vertices]`
    pub light: Vec<Vec3>,
    /// True for vertices inside another part of the object. `[vertices]`
    pub buried: Vec<bool>,
}

pub fn bake(mesh: &Mesh, tracer: &Tracer, lighting: &Lighting) -> Baked {
    let (point_of, points) = weld(mesh);
    let rays = lighting.rays.clamp(1, 512) as usize;
    let mut targets = vec![MISS; points.len() * rays];
    let mut buried = vec![false; points.len()];
    let mut sun = vec![0.0f32; points.len()];
    for (i, &(position, normal)) in points.iter().enumerate() {
        let origin = position + OFFSET * normal;
        let (x, y) = normal.any_orthonormal_pair();
        let shift = noise::unit(noise::hash3((position * 1e4).round().as_ivec3(), 77));
        let targets = &mut targets[i * rays..(i + 1) * rays];
        let mut inside = 0;
        for (k, target) in targets.iter_mut().enumerate() {
            // Cosine-weighted: a Fibonacci spiral over the disc, turned by a random angle.
            let r2 = (k as f32 + 0.5) / rays as f32;
            let angle = TAU * (k as f32 * 0.618_034 + shift);
            let r = r2.sqrt();
            let direction = r * angle.cos() * x + r * angle.sin() * y + (1.0 - r2).sqrt() * normal;
            match tracer.closest(origin, direction, 0.0) {
                None => {}
                Some(RawHit { back: true, .. }) => {
                    *target = INSIDE;
                    inside += 1;
                }
                Some(hit) => *target = hit.triangle,
            }
            // Most buried points show it early.
            if k == 7 && inside == 8 {
                inside = rays;
                break;
            }
        }
        buried[i] = 4 * inside > 3 * rays;
        let cos = normal.dot(lighting.sun_direction);
        if lighting.sun > 0.0 && cos > 0.0 && !buried[i] && !tracer.occluded(origin, lighting.sun_direction, 0.0) {
            sun[i] = lighting.sun * cos / std::f32::consts::PI;
        }
    }
    let neighbors = neighbors(mesh, &point_of, points.len());
    let mut light = gather(mesh, &point_of, &targets, rays, &buried, &sun, lighting.environment);
    fill_buried(&mut light, &buried, &neighbors);
    for _ in 0..2 {
        light = smoothed(&light, &buried, &neighbors);
    }
    Baked {
        light: point_of.iter().map(|&p| light[p as usize]).collect(),
        buried: point_of.iter().map(|&p| buried[p as usize]).collect(),
    }
}

/// Joins vertices that differ in texture coordinates only.
fn weld(mesh: &Mesh) -> (Vec<u32>, Vec<(Vec3, Vec3)>) {
    let mut known: HashMap<[i32; 6], u32> = HashMap::with_capacity(mesh.positions.len());
    let mut points = Vec::new();
    let point_of = mesh
        .positions
        .iter()
        .zip(&mesh.normals)
        .map(|(&p, &n)| {
            let (kp, kn) = ((p * 2e4).round().as_ivec3(), (n * 50.0).round().as_ivec3());
            *known.entry([kp.x, kp.y, kp.z, kn.x, kn.y, kn.z]).or_insert_with(|| {
                points.push((p, n));
                (points.len() - 1) as u32
            })
        })
        .collect();
    (point_of, points)
}

/// Radiosity: what leaves each triangle is its albedo times the mean light of its corners.
fn gather(
    mesh: &Mesh,
    point_of: &[u32],
    targets: &[u32],
    rays: usize,
    buried: &[bool],
    sun: &[f32],
    environment: f32,
) -> Vec<Vec3> {
    let corners: Vec<[u32; 3]> = mesh.triangles.iter().map(|t| t.map(|v| point_of[v as usize])).collect();
    let albedo: Vec<Vec3> = mesh
        .triangles
        .iter()
        .zip(&mesh.triangle_materials)
        .map(|(t, &m)| {
            let third = 1.0 / 3.0;
            let p = t.iter().map(|&v| mesh.rest[v as usize]).sum::<Vec3>() * third;
            let uv = t.iter().map(|&v| mesh.uvs[v as usize]).sum::<glam::Vec2>() * third;
            mesh.materials[usize::from(m)].albedo(p, uv)
        })
        .collect();
    // First guess: surroundings as bright as the point itself, with the mean albedo.
    let mean = albedo.iter().sum::<Vec3>() / albedo.len().max(1) as f32;
    let mut light: Vec<Vec3> = targets
        .chunks_exact(rays)
        .map(|t| {
            let (open, inside) = t.iter().fold((0.0, 0.0), |(open, inside), &t| match t {
                MISS => (open + 1.0, inside),
                INSIDE => (open, inside + 1.0),
                _ => (open, inside),
            });
            let closed = rays as f32 - open - inside;
            environment * (open + 1.0) / (Vec3::splat(open + 1.0) + (Vec3::ONE - mean).max(Vec3::ZERO) * closed)
        })
        .collect();
    for _ in 0..BOUNCES {
        let leaving: Vec<Vec3> = corners
            .iter()
            .zip(&albedo)
            .map(|(c, &a)| {
                let open: Vec3 = c
                    .iter()
                    .filter(|&&p| !buried[p as usize])
                    .map(|&p| light[p as usize] + Vec3::splat(sun[p as usize]))
                    .sum();
                let n = c.iter().filter(|&&p| !buried[p as usize]).count();
                a * open / n.max(1) as f32
            })
            .collect();
        for (i, value) in light.iter_mut().enumerate() {
            // Rays that start into the material (at concave edges, or just inside another part) tell nothing.
            let (sum, n) = targets[i * rays..(i + 1) * rays].iter().fold((Vec3::ZERO, 0), |(sum, n), &t| match t {
                MISS => (sum + Vec3::splat(environment), n + 1),
                INSIDE => (sum, n),
                t => (sum + leaving[t as usize], n + 1),
            });
            *value = sum / n.max(1) as f32;
        }
    }
    light
}

/// Adjacent points of every point, as a compressed list.
fn neighbors(mesh: &Mesh, point_of: &[u32], points: usize) -> (Vec<u32>, Vec<u32>) {
    let edges = || {
        mesh.triangles.iter().flat_map(|t| {
            let p = t.map(|v| point_of[v as usize]);
            (0..3).flat_map(move |k| [(p[k], p[(k + 1) % 3]), (p[(k + 1) % 3], p[k])])
        })
    };
    let mut start = vec![0u32; points + 1];
    for (a, _) in edges() {
        start[a as usize + 1] += 1;
    }
    for i in 0..points {
        start[i + 1] += start[i];
    }
    let mut fill = start.clone();
    let mut list = vec![0u32; start[points] as usize];
    for (a, b) in edges() {
        list[fill[a as usize] as usize] = b;
        fill[a as usize] += 1;
    }
    (start, list)
}

fn around((start, list): &(Vec<u32>, Vec<u32>), i: usize) -> &[u32] {
    &list[start[i] as usize..start[i + 1] as usize]
}

/// Buried points have no light of their own; the visible part of their triangles takes that of its surroundings.
fn fill_buried(light: &mut [Vec3], buried: &[bool], neighbors: &(Vec<u32>, Vec<u32>)) {
    let mut known: Vec<bool> = buried.iter().map(|b| !b).collect();
    for _ in 0..3 {
        let before = known.clone();
        for i in 0..light.len() {
            if before[i] {
                continue;
            }
            let lit = around(neighbors, i).iter().filter(|&&n| before[n as usize]);
            let (sum, n) = lit.fold((Vec3::ZERO, 0), |(s, n), &p| (s + light[p as usize], n + 1));
            if n > 0 {
                light[i] = sum / n as f32;
                known[i] = true;
            }
        }
    }
}

fn smoothed(light: &[Vec3], buried: &[bool], neighbors: &(Vec<u32>, Vec<u32>)) -> Vec<Vec3> {
    (0..light.len())
        .map(|i| {
            let open = around(neighbors, i).iter().filter(|&&n| !buried[n as usize] || buried[i]);
            let (sum, n) = open.fold((Vec3::ZERO, 0), |(s, n), &p| (s + light[p as usize], n + 1));
            if n == 0 { light[i] } else { 0.5 * light[i] + 0.5 * sum / n as f32 }
        })
        .collect()
}
