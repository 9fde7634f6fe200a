//! What a run changes, as it lies in its folder: `state-000001000`, the latest one last.

use std::path::{Path, PathBuf};

use burn::{module::Module, store::ModuleRecord, tensor::Device};
use freerange_gaussians::{Normalization, channel};
use freerange_model::{Checkpoint, Compute, FreeRange, WeightsOrigin};
use freerange_util::{IoError, sync_folder, sync_tree};

use super::{Best, Initial, Trainer, encoder::require_same_encoder};
use crate::{
    TrainError,
    config::DataConfig,
    optimizer::AdamW,
    ranks::{Ranks, agree, from_first, same_on_all, tensor_of_first},
    weights::Weights,
};

/// The part of the state that is neither weights nor optimizer.
#[derive(Clone, Debug, serde::Serialize, serde::Deserialize)]
pub(super) struct Progress {
    pub(super) step: u64,
    pub(super) seconds: f64,
    pub(super) gradient_square: [f32; channel::COUNT],
    /// Whether the mean square of the gradient began with that of other weights.
    #[serde(default)]
    pub(super) inherited: bool,
    pub(super) normalization: Normalization,
    /// Number of the first object of the window that the next batch is drawn from; none where there are several virtual ranks.
    #[serde(default)]
    pub(super) first_object: Option<u64>,
    /// That number in each of several virtual ranks.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) first_objects: Vec<u64>,
    /// Objects before it that could not be read.
    #[serde(default)]
    pub(super) broken: u64,
    /// Steps whose loss or gradients were not finite.
    #[serde(default)]
    pub(super) skipped: u64,
    /// The best measurement so far.
    #[serde(default)]
    pub(super) best: Option<Best>,
    /// The step that the last measurement was made after; 0: none was. Left out where measurements came before every state.
    #[serde(default)]
    pub(super) measured: Option<u64>,
    /// The frozen encoder's weights; none of an encoder of its own, or of random ones.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) encoder: Option<WeightsOrigin>,
    /// What the run computes in; none in states of before this was recorded.
    #[serde(default)]
    pub(super) compute: Option<Compute>,
}

impl Progress {
    /// That of the state in `path`.
    fn load(path: &Path) -> Result<Self, TrainError> {
        let file = path.join("progress.json");
        let text = std::fs::read_to_string(&file).map_err(IoError::at(&file))?;
        serde_json::from_str(&text).map_err(|e| TrainError::State { path: file, problem: e.to_string() })
    }

    /// Of each virtual rank, the number of the first object of its window.
    pub(super) fn positions(&self, data: &DataConfig) -> Result<Vec<u64>, String> {
        match (data.virtual_ranks, self.first_objects.len()) {
            (1, 0) => Ok(vec![self.first_object.unwrap_or(self.step * data.fresh as u64)]),
            (virtual_ranks, 0) if self.step == 0 => Ok((0..virtual_ranks as u64).collect()),
            (virtual_ranks, found) if virtual_ranks == found => Ok(self.first_objects.clone()),
            (virtual_ranks, found) => Err(format!(
                "first_objects: expected {virtual_ranks}, one for each of data.virtual_ranks, found {found}"
            )),
        }
    }

    pub(super) fn set_positions(&mut self, positions: Vec<u64>) {
        match positions[..] {
            [only] => self.first_object = Some(only),
            _ => (self.first_object, self.first_objects) = (None, positions),
        }
    }
}

/// All that a run changes.
pub(super) struct State {
    pub(super) model: FreeRange,
    pub(super) average: Weights,
    pub(super) optimizer: AdamW,
    pub(super) progress: Progress,
}

impl State {
    /// The state saved in `path`, of a run whose frozen encoder is of `origin`.
    pub(super) fn load(
        path: &Path,
        model: FreeRange,
        origin: Option<&WeightsOrigin>,
        device: &Device,
    ) -> Result<Self, TrainError> {
        let state = |name: &str| path.join(name);
        let broken = |name: &str, e: String| TrainError::State { path: path.join(name), problem: e };
        let record = |name: &str| ModuleRecord::load(state(name)).map_err(|e| broken(name, e.to_string()));
        let average = model.clone().valid();
        let average = average.try_load_record(record("average")?).map_err(|e| broken("average", e.to_string()))?;
        let model = model.try_load_record(record("model")?).map_err(|e| broken("model", e.to_string()))?;
        let average = Weights::of(&average);
        let optimizer = AdamW::load(&state("optimizer.safetensors"), &average, device)?;
        let mut progress = Progress::load(path)?;
        progress.measured.get_or_insert(progress.step);
        let run = || format!("the run, in {}", state("progress.json").display());
        require_same_encoder(progress.encoder.as_ref(), origin, run)?;
        Ok(Self { model, average, optimizer, progress })
    }

    /// The state of rank 0, on every rank; others have none, and begin with `model`.
    pub(super) fn of_first(ranks: &dyn Ranks, own: Option<Self>, model: FreeRange) -> Result<Self, TrainError> {
        let text = own.as_ref().map(|own| serde_json::to_vec(&own.progress).expect("plain numbers"));
        let text = from_first(ranks, &text.unwrap_or_default())?;
        let progress = serde_json::from_slice(&text).map_err(|e| TrainError::Ranks { problem: e.to_string() })?;
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
    pub(super) fn begin(
        mut model: FreeRange,
        initial: Option<Initial>,
        normalization: Normalization,
        encoder: Option<WeightsOrigin>,
    ) -> Self {
        if let Some(Initial { checkpoint, .. }) = initial {
            let mut known = checkpoint.model.clone().take_dinov2().0;
            if model.dit().observed() > known.dit().observed() {
                known = known.with_place_channels();
            }
            model = Weights::of(&known).apply(model);
        }
        // The gradient by normalized Gaussians grows with what they were divided by.
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
            measured: Some(0),
            encoder,
            compute: None,
        };
        let average = Weights::of(&model);
        let optimizer = AdamW::new(average.0.len());
        Self { model, average, optimizer, progress }
    }
}

impl Trainer {
    /// Saves everything that [`Trainer::open`] needs to go on, and the checkpoint of the averaged weights beside it.
    ///
    /// The state is written into a folder of its own and becomes the latest one by a rename; then older ones go. Rank 0 does
    /// it, but all ranks must call it: their weights are compared before, and where it fails, it does on all of them.
    ///
    /// # Errors
    /// [`TrainError::Io`], [`TrainError::State`]; [`TrainError::Elsewhere`]; [`TrainError::Ranks`] where the ranks' weights have
    /// come apart.
    pub fn save(&self) -> Result<PathBuf, TrainError> {
        self.compare_weights()?;
        let path = self.folder.join("checkpoint.safetensors");
        let written = if self.ranks.rank() == 0 { self.write(&path) } else { Ok(()) };
        agree(&*self.ranks, written)?;
        Ok(path)
    }

    /// Writes the state, and the checkpoint to `path`.
    fn write(&self, path: &Path) -> Result<(), TrainError> {
        let target = self.folder.join(format!("state-{:09}", self.progress.step));
        let partial = self.folder.join("state.partial");
        if partial.exists() {
            std::fs::remove_dir_all(&partial).map_err(IoError::at(&partial))?;
        }
        std::fs::create_dir_all(&partial).map_err(IoError::at(&partial))?;
        let broken = |name: &str, e: String| TrainError::State { path: partial.join(name), problem: e };
        let average = self.averaged();
        let model = self.model().clone().into_record();
        model.save(partial.join("model")).map_err(|e| broken("model", e.to_string()))?;
        let record = average.clone().into_record();
        record.save(partial.join("average")).map_err(|e| broken("average", e.to_string()))?;
        self.optimizer.save(&partial.join("optimizer.safetensors"))?;
        let file = partial.join("progress.json");
        let text = serde_json::to_string_pretty(&self.progress).expect("plain numbers");
        std::fs::write(&file, text).map_err(IoError::at(&file))?;
        sync_tree(&partial).map_err(IoError::at(&partial))?;
        if target.exists() {
            std::fs::remove_dir_all(&target).map_err(IoError::at(&target))?;
        }
        std::fs::rename(&partial, &target).map_err(IoError::at(&target))?;
        // Not before the new state outlives a power cut may the older ones go.
        sync_folder(&self.folder).map_err(IoError::at(&self.folder))?;
        for old in states(&self.folder)? {
            if old != target {
                std::fs::remove_dir_all(&old).map_err(IoError::at(&old))?;
            }
        }
        Ok(self.checkpoint(average)?.save(path)?)
    }

    /// Refuses ranks whose weights are not those of rank 0 to the bit.
    fn compare_weights(&self) -> Result<(), TrainError> {
        if self.ranks.world() == 1 {
            return Ok(());
        }
        let own = [("weights", Weights::of(self.model()).checksum()), ("averaged weights", self.average.checksum())];
        let own = own.map(|(what, value)| (format!("{what} after step {}", self.progress.step), value));
        same_on_all(&*self.ranks, &own).map_err(|e| TrainError::Ranks { problem: e.to_string() })
    }
}

fn states(folder: &Path) -> Result<Vec<PathBuf>, TrainError> {
    let entries = std::fs::read_dir(folder).map_err(IoError::at(folder))?;
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

pub(super) fn latest_state(folder: &Path) -> Result<Option<PathBuf>, TrainError> {
    Ok(states(folder)?.pop())
}

/// What the run in `folder` computes in, where its latest state says so.
pub(super) fn recorded_compute(folder: &Path) -> Result<Option<Compute>, TrainError> {
    Ok(latest_state(folder)?.map(|path| Progress::load(&path)).transpose()?.and_then(|progress| progress.compute))
}
