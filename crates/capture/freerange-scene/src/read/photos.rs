//! The image files that cameras name: found by name up to capitals and extension, or counted as missing.

use super::inside;
use crate::camera::scene::{ImageFiles, Located};
use crate::{SceneError, decode::size_of, error::In};
use freerange_util::Note;
use std::path::{Path, PathBuf};

/// Names in a note, at most.
const LISTED: usize = 6;

/// Looks for the images of one file of cameras, in some folders.
pub(super) struct Photos<'a> {
    /// The file that names them.
    file: &'a Path,
    folders: Vec<PathBuf>,
    files: ImageFiles,
    found: usize,
    missing: Vec<String>,
    renamed: Vec<String>,
    sized: Vec<String>,
}

impl<'a> Photos<'a> {
    /// Images of `file` in the first of `folders` that has them.
    pub fn new(file: &'a Path, folders: Vec<PathBuf>) -> Self {
        let (missing, renamed, sized) = (Vec::new(), Vec::new(), Vec::new());
        Self { file, folders, files: ImageFiles::default(), found: 0, missing, renamed, sized }
    }

    /// The folders where programs that write one file beside the photos have them.
    pub fn beside(file: &'a Path, images: Option<&Path>) -> Self {
        let folder = file.parent().unwrap_or(Path::new(""));
        let folders = match images {
            Some(images) => vec![images.to_path_buf()],
            None => vec![folder.join("images"), folder.to_path_buf()],
        };
        Self::new(file, folders)
    }

    /// The image at a path that a file gives, or the one of its name in the folders: files are moved, and paths of other machines mean nothing.
    pub fn find_at(&mut self, path: &Path) -> Result<Option<PathBuf>, SceneError> {
        match self.files.locate(path) {
            Located::Missing => {}
            located => return self.take(located, &path.file_name().unwrap_or_default().to_string_lossy()),
        }
        let parts: Vec<_> = path.components().collect();
        for count in [2, 1] {
            let tail: PathBuf = parts[parts.len().saturating_sub(count)..].iter().collect();
            for folder in self.folders.clone() {
                let Some(inner) = inside(&folder, &tail.to_string_lossy()) else { continue };
                match self.files.locate(&inner) {
                    Located::Missing => {}
                    Located::There(found) => {
                        self.found += 1;
                        self.renamed.push(format!("{} for {}", tail.display(), path.display()));
                        return Ok(Some(found));
                    }
                    located => return self.take(located, &tail.to_string_lossy()),
                }
            }
        }
        self.missing.push(path.display().to_string());
        Ok(None)
    }

    /// What was found for a name; none only where nothing was.
    fn take(&mut self, located: Located, name: &str) -> Result<Option<PathBuf>, SceneError> {
        match located {
            Located::There(path) => {
                self.found += 1;
                Ok(Some(path))
            }
            Located::Renamed(path) => {
                self.found += 1;
                self.renamed.push(format!("{} for {name}", path.file_name().unwrap_or_default().display()));
                Ok(Some(path))
            }
            Located::Several(first, second) => {
                let found = format!("{} and {}", first.display(), second.display());
                Err(In(self.file).field("", name, "one image of this name", found))
            }
            Located::Unreadable(path, kind) => Err(In(&path).unreadable(kind)),
            Located::Missing => Ok(None),
        }
    }

    /// The image called `name`: as written, by its file name alone, with an extension added, other capitals or another extension. None where
    /// it is nowhere: it is left out.
    pub fn find(&mut self, name: &str) -> Result<Option<PathBuf>, SceneError> {
        let alone = name.rsplit(['/', '\\']).next().unwrap_or(name);
        let mut unreadable = None;
        for name in [name, alone] {
            for folder in &self.folders {
                let Some(path) = inside(folder, name) else { continue };
                match self.files.locate(&path) {
                    Located::Missing => {}
                    Located::Unreadable(path, kind) => unreadable = unreadable.or(Some((path, kind))),
                    located => return self.take(located, name),
                }
            }
        }
        if let Some((path, kind)) = unreadable {
            return Err(In(&path).unreadable(kind));
        }
        self.missing.push(name.to_owned());
        Ok(None)
    }

    /// The size of an image that stands in for that of its camera, whose file does not say for which its pixels are.
    pub fn size_for_camera(&mut self, name: &str, image: &Path) -> Result<(u32, u32), SceneError> {
        let (w, h) = size_of(image)?;
        self.sized.push(format!("{name}: {w} x {h}"));
        Ok((w, h))
    }

    /// What there is to say of them; an error where none was found.
    pub fn finish(self, notes: &mut Vec<Note>) -> Result<(), SceneError> {
        if self.found == 0
            && let Some(name) = self.missing.first()
        {
            let folders = self.folders.iter().map(|f| f.display().to_string()).collect();
            return Err(SceneError::MissingImage {
                place: self.file.display().to_string(),
                image: name.into(),
                folders,
            });
        }
        if !self.missing.is_empty() {
            let (count, all) = (self.missing.len(), self.missing.len() + self.found);
            notes.push(Note::warning(format!(
                "{count} of {all} photos with cameras are not there and left out: {}",
                listed(&self.missing)
            )));
        }
        if !self.renamed.is_empty() {
            notes.push(Note::assumed(format!(
                "{} photos are files of other names: {}",
                self.renamed.len(),
                listed(&self.renamed)
            )));
        }
        if let Some(first) = self.sized.first() {
            notes.push(Note::assumed(format!(
                "no file says for which size the cameras of {} photos are: they are taken to be for the photos' own \
                 ({first}), which is wrong for reduced photos",
                self.sized.len()
            )));
        }
        Ok(())
    }
}

/// The first of some names.
pub(crate) fn listed(names: &[String]) -> String {
    let more = if names.len() > LISTED { ", ..." } else { "" };
    format!("{}{more}", names[..names.len().min(LISTED)].join(", "))
}
