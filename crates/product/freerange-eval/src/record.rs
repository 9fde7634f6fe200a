//! What is known of one object, view set and number of inputs.

use std::{collections::BTreeMap, fmt};

use crate::metrics::Metric;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// From where the input views look (the paper, Section 4).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ViewSet {
    /// From all around.
    Full,
    /// All from one side.
    Partial,
}

impl fmt::Display for ViewSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Full => "full",
            Self::Partial => "partial",
        })
    }
}

/// One thing to measure.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Case {
    /// The object's name.
    pub object: String,
    /// From where the inputs look.
    pub views: ViewSet,
    /// Number of input views.
    pub inputs: usize,
}

/// Longest part of an object's name in file names.
const LONGEST: usize = 60;

impl Case {
    /// A name for files, without ending: different for different cases, whatever the object's name holds.
    pub fn file_stem(&self) -> String {
        let plain = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        let mut name: String = self.object.chars().take(LONGEST).map(|c| if plain(c) { c } else { '_' }).collect();
        if name != self.object || name.is_empty() {
            let hash = Sha256::digest(self.object.as_bytes());
            name = format!("{name}.{:02x}{:02x}{:02x}{:02x}", hash[0], hash[1], hash[2], hash[3]);
        }
        format!("{name}.{}.{}", self.views, self.inputs)
    }
}

impl fmt::Display for Case {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({}, {} inputs)", self.object, self.views, self.inputs)
    }
}

/// A case and what came of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    /// What was measured.
    pub case: Case,
    /// What came of it.
    pub outcome: Outcome,
}

/// What came of a case.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
pub enum Outcome {
    /// It has numbers.
    Measured(Box<Measured>),
    /// The object or what should show it is broken.
    Failed {
        /// Why, for the user.
        reason: String,
    },
    /// The object does not have such views.
    Skipped {
        /// What it lacks.
        reason: String,
    },
}

/// The numbers of a case.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// Metrics by name, each the mean over samples and validation views.
    pub metrics: BTreeMap<String, f64>,
    /// Seconds per sample from the images to the Gaussians; neither reading nor scoring.
    pub seconds: f64,
    /// Largest memory of the process while the Gaussians were made, in bytes; `None` where the system does not tell.
    pub peak_memory_bytes: Option<u64>,
    /// With several samples: mean, over all validation pixels and channels, of the standard deviation across samples.
    pub disagreement: Option<f64>,
    /// Width and height in pixels of the first validation image; each is scored at its own size.
    pub image_size: [u32; 2],
    /// Names of the input views.
    pub inputs: Vec<String>,
    /// SHA-256 over the validation images and cameras: equal for reports that can be compared.
    pub validation_sha256: String,
    /// What each sample gave.
    pub samples: Vec<SampleScores>,
    /// Number of Inception features that are kept of renders, and as many of images, for FID; 0 without FID.
    #[serde(default)]
    pub features: usize,
    /// Number of VGG16's features that are kept, and of what; none without the Frechet distance of these.
    #[serde(default)]
    pub vgg: Option<VggFeatures>,
    /// Whether a picture strip was written.
    #[serde(default)]
    pub picture: bool,
    /// What the user should know, such as what was left out of a file.
    #[serde(default)]
    pub notes: Vec<String>,
    /// The commit that the program was built from.
    pub commit: String,
}

/// VGG16's features that are kept of a case: of the first sample's renders, of true images, of mean renders.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VggFeatures {
    /// Numbers in all.
    pub count: usize,
    /// Of each validation view, whether it looks from where no input does: along an axis more than 60 degrees from theirs.
    pub unseen: Vec<bool>,
    /// Samples that the mean renders are means of; 1: there are none.
    pub samples: usize,
}

impl Measured {
    /// Gaussians of the samples, on average.
    pub fn gaussians(&self) -> f64 {
        self.samples.iter().map(|s| s.gaussians as f64).sum::<f64>() / self.samples.len().max(1) as f64
    }
}

/// What one sample gave.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SampleScores {
    /// Its seed.
    pub seed: u64,
    /// Its Gaussians.
    pub gaussians: usize,
    /// Scores of each validation view.
    pub views: Vec<ViewScores>,
}

/// Scores of one validation view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewScores {
    /// The view.
    pub name: String,
    /// Metrics by name.
    pub values: BTreeMap<String, f64>,
}

/// The mean over samples and views of each metric that all of them have.
pub fn means(samples: &[SampleScores]) -> BTreeMap<String, f64> {
    let views: Vec<&ViewScores> = samples.iter().flat_map(|s| &s.views).collect();
    let Some(first) = views.first() else { return BTreeMap::new() };
    let mean = |name: &String| {
        let values: Option<Vec<f64>> = views.iter().map(|v| v.values.get(name).copied()).collect();
        Some((name.clone(), crate::statistics::mean(&values?)?))
    };
    first.values.keys().filter_map(mean).collect()
}

/// What names of the metrics of [`surface_metrics`](crate::surface_metrics) begin with. Units of the frame: the sphere around the object has
/// diameter 1.
const SURFACE: &str = "surface-";
/// Those of [`mesh_metrics`](crate::mesh_metrics): parts of the object's diameter, or a share.
const MESH: &str = "mesh-";
const F_SCORE: &str = "mesh-f-score";
/// That of [`agreement`](crate::agreement()).
pub const AGREEMENT: &str = "agreement";

/// How a metric of this name is written in tables: label, factor, decimals. Those of the paper where it has the metric.
pub fn style(name: &str) -> (String, f64, usize) {
    let metric = name.parse::<Metric>().ok();
    let label = metric.map_or_else(|| name.to_owned(), |m| m.label().to_owned());
    match metric {
        Some(Metric::Ssim) => ("SSIM (3DGS) x100".into(), 100.0, 2),
        Some(Metric::SsimCropped | Metric::SsimSample | Metric::Dino | Metric::DreamSim | Metric::DreamSimDino) => {
            (format!("{label} x100"), 100.0, 2)
        }
        Some(Metric::LpipsAlex | Metric::LpipsVgg) => (format!("{label} x1000"), 1000.0, 1),
        None if name == AGREEMENT => (label, 1.0, 3),
        None if name == F_SCORE => (format!("{name} x100"), 100.0, 2),
        None if name.starts_with(SURFACE) || name.starts_with(MESH) => (format!("{name} x1000"), 1000.0, 1),
        Some(Metric::Psnr) => ("PSNR dB".into(), 1.0, 2),
        _ => (label, 1.0, 2),
    }
}

/// Whether larger is better, where the metric is known. Seconds and Gaussians count as metrics here.
pub fn higher_is_better(name: &str) -> Option<bool> {
    match name {
        "seconds" => Some(false),
        // A signed distance is neither.
        AGREEMENT | F_SCORE => Some(true),
        _ if name.starts_with(SURFACE) || name.starts_with(MESH) => (!name.ends_with("-signed")).then_some(false),
        _ => name.parse::<Metric>().ok().map(Metric::higher_is_better),
    }
}

/// Metric names in the order of tables: known ones first, in their own order, then the others by name.
pub fn ordered<'a>(names: impl Iterator<Item = &'a String>) -> Vec<String> {
    let mut names: Vec<String> = names.cloned().collect();
    let rank = |n: &String| Metric::ALL.iter().position(|m| m.name() == n).unwrap_or(usize::MAX);
    names.sort_by(|a, b| rank(a).cmp(&rank(b)).then_with(|| a.cmp(b)));
    names.dedup();
    names
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_names_are_harmless_and_differ() {
        let stem = |object: &str| Case { object: object.into(), views: ViewSet::Full, inputs: 4 }.file_stem();
        assert_eq!(stem("rs_lemon"), "rs_lemon.full.4");
        let names = ["../../etc", "a/b", "a\\b", "a b", "<script>", "", "x".repeat(300).as_str(), "\u{e9}"].map(stem);
        for name in &names {
            assert!(name.len() < 90 && name.chars().all(|c| c.is_ascii_alphanumeric() || "._-".contains(c)), "{name}");
            assert!(!name.starts_with(".."), "{name}");
        }
        let different: std::collections::HashSet<_> = names.iter().collect();
        assert_eq!(different.len(), names.len());
        assert_ne!(stem("a.b"), stem("a_b"));
    }

    #[test]
    fn means_are_over_samples_and_views_and_need_all_values() {
        let view = |psnr: f64, more: Option<f64>| {
            let mut values = BTreeMap::from([("psnr".to_owned(), psnr)]);
            more.map(|v| values.insert("dino".into(), v));
            ViewScores { name: "v".into(), values }
        };
        let sample = |views| SampleScores { seed: 0, gaussians: 1, views };
        let samples = [sample(vec![view(10.0, Some(0.5)), view(20.0, None)]), sample(vec![view(30.0, None)])];
        assert_eq!(means(&samples), BTreeMap::from([("psnr".to_owned(), 20.0)]));
        assert!(means(&[]).is_empty());
    }

    #[test]
    fn metrics_have_one_order_whatever_they_come_in() {
        let names = ["zz", "ssim", "psnr", "aa", "lpips-vgg", "ssim"].map(String::from);
        assert_eq!(ordered(names.iter()), ["psnr", "ssim", "lpips-vgg", "aa", "zz"]);
    }

    #[test]
    fn records_survive_json_to_the_bit() {
        let measured = Measured {
            metrics: BTreeMap::from([("psnr".into(), 0.1 + 0.2)]),
            seconds: 1.0 / 3.0,
            peak_memory_bytes: None,
            disagreement: Some(1e-17),
            image_size: [7, 5],
            inputs: vec!["a".into()],
            validation_sha256: "00".into(),
            samples: Vec::new(),
            features: 0,
            vgg: Some(VggFeatures { count: 3, unseen: vec![true], samples: 2 }),
            picture: false,
            notes: Vec::new(),
            commit: "c".into(),
        };
        let case = Case { object: "\"<&".into(), views: ViewSet::Partial, inputs: 2 };
        for outcome in [Outcome::Measured(Box::new(measured)), Outcome::Failed { reason: "r".into() }] {
            let record = Record { case: case.clone(), outcome };
            let text = serde_json::to_string(&record).unwrap();
            assert_eq!(serde_json::from_str::<Record>(&text).unwrap(), record);
        }
    }
}
