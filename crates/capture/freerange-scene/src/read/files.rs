//! Folders and files of scenes, whose sizes and names nobody has checked.

use crate::{SceneError, error::In};
use std::{
    io::Read,
    path::{Path, PathBuf},
};

/// Largest file of cameras accepted, in bytes: COLMAP's with all keypoints of thousands of photos.
const LARGEST_FILE: u64 = 1 << 30;

/// What a folder holds, sorted by name.
pub(crate) fn entries(folder: &Path) -> Result<Vec<PathBuf>, SceneError> {
    let failed = |e| In(folder).read(e);
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(failed)?.take(100_000) {
        found.push(entry.map_err(failed)?.path());
    }
    found.sort();
    Ok(found)
}

pub(crate) fn has_extension(path: &Path, extensions: &[&str]) -> bool {
    path.extension().is_some_and(|e| extensions.iter().any(|known| e.eq_ignore_ascii_case(known)))
}

/// A whole file, if it is of a size that such files have.
pub(crate) fn bytes_of(file: &Path) -> Result<Vec<u8>, SceneError> {
    read_up_to(file, LARGEST_FILE + 1).and_then(|bytes| {
        let found = bytes.len() as u64;
        match found > LARGEST_FILE {
            true => Err(SceneError::TooLarge { file: file.into(), limit: LARGEST_FILE, found }),
            false => Ok(bytes),
        }
    })
}

pub(super) fn start_of(file: &Path) -> Result<Vec<u8>, SceneError> {
    read_up_to(file, 4096)
}

fn read_up_to(file: &Path, limit: u64) -> Result<Vec<u8>, SceneError> {
    let failed = |e| In(file).read(e);
    // A pipe or device would never end.
    if !std::fs::metadata(file).map_err(failed)?.is_file() {
        return Err(failed(std::io::Error::other("not a regular file")));
    }
    let mut bytes = Vec::new();
    std::fs::File::open(file).and_then(|f| f.take(limit).read_to_end(&mut bytes)).map_err(failed)?;
    Ok(bytes)
}

/// A file's text; the place of the first byte that is not UTF-8 is an error.
pub(crate) fn text_of<'a>(file: &Path, bytes: &'a [u8]) -> Result<&'a str, SceneError> {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    std::str::from_utf8(bytes).map_err(|e| In(file).malformed(&format!("byte {}", e.valid_up_to()), "not UTF-8 text"))
}

/// Joins a path that a file names to a folder, if it stays inside: names are other people's.
pub(crate) fn inside(folder: &Path, name: &str) -> Option<PathBuf> {
    let name = name.replace('\\', "/");
    let relative = Path::new(&name);
    let normal = |c| matches!(c, std::path::Component::Normal(_) | std::path::Component::CurDir);
    (!name.is_empty() && !name.contains('\0') && relative.components().all(normal)).then(|| folder.join(relative))
}
