//! From photos without cameras to a scene, or to the reasons why there is none. `freerange poses` and the page share it.

use std::path::{Path, PathBuf};

use freerange_scene::read::{Format, cameras, in_order};

use super::{
    bounds::Bounds,
    engine::Engine,
    job::{Done, Job},
    judge::Judgement,
    moving::moving,
    taken::{self, Taken, plain_name, taken},
};
use crate::error::CliError;

/// How to photograph, for those whose photos could not be placed.
pub const ADVICE: &str = "take 16 photos or more, 20 to 25 degrees apart, one way around the object, with a patterned cloth or newspaper below it";
/// Photos below which features have to hold under larger turns.
const MANY: usize = 16;
/// Photos on either side that are compared first, as a share of all: those within 60 degrees of one turn.
const NEIGHBORS: f64 = 1.0 / 6.0;

/// How cameras are looked for.
pub struct Search<'a> {
    /// What finds them.
    pub engine: &'a Engine,
    /// Where the scene goes: images, sparse/0, perhaps masks, and the engine's log.
    pub scene: &'a Path,
    /// Where the engine may work; none: in the system's temporary folder.
    pub work: Option<&'a Path>,
    /// A folder of masks.
    pub masks: Option<&'a Path>,
    /// The photos are not at even steps of one turn.
    pub uneven: bool,
    /// Seed of the engine's random numbers.
    pub seed: u64,
    /// When to end early.
    pub bounds: Bounds,
}

/// What is told while cameras are looked for.
pub enum Told<'a> {
    /// A step of the engine begins: one word, which pairs, how many steps are done.
    Step(&'static str, &'a str, u64),
    /// What the user may want to know.
    Note(String),
}

/// Steps of the engine: features, matches and a model of neighbors, then of all pairs if it comes to that.
pub const STEPS: u64 = 5;

/// What was found.
pub struct Found {
    /// Names of the photos in the scene, in the order in which they were taken.
    pub names: Vec<String>,
    /// What the engine did.
    pub done: Done,
    /// Whether the cameras can be right.
    pub judgement: Judgement,
}

/// What differs between attempts.
struct Way {
    /// Photos on either side that are compared, as a share of all.
    neighbors: f64,
    /// Whether masks hide what is beside the object from the engine.
    masked: bool,
}

impl Search<'_> {
    /// Refuses photos that are too few or have odd names, and finds cameras of others.
    pub fn run(&self, files: &[PathBuf], tell: &mut dyn FnMut(Told<'_>)) -> Result<Found, CliError> {
        let (photos, timed) = taken(files)?;
        let names: Vec<String> = photos.iter().map(|p| plain_name(&p.path)).collect();
        if names.len() < 4 {
            let folder = files.first().and_then(|file| file.parent()).unwrap_or(Path::new(""));
            let what = format!("expected at least 4 photos, found {}; {ADVICE}", names.len());
            return Err(CliError::file(folder, what));
        }
        if timed && !in_order(files).iter().eq(photos.iter().map(|p| &p.path)) {
            tell(Told::Note("the photos are in the order of their EXIF times, not of their names".into()));
        }
        for photo in photos.iter().map(|photo| &photo.path) {
            let to = self.path(&format!("images/{}", plain_name(photo)))?;
            if to.exists() {
                let what = "expected a name that differs from the others by more than spaces";
                return Err(CliError::file(photo, what));
            }
            std::fs::copy(photo, to).map_err(|e| CliError::file(photo, e))?;
        }
        let mut way = Way { neighbors: NEIGHBORS, masked: self.masks.is_some() };
        let (mut done, mut judgement) = self.attempt(&photos, &names, &way, tell)?;
        if way.masked && !judgement.refused.is_empty() {
            // The turntable or table has features, too.
            let why = judgement.refused.join("; ");
            tell(Told::Note(format!("{why}; trying again with features beside the masks")));
            way.masked = false;
            (done, judgement) = self.attempt(&photos, &names, &way, tell)?;
        }
        if judgement.in_doubt {
            // Photos that look alike are farther apart than those that follow one another: fewer pairs mix up fewer.
            let why = judgement.refused.join("; ");
            tell(Told::Note(format!("{why}; trying again with fewer neighbors")));
            way.neighbors *= 0.5;
            (done, judgement) = self.attempt(&photos, &names, &way, tell)?;
        }
        if names.len() < MANY {
            judgement.warnings.push(format!("{} photos are few: {MANY} or more are placed more surely", names.len()));
        }
        Ok(Found { names, done, judgement })
    }

    /// Where the file `name` of the scene goes. Folders in `name` are made.
    fn path(&self, name: &str) -> Result<PathBuf, CliError> {
        let path = self.scene.join(name);
        let folder = path.parent().unwrap_or(self.scene);
        std::fs::create_dir_all(folder).map_err(|e| CliError::file(folder, e))?;
        Ok(path)
    }

    /// Runs the engine on photos and the neighbors of each, and judges what it finds.
    fn attempt(
        &self,
        photos: &[Taken],
        names: &[String],
        way: &Way,
        tell: &mut dyn FnMut(Told<'_>),
    ) -> Result<(Done, Judgement), CliError> {
        let work = match self.work {
            Some(folder) => tempfile::tempdir_in(folder),
            None => tempfile::tempdir(),
        };
        let work = work.map_err(CliError::failure)?;
        let masks = self.masks.map(|from| masks_again(from, photos, &work.path().join("masks"))).transpose()?;
        let hidden = match masks.as_ref().filter(|_| way.masked) {
            Some((folder, _)) => Some(folder.clone()),
            None => moving(photos, &work.path().join("moving"))?,
        };
        let job = Job { masks: hidden, ..self.job(work.path(), photos, names, way.neighbors)? };
        let log = self.path("poses.log")?;
        let done = self.engine.run(&job, &log, &self.bounds, &mut |what, pairs, done| {
            tell(Told::Step(what, pairs, done));
        })?;
        let mut judgement = Judgement::of_engine(names, &done);
        if judgement.refused.is_empty() {
            tell(Told::Step("checks", "", STEPS));
            for name in ["cameras.bin", "images.bin", "points3D.bin"] {
                let from = work.path().join("model").join(name);
                std::fs::copy(&from, self.path(&format!("sparse/0/{name}"))?).map_err(|e| CliError::file(&from, e))?;
            }
            match &masks {
                Some((folder, found)) if *found == photos.len() => {
                    for name in names {
                        let from = folder.join(format!("{name}.png"));
                        let to = self.path(&format!("masks/{name}.png"))?;
                        std::fs::copy(&from, to).map_err(|e| CliError::file(&from, e))?;
                    }
                }
                Some((_, found)) => judgement.warnings.push(format!(
                    "{found} of {} photos have a mask: masks are used for poses only, not written to the scene",
                    photos.len()
                )),
                None => {}
            }
            let found = cameras(&self.path("sparse/0/cameras.bin")?, Some(Format::Colmap), None)?;
            judgement.look(&found, names, self.uneven)?;
            judgement.compare_lenses(&found, photos.iter().map(|p| (plain_name(&p.path), p.focal())));
            if judgement.refused.is_empty() {
                judgement.look_at_photos(&found, &self.bounds)?;
            }
        }
        Ok((done, judgement))
    }

    fn job(&self, work: &Path, photos: &[Taken], names: &[String], neighbors: f64) -> Result<Job, CliError> {
        let groups = taken::cameras(photos);
        let names_of = |group: Vec<&Taken>| group.iter().map(|p| plain_name(&p.path)).collect();
        let pairs = work.join("pairs.txt");
        std::fs::write(&pairs, ring(names, neighbors)).map_err(|e| CliError::file(&pairs, e))?;
        let absolute = |p: &Path| std::fs::canonicalize(p).map_err(|e| CliError::file(p, e));
        Ok(Job {
            work: work.into(),
            images: absolute(&self.path("images")?)?,
            names: names.to_vec(),
            groups: groups.into_iter().map(names_of).collect(),
            pairs,
            thorough: names.len() < MANY || neighbors < NEIGHBORS,
            all_pairs: neighbors >= NEIGHBORS,
            peak_threshold: if self.masks.is_some() { 0.0066 } else { 0.002 },
            masks: None,
            threads: self.bounds.threads(),
            seed: self.seed,
        })
    }
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
