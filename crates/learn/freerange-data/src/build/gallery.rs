//! Contact sheets of generated objects.

use freerange_scene::camera::Camera;
use glam::DVec3;
use image::{Rgb, RgbImage};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use freerange_assets::generate::{GeneratorConfig, generate};
use freerange_assets::mesh::MeshError;
use freerange_assets::render::{LightingConfig, Scene, render};
use freerange_util::{Invalid, check};

/// What a contact sheet shows.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GalleryConfig {
    /// Objects, one tile each, with consecutive seeds.
    pub objects: u32,
    /// Tiles per row.
    pub columns: u32,
    /// Width and height of a tile in pixels.
    pub tile: u32,
    /// Seed of the first object.
    pub first_seed: u64,
    /// Samples per pixel and axis.
    pub samples: u32,
    /// What is generated.
    pub generator: GeneratorConfig,
    /// The light, drawn per object.
    pub lighting: LightingConfig,
}

impl Default for GalleryConfig {
    fn default() -> Self {
        Self {
            objects: 100,
            columns: 10,
            tile: 160,
            first_seed: 0,
            samples: 3,
            generator: GeneratorConfig::default(),
            lighting: LightingConfig::default(),
        }
    }
}

impl GalleryConfig {
    /// Checks every range; a sheet has at most 400 million pixels.
    pub fn validate(&self) -> Result<(), Invalid> {
        check((1..=100_000).contains(&self.objects), "objects", "1 to 100000", self.objects)?;
        check((1..=1000).contains(&self.columns), "columns", "1 to 1000", self.columns)?;
        check((8..=4096).contains(&self.tile), "tile", "8 to 4096", self.tile)?;
        check((1..=8).contains(&self.samples), "samples", "1 to 8", self.samples)?;
        let tiles = u64::from(self.columns) * u64::from(self.objects.div_ceil(self.columns));
        let pixels = tiles * u64::from(self.tile).pow(2);
        check(pixels <= 400_000_000, "objects * tile^2", "at most 400 million pixels", pixels)?;
        self.generator.validate()?;
        self.lighting.validate()
    }
}

/// Renders a sheet of objects on white, each seen slightly from above and filling its tile. Runs on all threads of
/// the current Rayon pool; the result does not depend on their number.
pub fn gallery(config: &GalleryConfig) -> Result<RgbImage, MeshError> {
    config.validate()?;
    let tiles: Vec<RgbImage> =
        (0..config.objects).into_par_iter().map(|i| tile(config, i)).collect::<Result<_, _>>()?;
    let rows = config.objects.div_ceil(config.columns);
    let mut sheet = RgbImage::from_pixel(config.columns * config.tile, rows * config.tile, Rgb([255; 3]));
    for (i, tile) in (0..).zip(&tiles) {
        let (x, y) = (i % config.columns * config.tile, i / config.columns * config.tile);
        image::imageops::replace(&mut sheet, tile, i64::from(x), i64::from(y));
    }
    Ok(sheet)
}

fn tile(config: &GalleryConfig, index: u32) -> Result<RgbImage, MeshError> {
    let seed = config.first_seed.wrapping_add(u64::from(index));
    let mesh = generate(seed, &config.generator)?;
    let light = config.lighting.sample(&mut ChaCha8Rng::seed_from_u64(seed));
    let scene = Scene::new(mesh, &light)?;
    // The object lies in the ball of radius 0.5; the camera sees that ball and little more.
    let eye = 2.2 * DVec3::new(0.35, -0.82, 0.46).normalize();
    let fov = 2.0 * (0.5f64 / 2.2).asin() * 0.98;
    let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, fov, config.tile, config.tile);
    let view = render(&scene, &camera, config.samples);
    Ok(RgbImage::from_fn(config.tile, config.tile, |x, y| {
        let p = view.get_pixel(x, y);
        let alpha = f32::from(p[3]) / 255.0;
        Rgb([0, 1, 2].map(|k| (255.0 + (f32::from(p[k]) - 255.0) * alpha) as u8))
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_and_unknown_fields_are_refused() {
        assert!(GalleryConfig::default().validate().is_ok());
        assert!(serde_json::from_str::<GalleryConfig>(r#"{"rows": 1}"#).is_err());
    }

    #[test]
    fn a_gallery_has_one_object_per_tile() {
        let config = GalleryConfig { objects: 7, columns: 3, tile: 40, samples: 2, ..GalleryConfig::default() };
        let sheet = gallery(&config).unwrap();
        assert_eq!(sheet.dimensions(), (120, 120));
        let inked = |column: u32, row: u32| {
            let pixels = (0..1600).map(|i| sheet.get_pixel(40 * column + i % 40, 40 * row + i / 40).0);
            pixels.filter(|p| *p != [255; 3]).count()
        };
        for i in 0..9 {
            let n = inked(i % 3, i / 3);
            assert!(if i < 7 { n > 20 } else { n == 0 }, "tile {i}: {n} pixels");
        }
        // A later start shows the same objects further to the left.
        let later = gallery(&GalleryConfig { objects: 1, columns: 1, first_seed: 4, ..config.clone() }).unwrap();
        let tile = image::imageops::crop_imm(&sheet, 40, 40, 40, 40).to_image();
        assert_eq!(later, tile);
        for wrong in [
            GalleryConfig { objects: 0, ..config.clone() },
            GalleryConfig { columns: 0, ..config.clone() },
            GalleryConfig { tile: 5000, ..config.clone() },
            GalleryConfig { objects: 100_000, tile: 1000, ..config.clone() },
        ] {
            assert!(gallery(&wrong).is_err(), "{wrong:?}");
        }
    }
}
