//! The log of a training run: JSON lines that never say a step twice.

use std::{
    fs::File,
    io::{BufWriter, Write},
    path::{Path, PathBuf},
};

use freerange_util::{IoError, write_atomically};

use crate::TrainError;

/// `log.jsonl` of a run, open for further lines. Every line has a field `step`.
#[derive(Debug)]
pub struct Log {
    path: PathBuf,
    file: BufWriter<File>,
}

impl Log {
    /// Opens the log of a run that is at `step` and made its last measurement after step `measured`. Lines of what came
    /// later, which a killed process did without saving its state, and a line that it did not finish go away.
    ///
    /// # Errors
    /// [`TrainError::Io`].
    pub fn open(path: &Path, step: u64, measured: u64) -> Result<Self, TrainError> {
        let old = match std::fs::read(path) {
            Ok(old) => old,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Vec::new(),
            Err(e) => return Err(IoError::at(path)(e).into()),
        };
        let lines = old.split_inclusive(|&b| b == b'\n');
        let kept: Vec<&[u8]> = lines.filter(|line| is_known(line, step, measured)).collect();
        if kept.iter().map(|line| line.len()).sum::<usize>() < old.len() {
            write_atomically(path, |file| kept.iter().try_for_each(|line| file.write_all(line)))
                .map_err(IoError::at(path))?;
        }
        let file = File::options().create(true).append(true).open(path).map_err(IoError::at(path))?;
        Ok(Self { path: path.into(), file: BufWriter::new(file) })
    }

    /// Adds a line.
    ///
    /// # Errors
    /// [`TrainError::Io`].
    pub fn add(&mut self, line: &impl serde::Serialize) -> Result<(), TrainError> {
        let added = serde_json::to_writer(&mut self.file, line).map_err(std::io::Error::from);
        added.and_then(|()| self.file.write_all(b"\n")).map_err(|e| self.failed(e))
    }

    /// Makes the lines so far permanent.
    ///
    /// # Errors
    /// [`TrainError::Io`].
    pub fn sync(&mut self) -> Result<(), TrainError> {
        let done = self.file.flush().and_then(|()| self.file.get_ref().sync_data());
        done.map_err(|e| self.failed(e))
    }

    fn failed(&self, source: std::io::Error) -> TrainError {
        IoError::at(&self.path)(source).into()
    }
}

/// Whether this is a whole line of a step up to `last`, or of a measurement up to `measured`.
fn is_known(line: &[u8], last: u64, measured: u64) -> bool {
    #[derive(serde::Deserialize)]
    struct Line {
        step: u64,
        validation: Option<serde::de::IgnoredAny>,
    }
    let known = |line: Line| line.step <= if line.validation.is_some() { measured } else { last };
    line.ends_with(b"\n") && serde_json::from_slice(line).is_ok_and(known)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_resumed_log_says_every_step_once_and_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.jsonl");
        let line = |step: u64| serde_json::json!({ "step": step, "loss": 0.5 });
        let mut log = Log::open(&path, 0, 0).unwrap();
        (1..=3).for_each(|step| log.add(&line(step)).unwrap());
        log.sync().unwrap();
        let saved = std::fs::read(&path).unwrap();
        // Killed after a measurement, a step more, and in the middle of a line.
        log.add(&serde_json::json!({ "step": 3, "validation": { "psnr": 20.0 } })).unwrap();
        log.add(&line(4)).unwrap();
        drop(log);
        let mut torn = std::fs::read(&path).unwrap();
        torn.extend(b"{\"step\":2,\"lo");
        std::fs::write(&path, torn).unwrap();

        let mut log = Log::open(&path, 3, 0).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), saved);
        log.add(&line(4)).unwrap();
        drop(log);
        let text = std::fs::read_to_string(&path).unwrap();
        let steps: Vec<u64> = text
            .lines()
            .map(|l| serde_json::from_str::<serde_json::Value>(l).unwrap()["step"].as_u64().unwrap())
            .collect();
        assert_eq!(steps, [1, 2, 3, 4]);
    }
}
