//! What can be switched when sampling, one setting at a time, on one checkpoint and one source of data.

use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::{
    EvalError, Report,
    compare::{Comparison, compare},
    paper::{NUMBER_OF_VIEWS, TEST_TIME},
    record::ViewSet,
    table::{Cell, Table},
};

/// A family of settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Set {
    /// Without classifier-free guidance, without photometric guidance, without both.
    Guidance,
    /// Numbers of steps.
    Steps,
    /// Scales of the photometric guidance.
    Lambda,
    /// Scales of the classifier-free guidance.
    Scale,
    /// Where the gradient that the network sees is taken.
    Gradient,
    /// Numbers of input views.
    Inputs,
}

impl Set {
    /// All of them.
    pub const ALL: [Self; 6] = [Self::Guidance, Self::Steps, Self::Lambda, Self::Scale, Self::Gradient, Self::Inputs];

    /// The name in commands and reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Guidance => "guidance",
            Self::Steps => "steps",
            Self::Lambda => "lambda",
            Self::Scale => "scale",
            Self::Gradient => "gradient",
            Self::Inputs => "inputs",
        }
    }
}

/// The values that sets run through.
#[derive(Clone, Debug, PartialEq)]
pub struct Values {
    /// Of [`Set::Steps`].
    pub steps: Vec<usize>,
    /// Of [`Set::Lambda`].
    pub lambda: Vec<f32>,
    /// Of [`Set::Scale`].
    pub scale: Vec<f32>,
    /// Of [`Set::Inputs`].
    pub inputs: Vec<usize>,
}

/// One setting that differs from the default.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Variant {
    /// The family it belongs to.
    pub set: Set,
    /// What it is called in tables.
    pub name: String,
    /// Its folder in that of the study.
    pub folder: String,
    /// Fields of the sampling configuration that it changes.
    pub sample: Map<String, Value>,
    /// Its number of input views, if that is what it changes.
    pub inputs: Option<usize>,
}

impl Variant {
    /// The sampling configuration `default` with what this variant changes.
    pub fn apply(&self, default: &Value) -> Value {
        let mut out = default.clone();
        if let Value::Object(fields) = &mut out {
            self.sample.iter().for_each(|(k, v)| drop(fields.insert(k.clone(), v.clone())));
        }
        out
    }
}

/// The variants of `sets`, in order.
pub fn variants(sets: &[Set], values: &Values) -> Vec<Variant> {
    let mut out = Vec::new();
    let mut add = |set: Set, name: String, folder: String, sample: Value, inputs: Option<usize>| {
        let Value::Object(sample) = sample else { unreachable!("written as objects below") };
        out.push(Variant { set, name, folder, sample, inputs });
    };
    for set in Set::ALL.into_iter().filter(|s| sets.contains(s)) {
        match set {
            Set::Guidance => {
                let none = [
                    ("No Classifier-Free Guidance", "no-classifier-free", json!({ "cfg_scale": 1.0 })),
                    ("No Photometric Gradient Guidance", "no-photometric", json!({ "lambda_pg": 0.0 })),
                    ("Neither", "no-guidance", json!({ "cfg_scale": 1.0, "lambda_pg": 0.0 })),
                ];
                none.into_iter().for_each(|(name, folder, sample)| add(set, name.into(), folder.into(), sample, None));
            }
            Set::Steps => values.steps.iter().for_each(|n| {
                add(set, format!("{n} steps"), format!("steps-{n}"), json!({ "steps": n }), None);
            }),
            Set::Lambda => values.lambda.iter().for_each(|v| {
                add(set, format!("lambda = {v}"), format!("lambda-{v}"), json!({ "lambda_pg": v }), None);
            }),
            Set::Scale => values.scale.iter().for_each(|v| {
                add(set, format!("s = {v}"), format!("scale-{v}"), json!({ "cfg_scale": v }), None);
            }),
            Set::Gradient => ["noisy", "estimate"].iter().for_each(|at| {
                let name = format!("gradient at the {at}");
                add(set, name, format!("gradient-{at}"), json!({ "gradient_at": at }), None);
            }),
            Set::Inputs => values.inputs.iter().for_each(|n| {
                add(set, format!("{n} inputs"), format!("inputs-{n}"), json!({}), Some(*n));
            }),
        }
    }
    out
}

/// What a study found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Study {
    /// The default settings.
    pub settings: Value,
    /// One per variant; the default has none.
    pub lines: Vec<Line>,
    /// Variants without numbers, and why.
    pub without: Vec<Without>,
}

/// A variant that no object could be measured with.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Without {
    /// What it is called.
    pub name: String,
    /// The first reason.
    pub reason: String,
}

/// What a variant gives beside the default.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Line {
    /// The variant.
    #[serde(flatten)]
    pub variant: Variant,
    /// The folder that holds its report: its own, or `default` where it is the default.
    pub report: String,
    /// The default is A, the variant B; one per view set.
    pub comparisons: Vec<Comparison>,
}

impl Study {
    /// Compares reports of variants (with the folders they lie in) with that of the default. Variants without numbers are
    /// set aside.
    ///
    /// # Errors
    /// As [`compare`].
    pub fn new(default: &Report, variants: Vec<(Variant, String, Report)>, seed: u64) -> Result<Self, EvalError> {
        let (mut lines, mut without) = (Vec::new(), Vec::new());
        for (variant, folder, report) in variants {
            if report.measured().next().is_some() {
                lines.push(Line { comparisons: compare(default, &report, seed)?, variant, report: folder });
                continue;
            }
            let first = report.failures().chain(report.skipped()).next();
            let reason = first.map_or("no objects".into(), |(case, reason)| format!("{}: {reason}", case.object));
            without.push(Without { name: variant.name, reason });
        }
        Ok(Self { settings: default.settings.clone(), lines, without })
    }

    /// One table per set: the paper's Table 3, lower half, from [`Set::Guidance`], its Table 4 from [`Set::Inputs`].
    pub fn tables(&self) -> Vec<Table> {
        let sets = Set::ALL.into_iter().filter(|s| self.lines.iter().any(|l| l.variant.set == *s));
        let mut tables: Vec<Table> = sets.map(|set| self.table(set)).collect();
        if !self.without.is_empty() {
            let mut table = Table::new("No object could be measured", &["setting", "first reason"]);
            table.rows = self.without.iter().map(|w| vec![Cell::text(&w.name), Cell::text(&w.reason)]).collect();
            tables.push(table);
        }
        tables
    }

    fn table(&self, set: Set) -> Table {
        let lines: Vec<&Line> = self.lines.iter().filter(|l| l.variant.set == set).collect();
        let mut views: Vec<ViewSet> = lines.iter().flat_map(|l| l.comparisons.iter().map(|c| c.views)).collect();
        views.sort_unstable();
        views.dedup();
        let what = match set {
            Set::Guidance => "as in the paper's Table 3, lower half",
            Set::Inputs => "as in the paper's Table 4",
            _ => "one setting changed",
        };
        let caption = format!(
            "{}, {what}: PSNR in dB, difference to the default on the same objects with its 95 % bootstrap interval, and \
             seconds per object",
            set.name()
        );
        let mut table = Table::new(caption, &["setting"]);
        for v in &views {
            for column in ["objects", "PSNR", "difference", "interval", "s"] {
                table.head.push(format!("{v}: {column}"));
            }
            match set {
                Set::Guidance => table.head.push(format!("{v}: published (GSO)")),
                Set::Inputs if *v == ViewSet::Full => table.head.push("full: published (GSO)".into()),
                _ => {}
            }
        }
        for line in lines {
            let mut row = vec![Cell::link(&line.variant.name, Some(format!("{}/report.html", line.report)))];
            for &v in &views {
                let comparison = line.comparisons.iter().find(|c| c.views == v);
                row.extend(cells(comparison));
                match set {
                    Set::Guidance => row.push(Cell::text(published(&line.variant.name, v))),
                    Set::Inputs if v == ViewSet::Full => {
                        let found = NUMBER_OF_VIEWS.iter().find(|(n, _)| Some(*n) == line.variant.inputs);
                        row.push(Cell::text(found.map_or(String::new(), |(_, psnr)| format!("{psnr:.2}"))));
                    }
                    _ => {}
                }
            }
            table.rows.push(row);
        }
        if let Some(defaults) = self.lines.iter().find(|l| l.variant.set == set).map(|l| &l.comparisons) {
            let mut row = vec![Cell::text("default").strong()];
            for &v in &views {
                let default = defaults.iter().find(|c| c.views == v);
                row.extend(default_cells(default));
                if set == Set::Guidance {
                    row.push(Cell::text(published(TEST_TIME[0].0, v)));
                } else if set == Set::Inputs && v == ViewSet::Full {
                    row.push(Cell::text(""));
                }
            }
            table.rows.insert(0, row);
        }
        table
    }
}

fn published(name: &str, views: ViewSet) -> String {
    let found = TEST_TIME.iter().find(|(n, ..)| *n == name);
    found.map_or(String::new(), |(_, full, partial)| match views {
        ViewSet::Full => format!("{full:.2}"),
        ViewSet::Partial => format!("{partial:.2}"),
    })
}

/// Objects, PSNR, difference, interval, seconds.
fn cells(comparison: Option<&Comparison>) -> [Cell; 5] {
    let Some(c) = comparison else { return std::array::from_fn(|_| Cell::text("")) };
    let find = |name: &str| c.metrics.iter().find(|m| m.metric == name);
    let psnr = find("psnr");
    [
        Cell::text(c.objects),
        Cell::text(psnr.map_or("not computed".into(), |m| format!("{:.2}", m.b))),
        Cell::text(psnr.map_or(String::new(), |m| format!("{:+.2}", m.difference.mean))),
        Cell::text(psnr.map_or(String::new(), |m| format!("{:+.2} to {:+.2}", m.difference.low, m.difference.high))),
        Cell::text(find("seconds").map_or(String::new(), |m| format!("{:.2}", m.b))),
    ]
}

fn default_cells(comparison: Option<&Comparison>) -> [Cell; 5] {
    let Some(c) = comparison else { return std::array::from_fn(|_| Cell::text("")) };
    let value =
        |name: &str| c.metrics.iter().find(|m| m.metric == name).map_or(String::new(), |m| format!("{:.2}", m.a));
    [Cell::text(c.objects), Cell::text(value("psnr")), Cell::text(""), Cell::text(""), Cell::text(value("seconds"))]
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    fn values() -> Values {
        Values { steps: vec![5, 50], lambda: vec![0.5, 100.0], scale: vec![1.25], inputs: vec![2, 9] }
    }

    #[test]
    fn variants_change_what_they_say_and_have_folders_of_their_own() {
        let all = variants(&Set::ALL, &values());
        assert_eq!(all.len(), 3 + 2 + 2 + 1 + 2 + 2);
        assert_eq!(all.iter().map(|v| &v.folder).collect::<HashSet<_>>().len(), all.len());
        let default = json!({ "steps": 50, "cfg_scale": 1.5, "lambda_pg": 500.0 });
        let of = |folder: &str| all.iter().find(|v| v.folder == folder).unwrap().apply(&default);
        assert_eq!(of("steps-5"), json!({ "steps": 5, "cfg_scale": 1.5, "lambda_pg": 500.0 }));
        assert_eq!(of("no-guidance"), json!({ "steps": 50, "cfg_scale": 1.0, "lambda_pg": 0.0 }));
        assert_eq!(of("inputs-9"), default);
        assert_eq!(variants(&[Set::Scale], &values()).len(), 1);
        assert!(variants(&[], &values()).is_empty());
    }

    #[test]
    fn the_papers_names_are_found() {
        for variant in &variants(&[Set::Guidance], &values())[..2] {
            assert!(!published(&variant.name, ViewSet::Full).is_empty(), "{}", variant.name);
        }
    }
}
