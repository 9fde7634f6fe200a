//! How fast views are rendered. `cargo bench -p freerange-assets --bench render -- [TRIANGLES] [PIXELS]`.
//!
//! The scene: a bumpy sphere of 30,000 triangles (or TRIANGLES) under a picture of 1024 x 1024 pixels, seen from 1.5 away
//! at 512 x 512 pixels (or PIXELS squared) of 2 x 2 samples. One thread. A ray is a sample of the whole image; `hit`
//! counts those that meet the object.

use std::sync::Arc;
use std::time::{Duration, Instant};

use freerange_assets::mesh::{Map, Material, Mesh, Picture, Texture};
use freerange_assets::render::{Lighting, Scene, render_in_steps};
use freerange_scene::camera::Camera;
use glam::{DVec3, Vec2, Vec3};
use image::{Rgba, RgbaImage};

#[path = "../../../../tools/machine.rs"]
mod machine;

fn object(triangles: usize) -> Mesh {
    let n = ((triangles as f32 / 4.0).sqrt() as usize).max(4);
    let point = |u: f32, v: f32| {
        let (a, b) = (u * std::f32::consts::TAU, v * std::f32::consts::PI);
        let d = Vec3::new(b.sin() * a.cos(), b.sin() * a.sin(), b.cos());
        d * (0.44 + 0.03 * (9.0 * d.x).sin() * (8.0 * d.y).cos() + 0.02 * (17.0 * d.z + 3.0 * d.x).sin())
    };
    let picture = RgbaImage::from_fn(1024, 1024, |x, y| {
        Rgba([(x / 4) as u8, (y / 4) as u8, if (x / 32 + y / 32) % 2 == 0 { 200 } else { 60 }, 255])
    });
    let texture = Texture::Image(Map::new(Arc::new(Picture::new(picture, true))));
    let mut mesh = Mesh {
        materials: vec![Material { specular: 0.04, roughness: 0.8, ..Material::matt(texture) }],
        ..Mesh::default()
    };
    for j in 0..=n {
        for i in 0..=2 * n {
            let uv = Vec2::new(i as f32 / (2 * n) as f32, j as f32 / n as f32);
            let (e, p) = (1e-3, point(uv.x, uv.y));
            let normal = (point(uv.x, uv.y + e) - p).cross(point(uv.x + e, uv.y) - p);
            mesh.positions.push(p);
            mesh.normals.push(normal.try_normalize().filter(|n| n.dot(p) > 0.0).unwrap_or(p.normalize()));
            mesh.uvs.push(uv);
        }
    }
    for j in 0..n as u32 {
        for i in 0..2 * n as u32 {
            let at = |i: u32, j: u32| j * (2 * n as u32 + 1) + i;
            mesh.triangles.push([at(i, j), at(i, j + 1), at(i + 1, j + 1)]);
            mesh.triangles.push([at(i, j), at(i + 1, j + 1), at(i + 1, j)]);
        }
    }
    mesh.triangle_materials = vec![0; mesh.triangles.len()];
    mesh.rest.clone_from(&mesh.positions);
    mesh
}

fn milliseconds(time: Duration) -> f64 {
    1e3 * time.as_secs_f64()
}

fn main() {
    let numbers: Vec<usize> = std::env::args().filter_map(|a| a.parse().ok()).collect();
    let triangles = numbers.first().copied().unwrap_or(30_000);
    let pixels = numbers.get(1).copied().unwrap_or(512) as u32;
    println!("{}", machine::machine(1));
    println!("cargo bench -p freerange-assets --bench render -- {triangles} {pixels}");
    let mesh = object(triangles);
    println!("{} triangles", mesh.triangles.len());

    let dark = Lighting { rays: 1, ..Lighting::default() };
    for (name, lighting) in [("hierarchy, light of 1 ray", dark), ("hierarchy, light", Lighting::default())] {
        let copy = mesh.clone();
        let start = Instant::now();
        assert!(Scene::new(copy, &lighting).is_ok());
        println!("{name:28} {:8.1} ms", milliseconds(start.elapsed()));
    }

    let scene = Scene::new(mesh, &Lighting::default()).expect("a sound mesh");
    let camera =
        Camera::look_at(DVec3::new(0.9, -1.0, 0.66), DVec3::ZERO, DVec3::Z, 49.1f64.to_radians(), pixels, pixels);
    let rays = 4.0 * f64::from(pixels).powi(2);
    for (name, by_rays) in [("projection", false), ("rays", true)] {
        let mut best = [Duration::MAX; 3];
        let mut covered = 0.0;
        let begin = Instant::now();
        while begin.elapsed() < Duration::from_secs(3) {
            let (mut last, mut step) = (Instant::now(), 0);
            let image = render_in_steps(&scene, &camera, 2, by_rays, |_| {
                best[step] = best[step].min(last.elapsed());
                (last, step) = (Instant::now(), step + 1);
            });
            covered = image.pixels().map(|p| f64::from(p[3])).sum::<f64>() / 255.0 * 4.0;
        }
        let total = best.iter().sum::<Duration>().as_secs_f64();
        println!(
            "{name:12} visibility {:7.1} ms, shading {:7.1} ms, encoding {:5.1} ms: {:6.2} M rays/s, {:5.2} M hits/s",
            milliseconds(best[0]),
            milliseconds(best[1]),
            milliseconds(best[2]),
            rays / total / 1e6,
            covered / total / 1e6
        );
    }
}
