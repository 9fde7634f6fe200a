//! The generator: picks a family, builds its parts, turns and normalizes the result.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use glam::{Affine3A, Quat, Vec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::generate::config::{GeneratorConfig, Kind};
use crate::generate::part::Assembly;
use crate::generate::primitive::{deform, primitive};
use crate::generate::style::{Style, unit_vector};
use crate::generate::{bottle, household, jar, packaging, soft, toys, vessels, woven};
use crate::mesh::Mesh;
use crate::mesh::Texture;
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
        Kind::Jar => jar::jar(a, s),
        Kind::Lamp => vessels::lamp(a, s),
        Kind::Can => packaging::can(a, s),
        Kind::Bottle => bottle::bottle(a, s),
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
        Kind::Toy => toys::toy(a, s),
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

/// Puts its mean color in the place of a print.
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

/// Primitives that overlap: each new one is centerd near the surface of an earlier one.
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
            // A point between the new part's center and its surface meets a point of the old surface.
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
