//! The frozen encoder: the right weights, or none.

use burn::tensor::Device;
use freerange_model::{Dinov2, EncoderConfig, EncoderWeights, ModelConfig, WeightsOrigin};
use freerange_util::Invalid;

use crate::TrainError;

/// Weights fit only the architecture they were trained in; the image size may differ.
pub(super) fn require_same_model(model: &ModelConfig, given: &ModelConfig) -> Result<(), TrainError> {
    let mut given = ModelConfig { image_size: model.image_size, ..given.architecture() };
    // What it was not told yet it can be.
    given.place_channels |= model.place_channels && given.observation_channels;
    let model = model.architecture();
    if given == model {
        return Ok(());
    }
    let expected = format!("the architecture of the initial checkpoint, {given:?}");
    Err(Invalid::new("model", expected, format!("{model:?}")).into())
}

/// The frozen encoder, on `device`; `Ok(None)` where there is none, or a random one will do.
pub(super) fn load_encoder(
    config: &EncoderConfig,
    weights: Option<&EncoderWeights>,
    device: &Device,
    progress: &mut impl FnMut(&str),
) -> Result<Option<Dinov2>, TrainError> {
    let refuse = |field: &str, expected: &str, found: &str| Err(Invalid::new(field, expected, found).into());
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
pub(super) fn require_same_encoder(
    theirs: Option<&WeightsOrigin>,
    ours: Option<&WeightsOrigin>,
    who: impl FnOnce() -> String,
) -> Result<(), TrainError> {
    if theirs.map(|w| &w.sha256) == ours.map(|w| &w.sha256) {
        return Ok(());
    }
    let text = |w: Option<&WeightsOrigin>| w.map_or("none".into(), |w| format!("{} (sha256 {})", w.name, w.sha256));
    let expected = format!("those of {}, {}", who(), text(theirs));
    Err(Invalid::new("model.encoder.weights", expected, text(ours)).into())
}
