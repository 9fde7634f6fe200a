//! What a checkpoint says of its own use, as types: `network_views`, `sample`, `refiner` and their schema number in the
//! checkpoint's metadata.

use freerange_model::Compute;
use freerange_util::Invalid;
use serde_json::{Value, json};

use crate::{
    FlowError,
    sample::{FlowConfig, GradientAt, RefinerConfig, SETTINGS_SCHEMA},
};

/// How a model is used, unless the user says otherwise.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Most views that the model has seen at once in training.
    pub network_views: usize,
    /// How it is sampled from.
    pub sample: FlowConfig,
    /// How it refines Gaussians; none if it was not trained to.
    pub refiner: Option<RefinerConfig>,
}

/// The schema since which the default precision is automatic. Before, f32 was recorded where nobody had chosen.
const AUTOMATIC: u64 = 6;
/// The paper's number of input views.
const PAPERS_VIEWS: usize = 4;

impl Settings {
    /// Reads the metadata of a checkpoint; the paper's settings where it says nothing.
    ///
    /// # Errors
    /// Names the field that cannot be used, or says that a later program has made the checkpoint.
    pub fn of(provenance: &Value) -> Result<Self, FlowError> {
        let schema = provenance.get("settings_schema");
        let number = schema.map_or(Some(1), Value::as_u64).filter(|n| *n <= SETTINGS_SCHEMA.into());
        let Some(number) = number else {
            let expected = format!("a number up to {SETTINGS_SCHEMA}: a later program has made the checkpoint");
            let found = schema.map_or_else(String::new, ToString::to_string);
            return Err(Invalid::new(field("settings_schema"), expected, found).into());
        };
        let (mut sample, mut refiner) = match (provenance.get("sample"), number) {
            (None, _) => (FlowConfig::default(), None),
            (Some(value), 1) => converted(value)?,
            (Some(value), _) => {
                let refiner = provenance.get("refiner").filter(|r| !r.is_null());
                (parsed("sample", value)?, refiner.map(|r| parsed("refiner", r)).transpose()?)
            }
        };
        if number < AUTOMATIC {
            let of_refiner = refiner.as_mut().map(|r| &mut r.compute);
            std::iter::once(&mut sample.compute).chain(of_refiner).filter(|c| **c == Compute::F32).for_each(|c| {
                *c = Compute::Auto;
            });
        }
        sample.validate().map_err(|e| e.within(&field("sample")))?;
        refiner.as_ref().map_or(Ok(()), RefinerConfig::validate).map_err(|e| e.within(&field("refiner")))?;
        let views = provenance.get("network_views").or_else(|| provenance.pointer("/configuration/loss/input_views/1"));
        let views = views.and_then(Value::as_u64).and_then(|n| n.try_into().ok()).filter(|n| *n > 0);
        Ok(Self { network_views: views.unwrap_or(PAPERS_VIEWS), sample, refiner })
    }

    /// Writes them into the metadata of a checkpoint, an object.
    pub fn write(&self, provenance: &mut serde_json::Map<String, Value>) {
        provenance.insert("settings_schema".into(), SETTINGS_SCHEMA.into());
        provenance.insert("network_views".into(), self.network_views.into());
        provenance.insert("sample".into(), json!(self.sample));
        provenance.insert("refiner".into(), json!(self.refiner));
    }
}

fn field(name: &str) -> String {
    format!("checkpoint: field `{name}` of the metadata")
}

fn parsed<T: serde::de::DeserializeOwned>(name: &str, value: &Value) -> Result<T, FlowError> {
    serde_json::from_value(value.clone()).map_err(|e| Invalid::new(field(name), "settings of this program", e).into())
}

/// Photometric guidance of models whose settings say nothing of it in today's units.
const LAMBDA_PG: f32 = 10.0;

/// Settings of schema 1, in which one table held sampling from noise, network refinement and what follows it. The latter
/// belongs to the pipeline's presets now. Fields that were left out had the defaults of then, which are still these, but for
/// the precision ([`AUTOMATIC`]).
fn converted(value: &Value) -> Result<(FlowConfig, Option<RefinerConfig>), FlowError> {
    let get = |name: &str| value.get(name).filter(|v| !v.is_null());
    let fixed_point = get("solver").is_some_and(|s| s == "hold");
    if get("start").is_some() != fixed_point {
        let expected = "a start from initial fits with fixed-point refinement, or neither";
        return Err(Invalid::new(field("sample"), expected, value).into());
    }
    let pick = |from: &[(&str, &str)]| -> Value {
        let found = from.iter().filter_map(|(now, then)| Some(((*now).to_owned(), get(then)?.clone())));
        Value::Object(found.collect())
    };
    let mut flow: FlowConfig = parsed(
        "sample",
        &pick(&[
            ("steps", "steps"),
            ("lod_depth", "depth"),
            ("cfg_scale", "cfg_scale"),
            ("lambda_pg", "lambda_pg"),
            ("gradient_at", "gradient_at"),
            ("gradient_size", "gradient_size"),
            ("background", "background"),
            ("coupling", "coupling"),
            ("compute", "compute"),
        ]),
    )?;
    // Guidance along a rescaled gradient is no more.
    if get("photometric_step").is_some_and(|s| s == "scaled") && (flow.lambda_pg > 0.0 || fixed_point) {
        flow.lambda_pg = LAMBDA_PG;
    }
    if !fixed_point {
        return Ok((flow, None));
    }
    let refiner = parsed(
        "sample",
        &pick(&[
            ("passes", "steps"),
            ("retokenize_every", "regroup"),
            ("lod_depth", "depth"),
            ("gradient_size", "gradient_size"),
            ("compute", "compute"),
        ]),
    )?;
    let defaults = FlowConfig::default();
    let steps = value.pointer("/from_noise/steps").and_then(Value::as_u64).and_then(|n| n.try_into().ok());
    flow.steps = steps.unwrap_or(defaults.steps);
    flow.background = defaults.background;
    flow.gradient_at = GradientAt::Estimate;
    Ok((flow, Some(refiner)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn written_settings_are_read_again() {
        let settings = Settings {
            network_views: 6,
            sample: FlowConfig { steps: 7, ..FlowConfig::default() },
            refiner: Some(RefinerConfig { passes: 3, ..RefinerConfig::default() }),
        };
        let mut provenance = serde_json::Map::new();
        settings.write(&mut provenance);
        assert_eq!(Settings::of(&provenance.clone().into()).unwrap(), settings);
        let plain = Settings { refiner: None, ..settings };
        plain.write(&mut provenance);
        assert_eq!(Settings::of(&provenance.into()).unwrap(), plain);
    }

    #[test]
    fn settings_of_before_are_converted() {
        let start =
            json!({ "time": 0.0, "noise": 0.0, "fit": { "gaussians": 2048, "iterations": 200, "render_size": 128 } });
        let sample = json!({
            "steps": 12, "solver": "hold", "regroup": 4, "depth": 11, "start": start, "cfg_scale": 1.0, "lambda_pg": 0.0,
            "photometric_step": "scaled", "photometric_repeats": 8, "gradient_at": "estimate", "gradient_size": 128,
            "background": "white", "coupling": "tree", "mirror": 1.05, "turn": 0.85, "refine": 500, "ensemble": 4,
            "from_noise": { "steps": 40, "solver": "euler", "lambda_pg": 0.035, "mend": 4 }
        });
        let found = Settings::of(&json!({ "sample": sample, "configuration": { "loss": { "input_views": [2, 6] } } }));
        let found = found.unwrap();
        assert_eq!(found.network_views, 6);
        let refiner = found.refiner.unwrap();
        assert_eq!((refiner.passes, refiner.retokenize_every, refiner.lod_depth), (12, 4, Some(11)));
        assert_eq!((refiner.gradient_size, found.sample.gradient_size), (128, 128));
        assert_eq!((found.sample.steps, found.sample.cfg_scale, found.sample.lambda_pg), (40, 1.0, LAMBDA_PG));
        assert_eq!(found.sample.background, FlowConfig::default().background);

        // Automatic since schema 6, when f32 became a choice.
        assert_eq!((refiner.compute, found.sample.compute), (Compute::Auto, Compute::Auto));
        for (schema, expected) in [(5, Compute::Auto), (6, Compute::F32)] {
            let record =
                json!({ "settings_schema": schema, "sample": { "compute": "f32" }, "refiner": { "compute": "f32" } });
            let Settings { sample, refiner, .. } = Settings::of(&record).unwrap();
            assert_eq!((sample.compute, refiner.unwrap().compute), (expected, expected));
        }

        let paper = Settings::of(&json!({ "sample": { "cfg_scale": 1.5, "steps": 20 } })).unwrap();
        assert_eq!((paper.sample.cfg_scale, paper.sample.lambda_pg, paper.sample.steps), (1.5, 50.0, 20));
        assert!(paper.refiner.is_none() && paper.network_views == PAPERS_VIEWS);
        let other = json!({ "sample": { "solver": "euler", "start": { "time": 0.3 } } });
        assert!(Settings::of(&other).unwrap_err().to_string().contains("field `sample`"));
    }

    #[test]
    fn settings_of_later_programs_are_refused() {
        for later in [json!(SETTINGS_SCHEMA + 1), json!("1"), Value::Null] {
            let error = Settings::of(&json!({ "settings_schema": later })).unwrap_err().to_string();
            assert!(error.contains("settings_schema"), "{error}");
        }
        let unknown = json!({ "settings_schema": SETTINGS_SCHEMA, "sample": { "color": 1 } });
        let error = Settings::of(&unknown).unwrap_err().to_string();
        assert!(error.contains("`sample`") && error.contains("color"), "{error}");
    }
}
