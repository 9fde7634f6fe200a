//! Toys, shoes and grips: blobs joined smoothly.

use std::f32::consts::PI;

use glam::{Affine3A, Quat, Vec2, Vec3};

use crate::generate::blend::{Blob, blend};
use crate::generate::palette;
use crate::generate::part::Assembly;
use crate::generate::shapes;
use crate::generate::style::Style;
use crate::mesh::{Material, Texture};

/// Animals, dolls, cars, shoes, ergonomic grips: superquadrics joined smoothly.
pub fn toy(a: &mut Assembly, s: &mut Style) {
    let main = s.material();
    let cloth_color = s.color();
    let main = if s.chance(0.25) {
        let cloth = s.cloth(cloth_color);
        Material { roughness: 0.95, ..Material::matt(cloth) }
    } else {
        main
    };
    let second = s.material();
    let third = s.material();
    let m = [main, second, third].map(|m| a.material(m));
    let (blobs, soft) = match s.count(0, 4) {
        0 => (animal(s, m), 0.035),
        1 => (figure(s, m), 0.03),
        2 => (car(a, s, m), 0.02),
        _ => (shoe(s, m), 0.02),
    };
    a.add(blend(&blobs, soft, 40), 75.0);
    if s.chance(0.6) && blobs.len() > 8 {
        // Eyes on the head (the blob that is second in sitting figures, sixth in animals).
        let head = if blobs.len() > 10 { blobs[5] } else { blobs[1] };
        let dark = palette::hsv(0.6, 0.2, 0.08);
        let eye = Material { specular: 0.05, roughness: 0.12, ..Material::matt(Texture::Flat(dark)) };
        let eye = a.material(eye);
        let r = head.half.x;
        for y in [-1.0, 1.0] {
            let at = head.center + r * Vec3::new(0.78, 0.42 * y, 0.42);
            a.add(shapes::superquadric(Vec3::splat(0.14 * r), 1.0, 1.0, 10, eye).moved(at), 60.0);
        }
    }
}

/// Four legs, a head, ears, a tail.
fn animal(s: &mut Style, m: [u16; 3]) -> Vec<Blob> {
    let mut blobs = vec![];
    let (long, r) = (s.range(0.35, 0.6), s.range(0.2, 0.32));
    let legs = s.range(0.25, 0.6);
    blobs.push(Blob::ball(Vec3::ZERO, Vec3::new(long, r, r), m[0]));
    for (x, y) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
        let foot = Vec3::new(0.7 * x * long, 0.6 * y * r, -legs);
        blobs.push(Blob::limb(Vec3::new(0.6 * x * long, 0.5 * y * r, -0.2 * r), foot, 0.32 * r, m[s.count(0, 2)]));
    }
    let head = Vec3::new(long + 0.6 * r, 0.0, r * s.range(0.4, 1.6));
    blobs.push(Blob::ball(head, Vec3::splat(r * s.range(0.6, 1.0)), m[0]));
    blobs.push(Blob::limb(Vec3::new(0.6 * long, 0.0, 0.3 * r), head, 0.4 * r, m[0]));
    blobs.push(Blob::ball(head + Vec3::new(0.7 * r, 0.0, -0.15 * r), Vec3::splat(0.35 * r), m[1]));
    let ear = s.range(0.2, 0.8) * r;
    for y in [-1.0, 1.0] {
        let root = head + Vec3::new(-0.1 * r, 0.4 * y * r, 0.5 * r);
        blobs.push(Blob::limb(root, root + Vec3::new(-0.2 * ear, 0.3 * y * ear, ear), 0.2 * r, m[1]));
    }
    let tail = Vec3::new(-long, 0.0, 0.2 * r);
    blobs.push(Blob::limb(tail, tail + Vec3::new(-0.6 * r, 0.0, s.range(-0.3, 0.8) * r), 0.15 * r, m[2]));
    blobs
}

/// A sitting figure: body, head, arms, legs.
fn figure(s: &mut Style, m: [u16; 3]) -> Vec<Blob> {
    let mut blobs = vec![];
    let r = s.range(0.28, 0.4);
    blobs.push(Blob::ball(Vec3::ZERO, Vec3::new(r, 0.9 * r, s.range(1.0, 1.5) * r), m[0]));
    let head = Vec3::new(0.0, 0.0, 1.7 * r);
    blobs.push(Blob::ball(head, Vec3::splat(r * s.range(0.6, 0.95)), m[1]));
    for y in [-1.0, 1.0] {
        let up = s.range(-0.4, 0.6);
        let shoulder = Vec3::new(0.0, 0.7 * y * r, 0.6 * r);
        blobs.push(Blob::limb(shoulder, shoulder + Vec3::new(0.3 * r, 0.8 * y * r, up * r), 0.24 * r, m[0]));
        blobs.push(Blob::limb(
            Vec3::new(0.2 * r, 0.5 * y * r, -0.9 * r),
            Vec3::new(1.2 * r, 0.7 * y * r, -r),
            0.3 * r,
            m[2],
        ));
        blobs.push(Blob::ball(head + Vec3::new(0.0, 0.55 * y * r, 0.6 * r), Vec3::splat(0.25 * r), m[1]));
    }
    blobs.push(Blob::ball(head + Vec3::new(0.6 * r, 0.0, -0.1 * r), Vec3::splat(0.28 * r), m[2]));
    blobs
}

/// A car: body, cabin; wheels follow as parts.
fn car(a: &mut Assembly, s: &mut Style, m: [u16; 3]) -> Vec<Blob> {
    let mut blobs = vec![];
    let half = Vec3::new(s.range(0.45, 0.6), s.range(0.2, 0.3), s.range(0.09, 0.15));
    let square = Blob { center: Vec3::ZERO, half, square: 2, turn: Quat::IDENTITY, material: m[0] };
    blobs.push(square);
    let cabin = Vec3::new(half.x * s.range(0.4, 0.65), half.y * 0.85, s.range(0.1, 0.2));
    let back = s.range(-0.3, 0.1) * half.x;
    blobs.push(Blob { center: Vec3::new(back, 0.0, half.z + 0.4 * cabin.z), half: cabin, material: m[1], ..square });
    if s.chance(0.4) {
        blobs.push(Blob { center: Vec3::new(0.7 * half.x, 0.0, half.z), half: 0.35 * half, material: m[0], ..square });
    }
    let r = s.range(0.1, 0.16);
    for (x, y) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
        let wheel = shapes::torus(0.65 * r, Vec2::new(0.4 * r, 0.05), 3.0, [24, 10], m[2]);
        let hub = shapes::superquadric(Vec3::new(0.5 * r, 0.5 * r, 0.045), 0.6, 1.0, 10, m[1]);
        let place = Affine3A::from_translation(Vec3::new(0.6 * x * half.x, y * half.y, -0.8 * half.z))
            * Affine3A::from_rotation_x(0.5 * PI);
        a.add(wheel.transformed(place), 50.0);
        a.add(hub.transformed(place), 50.0);
    }
    blobs
}

/// A shoe: sole, toe, heel, shaft.
fn shoe(s: &mut Style, m: [u16; 3]) -> Vec<Blob> {
    let mut blobs = vec![];
    let (l, w, h) = (s.range(0.45, 0.55), s.range(0.16, 0.21), s.range(0.15, 0.5));
    let sole = Blob {
        center: Vec3::new(0.0, 0.0, -0.02),
        half: Vec3::new(l, w, 0.055),
        square: 2,
        turn: Quat::IDENTITY,
        material: m[1],
    };
    blobs.push(sole);
    blobs.push(Blob::ball(Vec3::new(0.5 * l, 0.0, 0.05), Vec3::new(0.5 * l, 0.95 * w, 0.13), m[0]));
    blobs.push(Blob::limb(Vec3::new(0.35 * l, 0.0, 0.1), Vec3::new(-0.4 * l, 0.0, 0.17 + 0.3 * h), 0.8 * w, m[0]));
    blobs.push(Blob::limb(Vec3::new(-0.55 * l, 0.0, 0.1), Vec3::new(-0.55 * l, 0.0, h), 0.9 * w, m[0]));
    for k in 0..4 {
        // Laces.
        let x = l * (0.38 - 0.16 * k as f32);
        let z = 0.18 + (0.12 + 0.1 * h) * k as f32 * 0.6;
        blobs.push(Blob::limb(Vec3::new(x, -0.5 * w, z), Vec3::new(x, 0.5 * w, z), 0.025, m[2]));
    }
    blobs
}
