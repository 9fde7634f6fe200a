//! A new job, from the first byte of its files on.

use std::{
    fs,
    path::PathBuf,
    time::{SystemTime, UNIX_EPOCH},
};

use serde_json::Value;

use super::{Board, clear, table::Job, uploads};
use crate::{
    JobOptions, Refusal,
    record::{Record, State},
    scene::SceneOptions,
};

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
            let job = self.board.table().jobs.remove(&self.id);
            job.into_iter().for_each(|job| clear(&job.folder));
        }
    }
}

impl Arriving<'_> {
    /// Everything is there: it may be read.
    pub fn submit(
        mut self,
        title: String,
        scene: SceneOptions,
        go: Option<JobOptions>,
        passed_over: Vec<String>,
    ) -> Result<String, Refusal> {
        self.board.change(&self.id, |job| {
            (job.record.title, job.record.scene, job.record.passed_over) = (title, scene, passed_over);
            (job.record.state, job.go) = (State::Reading, go);
            Ok(())
        })?;
        self.submitted = true;
        Ok(std::mem::take(&mut self.id))
    }
}

impl Board {
    /// Makes room for a new job.
    pub fn arrive(&self) -> Result<Arriving<'_>, Refusal> {
        let mut table = self.table();
        if table.jobs.values().filter(|j| j.record.state.is_open()).count() >= self.limits.open_jobs {
            // One that nobody came back to makes way.
            let idle = |j: &&Job| j.record.state == State::Ready && j.touched.elapsed() > self.limits.idle_time;
            let oldest = table.jobs.values().filter(idle).min_by_key(|j| j.touched).map(|j| j.record.id.clone());
            let full = || {
                Refusal::new(429, format!("{} jobs are open, which is all there is room for", self.limits.open_jobs))
            };
            table.forget(&oldest.ok_or_else(full)?);
        }
        let finished = |j: &&Job| !j.record.state.is_open();
        while table.jobs.values().filter(finished).count() >= self.limits.finished_jobs {
            if self.keeps {
                let text = format!(
                    "{} finished jobs are kept, which is all there is room for: remove some",
                    self.limits.finished_jobs
                );
                return Err(Refusal::new(507, text));
            }
            let oldest = table.jobs.values().filter(finished).min_by_key(|j| j.touched).map(|j| j.record.id.clone());
            oldest.iter().for_each(|id| table.forget(id));
        }
        let id = loop {
            let id = format!("{:016x}", rand::random::<u64>());
            if !table.jobs.contains_key(&id) {
                break id;
            }
        };
        let folder = self.root.join(&id);
        // Masks are also looked for some folders above the photos: there has to be nothing else.
        let upload = uploads(&folder).join("0/0/0");
        fs::create_dir_all(&upload).map_err(Refusal::own)?;
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
        let job = table.job(record, folder);
        table.jobs.insert(id.clone(), job);
        Ok(Arriving { board: self, id, upload, submitted: false })
    }
}

fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}
