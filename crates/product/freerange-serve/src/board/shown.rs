//! What clients are shown.

use std::{
    collections::BTreeMap,
    path::PathBuf,
    sync::{Arc, PoisonError, atomic::Ordering::Relaxed},
    time::{Duration, Instant},
};

use freerange_gaussians::formats::Format;
use serde_json::{Value, json};

use super::{Board, no_such, table::Job};
use crate::{Refusal, record::State, scene};

impl Board {
    /// What is known of a job, for clients.
    pub fn get(&self, id: &str) -> Result<Value, Refusal> {
        let mut table = self.table();
        let waiting = table.waiting();
        let job = table.jobs.get_mut(id).filter(|j| j.record.state != State::Uploading).ok_or_else(no_such)?;
        job.touched = Instant::now();
        let mut value = job.status(&waiting);
        let r = &job.record;
        let more = json!({
            "understood": r.understood, "options": r.options, "passed_over": r.passed_over, "notes": r.notes, "seconds": r.seconds,
            "samples": r.samples, "up": r.up, "may_go": r.state.may_go() && scene::is_whole(&job.folder),
            "formats": Format::ALL.map(|f| f.extension()),
        });
        if let (Some(fields), Value::Object(mut more)) = (value.as_object_mut(), more) {
            fields.append(&mut more);
        }
        Ok(value)
    }

    /// All jobs, latest first.
    pub fn list(&self) -> Value {
        let table = self.table();
        let waiting = table.waiting();
        let mut jobs: Vec<&Job> = table.jobs.values().filter(|j| j.record.state != State::Uploading).collect();
        jobs.sort_by_key(|j| std::cmp::Reverse((j.record.created, j.record.turn)));
        jobs.iter().map(|j| j.status(&waiting)).collect()
    }

    /// Number of jobs by state.
    pub fn counts(&self) -> BTreeMap<&'static str, usize> {
        let mut counts = BTreeMap::new();
        for state in [
            State::Reading,
            State::Ready,
            State::Queued,
            State::Running,
            State::Done,
            State::Failed,
            State::Cancelled,
            State::Interrupted,
        ] {
            counts.insert(state.name(), 0);
        }
        self.table().jobs.values().for_each(|j| *counts.entry(j.record.state.name()).or_default() += 1);
        counts
    }

    /// Waits until something about the job is newer than `version`; its version and status then, or none after `most`.
    pub fn wait(&self, id: &str, version: u64, most: Duration) -> Result<Option<(u64, Value)>, Refusal> {
        let deadline = Instant::now() + most;
        let mut table = self.table();
        loop {
            if self.stopping.load(Relaxed) {
                return Err(Refusal::new(503, "the server ends"));
            }
            let job = table.jobs.get(id).ok_or_else(no_such)?;
            if job.version > version {
                return Ok(Some((job.version, job.status(&table.waiting()))));
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            table = self.changed.wait_timeout(table, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// The folder of a job, to read from.
    pub fn folder(&self, id: &str) -> Result<PathBuf, Refusal> {
        let table = self.table();
        Ok(table.jobs.get(id).filter(|j| j.record.state != State::Uploading).ok_or_else(no_such)?.folder.clone())
    }

    /// Rows of the Gaussians of an estimate.
    pub fn estimate(&self, id: &str, number: u64, sample: usize) -> Result<Arc<Vec<u8>>, Refusal> {
        let table = self.table();
        let job = table.jobs.get(id).ok_or_else(no_such)?;
        let estimate = job.estimates.iter().find(|e| e.number == number);
        let gone = if number <= job.published { 410 } else { 404 };
        let estimate =
            estimate.ok_or_else(|| Refusal::new(gone, "this estimate is not there: there are later ones"))?;
        let part = estimate.parts.iter().find(|(s, _)| *s == sample);
        part.map(|(_, rows)| rows.clone()).ok_or_else(|| Refusal::new(404, "this estimate has no such sample"))
    }
}
