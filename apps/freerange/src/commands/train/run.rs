//! The steps of a run, with measurements and saved states between them.

use std::ops::ControlFlow;

use freerange_train::{TrainError, trainer::Trainer};

use super::{interrupt::Interrupt, journal::Journal};

/// A run under way.
pub struct Run<'a> {
    trainer: &'a mut Trainer,
    journal: Option<Journal>, // of rank 0
    interrupt: &'a Interrupt,
    save_every: u64,
    unsaved: bool,
    unwritten: Option<TrainError>, // why the journal cannot be written
}

impl<'a> Run<'a> {
    pub fn new(trainer: &'a mut Trainer, journal: Option<Journal>, interrupt: &'a Interrupt, save_every: u64) -> Self {
        Self { trainer, journal, interrupt, save_every, unsaved: false, unwritten: None }
    }

    /// Goes on to the last step, or until asked to end, and saves what was reached, also where something fails.
    ///
    /// # Errors
    /// The first thing that failed.
    pub fn go_on(&mut self) -> Result<(), TrainError> {
        let ended = self.advance();
        self.interrupt.heard();
        if matches!(ended, Err(TrainError::Ranks { .. })) {
            return ended;
        }
        let saved = self.save();
        if ended.is_err() && self.journal.is_some() {
            match &saved {
                Ok(()) => eprintln!("saved step {}", self.trainer.step_count()),
                Err(e) => eprintln!("{e}"),
            }
        }
        self.unwritten.take().map_or(ended, Err).and(saved)
    }

    /// Ends the progress bar.
    pub fn finish(self) {
        if let Some(journal) = self.journal {
            journal.finish();
        }
    }

    fn advance(&mut self) -> Result<(), TrainError> {
        let total = self.trainer.config().total_steps();
        loop {
            // The measurement of the step that a run was asked to end after comes first when it goes on.
            let ControlFlow::Continue(validated) = self.trainer.validate()? else { return Ok(()) };
            if let Some(validated) = validated {
                self.unsaved = true;
                self.write(|journal| journal.validated(&validated));
            }
            if self.trainer.step_count() == total {
                return Ok(());
            }
            if self.trainer.step_count().is_multiple_of(self.save_every) {
                self.save()?;
            }
            let report = match self.trainer.step() {
                Err(TrainError::Cancelled) => return Ok(()),
                report => report?,
            };
            self.unsaved = true;
            self.interrupt.stepped(report.seconds);
            self.write(|journal| journal.step(&report));
            // What is over after the last step is over anyway.
            if report.stop && report.step < total {
                return Ok(());
            }
        }
    }

    /// Saves what has changed.
    fn save(&mut self) -> Result<(), TrainError> {
        if self.unsaved {
            // First, so that the log has every step of the state.
            self.write(Journal::sync);
            self.trainer.save()?;
            self.unsaved = false;
        }
        Ok(())
    }

    /// Writes into the journal, if there is one. Other ranks hear that it could not be written with the next step: all end
    /// with a saved state.
    fn write(&mut self, what: impl FnOnce(&mut Journal) -> Result<(), TrainError>) {
        if let Some(Err(e)) = self.journal.as_mut().map(what) {
            self.interrupt.end();
            self.unwritten.get_or_insert(e);
        }
    }
}
