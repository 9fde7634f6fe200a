//! Shards: tar files in the WebDataset layout, whose neighbouring entries `KEY.*` make one object.
//!
//! Equal objects give equal bytes: entries come in a fixed order, with fixed times, owners and modes.

use std::collections::HashSet;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use crate::file::{NewFile, io_error};
use crate::sample::{self, CAMERAS, GAUSSIANS, MAX_VIEWS, METADATA, Metadata, Place};
use crate::{DataError, Object};

/// Largest entry, in bytes: bounds what a reader allocates.
const MAX_ENTRY: u64 = 512 << 20;
/// Largest number of objects in a shard.
const MAX_SAMPLES: usize = 1 << 20;
/// Tar files consist of blocks of this many bytes; two zero ones end them.
const BLOCK: u64 = 512;

/// Writes one shard. It appears under its name only when [finished](Self::finish).
pub struct ShardWriter {
    tar: tar::Builder<NewFile>,
    path: PathBuf,
    keys: HashSet<String>,
}

impl ShardWriter {
    /// Starts the shard `path`.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn create(path: &Path) -> Result<Self, DataError> {
        let tar = tar::Builder::new(NewFile::create(path)?);
        Ok(Self { tar, path: path.into(), keys: HashSet::new() })
    }

    /// Adds an object.
    ///
    /// # Errors
    /// [`DataError::Sample`] for one that could not be read back; [`DataError::Io`].
    pub fn add(&mut self, object: &Object, metadata: &Metadata) -> Result<(), DataError> {
        let entries = sample::encode(object, metadata, &self.path)?;
        self.add_encoded(&object.id, &entries)
    }

    /// Adds an object that [`sample::encode`] has made into entries.
    pub(crate) fn add_encoded(&mut self, key: &str, entries: &[(String, Vec<u8>)]) -> Result<(), DataError> {
        if !self.keys.insert(key.into()) {
            let place = Place { shard: &self.path, sample: key, entry: METADATA };
            return Err(place.error("ids that occur once", "a second object of that id"));
        }
        for (name, bytes) in entries {
            let mut header = tar::Header::new_ustar();
            header.set_entry_type(tar::EntryType::Regular);
            header.set_mode(0o644);
            header.set_uid(0);
            header.set_gid(0);
            header.set_mtime(0);
            header.set_size(bytes.len() as u64);
            let name = format!("{key}.{name}");
            let written = header.set_path(&name).and_then(|()| {
                header.set_cksum();
                self.tar.append(&header, bytes.as_slice())
            });
            written.map_err(io_error(&self.path))?;
        }
        Ok(())
    }

    /// Ends the shard and gives it its name. Returns its size in bytes and its SHA-256.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn finish(self) -> Result<(u64, String), DataError> {
        self.tar.into_inner().map_err(io_error(&self.path))?.finish()
    }
}

/// Bytes of an entry within its shard.
#[derive(Clone, Copy)]
struct Span {
    offset: u64,
    size: u64,
}

struct Sample {
    key: Box<str>,
    metadata: Span,
    cameras: Span,
    gaussians: Span,
    views: Box<[Span]>,
}

/// A shard whose objects can be read in any order: it remembers where their entries lie.
pub struct ShardReader {
    path: PathBuf,
    samples: Vec<Sample>,
}

impl ShardReader {
    /// Reads the headers of all entries.
    ///
    /// # Errors
    /// [`DataError::Sample`] or [`DataError::File`] where the file is no whole shard; [`DataError::Io`].
    pub fn open(path: &Path) -> Result<Self, DataError> {
        let problem = |problem: String| DataError::File { path: path.into(), problem };
        let file = File::open(path).map_err(io_error(path))?;
        let length = file.metadata().map_err(io_error(path))?.len();
        let mut archive = tar::Archive::new(file);
        let mut draft: Option<Draft> = None;
        let mut keys = HashSet::new();
        let mut samples = Vec::new();
        let mut end = 0;
        // Raw: names beyond 100 bytes and the like are not written here, and need memory that the file decides on.
        for entry in archive.entries_with_seek().map_err(io_error(path))?.raw(true) {
            let entry = entry.map_err(|e| problem(format!("not a tar file from byte {end}: {e}")))?;
            let bytes = entry.path_bytes();
            let name =
                std::str::from_utf8(&bytes).ok().and_then(|n| n.split_once('.')).filter(|(k, _)| sample::is_key(k));
            let Some((key, rest)) = name else {
                return Err(problem(format!(
                    "expected entries called KEY.*, found {:?}",
                    String::from_utf8_lossy(&bytes)
                )));
            };
            let place = Place { shard: path, sample: key, entry: rest };
            if !entry.header().entry_type().is_file() {
                return Err(place.error("a regular file", format!("{:?}", entry.header().entry_type())));
            }
            let span = Span { offset: entry.raw_file_position(), size: entry.size() };
            if span.size > MAX_ENTRY {
                return Err(place.error(format!("at most {MAX_ENTRY} bytes"), span.size));
            }
            end = span.offset + span.size.next_multiple_of(BLOCK);
            if end > length {
                let found = format!("{length}: the shard is cut off");
                return Err(place.error(format!("an entry that ends by byte {end}"), found));
            }
            if draft.as_ref().is_none_or(|d| d.key != key) {
                samples.extend(draft.take().map(|d| d.finish(path)).transpose()?);
                if !keys.insert(key.to_string()) {
                    return Err(place.error("the entries of an object side by side", "entries of others between them"));
                }
                if samples.len() == MAX_SAMPLES {
                    return Err(problem(format!("expected at most {MAX_SAMPLES} objects, found more")));
                }
                draft = Some(Draft { key: key.into(), ..Draft::default() });
            }
            if let Some(draft) = &mut draft {
                draft.add(rest, span, place)?;
            }
        }
        samples.extend(draft.map(|d| d.finish(path)).transpose()?);
        if length < end + 2 * BLOCK {
            let expected = end + 2 * BLOCK;
            return Err(problem(format!("expected at least {expected} bytes, found {length}: the shard is cut off")));
        }
        Ok(Self { path: path.into(), samples })
    }

    /// Number of objects.
    pub fn len(&self) -> usize {
        self.samples.len()
    }

    /// Whether there is no object.
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// Number of views of every object.
    pub fn view_counts(&self) -> impl Iterator<Item = usize> {
        self.samples.iter().map(|s| s.views.len())
    }

    /// Object number `i`, with its slices at `depths` only.
    ///
    /// # Errors
    /// [`DataError::Depth`] where it has none at one of the depths; [`DataError::Sample`] for broken entries;
    /// [`DataError::Io`].
    ///
    /// # Panics
    /// If there is no such object.
    pub fn read(&self, i: usize, depths: &[u32]) -> Result<Object, DataError> {
        let sample = &self.samples[i];
        let mut file = File::open(&self.path).map_err(io_error(&self.path))?;
        let place = Place { shard: &self.path, sample: &sample.key, entry: METADATA };
        let cameras = self.bytes(&mut file, sample.cameras)?;
        let cameras = sample::decode_cameras(&cameras, sample.views.len(), place.of(CAMERAS))?;
        let slices = sample::decode_slices(&self.bytes(&mut file, sample.gaussians)?, depths, place.of(GAUSSIANS))?;
        let views = cameras.into_iter().zip(&sample.views).enumerate().map(|(k, ((name, camera), &span))| {
            let bytes = self.bytes(&mut file, span)?;
            let entry = sample::view_entry(k);
            let place = Place { shard: &self.path, sample: &sample.key, entry: &entry };
            sample::decode_view(&bytes, name, camera, place)
        });
        Ok(Object { id: sample.key.to_string(), views: views.collect::<Result<_, _>>()?, slices })
    }

    /// What else is known of object number `i`.
    ///
    /// # Errors
    /// [`DataError::Sample`] for a broken entry; [`DataError::Io`].
    ///
    /// # Panics
    /// If there is no such object.
    pub fn metadata(&self, i: usize) -> Result<Metadata, DataError> {
        let sample = &self.samples[i];
        let mut file = File::open(&self.path).map_err(io_error(&self.path))?;
        let bytes = self.bytes(&mut file, sample.metadata)?;
        sample::decode_metadata(&bytes, Place { shard: &self.path, sample: &sample.key, entry: METADATA })
    }

    /// The bytes of an entry, whose size the index has checked against the file's.
    fn bytes(&self, file: &mut File, span: Span) -> Result<Vec<u8>, DataError> {
        let mut bytes = vec![0; span.size as usize];
        file.seek(SeekFrom::Start(span.offset))
            .and_then(|_| file.read_exact(&mut bytes))
            .map_err(io_error(&self.path))?;
        Ok(bytes)
    }
}

/// An object of which some entries have been seen.
#[derive(Default)]
struct Draft {
    key: String,
    metadata: Option<Span>,
    cameras: Option<Span>,
    gaussians: Option<Span>,
    views: Vec<Span>,
}

impl Draft {
    fn add(&mut self, name: &str, span: Span, place: Place) -> Result<(), DataError> {
        let next = sample::view_entry(self.views.len());
        let slot = match name {
            METADATA => &mut self.metadata,
            CAMERAS => &mut self.cameras,
            GAUSSIANS => &mut self.gaussians,
            _ if name == next && self.views.len() < MAX_VIEWS => {
                self.views.push(span);
                return Ok(());
            }
            _ => return Err(place.error(format!("{METADATA}, {CAMERAS}, {GAUSSIANS} or {next}"), name)),
        };
        match slot.replace(span) {
            None => Ok(()),
            Some(_) => Err(place.error("one such entry", "a second one")),
        }
    }

    fn finish(self, shard: &Path) -> Result<Sample, DataError> {
        let need = |span: Option<Span>, entry| {
            span.ok_or_else(|| Place { shard, sample: &self.key, entry }.error("this entry", "none"))
        };
        let (metadata, cameras) = (need(self.metadata, METADATA)?, need(self.cameras, CAMERAS)?);
        let gaussians = need(self.gaussians, GAUSSIANS)?;
        need(self.views.first().copied(), &sample::view_entry(0))?;
        Ok(Sample { metadata, cameras, gaussians, views: self.views.into(), key: self.key.into() })
    }
}
