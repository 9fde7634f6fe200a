//! What clients ask for.

use std::sync::{Arc, PoisonError, atomic::Ordering::Relaxed};

use super::{Board, no_such, table::Progress, uploads};
use crate::{JobOptions, Refusal, record::State, scene};

/// Most characters of a title.
const TITLE: usize = 120;

impl Board {
    /// Lets a job compute.
    pub fn go(&self, id: &str, options: JobOptions) -> Result<(), Refusal> {
        options.check().map_err(|e| Refusal::new(422, e))?;
        let options = self.complete(options);
        let turn = {
            let mut table = self.table();
            table.turns += 1;
            let open = table.jobs.values().filter(|j| j.record.state.is_open() && j.record.id != id).count();
            if open >= self.limits.open_jobs {
                return Err(Refusal::new(429, format!("{open} jobs are open, which is the limit")));
            }
            table.turns
        };
        self.change(id, |job| {
            if !job.record.state.may_go() {
                return Err(Refusal::new(409, format!("this job is {}", job.record.state.name())));
            }
            if !scene::is_whole(&job.folder) {
                return Err(Refusal::new(409, "the photos of this job are not there: give them again"));
            }
            (job.record.state, job.record.options, job.record.turn) = (State::Queued, options, turn);
            job.record.error = None;
            job.progress = Progress::default();
            job.estimates.clear();
            // The flag of an earlier run, which may still see it, stays set.
            job.cancel = Arc::default();
            Ok(())
        })
    }

    /// Stops a job. Whoever computes it hears of it at the next step.
    pub fn cancel(&self, id: &str) -> Result<(), Refusal> {
        let mut unread = None;
        self.change(id, |job| {
            match job.record.state {
                // Whoever reads it ends at the next photo, and clears its files away.
                State::Reading if job.read_by_one => {}
                State::Reading => unread = Some(uploads(&job.folder)),
                State::Queued | State::Running => {}
                state => return Err(Refusal::new(409, format!("this job is {}", state.name()))),
            }
            job.record.state = State::Cancelled;
            job.cancel.store(true, Relaxed);
            job.estimates.clear();
            self.metrics.ended(State::Cancelled.name());
            Ok(())
        })?;
        unread.into_iter().for_each(|folder| self.doom(folder));
        Ok(())
    }

    /// Gives a job another title.
    pub fn rename(&self, id: &str, title: &str) -> Result<(), Refusal> {
        let title = title.trim();
        if title.is_empty() || title.chars().count() > TITLE || title.chars().any(char::is_control) {
            return Err(Refusal::new(422, format!("title: expected 1 to {TITLE} characters in one line")));
        }
        self.change(id, |job| {
            job.record.title = title.to_owned();
            Ok(())
        })
    }

    /// Gives a photo another mask.
    pub fn edit_mask(&self, id: &str, k: usize, png: &[u8]) -> Result<f64, Refusal> {
        // One at a time: pictures take memory, and files are replaced.
        let _one = self.editing.lock().unwrap_or_else(PoisonError::into_inner);
        let folder = {
            let table = self.table();
            let job = table.jobs.get(id).ok_or_else(no_such)?;
            if !job.record.state.may_go() || !scene::is_whole(&job.folder) {
                return Err(Refusal::new(
                    409,
                    format!("this job is {}: its masks cannot be changed now", job.record.state.name()),
                ));
            }
            if job.record.understood["views"].get(k).is_none() {
                return Err(Refusal::new(404, "there is no such photo"));
            }
            job.folder.clone()
        };
        let covers = scene::edit_mask(&folder, k, png)?;
        self.change(id, |job| {
            let view = &mut job.record.understood["views"][k];
            (view["edited"], view["covers"]) = (true.into(), covers.into());
            Ok(covers)
        })
    }
}
