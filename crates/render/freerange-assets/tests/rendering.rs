//! Geometry and light against closed forms.

use std::f32::consts::{PI, TAU};

use freerange_assets::mesh::{Material, Mesh, Texture, linear_to_srgb};
use freerange_assets::render::{Lighting, Scene, render, sample_surface};
use freerange_scene::camera::Camera;
use glam::{DVec3, Vec2, Vec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn mesh(positions: Vec<Vec3>, normals: Vec<Vec3>, triangles: Vec<[u32; 3]>, albedo: f32) -> Mesh {
    Mesh {
        rest: positions.clone(),
        uvs: vec![Vec2::ZERO; positions.len()],
        positions,
        normals,
        triangle_materials: vec![0; triangles.len()],
        triangles,
        materials: vec![Material::matt(Texture::Flat(Vec3::splat(albedo)))],
        ..Mesh::default()
    }
}

fn sphere(radius: f32, n: u32, albedo: f32) -> Mesh {
    let mut normals = Vec::new();
    for j in 0..=n {
        for i in 0..2 * n {
            let (a, b) = (TAU * i as f32 / (2 * n) as f32, PI * j as f32 / n as f32);
            normals.push(Vec3::new(b.sin() * a.cos(), b.sin() * a.sin(), -b.cos()));
        }
    }
    let mut triangles = Vec::new();
    for j in 0..n {
        for i in 0..2 * n {
            let id = |i: u32, j: u32| j * 2 * n + i % (2 * n);
            if j > 0 {
                triangles.push([id(i, j), id(i + 1, j), id(i + 1, j + 1)]);
            }
            triangles.push([id(i, j), id(i + 1, j + 1), id(i, j + 1)]);
        }
    }
    mesh(normals.iter().map(|&v| v * radius).collect(), normals, triangles, albedo)
}

/// A square of half size `half` at height `z` that faces up.
fn square(half: f32, z: f32, albedo: f32) -> Mesh {
    let positions = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
    let positions = positions.map(|(x, y)| Vec3::new(half * x, half * y, z)).to_vec();
    mesh(positions, vec![Vec3::Z; 4], vec![[0, 1, 2], [0, 2, 3]], albedo)
}

fn join(mut a: Mesh, b: Mesh) -> Mesh {
    let (vertices, materials) = (a.positions.len() as u32, a.materials.len() as u16);
    a.triangles.extend(b.triangles.iter().map(|t| t.map(|i| i + vertices)));
    a.triangle_materials.extend(b.triangle_materials.iter().map(|m| m + materials));
    a.positions.extend(b.positions);
    a.normals.extend(b.normals);
    a.rest.extend(b.rest);
    a.uvs.extend(b.uvs);
    a.materials.extend(b.materials);
    a
}

fn lighting(environment: f32, sun: f32) -> Lighting {
    Lighting { environment, sun, sun_direction: Vec3::Z, rays: 64 }
}

fn from_above(size: u32) -> Camera {
    Camera::look_at(DVec3::new(0.0, 0.0, 2.0), DVec3::ZERO, DVec3::Y, 0.5, size, size)
}

#[test]
fn rays_meet_a_sphere_where_algebra_says() {
    let scene = Scene::new(sphere(0.4, 96, 0.5), &lighting(1.0, 0.0)).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let (mut hits, mut misses) = (0, 0);
    for _ in 0..4000 {
        let mut draw = |s: f32| Vec3::new(rng.random_range(-s..s), rng.random_range(-s..s), rng.random_range(-s..s));
        let origin = draw(1.0).normalize() * 1.5;
        let direction = (draw(0.5) - origin).normalize();
        let b = origin.dot(direction);
        let nearest = (origin - b * direction).length();
        let hit = scene.intersect(origin, direction);
        // Within 0.1% of the rim the facets decide.
        if nearest < 0.3995 {
            let expected = -b - (0.16 - nearest * nearest).sqrt();
            let t = hit.expect("inside the disc").t;
            // The facets lie up to 2e-4 below the sphere; a slanted ray travels farther.
            assert!((t - expected).abs() < 2.5e-4 / (1.0 - (nearest / 0.4).powi(2)).sqrt(), "{t} {expected}");
            hits += 1;
        } else if nearest > 0.4 {
            assert!(hit.is_none());
            misses += 1;
        }
    }
    assert!(hits > 1000 && misses > 300, "{hits} {misses}");
}

#[test]
fn alpha_of_a_sphere_is_the_share_of_samples_in_its_disc() {
    let scene = Scene::new(sphere(0.4, 128, 0.5), &lighting(1.0, 0.0)).unwrap();
    let camera = Camera::look_at(DVec3::new(1.2, -0.7, 0.5), DVec3::new(0.1, 0.05, 0.0), DVec3::Z, 0.8, 64, 48);
    let image = render(&scene, &camera, 4);
    let mut borderline = 0;
    for (x, y, pixel) in image.enumerate_pixels() {
        let (mut sure, mut maybe) = (0, 0);
        for k in 0..16 {
            let p = [x, y].map(f64::from);
            let offset = [(k % 4) as f64, (k / 4) as f64].map(|o| (o + 0.5) / 4.0);
            let d = camera.ray_direction(p[0] + offset[0], p[1] + offset[1]);
            let distance = camera.center().cross(d).length();
            sure += u32::from(distance < 0.3998);
            maybe += u32::from(distance < 0.4);
        }
        let hits = (f32::from(pixel[3]) / 255.0 * 16.0).round() as u32;
        assert!((sure..=maybe).contains(&hits), "pixel {x} {y}: {hits} of {sure}..={maybe}");
        borderline += u32::from(hits > 0 && hits < 16);
    }
    assert!(borderline > 40, "the rim is anti-aliased: {borderline}");
}

#[test]
fn a_plane_under_the_environment_shows_albedo_times_radiance() {
    let scene = Scene::new(square(0.4, 0.0, 0.35), &lighting(0.85, 0.0)).unwrap();
    let image = render(&scene, &from_above(32), 2);
    let expected = (linear_to_srgb(0.35 * 0.85) * 255.0).round() as u8;
    let center = image.get_pixel(16, 16);
    assert_eq!(center.0, [expected, expected, expected, 255]);
    let corner = image.get_pixel(0, 0);
    assert_eq!(corner[3], 0);
    for p in sample_surface(&scene, 50, &mut ChaCha8Rng::seed_from_u64(0)) {
        assert!((p.color[0] - linear_to_srgb(0.35 * 0.85)).abs() < 1e-4);
        assert_eq!(p.normal, [0.0, 0.0, 1.0]);
    }
}

#[test]
fn the_sun_adds_its_irradiance_over_pi_unless_something_is_in_the_way() {
    let at = |mesh: Mesh, x: u32| {
        let scene = Scene::new(mesh, &lighting(0.0, 1.5)).unwrap();
        // From the side, below the blocker.
        let camera = Camera::look_at(DVec3::new(0.0, -1.5, 0.3), DVec3::ZERO, DVec3::Z, 0.5, 33, 33);
        render(&scene, &camera, 1).get_pixel(x, 16)[0]
    };
    let lit = (linear_to_srgb(0.6 * 1.5 / PI) * 255.0).round() as u8;
    assert_eq!(at(square(0.4, 0.0, 0.6), 16), lit);
    let blocked = join(square(0.4, 0.0, 0.6), square(0.1, 0.8, 0.0));
    assert_eq!(at(blocked.clone(), 16), 0);
    assert_eq!(at(blocked, 26), lit);
}

#[test]
fn light_inside_a_white_cavity_is_neither_lost_nor_made() {
    // A box open at the top, of albedo 1: by reciprocity every point must show the environment's radiance.
    let n = 12u32;
    let mut open_box = square(0.3, -0.25, 1.0);
    open_box.triangles.clear();
    open_box.triangle_materials.clear();
    open_box.positions.clear();
    let mut normals = Vec::new();
    let mut wall = |origin: Vec3, u: Vec3, v: Vec3| {
        let base = open_box.positions.len() as u32;
        for j in 0..=n {
            for i in 0..=n {
                open_box.positions.push(origin + u * (i as f32 / n as f32) + v * (j as f32 / n as f32));
                normals.push(u.cross(v).normalize());
            }
        }
        for j in 0..n {
            for i in 0..n {
                let id = |i: u32, j: u32| base + j * (n + 1) + i;
                open_box.triangles.push([id(i, j), id(i + 1, j), id(i + 1, j + 1)]);
                open_box.triangles.push([id(i, j), id(i + 1, j + 1), id(i, j + 1)]);
            }
        }
    };
    let (x, y, z) = (Vec3::X * 0.6, Vec3::Y * 0.6, Vec3::Z * 0.3);
    let corner = Vec3::splat(-0.3);
    wall(corner, x, y);
    wall(corner, y, z);
    wall(corner + y, x, z);
    wall(corner + x + y, -y, z);
    wall(corner + x, -x, z);
    open_box.rest.clone_from(&open_box.positions);
    open_box.uvs = vec![Vec2::ZERO; open_box.positions.len()];
    open_box.triangle_materials = vec![0; open_box.triangles.len()];
    open_box.normals = normals;
    let scene = Scene::new(open_box, &lighting(0.6, 0.0)).unwrap();
    for p in sample_surface(&scene, 400, &mut ChaCha8Rng::seed_from_u64(1)) {
        let linear = ((p.color[0] + 0.055) / 1.055).powf(2.4);
        assert!((0.59..0.605).contains(&linear), "{linear} at {:?}", p.position);
    }
}

#[test]
fn surface_points_spread_by_area() {
    // Areas 3 : 1.
    let positions = [(0.0, 0.0), (0.3, 0.0), (0.0, 0.2), (0.0, 0.0), (-0.1, 0.0), (0.0, -0.2)];
    let positions: Vec<Vec3> = positions.iter().map(|&(x, y)| Vec3::new(x, y, 0.0)).collect();
    let scene =
        Scene::new(mesh(positions, vec![Vec3::Z; 6], vec![[0, 1, 2], [3, 4, 5]], 0.5), &lighting(1.0, 0.0)).unwrap();
    let points = sample_surface(&scene, 1000, &mut ChaCha8Rng::seed_from_u64(5));
    let first: Vec<_> = points.iter().filter(|p| p.position[0] > 0.0).collect();
    assert!((749..=751).contains(&first.len()), "{}", first.len());
    let total: f32 = points.iter().map(|p| p.area).sum();
    assert!((total - 0.04).abs() < 1e-5, "{total}");
    // Four congruent sub-triangles of the first: midpoints cut it, each must hold a quarter.
    let in_corner = |p: &&&freerange_assets::render::SurfacePoint| p.position[0] > 0.15;
    let right = first.iter().filter(in_corner).count() as f32 / first.len() as f32;
    assert!((right - 0.25).abs() < 0.02, "{right}");
    assert!(sample_surface(&scene, 0, &mut ChaCha8Rng::seed_from_u64(5)).is_empty());
}

#[test]
fn malformed_meshes_are_refused() {
    let good = square(0.4, 0.0, 0.5);
    let refused = |change: &dyn Fn(&mut Mesh)| {
        let mut m = good.clone();
        change(&mut m);
        Scene::new(m, &Lighting::default()).err().map(|e| e.to_string()).unwrap_or_default()
    };
    assert!(refused(&|m| m.triangles[1][2] = 4).contains("indices below 4, found 4"));
    assert!(refused(&|m| m.triangle_materials[0] = 1).contains("triangle_materials"));
    assert!(refused(&|m| m.positions[0].x = f32::NAN).contains("positions"));
    assert!(refused(&|m| m.normals.truncate(2)).contains("normals"));
    assert!(refused(&|m| m.triangles.clear()).contains("at least one"));
    assert_eq!(refused(&|_| {}), "");
}
