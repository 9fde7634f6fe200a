//! From photos without cameras to a scene, or to the reasons why there is none. `freerange poses` and the page share it.

use std::path::{Path, PathBuf};

use freerange_scene::{
    mask_file,
    read::{Format, cameras, in_order},
};

use super::{
    LOG,
    bounds::Bounds,
    engine::Engine,
    job::{Done, Job, begin},
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

/// Contrast that features need. On a table weak ones place photos that would be left out; on turntables they make poses
/// worse. The other value is COLMAP's own.
const WEAK: f64 = 0.002;
const CLEAR: f64 = 0.0066;

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
    /// Counted from 1.
    attempt: usize,
    /// Photos on either side that are compared, as a share of all.
    neighbors: f64,
    /// Whether masks hide what is beside the object from the engine.
    masked: bool,
}

impl Way {
    /// What is tried with `photos`, as the log says it.
    fn words(&self, given: bool, photos: usize) -> String {
        let masks = match (given, self.masked) {
            (true, true) => "features inside the masks",
            (true, false) => "features beside the masks, too",
            (false, _) => "no masks",
        };
        format!("pairs up to {} photos apart, {masks}", reach(photos, self.neighbors))
    }
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
        let mut way = Way { attempt: 1, neighbors: NEIGHBORS, masked: self.masks.is_some() };
        let (mut done, mut judgement) = self.attempt(&photos, &names, &way, tell)?;
        if way.masked && !judgement.refused.is_empty() {
            // The turntable or table has features, too.
            let why = judgement.refused.join("; ");
            tell(Told::Note(format!("{why}; trying again with features beside the masks")));
            (way.attempt, way.masked) = (way.attempt + 1, false);
            (done, judgement) = self.attempt(&photos, &names, &way, tell)?;
        }
        if judgement.in_doubt {
            // Photos that look alike are farther apart than those that follow one another: fewer pairs mix up fewer.
            let why = judgement.refused.join("; ");
            tell(Told::Note(format!("{why}; trying again with fewer neighbors")));
            (way.attempt, way.neighbors) = (way.attempt + 1, 0.5 * way.neighbors);
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
        // The photos are of a turntable, or may be.
        let peak_threshold = if self.masks.is_some() || hidden.is_some() { CLEAR } else { WEAK };
        let job = Job { masks: hidden, peak_threshold, ..self.job(work.path(), photos, names, way.neighbors)? };
        let log = self.path(LOG)?;
        begin(&log, way.attempt, &way.words(self.masks.is_some(), names.len()))?;
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
            peak_threshold: WEAK,
            masks: None,
            threads: self.bounds.threads(),
            seed: self.seed,
        })
    }
}

/// Masks, read as `reconstruct` reads them, as COLMAP reads them without surprises: gray, black or white, of the photo's
/// own size, one for each photo; white where there is none. Their folder, and for how many photos there was one.
/// (It leaves photos without a mask out, and lays masks of another size on pixel for pixel.)
fn masks_again(from: &Path, photos: &[Taken], to: &Path) -> Result<(PathBuf, usize), CliError> {
    std::fs::create_dir_all(to).map_err(|e| CliError::file(to, e))?;
    let mut found = 0;
    for photo in photos {
        let (size, photo) = (photo.size, &photo.path);
        let stem = photo.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let whole = photo.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let names = [(&whole, ""), (&stem, ""), (&whole, ".mask"), (&stem, ".mask"), (&stem, "_mask")];
        let mut paths = names.iter().map(|(name, end)| from.join(format!("{name}{end}.png")));
        let mask = match paths.find(|path| path.is_file() && path != photo) {
            None => image::GrayImage::from_pixel(size.0, size.1, image::Luma([255])),
            Some(path) => {
                found += 1;
                let mut mask = mask_file(&path, size)?;
                mask.pixels_mut().for_each(|p| p[0] = if p[0] >= 128 { 255 } else { 0 });
                if mask.pixels().all(|p| p[0] == 0) {
                    let what = "expected a mask that shows the object, found one that is empty";
                    return Err(CliError::file(&path, what));
                }
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

/// How far apart, in the order in which they were taken, photos of a pair are.
fn reach(photos: usize, share: f64) -> usize {
    ((photos as f64 * share).round() as usize).max(2).min((photos - 1) / 2 + 1)
}

/// Pairs of photos that are near to one another on one turn around, a line each.
fn ring(names: &[String], share: f64) -> String {
    let reach = reach(names.len(), share);
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
        // Two values of labels, the photo cut out, white with alpha, and one of twice the size.
        let pixel: [fn(bool) -> [u8; 4]; 4] = [
            |there| [u8::from(there), u8::from(there), u8::from(there), 255],
            |there| if there { [7, 7, 7, 255] } else { [0, 0, 0, 255] },
            |there| [40, 50, 60, if there { 255 } else { 0 }],
            |there| [255, 255, 255, if there { 255 } else { 0 }],
        ];
        for (kind, pixel) in pixel.into_iter().enumerate() {
            for size in [1, 2] {
                let mask = image::RgbaImage::from_fn(8 * size, 6 * size, |x, _| image::Rgba(pixel(x >= 4 * size)));
                mask.save(at("given/c.png")).unwrap();
                let (out, _) = masks_again(&at("given"), &photos, &at("kinds")).unwrap();
                let mask = image::open(out.join("c.png.png")).unwrap().into_luma8();
                assert_eq!(mask.dimensions(), (8, 6));
                assert!(mask.enumerate_pixels().all(|(x, _, p)| p[0] == if x < 4 { 0 } else { 255 }), "{kind}");
            }
        }
        image::GrayImage::new(4, 6).save(at("given/c.png")).unwrap();
        let error = masks_again(&at("given"), &photos, &at("bad")).unwrap_err().to_string();
        assert!(error.contains("c.png") && error.contains("4 x 6"), "{error}");
        image::GrayImage::new(8, 6).save(at("given/c.png")).unwrap();
        let error = masks_again(&at("given"), &photos, &at("bad")).unwrap_err().to_string();
        assert!(error.contains("c.png") && error.contains("found one that is empty"), "{error}");
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
