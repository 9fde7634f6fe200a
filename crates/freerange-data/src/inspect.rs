//! Looking at a folder of shards or any other source of objects.

use std::collections::BTreeMap;

use freerange_core::{Invalid, hex};
use freerange_splat::{Cloud, Normalization, channel};
use image::{Rgb, RgbImage, RgbaImage};
use rayon::prelude::*;
use sha2::{Digest, Sha256};

use crate::items::{Input, count};
use crate::manifest::{Failure, Manifest};
use crate::quality::{over_white, render_over_white};
use crate::shards::{check_size, read_object};
use crate::store::Store;
use crate::{DataError, Object};

/// What [`inspect`] finds in a folder.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Report {
    /// Whether every object that was asked for has been dealt with.
    pub complete: bool,
    /// What the objects are made of.
    pub input: Input,
    /// Objects in the shards.
    pub objects: u64,
    /// Of these, names of those that are flagged as bad fits.
    pub flagged: Vec<String>,
    /// Objects that could not be made.
    pub failures: Vec<Failure>,
    /// Shards.
    pub shards: u64,
    /// Bytes of all shards.
    pub bytes: u64,
    /// Depths of the slices.
    pub depths: Vec<u32>,
    /// Objects per part of the data.
    pub splits: BTreeMap<String, u64>,
    /// Objects per licence.
    pub licences: BTreeMap<String, u64>,
    /// Least, median and largest PSNR in dB of the Gaussians before the tree; `None` where not measured.
    pub psnr: Option<[f64; 3]>,
    /// Number of views of the first object; `None` without objects.
    pub views: Option<usize>,
    /// Width and height of the first object's views, in pixels; `None` without objects.
    pub image_size: Option<[u32; 2]>,
    /// Whether the first object has sets of views for evaluation; `None` without objects.
    pub evaluation: Option<bool>,
    /// SHA-256 of what the folder is made with.
    pub plan_sha256: String,
    /// By depth, mean and standard deviation of each channel over the objects for training.
    pub statistics: BTreeMap<u32, Normalization>,
    /// Names of the channels.
    pub channels: [&'static str; channel::COUNT],
    /// Whether contents were checked: every shard's checksum, and that every object can be read.
    pub verified: bool,
}

/// Looks at what [`build`](crate::build) made, also while it is unfinished. With `verify`, reads all of it.
///
/// # Errors
/// [`DataError::File`] where something is not what the manifest says; [`DataError::Sample`] for broken objects;
/// [`DataError::Io`].
pub fn inspect(store: &Store, verify: bool) -> Result<Report, DataError> {
    let manifest = Manifest::load(store)?;
    let depths = &manifest.plan.config.depths;
    for shard in &manifest.shards {
        check_size(store, &shard.name(), shard.bytes)?;
    }
    if verify {
        manifest.shards.iter().try_for_each(|shard| {
            let name = shard.name();
            let mut hash = Sha256::new();
            store.pieces(&name, shard.bytes, |piece| {
                hash.update(piece);
                Ok(())
            })?;
            let found = hex(&hash.finalize());
            if found != shard.sha256 {
                let problem = format!("expected SHA-256 {} as in the manifest, found {found}", shard.sha256);
                return Err(DataError::File { path: store.path(&name), problem });
            }
            shard.objects.par_iter().try_for_each(|object| {
                let entries = read_object(store, &name, object)?;
                entries.metadata()?;
                entries.leaves()?;
                entries.object(depths).map(|_| ())
            })
        })?;
    }
    let first = manifest.shards.iter().find_map(|s| Some((s.name(), s.objects.first()?)));
    let first = first.map(|(name, object)| read_object(store, &name, object)).transpose()?;
    let object = first.as_ref().map(|f| f.object(&[])).transpose()?;
    let metadata = first.as_ref().map(|f| f.metadata()).transpose()?;
    let mut statistics = BTreeMap::new();
    for &depth in depths {
        if let Some(s) = manifest.statistics(depth).filter(|s| s.count() > 0) {
            statistics.insert(depth, s.normalization()?);
        }
    }
    let mut psnr: Vec<f64> = manifest.objects().filter_map(|o| o.psnr).collect();
    psnr.sort_unstable_by(f64::total_cmp);
    let at = |i: usize| psnr.get(i).copied();
    Ok(Report {
        complete: manifest.is_complete(),
        input: manifest.plan.input.clone(),
        objects: manifest.objects().count() as u64,
        flagged: manifest.objects().filter(|o| o.flagged).map(|o| o.id.clone()).collect(),
        failures: manifest.shards.iter().flat_map(|s| s.failures.iter().cloned()).collect(),
        shards: manifest.shards.len() as u64,
        bytes: manifest.bytes(),
        depths: depths.clone(),
        splits: count(manifest.objects().map(|o| format!("{:?}", o.split).to_lowercase())),
        licences: count(manifest.objects().map(|o| o.licence.clone())),
        psnr: at(0).zip(at(psnr.len() / 2)).zip(psnr.last()).map(|((a, b), &c)| [a, b, c]),
        views: object.as_ref().map(|o| o.views.len()),
        image_size: object.and_then(|o| o.views.first().map(|v| [v.camera.width, v.camera.height])),
        evaluation: metadata.map(|m| m.evaluation.is_some()),
        plan_sha256: manifest.plan_sha256.clone(),
        statistics,
        channels: channel::NAMES,
        verified: verify,
    })
}

/// Gap between pictures on a contact sheet, in pixels.
const GAP: u32 = 2;
/// Largest side of a contact sheet, in pixels.
const MAX_SHEET: u64 = 16384;

/// Objects on one white sheet, `columns` of them side by side. Each is a row of pictures in front of white: two views,
/// then, as seen from the first view, the coarsest, the middle and the finest slice, then, where they are given, the
/// Gaussians before the tree.
///
/// # Errors
/// [`DataError::Config`] for a sheet of no or too many pixels; the errors of `objects`.
pub fn contact_sheet(
    objects: impl ExactSizeIterator<Item = Result<(Object, Option<Cloud>), DataError>>,
    columns: u64,
) -> Result<RgbaImage, DataError> {
    let count = objects.len() as u64;
    let refused = |found: String| {
        DataError::from(Invalid::new(
            "contact sheet",
            format!("at least one object and column, and at most {MAX_SHEET} pixels either way"),
            found,
        ))
    };
    if count == 0 || columns == 0 {
        return Err(refused(format!("{count} objects in {columns} columns")));
    }
    let columns = columns.min(count);
    let mut sheet = RgbaImage::default();
    let mut cell = [0; 2];
    let mut per_object = 0;
    // One object after the other, so that memory does not grow with their number.
    for (i, object) in (0..).zip(objects) {
        let (object, leaves) = object?;
        let pictures = pictures(&object, leaves.as_ref())?;
        if i == 0 {
            let (w, h) = pictures[0].dimensions();
            per_object = pictures.len();
            cell = [per_object as u64 * u64::from(w + GAP) + u64::from(GAP), u64::from(h + GAP)];
            let [width, height] = [columns.saturating_mul(cell[0]), count.div_ceil(columns).saturating_mul(cell[1])];
            if width > MAX_SHEET || height > MAX_SHEET {
                return Err(refused(format!("{width} x {height} pixels")));
            }
            sheet = RgbaImage::from_pixel(width as u32, height as u32, image::Rgba([255; 4]));
        }
        let (x, y) = (i % columns * cell[0], i / columns * cell[1]);
        for (k, picture) in pictures.into_iter().take(per_object).enumerate() {
            let x = x + k as u64 * u64::from(picture.width() + GAP);
            let picture = image::DynamicImage::ImageRgb8(picture).into_rgba8();
            image::imageops::replace(&mut sheet, &picture, x as i64, y as i64);
        }
    }
    Ok(sheet)
}

/// The pictures of an object on a contact sheet, at least one.
fn pictures(object: &Object, leaves: Option<&Cloud>) -> Result<Vec<RgbImage>, DataError> {
    let depths: Vec<u32> = object.slices.keys().copied().collect();
    let no = |what: &str| {
        DataError::from(Invalid::new(
            format!("object {}", object.id),
            "at least one view and one slice",
            format!("no {what}"),
        ))
    };
    let camera = object.views.first().ok_or_else(|| no("view"))?.camera;
    let (coarse, fine) = depths.first().zip(depths.last()).ok_or_else(|| no("slice"))?;
    let [w, h] = [camera.width, camera.height];
    // Objects of one source have as many pictures each, also where two of these are the same.
    let second = object.views.len().div_ceil(2).min(object.views.len() - 1);
    let mut pictures = vec![
        picture(&over_white(&object.views[0].image), w, h),
        picture(&over_white(&object.views[second].image), w, h),
    ];
    for &depth in [coarse, &depths[depths.len() / 2], fine] {
        pictures.push(picture(&render_over_white(object.slice(depth)?, &camera)?, w, h));
    }
    if let Some(leaves) = leaves {
        pictures.push(picture(&render_over_white(leaves, &camera)?, w, h));
    }
    Ok(pictures)
}

/// An image from values 0..1, `[h, w, 3]`.
fn picture(values: &[f32], width: u32, height: u32) -> RgbImage {
    let pixels = values.as_chunks::<3>().0;
    RgbImage::from_fn(width, height, |x, y| Rgb(pixels[(y * width + x) as usize].map(|v| (v * 255.0).round() as u8)))
}
