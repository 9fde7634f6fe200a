//! Making a folder of shards on all cores, in a way that can be interrupted at any time and taken up again.

use std::collections::BTreeMap;
use std::fs::File;
use std::ops::Range;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

use freerange_splat::Statistics;
use rayon::prelude::*;

use crate::file::{PARTIAL, io_error};
use crate::manifest::{Failure, Manifest, ShardRecord, shard_name};
use crate::quality::slice_psnr;
use crate::sample::{self, MAX_DEPTH, Metadata};
use crate::shard::ShardWriter;
use crate::validate::check;
use crate::{DataError, GaussianSource, Object, ObjectConfig};

/// A folder of objects.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GenerateConfig {
    /// Objects to make.
    pub objects: u64,
    /// Objects per shard; the last one may have fewer.
    pub objects_per_shard: u64,
    /// Seed of object 0; that of object `i` is `seed + i`.
    pub seed: u64,
    /// Depths of the slices to keep, ascending.
    pub depths: Vec<u32>,
    /// Views of every object, the last ones, against which the slices are measured; the PSNR goes into the object's
    /// metadata. Only for unpolished `surface` Gaussians: for them every view is held out. 0 measures nothing.
    pub quality_views: usize,
    /// Licence of the objects, as an SPDX identifier.
    pub licence: String,
    /// How an object is made.
    pub object: ObjectConfig,
}

impl Default for GenerateConfig {
    fn default() -> Self {
        Self {
            objects: 1024,
            objects_per_shard: 128,
            seed: 0,
            depths: vec![8, 9, 10, 11, 12],
            quality_views: 0,
            licence: "CC0-1.0".into(),
            object: ObjectConfig::default(),
        }
    }
}

impl GenerateConfig {
    /// Checks every field.
    ///
    /// # Errors
    /// As [`ObjectConfig::validate`].
    pub fn validate(&self) -> Result<(), DataError> {
        let count = 1..=1u64 << 32;
        check(count.contains(&self.objects), "objects", "1 to 2^32", self.objects)?;
        let per = self.objects_per_shard;
        check((1..=1 << 20).contains(&per), "objects_per_shard", "1 to 2^20", per)?;
        let ascending = self.depths.is_sorted_by(|a, b| a < b) && self.depths.iter().all(|d| *d <= MAX_DEPTH);
        let expected = format!("one or more ascending depths up to {MAX_DEPTH}");
        check(ascending && !self.depths.is_empty(), "depths", &expected, &self.depths)?;
        self.object.validate()?;
        let views = self.object.views;
        let measured = self.quality_views;
        check(measured <= views, "quality_views", &format!("at most the {views} views"), measured)?;
        let unseen = self.object.gaussians == GaussianSource::Surface && self.object.polish == 0;
        check(measured == 0 || unseen, "quality_views", "0 where Gaussians are fitted to all views", measured)
    }

    /// Number of shards.
    pub fn shard_count(&self) -> u64 {
        self.objects.div_ceil(self.objects_per_shard)
    }

    /// Numbers of the objects of a shard.
    pub fn shard_objects(&self, shard: u64) -> Range<u64> {
        let first = shard * self.objects_per_shard;
        first..(first + self.objects_per_shard).min(self.objects)
    }
}

/// What [`generate_shards`] has done.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Summary {
    /// Objects made now.
    pub made: u64,
    /// Objects that were there already.
    pub skipped: u64,
    /// Objects that could not be made, now or earlier.
    pub failures: Vec<Failure>,
    /// Shards in the folder.
    pub shards: u64,
    /// Their bytes.
    pub bytes: u64,
}

/// Makes the shards of `folder` that are not there yet. `progress` hears of objects done and of all objects, from
/// several threads.
///
/// Resumable: a killed call leaves whole shards, and at most files called `*.partial`, which the next call removes.
/// The bytes of the folder do not depend on interruptions or on the number of threads. At most a few objects per
/// thread are in memory at once.
///
/// # Errors
/// As [`GenerateConfig::validate`]; [`DataError::File`] where the folder holds objects of another configuration, or another
/// process writes to it; [`DataError::Io`]. Single objects that cannot be made are recorded in the manifest; only if
/// none of the first shard can be made, the first one's error is returned.
pub fn generate_shards(
    config: &GenerateConfig,
    folder: &Path,
    progress: impl Fn(u64, u64) + Sync,
) -> Result<Summary, DataError> {
    generate_with(config, folder, progress, |seed| Object::generate(seed, &config.object, &config.depths))
}

/// As [`generate_shards`], with `make` to make the object of a seed.
pub(crate) fn generate_with(
    config: &GenerateConfig,
    folder: &Path,
    progress: impl Fn(u64, u64) + Sync,
    make: impl Fn(u64) -> Result<Object, DataError> + Sync,
) -> Result<Summary, DataError> {
    config.validate()?;
    std::fs::create_dir_all(folder).map_err(io_error(folder))?;
    let _lock = lock(folder)?;
    let mut manifest = open_manifest(config, folder)?;
    remove_partial_files(folder)?;

    let mut finished: BTreeMap<u64, ShardRecord> = manifest.shards.drain(..).map(|s| (s.index, s)).collect();
    finished.retain(|_, s| std::fs::metadata(folder.join(&s.name)).is_ok_and(|m| m.is_file() && m.len() == s.bytes));
    let skipped = finished.values().map(|s| s.samples + s.failures.len() as u64).sum();
    let done = AtomicU64::new(skipped);
    progress(skipped, config.objects);
    let mut made = 0;
    for index in 0..config.shard_count() {
        if finished.contains_key(&index) {
            continue;
        }
        let record = write_shard(config, &manifest.config_sha256, folder, index, &make, &|| {
            progress(1 + done.fetch_add(1, Ordering::Relaxed), config.objects);
        })?;
        made += record.samples;
        finished.insert(index, record);
        manifest.shards = finished.values().cloned().collect();
        manifest.save(folder)?;
    }
    // Also where nothing was left to do: records of shards that have since vanished must not stay.
    manifest.shards = finished.into_values().collect();
    manifest.save(folder)?;
    let failures = manifest.shards.iter().flat_map(|s| s.failures.iter().cloned()).collect();
    Ok(Summary { made, skipped, failures, shards: manifest.shards.len() as u64, bytes: manifest.bytes() })
}

/// Two processes in one folder would rename each other's files away. The lock goes with the process.
fn lock(folder: &Path) -> Result<File, DataError> {
    let path = folder.join(".lock");
    let file = File::create(&path).map_err(io_error(&path))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(std::fs::TryLockError::WouldBlock) => Err(DataError::File {
            path: folder.into(),
            problem: "another process is making objects in this folder".into(),
        }),
        Err(std::fs::TryLockError::Error(source)) => Err(DataError::Io { path, source }),
    }
}

fn open_manifest(config: &GenerateConfig, folder: &Path) -> Result<Manifest, DataError> {
    let fresh = Manifest::new(config)?;
    let path = Manifest::path(folder);
    if !path.exists() {
        return Ok(fresh);
    }
    let old = Manifest::load(folder)?;
    if old.config_sha256 != fresh.config_sha256 {
        let (found, expected) = (&old.config_sha256, &fresh.config_sha256);
        let problem = format!(
            "the folder holds objects of another configuration (expected {expected}, found {found}): choose another folder"
        );
        return Err(DataError::File { path, problem });
    }
    Ok(old)
}

/// Removes what a killed run left; nothing else in the folder is touched.
fn remove_partial_files(folder: &Path) -> Result<(), DataError> {
    for entry in std::fs::read_dir(folder).map_err(io_error(folder))? {
        let path = entry.map_err(io_error(folder))?.path();
        let name = path.file_name().and_then(|n| n.to_str()).and_then(|n| n.strip_suffix(PARTIAL));
        if name.is_some_and(|n| n == "manifest.json" || n.starts_with("shard-") && n.ends_with(".tar")) {
            std::fs::remove_file(&path).map_err(io_error(&path))?;
        }
    }
    Ok(())
}

/// An object's entries and statistics by depth, or why it could not be made.
type Made = Result<(String, Vec<(String, Vec<u8>)>, BTreeMap<u32, Statistics>), DataError>;

fn write_shard(
    config: &GenerateConfig,
    config_sha256: &str,
    folder: &Path,
    index: u64,
    make: &(impl Fn(u64) -> Result<Object, DataError> + Sync),
    tick: &(impl Fn() + Sync),
) -> Result<ShardRecord, DataError> {
    let name = shard_name(index);
    let path = folder.join(&name);
    let encoded = |seed: u64| -> Made {
        let object = make(seed)?;
        let views = &object.views[object.views.len().saturating_sub(config.quality_views)..];
        let psnr = if views.is_empty() { BTreeMap::new() } else { slice_psnr(&object.slices, views)? };
        let metadata = Metadata {
            id: object.id.clone(),
            source: "generated".into(),
            licence: config.licence.clone(),
            seed,
            config_sha256: config_sha256.into(),
            psnr,
        };
        let mut statistics = BTreeMap::new();
        for &depth in &config.depths {
            let mut of_depth = Statistics::default();
            of_depth.add(object.slice(depth)?)?;
            statistics.insert(depth, of_depth);
        }
        Ok((object.id.clone(), sample::encode(&object, &metadata, &path)?, statistics))
    };

    let mut writer = ShardWriter::create(&path)?;
    let mut statistics: BTreeMap<u32, Statistics> = config.depths.iter().map(|&d| (d, Statistics::default())).collect();
    let (mut samples, mut failures, mut first_error) = (0, Vec::new(), None);
    let objects: Vec<u64> = config.shard_objects(index).collect();
    // A few objects per thread at a time bound the memory; they are written in order, so that bytes do not depend on
    // which thread is faster.
    for batch in objects.chunks(4 * rayon::current_num_threads()) {
        let made: Vec<(u64, Made)> = batch
            .par_iter()
            .with_max_len(1)
            .map(|&object| {
                let made = encoded(config.seed.wrapping_add(object));
                tick();
                (object, made)
            })
            .collect();
        for (object, made) in made {
            match made {
                Ok((id, entries, of_object)) => {
                    writer.add_encoded(&id, &entries)?;
                    statistics.iter_mut().zip(of_object.values()).for_each(|((_, all), one)| all.merge(one));
                    samples += 1;
                }
                Err(e) => {
                    let (seed, reason) = (config.seed.wrapping_add(object), e.to_string());
                    tracing::warn!("object {object} (seed {seed}) could not be made: {reason}");
                    failures.push(Failure { object, seed, reason });
                    first_error.get_or_insert(e);
                }
            }
        }
    }
    // Then it is not the object but the configuration or the machine, and the rest would fail, too.
    if let (0, 0, Some(error)) = (index, samples, first_error) {
        return Err(error);
    }
    let (bytes, sha256) = writer.finish()?;
    Ok(ShardRecord { index, name, samples, bytes, sha256, statistics, failures })
}
