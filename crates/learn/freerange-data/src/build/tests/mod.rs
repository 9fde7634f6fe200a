//! Tests of whole folders and of hostile files, on objects small enough to make hundreds of them.

mod folder;
mod hostile;
#[cfg(feature = "cloud")]
mod remote;

use std::collections::BTreeMap;
use std::path::Path;

use freerange_assets::render::{CameraConfig, LightingConfig};
use freerange_gaussians::{Gaussians, channel};
use freerange_scene::camera::{Camera, View};
use glam::DVec3;
use image::RgbaImage;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::build::folder::build_with;
use crate::build::item_object::FileFacts;
use crate::build::object::{MadeObject, generated_id};
use crate::build::{BuildConfig, BuildError, BuildOptions, Item, Items, ObjectConfig, Seconds, ShardConfig, Summary};
use crate::layout::{END, object_bytes};
use crate::{DataError, HeldOutPsnr, ImageFormat, InputFit, Metadata, Object, Shards, Split, Store};

/// Generated objects at their smallest.
pub(crate) fn tiny_config() -> ObjectConfig {
    let mut config = ObjectConfig {
        views: 3,
        samples_per_axis: 1,
        cameras: CameraConfig { resolution: 32, ..CameraConfig::default() },
        lighting: LightingConfig { rays: 4, ..LightingConfig::default() },
        ..ObjectConfig::default()
    };
    config.surface.points = 64;
    config
}

/// Objects that [`toy`] makes: 3 shards of 4, 4 and 2.
pub(crate) fn toy_config() -> BuildConfig {
    let shard = ShardConfig { objects_per_shard: 4, validation: 0.0, test: 0.0, ..ShardConfig::default() };
    BuildConfig { depths: vec![2, 3], shard, object: tiny_config(), ..BuildConfig::default() }
}

pub(crate) fn toy_items() -> Items {
    Items::generated(10, 7)
}

/// An object of noise: two views of 6 x 4 pixels, slices at depths 2 and 3.
fn toy(seed: u64) -> Object {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let views = (0..2).map(|i| {
        let eye = DVec3::new(rng.random_range(1.0..2.0), rng.random_range(-1.0..1.0), 0.3);
        let camera = Camera { cx: 2.7, ..Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.8, 6, 4) };
        View { name: format!("photo {i}"), camera, image: RgbaImage::from_fn(6, 4, |_, _| image::Rgba(rng.random())) }
    });
    let views = views.collect();
    let mut cloud =
        |n: usize| Gaussians::from_rows((0..n * channel::COUNT).map(|_| rng.random_range(-1.0..1.0)).collect());
    let slices = BTreeMap::from([(2, cloud(4)), (3, cloud(8))]);
    // Numbers that 16 bits hold.
    let mut fit =
        || Gaussians::from_rows((0..4 * channel::COUNT).map(|_| f32::from(rng.random::<i8>()) / 64.0).collect());
    let input_fits = [vec![1], vec![1, 0]].map(|views| InputFit { views, gaussians: fit(), target: fit() }).to_vec();
    Object { id: generated_id(seed), views, slices, input_fits }
}

/// A toy as a build makes it. Its fit is as bad as `psnr` says.
pub(crate) fn made(seed: u64, psnr: f64) -> (MadeObject, FileFacts) {
    let object = toy(seed);
    let leaves = object.slices[&3].clone();
    let psnr = Some(HeldOutPsnr { leaves: psnr, slices: BTreeMap::from([(2, 20.25), (3, 0.1 + 0.2)]) });
    (MadeObject { object, leaves, psnr, seconds: Seconds::default() }, FileFacts::default())
}

/// Builds toys in `folder` on one worker; `make` may fail.
fn build_toys(
    folder: &Path,
    options: &BuildOptions,
    make: impl Fn(u64) -> Result<f64, BuildError> + Sync,
) -> Result<Summary, BuildError> {
    let make = |item: &Item| {
        let seed = item.seed.unwrap();
        make(seed).map(|psnr| made(seed, psnr))
    };
    build_with(&toy_config(), &toy_items(), &Store::local(folder), options, |_| (), make)
}

fn open(folder: &Path, depths: &[u32]) -> Result<Shards, DataError> {
    Shards::open(&Store::local(folder), depths, None)
}

fn metadata_of(object: &Object) -> Metadata {
    Metadata {
        id: object.id.clone(),
        source: "noise".into(),
        license: "CC0-1.0".into(),
        file_sha256: None,
        notes: vec!["one".into()],
        seed: 3,
        plan_sha256: "none".into(),
        split: Split::Test,
        gaussians: 8,
        psnr: made(1, 30.0).0.psnr,
        flagged: false,
        input_fits: object.input_fits.iter().map(|f| f.views.clone()).collect(),
        evaluation: None,
    }
}

/// Writes a ball of 320 triangles with a band of another color as a PLY mesh.
pub(crate) fn write_ball(path: &Path) {
    let (rings, sides) = (9, 20);
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nelement face {}\n\
         property list uchar int vertex_indices\nend_header\n",
        rings * sides,
        (rings - 1) * sides
    );
    for r in 0..rings {
        for s in 0..sides {
            let (t, p) = (
                (r as f32 + 0.1) / (rings as f32 - 0.8) * std::f32::consts::PI,
                s as f32 / sides as f32 * std::f32::consts::TAU,
            );
            let color = if (3..6).contains(&r) { "200 40 30" } else { "30 90 200" };
            text += &format!("{} {} {} {color}\n", t.sin() * p.cos(), t.sin() * p.sin(), t.cos());
        }
    }
    for r in 0..rings - 1 {
        for s in 0..sides {
            let (a, b) = (r * sides + s, r * sides + (s + 1) % sides);
            text += &format!("4 {a} {} {} {b}\n", a + sides, b + sides);
        }
    }
    std::fs::write(path, text).unwrap();
}

/// A shard of toys, as a build writes it.
fn write_shard(path: &Path, seeds: std::ops::Range<u64>, format: ImageFormat) {
    let mut bytes = Vec::new();
    for seed in seeds {
        let object = toy(seed);
        let leaves = &object.slices[&3];
        bytes.extend(object_bytes(&object, Some(leaves), &metadata_of(&object), format, path).unwrap());
    }
    bytes.extend(END);
    std::fs::write(path, bytes).unwrap();
}

pub(crate) fn assert_same(a: &Object, b: &Object) {
    assert_eq!(a.id, b.id);
    assert_eq!(a.slices, b.slices);
    assert_eq!(a.views.len(), b.views.len());
    for (a, b) in a.views.iter().zip(&b.views) {
        assert_eq!((&a.name, &a.camera, &a.image), (&b.name, &b.camera, &b.image));
    }
}

/// Name and bytes of every file in `folder` and below, but for locks.
fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    walkdir::WalkDir::new(folder)
        .into_iter()
        .map(|e| e.unwrap())
        .filter(|e| e.file_type().is_file())
        .map(|e| {
            (e.path().strip_prefix(folder).unwrap().to_str().unwrap().to_owned(), std::fs::read(e.path()).unwrap())
        })
        .filter(|(name, _)| !name.starts_with(".lock"))
        .collect()
}

fn message<T>(result: Result<T, impl std::fmt::Display>) -> String {
    match result {
        Ok(_) => panic!("expected an error"),
        Err(e) => e.to_string(),
    }
}
