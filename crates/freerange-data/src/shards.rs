//! A folder of shards as a source of training objects.

use std::path::Path;

use rand::{SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use crate::manifest::Manifest;
use crate::shard::ShardReader;
use crate::{DataError, Metadata, Object, ObjectSource};

/// The objects of a folder in a shuffled order, over and over.
pub struct Shards {
    shards: Vec<ShardReader>,
    order: Vec<(u32, u32)>, // (shard, object in it)
    depths: Vec<u32>,
    manifest: Manifest,
}

impl std::fmt::Debug for Shards {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shards").field("objects", &self.len()).field("depths", &self.depths).finish_non_exhaustive()
    }
}

impl Shards {
    /// Opens a folder made by [`generate_shards`](crate::generate_shards). Objects will have slices at `depths`.
    ///
    /// # Errors
    /// [`DataError::File`] where the folder lacks a depth, is unfinished or empty, or where a shard is not the one of
    /// the manifest; [`DataError::Sample`] where a shard is broken; [`DataError::Io`].
    pub fn open(folder: &Path, depths: &[u32]) -> Result<Self, DataError> {
        let manifest = Manifest::load(folder)?;
        let problem = |problem: String| DataError::File { path: folder.into(), problem };
        if let Some(depth) = depths.iter().find(|d| !manifest.config.depths.contains(d)) {
            let found = &manifest.config.depths;
            return Err(problem(format!("expected Gaussians at depth {depth}, found depths {found:?}")));
        }
        if !manifest.is_complete() {
            let (found, expected) = (manifest.shards.len(), manifest.config.shard_count());
            return Err(problem(format!("expected {expected} shards, found {found}: let their making finish first")));
        }
        if manifest.samples() == 0 {
            return Err(problem("expected objects, found none".into()));
        }
        let shards = open_all(&manifest, folder)?;
        let mut order: Vec<(u32, u32)> = shards
            .iter()
            .enumerate()
            .flat_map(|(s, shard)| (0..shard.len()).map(move |i| (s as u32, i as u32)))
            .collect();
        order.shuffle(&mut ChaCha8Rng::seed_from_u64(manifest.config.seed));
        Ok(Self { shards, order, depths: depths.to_vec(), manifest })
    }

    /// Number of different objects.
    pub fn len(&self) -> usize {
        self.order.len()
    }

    /// Whether there is no object; never so for an opened folder.
    pub fn is_empty(&self) -> bool {
        self.order.is_empty()
    }

    /// What the folder says of itself.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// What is known of object number `index` besides its views and Gaussians.
    ///
    /// # Errors
    /// As [`object`](ObjectSource::object).
    pub fn metadata(&self, index: u64) -> Result<Metadata, DataError> {
        let (shard, i) = self.locate(index);
        shard.metadata(i)
    }

    fn locate(&self, index: u64) -> (&ShardReader, usize) {
        let (shard, i) = self.order[(index % self.order.len() as u64) as usize];
        (&self.shards[shard as usize], i as usize)
    }
}

impl ObjectSource for Shards {
    fn object(&self, index: u64) -> Result<Object, DataError> {
        let (shard, i) = self.locate(index);
        shard.read(i, &self.depths)
    }
}

/// Opens the finished shards of `folder` and compares them with the manifest; not their checksums.
pub(crate) fn open_all(manifest: &Manifest, folder: &Path) -> Result<Vec<ShardReader>, DataError> {
    manifest
        .shards
        .par_iter()
        .map(|record| {
            let path = folder.join(&record.name);
            let problem = |problem: String| DataError::File { path: path.clone(), problem };
            let bytes = std::fs::metadata(&path).map_err(crate::file::io_error(&path))?.len();
            if bytes != record.bytes {
                return Err(problem(format!("expected {} bytes as in the manifest, found {bytes}", record.bytes)));
            }
            let shard = ShardReader::open(&path)?;
            if shard.len() as u64 != record.samples {
                let (expected, found) = (record.samples, shard.len());
                return Err(problem(format!("expected {expected} objects as in the manifest, found {found}")));
            }
            Ok(shard)
        })
        .collect()
}
