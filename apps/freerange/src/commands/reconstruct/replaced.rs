//! The result that a new one replaces, for a note.

use std::{
    fs,
    path::{Path, PathBuf},
    time::Duration,
};

use freerange::{Choices, PipelineConfig, Quality, Reconstructor};
use serde::Deserialize;
use serde_json::Value;

use super::{GAUSSIANS, REPORT};

/// What a report says of the result beside it.
#[derive(Deserialize)]
struct Report {
    scene: PathBuf,
    pipeline: Value,
    samples: Vec<Sample>,
}

#[derive(Deserialize)]
struct Sample {
    seed: u64,
}

const PRESETS: [(&str, Quality); 3] =
    [("draft", Quality::Draft), ("default", Quality::Default), ("high", Quality::High)];

/// A note on the result in `folder`, if there is one. It stays until the new one is complete.
pub fn note(folder: &Path, model: &Reconstructor) -> Option<String> {
    let there = |name: &'static str| Some((name, fs::metadata(folder.join(name)).ok()?));
    let (name, data) = [REPORT, GAUSSIANS].into_iter().find_map(there)?;
    // Reports of other versions, or of other commands, may have other fields.
    let report = fs::read(folder.join(REPORT)).ok().and_then(|text| serde_json::from_slice::<Report>(&text).ok());
    let what = match report {
        Some(report) => format!("a result of {}", described(&report, |quality| preset(model, quality))),
        None => format!("another {name}"),
    };
    let age = data.modified().ok().and_then(|time| time.elapsed().ok()).map(ago).unwrap_or_default();
    Some(format!("{} holds {what}{age}: it is replaced when this one is done", folder.display()))
}

/// The scene, the preset and the seeds of a result.
fn described(report: &Report, preset: impl Fn(Quality) -> Option<Value>) -> String {
    let same = |quality: Quality| preset(quality).is_some_and(|preset| preset == report.pipeline);
    let quality = PRESETS.into_iter().find(|(_, quality)| same(*quality)).map_or("no preset", |(name, _)| name);
    let seeds: Vec<String> = report.samples.iter().map(|sample| sample.seed.to_string()).collect();
    format!("{} ({quality}, seed {})", report.scene.display(), seeds.join(", "))
}

/// A preset of the model, as reports have it.
fn preset(model: &Reconstructor, quality: Quality) -> Option<Value> {
    let options = model.options_of(&Choices { quality, ..Choices::default() }).ok()?;
    reported(&options.pipeline)
}

/// A pipeline as it is read from a report: numbers go through text there.
fn reported(pipeline: &PipelineConfig) -> Option<Value> {
    serde_json::from_str(&serde_json::to_string(pipeline).ok()?).ok()
}

/// `, made 5 minutes ago`
fn ago(age: Duration) -> String {
    let seconds = age.as_secs();
    let (count, unit) = match seconds {
        0..60 => (seconds, "second"),
        60..3600 => (seconds / 60, "minute"),
        3600..86_400 => (seconds / 3600, "hour"),
        _ => (seconds / 86_400, "day"),
    };
    format!(", made {count} {unit}{} ago", if count == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_result_is_described_by_scene_preset_seeds_and_age() {
        let text = json!({ "scene": "photos/mug", "pipeline": { "a": 2 }, "samples": [{ "seed": 0 }, { "seed": 1 }] });
        let report: Report = serde_json::from_value(text).unwrap();
        let of = |high: u32| described(&report, |q| Some(json!({ "a": if q == Quality::High { high } else { 1 } })));
        assert_eq!(of(2), "photos/mug (high, seed 0, 1)");
        assert_eq!(of(3), "photos/mug (no preset, seed 0, 1)");
        let made = |seconds: u64| ago(Duration::from_secs(seconds));
        assert_eq!((made(1), made(119)), (", made 1 second ago".into(), ", made 1 minute ago".into()));
        assert_eq!((made(7200), made(260_000)), (", made 2 hours ago".into(), ", made 3 days ago".into()));
    }
}
