//! Jobs that are removed, and folders that are taken away. Deleting takes as long as the disk does: it is done by a thread of its own, without
//! the lock.

use std::{
    fs,
    path::PathBuf,
    sync::{PoisonError, atomic::Ordering::Relaxed},
    time::Instant,
};

use super::{
    Board, clear, no_such,
    table::{Job, Table},
    uploads,
};
use crate::{Refusal, record::State};

/// Removed jobs that can be had back; the oldest beyond that is gone.
const REMOVED: usize = 100;

impl Board {
    /// Where removed jobs lie until the next start.
    pub(super) fn bin(&self) -> PathBuf {
        self.root.join(".removed")
    }

    /// Has a folder deleted.
    pub(super) fn doom(&self, folder: PathBuf) {
        self.doomed.lock().unwrap_or_else(PoisonError::into_inner).push(folder);
        self.doom_changed.notify_all();
    }

    /// Deletes what is doomed, until the server ends.
    pub fn empty_all(&self) {
        loop {
            let folder = {
                let mut doomed = self.doomed.lock().unwrap_or_else(PoisonError::into_inner);
                loop {
                    if self.stopping.load(Relaxed) {
                        return;
                    }
                    match doomed.pop() {
                        Some(folder) => break folder,
                        None => doomed = self.doom_changed.wait(doomed).unwrap_or_else(PoisonError::into_inner),
                    }
                }
            };
            clear(&folder);
        }
    }

    /// Forgets a job for good.
    pub(super) fn forget(&self, table: &mut Table, id: &str) {
        if let Some(job) = table.jobs.remove(id).or_else(|| table.removed.remove(id)) {
            self.doom(job.folder);
        }
    }

    /// The oldest of the removed jobs.
    fn oldest_removed(table: &Table) -> Option<String> {
        table.removed.values().min_by_key(|j| j.touched).map(|j| j.record.id.clone())
    }

    /// The finished job that was looked at longest ago, and that nobody is changing.
    pub(super) fn oldest_finished(table: &Table) -> Option<String> {
        let finished = table.jobs.values().filter(|j| !j.record.state.is_open() && j.is_still());
        finished.min_by_key(|j| j.touched).map(|j| j.record.id.clone())
    }

    /// Bytes on disk of all jobs, the removed ones among them.
    pub fn disk(&self) -> u64 {
        self.table().disk()
    }

    /// Bytes that job `id` may have on disk, once all that may go has gone ([`Self::make_room`]).
    pub(super) fn room(&self, id: &str) -> u64 {
        let table = self.table();
        let stays = |j: &&Job| j.record.id != id && (self.keeps || j.record.state.is_open());
        let others = table.jobs.values().filter(stays).map(|j| j.bytes).sum();
        self.limits.disk.saturating_sub(others)
    }

    /// Lets go what is more than there is room for.
    pub(super) fn trim(&self) {
        let mut table = self.table();
        if let Err(e) = self.make_room(&mut table, 0) {
            tracing::warn!("{}", e.text);
        }
    }

    /// Makes room on disk: removed jobs go for good, and without a folder to keep them the oldest finished ones.
    pub(super) fn make_room(&self, table: &mut Table, bytes: u64) -> Result<(), Refusal> {
        while table.disk().saturating_add(bytes) > self.limits.disk {
            let next = Self::oldest_removed(table).or_else(|| Self::oldest_finished(table).filter(|_| !self.keeps));
            match next {
                Some(id) => self.forget(table, &id),
                None => {
                    let [used, most, more] = [table.disk(), self.limits.disk, bytes].map(|b| b.div_ceil(1 << 20));
                    let text = format!(
                        "jobs have {used} MB on disk, and these files are {more} MB: {most} MB is all there is room for; remove some"
                    );
                    return Err(Refusal::new(507, text));
                }
            }
        }
        Ok(())
    }

    /// Takes a job away. Until the next start it can be [had back](Self::restore).
    pub fn remove(&self, id: &str) -> Result<(), Refusal> {
        let writing = self.writing(id)?;
        let _one = writing.lock().unwrap_or_else(PoisonError::into_inner);
        let (mut job, old) = {
            let mut table = self.table();
            let state = table.jobs.get(id).ok_or_else(no_such)?.record.state;
            if matches!(state, State::Uploading | State::Reading | State::Running) {
                return Err(Refusal::new(409, format!("this job is {}: cancel it first", state.name())));
            }
            let old = (table.removed.len() >= REMOVED).then(|| Self::oldest_removed(&table)).flatten();
            let old = old.and_then(|id| table.removed.remove(&id));
            let job = table.jobs.remove(id).ok_or_else(no_such)?;
            self.changed.notify_all();
            (job, old)
        };
        old.into_iter().for_each(|old| self.doom(old.folder));
        let aside = self.bin().join(id);
        if let Err(e) = fs::create_dir_all(self.bin()).and_then(|()| fs::rename(&job.folder, &aside)) {
            tracing::warn!("{}: {e}", job.folder.display());
            self.doom(job.folder);
            return Ok(());
        }
        (job.folder, job.touched) = (aside, Instant::now());
        job.estimates.clear();
        self.table().removed.insert(id.to_owned(), job);
        Ok(())
    }

    /// Brings a removed job back.
    pub fn restore(&self, id: &str) -> Result<(), Refusal> {
        let mut job = {
            let mut table = self.table();
            let job = table.removed.get(id).ok_or_else(|| Refusal::new(404, "there is no such job to bring back"))?;
            let open = job.record.state.is_open();
            let alike = table.jobs.values().filter(|j| j.record.state.is_open() == open).count();
            let most = if open { self.limits.open_jobs } else { self.limits.finished_jobs };
            if alike >= most {
                return Err(Refusal::new(
                    507,
                    format!("{alike} jobs are there, which is all there is room for: remove some"),
                ));
            }
            table.removed.remove(id).ok_or_else(no_such)?
        };
        let back = self.root.join(id);
        if let Err(e) = fs::rename(&job.folder, &back) {
            self.doom(job.folder);
            return Err(Refusal::own(e));
        }
        clear(&uploads(&back));
        job.folder = back;
        let mut table = self.table();
        (job.version, job.touched) = (table.next_version(), Instant::now());
        table.jobs.insert(id.to_owned(), job);
        self.changed.notify_all();
        Ok(())
    }
}
