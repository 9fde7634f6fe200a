//! Looking at a folder of shards.

use std::collections::BTreeMap;

use freerange_gaussians::{Normalization, channel};
use freerange_util::hex;
use rayon::prelude::*;
use sha2::{Digest, Sha256};

use crate::DataError;
use crate::manifest::{Failure, Input, Manifest};
use crate::shards::{check_size, read_object};
use crate::store::Store;

/// What [`inspect`] finds in a folder.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Inspection {
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
    /// Objects per license.
    pub licenses: BTreeMap<String, u64>,
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

/// Looks at what `freerange data build` made, also while it is unfinished. With `verify`, reads all of it.
///
/// # Errors
/// [`DataError::File`] where something is not what the manifest says; [`DataError::Sample`] for broken objects;
/// [`DataError::Io`].
pub fn inspect(store: &Store, verify: bool) -> Result<Inspection, DataError> {
    let manifest = Manifest::load(store)?;
    let depths = manifest.plan.config.depths();
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
    Ok(Inspection {
        complete: manifest.is_complete(),
        input: manifest.plan.input.clone(),
        objects: manifest.objects().count() as u64,
        flagged: manifest.objects().filter(|o| o.flagged).map(|o| o.id.clone()).collect(),
        failures: manifest.shards.iter().flat_map(|s| s.failures.iter().cloned()).collect(),
        shards: manifest.shards.len() as u64,
        bytes: manifest.bytes(),
        depths: depths.to_vec(),
        splits: count(manifest.objects().map(|o| format!("{:?}", o.split).to_lowercase())),
        licenses: count(manifest.objects().map(|o| o.license.clone())),
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

/// Counts per license, for reports.
pub(crate) fn count(values: impl Iterator<Item = String>) -> BTreeMap<String, u64> {
    let mut counts = BTreeMap::new();
    values.for_each(|v| *counts.entry(v).or_default() += 1);
    counts
}
