//! What many objects will cost, from a few that are made.

use crate::build::folder::{BuildOptions, build};
use crate::build::items::Items;
use crate::build::photographed::Seconds;
use crate::build::work::Done;
use crate::build::{BuildConfig, BuildError};
use crate::{HeldOutPsnr, Store};
use freerange_util::{Invalid, IoError};

/// Costs per object, measured.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Estimate {
    /// Objects tried.
    pub sampled: u64,
    /// Of these, how many could not be made.
    pub failed: u64,
    /// Of these, how many were flagged as bad fits.
    pub flagged: u64,
    /// Seconds of one core per object that could be made, on average.
    pub seconds: Seconds,
    /// Bytes in the shards per object that could be made, on average.
    pub bytes: f64,
    /// PSNR of the Gaussians, on average.
    pub psnr: Option<HeldOutPsnr>,
    /// Cores used at once.
    pub cores: usize,
}

impl Estimate {
    /// Core-hours for `objects` objects.
    pub fn core_hours(&self, objects: u64) -> f64 {
        objects as f64 * self.seconds.total() / 3600.0
    }

    /// Gigabytes (10^9 bytes) for `objects` objects.
    pub fn gigabytes(&self, objects: u64) -> f64 {
        objects as f64 * self.bytes / 1e9
    }
}

/// Makes `sample` of the items, evenly spread over all, in a temporary folder, on all cores.
///
/// # Errors
/// As [`build`]; [`BuildError::Config`] where none could be made.
pub fn estimate(
    config: &BuildConfig,
    items: &Items,
    sample: u64,
    progress: impl Fn(Done) + Sync,
) -> Result<Estimate, BuildError> {
    let folder = tempfile::tempdir().map_err(IoError::at(&std::env::temp_dir()))?;
    let some = items.spread(sample);
    // One core per worker, as in a large job: several cores within one object would hide their waiting.
    let workers = rayon::current_num_threads();
    let options = BuildOptions { workers, ..BuildOptions::default() };
    let summary = build(config, &some, &Store::local(folder.path()), &options, progress)?;
    if summary.made == 0 {
        return Err(BuildError::from(Invalid::new(
            "sample",
            "at least one object that can be made",
            summary.failures.first().map_or("none".into(), |f| format!("{}: {}", f.id, f.reason)),
        )));
    }
    Ok(Estimate {
        sampled: some.len(),
        failed: summary.failures.len() as u64,
        flagged: summary.flagged.len() as u64,
        seconds: summary.seconds,
        bytes: summary.bytes as f64 / summary.made as f64,
        psnr: summary.psnr,
        cores: workers,
    })
}
