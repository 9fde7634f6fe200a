//! Photos of bottles, boxes and mugs on textured tables with true cameras: what `freerange poses`
//! is measured on.
//!
//! `cargo run --release -p freerange-scene --example captures -- OUT [PHOTOS [WIDTH]]`, then
//! `python tools/poses.py OUT RESULTS`. Twenty captures: six bottles, five boxes whose sides are
//! equal in pairs or all, five mugs whose pattern repeats two to six times, and four objects on a
//! turntable in a still room. Each folder has `images/`, `masks/` (true), `transforms.json` (true
//! cameras), and eight more views of the object alone (`val/`, `transforms_val.json`).

use std::{error::Error, f64::consts::TAU, fs, path::Path};

use freerange_scene::camera::{Camera, transforms_json};
use glam::{DMat4, DQuat, DVec3};
use image::{GrayImage, Luma, Rgba, RgbaImage};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

const SUN: DVec3 = DVec3::new(0.42, -0.53, 0.74);
/// Half the table's width.
const TABLE: f64 = 2.4;
const TURNTABLE: f64 = 0.55;
/// Samples of a pixel along each axis.
const SAMPLES: u32 = 2;

/// What stands on the table, and how often its pattern repeats or how many sides are equal.
#[derive(Clone, Copy)]
enum Kind {
    Bottle(usize),
    Carton(usize),
    Mug(usize),
}

use Kind::{Bottle, Carton, Mug};

const CAPTURES: [(&str, Kind); 20] = [
    ("bottle-0", Bottle(1)),
    ("bottle-1", Bottle(1)),
    ("bottle-2", Bottle(1)),
    ("bottle-3", Bottle(2)),
    ("bottle-4", Bottle(2)),
    ("bottle-5", Bottle(3)),
    ("box-0", Carton(2)),
    ("box-1", Carton(2)),
    ("box-2", Carton(2)),
    ("box-3", Carton(2)),
    ("box-4", Carton(4)),
    ("mug-0", Mug(2)),
    ("mug-1", Mug(3)),
    ("mug-2", Mug(3)),
    ("mug-3", Mug(4)),
    ("mug-4", Mug(6)),
    ("turntable-bottle", Bottle(1)),
    ("turntable-box", Carton(2)),
    ("turntable-mug-0", Mug(3)),
    ("turntable-mug-1", Mug(1)),
];

/// A picture of linear colors, that goes around along its width.
struct Picture {
    width: usize,
    height: usize,
    pixels: Vec<DVec3>,
}

impl Picture {
    fn new(width: usize, height: usize, mut color: impl FnMut(usize, usize) -> DVec3) -> Self {
        let pixels = (0..width * height).map(|i| color(i % width, i / width)).collect();
        Self { width, height, pixels }
    }

    /// Rectangles and discs of three colors with grain, `tile` times side by side without a seam.
    fn print(rng: &mut ChaCha8Rng, size: (usize, usize), shapes: usize, tile: usize) -> Self {
        let (width, height) = (size.0 / tile, size.1);
        let colors = [(); 4].map(|()| color(rng, 0.05, 0.85));
        let mut one = Self::new(width, height, |_, _| colors[0]);
        for _ in 0..shapes / tile {
            let (cx, cy) = (rng.random_range(0..width), rng.random_range(0..height));
            let mut side = || rng.random_range(0.02..0.14) * height as f64;
            let (w, h) = (side(), side());
            let (round, which, light) = (rng.random_bool(0.5), rng.random_range(1..4), rng.random_range(0.6..1.2));
            for y in 0..height {
                for x in 0..width {
                    let dx = (x + width - cx) % width;
                    let dx = dx.min(width - dx) as f64 / w;
                    let dy = (y as f64 - cy as f64) / h;
                    if if round { dx * dx + dy * dy < 1.0 } else { dx.max(dy.abs()) < 1.0 } {
                        one.pixels[y * width + x] = light * colors[which];
                    }
                }
            }
        }
        one.pixels.iter_mut().for_each(|p| *p *= rng.random_range(0.85..1.15));
        Self::new(width * tile, height, |x, y| one.pixels[y * width + x % width].min(DVec3::ONE))
    }

    /// What lies on the table: a newspaper, a print, speckles or wood.
    fn cloth(rng: &mut ChaCha8Rng, kind: u64) -> Self {
        const N: usize = 800;
        let (a, b) = (color(rng, 0.05, 0.8), color(rng, 0.05, 0.8));
        let mut grid = |n: usize| {
            let values: Vec<f64> = (0..n * n).map(|_| rng.random_range(0.0..1.0)).collect();
            move |x: usize, y: usize| values[y * n / N * n + x * n / N]
        };
        let (coarse, middle, fine) = (grid(16), grid(100), grid(200));
        match kind {
            0 => {
                let mut page = Self::new(N, N, |_, _| DVec3::splat(0.75));
                for row in (6..N - 6).step_by(9) {
                    let mut from = 6;
                    while from < N - 40 {
                        let to = from + rng.random_range(4..30);
                        let ink = DVec3::splat(rng.random_range(0.05..0.2));
                        (row..row + 5).for_each(|y| page.pixels[y * N + from..y * N + to].fill(ink));
                        from = to + rng.random_range(3..7);
                    }
                }
                for _ in 0..9 {
                    let (x0, y0) = (rng.random_range(0..N - 130), rng.random_range(0..N - 130));
                    for (x, y) in (0..130 * 130).map(|i| (i % 130, i / 130)) {
                        let gray = 0.1 + 0.7 * fine((x0 + x) / 5 * 4, (y0 + y) / 5 * 4);
                        page.pixels[(y0 + y) * N + x0 + x] = DVec3::splat(gray);
                    }
                }
                page
            }
            1 => Self::print(rng, (N, N), 900, 1),
            2 => Self::new(N, N, |x, y| a.lerp(b, 0.5 * (middle(x, y) + fine(x, y)))),
            _ => Self::new(N, N, |x, y| {
                let (u, v) = (x as f64 / N as f64, y as f64 / N as f64);
                let rings = 140.0 * v + 5.0 * coarse(x, y) + 3.0 * (6.0 * u).sin();
                a.lerp(b, 0.5 + 0.3 * rings.sin() + 0.2 * (fine(x, y) - 0.5))
            }),
        }
    }

    /// Bilinear, at 0 to 1.
    fn at(&self, u: f64, v: f64) -> DVec3 {
        let x = (u * self.width as f64 - 0.5).rem_euclid(self.width as f64);
        let y = (v * self.height as f64 - 0.5).clamp(0.0, (self.height - 1) as f64);
        let (i, j) = (x as usize % self.width, y as usize);
        let (n, m) = ((i + 1) % self.width, (j + 1).min(self.height - 1));
        let row = |j: usize| {
            let row = &self.pixels[j * self.width..];
            row[i].lerp(row[n], x.fract())
        };
        row(j).lerp(row(m), y.fract())
    }
}

fn color(rng: &mut ChaCha8Rng, from: f64, to: f64) -> DVec3 {
    let mut value = || rng.random_range(from..to);
    DVec3::new(value(), value(), value())
}

/// One surface. Skins are numbers of pictures.
enum Part {
    /// The side of a cylinder or cone around z: lower and upper end, radii there, seen from inside.
    Cone {
        z: [f64; 2],
        r: [f64; 2],
        skin: usize,
        inner: bool,
    },
    Disc {
        z: f64,
        r: f64,
        skin: usize,
    },
    /// Corners, and the skins of -x, +x, -y, +y and the top.
    Block {
        low: DVec3,
        high: DVec3,
        skins: [usize; 5],
    },
}

impl Part {
    /// How far along a ray it is.
    fn hit(&self, o: DVec3, d: DVec3) -> f64 {
        match self {
            Self::Cone { z, r, .. } => {
                let slope = (r[1] - r[0]) / (z[1] - z[0]);
                let radius = r[0] + slope * (o.z - z[0]);
                let a = d.x * d.x + d.y * d.y - (slope * d.z).powi(2);
                let b = o.x * d.x + o.y * d.y - slope * d.z * radius;
                let root = (b * b - a * (o.x * o.x + o.y * o.y - radius * radius)).sqrt();
                let inside = |t: &f64| *t > 1e-6 && (z[0]..z[1]).contains(&(o.z + t * d.z));
                let hits = [(-b - root) / a, (-b + root) / a];
                hits.into_iter().filter(inside).fold(f64::INFINITY, f64::min)
            }
            Self::Disc { z, r, .. } => {
                let t = (z - o.z) / d.z;
                if t > 1e-6 && (o + t * d).truncate().length() < *r { t } else { f64::INFINITY }
            }
            Self::Block { low, high, .. } => {
                let (a, b) = ((low - o) / d, (high - o) / d);
                let (near, far) = (a.min(b).max_element(), a.max(b).min_element());
                if near <= far && near > 1e-6 { near } else { f64::INFINITY }
            }
        }
    }

    /// Normal and color at a point.
    fn look(&self, p: DVec3, skins: &[Picture]) -> (DVec3, DVec3) {
        match self {
            Self::Cone { z, r, skin, inner } => {
                let slope = (r[1] - r[0]) / (z[1] - z[0]);
                let normal = DVec3::new(p.x, p.y, -slope * p.truncate().length()).normalize();
                let v = (z[1] - p.z) / (z[1] - z[0]);
                (if *inner { -normal } else { normal }, skins[*skin].at(p.y.atan2(p.x) / TAU, v))
            }
            Self::Disc { skin, .. } => (DVec3::Z, skins[*skin].at(0.5, 0.5)),
            Self::Block { low, high, skins: sides } => {
                let q = (p - low) / (high - low);
                let away = [q.x, 1.0 - q.x, q.y, 1.0 - q.y, 1.0 - q.z];
                let side = (0..5).min_by(|a, b| away[*a].total_cmp(&away[*b])).unwrap_or(0);
                let u = [1.0 - q.y, q.y, q.x, 1.0 - q.x, q.x][side];
                let v = if side == 4 { q.y } else { 1.0 - q.z };
                let normal = [-DVec3::X, DVec3::X, -DVec3::Y, DVec3::Y, DVec3::Z][side];
                (normal, skins[sides[side]].at(0.999 * u, v))
            }
        }
    }
}

/// An object's parts and pictures.
fn object(rng: &mut ChaCha8Rng, kind: Kind) -> (Vec<Part>, Vec<Picture>) {
    let plain = |color: DVec3| Picture::new(1, 1, |_, _| color);
    match kind {
        Bottle(repeats) => {
            let (top, r) = (rng.random_range(0.5..0.62), rng.random_range(0.2..0.26));
            let skins = vec![
                Picture::print(rng, (1026, 256), 160, repeats),
                plain(color(rng, 0.05, 0.7)),
                plain(color(rng, 0.05, 0.7)),
            ];
            let cone = |z, r, skin| Part::Cone { z, r, skin, inner: false };
            let parts = vec![
                cone([0.0, 0.12], [r, r], 1),
                cone([0.12, top], [r, r], 0),
                cone([top, top + 0.18], [r, 0.08], 1),
                cone([top + 0.18, 0.95], [0.08, 0.08], 2),
                Part::Disc { z: 0.95, r: 0.08, skin: 2 },
            ];
            (parts, skins)
        }
        Carton(equal) => {
            let w = rng.random_range(0.22..0.32);
            let d = if equal == 4 { w } else { rng.random_range(0.15..0.32) };
            let skins = (0..3).map(|_| Picture::print(rng, (300, 400), 60, 1)).collect();
            let high = DVec3::new(w, d, rng.random_range(0.6..0.85));
            let sides = if equal == 4 { [0, 0, 0, 0, 2] } else { [0, 0, 1, 1, 2] };
            (vec![Part::Block { low: DVec3::new(-w, -d, 0.0), high, skins: sides }], skins)
        }
        Mug(repeats) => {
            let (h, r) = (rng.random_range(0.6..0.75), rng.random_range(0.28..0.34));
            let skins = vec![Picture::print(rng, (1020, 300), 120, repeats), plain(color(rng, 0.4, 0.8))];
            let arm = |x: [f64; 2], z: [f64; 2]| Part::Block {
                low: DVec3::new(x[0], -0.04, z[0] * h),
                high: DVec3::new(x[1], 0.04, z[1] * h),
                skins: [1; 5],
            };
            let s = r - 0.03;
            let parts = vec![
                Part::Cone { z: [0.0, h], r: [r, r], skin: 0, inner: false },
                Part::Cone { z: [0.03, h], r: [s, s], skin: 1, inner: true },
                Part::Disc { z: 0.03, r: s, skin: 1 },
                arm([r - 0.01, r + 0.2], [0.75, 0.85]),
                arm([r - 0.01, r + 0.2], [0.2, 0.3]),
                arm([r + 0.13, r + 0.2], [0.2, 0.85]),
            ];
            (parts, skins)
        }
    }
}

/// What is photographed.
struct Room {
    parts: Vec<Part>,
    skins: Vec<Picture>,
    table: Picture,
    wall: Picture,
    turntable: Option<Picture>,
}

impl Room {
    /// Distance and color of the object, which is turned by `turn`.
    fn object(&self, o: DVec3, d: DVec3, turn: DQuat) -> Option<(f64, DVec3)> {
        let middle = DVec3::new(0.0, 0.0, 0.45);
        if (middle - o).reject_from_normalized(d).length() > 0.75 {
            return None;
        }
        let back = turn.inverse();
        let (o, d, sun) = (back * o, back * d, back * SUN);
        let hits = self.parts.iter().map(|part| (part.hit(o, d), part));
        let (t, part) = hits.min_by(|a, b| a.0.total_cmp(&b.0)).filter(|h| h.0.is_finite())?;
        let (normal, skin) = part.look(o + t * d, &self.skins);
        Some((t, (0.55 + 0.15 * normal.z + 0.5 * normal.dot(sun).max(0.0)) * skin))
    }

    /// Color of table and walls.
    fn around(&self, o: DVec3, d: DVec3, turn: DQuat) -> DVec3 {
        let t = -o.z / d.z;
        let p = o + t * d;
        if t > 0.0 && p.truncate().abs().max_element() < TABLE {
            let near = p.truncate().length();
            let skin = match &self.turntable {
                Some(disc) if near < TURNTABLE => {
                    let q = turn.inverse() * p;
                    disc.at(0.5 * q.x + 0.5, 0.5 * q.y + 0.5)
                }
                _ => self.table.at(0.5 * p.x / TABLE + 0.5, 0.5 * p.y / TABLE + 0.5),
            };
            let lit = self.object(p + 1e-4 * DVec3::Z, SUN.normalize(), turn).is_none();
            return (0.4 + 0.25 * (near / 0.5).min(1.0) + if lit { 0.35 } else { 0.0 }) * skin;
        }
        let reach = |o: f64, d: f64| (4.0 * d.signum() - o) / d;
        let p = o + reach(o.x, d.x).min(reach(o.y, d.y)) * d;
        0.7 * self.wall.at(p.y.atan2(p.x) / TAU, (3.0 - p.z) / 6.0)
    }

    /// The photo, and the object alone.
    fn photo(&self, camera: &Camera, turn: DQuat, seed: u64) -> (RgbaImage, RgbaImage) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let o = camera.center();
        let tone = |v: f64| match v {
            v if v < 0.003_130_8 => 255.0 * 12.92 * v,
            v => 255.0 * (1.055 * v.min(1.0).powf(1.0 / 2.4) - 0.055),
        };
        let mut alone = RgbaImage::new(camera.width, camera.height);
        let photo = RgbaImage::from_fn(camera.width, camera.height, |x, y| {
            let (mut all, mut mine, mut hits) = (DVec3::ZERO, DVec3::ZERO, 0.0);
            for i in 0..SAMPLES * SAMPLES {
                let at = |p: u32, k: u32| f64::from(p) + (f64::from(k) + 0.5) / f64::from(SAMPLES);
                let d = camera.ray_direction(at(x, i % SAMPLES), at(y, i / SAMPLES)).normalize();
                match self.object(o, d, turn) {
                    Some((_, color)) => (all, mine, hits) = (all + color, mine + color, hits + 1.0),
                    None => all += self.around(o, d, turn),
                }
            }
            let (count, grain) = (f64::from(SAMPLES * SAMPLES), rng.random_range(-3.5..3.5));
            let byte = |v: f64| v.round().clamp(0.0, 255.0) as u8;
            let mine = (mine / f64::max(hits, 1.0)).to_array().map(|v| byte(tone(v)));
            alone.put_pixel(x, y, Rgba([mine[0], mine[1], mine[2], byte(255.0 * hits / count)]));
            let all = (all / count).to_array().map(|v| byte(tone(v) + grain));
            Rgba([all[0], all[1], all[2], 255])
        });
        (photo, alone)
    }
}

/// Cameras once around, relative to the object, and how the object is turned in each photo.
fn cameras(rng: &mut ChaCha8Rng, photos: usize, width: u32, turntable: bool) -> Vec<(bool, Camera, DQuat)> {
    let focal = rng.random_range(0.9..1.2) * f64::from(width);
    let (start, height) = (rng.random_range(0.0..TAU), rng.random_range(0.4..0.6));
    (0..photos + 8)
        .map(|i| {
            let photo = i < photos;
            let around = if photo { i as f64 / photos as f64 } else { ((i - photos) as f64 + 0.37) / 8.0 };
            let still = turntable && photo;
            let mut jitter = |by: f64| if still { 0.0 } else { rng.random_range(-by..by) };
            let azimuth = start + TAU * (around + jitter(0.2) / photos as f64);
            let elevation: f64 = height + jitter(0.2);
            let distance = (2.2 + jitter(0.2)) * focal / f64::from(width);
            let target = DVec3::new(jitter(0.08), jitter(0.08), 0.4 + jitter(0.08));
            let up = DVec3::new(jitter(0.08), jitter(0.08), 1.0);
            // The object turns and the camera stays: relative to the object it goes around.
            let turn = DQuat::from_rotation_z(if still { -TAU * around } else { 0.0 });
            let azimuth = if still { start } else { azimuth };
            let (flat, z) = (elevation.cos(), elevation.sin());
            let eye = DVec3::new(azimuth.cos() * flat, azimuth.sin() * flat, z) * distance + DVec3::new(0.0, 0.0, 0.4);
            let mut camera = Camera::look_at(eye, target, up, 1.0, width, width * 3 / 4);
            (camera.fx, camera.fy) = (focal, focal);
            (photo, camera, turn)
        })
        .collect()
}

fn capture(out: &Path, seed: u64, kind: Kind, photos: usize, width: u32) -> Result<(), Box<dyn Error>> {
    let turntable = out.to_string_lossy().contains("turntable");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let (parts, skins) = object(&mut rng, kind);
    let room = Room {
        parts,
        skins,
        table: Picture::cloth(&mut rng, seed % 4),
        wall: Picture::print(&mut rng, (1600, 400), 120, 1),
        turntable: turntable.then(|| Picture::cloth(&mut rng, 1)),
    };
    for part in ["images", "masks", "val"] {
        fs::create_dir_all(out.join(part))?;
    }
    let cameras = cameras(&mut rng, photos, width, turntable);
    let shot: Vec<_> = (cameras.par_iter().enumerate())
        .map(|(i, (_, camera, turn))| room.photo(camera, *turn, seed + 100 * i as u64))
        .collect();
    let (mut listed, mut others) = (Vec::new(), Vec::new());
    for (i, ((photo, mut camera, turn), (image, alone))) in cameras.into_iter().zip(shot).enumerate() {
        camera.world_to_camera *= DMat4::from_quat(turn);
        let (list, name) = match photo {
            true => (&mut listed, format!("images/{i:02}.png")),
            false => (&mut others, format!("val/{i:02}.png")),
        };
        if photo {
            image::DynamicImage::from(image).into_rgb8().save(out.join(&name))?;
            let mask = GrayImage::from_fn(width, alone.height(), |x, y| Luma([alone[(x, y)][3]]));
            mask.save(out.join(format!("masks/{i:02}.png")))?;
        } else {
            alone.save(out.join(&name))?;
        }
        list.push((name, camera));
    }
    fs::write(out.join("transforms_val.json"), transforms_json(&others))?;
    // Last: a folder that has it is complete.
    Ok(fs::write(out.join("transforms.json"), transforms_json(&listed))?)
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (out, photos, width) = match arguments.as_slice() {
        [out] => (out, 24, 640),
        [out, photos] => (out, photos.parse()?, 640),
        [out, photos, width] => (out, photos.parse()?, width.parse()?),
        _ => return Err("expected OUT [PHOTOS [WIDTH]]".into()),
    };
    for (seed, (name, kind)) in (0u64..).zip(CAPTURES) {
        let folder = Path::new(out).join(name);
        if !folder.join("transforms.json").is_file() {
            capture(&folder, seed, kind, photos, width)?;
            println!("{}", folder.display());
        }
    }
    Ok(())
}
