//! The paper's four tables with rows trained at our size beside its own numbers, from the evaluations of every row.
//!
//! Input is a folder per row: `SOURCE/report.json` for each source of objects that it was evaluated on, `inputs-N/SOURCE`
//! for other numbers of input views, `no-cfg/SOURCE` and `no-photometric/SOURCE` for the two test-time rows, and
//! `model.json` (what `model info --json` prints of its checkpoint). Every difference is to the row `full`, paired by object.

use std::{collections::BTreeMap, path::Path};

use freerange_util::IoError;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::{
    EvalError, Report, RunFolder,
    compare::compare,
    folder::read_json,
    paper::{FULL, NUMBER_OF_VIEWS, PARTIAL, TEST_TIME, thousands},
    record::ViewSet,
    report::Group,
    scorer::frechet_vgg,
    statistics::{Interval, bootstrap, quantile},
    table::{Cell, Table},
};

/// The row that all others are compared with.
pub const PARENT: &str = "full";
/// Resamples of the Frechet distance: each wants two roots of matrices.
const FRECHET_RESAMPLES: usize = 200;

/// The file of [claims](PaperTables::keep).
const CLAIMS: &str = "claims.json";
const FRECHET_CLAIM: &str =
    "One sample of Full beats No flow matching in Frechet distance (VGG16) on views that no input saw";

/// A row that this project knows of: its folder, its name in tables, the paper's PSNR on GSO, full and partial.
type Known = (&'static str, &'static str, Option<[f64; 2]>);

/// The rows, in the order of tables. The paper's numbers are those of its Tables 1 to 3.
pub const ROWS: [Known; 16] = [
    ("full", "Full", Some([31.49, 28.08])),
    ("full_seed2", "Full, another seed", None),
    ("no_flow_matching", "No flow matching", Some([28.40, 26.30])),
    ("no_rendering", "No multi-view rendering loss", Some([29.66, 26.87])),
    ("no_curriculum", "No LoD curriculum", Some([30.00, 26.42])),
    ("no_patching_half", "Without patching, half the Gaussians", Some([30.47, 27.22])),
    ("no_patching", "Without patching, as many Gaussians", Some([30.54, 26.75])),
    ("random_patches", "Random patching", Some([30.84, 27.16])),
    ("no_gradient_channels", "No gradient channels", Some([30.89, 27.51])),
    ("full/no-cfg", "No classifier-free guidance (test time)", Some([TEST_TIME[1].1, TEST_TIME[1].2])),
    ("full/no-photometric", "No photometric guidance (test time)", Some([TEST_TIME[2].1, TEST_TIME[2].2])),
    ("full/four-samples", "Full, four samples of each object", None),
    ("pixel_aligned", "Pixel-aligned (GS-LRM)", Some([31.13, 27.57])),
    ("voxel_aligned", "Voxel-aligned (LaRa)", Some([29.15, 25.64])),
    ("tree_coupling", "Tree coupling (ours, beyond the paper)", None),
    ("pipeline", "The shipped pipeline (ours, beyond the paper)", None),
];

/// What is known of a row.
#[derive(Clone, Debug)]
struct Row {
    key: String,
    title: String,
    published: Option<[f64; 2]>,
    /// By source of objects.
    reports: BTreeMap<String, Report>,
    folders: BTreeMap<String, RunFolder>,
    model: Option<Value>,
}

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

/// The tables and the claims.
#[derive(Clone, Debug)]
pub struct PaperTables {
    /// In order.
    pub tables: Vec<Table>,
    /// Those that rows exist for.
    pub claims: Vec<Claim>,
    /// Rows that have no evaluation yet.
    pub missing: Vec<String>,
    rows: Vec<Row>,
}

impl PaperTables {
    /// Reads the rows' folders below `place`.
    ///
    /// # Errors
    /// Where there is no row `full`, a report is broken, or two rows were scored by different images.
    pub fn read(place: &Path, seed: u64) -> Result<Self, EvalError> {
        let mut rows = Vec::new();
        let mut missing = Vec::new();
        for (key, title, published) in ROWS {
            match read_row(place, key, title, published)? {
                row if row.reports.is_empty() => missing.push(title.to_owned()),
                row => rows.push(row),
            }
        }
        let Some(full) = rows.iter().find(|r| r.key == PARENT) else {
            let expected = format!("the evaluations of the row `{PARENT}`: {PARENT}/SOURCE/report.json");
            return Err(EvalError::file(place, expected, "none"));
        };
        let mut tables = Vec::new();
        for source in full.reports.keys() {
            tables.push(ablations(&rows, full, source, seed)?);
            tables.extend(methods(&rows, source, ViewSet::Partial));
            tables.extend(methods(&rows, source, ViewSet::Full));
        }
        tables.extend(views(place)?);
        let mut claims = Vec::new();
        let kept: Vec<Claim> = match place.join(CLAIMS) {
            file if file.is_file() => read_json(&file)?,
            _ => Vec::new(),
        };
        for source in full.reports.keys() {
            claims.extend(psnr_claims(&rows, full, source, seed)?);
            let own = |c: &&Claim| c.claim == FRECHET_CLAIM && c.source == *source;
            let found = frechet_claim(&rows, full, source, seed)?;
            claims.extend(found.or_else(|| kept.iter().find(own).cloned()));
        }
        if !claims.is_empty() {
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
            tables.insert(0, table);
        }
        for count in NUMBER_OF_VIEWS.map(|(count, _)| count).into_iter().filter(|count| *count != 4) {
            rows.push(read_row(place, &format!("{PARENT}/inputs-{count}"), "", None)?);
        }
        Ok(Self { tables, claims, missing, rows })
    }

    /// Writes what the tables are made of to `place`, from where they can be made again: every report without the scores of
    /// single views, what is known of checkpoints, and the claims, one of which rests on features that are not kept.
    ///
    /// # Errors
    /// [`EvalError::Io`].
    pub fn keep(&self, place: &Path) -> Result<(), EvalError> {
        for row in &self.rows {
            for (source, report) in &row.reports {
                let folder = place.join(&row.key).join(source);
                std::fs::create_dir_all(&folder).map_err(IoError::at(&folder))?;
                RunFolder::existing(&folder).write_json("report.json", &report.without_views())?;
            }
            if let Some(model) = row.model.as_ref().filter(|_| !row.key.contains('/')) {
                RunFolder::existing(&place.join(&row.key)).write_json("model.json", model)?;
            }
        }
        RunFolder::existing(place).write_json(CLAIMS, &self.claims)
    }

    /// As Markdown, with what is missing.
    pub fn markdown(&self) -> String {
        let mut out = String::new();
        for table in &self.tables {
            out += &format!("\n{}", table.markdown());
        }
        if !self.missing.is_empty() {
            out += &format!("\nNot measured yet: {}.\n", self.missing.join("; "));
        }
        out
    }
}

/// The evaluations in a row's folder, each in a folder of its source's name.
fn read_row(place: &Path, key: &str, title: &str, published: Option<[f64; 2]>) -> Result<Row, EvalError> {
    let folder = place.join(key);
    let (mut reports, mut folders) = (BTreeMap::new(), BTreeMap::new());
    let entries = std::fs::read_dir(&folder).into_iter().flatten().flatten();
    for entry in entries.filter(|e| e.path().join("report.json").is_file()) {
        let source = entry.file_name().to_string_lossy().into_owned();
        reports.insert(source.clone(), Report::load(&entry.path())?);
        folders.insert(source, RunFolder::existing(&entry.path()));
    }
    // Rows of test time are of the checkpoint of the row that they are in.
    let model = folder.ancestors().take(2).map(|f| f.join("model.json")).find(|f| f.is_file());
    let model = model.map(|file| read_json(&file)).transpose()?;
    Ok(Row { key: key.into(), title: title.into(), published, reports, folders, model })
}

impl Row {
    fn group(&self, source: &str, views: ViewSet) -> Option<&Group> {
        self.reports.get(source)?.groups.iter().find(|g| g.views == views && g.measured > 0)
    }

    fn fact(&self, name: &str) -> Option<f64> {
        self.model.as_ref()?.get(name)?.as_f64()
    }
}

fn or_empty(value: Option<String>) -> Cell {
    Cell::text(value.unwrap_or_default())
}

/// Table 3: every row's PSNR beside Full's, with the paper's differences.
fn ablations(rows: &[Row], full: &Row, source: &str, seed: u64) -> Result<Table, EvalError> {
    let caption = format!(
        "The paper's Table 3, on {source}: PSNR in dB, difference to Full on the same objects with its 95 % interval, \
         and the paper's difference on GSO"
    );
    let mut table = Table::new(caption, &["row", "parameters", "samples", "hours", "#GS", "s"]);
    for views in [ViewSet::Full, ViewSet::Partial] {
        table.head.extend(["PSNR", "difference", "interval", "paper"].map(|c| format!("{views}: {c}")));
    }
    for row in rows.iter().filter(|r| r.reports.contains_key(source)) {
        let any = row.group(source, ViewSet::Full).or(row.group(source, ViewSet::Partial));
        let mut cells = vec![
            Cell::text(&row.title),
            or_empty(row.fact("trainable").map(|n| format!("{:.2} M", n / 1e6))),
            or_empty(row.fact("samples").map(|n| format!("{n:.0}"))),
            or_empty(row.fact("training_seconds").map(|s| format!("{:.2}", s / 3600.0))),
            or_empty(any.map(|g| thousands(g.gaussians))),
            or_empty(any.map(|g| format!("{:.2}", g.seconds))),
        ];
        let compared = match row.key == PARENT {
            true => Vec::new(),
            false => compare(&full.reports[source], &row.reports[source], seed)?,
        };
        for (i, views) in [ViewSet::Full, ViewSet::Partial].into_iter().enumerate() {
            let psnr = row.group(source, views).and_then(|g| g.value("psnr"));
            cells.push(or_empty(psnr.map(|p| format!("{p:.2}"))));
            let paired = compared.iter().find(|c| c.views == views);
            let difference = paired.and_then(|c| c.metrics.iter().find(|m| m.metric == "psnr")).map(|m| m.difference);
            cells.push(or_empty(difference.map(|d| format!("{:+.2}", d.mean))));
            cells.push(or_empty(difference.map(|d| format!("{:+.2} to {:+.2}", d.low, d.high))));
            let paper = row.published.zip(full.published).map(|(own, full)| own[i] - full[i]);
            cells.push(or_empty(paper.filter(|_| row.key != PARENT).map(|d| format!("{d:+.2}"))));
        }
        table.rows.push(cells);
    }
    Ok(table)
}

/// Tables 1 and 2: the methods of the paper, published, and ours below.
fn methods(rows: &[Row], source: &str, views: ViewSet) -> Option<Table> {
    let keys = [PARENT, "full/four-samples", "no_flow_matching", "pixel_aligned", "voxel_aligned", "pipeline"];
    let ours: Vec<(&Row, &Group)> = rows
        .iter()
        .filter(|r| keys.contains(&r.key.as_str()))
        .filter_map(|r| Some((r, r.group(source, views)?)))
        .collect();
    if ours.is_empty() {
        return None;
    }
    let number = if views == ViewSet::Partial { 1 } else { 2 };
    let caption =
        format!("The paper's Table {number}, {views} observation: published numbers are of GSO, ours of {source}");
    let head = [
        "method",
        "#GS",
        "PSNR",
        "SSIM x100",
        "LPIPS (paper's own) x1000",
        "LPIPS (AlexNet) x1000",
        "LPIPS (VGG) x1000",
        "FID",
        "Frechet (VGG16)",
        "same, of four samples' mean",
        "same, unseen views",
        "unseen, mean",
    ];
    let mut table = Table::new(caption, &head);
    let text = |v: Option<f64>, decimals: usize| or_empty(v.map(|v| format!("{v:.decimals$}")));
    let mut publish = |name: &str, thousands: u32, [psnr, ssim, lpips, fid]: [Option<f64>; 4]| {
        let mut row = vec![Cell::text(format!("{name} (published)")), Cell::text(format!("{thousands}K"))];
        row.extend([text(psnr, 2), text(ssim, 2), text(lpips, 1), Cell::default(), Cell::default(), text(fid, 2)]);
        row.resize(head.len(), Cell::default());
        table.rows.push(row);
    };
    match views {
        ViewSet::Partial => {
            PARTIAL.iter().for_each(|(n, k, _, g)| publish(n, *k, [Some(g[0]), None, None, Some(g[3])]))
        }
        ViewSet::Full => {
            FULL.iter().for_each(|(n, k, _, g)| publish(n, *k, [Some(g[0]), Some(g[1]), Some(g[2]), None]))
        }
    }
    for (row, group) in ours {
        let value =
            |metric: &str, factor: f64, decimals: usize| text(group.value(metric).map(|v| factor * v), decimals);
        let frechet = group.frechet_vgg;
        let mut cells = vec![
            Cell::text(&row.title),
            Cell::text(thousands(group.gaussians)),
            value("psnr", 1.0, 2),
            value("ssim", 100.0, 2),
            Cell::default(),
            value("lpips-alex", 1000.0, 1),
            value("lpips-vgg", 1000.0, 1),
            value("fid", 1.0, 2),
        ];
        cells.extend([
            text(frechet.map(|f| f.sample), 2),
            text(frechet.and_then(|f| f.mean), 2),
            text(frechet.and_then(|f| f.unseen_sample), 2),
            text(frechet.and_then(|f| f.unseen_mean), 2),
        ]);
        table.rows.push(cells.into_iter().map(Cell::strong).collect());
    }
    Some(table)
}

/// Table 4: numbers of input views, full observation.
fn views(place: &Path) -> Result<Option<Table>, EvalError> {
    let mut table = Table::new(
        "The paper's Table 4: Full by its number of input views, full observation, PSNR in dB",
        &["input views", "paper (GSO)"],
    );
    let mut rows: BTreeMap<String, Vec<Option<f64>>> = BTreeMap::new();
    for (i, (count, _)) in NUMBER_OF_VIEWS.iter().enumerate() {
        let key = if *count == 4 { PARENT.to_owned() } else { format!("{PARENT}/inputs-{count}") };
        for (source, report) in read_row(place, &key, "", None)?.reports {
            let psnr = report.groups.iter().find(|g| g.views == ViewSet::Full && g.inputs == *count);
            let own = rows.entry(source).or_insert_with(|| vec![None; NUMBER_OF_VIEWS.len()]);
            own[i] = psnr.and_then(|g| g.value("psnr"));
        }
    }
    rows.retain(|_, values| values.iter().flatten().count() > 1);
    if rows.is_empty() {
        return Ok(None);
    }
    table.head.extend(rows.keys().cloned());
    for (i, (count, paper)) in NUMBER_OF_VIEWS.iter().enumerate() {
        let mut cells = vec![Cell::text(count), Cell::text(format!("{paper:.2}"))];
        cells.extend(rows.values().map(|own| or_empty(own[i].map(|p| format!("{p:.2}")))));
        table.rows.push(cells);
    }
    Ok(Some(table))
}

/// PSNR of each object, of a view set.
fn psnr_by_object(row: &Row, source: &str, views: ViewSet) -> BTreeMap<String, f64> {
    let Some(report) = row.reports.get(source) else { return BTreeMap::new() };
    let own = report.measured().filter(|(case, _)| case.views == views);
    own.filter_map(|(case, m)| Some((case.object.clone(), *m.metrics.get("psnr")?))).collect()
}

/// The claims that PSNR answers: what partial observation costs, and what flow matching is worth.
fn psnr_claims(rows: &[Row], full: &Row, source: &str, seed: u64) -> Result<Vec<Claim>, EvalError> {
    let find = |key: &str| rows.iter().find(|r| r.key == key);
    let of = |row: &Row, views| psnr_by_object(row, source, views);
    let mut out = Vec::new();
    let mut add = |claim: &str, differences: Vec<f64>| {
        if let Some(difference) = bootstrap(&differences, seed) {
            out.push(Claim { claim: claim.into(), source: source.into(), difference, unit: "dB".into() });
        }
    };
    if let Some(pixel) = find("pixel_aligned") {
        let lost = |row: &Row| -> BTreeMap<String, f64> {
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
    if let Some(without) = find("no_flow_matching") {
        for views in [ViewSet::Full, ViewSet::Partial] {
            let (ours, theirs) = (of(full, views), of(without, views));
            add(
                &format!("Flow matching raises PSNR, {views} observation"),
                ours.iter().filter_map(|(object, psnr)| Some(psnr - theirs.get(object)?)).collect(),
            );
        }
    }
    Ok(out)
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
        let views = (0..kept.unseen.len()).filter(|&i| kept.unseen[i]);
        out.insert(case.object.clone(), views.map(|i| (at(0, i), at(1, i))).collect());
    }
    Ok(out)
}

/// One sample of Full beats No flow matching in Frechet distance on views that no input saw.
fn frechet_claim(rows: &[Row], full: &Row, source: &str, seed: u64) -> Result<Option<Claim>, EvalError> {
    use rand::{Rng, SeedableRng};
    let Some(without) = rows.iter().find(|r| r.key == "no_flow_matching") else { return Ok(None) };
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
