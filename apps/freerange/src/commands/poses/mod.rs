//! `freerange poses`

mod bounds;
mod colmap;
mod engine;
mod job;
mod judge;
mod moving;
mod search;
mod taken;

use std::path::{Path, PathBuf};

use freerange_scene::read::photos_in;
use serde::Serialize;

pub use self::{
    bounds::Bounds,
    engine::Engine,
    search::{ADVICE, STEPS, Search, Told},
};
use self::{
    job::{Done, last_words},
    judge::Judgement,
    search::Found,
};
use crate::{error::CliError, output::OutputFolder, progress::Progress};

/// The file in the output folder with what the engine says.
const LOG: &str = "poses.log";

/// Find the cameras of photos that have none with COLMAP or pycolmap, and check them.
///
/// The photos go once around the object, in the order of their EXIF times, else of their names. Writes a scene for `reconstruct`: images/, sparse/0, poses.json
/// (poses and checks) and poses.log (output of COLMAP). Poses that look wrong are refused with exit code 2; poses.json and poses.log are
/// still written.
#[derive(clap::Args)]
pub struct Args {
    /// Folder of photos.
    photos: PathBuf,
    /// Output folder of the scene.
    #[arg(short, long)]
    output: PathBuf,
    /// Python with pycolmap [default: COLMAP on the PATH, else python3].
    #[arg(long, value_name = "PROGRAM")]
    python: Option<PathBuf>,
    /// The photos are not at even steps: warn of uneven steps instead of refusing them.
    #[arg(long)]
    uneven: bool,
    /// Folder of masks (NAME.jpg.png or NAME.png, the object in white), for objects on a turntable. Those of all photos become part of the
    /// scene.
    #[arg(long, value_name = "FOLDER")]
    masks: Option<PathBuf>,
    /// Seed of the engine's random numbers.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Print the report as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Report<'a> {
    photos: &'a [String],
    engine: &'a Done,
    judgement: &'a Judgement,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), CliError> {
    let files = photos_in(&args.photos)?;
    let engine = Engine::find(args.python.as_deref())?;
    eprintln!("{} photos, {}", files.len(), engine.name());
    let output = OutputFolder::create("poses", &args.output)?;
    let log = output.path(LOG)?;
    let search = Search {
        engine: &engine,
        scene: log.parent().unwrap_or(&log),
        work: None,
        masks: args.masks.as_deref(),
        uneven: args.uneven,
        seed: args.seed,
        bounds: Bounds::default(),
    };
    let mut bar: Option<Progress> = None;
    let found = search.run(&files, &mut |told| match told {
        Told::Step(what, pairs, done) if done < STEPS => {
            bar.get_or_insert_with(|| Progress::new("poses", STEPS)).at(done, &format!("{what} {pairs}"));
        }
        told => {
            bar.take().into_iter().for_each(Progress::finish);
            if let Told::Note(text) = told {
                eprintln!("note: {text}");
            }
        }
    });
    let found = found.map_err(|error| with_log(error, &log, &args.output))?;
    finish(args, &found, output)
}

/// An error, and what the engine said until then, which is kept in the output folder.
fn with_log(error: CliError, log: &Path, folder: &Path) -> CliError {
    let kept = folder.join(LOG);
    let keep = || std::fs::create_dir_all(folder).and_then(|()| std::fs::copy(log, &kept));
    if last_words(log).is_empty() || keep().is_err() {
        return error;
    }
    let text = format!("{error}; the whole log is {}", kept.display());
    match error.exit_code() {
        2 => CliError::input(text),
        _ => CliError::failure(text),
    }
}

/// Writes what was found, and says it.
fn finish(args: &Args, found: &Found, mut output: OutputFolder) -> Result<(), CliError> {
    let Found { names, done, judgement } = found;
    let json =
        serde_json::to_string_pretty(&Report { photos: names, engine: done, judgement }).map_err(CliError::failure)?;
    if !judgement.refused.is_empty() {
        // What is refused is no scene.
        let log = std::fs::read(output.path(LOG)?).unwrap_or_default();
        output = OutputFolder::create("poses", &args.output)?;
        output.write(LOG, &log)?;
    }
    output.write("poses.json", json.as_bytes())?;
    output.commit()?;
    if args.json {
        println!("{json}");
    }
    judgement.warnings.iter().for_each(|warning| eprintln!("warning: {warning}"));
    if !judgement.refused.is_empty() {
        let reasons = judgement.refused.join("; ");
        let at = args.photos.display();
        return Err(CliError::input(format!("{at}: no cameras that can be relied on: {reasons}; {ADVICE}")));
    }
    if !args.json {
        let placed = names.len() - judgement.left_out.len();
        println!("{}: {placed} of {} photos have cameras ({})", args.output.display(), names.len(), done.engine);
    }
    Ok(())
}
