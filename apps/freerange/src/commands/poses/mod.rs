//! `freerange poses`

mod colmap;
mod engine;
mod job;
mod judge;
mod taken;

use std::path::{Path, PathBuf};

use freerange_scene::read::{Format, cameras, in_order, photos_in};
use serde::Serialize;

use crate::{error::CliError, output::OutputFolder};
use engine::Engine;
use job::{Done, Job};
use judge::Judgement;
use taken::{Taken, taken};

/// How to photograph, for those whose photos could not be placed.
const ADVICE: &str = "take 16 photos or more, 20 to 25 degrees apart, one way around the object, with a patterned cloth or newspaper below it";
/// Photos below which features have to hold under larger turns.
const MANY: usize = 16;
/// Photos on either side that are compared first, as a share of all: those within 60 degrees of one turn.
const NEIGHBORS: f64 = 1.0 / 6.0;

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
    let (photos, timed) = taken(&files)?;
    let names: Vec<String> = photos.iter().map(|p| plain_name(&p.path)).collect();
    if names.len() < 4 {
        return Err(CliError::input(format!(
            "{}: expected at least 4 photos, found {}; {ADVICE}",
            args.photos.display(),
            names.len()
        )));
    }
    let engine = Engine::find(args.python.as_deref())?;
    eprintln!("{} photos, {}", names.len(), engine.name());
    if timed && !in_order(&files).iter().eq(photos.iter().map(|p| &p.path)) {
        eprintln!("note: the photos are in the order of their EXIF times, not of their names");
    }
    let output = OutputFolder::create("poses", &args.output)?;
    for photo in photos.iter().map(|photo| &photo.path) {
        let to = output.path(&format!("images/{}", plain_name(photo)))?;
        if to.exists() {
            return Err(CliError::file(photo, "expected a name that differs from the others by more than spaces"));
        }
        std::fs::copy(photo, to).map_err(|e| CliError::file(photo, e))?;
    }
    let mut way = Way { neighbors: NEIGHBORS, masked: args.masks.is_some() };
    let (mut done, mut judgement) = attempt(args, &engine, &output, &photos, &names, &way)?;
    if way.masked && !judgement.refused.is_empty() {
        // The turntable itself has features, too. Those of a background that stands still are filtered.
        eprintln!("note: {}; trying again with features beside the masks", judgement.refused.join("; "));
        way.masked = false;
        (done, judgement) = attempt(args, &engine, &output, &photos, &names, &way)?;
    }
    if judgement.in_doubt {
        // Photos that look alike are farther apart than those that follow one another: fewer pairs mix up fewer.
        eprintln!("note: {}; trying again with fewer neighbors", judgement.refused.join("; "));
        way.neighbors *= 0.5;
        (done, judgement) = attempt(args, &engine, &output, &photos, &names, &way)?;
    }
    if names.len() < MANY {
        judgement.warnings.push(format!("{} photos are few: {MANY} or more are placed more surely", names.len()));
    }
    finish(args, &names, &done, &judgement, output)
}

/// What differs between attempts.
struct Way {
    /// Photos on either side that are compared, as a share of all.
    neighbors: f64,
    /// Whether masks hide what is beside the object from the engine.
    masked: bool,
}

/// Runs the engine on photos and the neighbors of each, and judges what it finds.
fn attempt(
    args: &Args,
    engine: &Engine,
    output: &OutputFolder,
    photos: &[Taken],
    names: &[String],
    way: &Way,
) -> Result<(Done, Judgement), CliError> {
    let work = tempfile::tempdir().map_err(CliError::failure)?;
    let masks = args.masks.as_deref().map(|from| masks_again(from, photos, &work.path().join("masks"))).transpose()?;
    let job = Job {
        masks: masks.as_ref().filter(|_| way.masked).map(|(folder, _)| folder.clone()),
        ..job(work.path(), &output.path("images")?, photos, names, way.neighbors, args)?
    };
    let done = engine.run(&job, &output.path("poses.log")?)?;
    let mut judgement = Judgement::of_engine(names, &done);
    if judgement.refused.is_empty() {
        for name in ["cameras.bin", "images.bin", "points3D.bin"] {
            let from = work.path().join("model").join(name);
            std::fs::copy(&from, output.path(&format!("sparse/0/{name}"))?).map_err(|e| CliError::file(&from, e))?;
        }
        match &masks {
            Some((folder, found)) if *found == photos.len() => {
                for name in names {
                    let from = folder.join(format!("{name}.png"));
                    let to = output.path(&format!("masks/{name}.png"))?;
                    std::fs::copy(&from, to).map_err(|e| CliError::file(&from, e))?;
                }
            }
            Some((_, found)) => judgement.warnings.push(format!(
                "{found} of {} photos have a mask: masks are used for poses only, not written to the scene",
                photos.len()
            )),
            None => {}
        }
        let found = cameras(&output.path("sparse/0/cameras.bin")?, Some(Format::Colmap), None)?;
        judgement.look(&found, names, args.uneven)?;
        judgement.compare_lenses(&found, photos.iter().map(|p| (plain_name(&p.path), p.focal())));
        if judgement.refused.is_empty() {
            judgement.look_at_photos(&found)?;
        }
    }
    Ok((done, judgement))
}

/// Writes what was found, and says it.
fn finish(
    args: &Args,
    names: &[String],
    done: &Done,
    judgement: &Judgement,
    mut output: OutputFolder,
) -> Result<(), CliError> {
    let json =
        serde_json::to_string_pretty(&Report { photos: names, engine: done, judgement }).map_err(CliError::failure)?;
    if !judgement.refused.is_empty() {
        // What is refused is no scene.
        let log = std::fs::read(output.path("poses.log")?).unwrap_or_default();
        output = OutputFolder::create("poses", &args.output)?;
        output.write("poses.log", &log)?;
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

/// A photo's name without spaces, at which COLMAP's lists end names.
fn plain_name(photo: &Path) -> String {
    photo.file_name().unwrap_or_default().to_string_lossy().replace(char::is_whitespace, "_")
}

fn job(
    work: &Path,
    images: &Path,
    photos: &[Taken],
    names: &[String],
    neighbors: f64,
    args: &Args,
) -> Result<Job, CliError> {
    let groups = taken::cameras(photos);
    let names_of = |group: Vec<&Taken>| group.iter().map(|p| plain_name(&p.path)).collect();
    let pairs = work.join("pairs.txt");
    std::fs::write(&pairs, ring(names, neighbors)).map_err(|e| CliError::file(&pairs, e))?;
    let absolute = |p: &Path| std::fs::canonicalize(p).map_err(|e| CliError::file(p, e));
    Ok(Job {
        work: work.into(),
        images: absolute(images)?,
        names: names.to_vec(),
        groups: groups.into_iter().map(names_of).collect(),
        pairs,
        thorough: names.len() < MANY || neighbors < NEIGHBORS,
        all_pairs: neighbors >= NEIGHBORS,
        peak_threshold: if args.masks.is_some() { 0.0066 } else { 0.002 },
        masks: None,
        seed: args.seed,
    })
}

/// Masks as COLMAP reads them without surprises: gray, black or white, of the photo's own size, one for each photo; white where there is none.
/// Their folder, and for how many photos there was one.
/// (It leaves photos without a mask out, and lays masks of another size on pixel for pixel.)
fn masks_again(from: &Path, photos: &[Taken], to: &Path) -> Result<(PathBuf, usize), CliError> {
    std::fs::create_dir_all(to).map_err(|e| CliError::file(to, e))?;
    let mut found = 0;
    for photo in photos {
        let (size, photo) = (photo.size, &photo.path);
        let stem = photo.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let whole = photo.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let names = [format!("{whole}.png"), format!("{stem}.png"), format!("{whole}.mask.png")];
        let mask = match names.iter().map(|name| from.join(name)).find(|path| path.is_file()) {
            None => image::GrayImage::from_pixel(size.0, size.1, image::Luma([255])),
            Some(path) => {
                found += 1;
                let mut mask = image::open(&path).map_err(|e| CliError::file(&path, e))?.into_luma8();
                if mask.dimensions() != size {
                    let ((w, h), (mw, mh)) = (size, mask.dimensions());
                    let what = format!("expected {w} x {h} pixels, as its photo has, found {mw} x {mh}");
                    return Err(CliError::file(&path, what));
                }
                mask.pixels_mut().for_each(|p| p[0] = if p[0] >= 128 { 255 } else { 0 });
                mask
            }
        };
        let path = to.join(format!("{}.png", plain_name(photo)));
        mask.save(&path).map_err(|e| CliError::file(&path, e))?;
    }
    match found {
        0 => Err(CliError::file(from, "expected masks with the photos' names (NAME.jpg.png or NAME.png), found none")),
        _ => Ok((to.into(), found)),
    }
}

/// Pairs of photos that are near to one another on one turn around, a line each.
fn ring(names: &[String], share: f64) -> String {
    let reach = ((names.len() as f64 * share).round() as usize).max(2).min((names.len() - 1) / 2 + 1);
    let mut lines = std::collections::BTreeSet::new();
    for i in 0..names.len() {
        for k in 1..=reach {
            let j = (i + k) % names.len();
            if i != j {
                lines.insert((i.min(j), i.max(j)));
            }
        }
    }
    lines.into_iter().map(|(i, j)| format!("{} {}\n", names[i], names[j])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_are_written_for_every_photo() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::create_dir(at("given")).unwrap();
        let photos: Vec<PathBuf> = ["a b.png", "c.png"].map(at).to_vec();
        photos.iter().for_each(|p| image::RgbImage::new(8, 6).save(p).unwrap());
        let photos = taken(&photos).unwrap().0;
        assert!(masks_again(&at("given"), &photos, &at("none")).unwrap_err().to_string().contains("found none"));
        let label = image::GrayImage::from_fn(8, 6, |x, _| image::Luma([if x < 4 { 20 } else { 200 }]));
        label.save(at("given/a b.png")).unwrap();
        let (out, found) = masks_again(&at("given"), &photos, &at("out")).unwrap();
        assert_eq!(found, 1);
        let read = |name: &str| image::open(out.join(name)).unwrap().into_luma8();
        assert_eq!((read("a_b.png.png")[(0, 0)][0], read("a_b.png.png")[(7, 5)][0]), (0, 255));
        assert!(read("c.png.png").pixels().all(|p| p[0] == 255));
        image::GrayImage::new(4, 6).save(at("given/c.png")).unwrap();
        let error = masks_again(&at("given"), &photos, &at("bad")).unwrap_err().to_string();
        assert!(error.contains("c.png") && error.contains("4 x 6"), "{error}");
    }

    #[test]
    fn names_have_no_spaces() {
        assert_eq!(plain_name(Path::new("a/IMG (1) x.jpg")), "IMG_(1)_x.jpg");
    }

    #[test]
    fn neighbors_on_a_ring_are_paired_once() {
        let names: Vec<String> = (0..24).map(|i| i.to_string()).collect();
        let pairs = ring(&names, NEIGHBORS);
        assert_eq!(pairs.lines().count(), 24 * 4);
        assert!(pairs.contains("0 23\n") && pairs.contains("1 5\n") && !pairs.contains("0 5\n"));
        let few: Vec<String> = (0..4).map(|i| i.to_string()).collect();
        assert_eq!(ring(&few, NEIGHBORS).lines().count(), 6);
    }
}
