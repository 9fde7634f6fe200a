//! The training loop: objects in, checkpoints out, resumable at every saved state as if never stopped.

use std::{
    collections::VecDeque,
    path::{Path, PathBuf},
    rc::Rc,
    sync::Arc,
    time::Instant,
};

use burn::{
    module::Module,
    store::ModuleRecord,
    tensor::{Device, Tensor},
};
use freerange_build::Generated;
use freerange_core::{sha256, sync_folder, sync_tree};
use freerange_data::{Object, ObjectSource, Shards, Split, Store, Stream};
use freerange_model::{Checkpoint, Compute, Dinov2, EncoderConfig, FreeRange, ModelConfig, WeightsOrigin};
use freerange_splat::{Normalization, Statistics, channel};
use rand::seq::index::sample as sample_indices;

use crate::{
    FlowError,
    batch::{Batch, part_rng, step_rng},
    config::{DataConfig, Stage, TrainConfig},
    inherit::is_path,
    optimizer::{AdamW, Flat, Step},
    photometric::Photometric,
    ranks::{Agreed, Layout, Own, Ranks, Single, agree, from_first, same_on_all, tensor_of_first},
    train,
    validation::{Figures, Validation},
    weights::Weights,
};

/// Losses that are told of a step.
const LOSSES: usize = 4;
/// Decay of the running mean square of the photometric gradient.
const GRADIENT_STATISTIC_DECAY: f32 = 0.99;
/// Steps in a row whose loss or gradients are not finite that end a run. Fewer are left out: a batch may be bad, a model
/// that always fails is.
const NOT_FINITE_IN_A_ROW: u32 = 5;

/// What is reported after a step.
#[derive(Clone, Debug, serde::Serialize)]
pub struct StepReport {
    /// Steps taken so far, this one included.
    pub step: u64,
    /// Total loss.
    pub loss: f32,
    /// Flow-matching term.
    pub flow: f32,
    /// L1 over input views.
    pub seen: f32,
    /// L1 over held-out views.
    pub held: f32,
    /// Norm of the gradients before clipping.
    pub gradient_norm: f32,
    /// Learning rate.
    pub learning_rate: f64,
    /// Seconds that the step took.
    pub seconds: f64,
    /// Of these, seconds spent waiting for objects and making tensors of them (for the next step; a GPU works meanwhile).
    pub data_seconds: f64,
    /// Steps so far whose loss or gradients were not finite: they changed nothing.
    pub skipped: u64,
    /// Objects so far that could not be read.
    pub broken: u64,
    /// Seconds that each of several ranks had worked when it began to wait for the others.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub rank_seconds: Vec<f32>,
    /// Seconds that this rank of several spent on the sum, its wait for the slowest included.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sum_seconds: Option<f64>,
    /// Whether [`Trainer::stop_at`] has come, on any rank.
    #[serde(skip)]
    pub out_of_time: bool,
}

impl StepReport {
    /// The rank that the others waited for, and for how many seconds they did on average; none of a single rank.
    pub fn slowest(&self) -> Option<(usize, f32)> {
        let (rank, most) = self.rank_seconds.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1))?;
        let others = self.rank_seconds.len().checked_sub(1).filter(|&n| n > 0)?;
        let waited: f32 = self.rank_seconds.iter().map(|s| most - s).sum();
        Some((rank, waited / others as f32))
    }
}

/// What is reported after a measurement on objects that training does not see.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Validated {
    /// Steps taken so far.
    pub step: u64,
    /// Samples seen so far.
    pub seen_samples: u64,
    /// What was measured.
    pub validation: Figures,
    /// The best measurement so far, this one included, which `best.safetensors` is of.
    pub best: Best,
}

/// The best measurement of a run.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Best {
    /// Steps taken by then.
    pub step: u64,
    /// [`Figures::psnr`].
    pub psnr: f64,
}

/// The part of the state that is neither weights nor optimiser.
#[derive(Clone, Debug, serde::Serialize, serde::Deserialize)]
struct Progress {
    step: u64,
    seconds: f64,
    gradient_square: [f32; channel::COUNT],
    /// Whether the mean square of the gradient began with that of other weights.
    #[serde(default)]
    inherited: bool,
    normalization: Normalization,
    /// Number of the first object of the window that the next batch is drawn from; none where there are several lanes.
    #[serde(default)]
    first_object: Option<u64>,
    /// That number in each of several lanes.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    first_objects: Vec<u64>,
    /// Objects before it that could not be read.
    #[serde(default)]
    broken: u64,
    /// Steps whose loss or gradients were not finite.
    #[serde(default)]
    skipped: u64,
    /// The best measurement so far.
    #[serde(default)]
    best: Option<Best>,
    /// The frozen encoder's weights; none of an encoder of its own, or of random ones.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    encoder: Option<WeightsOrigin>,
}

impl Progress {
    /// Of each lane, the number of the first object of its window.
    fn positions(&self, data: &DataConfig) -> Result<Vec<u64>, String> {
        match (data.lanes, self.first_objects.len()) {
            (1, 0) => Ok(vec![self.first_object.unwrap_or(self.step * data.fresh as u64)]),
            (lanes, 0) if self.step == 0 => Ok((0..lanes as u64).collect()),
            (lanes, found) if lanes == found => Ok(self.first_objects.clone()),
            (lanes, found) => {
                Err(format!("first_objects: expected {lanes}, one for each of data.lanes, found {found}"))
            }
        }
    }

    fn set_positions(&mut self, positions: Vec<u64>) {
        match positions[..] {
            [only] => self.first_object = Some(only),
            _ => (self.first_object, self.first_objects) = (None, positions),
        }
    }
}

/// Published weights of a frozen encoder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EncoderWeights {
    /// What they are known by: see [`Dinov2Config::weights`](freerange_model::Dinov2Config::weights).
    pub name: String,
    /// Where they lie.
    pub folder: PathBuf,
}

/// Weights that a new run starts from.
#[derive(Clone, Copy, Debug)]
pub struct Initial<'a> {
    /// The weights, of the same architecture.
    pub checkpoint: &'a Checkpoint,
    /// Normalise Gaussians by the statistics of the run's own data, not by the checkpoint's: for data that
    /// are made in another way, such as fits instead of points on the surface.
    pub remeasure: bool,
}

/// The processes that share a run.
#[derive(Clone)]
pub struct Among {
    /// All of them.
    pub ranks: Rc<dyn Ranks>,
    /// Names and values of what has to be the same on all ranks, besides configuration, data and encoder: such as the program.
    pub identity: Vec<(String, String)>,
}

impl Among {
    /// One process alone.
    pub fn single() -> Self {
        Self { ranks: Rc::new(Single), identity: Vec::new() }
    }
}

/// The objects of a lane that this rank works on.
struct Lane {
    number: usize,
    stream: Stream,
    window: VecDeque<(u64, Arc<Object>)>, // with their numbers
}

impl Lane {
    fn first(&self) -> u64 {
        self.window.front().map_or(0, |(number, _)| *number)
    }
}

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
fn numbers(t: Tensor<1>) -> Result<Vec<f32>, FlowError> {
    t.into_data().try_to_vec::<f32>().map_err(|_| FlowError::NoGradient)
}

/// A training run in memory.
pub struct Trainer {
    config: TrainConfig,
    device: Device,           // the plain one
    model: Option<FreeRange>, // without the frozen encoder; none only while the optimiser changes it
    frozen: Option<Dinov2>,
    average: Weights,
    optimizer: AdamW,
    progress: Progress,
    photometric: Photometric,
    ranks: Rc<dyn Ranks>,
    lanes: Vec<Lane>, // of this rank
    broken: u64,      // objects before those of all streams that could not be read
    stop_at: Option<Instant>,
    ahead: Option<Result<Batch, FlowError>>, // of the next step
    not_finite: u32,                         // steps in a row
    validation: Option<Validation>,
    folder: PathBuf,
}

impl Trainer {
    /// Starts a run in `folder`, or goes on with the one that is there.
    ///
    /// `initial`: weights to start a new run from; ignored by a run that goes on.
    ///
    /// # Errors
    /// Settings, data or a state that cannot be used; a frozen encoder without weights.
    pub fn open(
        config: TrainConfig,
        folder: &Path,
        initial: Option<Initial>,
        device: &Device,
        progress: impl FnMut(&str),
    ) -> Result<Self, FlowError> {
        Self::open_with(config, folder, initial, None, device, progress)
    }

    /// [`open`](Self::open) with the weights of a frozen encoder.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn open_with(
        config: TrainConfig,
        folder: &Path,
        initial: Option<Initial>,
        encoder: Option<&EncoderWeights>,
        device: &Device,
        progress: impl FnMut(&str),
    ) -> Result<Self, FlowError> {
        Self::open_among(Among::single(), config, folder, initial, encoder, device, progress)
    }

    /// [`open_with`](Self::open_with) on several ranks, all of which must call it. Only rank 0 reads and writes the folder, and
    /// only its `initial` matters.
    ///
    /// # Errors
    /// As [`open`](Self::open); [`FlowError::Differs`]; [`FlowError::Elsewhere`] where another rank has one of these.
    pub fn open_among(
        among: Among,
        config: TrainConfig,
        folder: &Path,
        initial: Option<Initial>,
        encoder: Option<&EncoderWeights>,
        device: &Device,
        mut progress: impl FnMut(&str),
    ) -> Result<Self, FlowError> {
        let Among { ranks: among_ranks, identity } = among;
        let ranks = &*among_ranks;
        let (rank, world) = (ranks.rank(), ranks.world());
        let plain = device.clone().inner();
        let tracked = plain.clone().autodiff();
        let prepared = agree(ranks, Prepared::new(&config, initial, encoder, [rank, world], &plain, &mut progress))?;
        let Prepared { source, validation, encoder, origin, manifest } = prepared;
        if world > 1 {
            let encoder = origin.as_ref().map_or("none".into(), |origin| origin.sha256.clone());
            let own = [("configuration", fingerprint(&config)), ("data", manifest), ("encoder weights", encoder)];
            let own = own.map(|(what, value)| (what.to_owned(), value));
            same_on_all(ranks, &[identity, own.to_vec()].concat())?;
        }
        let compute = compute_of_first(ranks, config.optimizer.compute, &plain)?;
        let own_folder = || {
            // Not before the data are there: a folder that holds a configuration belongs to a run.
            std::fs::create_dir_all(folder).map_err(|source| FlowError::Io { path: folder.into(), source })?;
            check_same_run(&config, folder)
        };
        agree(ranks, if rank == 0 { own_folder() } else { Ok(()) })?;
        let model = || {
            let mut model = FreeRange::new(&config.model, &mut step_rng(config.seed, u64::MAX), &tracked)?;
            if let Some(encoder) = encoder {
                model = model.with_dinov2(&config.model, encoder)?;
            }
            // States and averages are of what is trained.
            Ok(model.with_compute(compute).with_recompute(config.optimizer.recompute).take_dinov2())
        };
        let (model, frozen) = agree(ranks, model())?;
        let begin = || match latest_state(folder)? {
            Some(path) => {
                progress(&format!("continuing from {}", path.display()));
                State::load(&path, model.clone(), origin.as_ref(), &plain)
            }
            None => {
                let normalization = normalization(&config, initial, source.as_ref(), &mut progress)?;
                Ok(State::begin(model.clone(), initial, normalization, origin))
            }
        };
        let state = agree(ranks, if rank == 0 { begin().map(Some) } else { Ok(None) })?;
        let State { model, average, optimizer, progress: mut state } = match state {
            Some(state) if world == 1 => state,
            state => State::of_first(ranks, state, model)?,
        };
        let positions = state
            .positions(&config.data)
            .map_err(|problem| FlowError::State { path: folder.join("progress.json"), problem })?;
        progress(&format!("filling the window with {} objects", config.data.window));
        let lanes = agree(ranks, lanes(&config.data, &positions, [rank, world], &source))?;
        state.set_positions(positions);
        Ok(Self {
            photometric: Photometric::new(&state.normalization, &plain),
            config,
            device: plain,
            model: Some(model),
            frozen,
            average,
            optimizer,
            broken: state.broken,
            progress: state,
            ranks: among_ranks,
            lanes,
            stop_at: None,
            ahead: None,
            not_finite: 0,
            validation,
            folder: folder.into(),
        })
    }

    /// Steps after this time report that it is over, on all ranks alike.
    pub fn stop_at(&mut self, time: Instant) {
        self.stop_at = Some(time);
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

    /// The parts of a step's batch that this rank computes: those of its lanes, one lane after the other.
    fn own_parts(&self, stage: &Stage) -> Vec<usize> {
        let count = stage.parts_per_lane(self.config.data.lanes);
        self.lanes.iter().flat_map(|lane| lane.number * count..(lane.number + 1) * count).collect()
    }

    /// Part `part` of the batch of step `index`, which must be this rank's first or follow the one before.
    fn draw(&mut self, index: u64, part: usize) -> Result<Batch, FlowError> {
        let (stage, data) = (self.config.stage(index), &self.config.data);
        let per_lane = stage.parts_per_lane(data.lanes);
        let (lane, chunk) = (part / per_lane, part % per_lane);
        let lane = self.lanes.iter_mut().find(|l| l.number == lane).expect("a lane of this rank");
        // Which objects the lane takes is drawn where its first part draws the rest.
        let mut rng = part_rng(step_rng(self.config.seed, index), part - chunk);
        let (count, batch) = (lane.window.len(), stage.batch / data.lanes);
        let chosen: Vec<Arc<Object>> = match batch <= count {
            true => sample_indices(&mut rng, count, batch).into_iter().map(|i| lane.window[i].1.clone()).collect(),
            false => (0..batch).map(|i| lane.window[i % count].1.clone()).collect(),
        };
        let chosen = chosen.chunks(stage.at_a_time()).nth(chunk).expect("a part of the batch");
        let model_config = ModelConfig { image_size: stage.image_size, ..self.config.model.clone() };
        let loss = &self.config.loss;
        let mut rng = if chunk > 0 { part_rng(rng, part) } else { rng };
        let batch =
            Batch::draw(chosen, stage, &model_config, loss, &self.progress.normalization, &mut rng, &self.device)?;
        if chunk + 1 == per_lane {
            for _ in 0..data.fresh / data.lanes {
                let (i, object) = lane.stream.take_next()?;
                lane.window.push_back((i, Arc::new(object)));
                lane.window.pop_front();
            }
        }
        Ok(batch)
    }

    /// Gradients and figures of this rank's objects in step `index`: means over the parts, each by its share of the batch.
    fn compute(&mut self, index: u64) -> Result<Computed, FlowError> {
        let stage = self.config.stage(index).clone();
        let parts = self.own_parts(&stage);
        let all_parts = stage.parts_per_lane(self.config.data.lanes) * self.config.data.lanes;
        let mut data_seconds = 0.0;
        let rms = Tensor::<1>::from_floats(self.gradient_rms(), &self.device).reshape([1, 1, channel::COUNT]);
        let mut sums: Option<(Flat, Tensor<1>)> = None;
        let mut positions = Vec::new();
        for (i, &part) in parts.iter().enumerate() {
            let begin = Instant::now();
            let batch = match self.ahead.take() {
                Some(batch) => batch?,
                None => self.draw(index, part)?,
            };
            data_seconds += begin.elapsed().as_secs_f64();
            let share = batch.t.len() as f32 / stage.batch as f32;
            // Gone before the optimiser, which changes weights in place that nobody else holds.
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
                    positions = self.lanes.iter().map(|lane| (lane.number, lane.first())).collect();
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

    /// Objects of this rank's lanes that could not be read: before `positions`, and in all.
    fn unreadable(&self, positions: &[(usize, u64)]) -> [u64; 2] {
        let behind = |lane: &Lane| {
            let first = positions.iter().find(|(number, _)| *number == lane.number).map(|(_, first)| *first);
            lane.stream.broken().iter().filter(|&&number| Some(number) < first).count() as u64
        };
        let all = |lane: &Lane| lane.stream.broken().len() as u64;
        [self.lanes.iter().map(behind).sum(), self.lanes.iter().map(all).sum()]
    }

    fn out_of_time(&self) -> bool {
        self.stop_at.is_some_and(|time| Instant::now() >= time)
    }

    /// The step of a single rank.
    fn alone(&self, computed: Computed) -> Result<Summed, FlowError> {
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
    fn summed(&self, computed: Result<Computed, FlowError>, begin: Instant) -> Result<Summed, FlowError> {
        let ranks = &*self.ranks;
        let layout = Layout {
            parameters: self.average.0.iter().map(|w| w.dims()[0]).collect(),
            figures: LOSSES + if self.model().dit().gradient_channels() { channel::COUNT } else { 0 },
            world: ranks.world(),
            lanes: self.config.data.lanes,
        };
        let computed = computed.and_then(|computed| {
            // Else a device would seem fast that has only been told what to do.
            let synced = self.device.sync();
            synced.map(|()| computed).map_err(|e| FlowError::Ranks { problem: format!("the device failed: {e}") })
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
            stop: self.out_of_time(),
            found: computed.map(|c| (c.gradients, c.figures)),
            seconds: begin.elapsed().as_secs_f64(),
        };
        let summing = Instant::now();
        let (mut gradients, tail) = layout.sum(ranks, own, self.config.optimizer.wire, &self.device)?;
        let mut figures = numbers(Tensor::cat(vec![gradients.norm(&self.device), tail], 0))?;
        let sum_seconds = summing.elapsed().as_secs_f64();
        let agreed = layout.read(&figures.split_off(1 + layout.figures));
        match (failure, agreed.failed) {
            (Some(e), _) => return Err(e),
            (None, Some(rank)) => return Err(FlowError::Elsewhere { rank }),
            (None, None) => {}
        }
        for (gradient, _) in gradients.0.iter_mut().zip(&agreed.present).filter(|(_, present)| !**present) {
            *gradient = None;
        }
        Ok(Summed { gradients, figures, agreed, data_seconds, sum_seconds: Some(sum_seconds) })
    }

    /// Takes one step. A step whose loss or gradients are not finite changes no weights.
    ///
    /// After an error, too, [`save`](Self::save) keeps what was reached before it. Where one rank cannot take it, none does.
    ///
    /// # Errors
    /// [`FlowError::NotFinite`], on all ranks; those of data and device; [`FlowError::Elsewhere`]; [`FlowError::Ranks`].
    pub fn step(&mut self) -> Result<StepReport, FlowError> {
        let begin = Instant::now();
        let index = self.progress.step;
        let total_steps = self.config.total_steps();
        let computed = self.compute(index);
        let Summed { gradients, figures, agreed, data_seconds, sum_seconds } = match self.ranks.world() {
            1 => self.alone(computed?)?,
            _ => self.summed(computed, begin)?,
        };
        let (&[norm, total, flow, seen, held], square) = figures.split_first_chunk().ok_or(FlowError::NoGradient)?;
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
            return Err(FlowError::NotFinite { steps: self.not_finite, last: p.step, loss: total, norm });
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
            out_of_time: agreed.stop || (self.ranks.world() == 1 && self.out_of_time()),
        })
    }

    /// Measures the averaged weights, if that is due after the steps so far; `best.safetensors` are those of the best
    /// measurement.
    pub fn validate(&mut self) -> Result<Option<Validated>, FlowError> {
        let (step, every) = (self.progress.step, self.config.validation.every);
        let Some(validation) = self.validation.as_ref().filter(|_| step > 0 && step.is_multiple_of(every)) else {
            return Ok(None);
        };
        let tracked = self.average.apply(self.model().clone()).put_dinov2(self.frozen.clone());
        let checkpoint = self.checkpoint(self.averaged())?;
        let stage = self.config.stage(step - 1);
        let own = validation.measure(&checkpoint, &tracked, &self.config, stage, &self.device);
        let (own, pictures) = agree(&*self.ranks, own)?;
        let figures = Figures { pictures, ..Figures::of(&*self.ranks, own)? };
        let found = Best { step, psnr: figures.psnr };
        let best = self.progress.best.filter(|best| best.psnr >= found.psnr).unwrap_or(found);
        if best == found && self.ranks.rank() == 0 {
            checkpoint.save(&self.folder.join("best.safetensors"))?;
        }
        self.progress.best = Some(best);
        Ok(Some(Validated { step, seen_samples: self.samples(), validation: figures, best }))
    }

    /// The model with the averaged weights. Sampling chooses its own arithmetic.
    fn averaged(&self) -> FreeRange {
        self.average.apply(self.model().clone().valid()).with_compute(Compute::F32).with_recompute(false)
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

    fn gradient_rms(&self) -> [f32; channel::COUNT] {
        // Before the first step nothing is known: one is as good as any, and the channels are clamped.
        self.progress.gradient_square.map(|x| if x > 0.0 { x.sqrt().max(1e-12) } else { 1.0 })
    }

    /// Saves everything that [`Trainer::open`] needs to go on, and the checkpoint of the averaged weights beside it.
    ///
    /// The state is written into a folder of its own and becomes the latest one by a rename; then older ones go. Rank 0 does
    /// it, but all ranks must call it: their weights are compared before.
    ///
    /// # Errors
    /// [`FlowError::Io`], [`FlowError::State`]; [`FlowError::Ranks`] where the ranks' weights have come apart.
    pub fn save(&self) -> Result<PathBuf, FlowError> {
        self.compare_weights()?;
        if self.ranks.rank() > 0 {
            return Ok(self.folder.join("checkpoint.safetensors"));
        }
        let io = |path: &Path| {
            let path = path.to_path_buf();
            move |source| FlowError::Io { path, source }
        };
        let target = self.folder.join(format!("state-{:09}", self.progress.step));
        let partial = self.folder.join("state.partial");
        if partial.exists() {
            std::fs::remove_dir_all(&partial).map_err(io(&partial))?;
        }
        std::fs::create_dir_all(&partial).map_err(io(&partial))?;
        let broken = |name: &str, e: String| FlowError::State { path: partial.join(name), problem: e };
        let average = self.averaged();
        let model = self.model().clone().into_record();
        model.save(partial.join("model")).map_err(|e| broken("model", e.to_string()))?;
        let record = average.clone().into_record();
        record.save(partial.join("average")).map_err(|e| broken("average", e.to_string()))?;
        self.optimizer.save(&partial.join("optimizer.safetensors"))?;
        let file = partial.join("progress.json");
        let text = serde_json::to_string_pretty(&self.progress).expect("plain numbers");
        std::fs::write(&file, text).map_err(io(&file))?;
        sync_tree(&partial).map_err(io(&partial))?;
        if target.exists() {
            std::fs::remove_dir_all(&target).map_err(io(&target))?;
        }
        std::fs::rename(&partial, &target).map_err(io(&target))?;
        // Not before the new state outlives a power cut may the older ones go.
        sync_folder(&self.folder).map_err(io(&self.folder))?;
        for old in states(&self.folder)? {
            if old != target {
                std::fs::remove_dir_all(&old).map_err(io(&old))?;
            }
        }
        let path = self.folder.join("checkpoint.safetensors");
        self.checkpoint(average)?.save(&path)?;
        Ok(path)
    }

    /// Refuses ranks whose weights are not those of rank 0 to the bit.
    fn compare_weights(&self) -> Result<(), FlowError> {
        if self.ranks.world() == 1 {
            return Ok(());
        }
        let own = [("weights", Weights::of(self.model()).checksum()), ("averaged weights", self.average.checksum())];
        let own = own.map(|(what, value)| (format!("{what} after step {}", self.progress.step), value));
        same_on_all(&*self.ranks, &own).map_err(|e| FlowError::Ranks { problem: e.to_string() })
    }

    /// The averaged weights with everything that sampling needs.
    fn checkpoint(&self, average: FreeRange) -> Result<Checkpoint, FlowError> {
        let stage = self.config.stage(self.progress.step.saturating_sub(1));
        let config = ModelConfig { image_size: stage.image_size, ..self.config.model.architecture() };
        let provenance = serde_json::json!({
            "configuration": self.config,
            "steps": self.progress.step,
            "samples": self.samples(),
            "training_seconds": self.progress.seconds,
            "program": concat!("freerange ", env!("CARGO_PKG_VERSION")),
            "sample": self.config.sample,
        });
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

/// All that a run changes.
struct State {
    model: FreeRange,
    average: Weights,
    optimizer: AdamW,
    progress: Progress,
}

impl State {
    /// The state saved in `path`, of a run whose frozen encoder is of `origin`.
    fn load(path: &Path, model: FreeRange, origin: Option<&WeightsOrigin>, device: &Device) -> Result<Self, FlowError> {
        let state = |name: &str| path.join(name);
        let broken = |name: &str, e: String| FlowError::State { path: path.join(name), problem: e };
        let record = |name: &str| ModuleRecord::load(state(name)).map_err(|e| broken(name, e.to_string()));
        let average = model.clone().valid();
        let average = average.try_load_record(record("average")?).map_err(|e| broken("average", e.to_string()))?;
        let model = model.try_load_record(record("model")?).map_err(|e| broken("model", e.to_string()))?;
        let average = Weights::of(&average);
        let optimizer = AdamW::load(&state("optimizer.safetensors"), &average, device)?;
        let file = state("progress.json");
        let text = std::fs::read_to_string(&file).map_err(|source| FlowError::Io { path: file.clone(), source })?;
        let progress = serde_json::from_str::<Progress>(&text)
            .map_err(|e| FlowError::State { path: file.clone(), problem: e.to_string() })?;
        let run = || format!("the run, in {}", file.display());
        require_same_encoder(progress.encoder.as_ref(), origin, run)?;
        Ok(Self { model, average, optimizer, progress })
    }

    /// The state of rank 0, on every rank; others have none, and begin with `model`.
    fn of_first(ranks: &dyn Ranks, own: Option<Self>, model: FreeRange) -> Result<Self, FlowError> {
        let text = own.as_ref().map(|own| serde_json::to_vec(&own.progress).expect("plain numbers"));
        let text = from_first(ranks, &text.unwrap_or_default())?;
        let progress = serde_json::from_slice(&text).map_err(|e| FlowError::Ranks { problem: e.to_string() })?;
        let (model, mut average, mut optimizer) = match own {
            Some(own) => (own.model, own.average, own.optimizer),
            None => {
                let average = Weights::of(&model);
                let optimizer = AdamW::new(average.0.len());
                (model, average, optimizer)
            }
        };
        let mut weights = Weights::of(&model);
        for w in weights.0.iter_mut().chain(&mut average.0) {
            *w = tensor_of_first(ranks, w.clone())?;
        }
        optimizer.follow_first(ranks, &average)?;
        Ok(Self { model: weights.apply(model), average, optimizer, progress })
    }

    /// That of a new run.
    fn begin(
        mut model: FreeRange,
        initial: Option<Initial>,
        normalization: Normalization,
        encoder: Option<WeightsOrigin>,
    ) -> Self {
        if let Some(Initial { checkpoint, .. }) = initial {
            model = Weights::of(&checkpoint.model.clone().take_dinov2().0).apply(model);
        }
        // The gradient by normalised Gaussians grows with what they were divided by.
        let square = |i: usize, old: &Checkpoint| {
            (old.gradient_rms[i] * normalization.std[i] / old.normalization.std[i]).powi(2)
        };
        let progress = Progress {
            step: 0,
            seconds: 0.0,
            gradient_square: std::array::from_fn(|i| initial.map_or(0.0, |old| square(i, old.checkpoint))),
            inherited: initial.is_some(),
            normalization,
            first_object: Some(0),
            first_objects: Vec::new(),
            broken: 0,
            skipped: 0,
            best: None,
            encoder,
        };
        let average = Weights::of(&model);
        let optimizer = AdamW::new(average.0.len());
        Self { model, average, optimizer, progress }
    }
}

/// What a rank needs of its own before it can speak of the run with others.
struct Prepared {
    source: Arc<dyn ObjectSource>,
    validation: Option<Validation>,
    encoder: Option<Dinov2>,
    origin: Option<WeightsOrigin>,
    manifest: String, // a checksum
}

impl Prepared {
    fn new(
        config: &TrainConfig,
        initial: Option<Initial>,
        encoder: Option<&EncoderWeights>,
        [rank, world]: [usize; 2],
        device: &Device,
        progress: &mut impl FnMut(&str),
    ) -> Result<Self, FlowError> {
        config.validate()?;
        let lanes = config.data.lanes;
        if !lanes.is_multiple_of(world) {
            return Err(FlowError::Config {
                field: "data.lanes".into(),
                expected: format!("a multiple of the number of ranks, {world}"),
                found: lanes.to_string(),
            });
        }
        // Where nothing is differentiated, and features are those of sampling to the bit.
        let encoder = load_encoder(&config.model.encoder, encoder, device, progress)?;
        let origin = encoder.as_ref().and_then(|e| e.origin().cloned());
        if let Some(Initial { checkpoint, .. }) = initial {
            require_same_model(&config.model, &checkpoint.config)?;
            let theirs = checkpoint.model.encoder().dinov2().and_then(Dinov2::origin);
            require_same_encoder(theirs, origin.as_ref(), || "the initial checkpoint".into())?;
        }
        let (source, manifest) = training_objects(config, world > 1)?;
        let validation = validation_objects(config, [rank, world])?;
        Ok(Self { source, validation, encoder, origin, manifest })
    }
}

/// The lanes of a rank, their windows filled.
fn lanes(
    data: &DataConfig,
    positions: &[u64],
    [rank, world]: [usize; 2],
    source: &Arc<dyn ObjectSource>,
) -> Result<Vec<Lane>, FlowError> {
    let own = (rank..data.lanes).step_by(world);
    let count = own.len();
    // All of them begin to make objects before the first one is waited for.
    let streams: Vec<(usize, Stream)> = own
        .map(|lane| (lane, Stream::one_of(count, source.clone(), positions[lane], data.lanes as u64, data.workers)))
        .collect();
    let filled = streams.into_iter().map(|(number, mut stream)| {
        let window = (0..data.window / data.lanes).map(|_| stream.take_next().map(|(i, object)| (i, Arc::new(object))));
        let window = window.collect::<Result<VecDeque<_>, _>>()?;
        Ok(Lane { number, stream, window })
    });
    filled.collect()
}

/// What is automatic is chosen by rank 0: which arithmetic is faster may look different from each of them.
fn compute_of_first(ranks: &dyn Ranks, compute: Compute, device: &Device) -> Result<Compute, FlowError> {
    if ranks.world() == 1 || compute != Compute::Auto {
        return Ok(compute);
    }
    let chosen = serde_json::to_vec(&compute.on(device)).expect("a name");
    let chosen = serde_json::from_slice::<Compute>(&from_first(ranks, &chosen)?)
        .map_err(|e| FlowError::Ranks { problem: e.to_string() })?;
    let supported = chosen.supported(device);
    agree(
        ranks,
        if supported {
            Ok(())
        } else {
            Err(FlowError::Config {
                field: "optimizer.compute".into(),
                expected: "what the devices of all ranks can do".into(),
                found: format!("auto, which is {chosen:?} on rank 0 and not on rank {}", ranks.rank()),
            })
        },
    )?;
    Ok(chosen)
}

/// What has to be alike in the configurations of all ranks, in short.
fn fingerprint(config: &TrainConfig) -> String {
    let mut c = config.clone();
    c.data.workers = 0;
    // These may lie elsewhere on each machine, and are compared by what is in them.
    c.data.shards = None;
    if let EncoderConfig::Dinov2(encoder) = &mut c.model.encoder {
        encoder.weights = None;
    }
    sha256(&serde_json::to_vec(&c).expect("a configuration is plain"))
}

/// What a new run normalises Gaussians by.
fn normalization(
    config: &TrainConfig,
    initial: Option<Initial>,
    source: &dyn ObjectSource,
    progress: &mut impl FnMut(&str),
) -> Result<Normalization, FlowError> {
    if let Some(Initial { checkpoint, remeasure: false }) = initial {
        return Ok(checkpoint.normalization.clone());
    }
    let count = config.data.statistics_objects as u64;
    let depth = config.stages.last().map_or(0, |s| s.depth);
    match source.statistics(depth) {
        Some(known) => Ok(known.normalization().map_err(freerange_data::DataError::from)?),
        None => {
            progress(&format!("measuring the statistics of {count} objects"));
            measure(source, count, depth)
        }
    }
}

/// The part `split` of the shards at `place`.
fn shards(config: &TrainConfig, place: &str, split: Split) -> Result<Shards, FlowError> {
    let open = if config.data.partial { Shards::open_finished } else { Shards::open };
    Ok(open(&Store::open(place)?, &config.depths(), Some(split))?)
}

/// The objects, and a checksum of their description where one is wanted.
fn training_objects(config: &TrainConfig, checksum: bool) -> Result<(Arc<dyn ObjectSource>, String), FlowError> {
    Ok(match &config.data.shards {
        Some(place) => {
            let shards = shards(config, place, Split::Train)?.shuffled_by(config.seed);
            let text = || sha256(&serde_json::to_vec(shards.manifest()).expect("read from such a text"));
            let manifest = if checksum { text() } else { String::new() };
            (Arc::new(shards), manifest)
        }
        None => (Arc::new(generated(config, 0)), "generated".into()),
    })
}

/// Those of a rank to measure on, if anything is to be measured.
fn validation_objects(config: &TrainConfig, share: [usize; 2]) -> Result<Option<Validation>, FlowError> {
    let count = config.validation.objects;
    Ok(match (config.validation.every, &config.data.shards) {
        (0, _) => None,
        (_, Some(place)) => {
            let shards = shards(config, place, Split::Validation)?;
            Some(Validation::new(&shards, shards.len() as u64, count, config.seed, share)?)
        }
        // Farther than training comes.
        (_, None) => Some(Validation::new(&generated(config, 1 << 31), u64::MAX, count, config.seed, share)?),
    })
}

/// Objects made on the fly, from the run's seeds on or so many farther.
fn generated(config: &TrainConfig, farther: u64) -> Generated {
    let seed = config.seed.wrapping_mul(1 << 32).wrapping_add(farther);
    Generated { config: config.data.object.clone(), depths: config.depths(), seed }
}

/// Normalisation statistics over the first `count` objects at `depth`.
fn measure(source: &dyn ObjectSource, count: u64, depth: u32) -> Result<Normalization, FlowError> {
    use rayon::prelude::*;
    // Partial statistics are merged in the order of the objects, so that the result does not depend on threads.
    let parts = (0..count)
        .into_par_iter()
        .map(|i| {
            let mut statistics = Statistics::default();
            statistics.add(source.object(i)?.slice(depth)?).map_err(freerange_data::DataError::from)?;
            Ok(statistics)
        })
        .collect::<Result<Vec<_>, FlowError>>()?;
    let mut all = Statistics::default();
    parts.iter().for_each(|p| all.merge(p));
    Ok(all.normalization().map_err(freerange_data::DataError::from)?)
}

/// Weights fit only the architecture they were trained in; the image size may differ.
fn require_same_model(model: &ModelConfig, given: &ModelConfig) -> Result<(), FlowError> {
    let given = ModelConfig { image_size: model.image_size, ..given.architecture() };
    let model = model.architecture();
    if given == model {
        return Ok(());
    }
    Err(FlowError::Config {
        field: "model".into(),
        expected: format!("the architecture of the initial checkpoint, {given:?}"),
        found: format!("{model:?}"),
    })
}

/// The frozen encoder, on `device`; `Ok(None)` where there is none, or a random one will do.
fn load_encoder(
    config: &EncoderConfig,
    weights: Option<&EncoderWeights>,
    device: &Device,
    progress: &mut impl FnMut(&str),
) -> Result<Option<Dinov2>, FlowError> {
    let refuse = |field: &str, expected: &str, found: &str| {
        Err(FlowError::Config { field: field.into(), expected: expected.into(), found: found.into() })
    };
    match (config, weights) {
        (EncoderConfig::Patch(_), None) => Ok(None),
        (EncoderConfig::Patch(_), Some(_)) => {
            refuse("model.encoder.kind", "\"dinov2\" where encoder weights are given", "\"patch\"")
        }
        (EncoderConfig::Dinov2(c), None) if c.random => {
            progress(
                "WARNING: the frozen encoder is random (model.encoder.random): a dry run, whose model is of no use",
            );
            Ok(None)
        }
        (EncoderConfig::Dinov2(c), Some(_)) if c.random => {
            refuse("model.encoder.random", "false where encoder weights are given", "true")
        }
        (EncoderConfig::Dinov2(_), None) => refuse(
            "model.encoder.weights",
            "the weights of the frozen encoder, a folder or \"hf:owner/name\" (or random = true, for dry runs)",
            "none",
        ),
        (EncoderConfig::Dinov2(c), Some(weights)) => {
            let encoder = Dinov2::load_as(&weights.folder, &weights.name, device)?;
            if c.architecture() != *encoder.config() {
                let expected =
                    format!("the architecture of the weights in {}, {:?}", weights.folder.display(), encoder.config());
                return refuse("model.encoder", &expected, &format!("{:?}", c.architecture()));
            }
            if let Some(origin) = encoder.origin() {
                progress(&format!("encoder weights {} (sha256 {})", origin.name, origin.sha256));
            }
            Ok(Some(encoder))
        }
    }
}

/// What was trained with some features is of no use with others.
fn require_same_encoder(
    theirs: Option<&WeightsOrigin>,
    ours: Option<&WeightsOrigin>,
    who: impl FnOnce() -> String,
) -> Result<(), FlowError> {
    if theirs.map(|w| &w.sha256) == ours.map(|w| &w.sha256) {
        return Ok(());
    }
    let text = |w: Option<&WeightsOrigin>| w.map_or("none".into(), |w| format!("{} (sha256 {})", w.name, w.sha256));
    Err(FlowError::Config {
        field: "model.encoder.weights".into(),
        expected: format!("those of {}, {}", who(), text(theirs)),
        found: text(ours),
    })
}

/// A run's folder holds its configuration: going on with another one would mix two runs.
fn check_same_run(config: &TrainConfig, folder: &Path) -> Result<(), FlowError> {
    let path = folder.join("config.toml");
    let mut kept = config.clone();
    // Whoever reads that file, or goes on with the run from another folder, must find the same shards.
    kept.data.shards = kept.data.shards.map(|place| local(&place, |path| std::path::absolute(path)));
    if let EncoderConfig::Dinov2(encoder) = &mut kept.model.encoder {
        encoder.weights = encoder.weights.take().map(|place| local(&place, |path| std::path::absolute(path)));
    }
    let text =
        toml::to_string_pretty(&kept).map_err(|e| FlowError::State { path: path.clone(), problem: e.to_string() })?;
    match std::fs::read_to_string(&path) {
        Ok(old) => {
            let old: TrainConfig =
                toml::from_str(&old).map_err(|e| FlowError::State { path: path.clone(), problem: e.to_string() })?;
            // Running longer is no other run; neither is sampling or measuring otherwise, or with more threads.
            let essence = |c: &TrainConfig| {
                let mut c = c.clone();
                c.stages.iter_mut().for_each(|s| s.steps = 0);
                c.sample = Default::default();
                c.data.workers = 0;
                // The weights may have moved; the state knows which ones they are.
                if let EncoderConfig::Dinov2(encoder) = &mut c.model.encoder {
                    encoder.weights = None;
                }
                c.data.shards = c.data.shards.map(|place| local(&place, |path| path.canonicalize()));
                c.optimizer.compute = Default::default();
                c.optimizer.wire = Default::default();
                c.optimizer.schedule = Default::default();
                c.validation = Default::default();
                c
            };
            if essence(&old) != essence(config) {
                let problem = "the folder belongs to a run with another configuration: choose another folder".into();
                return Err(FlowError::State { path, problem });
            }
        }
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {}
        Err(source) => return Err(FlowError::Io { path, source }),
    }
    std::fs::write(&path, text).map_err(|source| FlowError::Io { path, source })
}

/// The path of a folder otherwise said by `say`; URLs and the like, and what cannot be said, as they are.
fn local(place: &str, say: impl Fn(&Path) -> std::io::Result<PathBuf>) -> String {
    let path = is_path(place).then(|| say(Path::new(place)).ok()).flatten();
    path.and_then(|path| path.to_str().map(str::to_owned)).unwrap_or_else(|| place.to_owned())
}

fn states(folder: &Path) -> Result<Vec<PathBuf>, FlowError> {
    let entries = std::fs::read_dir(folder).map_err(|source| FlowError::Io { path: folder.into(), source })?;
    let mut found: Vec<PathBuf> = entries
        .filter_map(|e| e.ok().map(|e| e.path()))
        .filter(|p| {
            p.file_name()
                .and_then(|n| n.to_str())
                .and_then(|n| n.strip_prefix("state-"))
                .is_some_and(|n| n.parse::<u64>().is_ok())
        })
        .collect();
    found.sort();
    Ok(found)
}

fn latest_state(folder: &Path) -> Result<Option<PathBuf>, FlowError> {
    Ok(states(folder)?.pop())
}

#[cfg(test)]
mod tests;
