//! Writes a contact sheet of generated objects, and prints where the time goes.
//!
//! `cargo run --release -p freerange-mesh --example gallery -- sheet.png [first seed] [count] [kind]`

use std::error::Error;
use std::time::{Duration, Instant};

use freerange_mesh::{
    CameraConfig, GeneratorConfig, LightingConfig, Scene, generate, orbit_cameras, render, sample_surface,
};
use image::{Rgb, RgbImage};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const TILE: u32 = 220;
const COLUMNS: u32 = 8;
const VIEWS_TIMED: usize = 10;

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let path = args.next().unwrap_or_else(|| "gallery.png".into());
    let first: u64 = args.next().map_or(Ok(0), |a| a.parse())?;
    let count: u32 = args.next().map_or(Ok(48), |a| a.parse())?;
    let config = match args.next() {
        Some(kind) => GeneratorConfig::only(serde_json::from_value(kind.into())?),
        None => GeneratorConfig::default(),
    };
    let mut sheet = RgbImage::from_pixel(COLUMNS * TILE, count.div_ceil(COLUMNS) * TILE, Rgb([255; 3]));
    let mut spent = [Duration::ZERO; 4];
    let (mut triangles, mut vertices) = (Vec::new(), 0);
    for i in 0..count {
        let mut rng = ChaCha8Rng::seed_from_u64(first + u64::from(i));
        let start = Instant::now();
        let mesh = generate(first + u64::from(i), &config)?;
        triangles.push(mesh.triangles.len());
        vertices += mesh.positions.len();
        let generated = Instant::now();
        let scene = Scene::new(mesh, &LightingConfig::default().sample(&mut rng))?;
        let baked = Instant::now();
        let cameras = orbit_cameras(VIEWS_TIMED, &mut rng, &CameraConfig::default());
        for camera in &cameras {
            render(&scene, camera, 2);
        }
        let rendered = Instant::now();
        sample_surface(&scene, 4096, &mut rng);
        let sampled = Instant::now();
        for (sum, (a, b)) in
            spent.iter_mut().zip([(start, generated), (generated, baked), (baked, rendered), (rendered, sampled)])
        {
            *sum += b - a;
        }
        let view = render(&scene, &cameras[0].resized(TILE, TILE), 3);
        let corner = [i % COLUMNS * TILE, i / COLUMNS * TILE];
        for (x, y, p) in view.enumerate_pixels() {
            let alpha = f32::from(p[3]) / 255.0;
            let over = [0, 1, 2].map(|k| (255.0 + (f32::from(p[k]) - 255.0) * alpha) as u8);
            sheet.put_pixel(corner[0] + x, corner[1] + y, Rgb(over));
        }
    }
    sheet.save(&path)?;
    triangles.sort_unstable();
    let ms = |d: Duration| 1e3 * d.as_secs_f64() / f64::from(count);
    println!(
        "per object: generate {:.1} ms, bake {:.1} ms, {VIEWS_TIMED} views {:.1} ms, samples {:.1} ms, all {:.1} ms",
        ms(spent[0]),
        ms(spent[1]),
        ms(spent[2]),
        ms(spent[3]),
        ms(spent.iter().sum())
    );
    println!(
        "triangles: least {}, median {}, most {}; vertices: mean {}",
        triangles[0],
        triangles[triangles.len() / 2],
        triangles[triangles.len() - 1],
        vertices / count as usize
    );
    Ok(())
}
