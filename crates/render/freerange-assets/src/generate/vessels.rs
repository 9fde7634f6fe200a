//! Open vessels and what is served from them: mugs, bowls, plates, pans, teapots and jugs; and lamps.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use glam::{Quat, Vec2, Vec3};

use crate::generate::caps::{CREASE, lid};
use crate::generate::decor::rosette;
use crate::generate::handles::{self, Mount, handle};
use crate::generate::label::Face;
use crate::generate::palette::{self, Tone};
use crate::generate::part::Assembly;
use crate::generate::shapes::{self, Span};
use crate::generate::style::Style;
use crate::generate::turned::{Relief, plain_section, turned, walls};
use crate::mesh::Texture;

pub fn mug(a: &mut Assembly, s: &mut Style) {
    let mut outside = s.ceramic();
    if s.chance(0.12) {
        outside = s.metal();
    }
    let inside = match s.count(0, 4) {
        0..2 => outside.clone(),
        2 => {
            let white = palette::color(&mut s.rng, Tone::White);
            s.plain(white)
        }
        _ => s.ceramic(),
    };
    let grip = if s.chance(0.8) { outside.clone() } else { inside.clone() };
    let rim_material = if s.chance(0.15) { s.metal() } else { inside.clone() };
    let h = s.log(0.7, 1.7);
    let (bottom, top) = (s.range(0.3, 0.52), s.range(0.38, 0.56));
    let belly = s.range(-0.06, 0.1);
    let wall = s.range(0.02, 0.05);
    let corner = s.range(0.7, 0.97);
    let profile = [
        Vec2::new(bottom * corner, 0.0),
        Vec2::new(bottom, 0.07 * h),
        Vec2::new(0.5 * (bottom + top) + belly, 0.5 * h),
        Vec2::new(top + 0.5 * belly.min(0.0), 0.8 * h),
        Vec2::new(top, h),
    ];
    let side = shapes::smooth(&profile, 5);
    let foot = if s.chance(0.5) { s.range(0.01, 0.04) } else { 0.0 };
    let w = walls(&side, wall, foot);
    let decorated = s.chance(0.35);
    let wrap = if decorated {
        let ground = if s.chance(0.6) { palette::color(&mut s.rng, Tone::White) } else { s.color() };
        let size = Vec2::new(1.0, (0.8 * h / (TAU * top)).min(0.6));
        if s.chance(0.45) {
            let mut scheme = s.scheme();
            scheme.ground = ground;
            let product = s.product(&scheme);
            let face = if s.chance(0.5) { Face::Sticker } else { Face::Wrap };
            s.print(&product, face, size)
        } else {
            s.decor(ground, size)
        }
    } else {
        outside.clone()
    };
    let [outside, inside, grip, rim_material, wrap] =
        [outside, inside, grip, rim_material, wrap].map(|m| a.material(m));
    // The body between foot and rim carries print or relief.
    let (from, to) = (w.foot + 4, w.outer.len() - 3);
    let body = w.outer[from..=to].to_vec();
    let relief = (!decorated && s.chance(0.35))
        .then(|| (Relief::random(s), 1, [body[0].y, body[body.len() - 1].y], s.range(0.008, 0.022)));
    let spans = [
        Span { points: w.outer[..=from].to_vec(), material: outside },
        Span { points: body, material: wrap },
        Span { points: w.outer[to..].to_vec(), material: outside },
        Span { points: w.rim, material: rim_material },
        Span { points: w.inner, material: inside },
    ];
    let section = plain_section(s, 0.12);
    a.add(turned(&spans, &section, relief), CREASE);
    let at = |t: f32| side[((t * (side.len() - 1) as f32) as usize).min(side.len() - 1)] + Vec2::new(-0.4 * wall, foot);
    let handles = match s.count(0, 10) {
        0 => 0,
        1 => 2,
        _ => 1,
    };
    let (low, high, reach) = (s.range(0.22, 0.4), s.range(0.72, 0.92), s.range(0.2, 0.42));
    for k in 0..handles {
        let mount = Mount { low: at(low), high: at(high), reach, material: grip, angle: PI * k as f32 };
        handle(a, s, mount);
    }
}

pub fn bowl(a: &mut Assembly, s: &mut Style) {
    let outside = s.ceramic();
    let inside = if s.chance(0.5) { outside.clone() } else { s.ceramic() };
    let rim = match s.count(0, 5) {
        0 => s.metal(),
        1 => {
            let color = s.color();
            s.plain(color)
        }
        _ => outside.clone(),
    };
    let h = s.log(0.3, 0.95);
    let foot = s.range(0.3, 0.75);
    let wall = s.range(0.02, 0.05);
    let curve = s.range(1.0, 3.0);
    let lip = if s.chance(0.25) { s.range(0.02, 0.12) } else { 0.0 };
    let straight = s.chance(0.2);
    let n = 14;
    let mut side: Vec<Vec2> = (0..=n)
        .map(|i| {
            let t = i as f32 / n as f32;
            if straight {
                // A ramekin: upright walls with a round corner.
                let c = (t / 0.35).min(1.0) * FRAC_PI_2;
                let r = 0.9 + 0.1 * c.sin();
                Vec2::new(r, h * (0.16 * (1.0 - c.cos()) + 0.84 * ((t - 0.35) / 0.65).max(0.0)))
            } else {
                Vec2::new(foot + (1.0 - foot) * (1.0 - (1.0 - t).powf(curve)), h * t.powf(0.5 + 0.5 * curve))
            }
        })
        .collect();
    if lip > 0.0 {
        let edge = side[n];
        side.extend([edge + Vec2::new(0.5 * lip, 0.2 * lip), edge + Vec2::new(lip, 0.3 * lip)]);
    }
    let foot_height = if s.chance(0.7) { s.range(0.02, 0.16) } else { 0.0 };
    let w = walls(&side, wall, foot_height);
    let painted = s.chance(0.35);
    let body = if painted {
        let ground = palette::color(&mut s.rng, Tone::White);
        s.decor(ground, Vec2::new(1.2, 0.35))
    } else {
        outside.clone()
    };
    let [outside, inside, rim, body] = [outside, inside, rim, body].map(|m| a.material(m));
    let from = w.foot + 1;
    let points = w.outer[from..].to_vec();
    let relief = (!painted && s.chance(0.4))
        .then(|| (Relief::random(s), 1, [points[0].y, points[points.len() - 1].y], s.range(0.008, 0.025)));
    let spans = [
        Span { points: w.outer[..=from].to_vec(), material: outside },
        Span { points, material: body },
        Span { points: w.rim, material: rim },
        Span { points: w.inner, material: inside },
    ];
    let part = match s.count(0, 12) {
        0 => shapes::lathe(&spans, 48, &shapes::lobed(s.count(5, 14), s.range(0.02, 0.08)), 0.14),
        1 => {
            shapes::lathe(&spans, 44, &shapes::superellipse(Vec2::new(1.0, s.range(0.5, 1.0)), s.range(2.0, 6.0)), 0.14)
        }
        _ => turned(&spans, &shapes::round, relief),
    };
    a.add(part, CREASE);
}

pub fn plate(a: &mut Assembly, s: &mut Style) {
    let ground = if s.chance(0.6) { palette::color(&mut s.rng, Tone::White) } else { s.color() };
    let top = match s.count(0, 5) {
        0..2 => s.ringed(ground),
        2..4 => {
            let colors = [palette::contrast(&mut s.rng, ground), s.color()];
            let raster = rosette(&mut s.rng, ground, colors, 384);
            s.finish(Texture::Print(raster.into()))
        }
        _ => s.ceramic(),
    };
    let below = if s.chance(0.7) { s.plain(ground) } else { s.ceramic() };
    let [top, below] = [top, below].map(|m| a.material(m));
    let (foot, h, wall) = (s.range(0.45, 0.7), s.range(0.06, 0.25), s.range(0.02, 0.04));
    let well = s.range(0.6, 0.85);
    let side = shapes::smooth(
        &[
            Vec2::new(foot, 0.0),
            Vec2::new(well.max(foot + 0.04), 0.1 * h),
            Vec2::new(well.max(foot + 0.04) + 0.07, 0.65 * h),
            Vec2::new(1.0, h),
        ],
        6,
    );
    let w = walls(&side, wall, s.range(0.01, 0.04));
    let spans = [
        Span { points: w.outer, material: below },
        Span { points: w.rim, material: top },
        Span { points: w.inner, material: top },
    ];
    let mut part = match s.count(0, 8) {
        0 => shapes::lathe(&spans, 56, &shapes::lobed(s.count(8, 16), s.range(0.01, 0.03)), 0.14),
        1 => {
            shapes::lathe(&spans, 48, &shapes::superellipse(Vec2::new(1.0, s.range(0.6, 1.0)), s.range(2.0, 5.0)), 0.14)
        }
        _ => shapes::lathe(&spans, 48, &shapes::round, 0.14),
    };
    // The painting is seen from above: a flat map from the plan.
    for (p, uv) in part.positions.iter().zip(&mut part.uvs) {
        *uv = 0.5 + 0.49 * p.truncate();
    }
    a.add(part, CREASE);
}

pub fn pan(a: &mut Assembly, s: &mut Style) {
    let body = match s.count(0, 10) {
        0..4 => {
            let dark = palette::color(&mut s.rng, Tone::Dark) * 0.6;
            let material = s.plain(dark);
            s.worn(material, 0.4)
        }
        4..7 => s.metal(),
        _ => {
            // Enamel.
            let color = s.color();
            let mut material = s.plain(color);
            (material.specular, material.roughness) = (0.045, 0.15);
            material
        }
    };
    let inside = match s.count(0, 5) {
        0..3 => body.clone(),
        3 => s.metal(),
        _ => {
            let dark = palette::color(&mut s.rng, Tone::Dark) * 0.5;
            s.plain(dark)
        }
    };
    let grip = match s.count(0, 5) {
        0 => body.clone(),
        1 => {
            let wood = s.wood();
            s.finish(wood)
        }
        2 => s.metal(),
        _ => s.dark_plastic(),
    };
    let rim = if s.chance(0.4) { s.metal() } else { body.clone() };
    let [body, inside, grip, rim] = [body, inside, grip, rim].map(|m| a.material(m));
    let r = 0.5;
    let deep = s.chance(0.4);
    let h = if deep { s.range(0.28, 0.7) } else { s.range(0.08, 0.2) };
    let base = r * if deep { s.range(0.88, 0.99) } else { s.range(0.65, 0.9) };
    let wall = s.range(0.012, 0.025);
    let flare = s.range(0.04, 0.2).min(0.7 * h);
    let corners = [Vec2::new(0.7 * base, 0.0), Vec2::new(base, 0.0), Vec2::new(r, h), Vec2::new(r + 0.02, h + 0.004)];
    let side = shapes::subdivide(&shapes::fillet(&corners, flare, 5), 0.1);
    let w = walls(&side, wall, 0.0);
    let spans = [
        Span { points: w.outer, material: body },
        Span { points: w.rim, material: rim },
        Span { points: w.inner, material: inside },
    ];
    a.add(shapes::lathe(&spans, 44, &shapes::round, 0.11), CREASE);
    let start = h * s.range(0.6, 0.9);
    let root = Vec2::new(base + (r - base) * start / h, start);
    if !deep || s.chance(0.35) {
        handles::stick(a, s, root, grip);
    } else {
        for side in 0..2 {
            handles::lug(a, s, root, grip, PI * side as f32);
        }
    }
    if deep && s.chance(0.5) {
        let z = h + 0.4 * wall;
        lid(a, s, Vec2::new(r + 0.015, z), [body, grip]);
    }
}

/// Teapots, kettles, jugs, coffee pots, watering cans.
pub fn teapot(a: &mut Assembly, s: &mut Style) {
    let body = match s.count(0, 6) {
        0..3 => s.ceramic(),
        3..5 => s.metal(),
        _ => {
            let ground = palette::color(&mut s.rng, Tone::White);
            s.decor(ground, Vec2::new(1.0, 0.4))
        }
    };
    let grip = match s.count(0, 4) {
        0 => s.dark_plastic(),
        1 => {
            let wood = s.wood();
            s.finish(wood)
        }
        _ => body.clone(),
    };
    let [body, grip] = [body, grip].map(|m| a.material(m));
    let (h, belly, foot, neck) = (s.range(0.5, 1.4), s.range(0.38, 0.6), s.range(0.2, 0.42), s.range(0.18, 0.4));
    let at_belly = s.range(0.3, 0.6);
    let side = shapes::smooth(
        &[
            Vec2::new(foot, 0.0),
            Vec2::new(0.5 * (foot + belly) + 0.06, 0.4 * at_belly * h),
            Vec2::new(belly, at_belly * h),
            Vec2::new(0.5 * (belly + neck) + 0.04, 0.5 * (1.0 + at_belly) * h),
            Vec2::new(neck, h),
        ],
        5,
    );
    let wall = 0.025;
    let foot_height = s.range(0.0, 0.05);
    let w = walls(&side, wall, foot_height);
    let spans = [w.outer, w.rim, w.inner].map(|points| Span { points, material: body });
    a.add(turned(&spans, &shapes::round, None), CREASE);
    let at = |t: f32| {
        side[((t * (side.len() - 1) as f32) as usize).min(side.len() - 1)] + Vec2::new(-0.5 * wall, foot_height)
    };
    if s.chance(0.7) {
        lid(a, s, Vec2::new(neck + 0.01, h + foot_height + 0.02), [body, grip]);
    }
    // The spout swings out and up, thinner to its mouth; jugs have only a short lip.
    let root = at(s.range(0.3, 0.6));
    let (out, up) = (s.range(0.25, 0.5), s.range(0.3, 0.9) * (h + foot_height - root.y));
    let points = [
        Vec2::new(root.x - 0.05, root.y),
        Vec2::new(root.x + 0.35 * out, root.y + 0.15 * up),
        Vec2::new(root.x + 0.65 * out, root.y + 0.6 * up),
        Vec2::new(root.x + out, root.y + up),
    ];
    let path: Vec<Vec3> = shapes::smooth(&points, 5).iter().map(|p| Vec3::new(-p.x, 0.0, p.y)).collect();
    let (r0, r1) = (s.range(0.07, 0.12), s.range(0.03, 0.05));
    a.add(shapes::tube(&path, Vec3::Y, |t| Vec2::splat(r0 + (r1 - r0) * t), 2.0, 14, body), 50.0);
    if s.chance(0.25) {
        let feet = at(0.9);
        handles::bail(a, s, feet, grip);
    } else {
        let (low, high) = (at(s.range(0.25, 0.4)), at(s.range(0.75, 0.95)));
        let reach = s.range(0.2, 0.4);
        handle(a, s, Mount { low, high, reach, material: grip, angle: 0.0 });
    }
}

/// Lamps and candlesticks: a turned foot and stem, a shade or a candle.
pub fn lamp(a: &mut Assembly, s: &mut Style) {
    let stem = match s.count(0, 3) {
        0 => s.metal(),
        1 => {
            let wood = s.wood();
            s.finish(wood)
        }
        _ => s.ceramic(),
    };
    let color = if s.chance(0.5) { palette::color(&mut s.rng, Tone::White) } else { s.color() };
    let cloth = if s.chance(0.6) { s.cloth(color) } else { Texture::Flat(color) };
    let shade = s.finish(cloth);
    let [stem, shade] = [stem, shade].map(|m| a.material(m));
    let (h, foot) = (s.range(0.6, 1.3), s.range(0.18, 0.4));
    let mut points = vec![Vec2::new(foot, 0.0), Vec2::new(foot, 0.03), Vec2::new(0.5 * foot, 0.07)];
    let knots = s.count(3, 7);
    for k in 0..knots {
        points.push(Vec2::new(s.range(0.03, 0.16), 0.1 + (h - 0.1) * k as f32 / knots as f32));
    }
    points.push(Vec2::new(0.03, h));
    let mut profile = vec![Vec2::ZERO];
    profile.extend(shapes::smooth(&points, 4).into_iter().map(|p| p.max(Vec2::new(0.02, 0.0))));
    profile.push(Vec2::new(0.0, h));
    a.add(shapes::lathe(&[Span { points: profile, material: stem }], 32, &shapes::round, 0.15), CREASE);
    let section = plain_section(s, 0.2);
    if s.chance(0.65) {
        let (top, bottom, tall, wall) = (s.range(0.12, 0.35), s.range(0.3, 0.55), s.range(0.3, 0.6), 0.012);
        let (z0, z1) = (h - 0.35 * tall, h + 0.65 * tall);
        let ring = [
            Vec2::new(bottom, z0),
            Vec2::new(top, z1),
            Vec2::new(top - wall, z1),
            Vec2::new(bottom - wall, z0),
            Vec2::new(bottom, z0),
        ];
        let part = shapes::lathe(&[Span { points: ring.to_vec(), material: shade }], 44, &section, 0.12);
        a.add(part, CREASE);
        // Spokes hold it.
        for k in 0..3 {
            let turn = Quat::from_rotation_z(TAU * k as f32 / 3.0);
            let r = top - 0.5 * wall;
            handles::wire(
                a,
                &[
                    Vec3::Z * (h - 0.01),
                    turn * Vec3::new(0.5 * r, 0.0, 0.5 * (h + z1)),
                    turn * Vec3::new(r, 0.0, z1 - 0.03),
                ],
                0.01,
                stem,
            );
        }
    } else {
        let (r, tall) = (s.range(0.06, 0.14), s.range(0.2, 0.6));
        let points =
            [Vec2::new(0.0, h - 0.02), Vec2::new(r, h - 0.02), Vec2::new(r, h + tall), Vec2::new(0.0, h + tall - 0.02)];
        let candle = Span { points: shapes::fillet(&points, 0.03, 3), material: shade };
        a.add(shapes::lathe(&[candle], 28, &shapes::round, 0.15), CREASE);
    }
}
