//! A folder of results that a killed run leaves whole and a later one goes on with.
//!
//! `settings.json`, one `objects/CASE.json` per case (with `CASE.jpg`, the picture strip, `CASE.f32` and `CASE.vgg.f32`, the
//! features for FID and for the Frechet distance on VGG16), and the reports.

use std::{
    fs,
    io::Write,
    path::{Path, PathBuf},
    thread,
    time::Duration,
};

use freerange_util::{IoError, write_atomically};
use serde_json::Value;

use crate::{
    EvalError,
    record::{Case, Outcome, Record},
};

const SETTINGS: &str = "settings.json";
const OBJECTS: &str = "objects";
/// The largest JSON file that is read.
pub(crate) const LARGEST: u64 = 1 << 30;

/// The folder of one run.
#[derive(Clone, Debug)]
pub struct RunFolder {
    path: PathBuf,
}

/// What networks see in the renders and true images of a case, for distances between sets of images.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Features {
    /// Inception's, for FID: of all renders of the first sample, then of all true images.
    pub inception: Vec<f32>,
    /// VGG16's: of all renders of the first sample, of all true images, and of several samples' mean renders.
    pub vgg: Vec<f32>,
}

/// Ending of the files of VGG16's features.
const VGG: &str = "vgg.f32";

impl RunFolder {
    /// Opens or makes the folder for a run with `settings`. `restart` throws the results of an earlier run away.
    ///
    /// # Errors
    /// [`EvalError::Settings`] where it holds results of other settings; [`EvalError::File`] where it holds something
    /// else; [`EvalError::Io`].
    pub fn open(path: &Path, settings: &Value, restart: bool) -> Result<Self, EvalError> {
        let folder = Self { path: path.into() };
        let file = path.join(SETTINGS);
        fs::create_dir_all(path).map_err(IoError::at(path))?;
        // Shares that start together see each other's first files: what belongs to one soon has settings beside it.
        let mut waits = 20;
        while !file.is_file()
            && let Some(entry) = fs::read_dir(path).map_err(IoError::at(path))?.next()
        {
            if waits == 0 {
                let found = format!("{:?} and no {SETTINGS}", entry.map_err(IoError::at(path))?.file_name());
                return Err(EvalError::file(path, "an empty folder or that of an earlier run", found));
            }
            waits -= 1;
            thread::sleep(Duration::from_millis(50));
        }
        if file.is_file() && restart {
            folder.clear()?;
        } else if file.is_file() {
            let earlier: Value = read_json(&file)?;
            let differences = differences(&earlier, settings);
            if !differences.is_empty() {
                return Err(EvalError::Settings { path: path.into(), differences });
            }
        }
        folder.write_json(SETTINGS, settings)?;
        let objects = path.join(OBJECTS);
        fs::create_dir_all(&objects).map_err(IoError::at(&objects))?;
        Ok(folder)
    }

    /// The folder of a run that is over, to read from.
    pub fn existing(path: &Path) -> Self {
        Self { path: path.into() }
    }

    /// Removes what runs write, and nothing else.
    fn clear(&self) -> Result<(), EvalError> {
        for name in [SETTINGS, "report.json", "report.md", "report.html"] {
            let file = self.path.join(name);
            match fs::remove_file(&file) {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(IoError::at(&file)(e).into()),
                _ => {}
            }
        }
        let objects = self.path.join(OBJECTS);
        if objects.is_dir() {
            fs::remove_dir_all(&objects).map_err(IoError::at(&objects))?;
        }
        Ok(())
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Path of a case's file, relative to the folder, with `/`.
    pub fn relative(case: &Case, ending: &str) -> String {
        format!("{OBJECTS}/{}.{ending}", case.file_stem())
    }

    fn file(&self, case: &Case, ending: &str) -> PathBuf {
        self.path.join(OBJECTS).join(format!("{}.{ending}", case.file_stem()))
    }

    /// What is known of a case; `None` if it was not worked on.
    ///
    /// # Errors
    /// [`EvalError::Io`]; [`EvalError::File`] where the file is no record of this case.
    pub fn record(&self, case: &Case) -> Result<Option<Record>, EvalError> {
        let file = self.file(case, "json");
        if !file.exists() {
            return Ok(None);
        }
        let record: Record = read_json(&file)?;
        if record.case != *case {
            return Err(EvalError::file(&file, format!("a record of {case}"), &record.case));
        }
        Ok(Some(record))
    }

    /// Whether a case has its numbers. Failures and what was skipped are tried again: the user may have mended them.
    ///
    /// # Errors
    /// As [`record`](Self::record).
    pub fn is_done(&self, case: &Case) -> Result<bool, EvalError> {
        Ok(self.record(case)?.is_some_and(|r| matches!(r.outcome, Outcome::Measured(_))))
    }

    /// Writes what came of a case: `features` and the `picture` first, so that a record stands for all of them.
    ///
    /// # Errors
    /// [`EvalError::Io`].
    pub fn write(&self, record: &Record, features: &Features, picture: Option<&[u8]>) -> Result<(), EvalError> {
        let mut files: Vec<(&str, Vec<u8>)> = Vec::new();
        for (ending, values) in [("f32", &features.inception), (VGG, &features.vgg)] {
            if !values.is_empty() {
                files.push((ending, values.iter().flat_map(|v| v.to_le_bytes()).collect()));
            }
        }
        if let Some(picture) = picture {
            files.push(("jpg", picture.to_vec()));
        }
        files.push(("json", to_json(record)));
        for (ending, bytes) in files {
            write(&self.file(&record.case, ending), &bytes)?;
        }
        Ok(())
    }

    /// The `count` features for FID that were written with a case.
    ///
    /// # Errors
    /// [`EvalError::Io`]; [`EvalError::File`] where there is another number of them.
    pub fn features(&self, case: &Case, count: usize) -> Result<Vec<f32>, EvalError> {
        self.numbers(case, "f32", count)
    }

    /// The `count` features of VGG16 that were written with a case.
    ///
    /// # Errors
    /// As [`features`](Self::features).
    pub fn vgg_features(&self, case: &Case, count: usize) -> Result<Vec<f32>, EvalError> {
        self.numbers(case, VGG, count)
    }

    /// Writes features of VGG16 without the case.
    ///
    /// # Errors
    /// [`EvalError::Io`].
    pub fn write_vgg_features(&self, case: &Case, values: &[f32]) -> Result<(), EvalError> {
        let objects = self.path.join(OBJECTS);
        fs::create_dir_all(&objects).map_err(IoError::at(&objects))?;
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        write(&self.file(case, VGG), &bytes)
    }

    /// Whether features of VGG16 were written with a case.
    pub fn has_vgg_features(&self, case: &Case) -> bool {
        self.file(case, VGG).is_file()
    }

    fn numbers(&self, case: &Case, ending: &str, count: usize) -> Result<Vec<f32>, EvalError> {
        let file = self.file(case, ending);
        let bytes = fs::read(&file).map_err(IoError::at(&file))?;
        if bytes.len() != count.saturating_mul(4) {
            return Err(EvalError::file(&file, format!("{count} features"), format!("{} bytes", bytes.len())));
        }
        Ok(bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect())
    }

    /// The picture strip of a case, if there is one.
    ///
    /// # Errors
    /// [`EvalError::Io`].
    pub fn picture(&self, case: &Case) -> Result<Option<Vec<u8>>, EvalError> {
        let file = self.file(case, "jpg");
        match fs::read(&file) {
            Ok(bytes) => Ok(Some(bytes)),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(e) => Err(IoError::at(&file)(e).into()),
        }
    }

    /// Writes a whole file into the folder.
    ///
    /// # Errors
    /// [`EvalError::Io`].
    pub fn write_text(&self, name: &str, text: &str) -> Result<(), EvalError> {
        write(&self.path.join(name), text.as_bytes())
    }

    /// Writes `value` as JSON into the folder.
    ///
    /// # Errors
    /// [`EvalError::Io`].
    pub fn write_json(&self, name: &str, value: &impl serde::Serialize) -> Result<(), EvalError> {
        write(&self.path.join(name), &to_json(value))
    }
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), EvalError> {
    Ok(write_atomically(path, |file| file.write_all(bytes)).map_err(IoError::at(path))?)
}

fn to_json(value: &impl serde::Serialize) -> Vec<u8> {
    let mut bytes = serde_json::to_vec_pretty(value).expect("plain data with names as keys");
    bytes.push(b'\n');
    bytes
}

/// Reads a JSON file that anyone may have written.
pub(crate) fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, EvalError> {
    let length = fs::metadata(path).map_err(IoError::at(path))?.len();
    if length > LARGEST {
        return Err(EvalError::file(path, format!("at most {LARGEST} bytes"), length));
    }
    let bytes = fs::read(path).map_err(IoError::at(path))?;
    serde_json::from_slice(&bytes).map_err(|e| EvalError::file(path, "JSON of this program", e))
}

/// Where two settings differ: `sample.steps: 50 there, 20 now`.
pub fn differences(there: &Value, now: &Value) -> Vec<String> {
    let mut out = Vec::new();
    collect(there, now, "", &mut out);
    out
}

fn collect(there: &Value, now: &Value, path: &str, out: &mut Vec<String>) {
    if let (Value::Object(a), Value::Object(b)) = (there, now) {
        let mut keys: Vec<&String> = a.keys().chain(b.keys()).collect();
        keys.sort();
        keys.dedup();
        for key in keys {
            let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
            collect(a.get(key).unwrap_or(&Value::Null), b.get(key).unwrap_or(&Value::Null), &path, out);
        }
    } else if there != now {
        let text = |v: &Value| if v.is_null() { "nothing".to_owned() } else { v.to_string() };
        out.push(format!("{path}: {} there, {} now", text(there), text(now)));
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::record::ViewSet;

    fn failed(name: &str) -> Record {
        let case = Case { object: name.into(), views: ViewSet::Full, inputs: 4 };
        Record { case, outcome: Outcome::Failed { reason: "broken".into() } }
    }

    #[test]
    fn other_settings_are_refused_by_name_and_restart_clears_only_its_own() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("out");
        let settings = json!({ "method": "model", "sample": { "steps": 50, "guidance": 1.5 } });
        let folder = RunFolder::open(&path, &settings, false).unwrap();
        let features = Features { inception: vec![1.5, -2.0], vgg: vec![0.5] };
        folder.write(&failed("a"), &features, Some(b"jpeg")).unwrap();
        fs::write(path.join("mine.txt"), "mine").unwrap();

        let again = RunFolder::open(&path, &settings, false).unwrap();
        assert_eq!(again.record(&failed("a").case).unwrap(), Some(failed("a")));
        assert_eq!(again.record(&failed("b").case).unwrap(), None);
        assert!(!again.is_done(&failed("a").case).unwrap());
        assert_eq!(again.features(&failed("a").case, 2).unwrap(), [1.5, -2.0]);
        assert!(again.features(&failed("a").case, 3).is_err());
        assert_eq!(again.vgg_features(&failed("a").case, 1).unwrap(), [0.5]);
        assert_eq!(again.picture(&failed("a").case).unwrap().unwrap(), b"jpeg");

        let other = json!({ "method": "model", "sample": { "steps": 20, "guidance": 1.5 }, "refine": 5 });
        let error = RunFolder::open(&path, &other, false).unwrap_err().to_string();
        assert!(error.contains("sample.steps: 50 there, 20 now") && error.contains("refine: nothing there, 5 now"));
        assert!(!error.contains("guidance"), "{error}");
        let fresh = RunFolder::open(&path, &other, true).unwrap();
        assert_eq!(fresh.record(&failed("a").case).unwrap(), None);
        assert_eq!(fs::read_to_string(path.join("mine.txt")).unwrap(), "mine");
    }

    #[test]
    fn shares_may_start_at_once() {
        let place = tempfile::tempdir().unwrap();
        for round in 0..20 {
            let path = place.path().join(round.to_string());
            let start = std::sync::Barrier::new(6);
            let open = || {
                start.wait();
                RunFolder::open(&path, &json!({ "method": "model" }), false).map(|_| ())
            };
            thread::scope(|scope| {
                let all: Vec<_> = (0..6).map(|_| scope.spawn(open)).collect();
                all.into_iter().for_each(|share| share.join().unwrap().unwrap());
            });
            assert!(path.join(OBJECTS).is_dir() && path.join(SETTINGS).is_file());
        }
    }

    #[test]
    fn folders_of_something_else_and_broken_records_are_refused() {
        let place = tempfile::tempdir().unwrap();
        fs::write(place.path().join("thesis.tex"), "").unwrap();
        for restart in [false, true] {
            let error = RunFolder::open(place.path(), &json!({}), restart).unwrap_err();
            assert!(error.to_string().contains("thesis.tex"), "{error}");
        }
        let path = place.path().join("out");
        let folder = RunFolder::open(&path, &json!({}), false).unwrap();
        folder.write(&failed("a"), &Features::default(), None).unwrap();
        let file = folder.file(&failed("a").case, "json");
        let text = fs::read_to_string(&file).unwrap();
        fs::write(&file, text.replace("\"a\"", "\"b\"")).unwrap();
        assert!(matches!(folder.record(&failed("a").case), Err(EvalError::File { .. })));
        fs::write(&file, &text[..text.len() / 2]).unwrap();
        let error = folder.record(&failed("a").case).unwrap_err().to_string();
        assert!(error.contains("a.full.4.json"), "{error}");
    }
}
