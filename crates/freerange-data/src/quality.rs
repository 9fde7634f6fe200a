//! How well slices show their object, and what making objects costs.

use std::collections::BTreeMap;
use std::ops::Range;
use std::time::Instant;

use freerange_camera::{Camera, View};
use freerange_mesh::{Scene, generate, orbit_cameras, render};
use freerange_metrics::psnr;
use freerange_raster::RasterConfig;
use freerange_splat::{Cloud, LodTree};
use image::RgbaImage;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::fitted::{fitted_gaussians, polished};
use crate::{DataError, GaussianSource, ObjectConfig, surface_gaussians};

/// PSNR in dB that a perfect image is given, so that means stay finite.
const BEST_PSNR: f64 = 100.0;

/// Quality and cost of one way to make Gaussians.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Quality {
    /// The way.
    pub gaussians: GaussianSource,
    /// Objects measured.
    pub objects: u64,
    /// By depth, PSNR in dB against views that the Gaussians were not made from: mean over objects.
    pub psnr: BTreeMap<u32, f64>,
    /// The same of the worst object.
    pub worst: BTreeMap<u32, f64>,
    /// Mean seconds per object.
    pub seconds: Seconds,
}

/// Seconds of one thread by stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Seconds {
    /// Mesh, ray structure, baked light.
    pub scene: f64,
    /// All views of the object.
    pub views: f64,
    /// Surface points or fit.
    pub gaussians: f64,
    /// Level-of-detail tree, slices, and their polishing.
    pub slices: f64,
}

/// Measures the ways `sources` on the objects of `seeds`, made as [`Object::generate`](crate::Object::generate) does,
/// with slices at `depths`. Every object is rendered from `held_out` further views in front of white, at the views' own
/// resolution. Objects come one after the other, so that seconds mean something; `progress` hears of each.
///
/// # Errors
/// [`DataError::Config`] if there is nothing to measure; whatever making an object can say.
pub fn measure_quality(
    config: &ObjectConfig,
    sources: &[GaussianSource],
    seeds: Range<u64>,
    depths: &[u32],
    held_out: usize,
    mut progress: impl FnMut(u64, GaussianSource),
) -> Result<Vec<Quality>, DataError> {
    if seeds.is_empty() || depths.is_empty() || held_out == 0 {
        return Err(DataError::Config {
            field: "quality".into(),
            expected: "at least one object, depth and held-out view".into(),
            found: format!("seeds {seeds:?}, depths {depths:?}, {held_out} views"),
        });
    }
    config.validate()?;
    let objects = seeds.end - seeds.start;
    sources
        .iter()
        .map(|&gaussians| {
            let config = ObjectConfig { gaussians, ..config.clone() };
            let mut seconds = Seconds::default();
            let mut psnr: BTreeMap<u32, f64> = depths.iter().map(|&d| (d, 0.0)).collect();
            let mut worst: BTreeMap<u32, f64> = depths.iter().map(|&d| (d, BEST_PSNR)).collect();
            for seed in seeds.clone() {
                let (slices, views) = slices_and_held_out_views(&config, seed, depths, held_out, &mut seconds)?;
                for (depth, db) in slice_psnr(&slices, &views)? {
                    *psnr.entry(depth).or_default() += db / objects as f64;
                    worst.entry(depth).and_modify(|w| *w = w.min(db));
                }
                progress(seed, gaussians);
            }
            for stage in [&mut seconds.scene, &mut seconds.views, &mut seconds.gaussians, &mut seconds.slices] {
                *stage /= objects as f64;
            }
            Ok(Quality { gaussians, objects, psnr, worst, seconds })
        })
        .collect()
}

/// Object `seed` stage by stage, and views of it that its Gaussians were not made from.
fn slices_and_held_out_views(
    config: &ObjectConfig,
    seed: u64,
    depths: &[u32],
    held_out: usize,
    seconds: &mut Seconds,
) -> Result<(BTreeMap<u32, Cloud>, Vec<View>), DataError> {
    // The same draws as for training, so that these are the very objects.
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(1);
    let start = Instant::now();
    let scene = Scene::new(generate(seed, &config.generator)?, &config.lighting.sample(&mut rng))?;
    lap(&mut seconds.scene, start);

    let start = Instant::now();
    let views = photograph(&scene, orbit_cameras(config.views, &mut rng, &config.cameras), config.samples_per_axis);
    lap(&mut seconds.views, start);

    let start = Instant::now();
    let leaves = match config.gaussians {
        GaussianSource::Surface => surface_gaussians(&scene, &config.surface, &mut rng),
        GaussianSource::Fit => fitted_gaussians(&scene, &views, config, &mut rng)?,
    };
    lap(&mut seconds.gaussians, start);

    let start = Instant::now();
    let tree = LodTree::build_to_depth(&leaves, depths.iter().copied().max().unwrap_or(0), config.alignment)?;
    let slice = |&depth: &u32| Ok((depth, polished(tree.slice(depth)?, &views, config.polish, seed)?));
    let slices = depths.iter().map(slice).collect::<Result<_, DataError>>()?;
    lap(&mut seconds.slices, start);

    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(2);
    let held_out = orbit_cameras(held_out, &mut rng, &config.cameras);
    Ok((slices, photograph(&scene, held_out, config.samples_per_axis)))
}

fn lap(stage: &mut f64, start: Instant) {
    *stage += start.elapsed().as_secs_f64();
}

fn photograph(scene: &Scene, cameras: Vec<Camera>, samples_per_axis: u32) -> Vec<View> {
    let view = |(i, camera)| View { name: format!("{i:03}"), image: render(scene, &camera, samples_per_axis), camera };
    cameras.into_iter().enumerate().map(view).collect()
}

/// PSNR in dB of renders of `slices` against `views`, in front of white: mean over the views.
pub(crate) fn slice_psnr(slices: &BTreeMap<u32, Cloud>, views: &[View]) -> Result<BTreeMap<u32, f64>, DataError> {
    slices
        .iter()
        .map(|(&depth, cloud)| {
            let mut sum = 0.0;
            for view in views {
                sum += psnr(&render_over_white(cloud, &view.camera)?, &over_white(&view.image))?.min(BEST_PSNR);
            }
            Ok((depth, sum / views.len() as f64))
        })
        .collect()
}

/// `cloud` in front of white, clamped to 0..1, sRGB-encoded. `[h, w, 3]`
pub(crate) fn render_over_white(cloud: &Cloud, camera: &Camera) -> Result<Vec<f32>, DataError> {
    let image = freerange_raster::render(cloud.rows(), &[*camera], &[[1.0; 3]], &RasterConfig::default())?;
    Ok(image.rgb.into_iter().map(|v| v.clamp(0.0, 1.0)).collect())
}

/// `image` in front of white, 0..1, sRGB-encoded. `[h, w, 3]`
pub(crate) fn over_white(image: &RgbaImage) -> Vec<f32> {
    let pixel = |p: &image::Rgba<u8>| {
        let [r, g, b, a] = p.0.map(|v| f32::from(v) / 255.0);
        [r, g, b].map(|c| c * a + (1.0 - a))
    };
    image.pixels().flat_map(pixel).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Object, tests::tiny_config};

    /// The stages here repeat those of `Object::generate`; this keeps the two together.
    #[test]
    fn measures_the_objects_of_training() {
        let mut config = tiny_config();
        config.surface.points = 64;
        let object = Object::generate(5, &config, &[4, 6]).unwrap();
        let (slices, views) = slices_and_held_out_views(&config, 5, &[4, 6], 3, &mut Seconds::default()).unwrap();
        assert_eq!(slices, object.slices);
        assert_eq!(views.len(), 3);
        assert!(views.iter().all(|v| object.views.iter().all(|o| o.camera != v.camera)));
    }

    #[test]
    fn finer_slices_are_better_and_both_ways_work() {
        let mut config = tiny_config();
        config.surface.points = 512;
        config.cameras.resolution = 64;
        config.fit.iterations = 20;
        config.fit.initial = 200;
        config.fit.max_gaussians = 512;
        let sources = [GaussianSource::Surface, GaussianSource::Fit];
        let mut heard = 0;
        let found = measure_quality(&config, &sources, 0..2, &[1, 8], 2, |_, _| heard += 1).unwrap();
        assert_eq!((found.len(), heard), (2, 4));
        for q in &found {
            assert!(q.psnr[&8] > q.psnr[&1] + 1.0, "{q:?}");
            assert!(q.worst[&8] <= q.psnr[&8]);
            assert!(q.seconds.scene > 0.0 && q.seconds.views > 0.0 && q.seconds.gaussians > 0.0);
        }
        assert!(measure_quality(&config, &sources, 0..0, &[2], 2, |_, _| {}).is_err());
    }

    #[test]
    fn white_shows_through_transparency() {
        let image = RgbaImage::from_pixel(1, 1, image::Rgba([255, 0, 51, 51]));
        let found = over_white(&image);
        for (found, expected) in found.iter().zip([1.0, 0.8, 0.84]) {
            assert!((found - expected).abs() < 1e-6);
        }
    }
}
