//! The paper's four tables with rows trained at our size beside its own numbers, from the evaluations of every row.
//!
//! Input is a folder per row: `SOURCE/report.json` for each source of objects that it was evaluated on, `inputs-N/SOURCE`
//! for other numbers of input views, `no-cfg/SOURCE` and `no-photometric/SOURCE` for the two test-time rows,
//! `model.json` (what `model info --json` prints of its checkpoint), and `log.jsonl` of its training. Every difference is to the row `full`, paired by object.

mod claims;
mod layout;

use std::{collections::BTreeMap, path::Path};

use freerange_util::IoError;
use serde_json::Value;

pub use claims::Claim;

use crate::{
    EvalError, Report, RunFolder,
    compare::{Comparison, compare},
    folder::read_json,
    paper::{NUMBER_OF_VIEWS, TEST_TIME},
    record::ViewSet,
    report::Group,
    table::Table,
};

/// The row that all others are compared with.
pub const PARENT: &str = "full";
/// The row of several samples of each object.
const FOUR_SAMPLES: &str = "full/four-samples";
/// The source that is the 21 objects, as `tools/tables.sh` calls it.
const OBJECTS: &str = "objects";
/// Input views of all rows but those of other numbers of views.
const INPUTS: usize = 4;
/// The file of a training's losses.
const LOG: &str = "log.jsonl";
/// The file of [claims](PaperTables::keep).
const CLAIMS: &str = "claims.json";

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
    (FOUR_SAMPLES, "Full, four samples of each object", None),
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
    /// Of the training.
    log: Option<String>,
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
        let kept: Vec<Claim> = match place.join(CLAIMS) {
            file if file.is_file() => read_json(&file)?,
            _ => Vec::new(),
        };
        let (mut tables, mut claims) = (Vec::new(), Vec::new());
        for source in full.reports.keys() {
            let compared = compared(&rows, full, source, seed)?;
            tables.push(layout::ablations(&compared, full, source));
            tables.extend(layout::differences(&compared, source));
            tables.extend(layout::methods(&rows, source, ViewSet::Partial));
            tables.extend(layout::methods(&rows, source, ViewSet::Full));
            claims.extend(claims::claims(&rows, full, source, &kept, seed)?);
        }
        tables.extend(layout::views(place, full, seed)?);
        if !claims.is_empty() {
            tables.insert(0, claims::table(&claims));
        }
        for count in NUMBER_OF_VIEWS.map(|(count, _)| count).into_iter().filter(|count| *count != INPUTS) {
            match read_row(place, &format!("{PARENT}/inputs-{count}"), "", None)? {
                row if row.reports.is_empty() => missing.push(format!("Full, {count} input views (test time)")),
                row => rows.push(row),
            }
        }
        missing.extend(without_objects(&rows));
        Ok(Self { tables, claims, missing, rows })
    }

    /// Writes what the tables are made of to `place`, from where they can be made again: every report without the scores of
    /// single views, the features that a claim rests on, what is known of checkpoints, every tenth step of their training,
    /// and the claims. `place` may be where the rows were read from.
    ///
    /// # Errors
    /// [`EvalError::Io`].
    pub fn keep(&self, place: &Path) -> Result<(), EvalError> {
        for row in &self.rows {
            for (source, report) in &row.reports {
                let folder = place.join(&row.key).join(source);
                std::fs::create_dir_all(&folder).map_err(IoError::at(&folder))?;
                let to = RunFolder::existing(&folder);
                let mut report = report.without_views();
                claims::keep_features(row, source, &mut report, &to)?;
                to.write_json("report.json", &report)?;
            }
            if row.key.contains('/') {
                continue; // of the checkpoint of the row that it is in
            }
            let to = RunFolder::existing(&place.join(&row.key));
            if let Some(model) = &row.model {
                to.write_json("model.json", model)?;
            }
            if let Some(log) = &row.log {
                to.write_text(LOG, &every_tenth(log))?;
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
    let log = folder.join(LOG);
    let log = log.is_file().then(|| std::fs::read_to_string(&log).map_err(IoError::at(&log))).transpose()?;
    Ok(Row { key: key.into(), title: title.into(), published, reports, folders, model, log })
}

/// The lines of a training's log whose step is a multiple of ten.
fn every_tenth(log: &str) -> String {
    let step = |line: &str| serde_json::from_str::<Value>(line).ok()?.get("step")?.as_u64();
    log.lines()
        .filter(|line| step(line).is_some_and(|n| n.is_multiple_of(10)))
        .map(|line| format!("{line}\n"))
        .collect()
}

impl Row {
    fn group(&self, source: &str, views: ViewSet) -> Option<&Group> {
        self.reports.get(source)?.groups.iter().find(|g| g.views == views && g.measured > 0)
    }

    fn fact(&self, name: &str) -> Option<f64> {
        self.model.as_ref()?.get(name)?.as_f64()
    }
}

/// The rows that are not evaluated on the 21 objects and should be: of few evaluations generated objects are enough.
fn without_objects(rows: &[Row]) -> Option<String> {
    let wanted = |row: &&Row| !row.title.is_empty() && row.key != FOUR_SAMPLES;
    let without = |row: &&Row| !row.reports.contains_key(OBJECTS);
    let titles: Vec<&str> = rows.iter().filter(wanted).filter(without).map(|row| row.title.as_str()).collect();
    match titles.len() {
        0 => None,
        n if n == rows.iter().filter(wanted).count() => Some("every row on the 21 objects".into()),
        _ => Some(format!("on the 21 objects {}", titles.join(", "))),
    }
}

/// Every row that was evaluated on `source`, beside Full on the objects that both have. Full itself has no comparisons.
type Compared<'a> = Vec<(&'a Row, Vec<Comparison>)>;

fn compared<'a>(rows: &'a [Row], full: &Row, source: &str, seed: u64) -> Result<Compared<'a>, EvalError> {
    let own = rows.iter().filter_map(|row| Some((row, row.reports.get(source)?)));
    own.map(|(row, report)| match row.key == PARENT {
        true => Ok((row, Vec::new())),
        false => Ok((row, compare(&full.reports[source], report, seed)?)),
    })
    .collect()
}
