//! Making shards, in a way that can be spread over machines, killed at any time and taken up again.
//!
//! An object is a pure function of its item, the configuration and the seed. Each finished object is written at once to
//! `parts/`; when all objects of a shard are there, they become the shard, then its record, and the parts go away.

use std::collections::{BTreeMap, VecDeque};
use std::io::Write;
use std::panic::AssertUnwindSafe;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use crate::layout::{END, ObjectBytes, PLAN, object_bytes, record_name, shard_name, to_json};
use crate::{
    DataError, FORMAT, Failure, HeldOutPsnr, Manifest, Metadata, Object, ObjectRecord, Plan, Recipe, ShardRecord,
    Split, Store,
};
use freerange_assets::generate::generate;
use freerange_assets::mesh::{Mesh, load_mesh};
use freerange_gaussians::Statistics;
use freerange_scene::camera::{SelectionConfig, View, ViewSets, select_views};
use freerange_util::{Invalid, IoError, Share, sha256};
use glam::DVec3;

use crate::build::items::{Item, Items, draw};
use crate::build::object::{MadeObject, Photographed, Seconds, add_elapsed, make};
use crate::build::{BuildConfig, BuildError};

/// Largest finished object, in bytes.
const MAX_PART: u64 = 4 << 30;

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

/// An object that is done.
#[derive(Clone, Debug)]
pub struct Done<'a> {
    /// Objects of this process's share that are done, and their number.
    pub count: [u64; 2],
    /// Its name.
    pub id: &'a str,
    /// How it ended; `None` if it was there already.
    pub result: Option<Result<(&'a HeldOutPsnr, Seconds), &'a str>>,
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

/// What is known of the file that an object was made of.
#[derive(Default)]
pub(crate) struct FileFacts {
    pub sha256: Option<String>,
    pub notes: Vec<String>,
}

/// Seed of what is drawn for an item.
pub(crate) fn seed_of(item: &Item, config: &BuildConfig) -> u64 {
    item.seed.unwrap_or_else(|| draw(&item.id, config.seed, "object"))
}

/// The part of the data that an item belongs to.
fn split_of(item: &Item, config: &BuildConfig) -> Split {
    item.split.unwrap_or_else(|| {
        let share = draw(&item.id, config.seed, "split") as f64 / 2f64.powi(64);
        let [validation, test] = [config.shard.validation, config.shard.test];
        match share {
            s if s < test => Split::Test,
            s if s < test + validation => Split::Validation,
            _ => Split::Train,
        }
    })
}

/// The mesh of an item in the canonical frame.
pub(crate) fn mesh_of(item: &Item, config: &BuildConfig) -> Result<(Mesh, FileFacts), BuildError> {
    match &item.file {
        None => Ok((generate(seed_of(item, config), &config.object.generator)?, FileFacts::default())),
        Some(path) => {
            let loaded = load_mesh(path, &config.mesh)?;
            let bytes = std::fs::read(path).map_err(IoError::at(path))?; // the loader has checked its size
            Ok((loaded.mesh, FileFacts { sha256: Some(sha256(&bytes)), notes: loaded.notes }))
        }
    }
}

/// The object of an item.
fn make_item(item: &Item, config: &BuildConfig) -> Result<(MadeObject, FileFacts), BuildError> {
    let start = Instant::now();
    let (mesh, facts) = mesh_of(item, config)?;
    let mut read = 0.0;
    add_elapsed(&mut read, start);
    let seed = seed_of(item, config);
    let mut made = make(item.id.clone(), mesh, seed, &config.object, &config.depths, config.shard.held_out)?;
    made.seconds.read = read;
    Ok((made, facts))
}

/// The views of an item in the canonical frame, as an object of it would have them, and which of them evaluation uses.
///
/// # Errors
/// As [`BuildConfig::validate`]; [`BuildError::Mesh`] for a mesh that cannot be loaded.
pub fn render_views(item: &Item, config: &BuildConfig) -> Result<(Vec<View>, Option<ViewSets>), BuildError> {
    config.validate()?;
    let (mesh, _) = mesh_of(item, config)?;
    let seed = seed_of(item, config);
    let views = Photographed::new(mesh, seed, &config.object, 0, &mut Seconds::default())?.views;
    let sets = evaluation(&views, config, seed)?;
    Ok((views, sets))
}

/// The mesh of an item, in the frame of its views.
///
/// # Errors
/// [`BuildError::Mesh`] for a mesh that cannot be made or loaded.
pub fn true_mesh(item: &Item, config: &BuildConfig) -> Result<Mesh, BuildError> {
    Ok(mesh_of(item, config)?.0)
}

/// The views that evaluation uses; `None` where there are too few.
fn evaluation(views: &[View], config: &BuildConfig, seed: u64) -> Result<Option<ViewSets>, BuildError> {
    let selection = SelectionConfig { seed, ..config.shard.selection.clone() };
    if views.len() < 2 * selection.inputs + selection.validation {
        return Ok(None);
    }
    let centers: Vec<DVec3> = views.iter().map(|v| v.camera.center()).collect();
    Ok(Some(select_views(&centers, DVec3::ZERO, &selection)?))
}

/// The result of an object, as `parts/` keeps it beside the object's bytes.
#[derive(serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum Outcome {
    #[serde(rename = "made")]
    Built {
        split: Split,
        psnr: Option<f64>,
        flagged: bool,
        statistics: BTreeMap<u32, Statistics>,
    },
    Failed {
        reason: String,
    },
}

/// Sums over the objects made now.
#[derive(Default)]
struct Totals {
    made: u64,
    failed: u64,
    measured: u64,
    seconds: Seconds,
    psnr: HeldOutPsnr,
}

/// What is to be done.
#[derive(Default)]
struct Queue {
    /// Shards that were not looked at yet.
    shards: VecDeque<u64>,
    /// Objects to make: shard, number, and how many of the shard's are left.
    objects: VecDeque<(u64, u64, Arc<AtomicUsize>)>,
}

/// What is there of a shard.
enum Scan {
    /// All of it.
    Whole(ShardRecord),
    /// All but these objects, and the shard itself.
    Missing(Vec<u64>),
}

/// What a lock holds, also where a thread has panicked with it: nothing is left half-changed here.
fn unpoisoned<T>(lock: Result<T, PoisonError<T>>) -> T {
    lock.unwrap_or_else(PoisonError::into_inner)
}

struct Work<'a, P, M> {
    plan: &'a Plan,
    config: &'a BuildConfig,
    plan_sha256: String,
    items: &'a Items,
    store: &'a Store,
    retry_failed: bool,
    pools: Vec<rayon::ThreadPool>,
    done: AtomicU64,
    all: u64,
    totals: Mutex<Totals>,
    progress: &'a P,
    make: &'a M,
}

impl<P, M> Work<'_, P, M>
where
    P: Fn(Done) + Sync,
    M: Fn(&Item) -> Result<(MadeObject, FileFacts), BuildError> + Sync,
{
    /// Makes what is missing of some shards, by all workers. The first error of the store ends it.
    ///
    /// Workers go on with the next shard while others finish the last objects of one; who makes a shard's last object
    /// also joins it.
    fn shards(&self, shards: Vec<u64>) -> Result<Vec<ShardRecord>, BuildError> {
        let queue = Mutex::new(Queue { shards: shards.into(), ..Queue::default() });
        let (records, failed) = (Mutex::new(BTreeMap::new()), Mutex::new(None));
        let stop = AtomicBool::new(false);
        let keep = |record: ShardRecord| unpoisoned(records.lock()).insert(record.index, record);
        let work = |pool: &rayon::ThreadPool| -> Result<(), BuildError> {
            while !stop.load(Ordering::Relaxed) {
                let next = {
                    let mut queue = unpoisoned(queue.lock());
                    while queue.objects.is_empty()
                        && let Some(shard) = queue.shards.pop_front()
                    {
                        match self.scan(shard)? {
                            Scan::Whole(record) => drop(keep(record)),
                            Scan::Missing(objects) if objects.is_empty() => drop(keep(self.join(shard)?)),
                            Scan::Missing(objects) => {
                                let left = Arc::new(AtomicUsize::new(objects.len()));
                                queue.objects.extend(objects.into_iter().map(|index| (shard, index, left.clone())));
                            }
                        }
                    }
                    queue.objects.pop_front()
                };
                let Some((shard, index, left)) = next else { break };
                pool.install(|| self.make_one(shard, index))?;
                if left.fetch_sub(1, Ordering::AcqRel) == 1 {
                    keep(self.join(shard)?);
                }
            }
            Ok(())
        };
        std::thread::scope(|scope| {
            for pool in &self.pools {
                let (work, stop, failed) = (&work, &stop, &failed);
                scope.spawn(move || {
                    if let Err(e) = work(pool) {
                        stop.store(true, Ordering::Relaxed);
                        unpoisoned(failed.lock()).get_or_insert(e);
                    }
                });
            }
        });
        match unpoisoned(failed.into_inner()) {
            Some(error) => Err(error),
            None => Ok(unpoisoned(records.into_inner()).into_values().collect()),
        }
    }

    /// What is there of a shard.
    fn scan(&self, shard: u64) -> Result<Scan, BuildError> {
        let old = ShardRecord::load(self.store, self.plan, &self.plan_sha256, shard)?;
        let whole = |r: &ShardRecord| Ok::<_, BuildError>(self.store.size(&r.name())? == Some(r.bytes));
        if let Some(record) = old
            && whole(&record)?
        {
            if self.retry_failed && !record.failures.is_empty() {
                self.unpack(&record)?;
            } else {
                // A process killed between the record and the end leaves parts.
                self.store.remove_folder(&parts(shard))?;
                record.objects.iter().for_each(|o| self.tell(&o.id, None));
                record.failures.iter().for_each(|f| self.tell(&f.id, None));
                return Ok(Scan::Whole(record));
            }
        }
        let folder = parts(shard);
        let there = self.store.list(&folder)?;
        let mut missing = Vec::new();
        for index in self.plan.shard_objects(shard) {
            let again = self.retry_failed && matches!(self.outcome(&folder, index)?, Some(Outcome::Failed { .. }));
            if !again && there.binary_search(&outcome_name(index)).is_ok() {
                self.tell(&self.item(index)?.id, None);
            } else {
                missing.push(index);
            }
        }
        Ok(Scan::Missing(missing))
    }

    /// Makes parts of the objects of a finished shard again, so that only those that it lacks have to be made.
    fn unpack(&self, record: &ShardRecord) -> Result<(), BuildError> {
        let (folder, name) = (parts(record.index), record.name());
        for &ObjectRecord { index, offset, bytes, split, psnr, flagged, ref id, .. } in &record.objects {
            let bytes = self.store.range(&name, offset, bytes)?;
            let object = ObjectBytes::new(bytes.clone(), id, self.store.path(&name))?.object(&self.config.depths)?;
            let statistics = statistics_of(&object, &self.config.depths)?;
            self.store.write(&format!("{folder}/{}", bytes_name(index)), &bytes)?;
            self.write_outcome(&folder, index, &Outcome::Built { split, psnr, flagged, statistics })?;
        }
        Ok(())
    }

    fn item(&self, index: u64) -> Result<Item, BuildError> {
        self.items.get(index).ok_or_else(|| {
            BuildError::from(Invalid::new("items", format!("item {index}"), format!("{} items", self.items.len())))
        })
    }

    fn tell(&self, id: &str, result: Option<Result<(&HeldOutPsnr, Seconds), &str>>) {
        let count = 1 + self.done.fetch_add(1, Ordering::Relaxed);
        (self.progress)(Done { count: [count, self.all], id, result });
    }

    /// Makes an object and writes it to `parts/`. Fails only if it cannot be written.
    fn make_one(&self, shard: u64, index: u64) -> Result<(), BuildError> {
        let item = self.item(index)?;
        let folder = parts(shard);
        // Any one of 140,000 files may meet a fault in some library: that is a reason, too, and the rest goes on.
        let made = std::panic::catch_unwind(AssertUnwindSafe(|| self.encoded(&item, &shard_name(shard))));
        let made = made.unwrap_or_else(|panic| {
            let text = panic.downcast_ref::<String>().map(String::as_str);
            let text = text.or(panic.downcast_ref::<&str>().copied()).unwrap_or("unknown");
            Err(format!("a fault in this program: {text}"))
        });
        let start = Instant::now();
        match made {
            Ok((bytes, outcome, psnr, mut seconds)) => {
                self.store.write(&format!("{folder}/{}", bytes_name(index)), &bytes)?;
                self.write_outcome(&folder, index, &outcome)?;
                add_elapsed(&mut seconds.write, start);
                let measured = psnr.is_some();
                let psnr = psnr.unwrap_or_default();
                {
                    let mut totals = unpoisoned(self.totals.lock());
                    totals.made += 1;
                    totals.seconds.add(&seconds, 1.0);
                    totals.measured += u64::from(measured);
                    totals.psnr.leaves += psnr.leaves;
                    psnr.slices.iter().for_each(|(&d, p)| *totals.psnr.slices.entry(d).or_default() += p);
                }
                self.tell(&item.id, Some(Ok((&psnr, seconds))));
            }
            Err(reason) => {
                tracing::warn!("object {index} ({}) could not be made: {reason}", item.id);
                self.write_outcome(&folder, index, &Outcome::Failed { reason: reason.clone() })?;
                unpoisoned(self.totals.lock()).failed += 1;
                self.tell(&item.id, Some(Err(&reason)));
            }
        }
        Ok(())
    }

    /// The bytes of an object and what is to be remembered of it, or why it could not be made.
    #[allow(clippy::type_complexity, reason = "named once, used once")]
    fn encoded(&self, item: &Item, shard: &str) -> Result<(Vec<u8>, Outcome, Option<HeldOutPsnr>, Seconds), String> {
        let config = self.config;
        let (mut made, facts) = (self.make)(item).map_err(|e| chain(&e))?;
        let start = Instant::now();
        let seed = seed_of(item, config);
        let flagged = made.psnr.as_ref().is_some_and(|p| p.leaves < config.shard.min_psnr);
        let metadata = Metadata {
            id: item.id.clone(),
            source: item.source.clone(),
            licence: item.licence.clone(),
            file_sha256: facts.sha256,
            notes: facts.notes,
            seed,
            plan_sha256: self.plan_sha256.clone(),
            split: split_of(item, config),
            gaussians: made.leaves.len() as u64,
            psnr: made.psnr.clone(),
            flagged,
            input_fits: made.object.input_fits.iter().map(|f| f.views.clone()).collect(),
            evaluation: evaluation(&made.object.views, config, seed).map_err(|e| chain(&e))?,
        };
        let statistics = statistics_of(&made.object, &config.depths).map_err(|e| chain(&e))?;
        let leaves = config.shard.leaves.then_some(&made.leaves);
        let bytes = object_bytes(&made.object, leaves, &metadata, config.shard.images, Path::new(shard));
        let bytes = bytes.map_err(|e| chain(&e))?;
        add_elapsed(&mut made.seconds.write, start);
        let psnr = made.psnr.as_ref().map(|p| p.leaves);
        Ok((bytes, Outcome::Built { split: metadata.split, psnr, flagged, statistics }, made.psnr, made.seconds))
    }

    fn write_outcome(&self, folder: &str, index: u64, outcome: &Outcome) -> Result<(), BuildError> {
        let name = format!("{folder}/{}", outcome_name(index));
        Ok(self.store.write(&name, &to_json(outcome, self.store, &name)?)?)
    }

    fn outcome(&self, folder: &str, index: u64) -> Result<Option<Outcome>, BuildError> {
        let name = format!("{folder}/{}", outcome_name(index));
        let Some(bytes) = self.store.read(&name, 1 << 24)? else { return Ok(None) };
        let broken = |e: serde_json::Error| DataError::File { path: self.store.path(&name), problem: e.to_string() };
        Ok(serde_json::from_slice(&bytes).map(Some).map_err(broken)?)
    }

    /// Makes a shard and its record of the parts, which then go away.
    fn join(&self, shard: u64) -> Result<ShardRecord, BuildError> {
        let (folder, name) = (parts(shard), shard_name(shard));
        let mut record = ShardRecord {
            index: shard,
            plan_sha256: self.plan_sha256.clone(),
            bytes: 0,
            sha256: String::new(),
            objects: Vec::new(),
            statistics: self.config.depths.iter().map(|&d| (d, Statistics::default())).collect(),
            failures: Vec::new(),
        };
        let lost = |name: String| DataError::File { path: self.store.path(&name), problem: "it has vanished".into() };
        let mut file = self.store.create(&name)?;
        let mut offset = 0;
        for index in self.plan.shard_objects(shard) {
            let Item { id, licence, .. } = self.item(index)?;
            match self.outcome(&folder, index)?.ok_or_else(|| lost(format!("{folder}/{}", outcome_name(index))))? {
                Outcome::Failed { reason } => record.failures.push(Failure { index, id, reason }),
                Outcome::Built { split, psnr, flagged, statistics } => {
                    let part = format!("{folder}/{}", bytes_name(index));
                    let content = self.store.read(&part, MAX_PART)?.ok_or_else(|| lost(part))?;
                    file.write_all(&content).map_err(IoError::at(&self.store.path(&name)))?;
                    let bytes = content.len() as u64;
                    let object = ObjectRecord { index, id, offset, bytes, licence, split, psnr, flagged };
                    offset += bytes;
                    if object.is_for_training() {
                        let all = record.statistics.iter_mut();
                        all.for_each(|(depth, all)| statistics.get(depth).into_iter().for_each(|one| all.merge(one)));
                    }
                    record.objects.push(object);
                }
            }
        }
        file.write_all(&END).map_err(IoError::at(&self.store.path(&name)))?;
        (record.bytes, record.sha256) = file.finish()?;
        self.store.write(&record_name(shard), &to_json(&record, self.store, &record_name(shard))?)?;
        self.store.remove_folder(&folder)?;
        Ok(record)
    }
}

const PARTS: &str = "parts";

fn parts(shard: u64) -> String {
    format!("{PARTS}/shard-{shard:05}")
}

fn bytes_name(index: u64) -> String {
    format!("{index:010}.tar")
}

/// Written after the bytes: where it is, the object is done.
fn outcome_name(index: u64) -> String {
    format!("{index:010}.json")
}

/// Statistics over an object's slices, by depth.
fn statistics_of(object: &Object, depths: &[u32]) -> Result<BTreeMap<u32, Statistics>, BuildError> {
    let of_depth = |&depth: &u32| {
        let mut statistics = Statistics::default();
        statistics.add(object.slice(depth)?)?;
        Ok((depth, statistics))
    };
    depths.iter().map(of_depth).collect()
}

/// An error with its causes, in one line.
fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(e) = cause {
        text += &format!(": {e}");
        cause = e.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splits_have_their_shares_and_do_not_change_with_the_rest() {
        let mut config = BuildConfig::default();
        (config.shard.validation, config.shard.test) = (0.1, 0.2);
        let items = Items::generated(4000, 0);
        let mut counts = BTreeMap::new();
        for i in 0..4000 {
            *counts.entry(split_of(&items.get(i).unwrap(), &config)).or_insert(0) += 1;
        }
        // Three standard deviations are 57 and 76.
        assert!((343..457).contains(&counts[&Split::Validation]), "{counts:?}");
        assert!((724..876).contains(&counts[&Split::Test]), "{counts:?}");
        let chosen = Item { split: Some(Split::Test), ..items.get(0).unwrap() };
        assert_eq!(split_of(&chosen, &config), Split::Test);
    }
}
