//! The start of a run, or its continuation: what all ranks have to agree on before the first step.

use std::{path::Path, sync::Arc};

use burn::tensor::Device;
use freerange_data::{Making, ObjectSource};
use freerange_model::{Compute, Dinov2, EncoderConfig, EncoderWeights, FreeRange, WeightsOrigin};
use freerange_util::{Invalid, sha256};

use super::{
    Trainer,
    among::{Among, Initial},
    encoder::{load_encoder, require_same_encoder, require_same_model},
    folder::claim,
    objects::{normalization, training_objects, validation_objects},
    state::{State, latest_state, recorded_compute},
    virtual_ranks::virtual_ranks,
};
use crate::{
    TrainError,
    batch::step_rng,
    config::TrainConfig,
    ranks::{Ranks, agree, from_first, same_on_all},
    validation::Validation,
};
use freerange_diffusion::photometric::Photometric;

impl Trainer {
    /// Starts a run in `folder`, or goes on with the one that is there.
    ///
    /// `initial`: weights to start a new run from; ignored by a run that goes on.
    ///
    /// # Errors
    /// Settings, data or a state that cannot be used; a frozen encoder without weights.
    pub fn open<M: Making>(
        config: TrainConfig<M>,
        folder: &Path,
        initial: Option<Initial>,
        device: &Device,
        progress: impl FnMut(&str),
    ) -> Result<Self, TrainError> {
        Self::open_with(config, folder, initial, None, device, progress)
    }

    /// [`open`](Self::open) with the weights of a frozen encoder.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn open_with<M: Making>(
        config: TrainConfig<M>,
        folder: &Path,
        initial: Option<Initial>,
        encoder: Option<&EncoderWeights>,
        device: &Device,
        progress: impl FnMut(&str),
    ) -> Result<Self, TrainError> {
        Self::open_among(Among::single(), config, folder, initial, encoder, device, progress)
    }

    /// [`open_with`](Self::open_with) on several ranks, all of which must call it. Only rank 0 reads and writes the folder, and
    /// only its `initial` matters.
    ///
    /// # Errors
    /// As [`open`](Self::open); [`TrainError::Differs`]; [`TrainError::Elsewhere`] where another rank has one of these.
    pub fn open_among<M: Making>(
        among: Among,
        config: TrainConfig<M>,
        folder: &Path,
        initial: Option<Initial>,
        encoder: Option<&EncoderWeights>,
        device: &Device,
        mut progress: impl FnMut(&str),
    ) -> Result<Self, TrainError> {
        let ranks = &*among.ranks;
        let share = [ranks.rank(), ranks.world()];
        let plain = device.clone().inner();
        let prepared = agree(ranks, Prepared::new(&config, initial, encoder, share, &plain, &mut progress))?;
        prepared.require_same_on_all(&among, &config)?;
        if let Some(validation) = &prepared.validation {
            validation.require_comparisons(ranks, &config)?;
        }
        // Not before the data are there: a folder that holds a configuration belongs to a run.
        let lock = agree(ranks, if share[0] == 0 { claim(&config, folder).map(Some) } else { Ok(None) })?;
        let compute = compute_of_run(ranks, config.optimizer.compute, folder, &plain)?;
        progress(&format!("computing in {compute}"));
        let described = serde_json::to_value(&config).expect("a configuration is plain");
        let (config, _) = config.apart();
        let (model, frozen) = agree(ranks, prepared.model(&config, compute, &plain))?;
        let Prepared { source, validation, origin, .. } = prepared;
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
        let state = agree(ranks, if share[0] == 0 { begin().map(Some) } else { Ok(None) })?;
        let State { model, average, optimizer, progress: mut state } = match state {
            Some(state) if share[1] == 1 => state,
            state => State::of_first(ranks, state, model)?,
        };
        let positions = state
            .positions(&config.data)
            .map_err(|problem| TrainError::State { path: folder.join("progress.json"), problem })?;
        progress(&format!("filling the window with {} objects", config.data.window));
        let virtual_ranks = agree(ranks, virtual_ranks(&config.data, &positions, share, &source))?;
        state.set_positions(positions);
        state.compute = Some(compute);
        Ok(Self {
            photometric: Photometric::new(&state.normalization, &plain),
            config,
            described,
            device: plain,
            model: Some(model),
            frozen,
            average,
            optimizer,
            broken: state.broken,
            progress: state,
            ranks: among.ranks,
            virtual_ranks,
            stop_when: Box::new(|| false),
            interrupt_when: Box::new(|| false),
            ahead: None,
            not_finite: 0,
            no_gradient: 0,
            validation,
            folder: folder.into(),
            _lock: lock,
        })
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
    fn new<M: Making>(
        config: &TrainConfig<M>,
        initial: Option<Initial>,
        encoder: Option<&EncoderWeights>,
        [rank, world]: [usize; 2],
        device: &Device,
        progress: &mut impl FnMut(&str),
    ) -> Result<Self, TrainError> {
        config.validate()?;
        let virtual_ranks = config.data.virtual_ranks;
        if !virtual_ranks.is_multiple_of(world) {
            let expected = format!("a multiple of the number of ranks, {world}");
            return Err(Invalid::new("data.virtual_ranks", expected, virtual_ranks).into());
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

    /// Refuses processes that were not told the same.
    fn require_same_on_all<M: Making>(&self, among: &Among, config: &TrainConfig<M>) -> Result<(), TrainError> {
        if among.ranks.world() == 1 {
            return Ok(());
        }
        let encoder = self.origin.as_ref().map_or("none".into(), |origin| origin.sha256.clone());
        let own =
            [("configuration", fingerprint(config)), ("data", self.manifest.clone()), ("encoder weights", encoder)];
        let own = own.map(|(what, value)| (what.to_owned(), value));
        same_on_all(&*among.ranks, &[among.identity.clone(), own.to_vec()].concat())
    }

    /// A new model, without the frozen encoder, which stands beside it: states and averages are of what is trained.
    fn model(
        &self,
        config: &TrainConfig,
        compute: Compute,
        device: &Device,
    ) -> Result<(FreeRange, Option<Dinov2>), TrainError> {
        let tracked = device.clone().autodiff();
        let mut model = FreeRange::new(&config.model, &mut step_rng(config.seed, u64::MAX), &tracked)?;
        if let Some(encoder) = &self.encoder {
            model = model.with_dinov2(&config.model, encoder.clone())?;
        }
        Ok(model.with_compute(compute).with_recompute(config.optimizer.recompute).take_dinov2())
    }
}

/// What a run computes in. What is automatic is chosen once, by rank 0, and recorded in the run's state: other ranks, and the
/// machine on which the run goes on, may have other processors, and another precision gives other bits.
fn compute_of_run(ranks: &dyn Ranks, compute: Compute, folder: &Path, device: &Device) -> Result<Compute, TrainError> {
    if compute != Compute::Auto {
        return Ok(compute);
    }
    let choose = || Ok(recorded_compute(folder)?.unwrap_or_else(|| compute.on(device)));
    let chosen = agree(ranks, if ranks.rank() == 0 { choose().map(Some) } else { Ok(None) })?;
    let chosen = serde_json::to_vec(&chosen).expect("a name");
    let chosen = serde_json::from_slice::<Option<Compute>>(&from_first(ranks, &chosen)?)
        .map_err(|e| TrainError::Ranks { problem: e.to_string() })?
        .expect("rank 0 chose");
    let refused = || {
        let found = format!("auto, which is {chosen} in this run, on a device of rank {} without it", ranks.rank());
        Invalid::new("optimizer.compute", "what the devices of all ranks can do", found)
    };
    agree(ranks, if chosen.supported(device) { Ok(()) } else { Err(refused().into()) })?;
    Ok(chosen)
}

/// What has to be alike in the configurations of all ranks, in short.
fn fingerprint<M: Making>(config: &TrainConfig<M>) -> String {
    let mut c = config.clone();
    c.data.workers = 0;
    // These may lie elsewhere on each machine, and are compared by what is in them.
    c.data.shards = None;
    if let EncoderConfig::Dinov2(encoder) = &mut c.model.encoder {
        encoder.weights = None;
    }
    sha256(&serde_json::to_vec(&c).expect("a configuration is plain"))
}
