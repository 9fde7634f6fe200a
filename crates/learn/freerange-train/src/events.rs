//! The log of a training run for TensorBoard: event files that never say a step twice.
//!
//! An event file is a sequence of records (TFRecord: length, checksum, bytes, checksum), each a protocol-buffer message `Event`. What is
//! written of these are five fields of three messages.

use std::{
    fs::File,
    io::{BufWriter, Write},
    path::{Path, PathBuf},
    time::{Duration, Instant, SystemTime},
};

use freerange_util::{IoError, write_atomically};
use image::RgbaImage;

use crate::TrainError;

/// Between two times that a reader is given what was added.
const FLUSH: Duration = Duration::from_secs(5);

/// Event files of a run, open for further events.
///
/// A file is named for the step that its process started at, so that readers, which take files in the order of their names, find steps in order.
#[derive(Debug)]
pub struct Events {
    path: PathBuf,
    file: BufWriter<File>,
    flushed: Instant,
}

impl Events {
    /// Opens the events of a run that is at `step`, in its folder. What earlier processes wrote of later steps, without saving their state, and
    /// a record that they did not finish go away.
    ///
    /// # Errors
    /// [`TrainError::Io`].
    pub fn open(folder: &Path, step: u64) -> Result<Self, TrainError> {
        for entry in std::fs::read_dir(folder).map_err(IoError::at(folder))? {
            let path = entry.map_err(IoError::at(folder))?.path();
            let Some(first) = path.file_name().and_then(|name| first_step(name.to_str()?)) else { continue };
            if first >= step {
                std::fs::remove_file(&path).map_err(IoError::at(&path))?;
                continue;
            }
            let old = std::fs::read(&path).map_err(IoError::at(&path))?;
            let kept: Vec<&[u8]> = Records(&old).filter(|record| step_of(record).is_some_and(|s| s <= step)).collect();
            if kept.iter().map(|record| record.len()).sum::<usize>() < old.len() {
                let written = write_atomically(&path, |file| kept.iter().try_for_each(|r| file.write_all(r)));
                written.map_err(IoError::at(&path))?;
            }
        }
        let path = folder.join(format!("{NAME}{step:010}{OURS}"));
        let file = BufWriter::new(File::create(&path).map_err(IoError::at(&path))?);
        let mut events = Self { path, file, flushed: Instant::now() };
        // Every file begins with its version.
        events.add(step, |event| event.bytes(3, b"brain.Event:2"))?;
        Ok(events)
    }

    /// Adds every number of `figures` (a struct of them) as a curve `group/FIELD`; what is not finite is a gap.
    ///
    /// # Errors
    /// [`TrainError::Io`].
    pub fn scalars(&mut self, step: u64, group: &str, figures: &impl serde::Serialize) -> Result<(), TrainError> {
        let value = serde_json::to_value(figures).map_err(|e| self.failed(e.into()))?;
        let mut summary = Message::default();
        for (field, value) in value.as_object().into_iter().flatten().filter(|(field, _)| *field != "step") {
            // JSON has no word for them.
            let number = if value.is_null() { Some(f64::NAN) } else { value.as_f64() };
            if let Some(number) = number {
                let mut value = Message::default();
                value.bytes(1, format!("{group}/{field}").as_bytes());
                value.float(2, number as f32);
                summary.bytes(1, &value.0);
            }
        }
        self.add(step, |event| event.bytes(5, &summary.0))
    }

    /// Adds a picture.
    ///
    /// # Errors
    /// [`TrainError::Io`].
    pub fn picture(&mut self, step: u64, tag: &str, picture: &RgbaImage) -> Result<(), TrainError> {
        let mut png = std::io::Cursor::new(Vec::new());
        let encoded = picture.write_to(&mut png, image::ImageFormat::Png);
        encoded.map_err(|e| self.failed(std::io::Error::other(e)))?;
        let mut image = Message::default();
        image.number(1, picture.height().into());
        image.number(2, picture.width().into());
        image.number(3, 4); // channels
        image.bytes(4, png.get_ref());
        let mut value = Message::default();
        value.bytes(1, tag.as_bytes());
        value.bytes(4, &image.0);
        let mut summary = Message::default();
        summary.bytes(1, &value.0);
        self.add(step, |event| event.bytes(5, &summary.0))
    }

    /// Makes the events so far permanent.
    ///
    /// # Errors
    /// [`TrainError::Io`].
    pub fn sync(&mut self) -> Result<(), TrainError> {
        let done = self.file.flush().and_then(|()| self.file.get_ref().sync_data());
        done.map_err(|e| self.failed(e))
    }

    fn add(&mut self, step: u64, what: impl FnOnce(&mut Message)) -> Result<(), TrainError> {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let mut event = Message::default();
        event.double(1, now.as_secs_f64());
        event.number(2, step);
        what(&mut event);
        let mut written = self.file.write_all(&record(&event.0));
        if self.flushed.elapsed() > FLUSH {
            written = written.and_then(|()| self.file.flush());
            self.flushed = Instant::now();
        }
        written.map_err(|e| self.failed(e))
    }

    fn failed(&self, source: std::io::Error) -> TrainError {
        IoError::at(&self.path)(source).into()
    }
}

/// What readers know event files by.
const NAME: &str = "events.out.tfevents.";
/// And we ours.
const OURS: &str = ".freerange";

/// The step that a file of ours begins after.
fn first_step(name: &str) -> Option<u64> {
    name.strip_prefix(NAME)?.strip_suffix(OURS)?.parse().ok()
}

/// A message of protocol buffers, as its bytes.
#[derive(Debug, Default)]
struct Message(Vec<u8>);

impl Message {
    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    fn key(&mut self, field: u64, wire: u64) {
        self.varint(field << 3 | wire);
    }

    fn number(&mut self, field: u64, value: u64) {
        self.key(field, 0);
        self.varint(value);
    }

    fn double(&mut self, field: u64, value: f64) {
        self.key(field, 1);
        self.0.extend(value.to_le_bytes());
    }

    fn bytes(&mut self, field: u64, value: &[u8]) {
        self.key(field, 2);
        self.varint(value.len() as u64);
        self.0.extend(value);
    }

    fn float(&mut self, field: u64, value: f32) {
        self.key(field, 5);
        self.0.extend(value.to_le_bytes());
    }
}

/// Bytes of a record before its data: length, and the length's checksum.
const HEAD: usize = 12;

fn record(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    let mut record = Vec::with_capacity(HEAD + data.len() + 4);
    record.extend(length);
    record.extend(masked_crc(&length).to_le_bytes());
    record.extend(data);
    record.extend(masked_crc(data).to_le_bytes());
    record
}

/// The whole and sound records at the beginning of a file.
struct Records<'a>(&'a [u8]);

impl<'a> Iterator for Records<'a> {
    type Item = &'a [u8];

    fn next(&mut self) -> Option<&'a [u8]> {
        let length = usize::try_from(u64::from_le_bytes(*self.0.first_chunk()?)).ok()?;
        let (found, rest) = self.0.split_at_checked(length.checked_add(HEAD + 4)?)?;
        let data = &found[HEAD..found.len() - 4];
        self.0 = rest;
        (record(data) == found).then_some(found)
    }
}

/// The step of a record of ours: its second field, after the time.
fn step_of(record: &[u8]) -> Option<u64> {
    let rest = record.get(HEAD + 9..record.len() - 4)?.strip_prefix(&[2 << 3])?;
    let mut step = 0;
    for (i, byte) in rest.iter().take(10).enumerate() {
        step |= u64::from(byte & 0x7f) << (7 * i);
        if byte & 0x80 == 0 {
            return Some(step);
        }
    }
    None
}

/// The checksum that records have: a checksum of data that holds checksums would be a weak one unmasked.
fn masked_crc(data: &[u8]) -> u32 {
    crc32c(data).rotate_right(15).wrapping_add(0xa282_ead8)
}

/// CRC-32C (Castagnoli), as in RFC 3720.
fn crc32c(data: &[u8]) -> u32 {
    const TABLE: [u32; 256] = {
        let mut table = [0; 256];
        let mut i = 0;
        while i < 256 {
            let (mut crc, mut bit) = (i as u32, 0);
            while bit < 8 {
                crc = if crc & 1 == 1 { crc >> 1 ^ 0x82f6_3b78 } else { crc >> 1 };
                bit += 1;
            }
            table[i] = crc;
            i += 1;
        }
        table
    };
    !data.iter().fold(!0, |crc, byte| crc >> 8 ^ TABLE[(crc as u8 ^ byte) as usize])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksums_are_the_standards() {
        // RFC 3720, appendix B.4, and the usual check value.
        let ascending: Vec<u8> = (0..32).collect();
        let descending: Vec<u8> = (0..32).rev().collect();
        for (data, crc) in [
            (&[0; 32][..], 0x8a91_36aa),
            (&[0xff; 32], 0x62a8_ab43),
            (&ascending, 0x46dd_794e),
            (&descending, 0x113f_db5c),
            (b"123456789", 0xe306_9283),
            (b"", 0),
        ] {
            assert_eq!(crc32c(data), crc);
        }
        // As TensorBoard has it of the length that files begin with.
        assert_eq!(masked_crc(&24u64.to_le_bytes()), 0x224b_7fa3);
    }

    #[derive(serde::Serialize)]
    struct Figures {
        step: u64,
        loss: f32,
        norm: f32,
    }

    fn steps(folder: &Path) -> Vec<u64> {
        let mut files: Vec<PathBuf> = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
        files.sort();
        let mut steps = Vec::new();
        for file in files {
            let bytes = std::fs::read(file).unwrap();
            // The first is the version.
            steps.extend(Records(&bytes).skip(1).map(|record| step_of(record).unwrap()));
            assert_eq!(Records(&bytes).map(<[u8]>::len).sum::<usize>(), bytes.len(), "no torn record is left");
        }
        steps
    }

    #[test]
    fn resumed_events_say_every_step_once_and_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path();
        let write = |events: &mut Events, step: u64| {
            events.scalars(step, "train", &Figures { step, loss: 0.5, norm: f32::NAN }).unwrap();
        };
        let mut events = Events::open(path, 0).unwrap();
        (1..=300).for_each(|step| write(&mut events, step));
        events.picture(300, "validation/sample", &RgbaImage::new(3, 2)).unwrap();
        drop(events);
        // Killed after its state of step 298, in the middle of a record.
        let file = path.join("events.out.tfevents.0000000000.freerange");
        let bytes = std::fs::read(&file).unwrap();
        std::fs::write(&file, &bytes[..bytes.len() - 7]).unwrap();
        let mut events = Events::open(path, 298).unwrap();
        (299..=301).for_each(|step| write(&mut events, step));
        drop(events);
        assert_eq!(steps(path), (1..=301).collect::<Vec<_>>());
        // Killed again before it saved anything; then everything from the start.
        let mut events = Events::open(path, 298).unwrap();
        write(&mut events, 299);
        drop(events);
        assert_eq!(steps(path), (1..=299).collect::<Vec<_>>());
        drop(Events::open(path, 0).unwrap());
        assert_eq!(steps(path), [0u64; 0]);
    }

    #[test]
    fn a_record_has_the_fields_that_readers_know() {
        let folder = tempfile::tempdir().unwrap();
        let mut events = Events::open(folder.path(), 7).unwrap();
        events.scalars(8, "train", &Figures { step: 8, loss: 0.5, norm: 2.0 }).unwrap();
        drop(events);
        let bytes = std::fs::read(folder.path().join("events.out.tfevents.0000000007.freerange")).unwrap();
        let records: Vec<&[u8]> = Records(&bytes).collect();
        assert!(records[0].windows(13).any(|w| w == b"brain.Event:2"));
        let data = &records[1][HEAD + 9..records[1].len() - 4];
        let loss = [&[0x0a, 17, 0x0a, 10][..], b"train/loss", &[0x15, 0, 0, 0, 0x3f]].concat();
        let norm = [&[0x0a, 17, 0x0a, 10][..], b"train/norm", &[0x15, 0, 0, 0, 0x40]].concat();
        assert_eq!(data, [&[0x10, 8, 0x2a, 38][..], &loss, &norm].concat());
    }
}
