//! The layout of the tables.

use std::{collections::BTreeMap, path::Path};

use super::{
    Compared, FOUR_SAMPLES, INPUTS, PARENT, Row,
    claims::{PsnrByObject, psnr_by_object},
    read_row,
};
use crate::{
    EvalError,
    compare::{Comparison, Paired, compare},
    paper::{FULL, GSO, NUMBER_OF_VIEWS, PARTIAL, printed, thousands},
    record::{ViewSet, style},
    report::Group,
    statistics::{bootstrap, mean},
    table::{Cell, Table},
};

/// Metrics beside PSNR whose differences are shown.
const FURTHER: [&str; 3] = ["ssim", "lpips-alex", "lpips-vgg"];

fn or_empty(value: Option<String>) -> Cell {
    Cell::text(value.unwrap_or_default())
}

/// Table 3: every row's PSNR beside Full's, with the paper's differences.
pub(super) fn ablations(compared: &Compared<'_>, full: &Row, source: &str) -> Table {
    let caption = format!(
        "The paper's Table 3, on {source}: PSNR in dB of the objects that a row shares with Full, difference to Full on \
         these with its 95 % interval, and the paper's difference on GSO"
    );
    let mut table = Table::new(caption, &["row", "parameters", "samples", "hours", "#GS", "s"]);
    for views in [ViewSet::Full, ViewSet::Partial] {
        table.head.extend(["objects", "PSNR", "difference", "interval", "paper"].map(|c| format!("{views}: {c}")));
    }
    for (row, comparisons) in compared {
        let any = row.group(source, ViewSet::Full).or(row.group(source, ViewSet::Partial));
        let mut cells = vec![
            Cell::text(&row.title),
            or_empty(row.fact("trainable").map(|n| format!("{:.2} M", n / 1e6))),
            or_empty(row.fact("samples").map(|n| format!("{n:.0}"))),
            or_empty(row.fact("training_seconds").map(|s| format!("{:.2}", s / 3600.0))),
            or_empty(any.map(|g| thousands(g.gaussians))),
            or_empty(any.map(|g| format!("{:.2}", g.seconds))),
        ];
        for (i, views) in [ViewSet::Full, ViewSet::Partial].into_iter().enumerate() {
            let paired = paired(comparisons, views, "psnr");
            let own = row.group(source, views).filter(|_| row.key == PARENT);
            let objects = paired.map(Paired::objects).or(own.map(|g| g.measured));
            cells.push(or_empty(objects.map(|n| n.to_string())));
            let psnr = paired.map(|p| p.b).or(own.and_then(|g| g.value("psnr")));
            cells.push(or_empty(psnr.map(|p| format!("{p:.2}"))));
            let difference = paired.map(|p| p.difference);
            cells.push(or_empty(difference.map(|d| format!("{:+.2}", d.mean))));
            cells.push(or_empty(difference.map(|d| format!("{:+.2} to {:+.2}", d.low, d.high))));
            let paper = row.published.zip(full.published).map(|(own, full)| own[i] - full[i]);
            cells.push(or_empty(paper.filter(|_| row.key != PARENT).map(|d| format!("{d:+.2}"))));
        }
        table.rows.push(cells);
    }
    table
}

/// How a metric of a row differs from Full's.
fn paired<'a>(comparisons: &'a [Comparison], views: ViewSet, metric: &str) -> Option<&'a Paired> {
    comparisons.iter().find(|c| c.views == views)?.metrics.iter().find(|m| m.metric == metric)
}

/// What Table 3 has no room for: differences to Full in SSIM and LPIPS.
pub(super) fn differences(compared: &Compared<'_>, source: &str) -> Option<Table> {
    let caption = format!("SSIM and LPIPS on {source}: difference to Full on the same objects with its 95 % interval");
    let mut table = Table::new(caption, &["row"]);
    for views in [ViewSet::Full, ViewSet::Partial] {
        table.head.push(format!("{views}: objects"));
        table.head.extend(FURTHER.map(|metric| format!("{views}: {}", style(metric).0)));
    }
    for (row, comparisons) in compared.iter().filter(|(row, _)| row.key != PARENT) {
        let mut cells = vec![Cell::text(&row.title)];
        for views in [ViewSet::Full, ViewSet::Partial] {
            let objects = comparisons.iter().find(|c| c.views == views).map(|c| c.objects.to_string());
            cells.push(or_empty(objects));
            cells.extend(FURTHER.map(|metric| or_empty(paired(comparisons, views, metric).map(signed))));
        }
        table.rows.push(cells);
    }
    (!table.rows.is_empty()).then_some(table)
}

/// A difference with its interval, in the unit of tables.
fn signed(paired: &Paired) -> String {
    let (_, factor, decimals) = style(&paired.metric);
    let [mean, low, high] = [paired.difference.mean, paired.difference.low, paired.difference.high]
        .map(|v| format!("{:+.decimals$}", factor * v));
    format!("{mean} ({low} to {high})")
}

/// A column of Tables 1 and 2: its head, which of the paper's values is in it, and our metric, its factor and decimals.
type Column = (&'static str, Option<usize>, &'static str, f64, usize);

const PARTIAL_COLUMNS: [Column; 7] = [
    ("PSNR", Some(0), "psnr", 1.0, 2),
    ("DINO x100", Some(1), "dino", 100.0, 2),
    ("DreamSim x100", Some(2), "dreamsim", 100.0, 2),
    ("FID", Some(3), "fid", 1.0, 2),
    ("SSIM x100", None, "ssim", 100.0, 2),
    ("LPIPS (AlexNet) x1000", None, "lpips-alex", 1000.0, 1),
    ("LPIPS (VGG) x1000", None, "lpips-vgg", 1000.0, 1),
];
/// The paper does not say which LPIPS its values are.
const FULL_COLUMNS: [Column; 5] = [
    ("PSNR", Some(0), "psnr", 1.0, 2),
    ("SSIM x100", Some(1), "ssim", 100.0, 2),
    ("LPIPS (paper's own) x1000", Some(2), "", 1000.0, 1),
    ("LPIPS (AlexNet) x1000", None, "lpips-alex", 1000.0, 1),
    ("LPIPS (VGG) x1000", None, "lpips-vgg", 1000.0, 1),
];
/// Columns of the Frechet distance, which the paper does not have.
const FRECHET: [&str; 5] =
    ["Frechet (VGG16)", "same, of four samples' mean", "same, unseen views", "unseen, mean", "unseen images"];

/// Tables 1 and 2: the methods of the paper, published, and ours below.
pub(super) fn methods(rows: &[Row], source: &str, views: ViewSet) -> Option<Table> {
    let keys = [PARENT, FOUR_SAMPLES, "no_flow_matching", "pixel_aligned", "voxel_aligned", "pipeline"];
    let ours: Vec<(&Row, &Group)> = rows
        .iter()
        .filter(|r| keys.contains(&r.key.as_str()))
        .filter_map(|r| Some((r, r.group(source, views)?)))
        .collect();
    if ours.is_empty() {
        return None;
    }
    let (number, columns): (_, &[Column]) = match views {
        ViewSet::Partial => (1, &PARTIAL_COLUMNS),
        ViewSet::Full => (2, &FULL_COLUMNS),
    };
    let caption =
        format!("The paper's Table {number}, {views} observation: published numbers are of GSO, ours of {source}");
    let mut table = Table::new(caption, &["method", "#GS", "objects"]);
    table.head.extend(columns.iter().map(|c| c.0).chain(FRECHET).map(String::from));
    let mut publish = |name: &str, thousands: u32, values: &[f64]| {
        let mut row = vec![Cell::text(format!("{name} (published)")), Cell::text(format!("{thousands}K"))];
        row.push(Cell::text(GSO));
        row.extend(columns.iter().map(|c| or_empty(c.1.map(|i| printed(values[i])))));
        row.resize(row.len() + FRECHET.len(), Cell::default());
        table.rows.push(row);
    };
    match views {
        ViewSet::Partial => PARTIAL.iter().for_each(|(name, k, _, gso)| publish(name, *k, gso)),
        ViewSet::Full => FULL.iter().for_each(|(name, k, _, gso)| publish(name, *k, gso)),
    }
    let text = |v: Option<f64>, decimals: usize| or_empty(v.map(|v| format!("{v:.decimals$}")));
    for (row, group) in ours {
        let mut cells =
            vec![Cell::text(&row.title), Cell::text(thousands(group.gaussians)), Cell::text(group.measured)];
        cells.extend(
            columns
                .iter()
                .map(|&(_, _, metric, factor, decimals)| text(group.value(metric).map(|v| factor * v), decimals)),
        );
        let frechet = group.frechet_vgg;
        cells.extend([
            text(frechet.map(|f| f.sample), 2),
            text(frechet.and_then(|f| f.mean), 2),
            text(frechet.and_then(|f| f.unseen_sample), 2),
            text(frechet.and_then(|f| f.unseen_mean), 2),
            or_empty(frechet.map(|f| f.unseen_images.to_string())),
        ]);
        table.rows.push(cells.into_iter().map(Cell::strong).collect());
    }
    Some(table)
}

/// Table 4: numbers of input views, full observation, on the objects that all of them have; one table for each source.
pub(super) fn views(place: &Path, full: &Row, seed: u64) -> Result<Vec<Table>, EvalError> {
    let mut sources: BTreeMap<String, BTreeMap<usize, PsnrByObject>> = BTreeMap::new();
    for (count, _) in NUMBER_OF_VIEWS {
        let key = if count == INPUTS { PARENT.to_owned() } else { format!("{PARENT}/inputs-{count}") };
        let row = read_row(place, &key, "", None)?;
        for (source, report) in &row.reports {
            if let Some(full) = full.reports.get(source).filter(|_| count != INPUTS) {
                compare(full, report, seed)?; // or the images differ
            }
            let psnr = psnr_by_object(&row, source, ViewSet::Full, count);
            if !psnr.is_empty() {
                sources.entry(source.clone()).or_default().insert(count, psnr);
            }
        }
    }
    Ok(sources.iter().filter(|(_, rows)| rows.len() > 1).map(|(source, rows)| by_views(source, rows, seed)).collect())
}

fn by_views(source: &str, rows: &BTreeMap<usize, PsnrByObject>, seed: u64) -> Table {
    let any = rows.values().next().into_iter().flat_map(BTreeMap::keys);
    let common: Vec<&String> = any.filter(|object| rows.values().all(|row| row.contains_key(*object))).collect();
    let caption = format!(
        "The paper's Table 4, on {source}: Full by its number of input views, full observation, on the {} objects that all \
         of these have; PSNR in dB, and the difference to {INPUTS} views with its 95 % interval",
        common.len()
    );
    let head = ["input views", "PSNR", "difference", "interval", "paper (GSO)", "paper: difference"];
    let mut table = Table::new(caption, &head);
    let (_, of_four) = NUMBER_OF_VIEWS[1];
    for (count, paper) in NUMBER_OF_VIEWS {
        let psnr = rows.get(&count).map(|row| common.iter().map(|object| row[*object]).collect::<Vec<f64>>());
        let four = rows.get(&INPUTS).filter(|_| count != INPUTS);
        let differences = psnr.iter().flatten().zip(&common).filter_map(|(psnr, object)| Some(psnr - four?[*object]));
        let difference = bootstrap(&differences.collect::<Vec<f64>>(), seed);
        table.rows.push(vec![
            Cell::text(count),
            or_empty(psnr.and_then(|psnr| mean(&psnr)).map(|p| format!("{p:.2}"))),
            or_empty(difference.map(|d| format!("{:+.2}", d.mean))),
            or_empty(difference.map(|d| format!("{:+.2} to {:+.2}", d.low, d.high))),
            Cell::text(format!("{paper:.2}")),
            or_empty((count != INPUTS).then(|| format!("{:+.2}", paper - of_four))),
        ]);
    }
    table
}
