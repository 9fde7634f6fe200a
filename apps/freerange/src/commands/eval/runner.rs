//! Measures methods on objects, case by case, so that a run can be stopped at any time and gone on with.

use std::{sync::Arc, time::Instant};

use burn::tensor::Device;
use freerange_camera::{View, image_ops::composite};
use freerange_eval::{
    EvalObject, Pair, Report, RunFolder, Scorer,
    html::{Embed, html},
    record::{Case, Measured, Outcome, Record, SampleScores, ViewScores, ViewSet, means, style},
    statistics::deviation,
    strip,
};
use freerange_model::Checkpoint;
use freerange_splat::Cloud;

use super::{
    args::Pictures,
    methods::{Made, Method},
    sources::Source,
};
use crate::{
    error::CliError,
    pictures::{WHITE, render_view},
    progress::Progress,
    runtime::{commit, peak_memory, reset_peak_memory},
};

/// One set of settings with its folder.
pub struct Run {
    /// What is measured.
    pub method: Method,
    /// Where results go.
    pub folder: RunFolder,
    /// What the numbers depend on.
    pub settings: serde_json::Value,
    /// From where the inputs look.
    pub views: Vec<ViewSet>,
    /// Numbers of inputs.
    pub inputs: Vec<usize>,
    /// What stands before an object's name on the screen.
    pub prefix: String,
}

/// What all runs share.
pub struct Shared {
    /// The objects.
    pub source: Source,
    /// The metrics.
    pub scorer: Scorer,
    /// The model, if a run uses one.
    pub checkpoint: Option<Arc<Checkpoint>>,
    /// Where to compute.
    pub device: Device,
    /// Which pictures are made.
    pub pictures: Pictures,
    /// Which of so many shares of the objects is worked on.
    pub share: (usize, usize),
    /// Print nothing but the progress bar.
    pub quiet: bool,
}

impl Run {
    fn cases(&self, object: &str) -> Vec<Case> {
        let case = |views: ViewSet, inputs: usize| Case { object: object.into(), views, inputs };
        self.views.iter().flat_map(|&v| self.inputs.iter().map(move |&n| case(v, n))).collect()
    }
}

/// Works on every case that is not done yet. An object that is broken is recorded as failed, and the others go on.
pub fn work(runs: &[Run], shared: &Shared) -> Result<(), CliError> {
    let (share, shares) = shared.share;
    let names: Vec<(usize, &String)> =
        shared.source.names().iter().enumerate().filter(|(i, _)| i % shares == share).collect();
    let per_object: usize = runs.iter().map(|r| r.views.len() * r.inputs.len()).sum();
    let mut bar = Progress::new("evaluating", (names.len() * per_object) as u64);
    for (number, &(index, name)) in names.iter().enumerate() {
        let mut open = Vec::new();
        for run in runs {
            for case in run.cases(name) {
                if !run.folder.is_done(&case)? {
                    open.push((run, case));
                }
            }
        }
        let mut done = (number + 1) * per_object - open.len();
        bar.at(done as u64, name);
        if open.is_empty() {
            continue;
        }
        let object = shared.source.load(index).map_err(|e| e.to_string());
        for (run, case) in open {
            let outcome = match &object {
                Ok(object) => measure_case(run, &case, object, shared)?,
                Err(reason) => Outcome::Failed { reason: reason.clone() },
            };
            let record = Record { case, outcome };
            // What has numbers was written with its picture.
            if !matches!(record.outcome, Outcome::Measured(_)) {
                run.folder.write(&record, &[], None)?;
            }
            if !shared.quiet {
                bar.line(&line(run, &record));
            }
            done += 1;
            bar.at(done as u64, name);
        }
    }
    bar.finish();
    Ok(())
}

/// Measures one case and, where that works out, writes its record. Only a folder that cannot be written to is an error.
fn measure_case(run: &Run, case: &Case, object: &EvalObject, shared: &Shared) -> Result<Outcome, CliError> {
    let failed = |e: String| Ok(Outcome::Failed { reason: e });
    let inputs = match object.inputs(case.views, case.inputs) {
        Ok(Ok(inputs)) => inputs,
        Ok(Err(reason)) => return Ok(Outcome::Skipped { reason }),
        Err(e) => return failed(CliError::from(e).to_string()),
    };
    // A peak that is not this case's own is no answer.
    let can_measure = reset_peak_memory();
    let begin = Instant::now();
    let made = match run.method.make(&case.object, case.views, &inputs, shared.checkpoint.as_deref(), &shared.device) {
        Ok(made) => made,
        Err(e) => return failed(e.to_string()),
    };
    let seconds = begin.elapsed().as_secs_f64() / made.clouds.len().max(1) as f64;
    let memory = if can_measure { peak_memory() } else { None };
    let (mut measured, features, picture) = match score(&made, object, &inputs, shared) {
        Ok(scored) => scored,
        Err(e) => return failed(e.to_string()),
    };
    measured.seconds = seconds;
    measured.peak_memory_bytes = memory;
    let outcome = Outcome::Measured(Box::new(measured));
    let record = Record { case: case.clone(), outcome };
    run.folder.write(&record, &features, picture.as_deref())?;
    Ok(record.outcome)
}

/// Numbers (but for time and memory), features for FID, and the picture strip.
type Scored = (Measured, Vec<f32>, Option<Vec<u8>>);

fn score(made: &Made, object: &EvalObject, inputs: &[View], shared: &Shared) -> Result<Scored, CliError> {
    let validation = object.validation();
    let (width, height) = validation.first().map_or((0, 0), |v| v.image.dimensions());
    let truths: Vec<Vec<f32>> = validation.iter().map(|v| composite(&v.image, WHITE)).collect();
    let mut samples = Vec::new();
    let mut renders = Vec::new(); // [samples][views]
    let mut features = Vec::new();
    for (seed, cloud) in &made.clouds {
        let images = validation.iter().map(|v| shown(cloud, v)).collect::<Result<Vec<_>, CliError>>()?;
        let pairs: Vec<Pair> = images.iter().zip(&truths).map(|(render, truth)| Pair { render, truth }).collect();
        let scores = shared.scorer.score(&pairs, width as usize, height as usize)?;
        let views = validation.iter().zip(scores.pairs).map(|(v, values)| ViewScores { name: v.name.clone(), values });
        samples.push(SampleScores { seed: *seed, gaussians: cloud.len(), views: views.collect() });
        // FID compares as many renders as images: those of the first sample.
        if features.is_empty() {
            features = scores.features;
        }
        renders.push(images);
    }
    let picture = match (&shared.pictures, renders.first()) {
        (Pictures::None, _) | (_, None) => None,
        (_, Some(first)) => Some(strip(inputs, &validation, first)?),
    };
    let measured = Measured {
        metrics: means(&samples),
        seconds: 0.0,
        peak_memory_bytes: None,
        disagreement: disagreement(&renders),
        image_size: [width, height],
        inputs: inputs.iter().map(|v| v.name.clone()).collect(),
        validation_sha256: object.validation_sha256(),
        samples,
        features: features.len(),
        picture: picture.is_some(),
        notes: made.notes.clone(),
        commit: commit(),
    };
    Ok((measured, features, picture))
}

/// A view of the Gaussians as a viewer shows it: clamped to the range of a picture. What is not a number stays so, and is
/// refused where it is scored.
fn shown(cloud: &Cloud, view: &View) -> Result<Vec<f32>, CliError> {
    Ok(render_view(cloud, &view.camera)?.iter().map(|x| x.clamp(0.0, 1.0)).collect())
}

/// The mean over views, pixels and channels of the standard deviation across samples; `None` for a single sample.
fn disagreement(renders: &[Vec<Vec<f32>>]) -> Option<f64> {
    let first = renders.first().filter(|_| renders.len() > 1)?;
    let (mut sum, mut count) = (0.0, 0usize);
    for (view, image) in first.iter().enumerate() {
        for pixel in 0..image.len() {
            let values: Vec<f64> = renders.iter().map(|r| f64::from(r[view][pixel])).collect();
            sum += deviation(&values)?;
        }
        count += image.len();
    }
    (count > 0).then(|| sum / count as f64)
}

/// A case in one line.
fn line(run: &Run, record: &Record) -> String {
    let case = &record.case;
    let name = format!("{}{} {} {}", run.prefix, case.object, case.views, case.inputs);
    match &record.outcome {
        Outcome::Measured(m) => {
            let value = |name: &str| {
                let (label, factor, decimals) = style(name);
                m.metrics.get(name).map_or(String::new(), |v| format!("  {label} {:6.decimals$}", factor * v))
            };
            format!("{name:48}{}{}  {:6.1} s", value("psnr"), value("ssim"), m.seconds)
        }
        Outcome::Failed { reason } => format!("{name:48}  failed: {reason}"),
        Outcome::Skipped { reason } => format!("{name:48}  skipped: {reason}"),
    }
}

/// Gathers a run's records and writes its reports.
pub fn report(run: &Run, shared: &Shared, environment: &freerange_eval::Environment) -> Result<Report, CliError> {
    let mut records = Vec::new();
    for name in shared.source.names() {
        for case in run.cases(name) {
            let record = run.folder.record(&case)?;
            records.push(record.ok_or_else(|| {
                CliError::input(format!("{case}: no result yet; run the other shares first, then without --share"))
            })?);
        }
    }
    let missing = shared.scorer.missing().clone();
    let weights = shared.scorer.used_files().to_vec();
    let (method, settings) = (run.method.label(), run.settings.clone());
    let report = Report::new(method, settings, environment.clone(), missing, weights, records, &run.folder)?;
    run.folder.write_json("report.json", &report)?;
    run.folder.write_text("report.md", &freerange_eval::document::markdown(&report))?;
    let embed = if shared.pictures == Pictures::All { Embed::All } else { Embed::Extremes };
    run.folder.write_text("report.html", &html(&report, &run.folder, embed)?)?;
    Ok(report)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn disagreement_is_the_mean_standard_deviation() {
        let renders = [vec![vec![0.0f32, 0.5], vec![1.0]], vec![vec![1.0, 0.5], vec![0.0]]];
        let expected = (0.5f64.sqrt() + 0.0 + 0.5f64.sqrt()) / 3.0;
        assert!((disagreement(&renders).unwrap() - expected).abs() < 1e-12);
        assert_eq!(disagreement(&renders[..1]), None);
        assert_eq!(disagreement(&[]), None);
    }
}
