//! What clients ask for.

use std::sync::{Arc, PoisonError, atomic::Ordering::Relaxed};

use super::{Board, clear, no_such, table::Progress, uploads};
use crate::{JobOptions, Refusal, record::State, scene};

impl Board {
    /// Lets a job compute.
    pub fn go(&self, id: &str, options: JobOptions) -> Result<(), Refusal> {
        options.check().map_err(|e| Refusal::new(422, e))?;
        let turn = {
            let mut table = self.table();
            table.turns += 1;
            let open = table.jobs.values().filter(|j| j.record.state.is_open() && j.record.id != id).count();
            if open >= self.limits.open_jobs {
                return Err(Refusal::new(429, format!("{open} jobs are open, which is all there is room for")));
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
        // Nobody reads these photos any more, unless someone is at it: then what comes of it is not looked at.
        unread.iter().for_each(|folder| clear(folder));
        Ok(())
    }

    /// Forgets a job, and what lies on disk of it.
    pub fn remove(&self, id: &str) -> Result<(), Refusal> {
        let mut table = self.table();
        let job = table.jobs.get(id).ok_or_else(no_such)?;
        if matches!(job.record.state, State::Uploading | State::Reading | State::Running) {
            return Err(Refusal::new(409, format!("this job is {}: cancel it first", job.record.state.name())));
        }
        table.forget(id);
        self.changed.notify_all();
        Ok(())
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
