//! Records hold every field: a field that is left out where it equals today's default says something else tomorrow.

use freerange_diffusion::sample::{FlowConfig, RefinerConfig};
use freerange_model::{Dinov2Config, ModelConfig, PatchConfig};
use freerange_train::{
    ValidationConfig,
    config::{FrameJitter, LossConfig, OptimizerConfig, RefinementLoss, Stage, Symmetries},
};
use serde::{Serialize, de::DeserializeOwned};
use serde_json::{Value, json};

/// The names that a struct can be read from: serde lists them where it refuses another one.
fn names<T: DeserializeOwned>() -> Vec<String> {
    let refusal = serde_json::from_value::<T>(json!({ "?": 0 })).err().expect("no such field").to_string();
    let names: Vec<String> = refusal.split('`').skip(3).step_by(2).map(str::to_owned).collect();
    assert!(!names.is_empty(), "{refusal}");
    names
}

/// Names of fields that a record of `value` lacks.
fn missing<T: Serialize + DeserializeOwned>(value: &T) -> Vec<String> {
    let record = serde_json::to_value(value).unwrap();
    names::<T>().into_iter().filter(|name| record.get(name).is_none()).collect()
}

#[test]
fn every_field_of_every_setting_is_recorded() {
    let refinement = RefinementLoss { share: 0.5, render_weight: 20.0 };
    let stage: Stage = serde_json::from_value(json!({ "depth": 4, "image_size": 16, "batch": 2, "steps": 1 })).unwrap();
    let found = [
        missing(&FlowConfig::default()),
        missing(&RefinerConfig::default()),
        missing(&LossConfig::default()),
        missing(&refinement),
        missing(&FrameJitter::default()),
        missing(&Symmetries::default()),
        missing(&OptimizerConfig::default()),
        missing(&stage),
        missing(&ValidationConfig::default()),
        missing(&ModelConfig::default()),
        missing(&PatchConfig::default()),
        missing(&Dinov2Config::default()),
    ];
    assert!(found.iter().all(Vec::is_empty), "left out: {found:?}");
}

#[test]
fn a_record_is_read_as_what_was_recorded() {
    let sample = FlowConfig { steps: 20, cfg_scale: 1.5, ..FlowConfig::default() };
    let record = serde_json::to_value(&sample).unwrap();
    assert_eq!((&record["steps"], &record["cfg_scale"]), (&json!(20), &json!(1.5)));
    assert_eq!(record["lod_depth"], Value::Null);
    assert_eq!(serde_json::from_value::<FlowConfig>(record).unwrap(), sample);
}
