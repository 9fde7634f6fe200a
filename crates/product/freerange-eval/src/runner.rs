//! Measures methods on objects, case by case, so that a run can be stopped at any time and gone on with.

use std::time::Instant;

use freerange_gaussians::Gaussians;
use freerange_raster::{RasterConfig, render};
use freerange_scene::camera::{View, image_ops::composite};
use freerange_util::Share;
use glam::DMat4;
use serde_json::Value;

use crate::{
    Environment, EvalError, EvalObject, Features, MeshSurface, Pair, Report, RunFolder, Scorer, agreement, document,
    html::{Embed, html},
    memory::{peak_memory, reset_peak_memory},
    mesh_metrics,
    record::{
        AGREEMENT, Case, Measured, Outcome, Record, SampleScores, VggFeatures, ViewScores, ViewSet, means, style,
    },
    statistics::deviation,
    strip, surface_metrics,
};

/// The color behind the object in everything that is measured or shown.
const WHITE: [f32; 3] = [1.0; 3];

/// The objects to measure on, by number.
pub trait Objects {
    /// Their names, all different.
    fn names(&self) -> &[String];

    /// Object number `index`.
    ///
    /// # Errors
    /// Why it cannot be used: what its record will say.
    fn load(&self, index: usize) -> Result<EvalObject, String>;
}

/// What makes the Gaussians.
pub trait Method {
    /// What it is called in tables.
    fn label(&self) -> String;

    /// Gaussians for the input views of a case. `truth` is the object's surface, if that is known: for an upper bound only.
    ///
    /// # Errors
    /// Why there are none: what the case's record will say.
    fn make(&self, case: &Case, inputs: &[View], truth: Option<&MeshSurface>) -> Result<Reconstructed, String>;
}

/// What a method gave.
#[derive(Clone, Debug)]
pub struct Reconstructed {
    /// Seeds and Gaussians in the frame of the object's cameras.
    pub clouds: Vec<(u64, Gaussians)>,
    /// What the user should know.
    pub notes: Vec<String>,
}

/// One set of settings with its folder.
pub struct Run {
    /// What is measured.
    pub method: Box<dyn Method>,
    /// Where results go.
    pub folder: RunFolder,
    /// What the numbers depend on.
    pub settings: Value,
    /// From where the inputs look.
    pub views: Vec<ViewSet>,
    /// Numbers of inputs.
    pub inputs: Vec<usize>,
    /// What stands before an object's name on the screen.
    pub prefix: String,
}

/// Which picture strips there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pictures {
    /// None.
    None,
    /// One per object; those of the worst and the best ones within report.html.
    Extremes,
    /// One per object, all of them within report.html.
    All,
}

/// What all runs share.
pub struct Shared {
    /// The objects.
    pub objects: Box<dyn Objects>,
    /// The metrics.
    pub scorer: Scorer,
    /// Which pictures are made.
    pub pictures: Pictures,
    /// Which of so many shares of the objects is worked on.
    pub share: Share,
    /// The commit that the program was built from, for the records.
    pub commit: String,
}

/// What [`work`] tells its caller.
pub enum Event<'a> {
    /// So many cases are done, of all; `object` is what is worked on.
    Cases {
        /// Done, by this run or an earlier one.
        done: usize,
        /// In all.
        total: usize,
        /// Name of the object.
        object: &'a str,
    },
    /// Something came of a case.
    Record {
        /// Its run.
        run: &'a Run,
        /// What came of it.
        record: &'a Record,
    },
}

impl Run {
    fn cases(&self, object: &str) -> Vec<Case> {
        let case = |views: ViewSet, inputs: usize| Case { object: object.into(), views, inputs };
        self.views.iter().flat_map(|&v| self.inputs.iter().map(move |&n| case(v, n))).collect()
    }
}

/// Works on every case that is not done yet. An object that is broken is recorded as failed, and the others go on.
///
/// # Errors
/// If a run's folder cannot be read or written.
pub fn work(runs: &[Run], shared: &Shared, tell: &mut dyn FnMut(Event<'_>)) -> Result<(), EvalError> {
    let names: Vec<(usize, &String)> =
        shared.objects.names().iter().enumerate().filter(|(i, _)| shared.share.contains(*i as u64)).collect();
    let per_object: usize = runs.iter().map(|r| r.views.len() * r.inputs.len()).sum();
    let total = names.len() * per_object;
    for (number, &(index, name)) in names.iter().enumerate() {
        let mut open = Vec::new();
        for run in runs {
            for case in run.cases(name) {
                if !run.folder.is_done(&case)? {
                    open.push((run, case));
                }
            }
        }
        let before = (number + 1) * per_object - open.len();
        tell(Event::Cases { done: before, total, object: name });
        if open.is_empty() {
            continue;
        }
        let object = shared.objects.load(index);
        for (done, (run, case)) in (before + 1..).zip(open) {
            let outcome = match &object {
                Ok(object) => measure_case(run, &case, object, shared)?,
                Err(reason) => Outcome::Failed { reason: reason.clone() },
            };
            let record = Record { case, outcome };
            // What has numbers was written with its picture.
            if !matches!(record.outcome, Outcome::Measured(_)) {
                run.folder.write(&record, &Features::default(), None)?;
            }
            tell(Event::Record { run, record: &record });
            tell(Event::Cases { done, total, object: name });
        }
    }
    Ok(())
}

/// Measures one case and, where that works out, writes its record. Only a folder that cannot be written to is an error.
fn measure_case(run: &Run, case: &Case, object: &EvalObject, shared: &Shared) -> Result<Outcome, EvalError> {
    let failed = |reason: String| Ok(Outcome::Failed { reason });
    let inputs = match object.inputs(case.views, case.inputs) {
        Ok(inputs) => inputs,
        Err(reason) => return Ok(Outcome::Skipped { reason }),
    };
    // A peak that is not this case's own is no answer.
    let can_measure = reset_peak_memory();
    let begin = Instant::now();
    let made = match run.method.make(case, &inputs, object.surface()) {
        Ok(made) => made,
        Err(reason) => return failed(reason),
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

/// Numbers (but for time and memory), features, and the picture strip.
type Scored = (Measured, Features, Option<Vec<u8>>);

fn score(found: &Reconstructed, object: &EvalObject, inputs: &[View], shared: &Shared) -> Result<Scored, EvalError> {
    let validation = object.validation();
    let sizes: Vec<[u32; 2]> = validation.iter().map(|v| v.image.dimensions().into()).collect();
    let truths: Vec<Vec<f32>> = validation.iter().map(|v| composite(&v.image, WHITE)).collect();
    let mut samples = Vec::new();
    let mut renders = Vec::new(); // [samples][views]
    let mut features = Vec::new();
    for (seed, cloud) in &found.clouds {
        let images = validation.iter().map(|v| shown(cloud, v)).collect::<Result<Vec<_>, EvalError>>()?;
        let pairs = images.iter().zip(&truths).zip(&sizes);
        let pairs = pairs.map(|((render, truth), size)| Pair { render, truth, size: size.map(|side| side as usize) });
        let scores = shared.scorer.score(&pairs.collect::<Vec<_>>())?;
        let views = validation.iter().zip(scores.pairs).map(|(v, values)| ViewScores { name: v.name.clone(), values });
        samples.push(SampleScores { seed: *seed, gaussians: cloud.len(), views: views.collect() });
        // FID compares as many renders as images: those of the first sample.
        if features.is_empty() {
            features = scores.features;
        }
        renders.push(images);
    }
    let vgg = vgg_features(&renders, &truths, &sizes, &shared.scorer)?;
    let vgg_kept = (!vgg.is_empty()).then(|| VggFeatures {
        count: vgg.len(),
        unseen: validation.iter().map(|v| is_unseen(v, inputs)).collect(),
        samples: renders.len(),
    });
    let picture = match (&shared.pictures, renders.first()) {
        (Pictures::None, _) | (_, None) => None,
        (_, Some(first)) => Some(strip(inputs, &validation, first)?),
    };
    let (mut metrics, mut notes) = (means(&samples), found.notes.clone());
    let agreement = renders.first().and_then(|first| agreement(first, &validation, &truths));
    metrics.extend(agreement.map(|value| (AGREEMENT.to_owned(), value)));
    if let (Some(truth), Some((_, cloud))) = (object.surface(), found.clouds.first()) {
        metrics.extend(surface_metrics(cloud, truth, inputs, &validation)?);
        match mesh_metrics(cloud, truth)? {
            Some(of_mesh) => metrics.extend(of_mesh),
            None => notes.push("the Gaussians show no surface: no mesh is compared".into()),
        }
    }
    let measured = Measured {
        metrics,
        seconds: 0.0,
        peak_memory_bytes: None,
        disagreement: disagreement(&renders),
        image_size: sizes.first().copied().unwrap_or_default(),
        inputs: inputs.iter().map(|v| v.name.clone()).collect(),
        validation_sha256: object.validation_sha256(),
        samples,
        features: features.len(),
        vgg: vgg_kept,
        picture: picture.is_some(),
        notes,
        commit: shared.commit.clone(),
    };
    Ok((measured, Features { inception: features, vgg }, picture))
}

/// Angle between viewing axes, in degrees, beyond which a view counts as one that no input saw.
const UNSEEN: f64 = 60.0;

fn is_unseen(view: &View, inputs: &[View]) -> bool {
    let axis = |v: &View| DMat4::row(&v.camera.world_to_camera, 2).truncate().normalize(); // z forward
    inputs.iter().all(|input| axis(input).dot(axis(view)) < UNSEEN.to_radians().cos())
}

/// VGG16's features: of each view of the first sample, of the true images, and of several samples of their mean renders.
/// Empty if they are not asked for.
fn vgg_features(
    renders: &[Vec<Vec<f32>>], // [samples][views]
    truths: &[Vec<f32>],
    sizes: &[[u32; 2]],
    scorer: &Scorer,
) -> Result<Vec<f32>, EvalError> {
    let of = |images: &[Vec<f32>]| {
        let images = images.iter().zip(sizes);
        scorer.vgg_features(&images.map(|(i, s)| (i.as_slice(), s.map(|x| x as usize))).collect::<Vec<_>>())
    };
    let Some(first) = renders.first() else { return Ok(Vec::new()) };
    let mut out = of(first)?;
    if out.is_empty() {
        return Ok(out);
    }
    out.extend(of(truths)?);
    if renders.len() > 1 {
        let share = 1.0 / renders.len() as f32;
        let mean = |view: usize| -> Vec<f32> {
            (0..first[view].len()).map(|i| renders.iter().map(|r| share * r[view][i]).sum()).collect()
        };
        out.extend(of(&(0..first.len()).map(mean).collect::<Vec<_>>())?);
    }
    Ok(out)
}

/// A view of the Gaussians as a viewer shows it: clamped to the range of a picture. What is not a number stays so, and is
/// refused where it is scored.
fn shown(cloud: &Gaussians, view: &View) -> Result<Vec<f32>, EvalError> {
    let rendered = render(cloud.rows(), &[view.camera], &[WHITE], &RasterConfig::default())?;
    Ok(rendered.rgb.iter().map(|x| x.clamp(0.0, 1.0)).collect())
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
pub fn line(run: &Run, record: &Record) -> String {
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
///
/// # Errors
/// If a case has no record yet, or the run's folder cannot be read or written.
pub fn report(run: &Run, shared: &Shared, environment: &Environment) -> Result<Report, EvalError> {
    let mut records = Vec::new();
    for name in shared.objects.names() {
        for case in run.cases(name) {
            let record = run.folder.record(&case)?;
            records.push(record.ok_or_else(|| EvalError::NoRecord(case.to_string()))?);
        }
    }
    let missing = shared.scorer.missing().clone();
    let weights = shared.scorer.used_files().to_vec();
    let (method, settings) = (run.method.label(), run.settings.clone());
    let report = Report::new(method, settings, environment.clone(), missing, weights, records, &run.folder)?;
    run.folder.write_json("report.json", &report)?;
    run.folder.write_text("report.md", &document::markdown(&report))?;
    let embed = if shared.pictures == Pictures::All { Embed::All } else { Embed::Extremes };
    run.folder.write_text("report.html", &html(&report, &run.folder, embed)?)?;
    Ok(report)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_is_unseen_where_no_input_looks_along_its_axis() {
        let view = |degrees: f64| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            let at = glam::DVec3::new(2.0 * cos, 2.0 * sin, 0.3);
            let camera = freerange_scene::camera::Camera::look_at(at, glam::DVec3::ZERO, glam::DVec3::Z, 0.8, 4, 4);
            View { name: String::new(), camera, image: image::RgbaImage::new(4, 4) }
        };
        let inputs = [view(0.0), view(30.0)];
        let unseen = [0.0, 45.0, 89.0, 95.0, 180.0, 302.0, 290.0].map(|d| is_unseen(&view(d), &inputs));
        assert_eq!(unseen, [false, false, false, true, true, false, true]);
    }

    #[test]
    fn disagreement_is_the_mean_standard_deviation() {
        let renders = [vec![vec![0.0f32, 0.5], vec![1.0]], vec![vec![1.0, 0.5], vec![0.0]]];
        let expected = (0.5f64.sqrt() + 0.0 + 0.5f64.sqrt()) / 3.0;
        assert!((disagreement(&renders).unwrap() - expected).abs() < 1e-12);
        assert_eq!(disagreement(&renders[..1]), None);
        assert_eq!(disagreement(&[]), None);
    }
}
