//! What an engine is asked for, and what comes of it.

use std::{
    fs::{File, OpenOptions},
    io::Write,
    path::{Path, PathBuf},
};

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

/// How a line of the log begins that is not the engine's.
const OWN: &str = "freerange: ";
/// Lines of the log in an error.
const QUOTED: usize = 3;

/// Begins an attempt, the first or a later one, in the log.
pub fn begin(log: &Path, attempt: usize, what: &str) -> Result<(), CliError> {
    let file = if attempt == 1 { File::create(log) } else { opened(log) };
    file.and_then(|mut file| writeln!(file, "{OWN}attempt {attempt}: {what}")).map_err(|e| CliError::file(log, e))
}

/// The log, for an engine to write on.
pub fn log_of_engine(log: &Path) -> Result<File, CliError> {
    opened(log).map_err(|e| CliError::file(log, e))
}

fn opened(log: &Path) -> std::io::Result<File> {
    OpenOptions::new().create(true).append(true).open(log)
}

/// What the engine said last in the attempt that the log ends with.
pub fn last_words(log: &Path) -> Vec<String> {
    let text = std::fs::read(log).map(|b| String::from_utf8_lossy(&b).into_owned()).unwrap_or_default();
    let of_attempt = text.lines().rev().take_while(|line| !line.starts_with(OWN));
    let mut last: Vec<String> = of_attempt.filter(|l| !l.trim().is_empty()).take(QUOTED).map(str::to_owned).collect();
    last.reverse();
    last
}

/// An engine's failure, with the end of what it said.
pub fn failed(engine: &str, log: &Path) -> CliError {
    let last = last_words(log);
    CliError::failure(match last.is_empty() {
        true => format!("{engine} failed without a message"),
        false => format!("{engine} failed; its log ends with: {}", last.join(" / ")),
    })
}
