//! Tests of whole folders and of hostile files, on objects small enough to make hundreds of them.

mod folder;
mod hostile;

use std::collections::BTreeMap;
use std::path::Path;

use freerange_camera::{Camera, View};
use freerange_mesh::{CameraConfig, LightingConfig};
use freerange_splat::{Cloud, channel};
use glam::DVec3;
use image::RgbaImage;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{DataError, GenerateConfig, Metadata, Object, ObjectConfig};

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

/// A folder of objects that [`toy`] makes: 3 shards of 4, 4 and 2.
fn toy_config() -> GenerateConfig {
    let object = tiny_config();
    GenerateConfig { objects: 10, objects_per_shard: 4, seed: 7, depths: vec![2, 3], object, ..Default::default() }
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
    let mut cloud = |n: usize| Cloud::from_rows((0..n * channel::COUNT).map(|_| rng.random_range(-1.0..1.0)).collect());
    Object { id: format!("toy-{seed:03}"), views, slices: BTreeMap::from([(2, cloud(4)), (3, cloud(8))]) }
}

fn metadata_of(object: &Object) -> Metadata {
    Metadata {
        id: object.id.clone(),
        source: "noise".into(),
        licence: "CC0-1.0".into(),
        seed: 3,
        config_sha256: "none".into(),
        psnr: BTreeMap::from([(2, 20.25), (3, 0.1 + 0.2)]),
    }
}

fn assert_same(a: &Object, b: &Object) {
    assert_eq!(a.id, b.id);
    assert_eq!(a.slices, b.slices);
    assert_eq!(a.views.len(), b.views.len());
    for (a, b) in a.views.iter().zip(&b.views) {
        assert_eq!((&a.name, &a.camera, &a.image), (&b.name, &b.camera, &b.image));
    }
}

/// Name and bytes of every file in `folder`.
fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    std::fs::read_dir(folder)
        .unwrap()
        .map(|e| e.unwrap())
        .map(|e| (e.file_name().into_string().unwrap(), std::fs::read(e.path()).unwrap()))
        .collect()
}

fn message<T>(result: Result<T, DataError>) -> String {
    match result {
        Ok(_) => panic!("expected an error"),
        Err(e) => e.to_string(),
    }
}
