//! What is known of each job while the server lives.

use std::{
    collections::{BTreeMap, VecDeque},
    path::PathBuf,
    sync::{Arc, Mutex, atomic::AtomicBool},
    time::Instant,
};

use freerange_gaussians::Gaussians;
use serde_json::{Value, json};

use crate::{
    JobOptions,
    record::{Record, State},
};

/// Gaussians that a run has published.
pub(super) struct Estimate {
    pub(super) number: u64,
    pub(super) stage: &'static str,
    /// Sample and rows, little-endian.
    pub(super) parts: Vec<(usize, Arc<Vec<u8>>)>,
}

/// How far a run has come.
#[derive(Clone, Copy, Default)]
pub(super) struct Progress {
    pub(super) stage: &'static str,
    pub(super) sample: usize,
    pub(super) done: usize,
    pub(super) total: usize,
    pub(super) loss: Option<f64>,
}

pub(super) struct Job {
    pub(super) record: Record,
    pub(super) folder: PathBuf,
    pub(super) version: u64,
    pub(super) progress: Progress,
    pub(super) estimates: VecDeque<Estimate>,
    pub(super) published: u64,
    pub(super) cancel: Arc<AtomicBool>,
    pub(super) touched: Instant,
    /// Computed as soon as it is read.
    pub(super) go: Option<JobOptions>,
    /// A file of Gaussians to be read instead of photos.
    pub(super) splats: Option<PathBuf>,
    /// Whether a thread reads its photos.
    pub(super) read_by_one: bool,
    /// Bytes on disk.
    pub(super) bytes: u64,
    /// Held by whoever changes its record.
    pub(super) writing: Arc<Mutex<()>>,
}

#[derive(Default)]
pub(super) struct Table {
    pub(super) jobs: BTreeMap<String, Job>,
    /// Those that can be brought back.
    pub(super) removed: BTreeMap<String, Job>,
    pub(super) turns: u64,
    pub(super) versions: u64,
}

impl Table {
    pub(super) fn next_version(&mut self) -> u64 {
        self.versions += 1;
        self.versions
    }

    pub(super) fn job(&mut self, record: Record, folder: PathBuf) -> Job {
        Job {
            record,
            folder,
            version: self.next_version(),
            progress: Progress::default(),
            estimates: VecDeque::new(),
            published: 0,
            cancel: Arc::default(),
            touched: Instant::now(),
            go: None,
            splats: None,
            read_by_one: false,
            bytes: 0,
            writing: Arc::default(),
        }
    }

    /// Who waits, in order.
    pub(super) fn waiting(&self) -> Vec<u64> {
        let queued = self.jobs.values().filter(|j| j.record.state == State::Queued);
        let mut turns: Vec<u64> = queued.map(|j| j.record.turn).collect();
        turns.sort_unstable();
        turns
    }

    pub(super) fn disk(&self) -> u64 {
        self.jobs.values().chain(self.removed.values()).map(|j| j.bytes).sum()
    }
}

impl Job {
    /// Whether nobody is changing it.
    pub(super) fn is_still(&self) -> bool {
        self.writing.try_lock().is_ok()
    }

    /// What changes while it is on its way.
    pub(super) fn status(&self, waiting: &[u64]) -> Value {
        let (r, p) = (&self.record, &self.progress);
        let running = matches!(r.state, State::Running | State::Reading);
        let estimate = self.estimates.back().map(|e| {
            let parts: Vec<_> =
                e.parts.iter().map(|(s, rows)| json!({ "sample": s, "gaussians": rows.len() / ROW })).collect();
            json!({ "number": e.number, "stage": e.stage, "parts": parts })
        });
        json!({
            "id": r.id, "title": r.title, "created": r.created, "state": r.state, "error": r.error,
            "position": waiting.iter().position(|t| *t == r.turn).filter(|_| r.state == State::Queued),
            "stage": running.then_some(p.stage), "sample": p.sample, "done": p.done, "total": p.total, "loss": p.loss,
            "estimate": estimate, "thumbnail": !r.understood.is_null(), "version": self.version,
        })
    }
}

/// Bytes of a Gaussian.
const ROW: usize = 4 * freerange_gaussians::channel::COUNT;

pub(super) fn bytes(cloud: &Gaussians) -> Vec<u8> {
    cloud.rows().iter().flat_map(|v| v.to_le_bytes()).collect()
}
