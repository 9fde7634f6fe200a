//! The work on shards, by many workers: each finished object is written at once to `parts/`; when all objects of a shard are
//! there, they become the shard, then its record, and the parts go away.

use std::collections::{BTreeMap, VecDeque};
use std::io::Write;
use std::panic::AssertUnwindSafe;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use crate::layout::{END, ObjectBytes, object_bytes, record_name, shard_name, to_json};
use crate::{DataError, Failure, HeldOutPsnr, Metadata, Object, ObjectRecord, Plan, ShardRecord, Split, Store};
use freerange_gaussians::Statistics;
use freerange_util::{Invalid, IoError, with_causes};

use crate::build::item_object::{FileFacts, evaluation, seed_of, split_of};
use crate::build::items::{Item, Items};
use crate::build::object::MadeObject;
use crate::build::photographed::{Seconds, add_elapsed};
use crate::build::{BuildConfig, BuildError};

/// Largest finished object, in bytes.
const MAX_PART: u64 = 4 << 30;

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
pub(super) struct Totals {
    pub made: u64,
    pub failed: u64,
    pub measured: u64,
    pub seconds: Seconds,
    pub psnr: HeldOutPsnr,
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
pub(super) fn unpoisoned<T>(lock: Result<T, PoisonError<T>>) -> T {
    lock.unwrap_or_else(PoisonError::into_inner)
}

/// What is to be done for the shards of one process.
pub(super) struct Work<'a, P, M> {
    pub plan: &'a Plan,
    pub config: &'a BuildConfig,
    pub plan_sha256: String,
    pub items: &'a Items,
    pub store: &'a Store,
    pub retry_failed: bool,
    pub pools: Vec<rayon::ThreadPool>,
    /// Objects that are done, of `all`.
    pub done: AtomicU64,
    pub all: u64,
    pub totals: Mutex<Totals>,
    pub progress: &'a P,
    pub make: &'a M,
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
    pub fn shards(&self, shards: Vec<u64>) -> Result<Vec<ShardRecord>, BuildError> {
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
        let (mut made, facts) = (self.make)(item).map_err(|e| with_causes(&e, ": "))?;
        let start = Instant::now();
        let seed = seed_of(item, config);
        let flagged = made.psnr.as_ref().is_some_and(|p| p.leaves < config.shard.min_psnr);
        let metadata = Metadata {
            id: item.id.clone(),
            source: item.source.clone(),
            license: item.license.clone(),
            file_sha256: facts.sha256,
            notes: facts.notes,
            seed,
            plan_sha256: self.plan_sha256.clone(),
            split: split_of(item, config),
            gaussians: made.leaves.len() as u64,
            psnr: made.psnr.clone(),
            flagged,
            input_fits: made.object.input_fits.iter().map(|f| f.views.clone()).collect(),
            evaluation: evaluation(&made.object.views, config, seed).map_err(|e| with_causes(&e, ": "))?,
        };
        let statistics = statistics_of(&made.object, &config.depths).map_err(|e| with_causes(&e, ": "))?;
        let leaves = config.shard.leaves.then_some(&made.leaves);
        let bytes = object_bytes(&made.object, leaves, &metadata, config.shard.images, Path::new(shard));
        let bytes = bytes.map_err(|e| with_causes(&e, ": "))?;
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
            let Item { id, license, .. } = self.item(index)?;
            match self.outcome(&folder, index)?.ok_or_else(|| lost(format!("{folder}/{}", outcome_name(index))))? {
                Outcome::Failed { reason } => record.failures.push(Failure { index, id, reason }),
                Outcome::Built { split, psnr, flagged, statistics } => {
                    let part = format!("{folder}/{}", bytes_name(index));
                    let content = self.store.read(&part, MAX_PART)?.ok_or_else(|| lost(part))?;
                    file.write_all(&content).map_err(IoError::at(&self.store.path(&name)))?;
                    let bytes = content.len() as u64;
                    let object = ObjectRecord { index, id, offset, bytes, license, split, psnr, flagged };
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

pub(super) const PARTS: &str = "parts";

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
