//! Result folders. Every file of a result is finished before the first one replaces a file of an older result, and an
//! interrupt leaves nothing behind.

use std::{
    collections::{BTreeMap, BTreeSet},
    io::{ErrorKind, Write},
    path::{Component, Path, PathBuf},
    sync::{Mutex, MutexGuard, PoisonError},
};

use freerange_util::write_atomically;

use crate::error::CliError;

/// Names what earlier runs wrote into a folder, so that those files, and no others, make way for a new result.
const RECORD: &str = ".freerange-files.json";

/// The files of each command's result, relative to the folder.
type Record = BTreeMap<String, BTreeSet<PathBuf>>;

/// Temporary folders of all results in the making. Held while one of them is moved to its place.
static STAGING: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

fn staging() -> MutexGuard<'static, BTreeSet<PathBuf>> {
    STAGING.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Removes what is in the making, and ends the process with this code. A result that is being moved to its place is
/// finished before.
pub fn abandon(code: u8) -> ! {
    let staging = staging();
    // What cannot be removed stays: there is nobody left to tell.
    staging.iter().for_each(|folder| drop(std::fs::remove_dir_all(folder)));
    // The lock is kept: nothing begins to move any more.
    std::process::exit(code.into())
}

/// A folder in the making: files are written into a temporary folder beside it and moved over at the end, so that a
/// failure leaves what was there before.
pub struct OutputFolder {
    command: &'static str,
    target: PathBuf,
    staging: tempfile::TempDir,
}

impl OutputFolder {
    /// Prepares `target` for a result of `command`; its parents are made, itself not yet.
    pub fn create(command: &'static str, target: &Path) -> Result<Self, CliError> {
        if target.exists() && !target.is_dir() {
            return Err(CliError::file(target, "expected a folder to write to, found a file"));
        }
        let parent = match target.parent() {
            Some(p) if !p.as_os_str().is_empty() => p,
            _ => Path::new("."),
        };
        std::fs::create_dir_all(parent).map_err(|e| CliError::file(parent, e))?;
        let mut all = staging();
        let staging = tempfile::Builder::new().prefix(".freerange-").tempdir_in(parent);
        let staging = staging.map_err(|e| CliError::file(parent, e))?;
        all.insert(staging.path().into());
        Ok(Self { command, target: target.into(), staging })
    }

    /// Where to write the file `name` for now. Folders in `name` are made.
    pub fn path(&self, name: &str) -> Result<PathBuf, CliError> {
        let path = self.staging.path().join(name);
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder).map_err(|e| CliError::file(&self.target, e))?;
        }
        Ok(path)
    }

    /// Writes a whole file.
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<(), CliError> {
        std::fs::write(self.path(name)?, bytes).map_err(|e| CliError::file(&self.target.join(name), e))
    }

    /// Writes a picture as PNG.
    pub fn picture(&self, name: &str, picture: &image::RgbaImage) -> Result<(), CliError> {
        picture.save(self.path(name)?).map_err(|e| CliError::file(&self.target.join(name), e))
    }

    /// Moves everything to the target. Files of the same command's last result that this one lacks go away; all others stay.
    pub fn commit(self) -> Result<(), CliError> {
        let at = |path: &Path| {
            let path = path.to_path_buf();
            move |e| CliError::file(&path, e)
        };
        let target = &self.target;
        let _moving = staging();
        std::fs::create_dir_all(target).map_err(at(target))?;
        let mut new = BTreeSet::new();
        files(self.staging.path(), Path::new(""), &mut new).map_err(at(target))?;
        let mut record = recorded(target)?;
        // What another command has written under the same name is no longer its own.
        record.values_mut().for_each(|others| others.retain(|name| !new.contains(name)));
        let old = record.remove(self.command).unwrap_or_default();
        // Whatever happens from here on, the next run knows all that is ours.
        record.insert(self.command.into(), old.union(&new).cloned().collect());
        write_record(target, &record)?;
        for name in &new {
            let to = target.join(name);
            if let Some(folder) = to.parent() {
                std::fs::create_dir_all(folder).map_err(at(folder))?;
            }
            std::fs::rename(self.staging.path().join(name), &to).map_err(at(&to))?;
        }
        for name in old.difference(&new) {
            let stale = target.join(name);
            match std::fs::remove_file(&stale) {
                Err(e) if e.kind() != ErrorKind::NotFound => return Err(CliError::file(&stale, e)),
                _ => {}
            }
            // Folders go with their last file; one that still holds something cannot be removed, and stays.
            let folders = Path::new(name).ancestors().skip(1).filter(|f| !f.as_os_str().is_empty());
            folders.for_each(|folder| drop(std::fs::remove_dir(target.join(folder))));
        }
        record.insert(self.command.into(), new);
        write_record(target, &record)
    }
}

impl Drop for OutputFolder {
    fn drop(&mut self) {
        staging().remove(self.staging.path());
    }
}

/// Paths of all files below `root/folder`, relative to `root`.
fn files(root: &Path, folder: &Path, found: &mut BTreeSet<PathBuf>) -> std::io::Result<()> {
    for entry in std::fs::read_dir(root.join(folder))? {
        let entry = entry?;
        let name = folder.join(entry.file_name());
        match entry.file_type()?.is_dir() {
            true => files(root, &name, found)?,
            false => drop(found.insert(name)),
        }
    }
    Ok(())
}

/// What earlier runs wrote into `target`.
fn recorded(target: &Path) -> Result<Record, CliError> {
    let path = target.join(RECORD);
    let text = match std::fs::read_to_string(&path) {
        Ok(text) => text,
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(Record::new()),
        Err(e) => return Err(CliError::file(&path, e)),
    };
    let record: Record = serde_json::from_str(&text).map_err(|e| CliError::file(&path, e))?;
    // Nothing outside of the folder is ours, whatever the file says.
    match record.values().flatten().find(|name| !name.components().all(|c| matches!(c, Component::Normal(_)))) {
        Some(name) => Err(CliError::file(&path, format!("expected files in this folder, found {}", name.display()))),
        None => Ok(record),
    }
}

fn write_record(target: &Path, record: &Record) -> Result<(), CliError> {
    let path = target.join(RECORD);
    let text = serde_json::to_string_pretty(record).map_err(|e| CliError::file(&path, e))?;
    write_atomically(&path, |file| file.write_all(text.as_bytes())).map_err(|e| CliError::file(&path, e))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn result(target: &Path, names: &[&str]) -> Result<(), CliError> {
        result_of("reconstruct", target, names)
    }

    fn result_of(command: &'static str, target: &Path, names: &[&str]) -> Result<(), CliError> {
        let output = OutputFolder::create(command, target)?;
        names.iter().try_for_each(|name| output.write(name, b"new"))?;
        output.commit()
    }

    fn there(target: &Path) -> Vec<String> {
        let mut found = BTreeSet::new();
        files(target, Path::new(""), &mut found).unwrap();
        found.remove(Path::new(RECORD));
        found.into_iter().map(|name| name.to_str().unwrap().replace('\\', "/")).collect()
    }

    #[test]
    fn a_result_replaces_the_one_before_and_leaves_other_files_alone() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("out");
        std::fs::create_dir_all(target.join("inputs")).unwrap();
        for mine in ["notes.txt", "inputs/mine.png", "a.ply"] {
            std::fs::write(target.join(mine), b"mine").unwrap();
        }
        result(&target, &["a.ply", "a-1.ply", "inputs/0.png", "inputs-1/0.png"]).unwrap();
        assert_eq!(
            there(&target),
            ["a-1.ply", "a.ply", "inputs/0.png", "inputs/mine.png", "inputs-1/0.png", "notes.txt"]
        );
        assert_eq!(std::fs::read(target.join("a.ply")).unwrap(), b"new");
        std::fs::remove_file(target.join("a-1.ply")).unwrap(); // whoever takes a file away has it as they like
        result(&target, &["a.ply", "inputs/1.png"]).unwrap();
        assert_eq!(there(&target), ["a.ply", "inputs/1.png", "inputs/mine.png", "notes.txt"]);
        assert!(!target.join("inputs-1").exists());
        assert_eq!(std::fs::read(target.join("notes.txt")).unwrap(), b"mine");
    }

    #[test]
    fn each_command_replaces_its_own_result() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("out");
        result_of("reconstruct", &target, &["a.ply", "x.png"]).unwrap();
        result_of("render", &target, &["x.png", "y.png"]).unwrap();
        assert_eq!(there(&target), ["a.ply", "x.png", "y.png"]);
        result_of("reconstruct", &target, &["b.ply"]).unwrap();
        assert_eq!(there(&target), ["b.ply", "x.png", "y.png"]);
        result_of("render", &target, &["y.png"]).unwrap();
        assert_eq!(there(&target), ["b.ply", "y.png"]);
    }

    #[test]
    fn a_record_of_files_elsewhere_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("out");
        std::fs::create_dir(&target).unwrap();
        std::fs::write(folder.path().join("other"), b"mine").unwrap();
        for name in ["../other", "/other", "a/../../other"] {
            std::fs::write(target.join(RECORD), format!("{{\"render\":[{name:?}]}}")).unwrap();
            let error = result(&target, &["a.ply"]).unwrap_err().to_string();
            assert!(error.contains(RECORD) && error.contains(name), "{error}");
        }
        assert!(folder.path().join("other").exists() && !target.join("a.ply").exists());
    }
}
