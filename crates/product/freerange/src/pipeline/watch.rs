//! Progress of the pipeline: what its steps report, what ends them, how long they take.

use std::{ops::ControlFlow, time::Instant};

use freerange_gaussians::Gaussians;
use freerange_optim::{FitError, FitProgress};
use freerange_scene::camera::Similarity;

use crate::{Error, Progress, Stage, error::Lift, progress::Preview};

/// Hands reports to the caller's callback.
pub(crate) struct Watch<'a> {
    progress: &'a mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>,
    /// Number of the sample that is worked on.
    pub sample: usize,
    /// Seconds per stage, in order.
    pub seconds: Vec<(Stage, f64)>,
}

impl<'a> Watch<'a> {
    pub fn new(progress: &'a mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>) -> Self {
        Self { progress, sample: 0, seconds: Vec::new() }
    }

    /// Reports that `done` of `total` steps of a stage are done.
    ///
    /// # Errors
    /// [`Error::Cancelled`] where the caller ends the work.
    pub fn report(
        &mut self,
        stage: Stage,
        [done, total]: [usize; 2],
        loss: Option<f64>,
        preview: Option<(Preview<'_>, &Similarity)>,
    ) -> Result<(), Error> {
        let progress = Progress { stage, sample: self.sample, done, total, loss, preview };
        match (self.progress)(&progress) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(Error::Cancelled),
        }
    }

    /// Does a step of the pipeline and adds its time to that of its stage.
    pub fn timed<T>(&mut self, stage: Stage, step: impl FnOnce(&mut Self) -> Result<T, Error>) -> Result<T, Error> {
        let begin = Instant::now();
        let done = step(self)?;
        let seconds = begin.elapsed().as_secs_f64();
        match self.seconds.iter_mut().find(|(known, _)| *known == stage) {
            Some((_, sum)) => *sum += seconds,
            None => self.seconds.push((stage, seconds)),
        }
        Ok(done)
    }

    /// A fit whose steps are reported with its state, as the first ones of `total`.
    pub fn fit(
        &mut self,
        stage: Stage,
        total: usize,
        canonical_from_user: &Similarity,
        fit: impl FnOnce(&mut dyn FnMut(&FitProgress<'_>) -> ControlFlow<()>) -> Result<Gaussians, FitError>,
    ) -> Result<Gaussians, Error> {
        self.report(stage, [0, total], None, None)?;
        let mut stopped = Ok(());
        let cloud = fit(&mut |p| {
            let preview = Some((Preview::Fit(p.cloud), canonical_from_user));
            stopped = self.report(stage, [p.step, total], Some(p.loss), preview);
            flow(&stopped)
        });
        stopped?;
        cloud.lift()
    }
}

/// Whether work goes on after a report.
pub(crate) fn flow(reported: &Result<(), Error>) -> ControlFlow<()> {
    if reported.is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
}
