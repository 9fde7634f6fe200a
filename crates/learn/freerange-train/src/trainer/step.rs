//! One step: gradients of this rank's objects, the sum of all ranks', the change of the weights.

use std::time::Instant;

use burn::tensor::Tensor;
use freerange_gaussians::channel;

use super::{StepReport, Trainer};
use crate::{
    TrainError,
    flat::Flat,
    optimizer::Step,
    ranks::{Agreed, Layout, Own},
    train,
};

/// Losses that are told of a step.
const LOSSES: usize = 4;
/// Decay of the running mean square of the photometric gradient.
pub(super) const GRADIENT_STATISTIC_DECAY: f32 = 0.99;
/// Steps in a row whose loss or gradients are not finite that end a run. Fewer are left out: a batch may be bad, a model
/// that always fails is.
pub(super) const NOT_FINITE_IN_A_ROW: u32 = 5;
/// Steps in a row whose gradients are all zero after which training stops.
pub(super) const NO_GRADIENT_IN_A_ROW: u32 = 20;

/// What the objects of this rank gave in a step.
struct Computed {
    gradients: Flat,
    figures: Tensor<1>, // the losses, and the mean squares of the photometric gradient
    positions: Vec<(usize, u64)>,
    data_seconds: f64,
}

/// What the objects of all ranks gave.
struct Summed {
    gradients: Flat,
    figures: Vec<f32>, // the norm of the gradients, and as in `Computed`
    agreed: Agreed,
    data_seconds: f64, // of this rank
    sum_seconds: Option<f64>,
}

/// The values of a tensor that is small.
fn numbers(t: Tensor<1>) -> Result<Vec<f32>, TrainError> {
    t.into_data().try_to_vec::<f32>().map_err(TrainError::device)
}

impl Trainer {
    /// Takes one step. A step whose loss or gradients are not finite changes no weights.
    ///
    /// After an error, too, [`save`](Self::save) keeps what was reached before it. Where one rank cannot take it, none does.
    ///
    /// # Errors
    /// [`TrainError::Cancelled`] of a single rank where [`interrupt_when`](Self::interrupt_when) said so;
    /// [`TrainError::NotFinite`], on all ranks; those of data and device; [`TrainError::Elsewhere`]; [`TrainError::Ranks`].
    pub fn step(&mut self) -> Result<StepReport, TrainError> {
        let begin = Instant::now();
        let index = self.progress.step;
        let total_steps = self.config.total_steps();
        let computed = self.compute(index);
        let Summed { gradients, figures, agreed, data_seconds, sum_seconds } = match self.ranks.world() {
            1 => self.alone(computed?)?,
            _ => self.summed(computed, begin)?,
        };
        let (&[norm, total, flow, seen, held], square) =
            figures.split_first_chunk().ok_or_else(|| TrainError::device(&figures))?;
        let o = &self.config.optimizer;
        let rate = o.rate(index, total_steps);
        let finite = figures.iter().all(|x| x.is_finite());
        if finite {
            let applied = self.progress.step - self.progress.skipped;
            let step = Step {
                time: applied + 1,
                rate,
                clip: if norm > o.clip { o.clip / norm } else { 1.0 },
                // The average follows closely at first, when the weights still move far.
                ema: o.ema.min((1.0 + applied as f32) / (10.0 + applied as f32)),
            };
            let model = self.model.take().expect("a step gives it back");
            self.model = Some(self.optimizer.step(model, gradients, &mut self.average, o, step));
            self.follow(square);
        }
        let seconds = begin.elapsed().as_secs_f64();
        let p = &mut self.progress;
        p.step += 1;
        p.seconds += seconds;
        p.skipped += u64::from(!finite);
        p.set_positions(agreed.positions);
        p.broken = self.broken + agreed.broken[0];
        self.not_finite = if finite { 0 } else { self.not_finite + 1 };
        if self.not_finite == NOT_FINITE_IN_A_ROW {
            return Err(TrainError::NotFinite { steps: self.not_finite, last: p.step, loss: total, norm });
        }
        self.no_gradient = if norm == 0.0 { self.no_gradient + 1 } else { 0 };
        if self.no_gradient == NO_GRADIENT_IN_A_ROW {
            return Err(TrainError::NoGradient { steps: self.no_gradient, last: self.progress.step });
        }
        Ok(StepReport {
            step: self.progress.step,
            loss: total,
            flow,
            seen,
            held,
            gradient_norm: norm,
            learning_rate: rate,
            seconds,
            data_seconds,
            skipped: self.progress.skipped,
            broken: self.broken + agreed.broken[1],
            rank_seconds: agreed.seconds,
            sum_seconds,
            stop: agreed.stop || (self.ranks.world() == 1 && (self.stop_when)()),
        })
    }

    /// Gradients and figures of this rank's objects in step `index`: means over the parts, each by its share of the batch.
    fn compute(&mut self, index: u64) -> Result<Computed, TrainError> {
        let stage = self.config.stage(index).clone();
        let parts = self.own_parts(&stage);
        let all_parts = stage.parts_per_virtual_rank(self.config.data.virtual_ranks) * self.config.data.virtual_ranks;
        let mut data_seconds = 0.0;
        let rms = Tensor::<1>::from_floats(self.gradient_rms(), &self.device).reshape([1, 1, channel::COUNT]);
        let mut sums: Option<(Flat, Tensor<1>)> = None;
        let mut positions = Vec::new();
        for (i, &part) in parts.iter().enumerate() {
            // Others would wait for the sum: there, the step is finished.
            if self.ranks.world() == 1 && (self.interrupt_when)() {
                return Err(TrainError::Cancelled);
            }
            let begin = Instant::now();
            let batch = match self.ahead.take() {
                Some(batch) => batch?,
                None => self.draw(index, part)?,
            };
            data_seconds += begin.elapsed().as_secs_f64();
            let share = batch.t.len() as f32 / stage.batch as f32;
            // Gone before the optimizer, which changes weights in place that nobody else holds.
            let whole = self.model().clone().put_dinov2(self.frozen.clone());
            let losses = train::step(&whole, batch, &self.photometric, &rms, &self.config.loss, &self.device)?;
            drop(whole);
            let mut figures = vec![losses.total.clone().inner(), losses.flow, losses.seen, losses.held];
            figures.extend(losses.gradient_square);
            let (mut total, mut figures) = (losses.total, Tensor::cat(figures, 0));
            if all_parts > 1 {
                (total, figures) = (total.mul_scalar(share), figures.mul_scalar(share));
            }
            let gradients = Flat::of(&mut total.backward(), self.model());
            sums = Some(match sums {
                None => (gradients, figures),
                Some((sum, before)) => (sum.add(gradients), before + figures),
            });
            // A GPU has only been told by now what to do: the next objects are made ready while it works.
            let begin = Instant::now();
            match parts.get(i + 1) {
                Some(&next) => self.ahead = Some(self.draw(index, next)),
                None => {
                    positions = self
                        .virtual_ranks
                        .iter()
                        .map(|virtual_rank| (virtual_rank.number, virtual_rank.first()))
                        .collect();
                    if index + 1 < self.config.total_steps() {
                        let next = self.own_parts(self.config.stage(index + 1))[0];
                        self.ahead = Some(self.draw(index + 1, next));
                    }
                }
            }
            data_seconds += begin.elapsed().as_secs_f64();
        }
        let (gradients, figures) = sums.expect("a batch has a part");
        Ok(Computed { gradients, figures, positions, data_seconds })
    }

    /// The step of a single rank.
    fn alone(&self, computed: Computed) -> Result<Summed, TrainError> {
        let Computed { mut gradients, figures, positions, data_seconds } = computed;
        // One transfer for all figures: each would wait for the device.
        let figures = numbers(Tensor::cat(vec![gradients.norm(&self.device), figures], 0))?;
        let agreed = Agreed {
            present: Vec::new(),
            seconds: Vec::new(),
            broken: self.unreadable(&positions),
            positions: positions.into_iter().map(|(_, first)| first).collect(),
            stop: false,
            failed: None,
        };
        Ok(Summed { gradients, figures, agreed, data_seconds, sum_seconds: None })
    }

    /// The step of all ranks, from what this one has computed since `begin`, or why it could not.
    fn summed(&self, computed: Result<Computed, TrainError>, begin: Instant) -> Result<Summed, TrainError> {
        let ranks = &*self.ranks;
        let layout = Layout {
            parameters: self.average.0.iter().map(|w| w.dims()[0]).collect(),
            figures: LOSSES + if self.model().dit().gradient_channels() { channel::COUNT } else { 0 },
            world: ranks.world(),
            virtual_ranks: self.config.data.virtual_ranks,
        };
        let computed = computed.and_then(|computed| {
            // Else a device would seem fast that has only been told what to do.
            let synced = self.device.sync();
            synced.map(|()| computed).map_err(TrainError::device)
        });
        let (computed, failure) = match computed {
            Ok(computed) => (Some(computed), None),
            Err(e) => (None, Some(e)),
        };
        let (data_seconds, positions) =
            computed.as_ref().map_or_else(Default::default, |c| (c.data_seconds, c.positions.clone()));
        let own = Own {
            broken: self.unreadable(&positions),
            positions,
            stop: (self.stop_when)(),
            found: computed.map(|c| (c.gradients, c.figures)),
            seconds: begin.elapsed().as_secs_f64(),
        };
        let summing = Instant::now();
        let (mut gradients, tail) = layout.sum(ranks, own, self.config.optimizer.all_reduce_dtype, &self.device)?;
        let mut figures = numbers(Tensor::cat(vec![gradients.norm(&self.device), tail], 0))?;
        let sum_seconds = summing.elapsed().as_secs_f64();
        let agreed = layout.read(&figures.split_off(1 + layout.figures));
        match (failure, agreed.failed) {
            (Some(e), _) => return Err(e),
            (None, Some(rank)) => return Err(TrainError::Elsewhere { rank }),
            (None, None) => {}
        }
        for (gradient, _) in gradients.0.iter_mut().zip(&agreed.present).filter(|(_, present)| !**present) {
            *gradient = None;
        }
        Ok(Summed { gradients, figures, agreed, data_seconds, sum_seconds: Some(sum_seconds) })
    }

    /// Moves the averages after a step that was applied. `square`: the mean square of the gradient's channels in it.
    fn follow(&mut self, square: &[f32]) {
        let applied = (self.progress.step - self.progress.skipped) as f32;
        // The mean of all steps so far until that is long enough to forget the oldest. What an initial checkpoint knows
        // is worth as much from the start.
        let decay = match self.progress.inherited {
            true => GRADIENT_STATISTIC_DECAY,
            false => GRADIENT_STATISTIC_DECAY.min(applied / (applied + 1.0)),
        };
        for (mine, new) in self.progress.gradient_square.iter_mut().zip(square) {
            *mine = decay * *mine + (1.0 - decay) * new;
        }
    }
}
