//! What the rows say of the paper's claims.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{INPUTS, PARENT, Row};
use crate::{
    EvalError, Report, RunFolder,
    record::{Outcome, Record, VggFeatures, ViewSet},
    scorer::frechet_vgg,
    statistics::{Interval, bootstrap, quantile},
    table::{Cell, Table},
};

/// Resamples of the Frechet distance: each wants two roots of matrices.
const FRECHET_RESAMPLES: usize = 200;

/// The row that is compared with Full by what is new in its views.
const WITHOUT_FLOW: &str = "no_flow_matching";
const FRECHET_CLAIM: &str =
    "One sample of Full beats No flow matching in Frechet distance (VGG16) on views that no input saw";

/// An answer to one of the paper's claims.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Claim {
    /// What is claimed.
    pub claim: String,
    /// Of which objects.
    pub source: String,
    /// Positive where the claim holds; with its 95 % interval.
    pub difference: Interval,
    /// In which unit.
    pub unit: String,
}

impl Claim {
    /// `yes` where the whole interval is above zero, `no` where it is below, else `not decided`.
    pub fn answer(&self) -> &'static str {
        match self.difference {
            Interval { low, .. } if low > 0.0 => "yes",
            Interval { high, .. } if high < 0.0 => "no",
            _ => "not decided",
        }
    }
}

/// The claims that rows exist for, on the objects of `source`. `kept` holds the one whose features are not there any more.
pub(super) fn claims(
    rows: &[Row],
    full: &Row,
    source: &str,
    kept: &[Claim],
    seed: u64,
) -> Result<Vec<Claim>, EvalError> {
    let mut out = psnr_claims(rows, full, source, seed);
    let own = |c: &&Claim| c.claim == FRECHET_CLAIM && c.source == source;
    let found = frechet_claim(rows, full, source, seed)?;
    out.extend(found.or_else(|| kept.iter().find(own).cloned()));
    Ok(out)
}

pub(super) fn table(claims: &[Claim]) -> Table {
    let mut table = Table::new("The paper's claims", &["claim", "objects", "answer", "difference", "interval"]);
    table.rows = claims
        .iter()
        .map(|c| {
            let Interval { mean, low, high } = c.difference;
            let texts = [
                c.claim.clone(),
                c.source.clone(),
                c.answer().into(),
                format!("{mean:+.2} {}", c.unit),
                format!("{low:+.2} to {high:+.2}"),
            ];
            texts.into_iter().map(Cell::text).collect()
        })
        .collect();
    table
}

/// PSNR of each object.
pub(super) type PsnrByObject = BTreeMap<String, f64>;

/// PSNR of each object, of a view set and a number of input views.
pub(super) fn psnr_by_object(row: &Row, source: &str, views: ViewSet, inputs: usize) -> PsnrByObject {
    let Some(report) = row.reports.get(source) else { return BTreeMap::new() };
    let own = report.measured().filter(|(case, _)| (case.views, case.inputs) == (views, inputs));
    own.filter_map(|(case, m)| Some((case.object.clone(), *m.metrics.get("psnr")?))).collect()
}

/// The claims that PSNR answers: what partial observation costs, and what flow matching is worth.
fn psnr_claims(rows: &[Row], full: &Row, source: &str, seed: u64) -> Vec<Claim> {
    let find = |key: &str| rows.iter().find(|r| r.key == key);
    let of = |row: &Row, views| psnr_by_object(row, source, views, INPUTS);
    let mut out = Vec::new();
    let mut add = |claim: &str, differences: Vec<f64>| {
        if let Some(difference) = bootstrap(&differences, seed) {
            out.push(Claim { claim: claim.into(), source: source.into(), difference, unit: "dB".into() });
        }
    };
    if let Some(pixel) = find("pixel_aligned") {
        let lost = |row: &Row| -> PsnrByObject {
            let partial = of(row, ViewSet::Partial);
            let both = of(row, ViewSet::Full).into_iter();
            both.filter_map(|(object, full)| Some((object.clone(), full - partial.get(&object)?))).collect()
        };
        let (ours, theirs) = (lost(full), lost(pixel));
        add(
            "From one side the pixel-aligned baseline loses more than Full",
            theirs.iter().filter_map(|(object, lost)| Some(lost - ours.get(object)?)).collect(),
        );
    }
    if let Some(without) = find(WITHOUT_FLOW) {
        for views in [ViewSet::Full, ViewSet::Partial] {
            let (ours, theirs) = (of(full, views), of(without, views));
            add(
                &format!("Flow matching raises PSNR, {views} observation"),
                ours.iter().filter_map(|(object, psnr)| Some(psnr - theirs.get(object)?)).collect(),
            );
        }
    }
    out
}

/// VGG16's features of the views of an object from where no input looks: of the first sample's renders, and of the images.
type Unseen = Vec<(Vec<f32>, Vec<f32>)>;

fn unseen_features(row: &Row, source: &str) -> Result<BTreeMap<String, Unseen>, EvalError> {
    let (Some(report), Some(folder)) = (row.reports.get(source), row.folders.get(source)) else {
        return Ok(BTreeMap::new());
    };
    let mut out = BTreeMap::new();
    for (case, measured) in report.measured().filter(|(case, _)| case.views == ViewSet::Partial) {
        let Some(kept) = measured.vgg.as_ref().filter(|_| folder.has_vgg_features(case)) else { continue };
        let parts = if kept.samples > 1 { 3 } else { 2 };
        let all = folder.vgg_features(case, kept.count)?;
        let width = kept.count / (parts * kept.unseen.len().max(1));
        let at = |part: usize, view: usize| all[(part * kept.unseen.len() + view) * width..][..width].to_vec();
        let views: Unseen = (0..kept.unseen.len()).filter(|&i| kept.unseen[i]).map(|i| (at(0, i), at(1, i))).collect();
        if !views.is_empty() {
            out.insert(case.object.clone(), views);
        }
    }
    Ok(out)
}

/// Writes the features of unseen views of the rows that the claim compares, and has `report` say so.
pub(super) fn keep_features(row: &Row, source: &str, report: &mut Report, to: &RunFolder) -> Result<(), EvalError> {
    if row.key != PARENT && row.key != WITHOUT_FLOW {
        return Ok(());
    }
    let found = unseen_features(row, source)?;
    for Record { case, outcome } in &mut report.records {
        let (Outcome::Measured(measured), Some(views)) = (outcome, found.get(&case.object)) else { continue };
        if case.views == ViewSet::Partial {
            let all: Vec<f32> =
                views.iter().flat_map(|v| &v.0).chain(views.iter().flat_map(|v| &v.1)).copied().collect();
            to.write_vgg_features(case, &all)?;
            measured.vgg = Some(VggFeatures { count: all.len(), unseen: vec![true; views.len()], samples: 1 });
        }
    }
    Ok(())
}

/// One sample of Full beats No flow matching in Frechet distance on views that no input saw.
fn frechet_claim(rows: &[Row], full: &Row, source: &str, seed: u64) -> Result<Option<Claim>, EvalError> {
    use rand::{Rng, SeedableRng};
    let Some(without) = rows.iter().find(|r| r.key == WITHOUT_FLOW) else { return Ok(None) };
    let (ours, theirs) = (unseen_features(full, source)?, unseen_features(without, source)?);
    let objects: Vec<&String> = ours.keys().filter(|o| theirs.contains_key(*o)).collect();
    if objects.len() < 2 {
        return Ok(None);
    }
    let distance = |features: &BTreeMap<String, Unseen>, chosen: &[&String]| {
        let views: Vec<&(Vec<f32>, Vec<f32>)> = chosen.iter().flat_map(|o| &features[*o]).collect();
        let (renders, truths): (Vec<&[f32]>, Vec<&[f32]>) =
            views.iter().map(|(a, b)| (a.as_slice(), b.as_slice())).unzip();
        frechet_vgg(&renders, &truths)
    };
    let difference = |chosen: &[&String]| -> Result<Option<f64>, EvalError> {
        Ok(distance(&theirs, chosen)?.zip(distance(&ours, chosen)?).map(|(theirs, ours)| theirs - ours))
    };
    let Some(mean) = difference(&objects)? else { return Ok(None) };
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let mut resampled = Vec::with_capacity(FRECHET_RESAMPLES);
    for _ in 0..FRECHET_RESAMPLES {
        let chosen: Vec<&String> = (0..objects.len()).map(|_| objects[rng.random_range(0..objects.len())]).collect();
        resampled.extend(difference(&chosen)?);
    }
    resampled.sort_unstable_by(f64::total_cmp);
    Ok(Some(Claim {
        claim: FRECHET_CLAIM.into(),
        source: source.into(),
        difference: Interval { mean, low: quantile(&resampled, 0.025), high: quantile(&resampled, 0.975) },
        unit: String::new(),
    }))
}
