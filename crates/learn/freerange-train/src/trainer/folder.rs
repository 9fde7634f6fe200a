//! A run's folder belongs to one run.

use std::{
    fs::{File, TryLockError},
    io::Write,
    path::{Path, PathBuf},
};

use freerange_data::Making;
use freerange_model::EncoderConfig;
use freerange_util::{IoError, write_atomically};

use crate::{TrainError, config::TrainConfig, inherit::is_path};

/// Makes the folder of a run, or refuses that of another one, or one in which another process trains. The folder is this
/// process's until the lock is dropped.
pub(super) fn claim<M: Making>(config: &TrainConfig<M>, folder: &Path) -> Result<File, TrainError> {
    std::fs::create_dir_all(folder).map_err(IoError::at(folder))?;
    let lock = lock(folder)?;
    check_same_run(config, folder)?;
    Ok(lock)
}

/// Two processes would remove each other's states.
fn lock(folder: &Path) -> Result<File, TrainError> {
    let path = folder.join(".lock");
    let file = File::create(&path).map_err(IoError::at(&path))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => {
            let problem = "expected a folder of its own for each run, found that another process trains in it".into();
            Err(TrainError::State { path: folder.into(), problem })
        }
        Err(TryLockError::Error(source)) => Err(IoError { path, source }.into()),
    }
}

/// A run's folder holds its configuration: going on with another one would mix two runs.
fn check_same_run<M: Making>(config: &TrainConfig<M>, folder: &Path) -> Result<(), TrainError> {
    let path = folder.join("config.toml");
    let mut kept = config.clone();
    // Whoever reads that file, or goes on with the run from another folder, must find the same shards.
    kept.data.shards = kept.data.shards.map(|place| local(&place, |path| std::path::absolute(path)));
    if let EncoderConfig::Dinov2(encoder) = &mut kept.model.encoder {
        encoder.weights = encoder.weights.take().map(|place| local(&place, |path| std::path::absolute(path)));
    }
    let text =
        toml::to_string_pretty(&kept).map_err(|e| TrainError::State { path: path.clone(), problem: e.to_string() })?;
    match std::fs::read_to_string(&path) {
        Ok(old) => {
            let old: TrainConfig<M> =
                toml::from_str(&old).map_err(|e| TrainError::State { path: path.clone(), problem: e.to_string() })?;
            // Running longer is no other run; neither is sampling, measuring or averaging otherwise, or with more threads.
            let essence = |c: &TrainConfig<M>| {
                let mut c = c.clone();
                c.stages.iter_mut().for_each(|s| s.steps = 0);
                c.sample = Default::default();
                c.refiner = None;
                c.data.workers = 0;
                // The weights may have moved; the state knows which ones they are.
                if let EncoderConfig::Dinov2(encoder) = &mut c.model.encoder {
                    encoder.weights = None;
                }
                c.data.shards = c.data.shards.map(|place| local(&place, |path| path.canonicalize()));
                c.optimizer.compute = Default::default();
                c.optimizer.all_reduce_dtype = Default::default();
                c.optimizer.schedule = Default::default();
                // A rate that is brought down wants an average that follows it.
                c.optimizer.ema = Default::default();
                c.validation = Default::default();
                c
            };
            if essence(&old) != essence(config) {
                let problem = "the folder belongs to a run with another configuration: choose another folder".into();
                return Err(TrainError::State { path, problem });
            }
        }
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {}
        Err(e) => return Err(IoError::at(&path)(e).into()),
    }
    Ok(write_atomically(&path, |file| file.write_all(text.as_bytes())).map_err(IoError::at(&path))?)
}

/// The path of a folder otherwise said by `say`; URLs and the like, and what cannot be said, as they are.
fn local(place: &str, say: impl Fn(&Path) -> std::io::Result<PathBuf>) -> String {
    let path = is_path(place).then(|| say(Path::new(place)).ok()).flatten();
    path.and_then(|path| path.to_str().map(str::to_owned)).unwrap_or_else(|| place.to_owned())
}
