//! A run's report: settings, every record, and what they add up to.

use std::{collections::BTreeMap, path::Path};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::{
    EvalError,
    folder::{RunFolder, read_json},
    record::{Case, Measured, Outcome, Record, VggFeatures, ViewSet, ordered},
    scorer::{UsedFile, fid, frechet_vgg},
    statistics::{Interval, bootstrap, mean, quantile},
};

/// The number that changes when reports of older programs cannot be read any more.
pub const FORMAT: u32 = 1;

/// Everything that a run says.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// [`FORMAT`].
    pub format: u32,
    /// What the method is called in tables.
    pub method: String,
    /// What the numbers depend on.
    pub settings: Value,
    /// Where and how it was run.
    pub environment: Environment,
    /// Metrics that were asked for and have no numbers, and why.
    pub not_computed: BTreeMap<String, String>,
    /// Files of weights that scores depend on.
    pub weights: Vec<UsedFile>,
    /// What the records add up to: one per view set and number of inputs.
    pub groups: Vec<Group>,
    /// Every case, in order.
    pub records: Vec<Record>,
}

/// Where and how a report was made.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Environment {
    /// The command line.
    pub command: String,
    /// The commits that the records were made by.
    pub commits: Vec<String>,
    /// The processor.
    pub processor: String,
    /// Threads that it runs at once.
    pub threads: usize,
    /// Main memory in bytes, where the system tells.
    pub memory_bytes: Option<u64>,
    /// The device, as `--device` names it.
    pub device: String,
}

/// What the records of one view set and number of inputs add up to.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Group {
    /// From where the inputs look.
    pub views: ViewSet,
    /// Number of input views.
    pub inputs: usize,
    /// Objects with numbers.
    pub measured: usize,
    /// Objects that failed.
    pub failed: usize,
    /// Objects without such views.
    pub skipped: usize,
    /// Means over the objects of each metric that all of them have; with the spread.
    pub metrics: BTreeMap<String, Spread>,
    /// FID over all validation images of the group.
    pub fid: Option<f64>,
    /// The Frechet distances of VGG16's features.
    #[serde(default)]
    pub frechet_vgg: Option<FrechetVgg>,
    /// Validation images of the group.
    pub images: usize,
    /// Mean number of Gaussians.
    pub gaussians: f64,
    /// Mean seconds per sample.
    pub seconds: f64,
    /// Largest peak memory in bytes.
    pub peak_memory_bytes: Option<u64>,
    /// Mean disagreement between samples.
    pub disagreement: Option<f64>,
}

/// Frechet distances between VGG16's features of renders and of true images. Not FID: see
/// [`Metric::FrechetVgg`](crate::metrics::Metric).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrechetVgg {
    /// Of one sample of each object, over all validation images.
    pub sample: f64,
    /// Of the mean renders of several samples.
    pub mean: Option<f64>,
    /// Validation images from where no input looks.
    pub unseen_images: usize,
    /// Of one sample, over those.
    pub unseen_sample: Option<f64>,
    /// Of the mean renders, over those.
    pub unseen_mean: Option<f64>,
}

impl FrechetVgg {
    /// Of cases with what is kept of each; none if nothing is.
    fn new<'a>(
        kept: impl Iterator<Item = (&'a Case, &'a VggFeatures)>,
        folder: &RunFolder,
    ) -> Result<Option<Self>, EvalError> {
        let mut views = Vec::new(); // features of the render, the true image and the mean render; whether unseen
        for (case, VggFeatures { count, unseen, samples }) in kept {
            let all = folder.vgg_features(case, *count)?;
            let parts = if *samples > 1 { 3 } else { 2 };
            if unseen.is_empty() || !count.is_multiple_of(parts * unseen.len()) {
                let expected = format!("features of {} views, {parts} each", unseen.len());
                return Err(EvalError::Object { object: case.object.clone(), expected, found: count.to_string() });
            }
            let width = count / (parts * unseen.len());
            let of = |part: usize, view: usize| all[(part * unseen.len() + view) * width..][..width].to_vec();
            let mean = |view| (parts == 3).then(|| of(2, view));
            views.extend(unseen.iter().enumerate().map(|(i, &unseen)| (of(0, i), of(1, i), mean(i), unseen)));
        }
        let distance = |unseen_alone: bool, of_means: bool| {
            let chosen = views.iter().filter(|v| v.3 || !unseen_alone);
            let pairs: Option<Vec<(&[f32], &[f32])>> = chosen
                .map(|(render, truth, mean, _)| match of_means {
                    true => Some((mean.as_deref()?, truth.as_slice())),
                    false => Some((render.as_slice(), truth.as_slice())),
                })
                .collect();
            let Some((renders, truths)) = pairs.map(|p| p.into_iter().unzip::<_, _, Vec<_>, Vec<_>>()) else {
                return Ok(None);
            };
            frechet_vgg(&renders, &truths)
        };
        let Some(sample) = distance(false, false)? else { return Ok(None) };
        Ok(Some(Self {
            sample,
            mean: distance(false, true)?,
            unseen_images: views.iter().filter(|v| v.3).count(),
            unseen_sample: distance(true, false)?,
            unseen_mean: distance(true, true)?,
        }))
    }
}

/// The values of a metric over objects.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Mean and 95 % bootstrap interval over objects.
    #[serde(flatten)]
    pub interval: Interval,
    /// Smallest value.
    pub least: f64,
    /// Median.
    pub median: f64,
    /// Largest value.
    pub most: f64,
}

impl Report {
    /// Adds up the records of a run. `folder` holds the features for FID.
    ///
    /// # Errors
    /// [`EvalError::Io`] and [`EvalError::File`] where features cannot be read.
    pub fn new(
        method: String,
        settings: Value,
        environment: Environment,
        not_computed: BTreeMap<String, String>,
        weights: Vec<UsedFile>,
        mut records: Vec<Record>,
        folder: &RunFolder,
    ) -> Result<Self, EvalError> {
        records.sort_by(|a, b| a.case.cmp(&b.case));
        let mut kinds: Vec<(ViewSet, usize)> = records.iter().map(|r| (r.case.views, r.case.inputs)).collect();
        kinds.sort_unstable();
        kinds.dedup();
        let mut groups = Vec::with_capacity(kinds.len());
        for (views, inputs) in kinds {
            let own = || records.iter().filter(|r| (r.case.views, r.case.inputs) == (views, inputs));
            let kept = own().filter_map(measured).filter(|(_, m)| m.features > 0);
            let fid = fid(kept.map(|(case, m)| folder.features(case, m.features)))?;
            let kept = own().filter_map(measured).filter_map(|(case, m)| Some((case, m.vgg.as_ref()?)));
            let frechet_vgg = FrechetVgg::new(kept, folder)?;
            groups.push(Group { fid, frechet_vgg, ..Group::new(views, inputs, own()) });
        }
        let mut commits: Vec<String> = records.iter().filter_map(measured).map(|(_, m)| m.commit.clone()).collect();
        commits.sort();
        commits.dedup();
        let environment = Environment { commits, ..environment };
        Ok(Self { format: FORMAT, method, settings, environment, not_computed, weights, groups, records })
    }

    /// The same without the scores of single views, a tenth of the size.
    pub fn without_views(&self) -> Self {
        let mut short = self.clone();
        for record in &mut short.records {
            if let Outcome::Measured(measured) = &mut record.outcome {
                measured.samples.iter_mut().for_each(|sample| sample.views.clear());
            }
        }
        short
    }

    /// Reads `report.json`, or that of a folder.
    ///
    /// # Errors
    /// [`EvalError::Io`]; [`EvalError::File`] where it is no report of this format.
    pub fn load(path: &Path) -> Result<Self, EvalError> {
        let path = if path.is_dir() { path.join("report.json") } else { path.to_path_buf() };
        let value: Value = read_json(&path)?;
        let format = value.get("format").cloned().unwrap_or(Value::Null);
        if format != FORMAT {
            return Err(EvalError::file(&path, format!("a report with format {FORMAT}"), format!("format {format}")));
        }
        serde_json::from_value(value).map_err(|e| EvalError::file(&path, "a report", e))
    }

    /// The cases with numbers, in order.
    pub fn measured(&self) -> impl Iterator<Item = (&Case, &Measured)> {
        self.records.iter().filter_map(measured)
    }

    /// The cases that failed, and why.
    pub fn failures(&self) -> impl Iterator<Item = (&Case, &str)> {
        self.records.iter().filter_map(|r| match &r.outcome {
            Outcome::Failed { reason } => Some((&r.case, reason.as_str())),
            _ => None,
        })
    }

    /// The cases that were skipped, and why.
    pub fn skipped(&self) -> impl Iterator<Item = (&Case, &str)> {
        self.records.iter().filter_map(|r| match &r.outcome {
            Outcome::Skipped { reason } => Some((&r.case, reason.as_str())),
            _ => None,
        })
    }

    /// Names of all metrics that some object has, in the order of tables.
    pub fn metrics(&self) -> Vec<String> {
        ordered(self.measured().flat_map(|(_, m)| m.metrics.keys()))
    }

    /// The cases of a group from the lowest PSNR to the highest; equal ones by name.
    pub fn by_psnr(&self, group: &Group) -> Vec<(&Case, &Measured)> {
        let own = |c: &Case| (c.views, c.inputs) == (group.views, group.inputs);
        let mut cases: Vec<_> = self.measured().filter(|(c, _)| own(c)).collect();
        let psnr = |m: &Measured| m.metrics.get("psnr").copied().unwrap_or(f64::INFINITY);
        cases.sort_by(|a, b| psnr(a.1).total_cmp(&psnr(b.1)).then_with(|| a.0.cmp(b.0)));
        cases
    }
}

fn measured(record: &Record) -> Option<(&Case, &Measured)> {
    match &record.outcome {
        Outcome::Measured(measured) => Some((&record.case, measured)),
        _ => None,
    }
}

impl Group {
    fn new<'a>(views: ViewSet, inputs: usize, records: impl Iterator<Item = &'a Record> + Clone) -> Self {
        let numbers: Vec<&Measured> = records.clone().filter_map(measured).map(|(_, m)| m).collect();
        let names = ordered(numbers.iter().flat_map(|m| m.metrics.keys()));
        let spread = |name: String| {
            let mut values: Vec<f64> = numbers.iter().map(|m| m.metrics.get(&name).copied()).collect::<Option<_>>()?;
            let interval = bootstrap(&values, 0)?;
            values.sort_unstable_by(f64::total_cmp);
            let spread =
                Spread { interval, least: values[0], median: quantile(&values, 0.5), most: values[values.len() - 1] };
            Some((name, spread))
        };
        let average =
            |f: &dyn Fn(&Measured) -> f64| mean(&numbers.iter().map(|m| f(m)).collect::<Vec<_>>()).unwrap_or(0.0);
        let disagreements: Vec<f64> = numbers.iter().filter_map(|m| m.disagreement).collect();
        Self {
            views,
            inputs,
            measured: numbers.len(),
            failed: records.clone().filter(|r| matches!(r.outcome, Outcome::Failed { .. })).count(),
            skipped: records.clone().filter(|r| matches!(r.outcome, Outcome::Skipped { .. })).count(),
            metrics: names.into_iter().filter_map(spread).collect(),
            fid: None,
            frechet_vgg: None,
            images: numbers.iter().map(|m| m.samples.first().map_or(0, |s| s.views.len())).sum(),
            gaussians: average(&Measured::gaussians),
            seconds: average(&|m| m.seconds),
            peak_memory_bytes: numbers.iter().filter_map(|m| m.peak_memory_bytes).max(),
            disagreement: mean(&disagreements),
        }
    }

    /// The mean of a metric, FID among them, if the group has it.
    pub fn value(&self, metric: &str) -> Option<f64> {
        match metric {
            "fid" => self.fid,
            "frechet-vgg" => self.frechet_vgg.map(|f| f.sample),
            _ => self.metrics.get(metric).map(|s| s.interval.mean),
        }
    }
}
