//! Sampling: from noise to Gaussians that fit the posed images (paper, Section 3.5).

use std::{cell::RefCell, ops::ControlFlow};

use burn::tensor::{Device, Tensor, TensorData};
use freerange_camera::View;
use freerange_fit::{QuickFitConfig, tree_slice};
use freerange_model::{Checkpoint, Compute, Feedback};
use freerange_splat::{Cloud, channel};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::{
    FlowError,
    batch::{Conditioning, draw_background, squares},
    coupling::Coupling,
    photometric::{Images, Photometric},
};

/// How to sample.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SampleConfig {
    /// Steps from noise to data.
    pub steps: usize,
    /// How they are taken.
    pub solver: Solver,
    /// Make `2^depth` Gaussians; left out: as many as at the depth the model was trained at. Tokens carry no position,
    /// so that any number can be drawn, but sizes are those of the trained depth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth: Option<u32>,
    /// Start from a quick fit of the input views instead of pure noise.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<StartConfig>,
    /// Classifier-free guidance scale s: `z_u + s (z_c - z_u)`. 1 switches it off (and halves the work).
    pub guidance: f32,
    /// Photometric guidance scale lambda_PG. 0 switches it off. What it multiplies is told by `photometric_step`. It acts
    /// on what the next step starts from, and on the result where there is one step only.
    pub photometric: f32,
    /// The gradient that photometric guidance follows.
    pub photometric_step: PhotometricStep,
    /// Photometric steps per step of the solver, each at the estimate that the one before has moved. The paper takes one.
    pub photometric_repeats: usize,
    /// Side, in pixels, of the renders that photometric guidance compares with the images; left out: `gradient_size`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub photometric_size: Option<u32>,
    /// Where the gradient that the network sees as input is taken.
    pub gradient_at: GradientAt,
    /// Side, in pixels, of the renders that the gradient for the network is taken on: as in training.
    pub gradient_size: u32,
    /// Colour behind the object in those renders.
    pub background: Background,
    /// How the starting noise is grouped into tokens: as in training.
    pub coupling: Coupling,
    /// Arithmetic of the transformer's blocks.
    pub compute: Compute,
    /// Steps of 3DGS-MCMC on the input views that follow ([`freerange_fit::refine`]); [`reconstruct`] itself takes none.
    pub refine: usize,
    /// How many samples refinement is held at the mean pictures of, each from a fit and noise of its own; what is refined is the
    /// first. [`reconstruct`] itself draws what it is asked for.
    #[serde(skip_serializing_if = "is_one")]
    pub ensemble: usize,
    /// Steps of [`Solver::Hold`] that follow a sample from pure noise, with it in the place of a fit. [`reconstruct`] itself
    /// takes none.
    #[serde(skip_serializing_if = "is_zero")]
    pub mend: usize,
    /// What is different where a model that starts from fits by itself is asked to start from pure noise; left out: nothing.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from_noise: Option<FromNoise>,
}

/// How a model samples from pure noise that by itself starts from fits.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FromNoise {
    /// [`SampleConfig::steps`]
    pub steps: usize,
    /// [`SampleConfig::solver`]
    pub solver: Solver,
    /// [`SampleConfig::photometric`]
    pub photometric: f32,
    /// [`SampleConfig::mend`]
    #[serde(default, skip_serializing_if = "is_zero")]
    pub mend: usize,
}

impl Default for SampleConfig {
    fn default() -> Self {
        Self {
            steps: 50,
            solver: Solver::Euler,
            depth: None,
            start: None,
            guidance: 2.0,
            photometric: 50.0,
            photometric_step: PhotometricStep::Gradient,
            photometric_repeats: 1,
            photometric_size: None,
            gradient_at: GradientAt::Noisy,
            gradient_size: 512,
            background: Background::Random,
            coupling: Coupling::Independent,
            compute: Compute::F32,
            refine: 0,
            ensemble: 1,
            mend: 0,
            from_noise: None,
        }
    }
}

fn is_zero(x: &usize) -> bool {
    *x == 0
}

fn is_one(x: &usize) -> bool {
    *x == 1
}

impl SampleConfig {
    /// The same from pure noise: see [`from_noise`](Self::from_noise).
    pub fn without_start(mut self) -> Self {
        if let (Some(_), Some(noise)) = (self.start.take(), self.from_noise) {
            let FromNoise { steps, solver, photometric, mend } = noise;
            self = Self { steps, solver, photometric, mend, ..self };
        }
        self
    }

    /// How samples from pure noise are mended: see [`mend`](Self::mend); none if they are not.
    pub fn mending(&self) -> Option<Self> {
        let start = StartConfig { time: 0.0, noise: 0.0, ..StartConfig::default() };
        let held =
            Self { steps: self.mend, solver: Solver::Hold, start: Some(start), photometric: 0.0, ..self.clone() };
        (self.mend > 0 && self.start.is_none()).then_some(held)
    }

    /// Refuses impossible values.
    pub fn validate(&self) -> Result<(), FlowError> {
        let bad = |field: &str, expected: &str, found: String| {
            Err(FlowError::Config { field: format!("sample.{field}"), expected: expected.into(), found })
        };
        if !(1..=10_000).contains(&self.steps) {
            return bad("steps", "1 to 10000", self.steps.to_string());
        }
        if self.depth.is_some_and(|d| !(1..=20).contains(&d)) {
            return bad("depth", "1 to 20", format!("{:?}", self.depth));
        }
        if self.mend > 10_000 {
            return bad("mend", "0 to 10000", self.mend.to_string());
        }
        if self.refine > 100_000 {
            return bad("refine", "0 to 100000", self.refine.to_string());
        }
        if !(1..=64).contains(&self.ensemble) {
            return bad("ensemble", "1 to 64", self.ensemble.to_string());
        }
        if self.solver == Solver::Hold && self.start.is_none() {
            return bad("solver", "euler, heun or multistep without sample.start", "hold".into());
        }
        if let Some(start) = &self.start {
            if !(0.0..1.0).contains(&start.time) {
                return bad("start.time", "0 to below 1", start.time.to_string());
            }
            if !(0.0..=2.0).contains(&start.noise) {
                return bad("start.noise", "0 to 2", start.noise.to_string());
            }
            start.fit.check().map_err(|e| FlowError::Config {
                field: "sample.start.fit".into(),
                expected: "settings of a quick fit".into(),
                found: e.to_string(),
            })?;
        }
        if !self.guidance.is_finite() || self.guidance < 0.0 {
            return bad("guidance", "a finite number, 0 or more", self.guidance.to_string());
        }
        if !self.photometric.is_finite() || self.photometric < 0.0 {
            return bad("photometric", "a finite number, 0 or more", self.photometric.to_string());
        }
        if !(1..=1000).contains(&self.photometric_repeats) {
            return bad("photometric_repeats", "1 to 1000", self.photometric_repeats.to_string());
        }
        for (field, size) in [("gradient_size", Some(self.gradient_size)), ("photometric_size", self.photometric_size)]
        {
            if let Some(size) = size.filter(|s| !(8..=4096).contains(s)) {
                return bad(field, "8 to 4096 pixels", size.to_string());
            }
        }
        Ok(())
    }
}

/// A start from a quick fit of the input views.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StartConfig {
    /// The time to which the fit is mixed with noise, and from which the flow is integrated; 0: noise alone, in the order of
    /// the fit.
    pub time: f32,
    /// Factor on the noise.
    pub noise: f32,
    /// How the fit is made: as in training.
    pub fit: QuickFitConfig,
}

impl Default for StartConfig {
    fn default() -> Self {
        Self { time: 0.3, noise: 1.0, fit: QuickFitConfig::default() }
    }
}

/// Where the photometric gradient that is fed to the network is taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GradientAt {
    /// At the noisy sample itself, rendered as Gaussians.
    #[default]
    Noisy,
    /// At the estimate of the clean sample: the network's in the previous step, at first the quick fit that sampling starts
    /// from; at the noisy sample where there is none.
    Estimate,
}

/// What the photometric guidance takes lambda_PG times.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PhotometricStep {
    /// The gradient itself, the paper's.
    #[default]
    Gradient,
    /// The gradient as the network sees it: every channel at unit root mean square (measured in training), outliers cut.
    /// Beyond the paper: gradients of colours are a fifth of those of positions and so hardly move at a lambda at
    /// which positions are still stable.
    Scaled,
}

impl PhotometricStep {
    /// What lambda_PG multiplies, of a gradient whose channels have the root mean squares `rms`.
    fn of(self, gradient: Tensor<3>, rms: &Tensor<3>) -> Tensor<3> {
        match self {
            Self::Gradient => gradient,
            Self::Scaled => scale_gradient(gradient, rms),
        }
    }
}

/// What lies behind the object where renders are compared with images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Background {
    /// A new colour for every object and step: no object can hide against all of them.
    #[default]
    Random,
    /// White, as in the evaluation.
    White,
}

impl Background {
    /// A colour, drawn from `rng` if need be.
    pub fn draw(self, rng: &mut ChaCha8Rng) -> [f32; 3] {
        match self {
            Self::Random => draw_background(rng),
            Self::White => [1.0; 3],
        }
    }
}

/// How the flow is integrated. All take uniform steps in time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Solver {
    /// First order, the paper's.
    #[default]
    Euler,
    /// Second order: a step with the mean of the velocities at both its ends. Two evaluations of the network per step.
    Heun,
    /// Second order from the estimates of this step and the one before, as DPM-Solver++(2M) (Lu et al. 2022), but linear in
    /// time instead of in the log of the signal-to-noise ratio, whose steps do not shrink near the data. One evaluation
    /// per step.
    Multistep,
    /// Not at all: the sample stays where it starts, and only the estimate is fed back, from step to step. Each estimate is then
    /// the mean of what is likely rather than a draw from it. For models that were trained so from fits
    /// ([`StartLoss::hold`](crate::config::StartLoss)).
    Hold,
}

/// The state that [`integrate`] hands to its callbacks.
#[derive(Clone, Debug)]
pub struct Step {
    /// Number of the step, from 0.
    pub index: usize,
    /// Time of `z`.
    pub t: f32,
    /// The sample at that time. `[b, n, 14]`
    pub z: Tensor<3>,
}

/// Integrates the flow `dz/dt = (z1_hat - z) / (1 - t)` from `z` at time `start` in `steps` uniform steps; after each,
/// `z <- z - push`.
///
/// `estimate` gives the guided estimate z1_hat of the clean sample, `push` the photometric step `lambda grad` taken at the
/// first estimate of each step (or nothing; [`Solver::Hold`] leaves it to the callbacks, which share the estimate). Returns the
/// last estimate less its push; the paper's, which is what it denormalises, has none.
pub fn integrate(
    mut z: Tensor<3>,
    start: f32,
    steps: usize,
    solver: Solver,
    mut estimate: impl FnMut(&Step) -> Result<Tensor<3>, FlowError>,
    mut push: impl FnMut(&Step, &Tensor<3>) -> Result<Option<Tensor<3>>, FlowError>,
) -> Result<Tensor<3>, FlowError> {
    let time = |i: usize| start + (1.0 - start) * i as f32 / steps as f32;
    let mut last = z.clone();
    for index in 0..steps {
        if solver == Solver::Hold {
            let step = Step { index, t: start, z: z.clone() };
            last = estimate(&step)?;
            match push(&step, &last)? {
                Some(push) if index + 1 == steps => return Ok(last - push),
                _ => continue,
            }
        }
        let (t, next) = (time(index), time(index + 1));
        let share = 1.0 / (steps - index) as f32; // of the way from z to the estimate
        let step = Step { index, t, z: z.clone() };
        let before = std::mem::replace(&mut last, estimate(&step)?);
        // Where a straight line to `goal` is at the end of this step.
        let towards = |goal: Tensor<3>| z.clone() + (goal - z.clone()).mul_scalar(share);
        let moved = match solver {
            // The velocity at the end of the last step would be one divided by zero.
            Solver::Heun if index + 1 < steps => {
                let end = Step { index, t: next, z: towards(last.clone()) };
                let velocity = (last.clone() - z.clone()).mul_scalar(1.0 / (1.0 - t));
                let at_end = (estimate(&end)? - end.z).mul_scalar(1.0 / (1.0 - next));
                z + (velocity + at_end).mul_scalar((next - t) / 2.0)
            }
            // The flow is solved exactly for an estimate that goes on changing as it did since the step before.
            Solver::Multistep if index > 0 => {
                let (left, rest) = ((steps - index) as f32, (steps - index - 1) as f32); // 1 - t before and after, in steps
                let logarithm = if rest > 0.0 { rest * (left / rest).ln() } else { 0.0 };
                towards(last.clone()) + (last.clone() - before).mul_scalar(1.0 - logarithm)
            }
            _ => towards(last.clone()),
        };
        z = match push(&step, &last)? {
            Some(push) if index + 1 == steps => return Ok(last - push),
            Some(push) => moved - push,
            None => moved,
        };
    }
    Ok(last)
}

/// What the network takes the clean Gaussians to be, after a step of sampling.
#[derive(Clone, Copy, Debug)]
pub struct Estimate<'a> {
    /// Number of the step, from 0.
    pub index: usize,
    /// The time that the step began at.
    pub t: f32,
    normalized: &'a Tensor<3>, // [b, n, 14]
    photometric: &'a Photometric,
    seeds: usize,
}

impl Estimate<'_> {
    /// The Gaussians, `[objects][seeds]`, in the objects' canonical frames. On a GPU this waits for what is queued.
    ///
    /// # Errors
    /// If the values cannot be read back.
    pub fn clouds(&self) -> Result<Vec<Vec<Cloud>>, FlowError> {
        clouds(self.photometric.denormalize(self.normalized.clone()), self.seeds)
    }
}

/// Raw channels as Gaussians. `[objects * seeds, n, 14]` to `[objects][seeds]`
fn clouds(raw: Tensor<3>, seeds: usize) -> Result<Vec<Vec<Cloud>>, FlowError> {
    let row = raw.dims()[1] * channel::COUNT;
    let values = raw.into_data().try_to_vec::<f32>().map_err(|_| FlowError::NoGradient)?;
    let cloud = |rows: &[f32]| {
        let mut cloud = Cloud::from_rows(rows.to_vec());
        cloud.canonicalize_rotations();
        cloud
    };
    Ok(values.chunks_exact(row * seeds).map(|object| object.chunks_exact(row).map(cloud).collect()).collect())
}

/// `uncond + s (cond - uncond)`: classifier-free guidance.
pub fn classifier_free(conditional: Tensor<3>, unconditional: Tensor<3>, scale: f32) -> Tensor<3> {
    unconditional.clone() + (conditional - unconditional).mul_scalar(scale)
}

/// Draws one sample of Gaussians per object and seed that fits the object's posed images. The whole of Section 3.5.
///
/// `objects` are the views of each object, as many for each, in its canonical frame (object within radius 0.5 of the
/// origin); so are the results, `[objects][seeds]`. `fits` are [quick fits](freerange_fit::quick_fit) of the views of each
/// object, which `config.start` asks for and nothing else looks at. All samples run as one batch. `progress` is told of
/// every step and may end it all by `ControlFlow::Break`; on a GPU, the step is only queued by then, and nothing waits for
/// it but the end and whoever asks for the estimate's Gaussians.
///
/// # Errors
/// [`FlowError::Cancelled`] where `progress` says so; settings and views that cannot be used.
pub fn reconstruct(
    checkpoint: &Checkpoint,
    objects: &[&[View]],
    fits: Option<&[Cloud]>,
    config: &SampleConfig,
    seeds: &[u64],
    device: &Device,
    mut progress: impl FnMut(&Estimate<'_>) -> ControlFlow<()>,
) -> Result<Vec<Vec<Cloud>>, FlowError> {
    config.validate()?;
    if objects.is_empty() || seeds.is_empty() {
        return Ok(vec![Vec::new(); objects.len()]);
    }
    let (depth, fewest) = (config.depth.unwrap_or(checkpoint.depth), checkpoint.config.gaussians_per_token);
    if 1usize << depth < fewest {
        let expected = format!("at least {}: a token of the model is {fewest} Gaussians", fewest.ilog2());
        return Err(FlowError::Config { field: "sample.depth".into(), expected, found: depth.to_string() });
    }
    let model = checkpoint.model.clone().with_compute(config.compute);
    let (b, n) = (objects.len() * seeds.len(), 1usize << depth);

    // The images are encoded once; every sample and step shares the tokens.
    let views: Vec<Vec<&View>> = objects.iter().map(|o| o.iter().collect()).collect();
    let tokens = Conditioning::new(&views, &checkpoint.config, device)?.encode(&model); // [objects, m, c]
    let [_, m, c] = tokens.dims();
    let tokens = tokens.unsqueeze_dim::<4>(1).repeat_dim(1, seeds.len()).reshape([b, m, c]);
    let both = Tensor::cat(vec![tokens.clone(), tokens.zeros_like()], 0);

    let photometric = Photometric::new(&checkpoint.normalization, device);
    let rms = Tensor::<1>::from_floats(checkpoint.gradient_rms, device).reshape([1, 1, channel::COUNT]);
    let at_size = |size: u32| {
        let small = squares(objects, size);
        let small: Vec<Vec<&View>> = small.iter().flat_map(|o| vec![o.iter().collect(); seeds.len()]).collect();
        Images::new(&small, device)
    };
    let images = at_size(config.gradient_size)?;
    let guiding = match config.photometric_size {
        Some(size) if size != config.gradient_size => at_size(size)?,
        _ => images.clone(),
    };
    let starts = match (&config.start, fits) {
        (None, _) => None,
        (Some(start), Some(fits)) if fits.len() == objects.len() => Some((start, fits)),
        (Some(_), given) => {
            return Err(FlowError::Config {
                field: "sample.start".into(),
                expected: format!("a quick fit of each of {} objects", objects.len()),
                found: given.map_or(0, <[Cloud]>::len).to_string(),
            });
        }
    };
    // Everything random about a sample comes from its own seed, whatever else is in the batch.
    let mut noise = Vec::with_capacity(b * n * channel::COUNT);
    let mut backgrounds = vec![Vec::with_capacity(b); config.steps]; // [steps][b]
    let mut guesses = Vec::new();
    for object in 0..objects.len() {
        let guess = match starts {
            None => None,
            Some((_, fits)) => {
                let slice = tree_slice(&fits[object], n.ilog2()).map_err(freerange_data::DataError::from)?;
                Some(checkpoint.normalization.normalize(&slice))
            }
        };
        for &seed in seeds {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut one: Vec<f32> = (0..n * channel::COUNT).map(|_| StandardNormal.sample(&mut rng)).collect();
            match (&guess, starts) {
                (Some(guess), Some((start, _))) => {
                    config.coupling.pair(&mut one, guess);
                    one.iter_mut().for_each(|e| *e *= start.noise);
                    guesses.extend_from_slice(guess);
                }
                _ => config.coupling.group(&mut one),
            }
            noise.extend(one);
            backgrounds.iter_mut().for_each(|step| step.push(config.background.draw(&mut rng)));
        }
    }
    let tensor = |values: Vec<f32>| Tensor::<3>::from_data(TensorData::new(values, [b, n, channel::COUNT]), device);
    let noise = tensor(noise);
    let guess = starts.is_some().then(|| tensor(guesses));
    let begin = starts.map_or(0.0, |(start, _)| start.time);
    let z = match &guess {
        Some(guess) => noise.mul_scalar(1.0 - begin) + guess.clone().mul_scalar(begin),
        None => noise,
    };

    let previous = RefCell::new(guess); // the latest estimate of the clean sample
    let estimate = |step: &Step| {
        let known = previous.borrow().clone();
        let hint = match checkpoint.config.gradient_channels {
            false => None,
            true => {
                let at = match (config.gradient_at, &known) {
                    (GradientAt::Estimate, Some(estimate)) => estimate.clone(),
                    _ => step.z.clone(),
                };
                Some(scale_gradient(photometric.gradient(at, &images.on(&backgrounds[step.index]))?, &rms))
            }
        };
        let observation = match &known {
            Some(known) if checkpoint.config.observation_channels => {
                Some(photometric.observe(known.clone(), &images.on(&backgrounds[step.index]))?)
            }
            _ => None,
        };
        let earlier = known.filter(|_| checkpoint.config.estimate_channels);
        let estimate = if config.guidance == 1.0 {
            let t = Tensor::full([b], step.t, device);
            let feedback = Feedback { gradient: hint, estimate: earlier, observation };
            model.denoise(step.z.clone(), feedback, tokens.clone(), t)
        } else {
            // Conditional and unconditional branch in one batch.
            let z = step.z.clone().repeat_dim(0, 2);
            let blind = |x: Tensor<3>| Tensor::cat(vec![x.clone(), x.zeros_like()], 0);
            let t = Tensor::full([2 * b], step.t, device);
            let feedback = Feedback {
                gradient: hint.map(blind),
                estimate: earlier.map(blind),
                observation: observation.map(blind),
            };
            let out = model.denoise(z, feedback, both.clone(), t);
            classifier_free(out.clone().narrow(0, 0, b), out.narrow(0, b, b), config.guidance)
        };
        previous.replace(Some(estimate.clone()));
        Ok(estimate)
    };
    let push = |step: &Step, estimate: &Tensor<3>| {
        let told = Estimate {
            index: step.index,
            t: step.t,
            normalized: estimate,
            photometric: &photometric,
            seeds: seeds.len(),
        };
        if progress(&told).is_break() {
            return Err(FlowError::Cancelled);
        }
        // What the paper returns is the last estimate as the network gives it. A single step would be guided by nothing.
        let last = step.index + 1 == config.steps && config.steps > 1;
        if config.photometric == 0.0 || last {
            return Ok(None);
        }
        let targets = guiding.on(&backgrounds[step.index]);
        let mut moved = estimate.clone();
        for _ in 0..config.photometric_repeats {
            let gradient = photometric.gradient(moved.clone(), &targets)?;
            moved = moved - config.photometric_step.of(gradient, &rms).mul_scalar(config.photometric);
        }
        if config.solver == Solver::Hold {
            previous.replace(Some(moved.clone())); // the sample does not move: what is fed back does
        }
        Ok(Some(estimate.clone() - moved))
    };
    let estimate = integrate(z, begin, config.steps, config.solver, estimate, push)?;
    clouds(photometric.denormalize(estimate), seeds.len())
}

/// Largest magnitude of a gradient channel, in units of its root mean square: a few Gaussians have gradients
/// hundreds of times larger than the rest, which say no more than "much".
const GRADIENT_LIMIT: f32 = 5.0;

/// The gradient as the network sees it: every channel at unit root mean square, outliers cut.
pub fn scale_gradient(gradient: Tensor<3>, rms: &Tensor<3>) -> Tensor<3> {
    (gradient / rms.clone()).clamp(-GRADIENT_LIMIT, GRADIENT_LIMIT)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Data drawn from a normal distribution of mean `M` and deviation `S`: the best estimate, and the whole flow, are
    /// known.
    const M: f32 = 0.7;
    const S: f32 = 0.4;

    #[test]
    fn guidance_follows_the_gradient_or_its_channels_at_one_scale() {
        let tensor = |values: [f32; 3]| Tensor::<3>::from_data([[values]], &Device::flex());
        let (gradient, rms) = (tensor([2e-4, -6e-6, 9.0]), tensor([1e-4, 3e-6, 0.1]));
        let of = |way: PhotometricStep| way.of(gradient.clone(), &rms).into_data().try_to_vec::<f32>().unwrap();
        assert_eq!(of(PhotometricStep::Gradient), [2e-4, -6e-6, 9.0]);
        let scaled = of(PhotometricStep::Scaled);
        assert!(scaled.iter().zip([2.0, -2.0, GRADIENT_LIMIT]).all(|(a, b)| (a - b).abs() < 1e-5), "{scaled:?}");
    }

    #[test]
    fn a_model_of_fits_starts_from_noise_in_its_own_way() {
        let noise = FromNoise { steps: 30, solver: Solver::Multistep, photometric: 0.2, mend: 3 };
        let fit = SampleConfig {
            steps: 4,
            solver: Solver::Hold,
            start: Some(StartConfig::default()),
            photometric: 0.0,
            from_noise: Some(noise),
            ..SampleConfig::default()
        };
        fit.validate().unwrap();
        let found = fit.clone().without_start();
        found.validate().unwrap();
        assert_eq!((found.steps, found.solver, found.photometric), (30, Solver::Multistep, 0.2));
        assert!(found.start.is_none());
        // What comes of it takes the place of a fit; what starts from a fit has no need.
        let mending = found.mending().unwrap();
        mending.validate().unwrap();
        assert_eq!((mending.steps, mending.solver, mending.photometric), (3, Solver::Hold, 0.0));
        assert!(mending.start.is_some_and(|start| start.time == 0.0 && start.noise == 0.0));
        assert!(fit.mending().is_none());
        assert_eq!(found.clone().without_start(), found);
        let held = SampleConfig { from_noise: None, ..fit }.without_start();
        let message = held.validate().unwrap_err().to_string();
        assert!(message.contains("sample.solver") && message.contains("hold"), "{message}");
    }

    fn error(solver: Solver, steps: usize) -> f32 {
        let device = Device::flex();
        let noise = Tensor::<3>::from_data([[[-1.5f32, -0.3, 0.4, 2.0]]], &device);
        let mut calls = 0;
        let estimate = |s: &Step| {
            calls += 1;
            let (t, rest) = (s.t, 1.0 - s.t);
            Ok((s.z.clone() - t * M).mul_scalar(t * S * S / (t * t * S * S + rest * rest)) + M)
        };
        let found = integrate(noise.clone(), 0.0, steps, solver, estimate, |_, _| Ok(None)).unwrap();
        assert_eq!(calls, if solver == Solver::Heun { 2 * steps - 1 } else { steps });
        let expected = noise.mul_scalar(S) + M;
        (found - expected).abs().max().into_scalar()
    }

    #[test]
    fn second_order_solvers_are_of_second_order() {
        // Twice the steps: half the error, or a quarter. (The multistep solver begins with a step of first order, which
        // takes long to be outweighed.)
        for (solver, fall) in [(Solver::Euler, 1.9), (Solver::Heun, 3.7), (Solver::Multistep, 2.7)] {
            let [coarse, fine] = [80, 160].map(|n| error(solver, n));
            assert!(coarse / fine > fall && coarse > 1e-5, "{solver:?}: {coarse} {fine}");
            assert!(solver == Solver::Euler || fine < 0.05 * error(Solver::Euler, 160), "{solver:?} {fine}");
        }
        assert_eq!(error(Solver::Multistep, 1), error(Solver::Euler, 1));
    }
}
