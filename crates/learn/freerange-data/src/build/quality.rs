//! How well Gaussians show an object, before and after the tree.

use std::time::Instant;

use freerange_gaussians::{Gaussians, LodTree};
use freerange_optim::{FitConfig, psnr_over_white};
use freerange_util::check;

use crate::build::fitted::{fitted_gaussians, optimized};
use crate::build::item_object::{mesh_of, seed_of};
use crate::build::items::Item;
use crate::build::photographed::{Photographed, Seconds, add_elapsed};
use crate::build::{BuildConfig, BuildError, ObjectConfig, SurfaceConfig, surface_gaussians};

/// How well Gaussians show an object: PSNR in dB over held-out views, over white.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Quality {
    /// The object.
    pub id: String,
    /// Triangles of its mesh.
    pub triangles: usize,
    /// Number of Gaussians of the fit that the tree is made of.
    pub gaussians: usize,
    /// PSNR of that fit.
    pub full: f64,
    /// Seconds of that fit.
    pub full_seconds: f64,
    /// The same for fewer Gaussians.
    pub by_count: Vec<CountQuality>,
}

/// How well a number of Gaussians shows an object. PSNR in dB.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct CountQuality {
    /// The number.
    pub gaussians: usize,
    /// A fit of so many.
    pub fit: f64,
    /// Seconds of that fit.
    pub fit_seconds: f64,
    /// The tree's slice of the full fit.
    pub slice: f64,
    /// That slice after some gradient steps; `None` where none were asked for.
    pub optimized: Option<f64>,
    /// The slice of a tree over points on the surface, as many as the full fit has Gaussians.
    pub surface: f64,
}

/// Fits an object with the configured number of Gaussians and with each of `counts`, and compares fits with slices.
///
/// # Errors
/// [`BuildError::Config`] for counts that are no powers of two or exceed the full fit's; what making an object may say.
pub fn measure_quality(item: &Item, config: &BuildConfig, counts: &[usize]) -> Result<Quality, BuildError> {
    config.validate()?;
    let most = config.object.fit.cap_max;
    let fine = |n: &usize| n.is_power_of_two() && *n <= most;
    check(counts.iter().all(fine), "counts", &format!("powers of two up to fit.cap_max = {most}"), counts)?;
    check(config.shard.held_out > 0, "held_out", "at least 1 to measure", config.shard.held_out)?;
    let (mesh, _) = mesh_of(item, config)?;
    let seed = seed_of(item, config);
    let triangles = mesh.triangles.len();
    let object = &config.object;
    let mut photographed = Photographed::new(mesh, seed, object, config.shard.held_out, &mut Seconds::default())?;

    let timed = |photographed: &mut Photographed, fit: FitConfig| -> Result<(Gaussians, f64, f64), BuildError> {
        let start = Instant::now();
        let cloud = fitted_gaussians(photographed, &ObjectConfig { fit, ..object.clone() })?;
        let mut seconds = 0.0;
        add_elapsed(&mut seconds, start);
        let db = psnr_over_white(&cloud, &photographed.held_out)?;
        Ok((cloud, db, seconds))
    };
    let (full_cloud, full, full_seconds) = timed(&mut photographed, object.fit.clone())?;
    let deepest = counts.iter().max().map_or(0, |n| n.ilog2());
    let tree = LodTree::build_to_depth(&full_cloud, deepest, object.alignment)?;
    let points = SurfaceConfig { points: full_cloud.len(), ..object.surface.clone() };
    let surface = surface_gaussians(&photographed.scene, &points, &mut photographed.rng);
    let surface = LodTree::build_to_depth(&surface, deepest, object.alignment)?;
    let by_count = counts.iter().map(|&gaussians| {
        let fit = FitConfig { cap_max: gaussians, initial: object.fit.initial.min(gaussians), ..object.fit.clone() };
        let (_, fit, fit_seconds) = timed(&mut photographed, fit)?;
        let slice = tree.slice(gaussians.ilog2())?;
        let optimized = match object.slice_iterations {
            0 => None,
            steps => Some(psnr_over_white(
                &optimized(slice.clone(), &photographed.views, steps, seed)?,
                &photographed.held_out,
            )?),
        };
        Ok(CountQuality {
            gaussians,
            fit,
            fit_seconds,
            slice: psnr_over_white(&slice, &photographed.held_out)?,
            optimized,
            surface: psnr_over_white(&surface.slice(gaussians.ilog2())?, &photographed.held_out)?,
        })
    });
    let by_count = by_count.collect::<Result<_, BuildError>>()?;
    Ok(Quality { id: item.id.clone(), triangles, gaussians: full_cloud.len(), full, full_seconds, by_count })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::build::Items;
    use crate::build::tests::{tiny_config, write_ball};

    #[test]
    fn more_gaussians_are_better_and_all_ways_are_measured() {
        let mut config = BuildConfig { object: tiny_config(), ..BuildConfig::default() };
        config.object.cameras.resolution = 64;
        config.object.views = 12;
        config.object.fit.iterations = 100;
        config.object.fit.initial = 1024;
        config.object.fit.cap_max = 1024;
        config.object.slice_iterations = 20;
        let folder = tempfile::tempdir().unwrap();
        write_ball(&folder.path().join("ball.ply"));
        let item = Items::find(folder.path(), "", "CC0-1.0").unwrap().get(0).unwrap();
        let q = measure_quality(&item, &config, &[16, 512]).unwrap();
        assert_eq!((q.id.as_str(), q.gaussians, q.by_count.len()), ("ball", 1024, 2));
        let [few, many] = [&q.by_count[0], &q.by_count[1]];
        assert!(many.fit > few.fit + 1.0 && many.slice > few.slice + 1.0 && many.surface > few.surface + 1.0, "{q:?}");
        assert!(q.full > few.fit + 1.0 && few.optimized.unwrap() > few.slice, "{q:?}");
        assert!(q.full_seconds > 0.0 && many.fit_seconds > 0.0 && q.triangles > 0);
        for bad in [&[3usize][..], &[2048]] {
            assert!(measure_quality(&item, &config, bad).unwrap_err().to_string().contains("powers of two"));
        }
        config.shard.held_out = 0;
        assert!(measure_quality(&item, &config, &[16]).unwrap_err().to_string().contains("held_out"));
    }
}
