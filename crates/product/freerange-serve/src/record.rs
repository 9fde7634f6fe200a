//! What is known of a job, as it lies in its folder.

use std::{
    fs::File,
    io::{Read, Write},
    path::{Path, PathBuf},
};

use freerange_util::write_atomically;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::{JobOptions, scene::SceneOptions};

/// Where a job is on its way.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// Its files are on their way.
    Uploading,
    /// Its photos are read.
    Reading,
    /// It can be looked at and edited, and waits for someone to press go.
    Ready,
    /// It waits for its turn.
    Queued,
    /// It computes.
    Running,
    /// It has a result.
    Done,
    /// It has none, and says why.
    Failed,
    /// Someone stopped it.
    Cancelled,
    /// The server ended while it computed or was read.
    Interrupted,
}

impl State {
    pub fn name(self) -> &'static str {
        match self {
            Self::Uploading => "uploading",
            Self::Reading => "reading",
            Self::Ready => "ready",
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Done => "done",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
            Self::Interrupted => "interrupted",
        }
    }

    /// Whether it holds or awaits resources.
    pub fn is_open(self) -> bool {
        matches!(self, Self::Uploading | Self::Reading | Self::Ready | Self::Queued | Self::Running)
    }

    /// Whether its scene may be edited and computed.
    pub fn may_go(self) -> bool {
        matches!(self, Self::Ready | Self::Done | Self::Failed | Self::Cancelled | Self::Interrupted)
    }
}

/// One sample of a result.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SampleRecord {
    pub seed: u64,
    pub gaussians: usize,
}

/// A job.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Record {
    pub id: String,
    pub title: String,
    /// Seconds since 1970.
    pub created: u64,
    pub state: State,
    /// Why it failed or was interrupted.
    #[serde(default)]
    pub error: Option<String>,
    #[serde(default)]
    pub scene: SceneOptions,
    #[serde(default)]
    pub options: JobOptions,
    /// Its place among those that wait.
    #[serde(default)]
    pub turn: u64,
    /// What was understood of its photos; null before.
    #[serde(default)]
    pub understood: Value,
    /// Files that were of no use.
    #[serde(default)]
    pub passed_over: Vec<String>,
    #[serde(default)]
    pub samples: Vec<SampleRecord>,
    #[serde(default)]
    pub up: [f64; 3],
    #[serde(default)]
    pub notes: Vec<String>,
    /// Seconds per stage.
    #[serde(default)]
    pub seconds: Vec<(String, f64)>,
}

/// Held by tests in which the disk takes its time.
#[cfg(test)]
pub static DISK: std::sync::Mutex<()> = std::sync::Mutex::new(());

/// Most bytes of a record.
const LARGEST: u64 = 64 << 20;

pub fn file(folder: &Path) -> PathBuf {
    folder.join("job.json")
}

/// The Gaussians of sample `i`.
pub fn sample_file(folder: &Path, i: usize) -> PathBuf {
    folder.join(format!("sample-{i}.ply"))
}

pub fn thumbnail_file(folder: &Path) -> PathBuf {
    folder.join("thumbnail.png")
}

impl Record {
    pub fn write(&self, folder: &Path) -> std::io::Result<()> {
        #[cfg(test)]
        let _disk = DISK.lock();
        let text = serde_json::to_vec(self).map_err(std::io::Error::other)?;
        write_atomically(&file(folder), |w| w.write_all(&text))
    }

    pub fn read(folder: &Path) -> std::io::Result<Self> {
        let mut text = Vec::new();
        File::open(file(folder))?.take(LARGEST).read_to_end(&mut text)?;
        Ok(serde_json::from_slice(&text)?)
    }
}
