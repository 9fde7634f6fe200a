//! Pictures, alpha, normals and other properties of loaded surfaces against closed forms.

use std::f32::consts::PI;
use std::sync::Arc;

use freerange_assets::mesh::{AlphaMode, Map, Material, Mesh, Picture, Texture, Wrap, linear_to_srgb, srgb_to_linear};
use freerange_assets::render::{BakeConfig, Lighting, Scene, render, sample_surface};
use freerange_scene::camera::Camera;
use glam::{Affine2, DVec3, Mat2, Vec2, Vec3, Vec4};
use image::{Rgba, RgbaImage};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// A square of half size 0.4 at height `z` that faces up; picture coordinates have (0, 0) at its upper left, seen from
/// above with +y upwards.
fn square(z: f32, material: Material) -> Mesh {
    let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
    let positions: Vec<Vec3> = corners.iter().map(|&(x, y)| Vec3::new(0.4 * x, 0.4 * y, z)).collect();
    Mesh {
        rest: positions.clone(),
        uvs: corners.iter().map(|&(x, y)| Vec2::new(0.5 + 0.5 * x, 0.5 - 0.5 * y)).collect(),
        positions,
        normals: vec![Vec3::Z; 4],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        triangle_materials: vec![0; 2],
        materials: vec![material],
        ..Mesh::default()
    }
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

fn flat(albedo: f32) -> Material {
    Material::matt(Texture::Flat(Vec3::splat(albedo)))
}

fn map(image: RgbaImage, srgb: bool) -> Map {
    Map::new(Arc::new(Picture::new(image, srgb)))
}

fn plain(pixel: [u8; 4], srgb: bool) -> Map {
    map(RgbaImage::from_pixel(4, 4, Rgba(pixel)), srgb)
}

const SKY: Lighting = Lighting { environment: 0.8, sun: 0.0, sun_direction: Vec3::Z, rays: 64 };
const SUN: Lighting = Lighting { environment: 0.0, sun: 2.0, sun_direction: Vec3::Z, rays: 16 };

/// The picture from above (or, with a negative height, from below), 32 x 32.
fn seen(mesh: Mesh, lighting: &Lighting, height: f64) -> RgbaImage {
    let camera = Camera::look_at(DVec3::new(0.0, 0.0, height), DVec3::ZERO, DVec3::Y, 0.5, 32, 32);
    render(&Scene::new(mesh, lighting).unwrap(), &camera, 2)
}

fn code(linear: f32) -> u8 {
    (linear_to_srgb(linear) * 255.0).round() as u8
}

fn assert_near(found: &Rgba<u8>, expected: [u8; 4]) {
    let far = (0..4).any(|k| found[k].abs_diff(expected[k]) > 1);
    assert!(!far, "{found:?}, expected {expected:?}");
}

#[test]
fn a_picture_lies_with_its_first_row_at_the_top() {
    let image = RgbaImage::from_fn(8, 8, |x, y| Rgba([255 * (x / 4) as u8, 255 * (y / 4) as u8, 90, 255]));
    let unlit = |map| Material { unlit: true, ..Material::matt(Texture::Image(map)) };
    let upright = seen(square(0.0, unlit(map(image.clone(), true))), &SKY, 1.6);
    assert_near(upright.get_pixel(9, 9), [0, 0, 90, 255]);
    assert_near(upright.get_pixel(22, 9), [255, 0, 90, 255]);
    assert_near(upright.get_pixel(9, 22), [0, 255, 90, 255]);
    // Mirrored along u, by a transform.
    let transform = Affine2::from_mat2_translation(Mat2::from_diagonal(Vec2::new(-1.0, 1.0)), Vec2::X);
    let mirrored = seen(square(0.0, unlit(Map { transform, ..map(image, true) })), &SKY, 1.6);
    assert_near(mirrored.get_pixel(9, 9), [255, 0, 90, 255]);
}

#[test]
fn samples_blend_in_linear_light_and_wrap_as_told() {
    let picture = Picture::new(RgbaImage::from_fn(2, 1, |x, _| Rgba([255 * x as u8, 0, 0, 255])), true);
    let at = |u: f32, wrap| picture.sample(Vec2::new(u, 0.5), 0.0, [wrap; 2]).x;
    assert!((at(0.5, Wrap::Clamp) - 0.5).abs() < 1e-6);
    assert!((at(0.0, Wrap::Repeat) - 0.5).abs() < 1e-6);
    assert_eq!((at(0.0, Wrap::Clamp), at(0.0, Wrap::Mirror)), (0.0, 0.0));
    assert_eq!((at(1.25, Wrap::Repeat), at(1.25, Wrap::Mirror), at(-7.0, Wrap::Clamp)), (0.0, 1.0, 0.0));
    assert!([f32::MAX, f32::MIN, 1e20].iter().all(|&u| at(u, Wrap::Mirror).is_finite()));
}

#[test]
fn smaller_copies_hold_means_of_linear_light_weighted_by_alpha() {
    // Odd sizes: every pixel counts the same.
    let image = RgbaImage::from_fn(5, 3, |x, y| Rgba([if (x + y) % 2 == 0 { 255 } else { 0 }, 80, 0, 255]));
    let picture = Picture::new(image, true);
    let mean = picture.sample(Vec2::splat(0.3), 1e9, [Wrap::Repeat; 2]);
    assert!((mean.x - 8.0 / 15.0).abs() < 0.01, "{mean}");
    assert!((mean.y - srgb_to_linear(80.0 / 255.0)).abs() < 1e-6);
    let half = Picture::new(RgbaImage::from_fn(2, 1, |x, _| Rgba([200, 100 * x as u8, 0, 255 * x as u8])), true);
    let mean = half.sample(Vec2::splat(0.5), 2.0, [Wrap::Clamp; 2]);
    assert!((mean.y - srgb_to_linear(100.0 / 255.0)).abs() < 1e-6 && (mean.w - 0.5).abs() < 0.003, "{mean}");
    let data = Picture::new(RgbaImage::from_fn(2, 1, |x, _| Rgba([100 * x as u8, 0, 0, 255 * x as u8])), false);
    assert!((data.sample(Vec2::splat(0.5), 2.0, [Wrap::Clamp; 2]).x - 50.0 / 255.0).abs() < 0.003);
    assert_eq!(Picture::new(RgbaImage::new(0, 0), true).pixels(), [[255; 4]]);
}

#[test]
fn fine_pictures_show_their_mean_from_afar() {
    let image = RgbaImage::from_fn(1024, 1024, |x, y| Rgba(opaque([if (x + y) % 2 == 0 { 255 } else { 0 }; 3])));
    let mesh = square(0.0, Material { unlit: true, ..Material::matt(Texture::Image(map(image, true))) });
    let seen = seen(mesh, &SKY, 1.6);
    for (x, y) in [(16, 16), (10, 20), (21, 9)] {
        assert_near(seen.get_pixel(x, y), [code(0.5), code(0.5), code(0.5), 255]);
    }
}

fn opaque([r, g, b]: [u8; 3]) -> [u8; 4] {
    [r, g, b, 255]
}

#[test]
fn factors_and_vertex_colors_multiply() {
    let material = Material { factor: Vec4::new(0.5, 1.0, 1.0, 1.0), ..flat(0.6) };
    let mut mesh = square(0.0, material);
    mesh.colors = vec![Vec4::new(1.0, 0.25, 0.0, 1.0); 4];
    let [r, g, b] = [0.3, 0.15, 0.0].map(|v: f32| code(v * 0.8));
    assert_near(seen(mesh, &SKY, 1.6).get_pixel(16, 16), [r, g, b, 255]);
}

#[test]
fn both_sides_of_a_sheet_are_lit_as_they_face() {
    let sun_above = |height| seen(square(0.0, flat(0.5)), &SUN, height).get_pixel(16, 16).0;
    let lit = code(0.5 * 2.0 / PI);
    assert_eq!(sun_above(1.6), [lit, lit, lit, 255]);
    assert_eq!(sun_above(-1.6), [0, 0, 0, 255]);
    let sky = code(0.5 * 0.8);
    assert_near(seen(square(0.0, flat(0.5)), &SKY, -1.6).get_pixel(16, 16), [sky, sky, sky, 255]);
    // A sheet wound against its normals shows the same.
    let mut wound = square(0.0, flat(0.5));
    wound.triangles.iter_mut().for_each(|t| t.swap(1, 2));
    assert_eq!(seen(wound.clone(), &SUN, 1.6).get_pixel(16, 16)[0], lit);
    assert_eq!(seen(wound, &SUN, -1.6).get_pixel(16, 16)[0], 0);
}

#[test]
fn normal_maps_bend_towards_u_and_up() {
    // Leaning 45 degrees to the right, or upwards in the picture.
    let lit = |pixel: [u8; 3], direction: Vec3, mirror: bool| {
        let material = Material { normal_map: Some((plain(opaque(pixel), false), 1.0)), ..flat(0.5) };
        let lighting = Lighting { sun_direction: direction.normalize(), ..SUN };
        let mut mesh = square(0.0, material);
        if mirror {
            mesh.uvs.iter_mut().for_each(|uv| uv.x = 1.0 - uv.x);
        }
        srgb_to_linear(f32::from(seen(mesh, &lighting, 1.6).get_pixel(16, 16)[0]) / 255.0) * PI / (0.5 * 2.0)
    };
    let (right, up) = ([218, 128, 218], [128, 218, 218]);
    let slanted = Vec3::new(1.0, 0.0, 1.0);
    assert!((lit(right, slanted, false) - 1.0).abs() < 0.01);
    assert!((lit(up, Vec3::new(0.0, 1.0, 1.0), false) - 1.0).abs() < 0.01);
    assert!((lit(right, Vec3::Z, false) - 0.707).abs() < 0.01);
    assert!(lit(right, Vec3::new(-1.0, 0.0, 1.0), false) < 0.01);
    // Mirrored coordinates mirror x, and leave up as it is.
    assert!((lit(right, Vec3::new(-1.0, 0.0, 1.0), true) - 1.0).abs() < 0.01);
    assert!((lit(up, Vec3::new(0.0, 1.0, 1.0), true) - 1.0).abs() < 0.01);
}

#[test]
fn metals_and_emission_follow_their_maps() {
    // A map that makes a metal of a matt material, and the other way round.
    let metal =
        |blue: u8| Material { metallic: 1.0, metallic_roughness: Some(plain([0, 30, blue, 255], false)), ..flat(0.5) };
    // A smooth metal under light from everywhere shows its color too.
    let sky = code(0.5 * 0.8);
    for blue in [0, 255] {
        let pixel = seen(square(0.0, metal(blue)), &SKY, 1.6).get_pixel(16, 16).0;
        assert!(pixel[0].abs_diff(sky) <= 2, "{pixel:?} {sky}");
    }
    let [rough, smooth] = [255, 60].map(|green| {
        let maps = Some(plain([0, green, 255, 255], false));
        let material = Material { metallic: 1.0, metallic_roughness: maps, ..flat(0.5) };
        seen(square(0.0, material), &Lighting { sun: 0.3, ..SUN }, 1.6).get_pixel(16, 16)[0]
    });
    assert!(smooth > rough + 60, "the sun's reflection: {smooth} {rough}");
    let lamp = Material {
        emission: Vec3::new(0.5, 0.5, 0.0),
        emission_map: Some(plain([255, 0, 255, 255], true)),
        ..flat(0.0)
    };
    assert_near(seen(square(0.0, lamp.clone()), &SUN, -1.6).get_pixel(16, 16), [code(0.5), 0, 0, 255]);
    // It lights its surroundings: a square of half size 0.4 fills 0.831 of the view (weighted by the cosine) from 0.2
    // below its middle.
    let mut floor = square(-0.2, flat(1.0));
    floor.positions.iter_mut().for_each(|p| *p *= Vec3::new(0.1, 0.1, 1.0));
    let lighting = Lighting { sun: 0.0, rays: 512, ..SUN };
    let scene = Scene::new(join(floor, square(0.0, lamp)), &lighting).unwrap();
    let points = sample_surface(&scene, 3000, &mut ChaCha8Rng::seed_from_u64(1));
    let floor = points.iter().find(|p| p.position[2] < -0.1).unwrap();
    assert!((srgb_to_linear(floor.color[0]) - 0.5 * 0.831).abs() < 0.01, "{:?}", floor.color);
}

#[test]
fn opaque_surfaces_ignore_alpha_and_masks_cut_at_the_cutoff() {
    let image = RgbaImage::from_fn(8, 1, |x, _| Rgba([255, 255, 255, if x < 4 { 100 } else { 160 }]));
    let at = |alpha, x: u32| {
        let texture = Texture::Image(Map { wrap: [Wrap::Clamp; 2], ..map(image.clone(), true) });
        seen(square(0.0, Material { alpha, unlit: true, ..Material::matt(texture) }), &SKY, 1.6).get_pixel(x, 16)[3]
    };
    assert_eq!((at(AlphaMode::Opaque, 8), at(AlphaMode::Opaque, 24)), (255, 255));
    assert_eq!((at(AlphaMode::Mask { cutoff: 0.5 }, 8), at(AlphaMode::Mask { cutoff: 0.5 }, 24)), (0, 255));
    assert_eq!((at(AlphaMode::Blend, 8), at(AlphaMode::Blend, 24)), (100, 160));
}

#[test]
fn layers_blend_from_the_front_to_the_back() {
    let glass = |color: Vec3, alpha: f32| Material {
        alpha: AlphaMode::Blend,
        factor: Vec4::new(1.0, 1.0, 1.0, alpha),
        unlit: true,
        ..Material::matt(Texture::Flat(color))
    };
    let stack = join(square(0.1, glass(Vec3::X, 0.5)), square(0.0, glass(Vec3::Y, 0.25)));
    // Red hides half; green a quarter of the rest.
    let (red, green) = (0.5, 0.125);
    let alpha = red + green;
    let expected = [code(red / alpha), code(green / alpha), 0, (255.0 * alpha + 0.5) as u8];
    assert_near(seen(stack.clone(), &SKY, 1.6).get_pixel(16, 16), expected);
    let opaque = join(stack.clone(), square(-0.1, Material { unlit: true, ..Material::matt(Texture::Flat(Vec3::Z)) }));
    assert_near(seen(opaque, &SKY, 1.6).get_pixel(16, 16), [code(0.5), code(0.125), code(0.375), 255]);
    // From below the green one comes first.
    let alpha = 0.25 + 0.375;
    let expected = [code(0.375 / alpha), code(0.25 / alpha), 0, (255.0 * alpha + 0.5) as u8];
    assert_near(seen(stack, &SKY, -1.6).get_pixel(16, 16), expected);
}

#[test]
fn veils_let_their_share_of_sun_and_sky_through() {
    let veil = Material { alpha: AlphaMode::Blend, factor: Vec4::new(0.0, 0.0, 0.0, 0.4), ..flat(0.5) };
    let ground = square(0.0, flat(0.5));
    let color = |lighting: &Lighting| {
        let scene = Scene::new(join(ground.clone(), square(0.02, veil.clone())), lighting).unwrap();
        let points = sample_surface(&scene, 2000, &mut ChaCha8Rng::seed_from_u64(0));
        let middle = points.iter().filter(|p| {
            let [x, y, z] = p.position;
            z < 0.01 && x.abs() < 0.2 && y.abs() < 0.2
        });
        let (sum, n) = middle.fold((0.0, 0), |(s, n), p| (s + srgb_to_linear(p.color[0]), n + 1));
        sum / n as f32
    };
    let sun = color(&SUN);
    assert!((sun - 0.6 * 0.5 * 2.0 / PI).abs() < 1e-3, "{sun}");
    let sky = color(&SKY);
    assert!((sky - 0.6 * 0.5 * 0.8).abs() < 0.02, "{sky}");
}

#[test]
fn a_box_of_twelve_triangles_keeps_its_contact_shadow_and_no_face_turns_black() {
    // A closed box on a sheet: the sheet is darker beside the box than at its border.
    let mut cube = Mesh { materials: vec![flat(0.7)], ..Mesh::default() };
    for axis in 0..3 {
        for sign in [-1.0f32, 1.0] {
            let normal = Vec3::AXES[axis] * sign;
            let (x, y) = (Vec3::AXES[(axis + 1) % 3] * sign, Vec3::AXES[(axis + 2) % 3]);
            let base = cube.positions.len() as u32;
            for (u, v) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
                cube.positions.push(0.12 * (normal + u * x + v * y) + Vec3::Z * 0.12);
                cube.normals.push(normal);
                cube.uvs.push(Vec2::ZERO);
            }
            cube.triangles.extend([[0, 1, 2], [0, 2, 3]].map(|t: [u32; 3]| t.map(|i| i + base)));
        }
    }
    cube.rest.clone_from(&cube.positions);
    cube.triangle_materials = vec![0; cube.triangles.len()];
    let scene = Scene::new(join(square(-0.001, flat(0.7)), cube), &SKY).unwrap();
    assert!(scene.mesh().triangles.len() > 800, "{}", scene.mesh().triangles.len());
    let points = sample_surface(&scene, 20_000, &mut ChaCha8Rng::seed_from_u64(2));
    let mean = |keep: &dyn Fn(Vec3, Vec3) -> bool| {
        let found: Vec<f32> = points
            .iter()
            .filter(|p| keep(p.position.into(), p.normal.into()))
            .map(|p| srgb_to_linear(p.color[0]))
            .collect();
        assert!(found.len() > 50, "{}", found.len());
        found.iter().sum::<f32>() / found.len() as f32
    };
    let full = 0.7 * 0.8;
    let ground = |p: Vec3, n: Vec3| n.z > 0.9 && p.z < 0.01;
    let beside = mean(&|p, n| ground(p, n) && (0.13..0.15).contains(&p.x.abs()) && p.y.abs() < 0.1);
    let border = mean(&|p, n| ground(p, n) && p.x.abs() > 0.37);
    let roof = mean(&|p, n| n.z > 0.9 && p.z > 0.2);
    assert!((roof - full).abs() < 1e-3, "{roof}");
    assert!((border / full) > 0.95, "{border}");
    assert!((0.6..0.9).contains(&(beside / full)), "{beside}");
    // Nobody sees the underside of the box.
    let covered = points.iter().filter(|p| {
        let [x, y, z] = p.position;
        x.abs() < 0.05 && y.abs() < 0.05 && z > -5e-4 && z < 0.01 && p.normal[2] < -0.9
    });
    assert_eq!(covered.count(), 0, "the underside of the box");
}

#[test]
fn what_lies_behind_closed_walls_is_left_out_and_an_opening_shows_it() {
    let room = |open: bool| {
        let mut mesh = Mesh { materials: vec![flat(0.5)], ..Mesh::default() };
        for axis in 0..3 {
            for sign in [-1.0f32, 1.0] {
                if open && axis == 2 && sign > 0.0 {
                    continue;
                }
                let (x, y) = (Vec3::AXES[(axis + 1) % 3] * sign, Vec3::AXES[(axis + 2) % 3]);
                let base = mesh.positions.len() as u32;
                for (u, v) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
                    mesh.positions.push(0.25 * (Vec3::AXES[axis] * sign + u * x + v * y));
                    mesh.normals.push(Vec3::AXES[axis] * sign);
                    mesh.uvs.push(Vec2::ZERO);
                }
                mesh.triangles.extend([[0, 1, 2], [0, 2, 3]].map(|t: [u32; 3]| t.map(|i| i + base)));
            }
        }
        mesh.rest.clone_from(&mesh.positions);
        mesh.triangle_materials = vec![0; mesh.triangles.len()];
        let mut inner = square(0.0, flat(0.5));
        inner.positions.iter_mut().for_each(|p| *p *= 0.3);
        let scene = Scene::new(join(mesh, inner), &SKY).unwrap();
        let points = sample_surface(&scene, 4000, &mut ChaCha8Rng::seed_from_u64(3));
        points.iter().filter(|p| p.position.iter().all(|v| v.abs() < 0.2)).count()
    };
    assert_eq!(room(false), 0);
    assert!(room(true) > 50, "{}", room(true));
}

#[test]
fn dense_meshes_share_points_and_look_the_same() {
    // A bowl, open above, of 90,000 triangles.
    let n = 150;
    let mut bowl = Mesh { materials: vec![flat(0.6)], ..Mesh::default() };
    for j in 0..=n {
        for i in 0..=2 * n {
            let (a, b) = (PI * i as f32 / n as f32, 0.5 * PI * j as f32 / n as f32);
            let d = Vec3::new(b.sin() * a.cos(), b.sin() * a.sin(), -b.cos());
            bowl.positions.push(0.45 * d);
            bowl.normals.push(d);
            bowl.uvs.push(Vec2::ZERO);
        }
    }
    for j in 0..n as u32 {
        for i in 0..2 * n as u32 {
            let at = |i: u32, j: u32| j * (2 * n as u32 + 1) + i;
            bowl.triangles.push([at(i, j), at(i, j + 1), at(i + 1, j + 1)]);
            bowl.triangles.push([at(i, j), at(i + 1, j + 1), at(i + 1, j)]);
        }
    }
    bowl.triangle_materials = vec![0; bowl.triangles.len()];
    bowl.rest.clone_from(&bowl.positions);
    let sky = Lighting { rays: 32, ..SKY };
    let camera = Camera::look_at(DVec3::new(0.0, -0.9, 1.3), DVec3::ZERO, DVec3::Z, 0.8, 64, 64);
    let [fine, coarse] = [1_000_000, 3000].map(|max_points| {
        let config = BakeConfig { max_points, ..BakeConfig::default() };
        render(&Scene::with_config(bowl.clone(), &sky, &config).unwrap(), &camera, 2)
    });
    let config = BakeConfig { max_points: 3000, ..BakeConfig::default() };
    let again = render(&Scene::with_config(bowl.clone(), &sky, &config).unwrap(), &camera, 2);
    assert!(again == coarse, "the same input gives the same bytes");
    // As few points as allowed are no reason to fail; coordinates far outside the canonical sphere are.
    let few = BakeConfig { max_points: 100, ..BakeConfig::default() };
    let image = render(&Scene::with_config(bowl.clone(), &sky, &few).unwrap(), &camera, 1);
    assert_eq!(image.get_pixel(32, 32)[3], 255);
    let mut huge = bowl.clone();
    huge.positions[0].x = 1e30;
    assert!(Scene::new(huge, &sky).is_err_and(|e| e.to_string().contains("1000")));
    let mut worst = 0;
    for (a, b) in fine.pixels().zip(coarse.pixels()) {
        assert_eq!(a[3], b[3]);
        worst = worst.max(a[0].abs_diff(b[0]));
    }
    assert!(worst <= 12, "{worst}");
    // The single sheet's inside is lit: nearly a cavity of albedo 0.6 under the sky.
    let inside = srgb_to_linear(f32::from(fine.get_pixel(32, 34)[0]) / 255.0);
    assert!((0.6 * 0.8 * 0.55..0.6 * 0.8).contains(&inside), "{inside}");
    assert!(Scene::with_config(bowl, &sky, &BakeConfig { max_edge: f32::NAN, ..BakeConfig::default() }).is_err());
}
