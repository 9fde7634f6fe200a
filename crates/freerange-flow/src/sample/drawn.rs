//! Where sampling starts.

use burn::tensor::{Device, Tensor, TensorData};
use freerange_core::Invalid;
use freerange_fit::tree_slice;
use freerange_model::Checkpoint;
use freerange_splat::{Cloud, channel};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::{SampleConfig, StartConfig};
use crate::FlowError;

/// A start from quick fits, one for each object or one for each of its seeds.
#[derive(Clone, Copy)]
pub(super) struct Start<'a> {
    pub(super) config: &'a StartConfig,
    fits: &'a [Cloud],
}

impl<'a> Start<'a> {
    pub(super) fn new(
        config: &'a StartConfig,
        fits: Option<&'a [Cloud]>,
        objects: usize,
        seeds: usize,
    ) -> Result<Self, FlowError> {
        match fits {
            Some(fits) if fits.len() == objects || fits.len() == objects * seeds => Ok(Self { config, fits }),
            given => {
                let expected = format!("a quick fit of each of {objects} objects, or of each of their {seeds} seeds");
                Err(Invalid::new("sample.start", expected, given.map_or(0, <[Cloud]>::len)).into())
            }
        }
    }
}

/// Everything random about a batch of samples, each from its own seed, whatever else is in the batch.
pub(super) struct Drawn {
    /// Where the flow begins. `[b, n, 14]`
    pub(super) z: Tensor<3>,
    /// The quick fits, in the order of their tree; none of pure noise. `[b, n, 14]`
    pub(super) guess: Option<Tensor<3>>,
    /// `[steps][b]`
    pub(super) backgrounds: Vec<Vec<[f32; 3]>>,
}

impl Drawn {
    pub(super) fn new(
        checkpoint: &Checkpoint,
        config: &SampleConfig,
        start: Option<Start<'_>>,
        objects: usize,
        seeds: &[u64],
        device: &Device,
    ) -> Result<Self, FlowError> {
        let (depth, fewest) = (config.depth_of(checkpoint.depth), checkpoint.config.gaussians_per_token);
        if 1usize << depth < fewest {
            let expected = format!("at least {}: a token of the model is {fewest} Gaussians", fewest.ilog2());
            return Err(Invalid::new("sample.depth", expected, depth).into());
        }
        let (b, n) = (objects * seeds.len(), 1usize << depth);
        let mut noise = Vec::with_capacity(b * n * channel::COUNT);
        let mut backgrounds = vec![Vec::with_capacity(b); config.steps];
        let mut guesses = Vec::new();
        for object in 0..objects {
            for (i, &seed) in seeds.iter().enumerate() {
                let guess = match start {
                    None => None,
                    Some(start) => {
                        let own = if start.fits.len() == objects { object } else { object * seeds.len() + i };
                        let slice = tree_slice(&start.fits[own], depth)?;
                        Some(checkpoint.normalization.normalize(&slice))
                    }
                };
                let mut rng = ChaCha8Rng::seed_from_u64(seed);
                let mut one: Vec<f32> = (0..n * channel::COUNT).map(|_| StandardNormal.sample(&mut rng)).collect();
                match (&guess, start) {
                    (Some(guess), Some(start)) => {
                        config.coupling.pair(&mut one, guess);
                        one.iter_mut().for_each(|e| *e *= start.config.noise);
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
        let guess = start.is_some().then(|| tensor(guesses));
        let begin = start.map_or(0.0, |start| start.config.time);
        let z = match &guess {
            Some(guess) => noise.mul_scalar(1.0 - begin) + guess.clone().mul_scalar(begin),
            None => noise,
        };
        Ok(Self { z, guess, backgrounds })
    }
}
