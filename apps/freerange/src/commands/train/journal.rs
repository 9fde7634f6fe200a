//! What a run tells of itself.

use std::path::Path;

use freerange_train::{
    TrainError,
    events::Events,
    log::Log,
    trainer::{StepReport, Trainer, Validated},
};

use crate::progress::Progress;

/// What a run tells: on the terminal, in log.jsonl, to TensorBoard.
pub struct Journal {
    log: Log,
    events: Events,
    bar: Progress,
}

impl Journal {
    /// That of a run in `folder`.
    pub fn open(folder: &Path, trainer: &Trainer) -> Result<Self, TrainError> {
        let (step, total) = (trainer.step_count(), trainer.config().total_steps());
        let log = Log::open(&folder.join("log.jsonl"), step, trainer.measured())?;
        Ok(Self { log, events: Events::open(folder, step)?, bar: Progress::new("training", total) })
    }

    pub fn step(&mut self, report: &StepReport) -> Result<(), TrainError> {
        self.log.add(report)?;
        self.events.scalars(report.step, "train", report)?;
        self.bar.at(report.step, &line(report));
        Ok(())
    }

    pub fn validated(&mut self, validated: &Validated) -> Result<(), TrainError> {
        self.log.add(validated)?;
        let Validated { step, validation: v, best, .. } = validated;
        self.events.scalars(*step, "validation", v)?;
        for (i, picture) in v.pictures.iter().enumerate() {
            self.events.picture(*step, &format!("validation/sample {i}"), picture)?;
        }
        let best = best.map_or("none".into(), |best| format!("{:.2} dB after {} steps", best.psnr, best.step));
        eprintln!(
            "validation after {step} steps: flow {:.3} held {:.4} PSNR {:.2} dB of {} samples (best {best})",
            v.flow, v.held, v.psnr, v.samples
        );
        Ok(())
    }

    pub fn sync(&mut self) -> Result<(), TrainError> {
        self.log.sync()?;
        self.events.sync()
    }

    pub fn finish(self) {
        self.bar.finish();
    }
}

/// What the progress says of a step.
fn line(report: &StepReport) -> String {
    let StepReport { loss, flow, held, seconds, .. } = report;
    let mut line = format!("loss {loss:.3} flow {flow:.3} held {held:.4} {seconds:.2} s");
    for (count, what) in [(report.skipped, "steps not finite"), (report.broken, "objects unreadable")] {
        if count > 0 {
            line += &format!(", {count} {what}");
        }
    }
    if let Some((rank, waited)) = report.slowest() {
        line += &format!(", rank {rank} slowest, the others waited {waited:.2} s");
    }
    line
}
