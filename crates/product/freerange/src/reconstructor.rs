//! A model on a device: the front door of the pipeline.

use std::path::Path;

use freerange_diffusion::settings::Settings;
use freerange_model::Checkpoint;
use freerange_scene::camera::FrameConfig;
use freerange_util::ensure;

use crate::{
    Choices, Device, EncoderPlaces, Error, Init, Options,
    checkpoint::load_checkpoint,
    error::{Beneath, Lift},
};

/// A model on a device, ready to reconstruct one object after the other. It can be shared between threads.
#[derive(Clone, Debug)]
pub struct Reconstructor {
    checkpoint: Checkpoint,
    device: Device,
}

impl Reconstructor {
    /// The model that is part of the library (feature `embedded`, 40 MB).
    ///
    /// # Errors
    /// If the device fails.
    #[cfg(feature = "embedded")]
    pub fn shipped(device: &Device) -> Result<Self, Error> {
        Ok(Self::new(load_checkpoint(None, &EncoderPlaces::default(), device)?, device))
    }

    /// A model from a file. The weights of a frozen encoder are looked for in `encoders`.
    ///
    /// # Errors
    /// Names the file and what is wrong with it.
    pub fn load(checkpoint: &Path, encoders: &EncoderPlaces, device: &Device) -> Result<Self, Error> {
        Ok(Self::new(load_checkpoint(Some(checkpoint), encoders, device)?, device))
    }

    /// A model on `device`, where its checkpoint is already.
    pub(crate) fn new(checkpoint: Checkpoint, device: &Device) -> Self {
        Self { checkpoint, device: device.clone() }
    }

    /// The model.
    pub(crate) fn checkpoint(&self) -> &Checkpoint {
        &self.checkpoint
    }

    /// How the model was made, as its checkpoint says it.
    pub fn provenance(&self) -> &serde_json::Value {
        &self.checkpoint.provenance
    }

    /// Where it computes.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// The model's own pipeline at the default quality: one sample of seed 0, +z up.
    ///
    /// # Errors
    /// If what the checkpoint says of its use cannot be read.
    pub fn options(&self) -> Result<Options, Error> {
        self.options_of(&Choices::default())
    }

    /// The same with what a user chooses.
    ///
    /// # Errors
    /// Names the choice that cannot be followed.
    pub fn options_of(&self, choices: &Choices) -> Result<Options, Error> {
        Ok(Options {
            pipeline: choices.pipeline(&self.checkpoint)?,
            seeds: vec![0],
            init: None,
            frame: FrameConfig::default(),
            without_network: false,
        })
    }

    /// Most views that the network sees by default: as many as at once in training.
    ///
    /// # Errors
    /// If what the checkpoint says of its use cannot be read.
    pub fn network_views(&self) -> Result<usize, Error> {
        Ok(Settings::of(&self.checkpoint.provenance).lift()?.network_views)
    }

    /// Gaussians that the network makes by default, before the optimization; of a pixel-aligned model for as many views as it
    /// sees.
    ///
    /// # Errors
    /// If what the checkpoint says of its use cannot be read.
    pub fn gaussians(&self) -> Result<usize, Error> {
        network_gaussians(&self.checkpoint.config, &self.checkpoint.provenance, self.checkpoint.depth)
    }

    /// Refuses options that this model or its device cannot follow.
    ///
    /// # Errors
    /// Names the option.
    pub fn check(&self, options: &Options) -> Result<(), Error> {
        let config = &options.pipeline;
        config.validate()?;
        let kind = self.checkpoint.config.kind;
        let own = Settings::of(&self.checkpoint.provenance).lift()?;
        config.propose.flow.validate_for(kind, &own.sample).map_err(|e| e.within("propose.flow").lift())?;
        let sampled = config.propose.init == Init::Flow && options.init.is_none();
        let only = |ok: bool, field: &str, expected: &str, found: String| {
            let expected = format!("{expected}: a {} model predicts in one pass", kind.name());
            ensure(ok, field, &expected, found).lift()
        };
        if kind.one_pass() {
            only(options.seeds.len() <= 1, "seeds", "one sample", options.seeds.len().to_string())?;
            only(config.propose.count == 1, "propose.count", "1", config.propose.count.to_string())?;
            only(config.refine.is_none(), "refine", "none", "some".into())?;
        }
        if config.refine.is_none() && (!sampled || options.without_network) {
            let expected = "samples of the flow, which is all that this model was trained for";
            let found = if options.init.is_some() { "Gaussians to begin with" } else { "initial fits" };
            return Err(Error::input("propose.init", expected, found));
        }
        if options.without_network && sampled {
            return Err(Error::input("propose.init", "fit where the network is left out", "flow"));
        }
        if config.refine.is_some() && own.refiner.is_none() {
            return Err(Error::input("refine", "none: the model was not trained to refine", "some"));
        }
        let compute = match &config.refine {
            Some(refine) => refine.compute,
            None => config.propose.flow.compute,
        };
        self.device.require(compute)
    }
}

/// Gaussians that a network with this configuration and provenance, trained at this depth, makes by default.
///
/// # Errors
/// If what the provenance says of its use cannot be read.
pub fn network_gaussians(
    config: &freerange_model::ModelConfig,
    provenance: &serde_json::Value,
    depth: u32,
) -> Result<usize, Error> {
    let Settings { network_views, sample, refiner } = Settings::of(provenance).lift()?;
    let own = refiner.map_or(sample.lod_depth, |r| r.lod_depth);
    Ok(config.gaussians(own.unwrap_or(depth), network_views))
}
