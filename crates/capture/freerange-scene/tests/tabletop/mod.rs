//! Photos of generated objects on tables: what estimates of masks are tuned on. The scenes of the shared folder only confirm.

#![allow(dead_code)] // tests and examples take different parts

use freerange_assets::generate::{GeneratorConfig, generate, kind_of};
use freerange_assets::mesh::{Mesh, linear_to_srgb};
use freerange_assets::render::{Lighting, LightingConfig, Scene, render};
use freerange_scene::camera::{Camera, View};
use glam::{DVec3, Vec3};
use image::{Rgba, RgbaImage};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// A scene with its truth.
pub struct Tabletop {
    /// The photos.
    pub views: Vec<View>,
    /// The object alone, `[views]`.
    pub alone: Vec<RgbaImage>,
    /// What is special about it.
    pub what: String,
}

/// What lies on the table.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Cloth {
    Wood,
    Checks,
    Speckles,
    Plain,
    Print,
}

/// Eight bits of a whole number's hash, 0 to 1.
fn hash(x: i64, y: i64, seed: u64) -> f32 {
    let mut h = seed ^ (x as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ (y as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F);
    h = (h ^ (h >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    h = (h ^ (h >> 32)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((h >> 40) & 0xFF) as f32 / 255.0
}

/// Smooth noise with a wavelength of one.
fn noise(x: f32, y: f32, seed: u64) -> f32 {
    let (i, j) = (x.floor(), y.floor());
    let smooth = |t: f32| t * t * (3.0 - 2.0 * t);
    let (fx, fy) = (smooth(x - i), smooth(y - j));
    let at = |di: i64, dj: i64| hash(i as i64 + di, j as i64 + dj, seed);
    let row = |dj: i64| at(0, dj) * (1.0 - fx) + at(1, dj) * fx;
    row(0) * (1.0 - fy) + row(1) * fy
}

struct Room {
    cloth: Cloth,
    colors: [Vec3; 3],
    floor: f32,
    seed: u64,
}

impl Room {
    /// Linear reflectance of the table.
    fn table(&self, x: f32, y: f32) -> Vec3 {
        let [a, b, c] = self.colors;
        match self.cloth {
            Cloth::Wood => {
                let bend = 2.0 * noise(0.8 * x, 3.0 * y, self.seed);
                a.lerp(b, 0.5 + 0.5 * (9.0 * y + 3.0 * bend + 4.0 * noise(2.0 * x, 14.0 * y, self.seed + 1)).sin())
            }
            Cloth::Checks => {
                let odd = |v: f32| (v * 4.0).rem_euclid(2.0) < 1.0;
                if odd(x) ^ odd(y) { a } else { b }
            }
            Cloth::Speckles => a.lerp(b, noise(18.0 * x, 18.0 * y, self.seed).powi(3)),
            Cloth::Plain => a * (0.9 + 0.1 * noise(0.5 * x, 0.5 * y, self.seed)),
            Cloth::Print => match hash((5.0 * x).floor() as i64, (5.0 * y).floor() as i64, self.seed) {
                t if t < 0.4 => a,
                t if t < 0.7 => b,
                _ => c,
            },
        }
    }

    /// Linear radiance of the walls, four units away, and of the floor.
    fn wall(&self, eye: Vec3, d: Vec3) -> Vec3 {
        let [_, b, c] = self.colors;
        let reach = |e: f32, d: f32| if d == 0.0 { f32::MAX } else { ((4.0 * d.signum()) - e) / d };
        let (tx, ty) = (reach(eye.x, d.x), reach(eye.y, d.y));
        let t = tx.min(ty);
        let p = eye + t * d;
        let along = if tx < ty { p.y } else { p.x };
        if p.z < self.floor - 2.0 {
            return 0.3 * c * (0.6 + 0.4 * noise(p.x, p.y, self.seed + 7));
        }
        let frame = hash((0.7 * along).floor() as i64, (0.7 * p.z).floor() as i64, self.seed + 3);
        let base = if frame < 0.3 { b } else { Vec3::new(0.55, 0.53, 0.5) };
        base * (0.5 + 0.3 * noise(along, p.z, self.seed + 5))
    }
}

/// A mesh made smaller and moved.
fn placed(mut mesh: Mesh, scale: f32, shift: Vec3) -> Mesh {
    mesh.positions.iter_mut().for_each(|p| *p = scale * *p + shift);
    mesh
}

fn lowest(mesh: &Mesh) -> f32 {
    mesh.positions.iter().map(|p| p.z).fold(f32::MAX, f32::min)
}

/// The scene of a seed, seen by `count` hand-held cameras over `turn` radians.
pub fn tabletop(seed: u64, count: usize, turn: f64, size: (u32, u32)) -> Tabletop {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let lighting: Lighting = LightingConfig { default_share: 0.2, ..LightingConfig::default() }.sample(&mut rng);
    let config = GeneratorConfig::default();
    let mesh = generate(seed, &config).unwrap();
    let cloth = [Cloth::Wood, Cloth::Checks, Cloth::Speckles, Cloth::Plain, Cloth::Print][rng.random_range(0..5)];
    let kind = kind_of(seed, &config).unwrap();
    let mut color = || {
        let value: f32 = rng.random_range(0.08..0.7);
        value * Vec3::new(rng.random_range(0.6..1.0), rng.random_range(0.6..1.0), rng.random_range(0.4..1.0))
    };
    let colors = [color(), color(), color()];
    let room = Room { cloth, colors, floor: lowest(&mesh), seed };
    let others = rng.random_range(0..4usize);
    let mut scenes = vec![Scene::new(mesh, &lighting).unwrap()];
    for i in 0..others {
        let mesh = generate(seed + 1000 * (i as u64 + 1), &config).unwrap();
        let scale = rng.random_range(0.25..0.45f32);
        let angle: f32 = rng.random_range(0.0..6.3);
        let away: f32 = rng.random_range(1.0..1.5);
        let lift = room.floor - scale * lowest(&mesh);
        let shift = Vec3::new(away * angle.cos(), away * angle.sin(), lift);
        scenes.push(Scene::new(placed(mesh, scale, shift), &lighting).unwrap());
    }
    let fov = rng.random_range(0.75..1.1);
    let start: f64 = rng.random_range(0.0..6.3);
    let (w, h) = size;
    let mixed = rng.random_range(0..4) == 0;
    let cameras: Vec<Camera> = (0..count)
        .map(|i| {
            let mut jitter = |by: f64| rng.random_range(-by..by);
            let azimuth = start + turn * (i as f64 + jitter(0.25)) / count as f64;
            let elevation: f64 = 0.55 + jitter(0.3);
            let distance = 2.1 + jitter(0.25);
            let eye = distance
                * DVec3::new(azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin());
            let target = DVec3::new(jitter(0.12), jitter(0.12), jitter(0.1));
            let up = DVec3::new(jitter(0.1), jitter(0.1), 1.0);
            let (w, h) = if mixed && i % 3 == 2 { (h, w) } else { (w, h) };
            let focal = 0.5 * f64::from(size.0.max(size.1)) / f64::tan(0.5 * fov);
            let mut camera = Camera::look_at(eye, target, up, 1.0, w, h);
            (camera.fx, camera.fy) = (focal, focal);
            camera
        })
        .collect();
    let shot: Vec<(RgbaImage, RgbaImage)> =
        cameras.par_iter().enumerate().map(|(i, c)| photo(&scenes, &room, &lighting, c, seed + i as u64)).collect();
    let (images, alone): (Vec<_>, Vec<_>) = shot.into_iter().unzip();
    let views = cameras
        .into_iter()
        .zip(images)
        .enumerate()
        .map(|(i, (camera, image))| View { name: format!("photo{i:02}"), camera, image })
        .collect();
    Tabletop { views, alone, what: format!("{kind:?} on {cloth:?}, {others} others, {count} views over {turn:.1}") }
}

/// A photo, and the object alone.
fn photo(scenes: &[Scene], room: &Room, light: &Lighting, camera: &Camera, seed: u64) -> (RgbaImage, RgbaImage) {
    let pictures: Vec<RgbaImage> = scenes.iter().map(|s| render(s, camera, 2)).collect();
    let alone = pictures[0].clone();
    let eye = camera.center().as_vec3();
    let mut order: Vec<usize> = (0..scenes.len()).collect();
    let middle = |i: usize| 0.5 * (scenes[i].bounds().0 + scenes[i].bounds().1);
    order.sort_by(|a, b| middle(*b).distance(eye).total_cmp(&middle(*a).distance(eye)));
    let tone = |v: f32| 255.0 * linear_to_srgb(v / (1.0 + 0.15 * v));
    let image = RgbaImage::from_fn(camera.width, camera.height, |x, y| {
        let d = camera.ray_direction(f64::from(x) + 0.5, f64::from(y) + 0.5).as_vec3();
        let t = (room.floor - eye.z) / d.z;
        let p = eye + t * d;
        let radiance = if t > 0.0 && p.truncate().abs().max_element() < 2.2 {
            let up = light.sun_direction.z.max(0.0);
            let lit = scenes.iter().all(|s| s.intersect(p + 1e-3 * Vec3::Z, light.sun_direction).is_none());
            let sun = if lit { light.sun * up / std::f32::consts::PI } else { 0.0 };
            // What stands near takes away some of the sky.
            let near = (p.truncate().length() / 0.6).min(1.0);
            room.table(p.x, p.y) * (light.environment * (0.6 + 0.4 * near) + sun)
        } else {
            room.wall(eye, d)
        };
        let grain = 6.0 * (hash(i64::from(x), i64::from(y), seed + 11) - 0.5);
        let mut color = radiance.to_array().map(|v| tone(v) + grain);
        for i in &order {
            let over = pictures[*i].get_pixel(x, y).0;
            let a = f32::from(over[3]) / 255.0;
            (0..3).for_each(|c| color[c] = color[c] * (1.0 - a) + (f32::from(over[c]) + grain) * a);
        }
        let [r, g, b] = color.map(|v| v.clamp(0.0, 255.0) as u8);
        Rgba([r, g, b, 255])
    });
    (image, alone)
}
