//! Light that arrives indirectly, per surface point: visible environment plus interreflection (radiosity).
//!
//! Light is kept per *point*: a place with a normal, shared by the vertices that have both. Solid meshes have light on
//! their outside only. Other meshes have it on both sides, except for the inside of their closed parts.

use std::collections::HashMap;
use std::f32::consts::TAU;

use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::mesh::Mesh;
use crate::mesh::noise;
use crate::render::lighting::Lighting;
use crate::render::refine::solid_triangles;
use crate::render::trace::Tracer;
use freerange_util::{Invalid, check};

/// Distance by which secondary rays start off the surface.
pub const OFFSET: f32 = 4e-4;

/// Passes of interreflection, after a first guess.
const BOUNCES: usize = 4;

/// Further rays that look for a way out where none of the first ones found it.
const PROBES: usize = 32;

/// What lets more than this share of the light through does not hide what lies behind it.
const THIN: f32 = 0.01;

const MISS: u32 = u32::MAX;
const INSIDE: u32 = u32::MAX - 1;

/// How finely light is stored on meshes that are not [`Mesh::solid`]; those are taken as they are.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BakeConfig {
    /// Longer edges are split, since light is interpolated between vertices.
    pub max_edge: f32,
    /// No edge is split beyond this number of triangles.
    pub max_triangles: usize,
    /// Most points that light is computed at. Denser meshes share points between near vertices with like normals, so
    /// that time and memory stay bounded: at most twice this times [`Lighting::rays`] rays, and a few more where
    /// nothing is seen.
    pub max_points: usize,
}

impl Default for BakeConfig {
    fn default() -> Self {
        Self { max_edge: 0.04, max_triangles: 100_000, max_points: 30_000 }
    }
}

impl BakeConfig {
    /// Checks every range.
    pub fn validate(&self) -> Result<(), Invalid> {
        check((1e-3..=10.0).contains(&self.max_edge), "max_edge", "0.001 to 10", self.max_edge)?;
        check(self.max_triangles <= 100_000_000, "max_triangles", "at most 1e8", self.max_triangles)?;
        check((100..=10_000_000).contains(&self.max_points), "max_points", "100 to 1e7", self.max_points)
    }
}

/// The result of [`bake`].
pub struct Baked {
    /// Indirect light per vertex: radiance that a white diffuse surface would show, without the direct sun. `[vertices]`
    pub light: Vec<Vec3>,
    /// The same for the side that the normals point away from. `[vertices]`, or empty for solid meshes
    pub back: Vec<Vec3>,
    /// True for vertices whose outside nobody can see. `[vertices]`
    pub buried: Vec<bool>,
    /// True for vertices in whose surroundings nobody can see anything, from either side. `[vertices]`
    pub hidden: Vec<bool>,
}

/// What bake knows of the points. Stations are the points' outsides, followed by their insides unless the mesh is solid.
struct Stations {
    rays: usize,
    /// What each ray meets: twice the triangle, plus one for its back; or `MISS` or `INSIDE`. `[stations, rays]`
    targets: Vec<u32>,
    buried: Vec<bool>,
    sun: Vec<f32>,
}

pub fn bake(mesh: &Mesh, tracer: &Tracer, lighting: &Lighting, config: &BakeConfig) -> Baked {
    let max_points = if mesh.solid { usize::MAX } else { config.max_points };
    let (point_of, points) = weld(mesh, max_points);
    let solid = if mesh.solid { vec![true; mesh.triangles.len()] } else { solid_triangles(mesh) };
    let stations = look_around(mesh, tracer, lighting, &point_of, &points, &solid);
    let neighbors = neighbors(mesh, &point_of, points.len());
    let mut light = gather(mesh, &point_of, points.len(), &stations, lighting.environment);
    let mut sides =
        light.chunks_exact_mut(points.len()).zip(stations.buried.chunks_exact(points.len())).map(|(light, buried)| {
            fill_buried(light, buried, &neighbors);
            let light = smoothed(light, buried, &neighbors);
            let light = smoothed(&light, buried, &neighbors);
            point_of.iter().map(|&p| light[p as usize]).collect::<Vec<_>>()
        });
    let (light, back) = (sides.next().unwrap_or_default(), sides.next().unwrap_or_default());
    drop(sides);
    let n = points.len();
    let unseen = |p: usize| stations.buried[p] && stations.buried.get(n + p).is_none_or(|&b| b);
    let hidden = |p: usize| unseen(p) && (mesh.solid || around(&neighbors, p).iter().all(|&p| unseen(p as usize)));
    Baked {
        light,
        back,
        buried: point_of.iter().map(|&p| stations.buried[p as usize]).collect(),
        hidden: point_of.iter().map(|&p| hidden(p as usize)).collect(),
    }
}

/// Towards the middle of each point's triangles, with their number, for a station a little off its vertex: in a corner it would
/// otherwise lie in the plane of another wall. And whether all of them close a solid.
fn inwards_of(mesh: &Mesh, point_of: &[u32], solid: &[bool], n: usize) -> (Vec<(Vec3, f32)>, Vec<bool>) {
    let mut inwards = vec![(Vec3::ZERO, 0.0); n];
    let mut closed = vec![true; n];
    if !mesh.solid {
        for (i, t) in mesh.triangles.iter().enumerate() {
            let center = mesh.corners(i).iter().sum::<Vec3>() / 3.0;
            for &v in t {
                let p = point_of[v as usize] as usize;
                // Points of clustered vertices stay near their own vertex.
                inwards[p].0 += (center - mesh.positions[v as usize]).clamp_length_max(0.02);
                inwards[p].1 += 1.0;
                closed[p] &= solid[i];
            }
        }
    }
    (inwards, closed)
}

/// Sends rays from every station.
fn look_around(
    mesh: &Mesh,
    tracer: &Tracer,
    lighting: &Lighting,
    point_of: &[u32],
    points: &[(Vec3, Vec3)],
    solid: &[bool],
) -> Stations {
    let n = points.len();
    let count = if mesh.solid { n } else { 2 * n };
    let rays = lighting.rays.clamp(1, 512) as usize;
    let mut s = Stations { rays, targets: vec![MISS; count * rays], buried: vec![false; count], sun: vec![0.0; count] };
    let (inwards, closed) = inwards_of(mesh, point_of, solid, n);
    for i in 0..count {
        let p = i % n;
        if i >= n && closed[p] {
            s.buried[i] = true;
            s.targets[i * rays..(i + 1) * rays].fill(INSIDE);
            continue;
        }
        let (position, mut normal) = points[p];
        if i >= n {
            normal = -normal;
        }
        let origin = position + OFFSET * normal + 0.05 * inwards[p].0 / f32::max(inwards[p].1, 1.0);
        let (x, y) = normal.any_orthonormal_pair();
        let seed = noise::hash3((position * 1e4).round().as_ivec3(), 77 + (i >= n) as u32);
        let shift = noise::unit(seed);
        // Cosine-weighted: a Fibonacci spiral over the disc, turned by a random angle.
        let direction = |k: usize, of: usize| {
            let r2 = (k as f32 + 0.5) / of as f32;
            let angle = TAU * (k as f32 * 0.618_034 + shift);
            let r = r2.sqrt();
            r * angle.cos() * x + r * angle.sin() * y + (1.0 - r2).sqrt() * normal
        };
        let (mut inside, mut open) = (0, 0);
        for (k, target) in s.targets[i * rays..(i + 1) * rays].iter_mut().enumerate() {
            let chance = noise::unit(noise::hash3(glam::IVec3::new(k as i32, seed as i32, 5), 78));
            match tracer.closest_by_chance(mesh, origin, direction(k, rays), chance) {
                None => open += 1,
                Some(hit) if hit.back && solid[hit.triangle as usize] => {
                    *target = INSIDE;
                    inside += 1;
                }
                Some(hit) => *target = 2 * hit.triangle + u32::from(hit.back),
            }
            // Most buried points show it early.
            if mesh.solid && k == 7 && inside == 8 {
                inside = rays;
                break;
            }
        }
        s.buried[i] = if mesh.solid {
            4 * inside > 3 * rays
        } else {
            open == 0
                && (0..PROBES).all(|k| tracer.closest_by_chance(mesh, origin, direction(k, PROBES), THIN).is_some())
        };
        let cos = normal.dot(lighting.sun_direction);
        if lighting.sun > 0.0 && cos > 0.0 && !s.buried[i] {
            let through = tracer.transmittance(mesh, origin, lighting.sun_direction);
            s.sun[i] = through * lighting.sun * cos / std::f32::consts::PI;
        }
    }
    s
}

/// Joins vertices that differ in texture coordinates only; and where that leaves more than `max_points`, also vertices
/// that are near each other and have like normals. The first vertex of each point gives its place and normal.
fn weld(mesh: &Mesh, max_points: usize) -> (Vec<u32>, Vec<(Vec3, Vec3)>) {
    /// Cells per unit: one point per direction in each of them is as few as it gets.
    const COARSEST: f32 = 4.0;
    let (mut cells, mut facets) = (2e4, 50.0);
    loop {
        let mut known: HashMap<[i32; 6], u32> = HashMap::with_capacity(mesh.positions.len().min(max_points));
        let mut points = Vec::new();
        let mut point_of = Vec::with_capacity(mesh.positions.len());
        for (&p, &n) in mesh.positions.iter().zip(&mesh.normals) {
            let (kp, kn) = ((p * cells).round().as_ivec3(), (n * facets).round().as_ivec3());
            point_of.push(*known.entry([kp.x, kp.y, kp.z, kn.x, kn.y, kn.z]).or_insert_with(|| {
                points.push((p, n));
                (points.len() - 1) as u32
            }));
            if points.len() > max_points && cells >= COARSEST {
                break;
            }
        }
        if points.len() <= max_points || cells < COARSEST {
            return (point_of, points);
        }
        // From 200 cells per unit (half a pixel in an image of 128) downwards; normals within about 30 degrees.
        (cells, facets) = (f32::min(cells * 0.7, 400.0), 2.0);
    }
}

/// Radiosity: what leaves each side of a triangle is its albedo times the mean light of its corners.
fn gather(mesh: &Mesh, point_of: &[u32], points: usize, stations: &Stations, environment: f32) -> Vec<Vec3> {
    let Stations { rays, targets, buried, sun } = stations;
    let corners: Vec<[u32; 3]> = mesh.triangles.iter().map(|t| t.map(|v| point_of[v as usize])).collect();
    let looks: Vec<(Vec3, Vec3)> = (0..mesh.triangles.len()).map(|i| look(mesh, i)).collect();
    // First guess: surroundings as bright as the point itself, with the mean albedo.
    let mean = looks.iter().map(|l| l.0).sum::<Vec3>() / looks.len().max(1) as f32;
    let mut light: Vec<Vec3> = targets
        .chunks_exact(*rays)
        .map(|t| {
            let (open, inside) = t.iter().fold((0.0, 0.0), |(open, inside), &t| match t {
                MISS => (open + 1.0, inside),
                INSIDE => (open, inside + 1.0),
                _ => (open, inside),
            });
            let closed = *rays as f32 - open - inside;
            environment * (open + 1.0) / (Vec3::splat(open + 1.0) + (Vec3::ONE - mean).max(Vec3::ZERO) * closed)
        })
        .collect();
    for _ in 0..BOUNCES {
        let leaving: Vec<[Vec3; 2]> = corners
            .iter()
            .zip(&looks)
            .map(|(c, &(albedo, emission))| {
                [0, points].map(|side| {
                    let seen = || c.iter().map(|&p| p as usize + side).filter(|&p| !buried.get(p).unwrap_or(&true));
                    let open: Vec3 = seen().map(|p| light[p] + Vec3::splat(sun[p])).sum();
                    albedo * open / seen().count().max(1) as f32 + emission
                })
            })
            .collect();
        for (i, value) in light.iter_mut().enumerate() {
            // Rays that start into the material (at concave edges, or just inside another part) tell nothing.
            let (sum, n) = targets[i * rays..(i + 1) * rays].iter().fold((Vec3::ZERO, 0), |(sum, n), &t| match t {
                MISS => (sum + Vec3::splat(environment), n + 1),
                INSIDE => (sum, n),
                t => (sum + leaving[t as usize / 2][t as usize % 2], n + 1),
            });
            *value = sum / n.max(1) as f32;
        }
    }
    light
}

/// Mean albedo and emission of a triangle.
fn look(mesh: &Mesh, i: usize) -> (Vec3, Vec3) {
    let corners = mesh.triangles[i].map(|v| v as usize);
    let third = 1.0 / 3.0;
    let rest = corners.iter().map(|&v| mesh.rest[v]).sum::<Vec3>() * third;
    let [a, b, c] = corners.map(|v| mesh.uvs[v]);
    let uv = (a + b + c) * third;
    let footprint = (0.5 * (b - a).perp_dot(c - a)).abs().sqrt();
    let material = &mesh.materials[usize::from(mesh.triangle_materials[i])];
    let color = material.rgba(rest, uv, mesh.tint(corners, [third; 3]), footprint).truncate();
    let emission = material.emitted(uv, footprint);
    if material.unlit { (Vec3::ZERO, color + emission) } else { (color, emission) }
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
