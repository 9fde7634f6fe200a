//! Shards: tar files in the WebDataset layout, whose neighboring entries `KEY.*` make one object.
//!
//! Equal objects give equal bytes: entries come in a fixed order, with fixed times, owners and modes.

use std::collections::HashSet;
use std::fs::File;
use std::io::{BufReader, Cursor, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use freerange_gaussians::Gaussians;
use freerange_util::IoError;

use crate::sample::{self, CAMERAS, EntryOfShard, GAUSSIANS, MAX_VIEWS, METADATA, Metadata};
use crate::{DataError, ImageFormat, Object};

/// Largest entry, in bytes: bounds what a reader allocates.
const MAX_ENTRY: u64 = 512 << 20;
/// Largest number of objects in a shard.
const MAX_SAMPLES: usize = 1 << 20;
/// Tar files consist of blocks of this many bytes.
const BLOCK: u64 = 512;
/// What ends a tar file: two zero blocks.
pub const END: [u8; 2 * BLOCK as usize] = [0; 2 * BLOCK as usize];

/// The entries of one object as they stand in a shard: a tar file without its end.
///
/// # Errors
/// [`DataError::Sample`] for an object that could not be read back.
pub fn object_bytes(
    object: &Object,
    leaves: Option<&Gaussians>,
    metadata: &Metadata,
    format: ImageFormat,
    shard: &Path,
) -> Result<Vec<u8>, DataError> {
    tar_bytes(&object.id, &sample::encode(object, leaves, metadata, format, shard)?, shard)
}

/// Entries `KEY.NAME` as a tar file without its end.
///
/// # Errors
/// [`DataError::Io`] for a name that no tar file can hold.
pub fn tar_bytes(key: &str, entries: &[(String, Vec<u8>)], shard: &Path) -> Result<Vec<u8>, DataError> {
    let mut bytes = Vec::new();
    for (entry, content) in entries {
        let mut header = tar::Header::new_ustar();
        header.set_entry_type(tar::EntryType::Regular);
        header.set_mode(0o644);
        header.set_uid(0);
        header.set_gid(0);
        header.set_mtime(0);
        header.set_size(content.len() as u64);
        header.set_path(format!("{key}.{entry}")).map_err(IoError::at(shard))?;
        header.set_cksum();
        bytes.extend_from_slice(header.as_bytes());
        bytes.extend_from_slice(content);
        bytes.resize(bytes.len().next_multiple_of(BLOCK as usize), 0);
    }
    Ok(bytes)
}

/// Bytes of an entry within its shard.
#[derive(Clone, Copy)]
struct Span {
    offset: u64,
    size: u64,
}

/// Where the entries of an object lie.
struct Sample {
    key: Box<str>,
    metadata: Span,
    cameras: Span,
    gaussians: Span,
    format: ImageFormat,
    views: Box<[Span]>,
}

impl Sample {
    fn object(&self, path: &Path, depths: &[u32], mut fetch: impl Fetch) -> Result<Object, DataError> {
        let place = EntryOfShard { shard: path, sample: &self.key, entry: METADATA };
        let cameras = fetch(self.cameras)?;
        let cameras = sample::decode_cameras(&cameras, self.views.len(), place.of(CAMERAS))?;
        let gaussians = fetch(self.gaussians)?;
        let slices = sample::decode_slices(&gaussians, depths, place.of(GAUSSIANS))?;
        let fitted = sample::decode_metadata(&fetch(self.metadata)?, place)?.input_fits;
        let input_fits = sample::decode_fits(&gaussians, &fitted, self.views.len(), place.of(GAUSSIANS))?;
        let views = cameras.into_iter().zip(&self.views).enumerate().map(|(k, ((name, camera), &span))| {
            let bytes = fetch(span)?;
            let entry = sample::view_entry(k, self.format);
            sample::decode_view(&bytes, self.format, name, camera, place.of(&entry))
        });
        Ok(Object { id: self.key.to_string(), views: views.collect::<Result<_, _>>()?, slices, input_fits })
    }

    fn metadata(&self, path: &Path, mut fetch: impl Fetch) -> Result<Metadata, DataError> {
        let place = EntryOfShard { shard: path, sample: &self.key, entry: METADATA };
        sample::decode_metadata(&fetch(self.metadata)?, place)
    }

    fn leaves(&self, path: &Path, mut fetch: impl Fetch) -> Result<Option<Gaussians>, DataError> {
        let place = EntryOfShard { shard: path, sample: &self.key, entry: GAUSSIANS };
        sample::decode_leaves(&fetch(self.gaussians)?, place)
    }
}

/// Gives the bytes of an entry.
trait Fetch: FnMut(Span) -> Result<Vec<u8>, DataError> {}
impl<F: FnMut(Span) -> Result<Vec<u8>, DataError>> Fetch for F {}

/// The entries of one object, read as a whole.
pub struct ObjectBytes {
    path: PathBuf,
    bytes: Vec<u8>,
    sample: Sample,
}

impl ObjectBytes {
    /// `bytes`: those of the object `key` in the shard `path`, which only messages name.
    ///
    /// # Errors
    /// [`DataError::File`] where they are not.
    pub fn new(bytes: Vec<u8>, key: &str, path: PathBuf) -> Result<Self, DataError> {
        let samples = index(Cursor::new(&bytes), bytes.len() as u64, &path, false)?;
        let found = samples.iter().map(|s| s.key.as_ref()).collect::<Vec<_>>().join(", ");
        match samples.into_iter().next().filter(|s| *s.key == *key && found == key) {
            Some(sample) => Ok(Self { path, bytes, sample }),
            None => {
                let problem = format!("expected the entries of object {key}, found those of {found:?}");
                Err(DataError::File { path, problem })
            }
        }
    }

    fn fetch(&self) -> impl Fetch {
        // The index has checked that spans lie within the bytes.
        |s: Span| Ok(self.bytes[s.offset as usize..(s.offset + s.size) as usize].to_vec())
    }

    /// The object, with its slices at `depths`.
    ///
    /// # Errors
    /// [`DataError::Sample`] for a broken entry.
    pub fn object(&self, depths: &[u32]) -> Result<Object, DataError> {
        self.sample.object(&self.path, depths, self.fetch())
    }

    /// What is known of it besides its views and Gaussians.
    ///
    /// # Errors
    /// [`DataError::Sample`] for a broken entry.
    pub fn metadata(&self) -> Result<Metadata, DataError> {
        self.sample.metadata(&self.path, self.fetch())
    }

    /// The Gaussians before the tree, where they are kept.
    ///
    /// # Errors
    /// [`DataError::Sample`] for a broken entry.
    pub fn leaves(&self) -> Result<Option<Gaussians>, DataError> {
        self.sample.leaves(&self.path, self.fetch())
    }
}

/// A shard whose objects can be read in any order, with or without a manifest.
pub struct ShardReader {
    path: PathBuf,
    bytes: Option<Vec<u8>>, // none: they are in the file
    samples: Vec<Sample>,
}

impl ShardReader {
    /// Reads the headers of all entries.
    ///
    /// # Errors
    /// [`DataError::Sample`] or [`DataError::File`] where the file is no whole shard; [`DataError::Io`].
    pub fn open(path: &Path) -> Result<Self, DataError> {
        let file = File::open(path).map_err(IoError::at(path))?;
        let length = file.metadata().map_err(IoError::at(path))?.len();
        Ok(Self { path: path.into(), bytes: None, samples: index(BufReader::new(file), length, path, true)? })
    }

    /// As [`open`](Self::open), of a shard in memory. Messages call it `path`.
    ///
    /// # Errors
    /// [`DataError::Sample`] or [`DataError::File`] where the bytes are no whole shard.
    pub fn from_bytes(path: &Path, bytes: Vec<u8>) -> Result<Self, DataError> {
        let samples = index(Cursor::new(&bytes), bytes.len() as u64, path, true)?;
        Ok(Self { path: path.into(), bytes: Some(bytes), samples })
    }

    /// Number of objects.
    pub fn len(&self) -> usize {
        self.samples.len()
    }

    /// Whether there is no object.
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// Name of object number `i`, if there is one.
    pub fn id(&self, i: usize) -> Option<&str> {
        self.samples.get(i).map(|s| s.key.as_ref())
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
        self.samples[i].object(&self.path, depths, self.fetch()?)
    }

    /// The Gaussians of object number `i` before the tree, where the shard keeps them.
    ///
    /// # Errors
    /// [`DataError::Sample`] for a broken entry; [`DataError::Io`].
    ///
    /// # Panics
    /// If there is no such object.
    pub fn leaves(&self, i: usize) -> Result<Option<Gaussians>, DataError> {
        self.samples[i].leaves(&self.path, self.fetch()?)
    }

    /// What else is known of object number `i`.
    ///
    /// # Errors
    /// [`DataError::Sample`] for a broken entry; [`DataError::Io`].
    ///
    /// # Panics
    /// If there is no such object.
    pub fn metadata(&self, i: usize) -> Result<Metadata, DataError> {
        self.samples[i].metadata(&self.path, self.fetch()?)
    }

    fn fetch(&self) -> Result<impl Fetch + '_, DataError> {
        let mut file = match self.bytes {
            None => Some(File::open(&self.path).map_err(IoError::at(&self.path))?),
            Some(_) => None,
        };
        Ok(move |span: Span| {
            // The index has checked spans against the size of file or bytes.
            let Some(file) = &mut file else {
                let bytes = self.bytes.as_deref().unwrap_or_default();
                return Ok(bytes[span.offset as usize..(span.offset + span.size) as usize].to_vec());
            };
            let mut bytes = vec![0; span.size as usize];
            file.seek(SeekFrom::Start(span.offset))
                .and_then(|_| file.read_exact(&mut bytes))
                .map_err(IoError::at(&self.path))?;
            Ok(bytes)
        })
    }
}

/// Where the objects of a tar file of `length` bytes lie. `whole`: whether the tar file's end must be there.
fn index(reader: impl Read + Seek, length: u64, path: &Path, whole: bool) -> Result<Vec<Sample>, DataError> {
    let problem = |problem: String| DataError::File { path: path.into(), problem };
    let mut archive = tar::Archive::new(reader);
    let mut draft: Option<Draft> = None;
    let mut keys = HashSet::new();
    let mut samples = Vec::new();
    let mut end = 0;
    // Raw: names beyond 100 bytes and the like are not written here, and need memory that the file decides on.
    for entry in archive.entries_with_seek().map_err(IoError::at(path))?.raw(true) {
        let entry = entry.map_err(|e| problem(format!("not a tar file from byte {end}: {e}")))?;
        let bytes = entry.path_bytes();
        let name = std::str::from_utf8(&bytes).ok().and_then(|n| n.split_once('.')).filter(|(k, _)| sample::is_key(k));
        let Some((key, rest)) = name else {
            return Err(problem(format!("expected entries called KEY.*, found {:?}", String::from_utf8_lossy(&bytes))));
        };
        let place = EntryOfShard { shard: path, sample: key, entry: rest };
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
    let expected = end + if whole { END.len() as u64 } else { 0 };
    if length < expected {
        return Err(problem(format!("expected at least {expected} bytes, found {length}: the shard is cut off")));
    }
    Ok(samples)
}

/// An object of which some entries have been seen.
#[derive(Default)]
struct Draft {
    key: String,
    metadata: Option<Span>,
    cameras: Option<Span>,
    gaussians: Option<Span>,
    format: Option<ImageFormat>,
    views: Vec<Span>,
}

impl Draft {
    fn add(&mut self, name: &str, span: Span, place: EntryOfShard) -> Result<(), DataError> {
        let next = |format| sample::view_entry(self.views.len(), format);
        let is_view = |format| self.format.is_none_or(|f| f == format) && name == next(format);
        if let Some(format) = [ImageFormat::Webp, ImageFormat::Png].into_iter().find(|f| is_view(*f))
            && self.views.len() < MAX_VIEWS
        {
            self.format = Some(format);
            self.views.push(span);
            return Ok(());
        }
        let next = next(self.format.unwrap_or_default());
        let slot = match name {
            METADATA => &mut self.metadata,
            CAMERAS => &mut self.cameras,
            GAUSSIANS => &mut self.gaussians,
            _ => return Err(place.error(format!("{METADATA}, {CAMERAS}, {GAUSSIANS} or {next}"), name)),
        };
        match slot.replace(span) {
            None => Ok(()),
            Some(_) => Err(place.error("one such entry", "a second one")),
        }
    }

    fn finish(self, shard: &Path) -> Result<Sample, DataError> {
        let need = |span: Option<Span>, entry| {
            span.ok_or_else(|| EntryOfShard { shard, sample: &self.key, entry }.error("this entry", "none"))
        };
        let (metadata, cameras) = (need(self.metadata, METADATA)?, need(self.cameras, CAMERAS)?);
        let gaussians = need(self.gaussians, GAUSSIANS)?;
        let format = self.format.unwrap_or_default();
        need(self.views.first().copied(), &sample::view_entry(0, format))?;
        Ok(Sample { metadata, cameras, gaussians, format, views: self.views.into(), key: self.key.into() })
    }
}
