//! Meshes as other programs read and draw them, beside the Gaussians that they were made of.

use std::{f64::consts::FRAC_PI_2, path::Path};

use freerange_assets::mesh::{LoadLimits, Mesh, load_mesh};
use freerange_assets::render::{Lighting, Scene};
use freerange_gaussians::{Gaussians, Splats, channel};
use freerange_optim::meshing::{MeshConfig, mesh_of, save};
use freerange_raster::{RasterConfig, render};
use freerange_scene::camera::Camera;
use glam::{DQuat, DVec3, Vec3};

/// Flat Gaussians on an egg with patches of color that no mirror leaves as they are.
fn egg() -> Splats {
    let mut cloud = Gaussians::default();
    let n = 12000;
    for i in 0..n {
        let z = 1.0 - 2.0 * (f64::from(i) + 0.5) / f64::from(n);
        let turn = f64::from(i) * 2.399_963;
        let r = (1.0 - z * z).sqrt();
        let d = DVec3::new(r * turn.cos(), r * turn.sin(), z);
        let q = DQuat::from_rotation_arc(DVec3::Z, d);
        let mut row = [0f32; channel::COUNT];
        row[channel::MEAN].copy_from_slice(&(DVec3::new(0.5, 0.4, 0.3) * d).as_vec3().to_array());
        row[channel::LOG_SCALE].copy_from_slice(&[-4.4, -4.4, -6.0]);
        row[channel::ROTATION].copy_from_slice(&[q.w, q.x, q.y, q.z].map(|v| v as f32));
        row[channel::LOGIT_OPACITY] = 4.0;
        let bands = (d * 3.0).map(|v| 0.5 + 0.3 * (2.0 * v).sin()).as_vec3();
        let patch = Vec3::splat(if d.x > 0.2 && d.y > 0.1 { 0.15 } else { 0.0 });
        row[channel::COLOR].copy_from_slice(&(bands + patch).to_array());
        cloud.push(&row);
    }
    cloud.into()
}

/// The frame with +y up.
fn y_up() -> DQuat {
    DQuat::from_rotation_x(-FRAC_PI_2)
}

/// The mesh of a file, in the frame of the Gaussians.
fn loaded(path: &Path) -> Mesh {
    let loaded = load_mesh(path, &LoadLimits::default()).unwrap();
    let back = (loaded.canonical_from_file * glam::DAffine3::from_quat(y_up())).inverse();
    let mut mesh = loaded.mesh;
    let turn = |v: &mut Vec3| *v = back.transform_vector3(v.as_dvec3()).normalize().as_vec3();
    mesh.normals.iter_mut().for_each(turn);
    mesh.positions.iter_mut().for_each(|p| *p = back.transform_point3(p.as_dvec3()).as_vec3());
    mesh
}

/// PSNR in dB of the mesh's pictures with what the Gaussians show, where both are opaque; over cameras from all around.
fn agreement(splats: &Splats, mesh: Mesh) -> f64 {
    let scene = Scene::new(mesh, &Lighting::default()).unwrap();
    let (mut sum, mut count) = (0.0, 0.0);
    for eye in [DVec3::X, DVec3::Y, DVec3::NEG_X, DVec3::NEG_Y, DVec3::new(0.5, 0.5, 0.7), DVec3::new(-0.5, 0.3, -0.8)]
    {
        let camera = Camera::look_at(2.0 * eye, DVec3::ZERO, DVec3::Z, 0.6, 160, 160);
        let drawn = freerange_assets::render::render(&scene, &camera, 3);
        let shown = render(splats.cloud.rows(), &[camera], &[[0.0; 3]], &RasterConfig::default()).unwrap();
        for (i, pixel) in drawn.pixels().enumerate() {
            if pixel[3] < 255 || shown.alpha[i] < 0.95 {
                continue;
            }
            for k in 0..3 {
                let off = f64::from(pixel[k]) / 255.0 - f64::from(shown.rgb[3 * i + k]);
                sum += off * off;
                count += 1.0;
            }
        }
    }
    assert!(count > 60_000.0, "{count}");
    -10.0 * (sum / count).log10()
}

#[test]
fn a_mesh_shows_what_its_gaussians_show() {
    let folder = tempfile::tempdir().unwrap();
    let splats = egg();
    let plain = MeshConfig { voxels: 64, views: 40, pixels: 256, ..MeshConfig::default() };
    let path = folder.path().join("m.glb");
    let made = |config: &MeshConfig| {
        let shape = mesh_of(&splats, config).unwrap();
        save(&shape, &path, y_up()).unwrap();
        (shape, loaded(&path))
    };
    let (shape, mesh) = made(&plain);
    assert!(shape.is_closed_manifold());
    let fine = agreement(&splats, mesh);
    let (shape, mesh) = made(&MeshConfig { triangles: Some(800), ..plain });
    assert!(shape.is_closed_manifold() && (780..=800).contains(&shape.triangles.len()));
    let coarse = agreement(&splats, mesh);
    let (shape, mesh) = made(&MeshConfig { triangles: Some(800), texture: Some(512), ..plain });
    let texture = shape.texture.unwrap();
    assert!(texture.image.width() == 512 && texture.image.height() <= 512);
    assert!(texture.uvs.iter().all(|uv| uv.min_element() >= 0.0 && uv.max_element() <= 1.0));
    let textured = agreement(&splats, mesh.clone());
    println!("{fine:.2} {coarse:.2} {textured:.2}");
    assert!(fine > 28.0 && textured > 28.0 && textured > coarse + 1.0, "{fine:.2} {coarse:.2} {textured:.2}");
    // Charts the other way about would show.
    let mut mirrored = mesh;
    mirrored.uvs.iter_mut().for_each(|uv| uv.x = 1.0 - uv.x);
    assert!(agreement(&splats, mirrored) < textured - 8.0);
}

#[test]
fn only_glb_holds_a_texture_and_few_texels_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let config = MeshConfig { voxels: 32, views: 20, pixels: 128, triangles: Some(500), ..MeshConfig::default() };
    let shape = mesh_of(&egg(), &MeshConfig { texture: Some(128), ..config }).unwrap();
    for name in ["m.ply", "m.obj"] {
        let error = save(&shape, &folder.path().join(name), y_up()).unwrap_err().to_string();
        assert!(error.contains(&format!("{name}: a texture: expected .glb, found .{}", &name[2..])), "{error}");
    }
    // The same Gaussians give the same texture.
    assert_eq!(shape, mesh_of(&egg(), &MeshConfig { texture: Some(128), ..config }).unwrap());
}
