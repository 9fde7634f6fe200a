//! The jobs: who waits, who computes, what is there of each.

mod arriving;
mod bin;
mod orders;
mod read;
mod results;
mod search;
mod shown;
mod table;
mod work;

use std::{
    fs::{self, File, TryLockError},
    path::{Path, PathBuf},
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering::Relaxed},
    },
    time::Instant,
};

use freerange_util::IoError;

use self::table::{Job, Table};
pub use self::{arriving::Submission, results::Held};
use crate::{
    Engine, JobOptions, Limits, Refusal, ServeError,
    disk::size_of,
    metrics::Metrics,
    record::{Record, State},
    scene,
};

/// All jobs of a server.
pub struct Board {
    root: PathBuf,
    temporary: Mutex<Option<tempfile::TempDir>>,
    keeps: bool,
    lock: File,
    limits: Limits,
    engine: Arc<dyn Engine>,
    table: Mutex<Table>,
    changed: Condvar,
    editing: Mutex<()>,
    doomed: Mutex<Vec<PathBuf>>,
    doom_changed: Condvar,
    stopping: AtomicBool,
    /// Bytes of memory that results take which are on their way to clients.
    held: AtomicU64,
    pub metrics: Metrics,
}

impl Board {
    /// Opens the folder of jobs, and finds what an earlier server left there.
    pub fn open(keep: Option<&Path>, limits: Limits, engine: Arc<dyn Engine>) -> Result<Self, ServeError> {
        let (root, temporary) = match keep {
            Some(folder) => {
                fs::create_dir_all(folder).map_err(IoError::at(folder))?;
                (folder.to_path_buf(), None)
            }
            None => {
                let folder = tempfile::Builder::new().prefix("freerange-serve-").tempdir();
                let folder = folder.map_err(IoError::at(&std::env::temp_dir()))?;
                (folder.path().to_path_buf(), Some(folder))
            }
        };
        let lock_path = root.join(".freerange-serve.lock");
        let lock = File::create(&lock_path).map_err(IoError::at(&lock_path))?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let source = std::io::Error::other("another server keeps its jobs here");
                return Err(IoError { path: root, source }.into());
            }
            Err(TryLockError::Error(e)) => return Err(IoError::at(&lock_path)(e).into()),
        }
        let board = Self {
            keeps: keep.is_some(),
            root,
            temporary: Mutex::new(temporary),
            lock,
            limits,
            engine,
            table: Mutex::default(),
            changed: Condvar::new(),
            editing: Mutex::new(()),
            doomed: Mutex::default(),
            doom_changed: Condvar::new(),
            stopping: AtomicBool::new(false),
            held: AtomicU64::new(0),
            metrics: Metrics::new(),
        };
        board.recover().map_err(IoError::at(&board.root))?;
        Ok(board)
    }

    /// Takes over what an earlier server left: finished and waiting jobs as they are, others as interrupted.
    fn recover(&self) -> std::io::Result<()> {
        let mut table = self.table();
        if self.bin().is_dir() {
            // What was removed is gone for good with this start.
            fs::read_dir(self.bin())?.flatten().for_each(|entry| self.doom(entry.path()));
        }
        for entry in fs::read_dir(&self.root)? {
            let entry = entry?;
            let Ok(id) = entry.file_name().into_string() else { continue };
            if !is_id(&id) || !entry.file_type()?.is_dir() {
                continue;
            }
            let folder = entry.path();
            let mut record = match Record::read(&folder) {
                Ok(record) if record.id == id => record,
                // Nothing but files on their way is without a record; ours to clear away.
                Err(e) if e.kind() == std::io::ErrorKind::NotFound && uploads(&folder).is_dir() => {
                    clear(&folder);
                    continue;
                }
                Ok(_) => continue,
                Err(e) => {
                    tracing::warn!("{}: {e}", crate::record::file(&folder).display());
                    continue;
                }
            };
            clear(&uploads(&folder));
            if matches!(record.state, State::Uploading | State::Reading | State::Running) {
                let again = if scene::is_whole(&folder) {
                    "press go to compute it again"
                } else {
                    "its photos have to be given again"
                };
                record.error = Some(format!("the server ended while this job was {}: {again}", record.state.name()));
                record.state = State::Interrupted;
                record.write(&folder)?;
            }
            table.turns = table.turns.max(record.turn);
            let mut job = table.job(record, folder);
            job.bytes = size_of(&job.folder);
            table.jobs.insert(id, job);
        }
        Ok(())
    }

    fn table(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn engine_name(&self) -> String {
        self.engine.name()
    }

    pub fn defaults(&self) -> JobOptions {
        self.engine.defaults()
    }

    /// The options of a job that goes: what they leave out is recorded, as far as it is known. Another server may have other defaults.
    fn complete(&self, options: JobOptions) -> JobOptions {
        let known = self.defaults();
        JobOptions { quality: options.quality.or(known.quality), init: options.init.or(known.init), ..options }
    }

    pub fn camera_finder(&self) -> Result<String, String> {
        self.engine.camera_finder()
    }

    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// What makes changes of a job come one after the other. Taken before the table is.
    fn writing(&self, id: &str) -> Result<Arc<Mutex<()>>, Refusal> {
        Ok(self.table().jobs.get(id).ok_or_else(no_such)?.writing.clone())
    }

    /// Changes a job, writes its record, and tells everyone who looks. The disk may take its time: meanwhile others see the job as it was, and
    /// nobody waits for the table. A job whose next state cannot be written has failed: after the next start it would not be in that state.
    fn change<T>(&self, id: &str, change: impl FnOnce(&mut Job) -> Result<T, Refusal>) -> Result<T, Refusal> {
        let writing = self.writing(id)?;
        let _one = writing.lock().unwrap_or_else(PoisonError::into_inner);
        let (result, mut record, folder, was) = {
            let mut table = self.table();
            let job = table.jobs.get_mut(id).ok_or_else(no_such)?;
            let before = job.record.clone();
            let was = before.state;
            let result = change(job)?;
            (result, std::mem::replace(&mut job.record, before), job.folder.clone(), was)
        };
        let written = record.write(&folder).map_err(Refusal::file(&crate::record::file(&folder)));
        let over = matches!(record.state, State::Failed | State::Cancelled | State::Interrupted);
        if let Err(e) = &written
            && record.state != was
            && !over
        {
            (record.state, record.error) = (State::Failed, Some(e.text.clone()));
        }
        let mut table = self.table();
        let version = table.next_version();
        let job = table.jobs.get_mut(id).ok_or_else(no_such)?;
        (job.record, job.version, job.touched) = (record, version, Instant::now());
        self.changed.notify_all();
        written.map(|()| result)
    }

    /// Ends: whoever waits hears of it, whoever computes stops.
    pub fn stop(&self) {
        self.stopping.store(true, Relaxed);
        let table = self.table();
        table.jobs.values().for_each(|j| j.cancel.store(true, Relaxed));
        self.changed.notify_all();
        drop(table);
        let _doomed = self.doomed.lock().unwrap_or_else(PoisonError::into_inner);
        self.doom_changed.notify_all();
    }

    /// Takes a temporary folder away, after all threads that use it have ended.
    pub fn close(&self) {
        let folder = self.temporary.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(Err(e)) = folder.map(tempfile::TempDir::close) {
            tracing::warn!("{}: {e}", self.root.display());
        }
        // Threads of slow clients may live a little longer than the server.
        if let Err(e) = self.lock.unlock() {
            tracing::warn!("{}: {e}", self.root.display());
        }
    }
}

fn clear(folder: &Path) {
    if let Err(e) = fs::remove_dir_all(folder)
        && e.kind() != std::io::ErrorKind::NotFound
    {
        tracing::warn!("{}: {e}", folder.display());
    }
}

fn uploads(folder: &Path) -> PathBuf {
    folder.join("upload")
}

fn no_such() -> Refusal {
    Refusal::new(404, "there is no such job")
}

/// Whether a text can be a job's.
pub fn is_id(text: &str) -> bool {
    text.len() == 16 && text.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b))
}

#[cfg(test)]
mod tests {
    use std::{ops::ControlFlow, sync::mpsc, thread, time::Duration};

    use freerange_gaussians::Gaussians;
    use freerange_scene::{
        camera::{Camera, View},
        estimate::LeaveOneOut,
    };
    use image::RgbaImage;

    use super::*;
    use crate::{EngineError, FoundCameras, Outcome, Scene, Search, SearchStep, Step, scene::SceneOptions};

    /// Computes nothing.
    struct Idle;

    impl Engine for Idle {
        fn name(&self) -> String {
            String::new()
        }

        fn choose(&self, _: &[View]) -> Result<Vec<usize>, String> {
            Ok(Vec::new())
        }

        fn leave_one_out(&self) -> Option<LeaveOneOut> {
            None
        }

        fn run(
            &self,
            _: &Scene,
            _: &JobOptions,
            _: &mut dyn FnMut(&Step<'_>) -> ControlFlow<()>,
        ) -> Result<Outcome, EngineError> {
            Err(EngineError::Cancelled)
        }

        fn picture(&self, _: &Gaussians, _: &Camera) -> Result<RgbaImage, String> {
            Err(String::new())
        }

        fn camera_finder(&self) -> Result<String, String> {
            Err(String::new())
        }

        fn find_cameras(&self, _: &Search<'_>, _: &mut dyn FnMut(SearchStep)) -> Result<FoundCameras, EngineError> {
            Err(EngineError::Cancelled)
        }
    }

    /// V9.
    #[test]
    fn nobody_waits_while_a_record_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let board = Board::open(Some(folder.path()), Limits::default(), Arc::new(Idle)).unwrap();
        let (title, passed_over) = ("before".to_owned(), Vec::new());
        let submission =
            Submission { title, scene: SceneOptions::default(), go: None, splats: None, passed_over, bytes: 0 };
        let id = board.arrive(0).unwrap().submit(submission).unwrap();
        let writing = board.writing(&id).unwrap();
        let disk = crate::record::DISK.lock().unwrap_or_else(PoisonError::into_inner);
        let (told, hears) = mpsc::channel();
        thread::scope(|s| {
            let writes = s.spawn(|| board.rename(&id, "after"));
            s.spawn(|| {
                // Until the other thread waits for the disk.
                while writing.try_lock().is_ok() {
                    thread::sleep(Duration::from_millis(1));
                }
                let seen = board.get(&id).map(|job| job["title"].clone());
                told.send(seen.and_then(|title| board.arrive(0).map(|_| title))).ok();
            });
            let seen = hears.recv_timeout(Duration::from_secs(20)).expect("others wait for the disk");
            assert_eq!(seen.unwrap(), "before");
            assert!(!writes.is_finished());
            drop(disk);
            writes.join().unwrap().unwrap();
        });
        assert_eq!(board.get(&id).unwrap()["title"], "after");
    }
}
