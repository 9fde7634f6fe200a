//! Baskets of cane with strands in relief, and baskets of wire.

use std::f32::consts::TAU;

use glam::{Vec2, Vec3};

use crate::generate::handles;
use crate::generate::part::Assembly;
use crate::generate::shapes;
use crate::generate::style::Style;
use crate::mesh::Frame;

/// A woven basket: the wall swells where strands pass over, and its texture runs with them.
pub fn wicker(a: &mut Assembly, s: &mut Style) {
    let (h, wall) = (s.range(0.25, 1.0), s.range(0.02, 0.04));
    let top = Vec2::new(s.range(0.4, 0.65), s.range(0.35, 0.6));
    let taper = s.range(0.65, 1.0);
    let belly = s.range(-0.08, 0.15);
    let exponent = if s.chance(0.55) { 2.0 } else { s.range(3.0, 6.0) };
    let stakes = 2 * s.count(10, 19);
    let rows = ((h * s.range(14.0, 24.0)) as usize).clamp(5, 20);
    let floor_rows = 4;
    let nv = floor_rows + 2 * rows;
    // The texture has one cell per strand; rows of the floor count as rows too.
    let frame = Frame::Uv(Vec2::new(stakes as f32, nv as f32 / 2.0));
    let cane = s.woven(frame);
    let inside = if s.chance(0.75) {
        cane.clone()
    } else {
        let color = s.color();
        let cloth = s.cloth(color);
        s.finish(cloth)
    };
    let border = if s.chance(0.5) { s.material() } else { cane.clone() };
    let [cane, inside, border] = [cane, inside, border].map(|m| a.material(m));
    let section = shapes::superellipse(Vec2::ONE, exponent);
    let depth = s.range(0.3, 0.6) * wall;
    let nu = 3 * stakes;
    let size = |t: f32| (taper + (1.0 - taper) * t + belly * 4.0 * t * (1.0 - t)) * top;
    let body = |u: f32, v: f32, inset: f32, lift: f32| {
        let j = v * nv as f32;
        let c = section(TAU * u);
        if j < floor_rows as f32 + 0.5 {
            let reach = (j / floor_rows as f32).min(1.0);
            (c * (size(0.0) - inset) * reach).extend(inset)
        } else {
            let row = j - floor_rows as f32;
            let t = row / (2 * rows) as f32;
            let strand = (row * 0.5).floor() as i32;
            let over = ((u * stakes as f32).floor() as i32 + strand) & 1 == 0;
            let across = (std::f32::consts::PI * (u * stakes as f32).fract()).sin();
            let bump =
                if over { lift * across } else { -0.5 * lift * across } * if row as usize % 2 == 1 { 1.0 } else { 0.3 };
            (c * (size(t) - inset + bump)).extend((h * t).max(inset))
        }
    };
    let outer = |u: f32, v: f32| body(u, v, 0.0, depth);
    let inner = |u: f32, v: f32| body(u, v, wall, 0.0);
    a.add(shapes::shell([nu, nv], true, outer, inner, |_, _| true, [cane, inside]), 60.0);
    // Braided borders: hoops at the rim and the foot.
    let r = s.range(0.9, 1.5) * wall;
    let rim = |angle: f32| section(angle) * (size(1.0) - 0.5 * wall);
    handles::hoop(a, &rim, h, r, border);
    if s.chance(0.6) {
        let foot = |angle: f32| section(angle) * (size(0.0) - 0.3 * wall);
        handles::hoop(a, &foot, 0.5 * r, 0.8 * r, border);
    }
    match s.count(0, 4) {
        0 => handles::bail(a, s, Vec2::new(size(1.0).y, h), border),
        1 => {
            for k in 0..2 {
                handles::lug(a, s, Vec2::new(size(0.85).x, 0.9 * h), border, TAU * 0.5 * k as f32);
            }
        }
        _ => {}
    }
}

/// A basket or holder of wires: hoops and uprights, or a grid.
pub fn wire(a: &mut Assembly, s: &mut Style) {
    let m = match s.count(0, 3) {
        0 => s.metal(),
        1 => s.dark_plastic(),
        _ => {
            let color = s.color();
            s.plain(color)
        }
    };
    let frame = m.clone();
    let [m, frame] = [m, frame].map(|m| a.material(m));
    let (h, top, taper) = (s.range(0.25, 0.8), Vec2::new(s.range(0.4, 0.6), s.range(0.35, 0.6)), s.range(0.6, 1.0));
    let exponent = if s.chance(0.5) { 2.0 } else { s.range(4.0, 9.0) };
    let section = shapes::superellipse(Vec2::ONE, exponent);
    let (r, curve) = (s.range(0.008, 0.018), s.range(0.5, 1.5));
    let size = |t: f32| (taper + (1.0 - taper) * t.powf(curve)) * top;
    let hoops = s.count(2, 6);
    for k in 0..=hoops {
        let t = k as f32 / hoops as f32;
        let at = |angle: f32| section(angle) * size(t);
        let thick = if k == hoops { 1.8 * r } else { r };
        handles::hoop(a, &at, h * t, thick, if k == hoops { frame } else { m });
    }
    // Uprights run from the middle of the floor up the wall.
    let n = s.count(7, 15);
    let lean = if s.chance(0.3) { s.range(0.2, 0.6) } else { 0.0 };
    let ways: &[f32] = if lean > 0.0 { &[-1.0, 1.0] } else { &[0.0] };
    for &way in ways {
        for k in 0..n {
            // The two ways start between each other, or their feet would coincide.
            let angle = TAU * (k as f32 + 0.25 * way) / n as f32;
            let mut path = vec![(section(angle) * size(0.0) * 0.08).extend(0.0)];
            path.extend((1..4).map(|i| (section(angle) * size(0.0) * i as f32 / 3.0).extend(0.0)));
            path.extend((1..=6).map(|i| {
                let t = i as f32 / 6.0;
                (section(angle + way * lean * t) * size(t)).extend(h * t)
            }));
            handles::wire(a, &path, 0.9 * r, m);
        }
    }
    let hub = |angle: f32| shapes::round(angle) * 0.1 * top.min_element();
    handles::hoop(a, &hub, 0.0, 1.2 * r, m);
    if s.chance(0.35) {
        handles::bail(a, s, Vec2::new(top.y, h), frame);
    }
    if s.chance(0.4) {
        // Fruit or balls in it.
        for k in 0..s.count(2, 5) {
            let fill = s.material();
            let fill = a.material(fill);
            let radius = s.range(0.14, 0.2);
            let angle = 2.4 * k as f32;
            let out = if k == 0 { 0.0 } else { 0.55 * (size(0.3).min_element() - radius).max(0.05) };
            let ball = shapes::superquadric(Vec3::new(radius, radius, 0.95 * radius), 1.0, 1.0, 16, fill);
            a.add(ball.moved((shapes::round(angle) * out).extend(r + radius)), 60.0);
        }
    }
}
