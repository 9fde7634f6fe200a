//! Results: as files of all formats, as rows, and with some of their Gaussians left out.

use std::{
    fs,
    path::{Path, PathBuf},
    sync::{Arc, PoisonError, atomic::Ordering::Relaxed},
};

use freerange_gaussians::formats::{Format, Frame, WriteOptions, encode};
use freerange_gaussians::read_ply;
use freerange_util::write_atomically;
use glam::DVec3;

use super::{Board, no_such, table::bytes};
use crate::{
    Refusal,
    record::{State, sample_file},
};

/// The Gaussians that the run made, where some of them were left out since.
fn whole_file(folder: &Path, i: usize) -> PathBuf {
    folder.join(format!("sample-{i}-whole.ply"))
}

/// Which of those are kept: a byte for each, 0 or 1.
fn kept_file(folder: &Path, i: usize) -> PathBuf {
    folder.join(format!("sample-{i}-kept.bin"))
}

/// Forgets what was left out of earlier results.
pub(super) fn forget_edits(folder: &Path, samples: usize) {
    for i in 0..samples {
        for file in [whole_file(folder, i), kept_file(folder, i)] {
            if let Err(e) = fs::remove_file(&file)
                && e.kind() != std::io::ErrorKind::NotFound
            {
                tracing::warn!("{}: {e}", file.display());
            }
        }
    }
}

/// Bytes of memory that a byte of a result takes while it is read, converted and sent: formats of text take the most.
const MEMORY_PER_BYTE: u64 = 8;

/// Memory for a result, from before it is read until it is sent, or for a body that arrives.
pub struct Held {
    board: Arc<Board>,
    bytes: u64,
}

impl Held {
    /// For sample `i` of a job. Refused while other results take all the memory that there is for them; one can always be had.
    pub fn take(board: &Arc<Board>, id: &str, i: usize) -> Result<Self, Refusal> {
        let (folder, ..) = board.with_sample(id, i)?;
        let size = |file: PathBuf| fs::metadata(file).map_or(0, |data| data.len());
        let bytes = MEMORY_PER_BYTE * size(sample_file(&folder, i)).max(size(whole_file(&folder, i)));
        Self::bytes(board, bytes)
    }

    /// For so many bytes, such as those of a body, before the first of them is read. Refused as [`take`](Self::take) is.
    pub fn bytes(board: &Arc<Board>, bytes: u64) -> Result<Self, Refusal> {
        let before = board.held.fetch_add(bytes, Relaxed);
        let held = Self { board: board.clone(), bytes };
        match before == 0 || before + bytes <= board.limits.memory {
            true => Ok(held),
            false => Err(Refusal::new(503, "the server sends other results now: try again in a moment")),
        }
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        self.board.held.fetch_sub(self.bytes, Relaxed);
    }
}

impl Board {
    /// The folder, up and title of a job that has a sample `i`.
    fn with_sample(&self, id: &str, i: usize) -> Result<(PathBuf, [f64; 3], String), Refusal> {
        let table = self.table();
        let job = table.jobs.get(id).ok_or_else(no_such)?;
        if i >= job.record.samples.len() {
            return Err(Refusal::new(404, "this job has no such sample"));
        }
        Ok((job.folder.clone(), job.record.up, job.record.title.clone()))
    }

    /// Sample `i` of a result as a file.
    pub fn result(&self, id: &str, i: usize, format: Format) -> Result<(Vec<u8>, String), Refusal> {
        let (folder, up, title) = self.with_sample(id, i)?;
        let splats = read_ply(&sample_file(&folder, i)).map_err(Refusal::own)?.splats;
        let frame = Frame::with_up(DVec3::from_array(up)).unwrap_or_default();
        let options = WriteOptions { frame, ..WriteOptions::default() };
        let encoded = encode(&splats, format, &options).map_err(Refusal::own)?;
        // The title of a file of Gaussians is its name.
        let stem = title.rsplit_once('.').filter(|(_, end)| Format::from_extension(end).is_some());
        let stem = stem.map_or(&*title, |(stem, _)| stem);
        // Nothing of a client's name may end the header or name a folder.
        let plain: String = stem.chars().filter(|c| c.is_ascii_alphanumeric() || "-_".contains(*c)).take(40).collect();
        let plain = if plain.is_empty() { "gaussians".to_owned() } else { plain };
        Ok((encoded.bytes, format!("{plain}-{i}.{format}")))
    }

    /// Rows of the Gaussians of sample `i` of a result.
    pub fn rows(&self, id: &str, i: usize) -> Result<Vec<u8>, Refusal> {
        let (folder, ..) = self.with_sample(id, i)?;
        Ok(bytes(&read_ply(&sample_file(&folder, i)).map_err(Refusal::own)?.splats.cloud))
    }

    /// Rows of all Gaussians that the run made of sample `i`.
    pub fn whole_rows(&self, id: &str, i: usize) -> Result<Vec<u8>, Refusal> {
        let (folder, ..) = self.with_sample(id, i)?;
        let whole = Some(whole_file(&folder, i)).filter(|file| file.is_file());
        let file = whole.unwrap_or_else(|| sample_file(&folder, i));
        Ok(bytes(&read_ply(&file).map_err(Refusal::own)?.splats.cloud))
    }

    /// Which Gaussians of [`Self::whole_rows`] are kept: a byte for each.
    pub fn kept(&self, id: &str, i: usize) -> Result<Vec<u8>, Refusal> {
        let (folder, ..) = self.with_sample(id, i)?;
        match fs::read(kept_file(&folder, i)) {
            Ok(kept) => Ok(kept),
            Err(_) => {
                let cloud = read_ply(&sample_file(&folder, i)).map_err(Refusal::own)?.splats.cloud;
                Ok(vec![1; cloud.len()])
            }
        }
    }

    /// Keeps some of the Gaussians that the run made of sample `i`: a byte for each, 0 or 1. Files of all formats follow. Returns their number.
    pub fn keep(&self, id: &str, i: usize, kept: &[u8]) -> Result<usize, Refusal> {
        let _one = self.editing.lock().unwrap_or_else(PoisonError::into_inner);
        let (folder, ..) = self.with_sample(id, i)?;
        let busy = self.table().jobs.get(id).map(|j| j.record.state).filter(|state| *state != State::Done);
        if let Some(state) = busy {
            return Err(Refusal::new(409, format!("this job is {}: its result cannot be changed now", state.name())));
        }
        let (shown, whole) = (sample_file(&folder, i), whole_file(&folder, i));
        let from = if whole.is_file() { &whole } else { &shown };
        let read = read_ply(from).map_err(Refusal::own)?;
        let (cloud, splats) = (&read.splats.cloud, &read.splats);
        if kept.len() != cloud.len() || kept.iter().any(|v| *v > 1) {
            let text = format!("body: expected {} bytes, each 0 or 1, found {} bytes", cloud.len(), kept.len());
            return Err(Refusal::new(422, text));
        }
        let chosen: Vec<usize> = (0..kept.len()).filter(|k| kept[*k] == 1).collect();
        if chosen.is_empty() {
            return Err(Refusal::new(422, "body: expected some Gaussians that are kept, found none"));
        }
        if !whole.is_file() {
            let all = fs::read(&shown).map_err(Refusal::own)?;
            write_atomically(&whole, |w| std::io::Write::write_all(w, &all)).map_err(Refusal::own)?;
        }
        write_atomically(&kept_file(&folder, i), |w| std::io::Write::write_all(w, kept)).map_err(Refusal::own)?;
        let frame = read.up.and_then(Frame::with_up).unwrap_or_default();
        let options = WriteOptions { frame, ..WriteOptions::default() };
        let encoded = encode(&splats.select(&chosen), Format::Ply, &options).map_err(Refusal::own)?;
        write_atomically(&shown, |w| std::io::Write::write_all(w, &encoded.bytes)).map_err(Refusal::own)?;
        self.change(id, |job| {
            if let Some(sample) = job.record.samples.get_mut(i) {
                sample.gaussians = chosen.len();
            }
            Ok(chosen.len())
        })
    }
}
