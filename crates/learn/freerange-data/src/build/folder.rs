//! Making shards, in a way that can be spread over machines, killed at any time and taken up again.
//!
//! An object is a pure function of its item, the configuration and the seed.

use std::io::Write;
use std::sync::Mutex;
use std::sync::atomic::AtomicU64;

use crate::layout::{PLAN, record_name, to_json};
use crate::{DataError, FORMAT, Failure, HeldOutPsnr, Manifest, Plan, Recipe, ShardRecord, Store};
use freerange_util::{Invalid, IoError, Share};

use crate::build::item_object::{FileFacts, make_item};
use crate::build::items::{Item, Items};
use crate::build::object::MadeObject;
use crate::build::photographed::Seconds;
use crate::build::work::{Done, PARTS, Work, unpoisoned};
use crate::build::{BuildConfig, BuildError};

/// How the work is done; none of it changes the result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BuildOptions {
    /// Which shards.
    pub share: Share,
    /// Objects made at once; 0: as many as there are cores. Memory grows with it.
    pub workers: usize,
    /// Whether objects that could not be made are tried again.
    pub retry_failed: bool,
}

/// What [`build`] has done.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct Summary {
    /// Objects made now.
    pub made: u64,
    /// Objects of the share that were there already.
    pub skipped: u64,
    /// Objects of the share that could not be made, now or earlier.
    pub failures: Vec<Failure>,
    /// Objects of the share that are flagged as bad fits.
    pub flagged: Vec<String>,
    /// Objects in the shards of the share.
    pub objects: u64,
    /// Shards of the share.
    pub shards: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Seconds of one worker per object made now, on average.
    pub seconds: Seconds,
    /// PSNR of the objects made now, in dB: mean of the Gaussians before the tree and of each slice.
    pub psnr: Option<HeldOutPsnr>,
    /// Whether the shards of all processes are there, and so the manifest.
    pub complete: bool,
}

/// Makes the share's shards that are not there yet, and the manifest if that completes them. `progress` hears of every
/// object, from several threads.
///
/// Resumable: a killed call loses at most the objects that were being made. The bytes do not depend on interruptions,
/// on the number of workers or on how the work is shared; they are the same on machines of one instruction set.
///
/// # Errors
/// As [`Plan::validate`]; [`BuildError::Data`] where the place holds shards of another plan, where another process makes
/// the same share, or where it cannot be written to. Single objects that cannot be made are recorded with their reason.
pub fn build(
    config: &BuildConfig,
    items: &Items,
    store: &Store,
    options: &BuildOptions,
    progress: impl Fn(Done) + Sync,
) -> Result<Summary, BuildError> {
    build_with(config, items, store, options, progress, |item| make_item(item, config))
}

/// As [`build`], with `make` to make the object of an item.
pub(crate) fn build_with(
    config: &BuildConfig,
    items: &Items,
    store: &Store,
    options: &BuildOptions,
    progress: impl Fn(Done) + Sync,
    make: impl Fn(&Item) -> Result<(MadeObject, FileFacts), BuildError> + Sync,
) -> Result<Summary, BuildError> {
    let plan = Plan { format: FORMAT, config: Recipe::new(config)?, input: items.describe() };
    plan.validate()?;
    config.validate()?;
    let Share { index, count } = options.share;
    let store = store.written_by(format!("-{index}-of-{count}"));
    let _lock = store.lock()?;
    agree(&store, &plan)?;
    store.remove_partial_files("")?;

    let mine = || (index..plan.shard_count()).step_by(usize::try_from(count).unwrap_or(usize::MAX));
    let all: u64 = mine().map(|s| plan.shard_objects(s)).map(|r| r.end - r.start).sum();
    let work = Work {
        plan: &plan,
        config,
        plan_sha256: plan.sha256()?,
        items,
        store: &store,
        retry_failed: options.retry_failed,
        pools: pools(options.workers)?,
        done: AtomicU64::new(0),
        all,
        totals: Mutex::default(),
        progress: &progress,
        make: &make,
    };
    let mut summary = Summary::default();
    for record in work.shards(mine().collect())? {
        summary.shards += 1;
        summary.bytes += record.bytes;
        summary.objects += record.objects.len() as u64;
        summary.flagged.extend(record.objects.iter().filter(|o| o.flagged).map(|o| o.id.clone()));
        summary.failures.extend(record.failures);
    }
    let totals = unpoisoned(work.totals.into_inner());
    summary.made = totals.made;
    summary.skipped = all - totals.made - totals.failed;
    let each = 1.0 / totals.made.max(1) as f64;
    summary.seconds.add(&totals.seconds, each);
    summary.psnr = (totals.measured > 0).then(|| {
        let each = 1.0 / totals.measured as f64;
        let slices = totals.psnr.slices.iter().map(|(&d, p)| (d, p * each)).collect();
        HeldOutPsnr { leaves: totals.psnr.leaves * each, slices }
    });
    let names = store.list("")?;
    if (0..plan.shard_count()).all(|s| names.binary_search(&record_name(s)).is_ok()) {
        summary.complete = merge(&store)?.is_complete();
        store.remove_folder(PARTS)?;
    }
    Ok(summary)
}

/// Writes the manifest of `store` if all its shards are there. Returns what is there.
///
/// # Errors
/// [`BuildError::Data`], also where there is no plan or a broken record.
pub fn merge(store: &Store) -> Result<Manifest, BuildError> {
    let plan = Plan::load(store)?.ok_or_else(|| DataError::File {
        path: store.path(PLAN),
        problem: "expected a folder of shards, found none".into(),
    })?;
    let manifest = Manifest::gather(store, plan)?;
    if manifest.is_complete() {
        manifest.save(store)?;
    }
    Ok(manifest)
}

/// Copies the finished shards of `other` that `store` lacks. Returns their number.
///
/// # Errors
/// [`BuildError::Data`] where `other` was made with another plan, or one of its shards is not what its record says.
pub fn collect(store: &Store, other: &Store) -> Result<u64, BuildError> {
    let manifest = Manifest::load(other)?;
    agree(store, &manifest.plan)?;
    let mut copied = 0;
    for record in &manifest.shards {
        if ShardRecord::load(store, &manifest.plan, &manifest.plan_sha256, record.index)?.is_some() {
            continue;
        }
        let name = record.name();
        let mut file = store.create(&name)?;
        other.pieces(&name, record.bytes, |piece| {
            Ok(file.write_all(piece).map_err(IoError::at(&store.path(&name)))?)
        })?;
        let found = file.sha256();
        if found != record.sha256 {
            let problem = format!("expected SHA-256 {} as in its record, found {found}", record.sha256);
            return Err(DataError::File { path: other.path(&name), problem }.into());
        }
        file.finish()?;
        let record_name = record_name(record.index);
        store.write(&record_name, &to_json(record, store, &record_name)?)?;
        copied += 1;
    }
    Ok(copied)
}

/// Writes `plan.json`, or compares with the one that is there.
fn agree(store: &Store, plan: &Plan) -> Result<(), BuildError> {
    let name = PLAN;
    match Plan::load(store)? {
        None => Ok(store.write(name, &to_json(plan, store, name)?)?),
        Some(old) if old == *plan => Ok(()),
        Some(old) => {
            let differs = match (old.config == plan.config, old.input == plan.input) {
                (true, _) => format!("is made of other objects ({:?}, now {:?})", old.input, plan.input),
                (_, true) => "is made with another configuration".into(),
                _ => "is made of other objects with another configuration".into(),
            };
            let problem = format!("this folder {differs}: choose another folder, or the same arguments as before");
            Err(DataError::File { path: store.path(name), problem }.into())
        }
    }
}

/// One thread pool per worker: rayon's threads would otherwise start further objects while they wait within one.
fn pools(workers: usize) -> Result<Vec<rayon::ThreadPool>, BuildError> {
    let cores = rayon::current_num_threads();
    let workers = if workers == 0 { cores } else { workers.min(1024) };
    (0..workers)
        .map(|_| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads((cores / workers).max(1)).build();
            pool.map_err(|e| BuildError::from(Invalid::new("workers", "threads that the system can start", e)))
        })
        .collect()
}
