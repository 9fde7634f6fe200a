//! Files that are either the old or the new, never half of one.

use std::io::{self, BufWriter, Write};
use std::{fs::File, path::Path};

use tempfile::NamedTempFile;

/// Writes a file beside `path` with `fill`, then renames it to `path`, replacing what is there. Where anything fails,
/// the process is killed or the power goes, `path` stays as it was. Afterwards the new file outlives both.
///
/// # Errors
/// Those of `fill` and of the file system.
pub fn write_atomically(path: &Path, fill: impl FnOnce(&mut BufWriter<&File>) -> io::Result<()>) -> io::Result<()> {
    let beside = beside(path)?;
    let mut writer = BufWriter::new(beside.as_file());
    fill(&mut writer)?;
    writer.flush()?;
    drop(writer);
    persist(beside, path)
}

/// A new file in the folder of `path`, to be filled and given that name by [`persist`]. Dropped before, it goes away.
///
/// # Errors
/// Those of the file system.
pub fn beside(path: &Path) -> io::Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".freerange-");
    // Temporary files are private by default; a result has the permissions that any new file gets.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder_of(path))
}

/// Makes the content of `file` permanent, then its name `path`, replacing what is there.
///
/// # Errors
/// Those of the file system; `path` is then as it was, unless the folder alone could not be made permanent.
pub fn persist(file: NamedTempFile, path: &Path) -> io::Result<()> {
    file.as_file().sync_all()?;
    file.persist(path)?;
    sync_folder(folder_of(path))
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Waits until the names in `folder` are permanent; those of files that were renamed into it, too, are so only then.
///
/// # Errors
/// Those of the file system.
pub fn sync_folder(folder: &Path) -> io::Result<()> {
    // Not every system lets a folder be opened.
    if cfg!(unix) { File::open(folder)?.sync_all() } else { Ok(()) }
}

/// Waits until `folder` with all files and folders in it is permanent.
///
/// # Errors
/// Those of the file system.
pub fn sync_tree(folder: &Path) -> io::Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        match path.is_dir() {
            true => sync_tree(&path)?,
            false => File::open(&path)?.sync_all()?,
        }
    }
    sync_folder(folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failure_leaves_the_old_file_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt");
        write_atomically(&path, |w| w.write_all(b"old")).unwrap();
        write_atomically(&path, |w| w.write_all(b"n").and(Err(io::Error::other("no")))).unwrap_err();
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        write_atomically(&path, |w| w.write_all(b"new")).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
        assert!(write_atomically(&folder.path().join("none/a.txt"), |_| Ok(())).is_err());
    }

    #[test]
    fn folders_are_synchronised_with_what_is_in_them() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("a")).unwrap();
        std::fs::write(folder.path().join("a/b.txt"), b"b").unwrap();
        sync_tree(folder.path()).unwrap();
        sync_tree(&folder.path().join("none")).unwrap_err();
    }
}
