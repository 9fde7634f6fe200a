//! The training loop: objects in, checkpoints out, resumable at every saved state as if never stopped.

mod among;
mod encoder;
mod folder;
mod objects;
mod open;
mod report;
mod state;
mod step;
#[cfg(test)]
mod tests;
mod virtual_ranks;

use std::{fs::File, ops::ControlFlow, path::PathBuf, rc::Rc};

use burn::{module::Module, tensor::Device};
use freerange_gaussians::channel;
use freerange_model::{Checkpoint, Compute, Dinov2, FreeRange, ModelConfig};

pub use self::{
    among::{Among, Initial},
    report::{Best, StepReport, Validated},
};
use self::{state::Progress, virtual_ranks::VirtualRank};
use crate::{
    TrainError,
    batch::Batch,
    config::TrainConfig,
    optimizer::AdamW,
    ranks::{Ranks, agree, gather},
    validation::{Figures, Validation},
    weights::Weights,
};
use freerange_diffusion::{photometric::Photometric, settings::Settings};

/// A training run in memory.
pub struct Trainer {
    config: TrainConfig,
    described: serde_json::Value, // the configuration, with how objects are made
    device: Device,               // the plain one
    model: Option<FreeRange>,     // without the frozen encoder; none only while the optimizer changes it
    frozen: Option<Dinov2>,
    average: Weights,
    optimizer: AdamW,
    progress: Progress,
    photometric: Photometric,
    ranks: Rc<dyn Ranks>,
    virtual_ranks: Vec<VirtualRank>, // of this rank
    broken: u64,                     // objects before those of all streams that could not be read
    stop_when: Box<dyn Fn() -> bool>,
    interrupt_when: Box<dyn Fn() -> bool>,
    ahead: Option<Result<Batch, TrainError>>, // of the next step
    not_finite: u32,                          // steps in a row
    no_gradient: u32,                         // likewise
    validation: Option<Validation>,
    folder: PathBuf,
    _lock: Option<File>, // of the folder, on rank 0
}

impl Trainer {
    /// Is asked after every step; once it is so on one rank, the step reports it on all of them alike.
    pub fn stop_when(&mut self, enough: impl Fn() -> bool + 'static) {
        self.stop_when = Box::new(enough);
    }

    /// Steps taken so far.
    pub fn step_count(&self) -> u64 {
        self.progress.step
    }

    /// The configuration of the run.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    fn model(&self) -> &FreeRange {
        self.model.as_ref().expect("a step gives it back")
    }

    /// Is asked between the parts of a step and between those of a measurement. Where it is so, they are given up: the step
    /// of a single rank ends with [`TrainError::Cancelled`], a measurement of all ranks is made when the run goes on.
    pub fn interrupt_when(&mut self, at_once: impl Fn() -> bool + 'static) {
        self.interrupt_when = Box::new(at_once);
    }

    /// Whether all steps are taken, and the measurement after the last one is made.
    pub fn is_finished(&self) -> bool {
        self.progress.step == self.config.total_steps() && !self.measurement_is_due()
    }

    /// The step after which the last measurement was made; 0: none was.
    pub fn measured(&self) -> u64 {
        self.progress.measured.unwrap_or(0)
    }

    fn measurement_is_due(&self) -> bool {
        let (step, every) = (self.progress.step, self.config.validation.every);
        self.validation.is_some() && step > self.measured() && step.is_multiple_of(every)
    }

    /// Measures the averaged weights, if that is due after the steps so far; `best.safetensors` are those of the best
    /// measurement. Where a run was saved without a measurement that is due, it is made when the run goes on.
    ///
    /// `Break`: [`interrupt_when`](Self::interrupt_when) said so on a rank, and nothing was measured.
    ///
    /// # Errors
    /// The same as of sampling; [`TrainError::Io`]; [`TrainError::Elsewhere`]; [`TrainError::Ranks`].
    pub fn validate(&mut self) -> Result<ControlFlow<(), Option<Validated>>, TrainError> {
        let Some(validation) = self.validation.as_ref().filter(|_| self.measurement_is_due()) else {
            return Ok(ControlFlow::Continue(None));
        };
        let step = self.progress.step;
        let tracked = self.average.apply(self.model().clone()).put_dinov2(self.frozen.clone());
        let checkpoint = self.checkpoint(self.averaged())?;
        let stage = self.config.stage(step - 1);
        let interrupted = &*self.interrupt_when;
        let own = match validation.measure(&checkpoint, &tracked, &self.config, stage, &self.device, interrupted) {
            Err(TrainError::Cancelled) => Ok(None),
            own => own.map(Some),
        };
        let own = agree(&*self.ranks, own)?;
        let given_up = gather(&*self.ranks, &[u8::from(own.is_none())])?.contains(&vec![1]);
        let Some((own, pictures)) = own.filter(|_| !given_up) else { return Ok(ControlFlow::Break(())) };
        let figures = Figures { pictures, ..Figures::of(&*self.ranks, own)? };
        let found = Best { step, psnr: figures.psnr };
        if found.is_better_than(self.progress.best) {
            let path = self.folder.join("best.safetensors");
            let saved = if self.ranks.rank() == 0 { checkpoint.save(&path) } else { Ok(()) };
            agree(&*self.ranks, saved.map_err(TrainError::from))?;
            self.progress.best = Some(found);
        }
        self.progress.measured = Some(step);
        let best = self.progress.best;
        Ok(ControlFlow::Continue(Some(Validated { step, seen_samples: self.samples(), validation: figures, best })))
    }

    /// The model with the averaged weights. Sampling chooses its own arithmetic.
    fn averaged(&self) -> FreeRange {
        self.average.apply(self.model().clone().valid()).with_compute(Compute::F32).with_recompute(false)
    }

    fn gradient_rms(&self) -> [f32; channel::COUNT] {
        // Before the first step nothing is known: one is as good as any, and the channels are clamped.
        self.progress.gradient_square.map(|x| if x > 0.0 { x.sqrt().max(1e-12) } else { 1.0 })
    }

    /// The averaged weights with everything that sampling needs.
    fn checkpoint(&self, average: FreeRange) -> Result<Checkpoint, TrainError> {
        let stage = self.config.stage(self.progress.step.saturating_sub(1));
        let config = ModelConfig { image_size: stage.image_size, ..self.config.model.architecture() };
        let mut provenance = serde_json::json!({
            "configuration": self.described,
            "steps": self.progress.step,
            "samples": self.samples(),
            "training_seconds": self.progress.seconds,
            "program": concat!("freerange ", env!("CARGO_PKG_VERSION")),
        });
        let settings = Settings {
            network_views: self.config.loss.input_views.1,
            sample: self.config.sample.clone(),
            refiner: self.config.refiner.clone(),
        };
        settings.write(provenance.as_object_mut().expect("just made"));
        Ok(Checkpoint {
            config,
            model: average.put_dinov2(self.frozen.clone()),
            normalization: self.progress.normalization.clone(),
            gradient_rms: self.gradient_rms(),
            depth: stage.depth,
            provenance,
        })
    }

    /// Objects seen so far, counting repetitions.
    fn samples(&self) -> u64 {
        let mut left = self.progress.step;
        self.config.stages.iter().fold(0, |sum, stage| {
            let steps = left.min(stage.steps);
            left -= steps;
            sum + steps * stage.batch as u64
        })
    }
}
