//! Files that appear under their name only when they are whole.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::DataError;

/// What a file that is being written is called.
pub(crate) const PARTIAL: &str = ".partial";

/// Turns an I/O error into one that names `path`.
pub(crate) fn io_error(path: &Path) -> impl FnOnce(io::Error) -> DataError {
    let path = path.to_path_buf();
    move |source| DataError::Io { path, source }
}

/// A file under construction beside its target. Dropped unfinished, it goes away; killed, it stays as `*.partial`.
pub(crate) struct NewFile {
    target: PathBuf,
    partial: PathBuf,
    writer: Option<BufWriter<File>>, // none once closed
    hash: Sha256,
    bytes: u64,
}

impl NewFile {
    /// Starts `target`, in place of what an earlier, killed process may have left.
    pub fn create(target: &Path) -> Result<Self, DataError> {
        let mut partial = target.as_os_str().to_owned();
        partial.push(PARTIAL);
        let partial = PathBuf::from(partial);
        let file = File::create(&partial).map_err(io_error(&partial))?;
        let writer = Some(BufWriter::with_capacity(1 << 20, file));
        Ok(Self { target: target.into(), partial, writer, hash: Sha256::new(), bytes: 0 })
    }

    /// Forces the bytes onto the disk, then gives the file its name. Returns its size and SHA-256.
    pub fn finish(mut self) -> Result<(u64, String), DataError> {
        if let Some(mut writer) = self.writer.take() {
            let done = writer.flush().and_then(|()| writer.get_ref().sync_all());
            drop(writer);
            let done = done.and_then(|()| std::fs::rename(&self.partial, &self.target));
            if let Err(source) = done {
                // The error that counts is the first one.
                let _ = std::fs::remove_file(&self.partial);
                return Err(io_error(&self.target)(source));
            }
            // The new name, too, must outlive a power cut; not every system lets a folder be opened.
            #[cfg(unix)]
            if let Some(folder) = self.target.parent().filter(|p| !p.as_os_str().is_empty()) {
                File::open(folder).and_then(|f| f.sync_all()).map_err(io_error(folder))?;
            }
        }
        Ok((self.bytes, hex(&std::mem::take(&mut self.hash).finalize())))
    }
}

impl Write for NewFile {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        let writer = self.writer.as_mut().ok_or_else(|| io::Error::other("already closed"))?;
        let n = writer.write(data)?;
        self.hash.update(&data[..n]);
        self.bytes += n as u64;
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.writer.as_mut().map_or(Ok(()), |w| w.flush())
    }
}

impl Drop for NewFile {
    fn drop(&mut self) {
        if self.writer.take().is_some() {
            let _ = std::fs::remove_file(&self.partial);
        }
    }
}

/// SHA-256 of a file, in hexadecimal.
pub(crate) fn sha256_of_file(path: &Path) -> Result<String, DataError> {
    let mut hash = Sha256::new();
    File::open(path).and_then(|mut f| io::copy(&mut f, &mut hash)).map_err(io_error(path))?;
    Ok(hex(&hash.finalize()))
}

/// SHA-256 of `bytes`, in hexadecimal.
pub(crate) fn sha256(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_appears_only_when_finished() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        let mut file = NewFile::create(&path).unwrap();
        file.write_all(b"abc").unwrap();
        assert!(!path.exists() && folder.path().join("a.bin.partial").exists());
        drop(file);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);

        let mut file = NewFile::create(&path).unwrap();
        file.write_all(b"abc").unwrap();
        let (bytes, hash) = file.finish().unwrap();
        assert_eq!((bytes, std::fs::read(&path).unwrap()), (3, b"abc".to_vec()));
        assert_eq!(hash, "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
        assert_eq!(sha256_of_file(&path).unwrap(), hash);
        assert_eq!(sha256(b"abc"), hash);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
