//! What an engine is asked for, and what comes of it.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::error::CliError;

/// What an engine is asked for.
#[derive(Serialize)]
pub struct Job {
    /// Where it works.
    pub work: PathBuf,
    /// The folder of the photos.
    pub images: PathBuf,
    /// The photos, in the order in which they were taken.
    pub names: Vec<String>,
    /// Those of one size and lens, which share a camera.
    pub groups: Vec<Vec<String>>,
    /// A file with a pair of names on each line: photos taken one after the other.
    pub pairs: PathBuf,
    /// Slower features that hold under larger turns.
    pub thorough: bool,
    /// Whether all pairs are compared where neighbors leave photos out.
    pub all_pairs: bool,
    /// Contrast that a feature needs at least.
    pub peak_threshold: f64,
    /// Threads that look for features; none: as many as the engine likes.
    pub threads: Option<usize>,
    /// A folder of masks as COLMAP has them.
    pub masks: Option<PathBuf>,
    /// Of all random numbers.
    pub seed: u64,
}

/// What an engine did.
#[derive(Deserialize, Serialize, Debug, Default)]
pub struct Done {
    /// Its name and version.
    pub engine: String,
    /// Photos in each of its models, the largest first.
    pub models: Vec<usize>,
    /// Which pairs were enough: neighbors or all.
    pub pairs: Option<String>,
    /// Points of the largest model.
    pub points: usize,
    /// Their mean distance from where they should appear, in pixels.
    #[serde(default)]
    pub reprojection_error: Option<f64>,
}

/// An engine's failure, with the end of what it said.
pub fn failed(engine: &str, log: &Path) -> CliError {
    let text = std::fs::read(log).map(|b| String::from_utf8_lossy(&b).into_owned()).unwrap_or_default();
    let last: Vec<&str> = text.lines().rev().filter(|l| !l.trim().is_empty()).take(2).collect();
    let last: Vec<&str> = last.into_iter().rev().collect();
    CliError::failure(format!("{engine} failed; {} ends with: {}", log.display(), last.join(" / ")))
}
