//! The threads that read photos.

use std::{
    path::PathBuf,
    sync::{Arc, PoisonError, atomic::AtomicBool, atomic::Ordering::Relaxed},
    time::Instant,
};

use freerange_util::Stop;
use rayon::ThreadPoolBuilder;
use serde_json::Value;

use super::{
    Board, clear,
    table::{Job, Progress},
    uploads,
    work::{guarded, on_white, save_thumbnail},
};
use crate::{
    FoundCameras, Refusal,
    disk::size_of,
    record::{SampleRecord, State},
    scene::{self, Preparation, SceneOptions},
    splats,
};

/// What came of reading.
struct Read {
    understood: Value,
    /// Number and up of Gaussians that were read: they are the result already.
    result: Option<(usize, [f64; 3])>,
}

/// A job whose photos a thread reads.
struct Unread {
    id: String,
    folder: PathBuf,
    options: SceneOptions,
    splats: Option<PathBuf>,
    cancel: Arc<AtomicBool>,
}

impl Board {
    /// The next job whose photos nobody reads yet, of those whose cameras are to be found or of the others; none when the server ends.
    fn next_unread(&self, searching: bool) -> Option<Unread> {
        let mut table = self.table();
        loop {
            if self.stopping.load(Relaxed) {
                return None;
            }
            let searches = |j: &Job| j.record.scene.find_cameras && j.splats.is_none();
            let unread = |j: &&mut Job| j.record.state == State::Reading && !j.read_by_one && searches(j) == searching;
            let of = table.jobs.values_mut().filter(unread);
            if let Some(job) = of.min_by_key(|j| (j.record.turn, j.record.created)) {
                job.read_by_one = true;
                return Some(Unread {
                    id: job.record.id.clone(),
                    folder: job.folder.clone(),
                    options: job.record.scene.clone(),
                    splats: job.splats.take(),
                    cancel: job.cancel.clone(),
                });
            }
            table = self.changed.wait(table).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Reads photos, one job after the other, until the server ends. Several threads do so at the same time. One thread of its own has the jobs
    /// whose cameras are to be found (`searching`): that takes minutes, and nobody else waits for it.
    pub fn read_all(&self, searching: bool) {
        // Threads of its own: in a common pool, pictures of a small job would wait behind all those of a large one.
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let own = ThreadPoolBuilder::new().num_threads(cores.div_ceil(self.limits.readers.max(1))).build();
        let pool = match own {
            Ok(pool) => pool,
            Err(e) => return tracing::error!("no threads to read photos: {e}"),
        };
        while let Some(unread) = self.next_unread(searching) {
            // Errors in the log name it, also those of other threads.
            let span = tracing::error_span!("job", id = %unread.id);
            let _job = span.enter();
            let read = pool.install(|| span.in_scope(|| guarded(|| self.read(&unread))));
            let Unread { id, folder, cancel, .. } = unread;
            clear(&uploads(&folder));
            let bytes = size_of(&folder);
            let told = self.change(&id, |job| {
                (job.read_by_one, job.bytes, job.progress) = (false, bytes, Progress::default());
                if cancel.load(Relaxed) || job.record.state != State::Reading {
                    // Someone was faster; what was read is there all the same.
                    if let Ok(Read { understood, .. }) = read {
                        job.record.understood = understood;
                    }
                    return Ok(());
                }
                match read {
                    Ok(Read { understood, result: Some((gaussians, up)) }) => {
                        (job.record.understood, job.record.up) = (understood, up);
                        job.record.samples = vec![SampleRecord { seed: 0, gaussians }];
                        job.record.state = State::Done;
                        self.metrics.ended(State::Done.name());
                    }
                    Ok(Read { understood, result: None }) => {
                        job.record.understood = understood;
                        job.record.state = State::Ready;
                        if let Some(options) = job.go.take() {
                            // Its turn is that of its arrival, however long it took to read.
                            (job.record.state, job.record.options) = (State::Queued, self.complete(options));
                        }
                    }
                    Err(e) => {
                        (job.record.state, job.record.error) = (State::Failed, Some(e.text));
                        self.metrics.ended(State::Failed.name());
                    }
                }
                Ok(())
            });
            self.note(told);
            self.trim();
        }
    }

    /// Reads the photos of one job; ends early when it is cancelled, and when its time is over.
    fn read(&self, unread: &Unread) -> Result<Read, Refusal> {
        let Unread { id, folder, options, splats, cancel } = unread;
        if let Some(file) = splats {
            let stop = Stop::on(cancel.clone(), Some(Instant::now() + self.limits.read_time));
            let found = splats::prepare(file, folder, options.up()?, &self.limits, &stop)?;
            save_thumbnail(folder, &splats::thumbnail(&*self.engine, &found))?;
            return Ok(Read { understood: found.understood, result: Some((found.gaussians, found.up)) });
        }
        let mut upload = uploads(folder).join("0/0/0");
        let mut found = FoundCameras::default();
        if options.find_cameras {
            (found, upload) = self.search(id, folder, options, cancel)?;
        }
        let stop = Stop::on(cancel.clone(), Some(Instant::now() + self.limits.read_time));
        let mut understood = scene::prepare(&Preparation {
            upload: &upload,
            folder,
            options,
            limits: &self.limits,
            engine: &*self.engine,
            stop: &stop,
            room: self.room(id),
        })?;
        for (list, more) in [("warnings", found.warnings), ("notes", found.notes)] {
            if let Some(list) = understood[list].as_array_mut() {
                list.splice(0..0, more.into_iter().map(Value::from));
            }
        }
        let view = scene::view_file(folder, 0);
        let first = image::open(&view).map_err(Refusal::file(&view))?.into_rgba8();
        save_thumbnail(folder, &on_white(&first))?;
        Ok(Read { understood, result: None })
    }
}
