//! Many scenes: each in a folder of its own, as often interrupted as one likes, and a table at the end.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    io::Write,
    path::{Path, PathBuf},
    time::{Instant, UNIX_EPOCH},
};

use freerange::{KeepWhole, Reconstructor, SETTINGS_SCHEMA, Scores};
use freerange_train::ranks::gather;
use freerange_util::write_atomically;
use serde::{Deserialize, Serialize};

use super::{Args, Program, SceneReport};
use crate::{error::CliError, ranks::Job};

/// In each scene's folder, once it is finished: what it was made with, and how it went.
const RECORD: &str = "scene.json";

/// A scene of the list.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Entry {
    /// Its folder below the output.
    name: String,
    scene: PathBuf,
}

/// What a scene was made with and what came of it.
#[derive(Serialize, Deserialize)]
struct Record {
    /// The program's version; not compared.
    version: String,
    scene: PathBuf,
    /// Each option that has to do with the result.
    options: BTreeMap<String, String>,
    /// Each file that was read: its size and when it was last changed.
    files: BTreeMap<PathBuf, String>,
    result: Row,
}

/// How a scene went.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Status {
    /// Made now.
    Done,
    /// Finished before.
    Kept,
    Failed,
}

/// A line of the table.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Row {
    scene: String,
    status: Status,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    error: Option<String>,
    gaussians: usize,
    input_views: Option<Mean>,
    further_views: Option<Mean>,
    seconds: f64,
}

/// Means over views.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct Mean {
    views: usize,
    psnr: f64,
    ssim: f64,
}

impl Mean {
    fn of(scores: &Option<Scores>) -> Option<Self> {
        scores.as_ref().map(|s| Self { views: s.views.len(), psnr: s.psnr, ssim: s.ssim })
    }
}

/// Whether the command line asks for many scenes.
pub fn asked(args: &Args) -> bool {
    args.scene.len() > 1 || args.list.is_some() || args.shard.is_some()
}

/// Runs the command on many scenes.
pub fn run(args: &Args, job: &Job) -> Result<(), CliError> {
    let Prepared { own, model, program, options, before } = job.together(Prepared::new(args, job))?;
    let (mut rows, mut code) = (Vec::new(), 0);
    for (i, ((number, entry), record)) in own.iter().zip(before).enumerate() {
        let begin = Instant::now();
        let failed = |error: &CliError| Row {
            scene: entry.name.clone(),
            status: Status::Failed,
            error: Some(error.to_string()),
            gaussians: 0,
            input_views: None,
            further_views: None,
            seconds: begin.elapsed().as_secs_f64(),
        };
        let row = one(args, entry, record, &model, &program, &options).unwrap_or_else(|error| {
            // A failure of ours weighs more than input that cannot be used.
            code = if code == 1 { 1 } else { error.exit_code() };
            failed(&error)
        });
        let line = match (&row.error, row.status) {
            (Some(error), _) => format!("failed: {error}"),
            (None, Status::Kept) => "was finished before".into(),
            _ => format!("done in {:.1} s", row.seconds),
        };
        eprintln!("{}/{} {}: {line}", i + 1, own.len(), entry.name);
        rows.push((*number, row));
    }
    let rows = (rows, code);
    let Some((rows, code)) = joined(job, rows)? else { return job.together(Ok(())) };
    job.together(report(args, rows, code))
}

/// The table of all scenes, and the error if some failed.
fn report(args: &Args, rows: Vec<Row>, code: u8) -> Result<(), CliError> {
    let json = serde_json::to_string_pretty(&rows).map_err(CliError::failure)?;
    let table = match args.shard {
        None => "scenes.json".to_owned(),
        Some((i, n)) => format!("scenes-{i}-of-{n}.json"),
    };
    std::fs::create_dir_all(&args.output).map_err(|e| CliError::file(&args.output, e))?;
    let path = args.output.join(table);
    write_atomically(&path, |file| file.write_all(json.as_bytes())).map_err(|e| CliError::file(&path, e))?;
    match args.json {
        true => println!("{json}"),
        false => print(&rows, &path),
    }
    let bad: Vec<&str> = rows.iter().filter(|r| r.error.is_some()).map(|r| r.scene.as_str()).collect();
    let text = format!("{} of {} scenes failed: {}", bad.len(), rows.len(), bad.join(", "));
    match code {
        0 => Ok(()),
        1 => Err(CliError::failure(text)),
        _ => Err(CliError::input(text)),
    }
}

/// All that is looked at before the first scene is begun.
struct Prepared {
    /// The scenes of this process, with their numbers in the list.
    own: Vec<(usize, Entry)>,
    model: Reconstructor,
    program: Program,
    options: BTreeMap<String, String>,
    /// What is known of each of them from before.
    before: Vec<Option<Record>>,
}

impl Prepared {
    fn new(args: &Args, job: &Job) -> Result<Self, CliError> {
        if args.eval_scene.is_some() {
            return Err(CliError::input(
                "--eval-scene: expected one scene; with several, hold photos out with --holdout-every",
            ));
        }
        let entries = named(scenes(args)?)?;
        let (index, count) = args.shard.unwrap_or(job.share());
        let own: Vec<(usize, Entry)> = entries.into_iter().enumerate().filter(|(i, _)| i % count == index).collect();
        let device = job.open(args.pipeline.device)?;
        let model = args.pipeline.open(&device)?;
        let checkpoint = args.pipeline.checkpoint_sha256()?;
        let program = Program::of(&model, checkpoint.clone());
        let options = options(args, &model, checkpoint)?;
        let before = match args.overwrite {
            // Whatever lies there, none of it counts.
            true => own.iter().map(|_| None).collect(),
            false => own.iter().map(|(_, e)| recorded(&args.output.join(&e.name))).collect::<Result<Vec<_>, _>>()?,
        };
        for ((_, entry), record) in own.iter().zip(&before) {
            if let Some(record) = record {
                same_options(&args.output.join(&entry.name).join(RECORD), &record.options, &options)?;
            }
        }
        Ok(Self { own, model, program, options, before })
    }
}

/// On rank 0 the rows of all ranks in the list's order, and the exit code: a failure of ours weighs more than input that
/// cannot be used.
fn joined(job: &Job, own: (Vec<(usize, Row)>, u8)) -> Result<Option<(Vec<Row>, u8)>, CliError> {
    let mut rows = Vec::new();
    let mut codes = Vec::new();
    for text in gather(&*job.ranks, &serde_json::to_vec(&own).map_err(CliError::failure)?)? {
        let (theirs, code): (Vec<(usize, Row)>, u8) = serde_json::from_slice(&text).map_err(CliError::failure)?;
        rows.extend(theirs);
        codes.extend((code > 0).then_some(code));
    }
    rows.sort_by_key(|(number, _)| *number);
    let code = codes.into_iter().min().unwrap_or(0);
    Ok(job.first().then(|| (rows.into_iter().map(|(_, row)| row).collect(), code)))
}

/// The scenes that the command line and the list name.
fn scenes(args: &Args) -> Result<Vec<PathBuf>, CliError> {
    let mut scenes = args.scene.clone();
    if let Some(list) = &args.list {
        let text = std::fs::read_to_string(list).map_err(|e| CliError::file(list, e))?;
        let folder = list.parent().unwrap_or(Path::new(""));
        let lines = text.lines().map(str::trim).filter(|l| !l.is_empty() && !l.starts_with('#'));
        scenes.extend(lines.map(|line| folder.join(line)));
        if scenes.is_empty() {
            return Err(CliError::file(list, "expected a scene on each line, found none"));
        }
    }
    Ok(scenes)
}

/// Each scene with a name of its own: its last folder, with those above it where that is not enough.
fn named(scenes: Vec<PathBuf>) -> Result<Vec<Entry>, CliError> {
    let parts: Vec<Vec<String>> = scenes
        .iter()
        .map(|scene| {
            // `.` and links have names, too.
            let mut whole = std::fs::canonicalize(scene).unwrap_or_else(|_| scene.clone());
            if whole.is_file() {
                whole.pop();
            }
            let normal = |c: std::path::Component| match c {
                std::path::Component::Normal(name) => Some(name.to_string_lossy().into_owned()),
                _ => None,
            };
            whole.components().filter_map(normal).collect()
        })
        .collect();
    let longest = parts.iter().map(Vec::len).max().unwrap_or(0);
    let mut found: Vec<Option<String>> = vec![None; parts.len()];
    for depth in 1..=longest {
        if !found.contains(&None) {
            break;
        }
        let tails: Vec<String> = parts.iter().map(|p| p[p.len().saturating_sub(depth)..].join("-")).collect();
        let mut count: HashMap<&str, usize> = HashMap::new();
        tails.iter().for_each(|tail| *count.entry(tail).or_default() += 1);
        for (name, tail) in found.iter_mut().zip(&tails) {
            if name.is_none() && !tail.is_empty() && count[tail.as_str()] == 1 {
                *name = Some(tail.clone());
            }
        }
    }
    if let Some(twice) = found.iter().position(Option::is_none) {
        return Err(CliError::file(&scenes[twice], "expected every scene once, found it twice"));
    }
    let names: Vec<String> = found.into_iter().flatten().collect();
    let different: BTreeSet<&String> = names.iter().collect();
    if different.len() < names.len() {
        return Err(CliError::input(format!("expected scenes with names of their own, found {}", names.join(", "))));
    }
    Ok(names.into_iter().zip(scenes).map(|(name, scene)| Entry { name, scene }).collect())
}

/// What is not the same if the result is not.
fn options(args: &Args, model: &Reconstructor, checkpoint: String) -> Result<BTreeMap<String, String>, CliError> {
    let own = args.pipeline.options(model, args.samples)?;
    let mut formats: Vec<String> = args.format.iter().map(ToString::to_string).collect();
    formats.sort();
    let mut told = BTreeMap::from([
        ("settings_schema".to_owned(), SETTINGS_SCHEMA.to_string()),
        ("checkpoint".into(), checkpoint),
        ("seeds".into(), format!("{:?}", own.seeds)),
        ("init".into(), format!("{:?}", args.pipeline.init)),
        ("holdout".into(), format!("{:?}", (args.holdout_every, &args.holdout))),
        ("format".into(), formats.join(",")),
    ]);
    told.extend(args.photos.told());
    let value = serde_json::to_value(&own.pipeline).map_err(CliError::failure)?;
    if let serde_json::Value::Object(fields) = value {
        told.extend(fields.into_iter().map(|(name, value)| (format!("pipeline.{name}"), value.to_string())));
    }
    Ok(told)
}

fn same_options(file: &Path, were: &BTreeMap<String, String>, are: &BTreeMap<String, String>) -> Result<(), CliError> {
    let names: BTreeSet<&String> = were.keys().chain(are.keys()).collect();
    let none = "nothing".to_owned();
    match names.into_iter().find(|n| were.get(*n) != are.get(*n)) {
        None => Ok(()),
        Some(name) => {
            let of = |options: &BTreeMap<String, String>| options.get(name).unwrap_or(&none).clone();
            let text = format!(
                "`{name}`: expected {} as this scene was made with, found {}; choose another folder, or make all again with --overwrite",
                of(were),
                of(are)
            );
            Err(CliError::file(file, text))
        }
    }
}

/// The record of a finished scene; none where there is none.
fn recorded(folder: &Path) -> Result<Option<Record>, CliError> {
    let path = folder.join(RECORD);
    let text = match std::fs::read_to_string(&path) {
        Ok(text) => text,
        Err(e) if matches!(e.kind(), std::io::ErrorKind::NotFound | std::io::ErrorKind::NotADirectory) => {
            return Ok(None);
        }
        Err(e) => return Err(CliError::file(&path, e)),
    };
    serde_json::from_str(&text).map(Some).map_err(|e| CliError::file(&path, e))
}

/// Makes a scene, unless that has been done.
fn one(
    args: &Args,
    entry: &Entry,
    record: Option<Record>,
    model: &Reconstructor,
    program: &Program,
    options: &BTreeMap<String, String>,
) -> Result<Row, CliError> {
    let begin = Instant::now();
    let cameras = args.photos.cameras(&entry.scene)?;
    let files = stamps(&args.photos.files(&cameras)?)?;
    if let Some(record) = record {
        if record.scene == entry.scene && record.files == files {
            return Ok(Row { status: Status::Kept, ..record.result });
        }
        eprintln!("{}: files have changed since it was made: it is made again", entry.name);
    }
    let folder = args.output.join(&entry.name);
    let scene = args.photos.load(cameras, KeepWhole::Small)?;
    let (report, _) =
        super::reconstruct(args, &entry.scene, scene, model, program, &folder, begin, || forget(&folder))?;
    let row = row(entry, &report, begin.elapsed().as_secs_f64());
    let record = Record {
        version: env!("CARGO_PKG_VERSION").into(),
        scene: entry.scene.clone(),
        options: options.clone(),
        files,
        result: row.clone(),
    };
    let json = serde_json::to_string_pretty(&record).map_err(CliError::failure)?;
    let path = folder.join(RECORD);
    write_atomically(&path, |file| file.write_all(json.as_bytes())).map_err(|e| CliError::file(&path, e))?;
    Ok(row)
}

/// From here on the folder holds parts of an old and of a new result.
fn forget(folder: &Path) -> Result<(), CliError> {
    let path = folder.join(RECORD);
    match std::fs::remove_file(&path) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(CliError::file(&path, e)),
        _ => Ok(()),
    }
}

/// Before one scene alone replaces what is in `folder`: a record of it would be wrong.
pub fn replace(folder: &Path) -> Result<(), CliError> {
    match recorded(folder) {
        Ok(Some(_)) => forget(folder),
        // Nothing, or a file that is not ours.
        _ => Ok(()),
    }
}

/// Size and last change of files.
fn stamps(files: &[PathBuf]) -> Result<BTreeMap<PathBuf, String>, CliError> {
    let stamp = |file: &PathBuf| {
        let data = std::fs::metadata(file).map_err(|e| CliError::file(file, e))?;
        let changed = data.modified().ok().and_then(|t| t.duration_since(UNIX_EPOCH).ok()).map_or(0, |t| t.as_millis());
        Ok((file.clone(), format!("{} bytes, {changed} ms", data.len())))
    };
    files.iter().map(stamp).collect()
}

fn row(entry: &Entry, report: &SceneReport, seconds: f64) -> Row {
    let first = report.samples.first();
    Row {
        scene: entry.name.clone(),
        status: Status::Done,
        error: None,
        gaussians: report.gaussians,
        input_views: first.and_then(|s| Mean::of(&s.input_views)),
        further_views: first.and_then(|s| Mean::of(&s.further_views)),
        seconds,
    }
}

fn print(rows: &[Row], path: &Path) {
    let wide = rows.iter().map(|r| r.scene.chars().count()).max().unwrap_or(0).max(5);
    println!("{:wide$}  {:6}  {:>14}  {:>20}  {:>7}", "scene", "", "input PSNR", "further PSNR, SSIM", "seconds");
    let input = |m: Option<Mean>| m.map_or("-".into(), |m| format!("{:.2} ({})", m.psnr, m.views));
    let further = |m: Option<Mean>| m.map_or("-".into(), |m| format!("{:.2}, {:.4} ({})", m.psnr, m.ssim, m.views));
    for row in rows {
        let status = match row.status {
            Status::Done => "done",
            Status::Kept => "kept",
            Status::Failed => "failed",
        };
        println!(
            "{:wide$}  {status:6}  {:>14}  {:>20}  {:7.1}",
            row.scene,
            input(row.input_views),
            further(row.further_views),
            row.seconds
        );
    }
    let measured: Vec<Mean> = rows.iter().filter_map(|r| r.further_views).collect();
    if measured.len() > 1 {
        let mean = |f: fn(&Mean) -> f64| measured.iter().map(f).sum::<f64>() / measured.len() as f64;
        let (psnr, ssim) = (mean(|m| m.psnr), mean(|m| m.ssim));
        println!("mean over {} scenes: further views PSNR {psnr:.2} dB, SSIM {ssim:.4}", measured.len());
    }
    println!("{}", path.display());
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(scenes: &[&str]) -> Result<Vec<String>, String> {
        let entries = named(scenes.iter().map(PathBuf::from).collect()).map_err(|e| e.to_string())?;
        Ok(entries.into_iter().map(|e| e.name).collect())
    }

    #[test]
    fn scenes_are_called_by_their_folders() {
        assert_eq!(names(&["/a/mug", "/a/bowl/"]).unwrap(), ["mug", "bowl"]);
        assert_eq!(names(&["/a/mug", "/b/mug", "/c/bowl"]).unwrap(), ["a-mug", "b-mug", "bowl"]);
        assert_eq!(names(&["/mug", "/b/mug"]).unwrap(), ["mug", "b-mug"]);
        assert!(names(&["/a/mug", "/a/mug"]).unwrap_err().contains("twice"));
        assert!(names(&["/x/a/b", "/y/a/b", "/z/a-b"]).is_ok());
        // As many as an array of jobs may have, each known by its grandparent: no pairs are compared.
        let many: Vec<String> = (0..20_000).map(|i| format!("/scans/{i}/photos/mug")).collect();
        let many: Vec<&str> = many.iter().map(String::as_str).collect();
        assert_eq!(names(&many).unwrap()[19_999], "19999-photos-mug");
    }

    #[test]
    fn other_options_are_named() {
        let options =
            |refine: &str| BTreeMap::from([("a".to_owned(), "1".to_owned()), ("refine".into(), refine.into())]);
        assert!(same_options(Path::new("x/scene.json"), &options("500"), &options("500")).is_ok());
        let text = same_options(Path::new("x/scene.json"), &options("500"), &options("0")).unwrap_err().to_string();
        assert!(["x/scene.json", "`refine`", "expected 500", "found 0"].iter().all(|w| text.contains(w)), "{text}");
    }
}
