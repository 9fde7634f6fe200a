//! Result folders that are written whole or not at all.

use std::path::{Path, PathBuf};

use crate::error::CliError;

/// A folder in the making: files are written into a temporary folder beside it and moved over at the end, so that a
/// failure leaves what was there before.
pub struct OutputFolder {
    target: PathBuf,
    staging: tempfile::TempDir,
}

impl OutputFolder {
    /// Prepares `target`; its parents are made, itself not yet.
    pub fn create(target: &Path) -> Result<Self, CliError> {
        if target.exists() && !target.is_dir() {
            return Err(CliError::file(target, "expected a folder to write to, found a file"));
        }
        let parent = match target.parent() {
            Some(p) if !p.as_os_str().is_empty() => p,
            _ => Path::new("."),
        };
        std::fs::create_dir_all(parent).map_err(|e| CliError::file(parent, e))?;
        let staging = tempfile::Builder::new().prefix(".freerange-").tempdir_in(parent);
        Ok(Self { target: target.into(), staging: staging.map_err(|e| CliError::file(parent, e))? })
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

    /// Moves everything to the target. Files and folders of the same names there are replaced, others stay.
    pub fn commit(self) -> Result<(), CliError> {
        let at = |e| CliError::file(&self.target, e);
        std::fs::create_dir_all(&self.target).map_err(at)?;
        for entry in std::fs::read_dir(self.staging.path()).map_err(at)? {
            let entry = entry.map_err(at)?;
            let to = self.target.join(entry.file_name());
            if to.is_dir() {
                std::fs::remove_dir_all(&to).map_err(at)?;
            }
            std::fs::rename(entry.path(), &to).map_err(at)?;
        }
        Ok(())
    }
}
