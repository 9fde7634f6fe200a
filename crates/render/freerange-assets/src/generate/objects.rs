//! The generator: picks a family, builds its parts, turns and normalises the result.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use glam::{Affine3A, EulerRot, Quat, Vec2, Vec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::generate::config::{GeneratorConfig, Kind};
use crate::generate::part::{Assembly, Part};
use crate::generate::shapes::{self, Span};
use crate::generate::style::{Style, unit_vector};
use crate::generate::{household, packaging, soft, vessels, woven};
use crate::mesh::Mesh;
use crate::mesh::Texture;
use crate::mesh::noise;
use freerange_util::Invalid;

/// Objects with more triangles than this get no further parts.
const MANY: usize = 7000;

/// The object of a seed: a pure function of (`seed`, `config`).
pub fn generate(seed: u64, config: &GeneratorConfig) -> Result<Mesh, Invalid> {
    config.validate()?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let kind = draw_kind(&mut rng, config);
    let mut style = Style::new(rng, config);
    let s = &mut style;
    let mut assembly = Assembly::default();
    let a = &mut assembly;
    match kind {
        Kind::Composition => composition(a, s),
        Kind::Mug => vessels::mug(a, s),
        Kind::Bowl => vessels::bowl(a, s),
        Kind::Plate => vessels::plate(a, s),
        Kind::Pan => vessels::pan(a, s),
        Kind::Teapot => vessels::teapot(a, s),
        Kind::Jar => vessels::jar(a, s),
        Kind::Lamp => vessels::lamp(a, s),
        Kind::Can => packaging::can(a, s),
        Kind::Bottle => packaging::bottle(a, s),
        Kind::Carton => packaging::carton(a, s),
        Kind::OpenBox => packaging::open_box(a, s),
        Kind::Book => packaging::book(a, s),
        Kind::Fruit => household::fruit(a, s),
        Kind::Loaf => household::loaf(a, s),
        Kind::Basket => household::basket(a, s),
        Kind::Rack => household::rack(a, s),
        Kind::Utensil => household::utensil(a, s),
        Kind::Stack => household::stack(a, s),
        Kind::Pouch => soft::pouch(a, s),
        Kind::Tube => soft::tube(a, s),
        Kind::Toy => soft::toy(a, s),
        Kind::Textile => soft::textile(a, s),
        Kind::Wicker => woven::wicker(a, s),
        Kind::Wire => woven::wire(a, s),
    }
    let rotation = rotation(s);
    let mut mesh = assembly.finish(rotation);
    if !config.prints {
        mesh.materials.iter_mut().for_each(|m| unprint(&mut m.texture));
    }
    Ok(mesh)
}

/// Puts its mean colour in the place of a print.
fn unprint(texture: &mut Texture) {
    match texture {
        Texture::Print(raster) => *texture = Texture::Flat(raster.mean()),
        Texture::Worn(wear) => unprint(&mut wear.base),
        Texture::Patches { base, over, .. } => {
            unprint(base);
            unprint(over);
        }
        _ => {}
    }
}

/// The family of the object that [`generate`] makes of `seed`.
pub fn kind_of(seed: u64, config: &GeneratorConfig) -> Result<Kind, Invalid> {
    config.validate()?;
    Ok(draw_kind(&mut ChaCha8Rng::seed_from_u64(seed), config))
}

fn draw_kind(rng: &mut ChaCha8Rng, config: &GeneratorConfig) -> Kind {
    let weights = config.weights();
    let mut x = rng.random::<f32>() * weights.iter().map(|w| w.1).sum::<f32>();
    let mut chosen = Kind::Composition;
    for (kind, weight) in weights {
        if weight > 0.0 {
            chosen = kind;
            if x < weight {
                break;
            }
        }
        x -= weight;
    }
    chosen
}

fn rotation(s: &mut Style) -> Quat {
    let yaw = Quat::from_rotation_z(s.range(0.0, TAU));
    let x: f32 = s.rng.random();
    if x < s.config.upright_share {
        yaw
    } else if x < s.config.upright_share + s.config.lying_share {
        let tip = [FRAC_PI_2, -FRAC_PI_2, PI][s.count(0, 3)];
        yaw * Quat::from_rotation_x(tip) * Quat::from_rotation_z(s.range(0.0, TAU))
    } else {
        random_rotation(s)
    }
}

pub fn random_rotation(s: &mut Style) -> Quat {
    let axis = unit_vector(&mut s.rng);
    Quat::from_axis_angle(axis, s.range(0.0, TAU))
}

/// Primitives that overlap: each new one is centred near the surface of an earlier one.
fn composition(a: &mut Assembly, s: &mut Style) {
    let parts = 2 + (s.range(0.0, 1.0).powi(2) * 6.0) as usize;
    for i in 0..parts {
        if a.triangle_count() > MANY {
            break;
        }
        let size = if i == 0 { 0.5 } else { s.log(0.12, 0.45) };
        let stretch = Vec3::new(s.log(0.5, 1.6), s.log(0.5, 1.6), s.log(0.5, 1.6));
        let materials = [s.material(), s.material()].map(|m| a.material(m));
        let (mut part, crease) = primitive(s, materials);
        if s.chance(0.35) {
            deform(s, &mut part);
        }
        let turn = if s.chance(0.6) { Quat::from_rotation_z(s.range(0.0, TAU)) } else { random_rotation(s) };
        part = part.transformed(Affine3A::from_scale_rotation_translation(size * stretch, turn, Vec3::ZERO));
        if i > 0 {
            // A point between the new part's centre and its surface meets a point of the old surface.
            let own = part.positions[s.count(0, part.positions.len())] * s.range(0.3, 1.0);
            part = part.moved(anchor(a, s) - own);
        }
        a.add(part, crease);
    }
}

/// A random vertex of the parts so far.
fn anchor(a: &Assembly, s: &mut Style) -> Vec3 {
    let n = a.parts().count();
    let pick = s.count(0, n.max(1));
    a.parts().nth(pick).map_or(Vec3::ZERO, |part| part.positions[s.count(0, part.positions.len())])
}

/// A primitive of about unit half size, and its crease angle.
pub fn primitive(s: &mut Style, m: [u16; 2]) -> (Part, f32) {
    match s.count(0, 100) {
        0..16 => {
            let radius = if s.chance(0.5) { 0.0 } else { s.log(0.03, 0.5) };
            let six = if s.chance(0.5) { [m[0]; 6] } else { [m[0], m[0], m[1], m[1], m[0], m[1]] };
            (shapes::rounded_box(Vec3::ONE * 0.9, radius, six), 50.0)
        }
        16..28 => (shapes::superquadric(Vec3::ONE, 1.0, 1.0, s.count(14, 26), m[0]), 60.0),
        28..38 => {
            let (e1, e2) = (s.log(0.25, 1.7), s.log(0.25, 1.7));
            (shapes::superquadric(Vec3::ONE, e1, e2, s.count(18, 28), m[0]), 40.0)
        }
        38..52 => {
            // Cylinders, cones, frusta and prisms.
            let top = match s.count(0, 3) {
                0 => 1.0,
                1 => 0.02,
                _ => s.range(0.1, 1.6),
            };
            let profile = [Vec2::new(0.0, -1.0), Vec2::new(1.0, -1.0), Vec2::new(top, 1.0), Vec2::new(0.0, 1.0)];
            let points = if s.chance(0.5) { shapes::fillet(&profile, s.range(0.03, 0.4), 4) } else { profile.to_vec() };
            (lathe_two(s, points, m), 40.0)
        }
        52..60 => {
            let minor = s.range(0.12, 0.42);
            let exponent = if s.chance(0.6) { 2.0 } else { 6.0 };
            let flat = Vec2::new(minor, minor * s.log(0.4, 2.0));
            (shapes::torus(1.0 - minor, flat, exponent, [40, 18], m[0]), 45.0)
        }
        60..66 => {
            let r = s.range(0.3, 0.6);
            let mut points: Vec<Vec2> =
                (0..=8).map(|i| arc_point(r, -1.0 + r, -FRAC_PI_2 + i as f32 * PI / 16.0)).collect();
            points.extend((0..=8).map(|i| arc_point(r, 1.0 - r, i as f32 * PI / 16.0)));
            (lathe_two(s, points, m), 60.0)
        }
        66..80 => {
            // A turned body with a random smooth profile.
            let n = s.count(3, 7);
            let mut points = vec![Vec2::new(s.range(0.2, 0.9), -1.0)];
            for i in 1..n {
                points.push(Vec2::new(s.range(0.25, 1.0), -1.0 + 2.0 * i as f32 / (n - 1) as f32));
            }
            let mut points = shapes::smooth(&points, 5);
            points.insert(0, Vec2::new(0.0, -1.0));
            points.push(Vec2::new(0.0, 1.0));
            (lathe_two(s, points, m), 45.0)
        }
        80..88 => {
            let body = hollow(s, m);
            (body, 45.0)
        }
        88..94 => {
            let path = wiggle(s, 14);
            let r = s.range(0.08, 0.3);
            let taper = s.range(0.2, 1.0);
            let flat = s.log(0.5, 2.0);
            let half = move |t: f32| Vec2::new(r, r * flat) * (1.0 + (taper - 1.0) * t);
            (shapes::tube(&path, Vec3::Z, half, if s.chance(0.6) { 2.0 } else { 6.0 }, 16, m[0]), 50.0)
        }
        _ => (slab_with_holes(s, m), 40.0),
    }
}

fn arc_point(r: f32, z: f32, angle: f32) -> Vec2 {
    Vec2::new((r * angle.cos()).max(0.0), z + r * angle.sin())
}

/// Revolves a closed profile with the cross-section of a random family; materials change somewhere along it.
fn lathe_two(s: &mut Style, points: Vec<Vec2>, m: [u16; 2]) -> Part {
    let cut = s.count(1, points.len() - 1);
    let spans = if s.chance(0.6) {
        vec![Span { points, material: m[0] }]
    } else {
        vec![
            Span { points: points[..=cut].to_vec(), material: m[0] },
            Span { points: points[cut..].to_vec(), material: m[1] },
        ]
    };
    match s.count(0, 10) {
        0..6 => shapes::lathe(&spans, 36, &shapes::round, 0.25),
        6 => {
            let corners = s.count(3, 9);
            shapes::lathe(&spans, corners * (36 / corners), &shapes::polygon(corners), 0.25)
        }
        7 => {
            let lobes = s.count(3, 10);
            shapes::lathe(&spans, 48, &shapes::lobed(lobes, s.range(0.05, 0.3)), 0.25)
        }
        _ => {
            shapes::lathe(&spans, 40, &shapes::superellipse(Vec2::new(1.0, s.range(0.5, 1.0)), s.log(2.0, 10.0)), 0.25)
        }
    }
}

/// An open vessel with a wall.
fn hollow(s: &mut Style, m: [u16; 2]) -> Part {
    let (bottom, top, wall) = (s.range(0.4, 1.0), s.range(0.5, 1.0), s.range(0.03, 0.15));
    let outer = [Vec2::new(0.0, -1.0), Vec2::new(bottom, -1.0), Vec2::new(top, 1.0)];
    let inner = [
        Vec2::new(top, 1.0),
        Vec2::new(top - wall, 1.0),
        Vec2::new((bottom - wall).max(0.1), -1.0 + wall),
        Vec2::new(0.0, -1.0 + wall),
    ];
    let spans = [
        Span { points: shapes::fillet(&outer, s.range(0.01, 0.5), 4), material: m[0] },
        Span { points: shapes::fillet(&inner, s.range(0.01, 0.4), 3), material: m[1] },
    ];
    let section = shapes::superellipse(Vec2::new(1.0, s.range(0.6, 1.0)), s.log(2.0, 8.0));
    shapes::lathe(&spans, 40, &section, 0.25)
}

/// A smooth random curve.
fn wiggle(s: &mut Style, steps: usize) -> Vec<Vec3> {
    let (bend, twist) = (s.range(0.0, 4.5), s.range(0.0, 1.0));
    let (a, b) = (s.range(0.2, 0.7), s.range(0.2, 0.7));
    (0..=steps)
        .map(|i| {
            let t = i as f32 / steps as f32;
            Vec3::new(a * (bend * t).sin(), twist * b * (1.7 * bend * t).cos(), 2.0 * t - 1.0)
        })
        .collect()
}

/// A curved or flat plate with rectangular or ragged holes.
fn slab_with_holes(s: &mut Style, m: [u16; 2]) -> Part {
    let (nu, nv) = (s.count(8, 20), s.count(8, 20));
    let (period, ragged, seed) = (s.count(2, 5), s.chance(0.3), s.rng.random());
    let (curve, thick) = (s.range(-0.8, 0.8), s.range(0.05, 0.2));
    let surface = move |u: f32, v: f32, lift: f32| {
        let (x, y) = (2.0 * u - 1.0, 2.0 * v - 1.0);
        Vec3::new(x, y, curve * (x * x - 0.5) + lift)
    };
    let keep = move |i: usize, j: usize| {
        let border = i == 0 || j == 0 || i + 1 == nu || j + 1 == nv;
        let open = if ragged {
            noise::value(Vec3::new(i as f32, j as f32, 0.0) * 0.45, seed) > 0.6
        } else {
            !i.is_multiple_of(period) && !j.is_multiple_of(period)
        };
        border || !open
    };
    shapes::shell([nu, nv], false, |u, v| surface(u, v, thick), |u, v| surface(u, v, -thick), keep, m)
}

/// Bends, twists, tapers or roughens a part of unit size.
pub fn deform(s: &mut Style, part: &mut Part) {
    match s.count(0, 4) {
        0 => {
            let rate = s.range(-1.2, 1.2);
            part.map(|p| Quat::from_rotation_z(rate * p.z) * p);
        }
        1 => {
            let k = s.range(-0.6, 0.6);
            part.map(|p| Vec3::new(p.x * (1.0 + k * p.z), p.y * (1.0 + k * p.z), p.z));
        }
        2 => {
            let k = s.range(0.2, 0.9);
            part.map(|p| Quat::from_euler(EulerRot::XYZ, 0.0, k * p.z, 0.0) * p);
        }
        _ => {
            let (amplitude, scale, seed) = (s.range(0.03, 0.25), s.log(0.8, 5.0), s.rng.random());
            part.map(|p| p + amplitude / scale.max(1.0).sqrt() * noise::vector(p * scale, seed, 2));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn primitives_are_closed() {
        let config = GeneratorConfig::default();
        for seed in 0..400 {
            let mut style = Style::new(ChaCha8Rng::seed_from_u64(seed), &config);
            let (mut part, _) = primitive(&mut style, [0, 1]);
            assert_eq!(part.open_edges(), 0, "seed {seed}, {} triangles", part.triangles.len());
            deform(&mut style, &mut part);
            assert_eq!(part.open_edges(), 0, "seed {seed}, deformed");
        }
    }
}
