//! What folders take on disk, and whether there is room.

use std::{fs, path::Path};

/// Bytes of all files below `folder`.
pub fn size_of(folder: &Path) -> u64 {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let size = |entry: fs::DirEntry| match entry.metadata() {
        Ok(data) if data.is_dir() => size_of(&entry.path()),
        Ok(data) => data.len(),
        Err(_) => 0,
    };
    entries.map(size).sum()
}

/// The system's errors of a disk without room, and of a quota that is used up.
const FULL: [&str; 2] = match () {
    () if cfg!(windows) => ["(os error 112)", "(os error 39)"],
    () if cfg!(target_os = "linux") => ["(os error 28)", "(os error 122)"],
    () => ["(os error 28)", "(os error 69)"],
};

/// Whether an error's text is that of a full disk. The text, since not every library hands the system's error on.
pub fn is_full(text: &str) -> bool {
    text.contains("No space left on device") || FULL.iter().any(|code| text.contains(code))
}
