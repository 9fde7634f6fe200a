//! Looking at a folder of shards or any other source of objects.

use std::collections::BTreeMap;
use std::path::Path;

use freerange_splat::{Normalization, channel};
use image::{Rgb, RgbImage, RgbaImage};
use rayon::prelude::*;

use crate::file::sha256_of_file;
use crate::manifest::{Failure, Manifest};
use crate::quality::{over_white, render_over_white};
use crate::shards::open_all;
use crate::{DataError, Object, ObjectSource};

/// What [`inspect`] finds in a folder.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Report {
    /// Whether every object that was asked for has been dealt with.
    pub complete: bool,
    /// Objects in the shards.
    pub objects: u64,
    /// Objects that could not be made.
    pub failures: Vec<Failure>,
    /// Shards.
    pub shards: u64,
    /// Bytes of all shards.
    pub bytes: u64,
    /// Depths of the slices.
    pub depths: Vec<u32>,
    /// Fewest and most views of an object; `None` without objects.
    pub views: Option<[usize; 2]>,
    /// Width and height of the first object's views, in pixels; `None` without objects.
    pub image_size: Option<[u32; 2]>,
    /// Licence of the objects, as an SPDX identifier.
    pub licence: String,
    /// SHA-256 of the configuration.
    pub config_sha256: String,
    /// By depth, mean and standard deviation of each channel.
    pub statistics: BTreeMap<u32, Normalization>,
    /// Names of the channels.
    pub channels: [&'static str; channel::COUNT],
    /// Whether contents were checked: every shard's checksum, and that every object can be read.
    pub verified: bool,
}

/// Looks at a folder of shards. With `verify`, reads all of it.
///
/// # Errors
/// As [`Shards::open`](crate::Shards::open), but folders may be unfinished; with `verify` also for contents that are
/// not those of the manifest.
pub fn inspect(folder: &Path, verify: bool) -> Result<Report, DataError> {
    let manifest = Manifest::load(folder)?;
    let shards = open_all(&manifest, folder)?;
    if verify {
        manifest.shards.par_iter().zip(&shards).try_for_each(|(record, shard)| {
            let path = folder.join(&record.name);
            let found = sha256_of_file(&path)?;
            if found != record.sha256 {
                let problem = format!("expected SHA-256 {} as in the manifest, found {found}", record.sha256);
                return Err(DataError::File { path, problem });
            }
            (0..shard.len()).into_par_iter().try_for_each(|i| {
                shard.metadata(i)?;
                shard.read(i, &manifest.config.depths).map(|_| ())
            })
        })?;
    }
    let first = shards.iter().find(|s| !s.is_empty()).map(|s| s.read(0, &[])).transpose()?;
    let views = || shards.iter().flat_map(|s| s.view_counts());
    let mut statistics = BTreeMap::new();
    for &depth in &manifest.config.depths {
        if let Some(s) = manifest.statistics(depth).filter(|s| s.count() > 0) {
            statistics.insert(depth, s.normalization()?);
        }
    }
    Ok(Report {
        complete: manifest.is_complete(),
        objects: manifest.samples(),
        failures: manifest.shards.iter().flat_map(|s| s.failures.iter().cloned()).collect(),
        shards: manifest.shards.len() as u64,
        bytes: manifest.bytes(),
        depths: manifest.config.depths.clone(),
        views: views().min().zip(views().max()).map(|(a, b)| [a, b]),
        image_size: first.and_then(|o| o.views.first().map(|v| [v.camera.width, v.camera.height])),
        licence: manifest.config.licence.clone(),
        config_sha256: manifest.config_sha256.clone(),
        statistics,
        channels: channel::NAMES,
        verified: verify,
    })
}

/// Gap between pictures on a contact sheet, in pixels.
const GAP: u32 = 2;
/// Largest side of a contact sheet, in pixels.
const MAX_SHEET: u64 = 16384;

/// The first `count` objects of `source` on one white sheet, `columns` of them side by side. Each is a row of pictures in
/// front of white: two views, then, as seen from the first view, the coarsest, the middle and the finest slice.
///
/// # Errors
/// [`DataError::Config`] for a sheet of no or too many pixels; the source's errors.
pub fn contact_sheet(source: &dyn ObjectSource, count: u64, columns: u64) -> Result<RgbaImage, DataError> {
    let refused = |found: String| DataError::Config {
        field: "contact sheet".into(),
        expected: format!("at least one object and column, and at most {MAX_SHEET} pixels either way"),
        found,
    };
    if count == 0 || columns == 0 {
        return Err(refused(format!("{count} objects in {columns} columns")));
    }
    let first = pictures(&source.object(0)?)?;
    let (w, h) = first[0].dimensions();
    let columns = columns.min(count);
    let cell = [first.len() as u64 * u64::from(w + GAP) + u64::from(GAP), u64::from(h + GAP)];
    let [width, height] = [columns.saturating_mul(cell[0]), count.div_ceil(columns).saturating_mul(cell[1])];
    if width > MAX_SHEET || height > MAX_SHEET {
        return Err(refused(format!("{width} x {height} pixels")));
    }
    let mut sheet = RgbaImage::from_pixel(width as u32, height as u32, image::Rgba([255; 4]));
    // One object after the other, so that memory does not grow with their number.
    for i in 0..count {
        let (x, y) = (i % columns * cell[0], i / columns * cell[1]);
        for (k, picture) in pictures(&source.object(i)?)?.into_iter().take(first.len()).enumerate() {
            let picture = image::DynamicImage::ImageRgb8(picture).into_rgba8();
            let x = x + k as u64 * u64::from(w + GAP);
            image::imageops::replace(&mut sheet, &picture, x as i64, y as i64);
        }
    }
    Ok(sheet)
}

/// The pictures of an object on a contact sheet, at least one.
fn pictures(object: &Object) -> Result<Vec<RgbImage>, DataError> {
    let depths: Vec<u32> = object.slices.keys().copied().collect();
    let no = |what: &str| DataError::Config {
        field: format!("object {}", object.id),
        expected: "at least one view and one slice".into(),
        found: format!("no {what}"),
    };
    let camera = object.views.first().ok_or_else(|| no("view"))?.camera;
    let (coarse, fine) = depths.first().zip(depths.last()).ok_or_else(|| no("slice"))?;
    // Objects of one source have as many pictures each, also where two of these are the same.
    let second = object.views.len().div_ceil(2).min(object.views.len() - 1);
    let mut pictures = vec![
        picture(&over_white(&object.views[0].image), camera.width, camera.height),
        picture(&over_white(&object.views[second].image), camera.width, camera.height),
    ];
    for &depth in [coarse, &depths[depths.len() / 2], fine] {
        pictures.push(picture(&render_over_white(object.slice(depth)?, &camera)?, camera.width, camera.height));
    }
    Ok(pictures)
}

/// An image from values 0..1, `[h, w, 3]`.
fn picture(values: &[f32], width: u32, height: u32) -> RgbImage {
    let pixels = values.as_chunks::<3>().0;
    RgbImage::from_fn(width, height, |x, y| Rgb(pixels[(y * width + x) as usize].map(|v| (v * 255.0).round() as u8)))
}
