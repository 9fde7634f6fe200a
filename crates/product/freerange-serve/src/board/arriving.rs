//! A new job, from the first byte of its files on.

use std::{
    fs,
    path::PathBuf,
    time::{SystemTime, UNIX_EPOCH},
};

use serde_json::Value;

use super::{Board, table::Job, uploads};
use crate::{
    JobOptions, Refusal,
    record::{Record, State},
    scene::SceneOptions,
};

/// What a client has sent.
pub struct Submission {
    pub title: String,
    pub scene: SceneOptions,
    /// Computed as soon as it is read.
    pub go: Option<JobOptions>,
    /// A file of Gaussians instead of photos.
    pub splats: Option<PathBuf>,
    /// Files of no use.
    pub passed_over: Vec<String>,
    /// Bytes on disk.
    pub bytes: u64,
}

/// A job whose files are on their way; it is gone unless it is submitted.
pub struct Arriving<'b> {
    board: &'b Board,
    pub id: String,
    /// Where files go.
    pub upload: PathBuf,
    submitted: bool,
}

impl Drop for Arriving<'_> {
    fn drop(&mut self) {
        if !self.submitted {
            let mut table = self.board.table();
            self.board.forget(&mut table, &self.id);
        }
    }
}

impl Arriving<'_> {
    /// Everything is there: it may be read.
    pub fn submit(mut self, submission: Submission) -> Result<String, Refusal> {
        let Submission { title, scene, go, splats, passed_over, bytes } = submission;
        self.board.change(&self.id, |job| {
            (job.record.title, job.record.scene, job.record.passed_over) = (title, scene, passed_over);
            (job.record.state, job.go, job.splats, job.bytes) = (State::Reading, go, splats, bytes);
            Ok(())
        })?;
        self.submitted = true;
        Ok(std::mem::take(&mut self.id))
    }
}

impl Board {
    /// Makes room for a new job of so many bytes.
    pub fn arrive(&self, bytes: u64) -> Result<Arriving<'_>, Refusal> {
        let mut table = self.table();
        if table.jobs.values().filter(|j| j.record.state.is_open()).count() >= self.limits.open_jobs {
            // One that nobody came back to makes way.
            let idle = |j: &&Job| {
                j.record.state == State::Ready && j.touched.elapsed() > self.limits.idle_time && j.is_still()
            };
            let oldest = table.jobs.values().filter(idle).min_by_key(|j| j.touched).map(|j| j.record.id.clone());
            let full = || Refusal::new(429, format!("{} jobs are open, which is the limit", self.limits.open_jobs));
            self.forget(&mut table, &oldest.ok_or_else(full)?);
        }
        let finished = |j: &&Job| !j.record.state.is_open();
        while table.jobs.values().filter(finished).count() >= self.limits.finished_jobs {
            if self.keeps {
                let text =
                    format!("{} finished jobs are kept, which is the limit: remove some", self.limits.finished_jobs);
                return Err(Refusal::new(507, text));
            }
            match Self::oldest_finished(&table) {
                Some(id) => self.forget(&mut table, &id),
                None => break,
            }
        }
        self.make_room(&mut table, bytes)?;
        let id = loop {
            let id = format!("{:016x}", rand::random::<u64>());
            if !table.jobs.contains_key(&id) && !table.removed.contains_key(&id) {
                break id;
            }
        };
        let folder = self.root.join(&id);
        // Masks are also looked for some folders above the photos: there has to be nothing else.
        let upload = uploads(&folder).join("0/0/0");
        table.turns += 1;
        let record = Record {
            id: id.clone(),
            title: String::new(),
            created: now(),
            state: State::Uploading,
            error: None,
            scene: SceneOptions::default(),
            options: JobOptions::default(),
            turn: table.turns,
            understood: Value::Null,
            passed_over: Vec::new(),
            samples: Vec::new(),
            up: [0.0, 0.0, 1.0],
            notes: Vec::new(),
            seconds: Vec::new(),
        };
        let mut job = table.job(record, folder);
        job.bytes = bytes;
        table.jobs.insert(id.clone(), job);
        drop(table);
        let arriving = Arriving { board: self, id, upload, submitted: false };
        fs::create_dir_all(&arriving.upload).map_err(Refusal::own)?;
        Ok(arriving)
    }
}

fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}
