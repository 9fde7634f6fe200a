//! Where shards lie: a local folder, or (feature `cloud`) a place that `object_store` reaches.
//!
//! Files appear under their name only when they are whole, in both.

use std::fs::File;
use std::io::{self, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use freerange_util::{IoError, hex};
use sha2::{Digest, Sha256};

use crate::DataError;
#[cfg(feature = "cloud")]
use crate::remote::Whole;

/// What follows the name of a local file that is being written.
pub(crate) const PARTIAL: &str = ".partial";

/// A folder of named files. Names are relative, with `/` between their parts.
#[derive(Clone, Debug)]
pub struct Store {
    location: Location,
    /// Tells the unfinished files of one writer from those of another.
    writer: String,
}

#[derive(Clone, Debug)]
enum Location {
    Local(PathBuf),
    #[cfg(feature = "cloud")]
    Remote(crate::remote::Remote),
}

impl Store {
    /// `location`: a local folder (it need not exist yet), or a URL: `s3://bucket/prefix`, `gs://bucket/prefix`,
    /// `http(s)://host/path` (reading only). Credentials are found where the providers' own programs look for them.
    ///
    /// # Errors
    /// [`DataError::Store`] for a URL that cannot be used, or where this program was built without the feature `cloud`.
    pub fn open(location: &str) -> Result<Self, DataError> {
        let location = match location.split_once("://") {
            None => Location::Local(location.into()),
            #[cfg(feature = "cloud")]
            Some(_) => Location::Remote(crate::remote::Remote::open(location)?),
            #[cfg(not(feature = "cloud"))]
            Some(_) => {
                return Err(DataError::Store {
                    location: location.into(),
                    problem: "expected a local folder: this program was built without the feature `cloud`".into(),
                });
            }
        };
        Ok(Self { location, writer: String::new() })
    }

    /// The local folder `path`.
    pub fn local(path: &Path) -> Self {
        Self { location: Location::Local(path.into()), writer: String::new() }
    }

    /// An object store that goes away with its last copy, as those that URLs name in all else: for tests.
    #[cfg(feature = "cloud")]
    pub fn in_memory() -> Self {
        Self { location: Location::Remote(crate::remote::Remote::in_memory()), writer: String::new() }
    }

    /// The same place, written to by `writer`: no two may write at once under one name.
    pub fn written_by(&self, writer: String) -> Self {
        Self { writer, ..self.clone() }
    }

    /// The local folder, if it is one.
    pub fn folder(&self) -> Option<&Path> {
        match &self.location {
            Location::Local(folder) => Some(folder),
            #[cfg(feature = "cloud")]
            Location::Remote(_) => None,
        }
    }

    /// `name` as it is called in messages.
    pub fn path(&self, name: &str) -> PathBuf {
        match &self.location {
            Location::Local(folder) => folder.join(name),
            #[cfg(feature = "cloud")]
            Location::Remote(remote) => remote.path(name),
        }
    }

    /// The whole of `name`; `None` where there is no such file.
    ///
    /// # Errors
    /// [`DataError::Io`]; [`DataError::File`] for more than `most` bytes.
    pub fn read(&self, name: &str, most: u64) -> Result<Option<Vec<u8>>, DataError> {
        let path = self.path(name);
        let too_large = || DataError::File { path: path.clone(), problem: format!("expected at most {most} bytes") };
        match &self.location {
            Location::Local(_) => {
                let file = match File::open(&path) {
                    Ok(file) => file,
                    Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
                    Err(e) => return Err(DataError::from(IoError::at(&path)(e))),
                };
                let mut bytes = Vec::new();
                file.take(most.saturating_add(1)).read_to_end(&mut bytes).map_err(IoError::at(&path))?;
                if bytes.len() as u64 > most { Err(too_large()) } else { Ok(Some(bytes)) }
            }
            #[cfg(feature = "cloud")]
            Location::Remote(remote) => match remote.read(name, most)? {
                Whole::Here(bytes) => Ok(Some(bytes)),
                Whole::TooLarge => Err(too_large()),
                Whole::Missing => Ok(None),
            },
        }
    }

    /// `length` bytes of `name` from `offset` on. The caller bounds the length.
    ///
    /// # Errors
    /// [`DataError::Io`], also where the file ends before.
    pub fn range(&self, name: &str, offset: u64, length: u64) -> Result<Vec<u8>, DataError> {
        match &self.location {
            Location::Local(folder) => {
                let path = folder.join(name);
                let mut bytes = vec![0; length as usize];
                File::open(&path)
                    .and_then(|mut file| {
                        file.seek(SeekFrom::Start(offset))?;
                        file.read_exact(&mut bytes)
                    })
                    .map_err(IoError::at(&path))?;
                Ok(bytes)
            }
            #[cfg(feature = "cloud")]
            Location::Remote(remote) => remote.range(name, offset, length),
        }
    }

    /// Hands the first `length` bytes of `name` over, piece by piece: files may be larger than memory.
    ///
    /// # Errors
    /// [`DataError::Io`], also where the file ends before; those of `take`.
    pub fn pieces(
        &self,
        name: &str,
        length: u64,
        mut take: impl FnMut(&[u8]) -> Result<(), DataError>,
    ) -> Result<(), DataError> {
        const PIECE: u64 = 8 << 20;
        (0..length.div_ceil(PIECE)).try_for_each(|i| {
            let at = i * PIECE;
            take(&self.range(name, at, PIECE.min(length - at))?)
        })
    }

    /// Size of `name` in bytes; `None` where there is no such file.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn size(&self, name: &str) -> Result<Option<u64>, DataError> {
        match &self.location {
            Location::Local(folder) => match std::fs::metadata(folder.join(name)) {
                Ok(found) => Ok(found.is_file().then_some(found.len())),
                Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
                Err(e) => Err(DataError::from(IoError::at(&folder.join(name))(e))),
            },
            #[cfg(feature = "cloud")]
            Location::Remote(remote) => remote.size(name),
        }
    }

    /// Starts `name`, in place of what may be there.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn create(&self, name: &str) -> Result<NewFile, DataError> {
        let target = self.path(name);
        let sink = match &self.location {
            Location::Local(_) => {
                if let Some(folder) = target.parent() {
                    std::fs::create_dir_all(folder).map_err(IoError::at(folder))?;
                }
                let mut partial = target.clone().into_os_string();
                partial.push(format!("{PARTIAL}{}", self.writer));
                let partial = PathBuf::from(partial);
                let file = File::create(&partial).map_err(IoError::at(&partial))?;
                Sink::Local { writer: BufWriter::with_capacity(1 << 20, file), partial }
            }
            #[cfg(feature = "cloud")]
            Location::Remote(remote) => Sink::Remote(remote.create(name)?),
        };
        Ok(NewFile { target, sink: Some(sink), hash: Sha256::new(), bytes: 0 })
    }

    /// Writes the whole of `name`.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<(), DataError> {
        let mut file = self.create(name)?;
        file.write_all(bytes).map_err(IoError::at(&self.path(name)))?;
        file.finish().map(|_| ())
    }

    /// Names of the finished files directly in the folder `name`, in order; none where there is no such folder.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn list(&self, name: &str) -> Result<Vec<String>, DataError> {
        let mut names = match &self.location {
            Location::Local(folder) => {
                let path = folder.join(name);
                let entries = match std::fs::read_dir(&path) {
                    Ok(entries) => entries,
                    Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
                    Err(e) => return Err(DataError::from(IoError::at(&path)(e))),
                };
                let mut names = Vec::new();
                for entry in entries {
                    let entry = entry.map_err(IoError::at(&path))?;
                    if let Ok(found) = entry.file_name().into_string()
                        && !found.contains(PARTIAL)
                        && entry.path().is_file()
                    {
                        names.push(found);
                    }
                }
                names
            }
            #[cfg(feature = "cloud")]
            Location::Remote(remote) => remote.list(name)?,
        };
        names.sort_unstable();
        Ok(names)
    }

    /// Removes the folder `name` with all it holds, if it is there.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn remove_folder(&self, name: &str) -> Result<(), DataError> {
        match &self.location {
            Location::Local(folder) => match std::fs::remove_dir_all(folder.join(name)) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => {
                    Err(DataError::from(IoError::at(&folder.join(name))(e)))
                }
                _ => Ok(()),
            },
            #[cfg(feature = "cloud")]
            Location::Remote(remote) => remote.remove(name),
        }
    }

    /// Two processes that write under one name would rename each other's files away. Held until dropped, and gone with
    /// the process. Remote places give no such lock: there, equal work writes equal bytes.
    ///
    /// # Errors
    /// [`DataError::File`] where another process has it; [`DataError::Io`].
    pub fn lock(&self) -> Result<Option<File>, DataError> {
        let Some(folder) = self.folder() else { return Ok(None) };
        std::fs::create_dir_all(folder).map_err(IoError::at(folder))?;
        let path = folder.join(format!(".lock{}", self.writer));
        let file = File::create(&path).map_err(IoError::at(&path))?;
        match file.try_lock() {
            Ok(()) => Ok(Some(file)),
            Err(std::fs::TryLockError::WouldBlock) => Err(DataError::File {
                path: folder.into(),
                problem: "another process is making the same shards in this folder".into(),
            }),
            Err(std::fs::TryLockError::Error(source)) => Err(DataError::from(IoError { path, source })),
        }
    }

    /// Removes what a killed process of the same writer left unfinished outside of folders of their own.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn remove_partial_files(&self, folder: &str) -> Result<(), DataError> {
        let Some(root) = self.folder() else { return Ok(()) };
        let path = root.join(folder);
        let ending = format!("{PARTIAL}{}", self.writer);
        let entries = match std::fs::read_dir(&path) {
            Ok(entries) => entries,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(()),
            Err(e) => return Err(DataError::from(IoError::at(&path)(e))),
        };
        for entry in entries {
            let found = entry.map_err(IoError::at(&path))?.path();
            if found.file_name().and_then(|n| n.to_str()).is_some_and(|n| n.ends_with(&ending)) {
                std::fs::remove_file(&found).map_err(IoError::at(&found))?;
            }
        }
        Ok(())
    }
}

/// A file under construction. Dropped unfinished, it goes away; killed, a local one stays as `*.partial*`.
pub struct NewFile {
    target: PathBuf,
    sink: Option<Sink>, // none once closed
    hash: Sha256,
    bytes: u64,
}

enum Sink {
    Local {
        writer: BufWriter<File>,
        partial: PathBuf,
    },
    #[cfg(feature = "cloud")]
    Remote(crate::remote::Upload),
}

impl NewFile {
    /// SHA-256 of what was written so far, in hexadecimal.
    pub fn sha256(&self) -> String {
        hex(&self.hash.clone().finalize())
    }

    /// Makes the bytes permanent, then gives the file its name. Returns its size and SHA-256.
    ///
    /// # Errors
    /// [`DataError::Io`]; no file has the name then.
    pub fn finish(mut self) -> Result<(u64, String), DataError> {
        match self.sink.take() {
            None => {}
            Some(Sink::Local { mut writer, partial }) => {
                let done = writer.flush().and_then(|()| writer.get_ref().sync_all());
                drop(writer);
                if let Err(source) = done.and_then(|()| std::fs::rename(&partial, &self.target)) {
                    // The error that counts is the first one.
                    let _ = std::fs::remove_file(&partial);
                    return Err(DataError::from(IoError::at(&self.target)(source)));
                }
                // The new name, too, must outlive a power cut.
                if let Some(folder) = self.target.parent().filter(|p| !p.as_os_str().is_empty()) {
                    freerange_util::sync_folder(folder).map_err(IoError::at(folder))?;
                }
            }
            #[cfg(feature = "cloud")]
            Some(Sink::Remote(upload)) => upload.finish().map_err(IoError::at(&self.target))?,
        }
        Ok((self.bytes, hex(&std::mem::take(&mut self.hash).finalize())))
    }
}

impl Write for NewFile {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        let n = match self.sink.as_mut() {
            None => return Err(io::Error::other("already closed")),
            Some(Sink::Local { writer, .. }) => writer.write(data)?,
            #[cfg(feature = "cloud")]
            Some(Sink::Remote(upload)) => upload.write(data)?,
        };
        self.hash.update(&data[..n]);
        self.bytes += n as u64;
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        match self.sink.as_mut() {
            Some(Sink::Local { writer, .. }) => writer.flush(),
            _ => Ok(()),
        }
    }
}

impl Drop for NewFile {
    fn drop(&mut self) {
        if let Some(Sink::Local { partial, .. }) = self.sink.take() {
            let _ = std::fs::remove_file(&partial);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_appears_only_when_finished() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::local(folder.path()).written_by("-1".into());
        let mut file = store.create("b/a.bin").unwrap();
        file.write_all(b"abc").unwrap();
        assert_eq!(store.list("b").unwrap(), Vec::<String>::new());
        assert!(folder.path().join("b/a.bin.partial-1").exists());
        drop(file);
        assert_eq!(std::fs::read_dir(folder.path().join("b")).unwrap().count(), 0);

        let mut file = store.create("b/a.bin").unwrap();
        file.write_all(b"abc").unwrap();
        let (bytes, hash) = file.finish().unwrap();
        assert_eq!((bytes, store.read("b/a.bin", 3).unwrap()), (3, Some(b"abc".to_vec())));
        assert_eq!(hash, "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
        assert_eq!((store.range("b/a.bin", 1, 2).unwrap(), store.size("b/a.bin").unwrap()), (b"bc".to_vec(), Some(3)));
        assert!(store.range("b/a.bin", 1, 3).is_err());
        assert!(store.read("b/a.bin", 2).unwrap_err().to_string().contains("at most 2 bytes"));
        assert_eq!((store.read("c", 9).unwrap(), store.size("c").unwrap()), (None, None));
        assert_eq!(store.list("b").unwrap(), ["a.bin"]);
        store.remove_folder("b").unwrap();
        store.remove_folder("b").unwrap();
        assert_eq!(store.list("b").unwrap(), Vec::<String>::new());
    }

    #[test]
    fn leftovers_of_the_same_writer_only_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["m.json.partial-0", "m.json.partial-1", "m.json"] {
            std::fs::write(folder.path().join(name), b"x").unwrap();
        }
        Store::local(folder.path()).written_by("-0".into()).remove_partial_files("").unwrap();
        let left: Vec<bool> =
            ["m.json.partial-0", "m.json.partial-1", "m.json"].iter().map(|n| folder.path().join(n).exists()).collect();
        assert_eq!(left, [false, true, true]);
    }

    #[cfg(not(feature = "cloud"))]
    #[test]
    fn urls_need_the_feature() {
        assert!(Store::open("s3://a/b").unwrap_err().to_string().contains("feature `cloud`"));
    }
}
