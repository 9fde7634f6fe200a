//! `manifest.json`: what a folder of shards holds, and what it was made with.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use freerange_splat::Statistics;

use crate::file::{NewFile, io_error, sha256};
use crate::{DataError, GenerateConfig};

/// Version of the layout of shards and manifest.
pub const FORMAT: u32 = 1;
/// Largest manifest, in bytes.
const MAX_BYTES: u64 = 256 << 20;

/// Contents of `manifest.json`.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// [`FORMAT`].
    pub format: u32,
    /// SHA-256 of `config` as compact JSON. A folder holds objects of one configuration only.
    pub config_sha256: String,
    /// What the objects were made with; among it the depths of their slices.
    pub config: GenerateConfig,
    /// The finished shards in ascending order. While objects are being made some are missing.
    pub shards: Vec<ShardRecord>,
}

/// A finished shard.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShardRecord {
    /// Number of the shard.
    pub index: u64,
    /// File name in the folder.
    pub name: String,
    /// Objects in it.
    pub samples: u64,
    /// Size in bytes.
    pub bytes: u64,
    /// SHA-256 in hexadecimal.
    pub sha256: String,
    /// By depth, statistics over the Gaussians of its slices.
    pub statistics: BTreeMap<u32, Statistics>,
    /// Objects that could not be made, and are not in it.
    pub failures: Vec<Failure>,
}

/// An object that could not be made.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Failure {
    /// Its number.
    pub object: u64,
    /// Its seed.
    pub seed: u64,
    /// Why.
    pub reason: String,
}

/// File name of a shard.
pub(crate) fn shard_name(index: u64) -> String {
    format!("shard-{index:05}.tar")
}

impl Manifest {
    /// That of an empty folder.
    pub fn new(config: &GenerateConfig) -> Result<Self, DataError> {
        let config_sha256 = config.sha256()?;
        Ok(Self { format: FORMAT, config_sha256, config: config.clone(), shards: Vec::new() })
    }

    /// Where a folder keeps it.
    pub fn path(folder: &Path) -> PathBuf {
        folder.join("manifest.json")
    }

    /// That of `folder`, checked for contradictions; whether the shards are there is not looked at.
    ///
    /// # Errors
    /// [`DataError::Io`], [`DataError::File`].
    pub fn load(folder: &Path) -> Result<Self, DataError> {
        let path = Self::path(folder);
        let mut text = Vec::new();
        let file = std::fs::File::open(&path).map_err(io_error(&path))?;
        file.take(MAX_BYTES + 1).read_to_end(&mut text).map_err(io_error(&path))?;
        let problem = |problem: String| DataError::File { path: path.clone(), problem };
        if text.len() as u64 > MAX_BYTES {
            return Err(problem(format!("expected at most {MAX_BYTES} bytes, found more")));
        }
        // The version first: another one may have other fields.
        #[derive(serde::Deserialize)]
        struct Version {
            format: u32,
        }
        let Version { format } =
            serde_json::from_slice(&text).map_err(|e| problem(format!("no manifest of shards: {e}")))?;
        if format != FORMAT {
            return Err(problem(format!("field format: expected {FORMAT}, found {format}")));
        }
        let manifest: Self = serde_json::from_slice(&text).map_err(|e| problem(e.to_string()))?;
        manifest.check().map_err(problem)?;
        Ok(manifest)
    }

    fn check(&self) -> Result<(), String> {
        self.config.validate().map_err(|e| format!("field config.{e}"))?;
        let mut next = 0;
        for (i, s) in self.shards.iter().enumerate() {
            let expect = |ok: bool, field: &str, expected: String, found: String| match ok {
                true => Ok(()),
                false => Err(format!("field shards[{i}].{field}: expected {expected}, found {found}")),
            };
            let range = next..self.config.shard_count();
            expect(range.contains(&s.index), "index", format!("{range:?}"), s.index.to_string())?;
            next = s.index + 1;
            // Exactly this name: a manifest cannot point outside its folder.
            let name = shard_name(s.index);
            expect(s.name == name, "name", format!("{name:?}"), format!("{:?}", s.name))?;
            let objects = self.config.shard_objects(s.index);
            let found = s.samples.saturating_add(s.failures.len() as u64);
            let whole = found == objects.end - objects.start;
            expect(whole, "samples", format!("with the failures {objects:?}"), found.to_string())?;
            let depths: Vec<u32> = s.statistics.keys().copied().collect();
            let known = depths == self.config.depths;
            expect(known, "statistics", format!("those of depths {:?}", self.config.depths), format!("{depths:?}"))?;
            for (depth, statistics) in &s.statistics {
                // No overflow: neither number exceeds what `validate` allows.
                let (count, found) = (s.samples << depth, statistics.count());
                expect(count == found, "statistics", format!("{count} Gaussians at depth {depth}"), found.to_string())?;
            }
        }
        Ok(())
    }

    /// Writes `manifest.json` in `folder` in one piece.
    pub(crate) fn save(&self, folder: &Path) -> Result<(), DataError> {
        let path = Self::path(folder);
        let text = serde_json::to_string_pretty(self)
            .map_err(|e| DataError::File { path: path.clone(), problem: e.to_string() })?;
        let mut file = NewFile::create(&path)?;
        file.write_all(text.as_bytes()).and_then(|()| file.write_all(b"\n")).map_err(io_error(&path))?;
        file.finish().map(|_| ())
    }

    /// Objects in all finished shards.
    pub fn samples(&self) -> u64 {
        self.shards.iter().map(|s| s.samples).sum()
    }

    /// Bytes of all finished shards.
    pub fn bytes(&self) -> u64 {
        self.shards.iter().fold(0, |sum, s| sum.saturating_add(s.bytes))
    }

    /// Whether every shard is finished.
    pub fn is_complete(&self) -> bool {
        self.shards.len() as u64 == self.config.shard_count()
    }

    /// Statistics over all Gaussians of the slices at `depth`, from which normalisation follows; `None` if there are no
    /// such slices.
    pub fn statistics(&self, depth: u32) -> Option<Statistics> {
        let mut all = Statistics::default();
        for shard in &self.shards {
            all.merge(shard.statistics.get(&depth)?);
        }
        self.config.depths.contains(&depth).then_some(all)
    }
}

impl GenerateConfig {
    /// SHA-256, in hexadecimal, of the configuration as compact JSON.
    pub fn sha256(&self) -> Result<String, DataError> {
        let json = serde_json::to_vec(self).map_err(|e| DataError::Config {
            field: "config".into(),
            expected: "values JSON can hold".into(),
            found: e.to_string(),
        })?;
        Ok(sha256(&json))
    }
}
