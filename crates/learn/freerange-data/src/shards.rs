//! A folder of shards as a source of training objects.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use freerange_gaussians::{Gaussians, Statistics};
use rand::{SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;

use crate::manifest::{Manifest, ObjectRecord};
use crate::shard::ObjectBytes;
use crate::store::Store;
use crate::{DataError, Metadata, Object, ObjectSource, Split};

/// The objects of one part of a folder of shards, over and over, each time in another order.
///
/// Object number `index` is a function of the seed and `index` alone, so that reading can begin at any number.
/// One read per object, of just its bytes: from a local folder as from far away.
pub struct Shards {
    store: Store,
    objects: Vec<(u32, u32)>, // (shard, object in it)
    seed: u64,
    orders: Mutex<VecDeque<(u64, Arc<[u32]>)>>, // of the last epochs that were asked for
    depths: Vec<u32>,
    manifest: Manifest,
}

impl std::fmt::Debug for Shards {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shards").field("objects", &self.len()).field("depths", &self.depths).finish_non_exhaustive()
    }
}

impl Shards {
    /// Opens what `freerange data build` made. Objects will have slices at `depths`. Flagged objects are left out.
    /// `split`: `None` takes all parts.
    ///
    /// # Errors
    /// [`DataError::File`] where the folder lacks a depth, is unfinished or empty, or where a local shard is not the one
    /// of the manifest; [`DataError::Io`].
    pub fn open(store: &Store, depths: &[u32], split: Option<Split>) -> Result<Self, DataError> {
        let manifest = Manifest::load(store)?;
        if !manifest.is_complete() {
            let (found, expected) = (manifest.shards.len(), manifest.plan.shard_count());
            let problem = format!("expected {expected} shards, found {found}: let their making finish first");
            return Err(DataError::File { path: store.path(""), problem });
        }
        Self::of(manifest, store, depths, split)
    }

    /// As [`open`](Self::open), but of a folder that is still being made, takes the shards that are finished by now. The
    /// order of the objects changes with their number.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn open_finished(store: &Store, depths: &[u32], split: Option<Split>) -> Result<Self, DataError> {
        Self::of(Manifest::load(store)?, store, depths, split)
    }

    fn of(manifest: Manifest, store: &Store, depths: &[u32], split: Option<Split>) -> Result<Self, DataError> {
        let problem = |problem: String| DataError::File { path: store.path(""), problem };
        let found = manifest.plan.config.depths();
        if let Some(depth) = depths.iter().find(|d| !found.contains(d)) {
            return Err(problem(format!("expected Gaussians at depth {depth}, found depths {found:?}")));
        }
        // Local ones only: asking for the size of thousands of remote files takes minutes.
        if store.folder().is_some() {
            for shard in &manifest.shards {
                check_size(store, &shard.name(), shard.bytes)?;
            }
        }
        let wanted = |o: &ObjectRecord| !o.flagged && split.is_none_or(|s| s == o.split);
        let mut all: Vec<(u32, u32)> = Vec::new();
        for (s, shard) in manifest.shards.iter().enumerate() {
            let objects = shard.objects.iter().enumerate().filter(|(_, o)| wanted(o));
            all.extend(objects.map(|(i, _)| (s as u32, i as u32)));
        }
        if all.is_empty() {
            let part = split.map_or("any part".into(), |s| format!("part {s:?}"));
            return Err(problem(format!("expected objects in {part} that are not flagged, found none")));
        }
        let (seed, orders) = (manifest.plan.config.seed(), Mutex::default());
        Ok(Self { store: store.clone(), objects: all, seed, orders, depths: depths.to_vec(), manifest })
    }

    /// The same objects in the orders that `seed` gives instead of those of the folder's own seed.
    pub fn shuffled_by(self, seed: u64) -> Self {
        Self { seed, orders: Mutex::default(), ..self }
    }

    /// Number of different objects.
    pub fn len(&self) -> usize {
        self.objects.len()
    }

    /// Whether there is no object; never so for an opened folder.
    pub fn is_empty(&self) -> bool {
        self.objects.is_empty()
    }

    /// What the folder says of itself.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// The name of object number `index`.
    pub fn id(&self, index: u64) -> &str {
        &self.locate(index).1.id
    }

    /// Bytes of object number `index` in its shard.
    pub fn object_size(&self, index: u64) -> u64 {
        self.locate(index).1.bytes
    }

    /// What is known of object number `index` besides its views and Gaussians.
    ///
    /// # Errors
    /// As [`object`](ObjectSource::object).
    pub fn metadata(&self, index: u64) -> Result<Metadata, DataError> {
        self.bytes(index)?.metadata()
    }

    /// The Gaussians of object number `index` before the tree, where the shards keep them.
    ///
    /// # Errors
    /// As [`object`](ObjectSource::object).
    pub fn leaves(&self, index: u64) -> Result<Option<Gaussians>, DataError> {
        self.bytes(index)?.leaves()
    }

    fn locate(&self, index: u64) -> (String, &ObjectRecord) {
        let (epoch, place) = (index / self.objects.len() as u64, index % self.objects.len() as u64);
        let (shard, i) = self.objects[self.order(epoch)[place as usize] as usize];
        let shard = &self.manifest.shards[shard as usize];
        (shard.name(), &shard.objects[i as usize])
    }

    /// The order of all objects in one epoch.
    fn order(&self, epoch: u64) -> Arc<[u32]> {
        /// Readers that are a little ahead are in the next epoch already.
        const KEPT: usize = 2;
        let mut orders = self.orders.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, order)) = orders.iter().find(|(e, _)| *e == epoch) {
            return order.clone();
        }
        let mut order: Vec<u32> = (0..self.objects.len() as u32).collect();
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(epoch);
        order.shuffle(&mut rng);
        let order: Arc<[u32]> = order.into();
        orders.push_back((epoch, order.clone()));
        if orders.len() > KEPT {
            orders.pop_front();
        }
        order
    }

    fn bytes(&self, index: u64) -> Result<ObjectBytes, DataError> {
        let (name, object) = self.locate(index);
        read_object(&self.store, &name, object)
    }
}

impl ObjectSource for Shards {
    fn object(&self, index: u64) -> Result<Object, DataError> {
        self.bytes(index)?.object(&self.depths)
    }

    fn statistics(&self, depth: u32) -> Option<Statistics> {
        self.manifest.statistics(depth).filter(|s| s.count() > 0)
    }
}

/// The entries of an object of the shard `name`.
pub(crate) fn read_object(store: &Store, name: &str, object: &ObjectRecord) -> Result<ObjectBytes, DataError> {
    // A shard may claim anything; what objects can really have is bounded entry by entry.
    const MAX: u64 = 4 << 30;
    if object.bytes > MAX {
        let problem = format!("object {}: expected at most {MAX} bytes, found {}", object.id, object.bytes);
        return Err(DataError::File { path: store.path(name), problem });
    }
    ObjectBytes::new(store.range(name, object.offset, object.bytes)?, &object.id, store.path(name))
}

/// Compares the size of a shard with its record's.
pub(crate) fn check_size(store: &Store, name: &str, bytes: u64) -> Result<(), DataError> {
    match store.size(name)? {
        Some(found) if found == bytes => Ok(()),
        found => {
            let found = found.map_or("no such file".into(), |n| n.to_string());
            let problem = format!("expected {bytes} bytes as in the manifest, found {found}");
            Err(DataError::File { path: store.path(name), problem })
        }
    }
}
