//! What a folder of shards holds, and what it is made with.
//!
//! | file | content |
//! |---|---|
//! | `plan.json` | [`Plan`]: what every process that works on the folder must agree on |
//! | `shard-00000.tar`, ... | the objects |
//! | `shard-00000.json`, ... | one [`ShardRecord`] each; there as soon as the shard is whole |
//! | `manifest.json` | [`Manifest`]: all records together; there as soon as all shards are |
//! | `parts/` | finished objects of unfinished shards |

use std::collections::{BTreeMap, HashSet};
use std::ops::Range;
use std::path::Path;

use freerange_gaussians::Statistics;
use freerange_util::{Invalid, check, sha256};
use serde_json::value::RawValue;

use crate::sample::{MAX_DEPTH, is_key};
use crate::store::Store;
use crate::{DataError, Split};

/// Version of the layout of shards and manifest.
pub const FORMAT: u32 = 2;
/// Largest manifest, in bytes.
const MAX_BYTES: u64 = 1 << 30;
/// Largest number of objects.
pub const MAX_OBJECTS: u64 = 1 << 32;

pub(crate) const MANIFEST: &str = "manifest.json";
/// File name of the plan.
pub const PLAN: &str = "plan.json";

/// What a folder of shards is made with.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// [`FORMAT`].
    pub format: u32,
    /// How objects are made and stored.
    pub config: Recipe,
    /// What they are made of.
    pub input: Input,
}

impl Plan {
    /// SHA-256, in hexadecimal, of the plan as compact JSON: which folder belongs to which plan.
    ///
    /// # Errors
    /// [`DataError::Config`] for values that JSON cannot hold.
    pub fn sha256(&self) -> Result<String, DataError> {
        let json =
            serde_json::to_vec(self).map_err(|e| DataError::from(Invalid::new("config", "values JSON can hold", e)))?;
        Ok(sha256(&json))
    }

    /// Checks every field.
    ///
    /// # Errors
    /// [`DataError::Config`] and those of its parts.
    pub fn validate(&self) -> Result<(), DataError> {
        let objects = self.input.objects();
        check((1..=MAX_OBJECTS).contains(&objects), "objects", "1 to 2^32", objects)?;
        Ok(self.config.validate()?)
    }

    /// Number of shards.
    pub fn shard_count(&self) -> u64 {
        self.input.objects().div_ceil(self.config.objects_per_shard())
    }

    /// Numbers of the objects of a shard.
    pub fn shard_objects(&self, shard: u64) -> Range<u64> {
        let per = self.config.objects_per_shard();
        let first = shard * per;
        first..(first + per).min(self.input.objects())
    }

    /// That of `store`, if it has one.
    ///
    /// # Errors
    /// [`DataError::Io`], [`DataError::File`].
    pub fn load(store: &Store) -> Result<Option<Self>, DataError> {
        store.read(PLAN, MAX_BYTES)?.map(|bytes| parse(&store.path(PLAN), &bytes)).transpose()
    }
}

/// How the objects of a folder are made and stored: the configuration of who made them, word for word, of which a reader
/// needs little.
#[derive(Clone, Debug)]
pub struct Recipe {
    json: Box<RawValue>,
    read: ReadOfRecipe,
}

/// Fields that reading needs.
#[derive(Clone, Debug, serde::Deserialize)]
struct ReadOfRecipe {
    seed: u64,
    depths: Vec<u32>,
    shard: ReadOfShard,
}

#[derive(Clone, Debug, serde::Deserialize)]
struct ReadOfShard {
    objects_per_shard: u64,
}

impl Recipe {
    /// That of a configuration with the fields `seed`, `depths` and `shard.objects_per_shard`.
    ///
    /// # Errors
    /// [`DataError::Config`] for values that JSON cannot hold, and where one of these is missing.
    pub fn new(config: &impl serde::Serialize) -> Result<Self, DataError> {
        let json = serde_json::value::to_raw_value(config);
        let recipe = json.and_then(|json| serde_json::from_str(json.get()));
        recipe.map_err(|e| Invalid::new("config", "values JSON can hold", e).into())
    }

    /// Seed of what is drawn for the objects.
    pub fn seed(&self) -> u64 {
        self.read.seed
    }

    /// Depths of the slices, ascending.
    pub fn depths(&self) -> &[u32] {
        &self.read.depths
    }

    /// Objects per shard; the last one may have fewer.
    pub fn objects_per_shard(&self) -> u64 {
        self.read.shard.objects_per_shard
    }

    /// Checks what reading needs.
    ///
    /// # Errors
    /// [`Invalid`] with the field's name.
    pub fn validate(&self) -> Result<(), Invalid> {
        let depths = self.depths();
        let ascending = depths.is_sorted_by(|a, b| a < b) && depths.iter().all(|d| *d <= MAX_DEPTH);
        let expected = format!("one or more ascending depths up to {MAX_DEPTH}");
        check(ascending && !depths.is_empty(), "depths", &expected, depths)?;
        let per = self.objects_per_shard();
        check((1..=1 << 20).contains(&per), "objects_per_shard", "1 to 2^20", per)
    }
}

impl PartialEq for Recipe {
    fn eq(&self, other: &Self) -> bool {
        self.json.get() == other.json.get()
    }
}

impl serde::Serialize for Recipe {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.json.serialize(serializer)
    }
}

impl<'de> serde::Deserialize<'de> for Recipe {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let json = Box::<RawValue>::deserialize(deserializer)?;
        let read = serde_json::from_str(json.get()).map_err(serde::de::Error::custom)?;
        Ok(Self { json, read })
    }
}

/// What objects are made of.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Input {
    /// Generated objects.
    Generated {
        /// Their number.
        objects: u64,
        /// Seed of the first; object `i` has `seed + i`.
        seed: u64,
    },
    /// Mesh files.
    Files {
        /// Their number.
        objects: u64,
        /// SHA-256 over the list of items: ids, sources, licenses, splits. Contents are hashed per object.
        sha256: String,
    },
}

impl Input {
    /// Number of objects.
    pub fn objects(&self) -> u64 {
        match self {
            Self::Generated { objects, .. } | Self::Files { objects, .. } => *objects,
        }
    }
}

/// Contents of `manifest.json`.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// What the folder is made with.
    pub plan: Plan,
    /// SHA-256 of it.
    pub plan_sha256: String,
    /// The shards in ascending order.
    pub shards: Vec<ShardRecord>,
}

/// A finished shard.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShardRecord {
    /// Number of the shard.
    pub index: u64,
    /// [`Plan::sha256`] of what it is made with.
    pub plan_sha256: String,
    /// Size in bytes.
    pub bytes: u64,
    /// SHA-256 in hexadecimal.
    pub sha256: String,
    /// Its objects, in order.
    pub objects: Vec<ObjectRecord>,
    /// By depth, statistics over the Gaussians of the slices of its objects for training, but not of flagged ones.
    pub statistics: BTreeMap<u32, Statistics>,
    /// Objects that could not be made, and are not in it.
    pub failures: Vec<Failure>,
}

/// An object in a shard.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectRecord {
    /// Its number among all objects.
    pub index: u64,
    /// Its name.
    pub id: String,
    /// Where its entries begin in the shard.
    pub offset: u64,
    /// Bytes of its entries.
    pub bytes: u64,
    /// License, as an SPDX identifier.
    pub license: String,
    /// The part of the data it belongs to.
    pub split: Split,
    /// PSNR of its Gaussians before the tree against held-out views, in dB; `None` where not measured.
    pub psnr: Option<f64>,
    /// Whether it is left out of training for that PSNR.
    pub flagged: bool,
}

/// An object that could not be made.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Failure {
    /// Its number among all objects.
    pub index: u64,
    /// Its name.
    pub id: String,
    /// Why.
    pub reason: String,
}

/// File name of a shard.
pub fn shard_name(index: u64) -> String {
    format!("shard-{index:05}.tar")
}

/// File name of a shard's record.
pub fn record_name(index: u64) -> String {
    format!("shard-{index:05}.json")
}

impl ShardRecord {
    /// File name of the shard.
    pub fn name(&self) -> String {
        shard_name(self.index)
    }

    /// That of shard `index` of `store`, checked for contradictions; `None` where there is none.
    ///
    /// # Errors
    /// [`DataError::Io`], [`DataError::File`].
    pub fn load(store: &Store, plan: &Plan, plan_sha256: &str, index: u64) -> Result<Option<Self>, DataError> {
        let name = record_name(index);
        let Some(bytes) = store.read(&name, MAX_BYTES)? else { return Ok(None) };
        let problem = |problem: String| DataError::File { path: store.path(&name), problem };
        let record: Self = serde_json::from_slice(&bytes).map_err(|e| problem(e.to_string()))?;
        record.check(plan, plan_sha256, index).map_err(problem)?;
        Ok(Some(record))
    }

    fn check(&self, plan: &Plan, plan_sha256: &str, index: u64) -> Result<(), String> {
        let expect = |ok: bool, field: &str, expected: String, found: String| match ok {
            true => Ok(()),
            false => Err(format!("field {field} of shard {index}: expected {expected}, found {found}")),
        };
        expect(self.index == index, "index", index.to_string(), self.index.to_string())?;
        expect(self.plan_sha256 == plan_sha256, "plan_sha256", plan_sha256.into(), self.plan_sha256.clone())?;
        let range = plan.shard_objects(index);
        let found = self.objects.len() as u64 + self.failures.len() as u64;
        expect(found == range.end - range.start, "objects", format!("with the failures {range:?}"), found.to_string())?;
        let (mut next, mut end, mut ids) = (range.start, 0, HashSet::new());
        for o in &self.objects {
            let left = next..range.end;
            expect(left.contains(&o.index), "objects.index", format!("{left:?}"), o.index.to_string())?;
            next = o.index + 1;
            expect(is_key(&o.id) && ids.insert(&o.id), "objects.id", "a name that occurs once".into(), o.id.clone())?;
            let inside = o.offset == end && o.bytes > 0 && o.bytes <= self.bytes.saturating_sub(end);
            let span = || format!("{} bytes from {}", o.bytes, o.offset);
            expect(inside, "objects.offset", format!("from {end}, within {} bytes", self.bytes), span())?;
            end = o.offset + o.bytes;
        }
        let known = plan.config.depths().iter().eq(self.statistics.keys());
        expect(known, "statistics", format!("{:?}", plan.config.depths()), format!("{:?}", self.statistics.keys()))?;
        let counted = self.objects.iter().filter(|o| o.is_for_training()).count() as u64;
        for (depth, statistics) in &self.statistics {
            // No overflow: neither number exceeds what `validate` allows.
            let (count, found) = (counted << depth, statistics.count());
            expect(count == found, "statistics", format!("{count} Gaussians at depth {depth}"), found.to_string())?;
        }
        Ok(())
    }
}

impl ObjectRecord {
    /// Whether models are trained on it, and statistics count it.
    pub fn is_for_training(&self) -> bool {
        self.split == Split::Train && !self.flagged
    }
}

fn parse<T: serde::de::DeserializeOwned>(path: &Path, bytes: &[u8]) -> Result<T, DataError> {
    let problem = |problem: String| DataError::File { path: path.into(), problem };
    // The version first: another one may have other fields.
    #[derive(serde::Deserialize)]
    struct Inner {
        format: u32,
    }
    #[derive(serde::Deserialize)]
    struct Version {
        format: Option<u32>,
        plan: Option<Inner>,
    }
    let version: Version =
        serde_json::from_slice(bytes).map_err(|e| problem(format!("expected a description of shards: {e}")))?;
    match version.format.or(version.plan.map(|p| p.format)) {
        Some(FORMAT) => serde_json::from_slice(bytes).map_err(|e| problem(e.to_string())),
        Some(found) => Err(problem(format!("field format: expected {FORMAT}, found {found}"))),
        None => Err(problem(format!("field format: expected {FORMAT}, found none"))),
    }
}

impl Manifest {
    /// That of `store`, checked for contradictions; whether the shards are there is not looked at. Without a
    /// `manifest.json`, that of the shards which are finished so far.
    ///
    /// # Errors
    /// [`DataError::Io`]; [`DataError::File`], also where there is neither manifest nor plan.
    pub fn load(store: &Store) -> Result<Self, DataError> {
        let problem = |problem: String| DataError::File { path: store.path(MANIFEST), problem };
        let Some(bytes) = store.read(MANIFEST, MAX_BYTES)? else {
            let plan = Plan::load(store)?.ok_or_else(|| problem("expected a folder of shards, found none".into()))?;
            return Self::gather(store, plan);
        };
        Self::from_json(&store.path(MANIFEST), &bytes)
    }

    /// A manifest from its bytes, checked for contradictions. Messages call it `path`.
    ///
    /// # Errors
    /// [`DataError::File`].
    pub fn from_json(path: &Path, bytes: &[u8]) -> Result<Self, DataError> {
        let problem = |problem: String| DataError::File { path: path.into(), problem };
        let manifest: Self = parse(path, bytes)?;
        manifest.plan.validate().map_err(|e| problem(format!("field plan.{e}")))?;
        let sha256 = manifest.plan.sha256()?;
        if manifest.plan_sha256 != sha256 {
            let found = &manifest.plan_sha256;
            return Err(problem(format!("field plan_sha256: expected {sha256}, found {found}")));
        }
        let mut next = 0;
        for shard in &manifest.shards {
            let range = next..manifest.plan.shard_count();
            if !range.contains(&shard.index) {
                return Err(problem(format!("field shards.index: expected {range:?}, found {}", shard.index)));
            }
            next = shard.index + 1;
            shard.check(&manifest.plan, &sha256, shard.index).map_err(problem)?;
        }
        Ok(manifest)
    }

    /// What the records of finished shards say together.
    ///
    /// # Errors
    /// [`DataError::Io`], [`DataError::File`].
    pub fn gather(store: &Store, plan: Plan) -> Result<Self, DataError> {
        plan.validate()?;
        let plan_sha256 = plan.sha256()?;
        // One listing instead of thousands of requests for records that are not there yet.
        let names = store.list("")?;
        let there = |index: &u64| names.binary_search(&record_name(*index)).is_ok();
        let mut shards = Vec::new();
        for index in (0..plan.shard_count()).filter(there) {
            shards.extend(ShardRecord::load(store, &plan, &plan_sha256, index)?);
        }
        Ok(Self { plan, plan_sha256, shards })
    }

    /// Writes `manifest.json` in one piece.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn save(&self, store: &Store) -> Result<(), DataError> {
        store.write(MANIFEST, &to_json(self, store, MANIFEST)?)
    }

    /// Objects in all finished shards.
    pub fn objects(&self) -> impl Iterator<Item = &ObjectRecord> {
        self.shards.iter().flat_map(|s| &s.objects)
    }

    /// Bytes of all finished shards.
    pub fn bytes(&self) -> u64 {
        self.shards.iter().fold(0, |sum, s| sum.saturating_add(s.bytes))
    }

    /// Whether every shard is finished.
    pub fn is_complete(&self) -> bool {
        self.shards.len() as u64 == self.plan.shard_count()
    }

    /// Statistics over all Gaussians of the slices for training at `depth`, from which normalization follows; `None` if
    /// there are no such slices.
    pub fn statistics(&self, depth: u32) -> Option<Statistics> {
        let mut all = Statistics::default();
        for shard in &self.shards {
            all.merge(shard.statistics.get(&depth)?);
        }
        self.plan.config.depths().contains(&depth).then_some(all)
    }
}

/// `value` as JSON with a line break at its end. Messages call it `name` of `store`.
///
/// # Errors
/// [`DataError::File`] for values that JSON cannot hold.
pub fn to_json(value: &impl serde::Serialize, store: &Store, name: &str) -> Result<Vec<u8>, DataError> {
    let problem = |e: serde_json::Error| DataError::File { path: store.path(name), problem: e.to_string() };
    let mut json = serde_json::to_vec(value).map_err(problem)?;
    json.push(b'\n');
    Ok(json)
}
