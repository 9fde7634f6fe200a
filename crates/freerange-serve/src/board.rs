//! The jobs: who waits, who computes, what is there of each.

use std::{
    collections::{BTreeMap, VecDeque},
    fs::{self, File, TryLockError},
    ops::ControlFlow,
    path::{Path, PathBuf},
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use freerange_camera::{
    Camera,
    image_ops::{composite, resize_area, to_picture},
};
use freerange_formats::{Format, Frame, WriteOptions};
use freerange_splat::{Cloud, read_ply, write_ply};
use glam::DVec3;
use image::RgbaImage;
use serde_json::{Value, json};

use crate::{
    Engine, EngineError, JobOptions, Limits, Outcome, Refusal, ServeError, Step,
    metrics::Metrics,
    record::{Record, SampleRecord, State, sample_file, thumbnail_file},
    scene::{self, SceneOptions},
};

/// Time between two estimates that are published.
const BETWEEN: Duration = Duration::from_millis(100);
/// Estimates of a job that can be had.
const ESTIMATES: usize = 8;
/// Longer side of a thumbnail, in pixels.
const THUMBNAIL: u32 = 160;

/// Gaussians that a run has published.
struct Estimate {
    number: u64,
    stage: &'static str,
    /// Sample and rows, little-endian.
    parts: Vec<(usize, Arc<Vec<u8>>)>,
}

/// How far a run has come.
#[derive(Clone, Copy, Default)]
struct Progress {
    stage: &'static str,
    sample: usize,
    done: usize,
    total: usize,
    loss: Option<f64>,
}

struct Job {
    record: Record,
    folder: PathBuf,
    version: u64,
    progress: Progress,
    estimates: VecDeque<Estimate>,
    published: u64,
    cancel: Arc<AtomicBool>,
    touched: Instant,
    /// Computed as soon as it is read.
    go: Option<JobOptions>,
}

#[derive(Default)]
struct Table {
    jobs: BTreeMap<String, Job>,
    turns: u64,
    versions: u64,
}

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
    mending: Mutex<()>,
    stopping: AtomicBool,
    pub metrics: Metrics,
}

/// A job whose files are on their way; it is gone unless it is submitted.
pub struct Arriving<'b> {
    board: &'b Board,
    pub id: String,
    /// Where files go.
    pub upload: PathBuf,
    submitted: bool,
}

impl Drop for Arriving<'_> {
    fn drop(&mut self) {
        if !self.submitted {
            let job = self.board.table().jobs.remove(&self.id);
            job.into_iter().for_each(|job| clear(&job.folder));
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

fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

impl Board {
    /// Opens the folder of jobs, and finds what an earlier server left there.
    pub fn open(keep: Option<&Path>, limits: Limits, engine: Arc<dyn Engine>) -> Result<Self, ServeError> {
        let at = |path: &Path| {
            let path = path.to_path_buf();
            move |source| ServeError::Folder { path, source }
        };
        let (root, temporary) = match keep {
            Some(folder) => {
                fs::create_dir_all(folder).map_err(at(folder))?;
                (folder.to_path_buf(), None)
            }
            None => {
                let folder = tempfile::Builder::new().prefix("freerange-serve-").tempdir();
                let folder = folder.map_err(at(&std::env::temp_dir()))?;
                (folder.path().to_path_buf(), Some(folder))
            }
        };
        let lock_path = root.join(".freerange-serve.lock");
        let lock = File::create(&lock_path).map_err(at(&lock_path))?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let source = std::io::Error::other("another server keeps its jobs here");
                return Err(ServeError::Folder { path: root, source });
            }
            Err(TryLockError::Error(e)) => return Err(at(&lock_path)(e)),
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
            mending: Mutex::new(()),
            stopping: AtomicBool::new(false),
            metrics: Metrics::new(),
        };
        board.recover().map_err(at(&board.root))?;
        Ok(board)
    }

    /// Takes over what an earlier server left: finished and waiting jobs as they are, others as interrupted.
    fn recover(&self) -> std::io::Result<()> {
        let mut table = self.table();
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
            let job = table.job(record, folder);
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

    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// Makes room for a new job.
    pub fn arrive(&self) -> Result<Arriving<'_>, Refusal> {
        let mut table = self.table();
        if table.jobs.values().filter(|j| j.record.state.is_open()).count() >= self.limits.open_jobs {
            // One that nobody came back to makes way.
            let idle = |j: &&Job| j.record.state == State::Ready && j.touched.elapsed() > self.limits.idle_time;
            let oldest = table.jobs.values().filter(idle).min_by_key(|j| j.touched).map(|j| j.record.id.clone());
            let full = || {
                Refusal::new(429, format!("{} jobs are open, which is all there is room for", self.limits.open_jobs))
            };
            table.forget(&oldest.ok_or_else(full)?);
        }
        let finished = |j: &&Job| !j.record.state.is_open();
        while table.jobs.values().filter(finished).count() >= self.limits.finished_jobs {
            if self.keeps {
                let text = format!(
                    "{} finished jobs are kept, which is all there is room for: remove some",
                    self.limits.finished_jobs
                );
                return Err(Refusal::new(507, text));
            }
            let oldest = table.jobs.values().filter(finished).min_by_key(|j| j.touched).map(|j| j.record.id.clone());
            oldest.iter().for_each(|id| table.forget(id));
        }
        let id = loop {
            let id = format!("{:016x}", rand::random::<u64>());
            if !table.jobs.contains_key(&id) {
                break id;
            }
        };
        let folder = self.root.join(&id);
        // Masks are also looked for some folders above the photos: there has to be nothing else.
        let upload = uploads(&folder).join("0/0/0");
        fs::create_dir_all(&upload).map_err(Refusal::own)?;
        table.turns += 1;
        let record = Record {
            id: id.clone(),
            title: String::new(),
            created: now(),
            state: State::Uploading,
            error: None,
            scene: SceneOptions::default(),
            options: JobOptions::default(),
            turn: table.turns,
            understood: Value::Null,
            passed_over: Vec::new(),
            samples: Vec::new(),
            up: [0.0, 0.0, 1.0],
            notes: Vec::new(),
            seconds: Vec::new(),
        };
        let job = table.job(record, folder);
        table.jobs.insert(id.clone(), job);
        Ok(Arriving { board: self, id, upload, submitted: false })
    }

    /// Changes a job under the lock, writes its record, and tells everyone who looks.
    fn change<T>(&self, id: &str, change: impl FnOnce(&mut Job) -> Result<T, Refusal>) -> Result<T, Refusal> {
        let mut table = self.table();
        let version = table.next_version();
        let job = table.jobs.get_mut(id).ok_or_else(no_such)?;
        let result = change(job)?;
        (job.version, job.touched) = (version, Instant::now());
        job.record.write(&job.folder).map_err(Refusal::own)?;
        self.changed.notify_all();
        Ok(result)
    }

    /// What is known of a job, for clients.
    pub fn get(&self, id: &str) -> Result<Value, Refusal> {
        let mut table = self.table();
        let waiting = table.waiting();
        let job = table.jobs.get_mut(id).filter(|j| j.record.state != State::Uploading).ok_or_else(no_such)?;
        job.touched = Instant::now();
        let mut value = job.status(&waiting);
        let r = &job.record;
        let more = json!({
            "understood": r.understood, "options": r.options, "passed_over": r.passed_over, "notes": r.notes, "seconds": r.seconds,
            "samples": r.samples, "up": r.up, "may_go": r.state.may_go() && scene::is_whole(&job.folder),
            "formats": Format::ALL.map(|f| f.extension()),
        });
        if let (Some(fields), Value::Object(mut more)) = (value.as_object_mut(), more) {
            fields.append(&mut more);
        }
        Ok(value)
    }

    /// All jobs, latest first.
    pub fn list(&self) -> Value {
        let table = self.table();
        let waiting = table.waiting();
        let mut jobs: Vec<&Job> = table.jobs.values().filter(|j| j.record.state != State::Uploading).collect();
        jobs.sort_by_key(|j| std::cmp::Reverse((j.record.created, j.record.turn)));
        jobs.iter().map(|j| j.status(&waiting)).collect()
    }

    /// Number of jobs by state.
    pub fn counts(&self) -> BTreeMap<&'static str, usize> {
        let mut counts = BTreeMap::new();
        for state in [
            State::Reading,
            State::Ready,
            State::Queued,
            State::Running,
            State::Done,
            State::Failed,
            State::Cancelled,
            State::Interrupted,
        ] {
            counts.insert(state.name(), 0);
        }
        self.table().jobs.values().for_each(|j| *counts.entry(j.record.state.name()).or_default() += 1);
        counts
    }

    /// Waits until something about the job is newer than `version`; its version and status then, or none after `most`.
    pub fn wait(&self, id: &str, version: u64, most: Duration) -> Result<Option<(u64, Value)>, Refusal> {
        let deadline = Instant::now() + most;
        let mut table = self.table();
        loop {
            if self.stopping.load(Relaxed) {
                return Err(Refusal::new(503, "the server ends"));
            }
            let job = table.jobs.get(id).ok_or_else(no_such)?;
            if job.version > version {
                return Ok(Some((job.version, job.status(&table.waiting()))));
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            table = self.changed.wait_timeout(table, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Lets a job compute.
    pub fn go(&self, id: &str, options: JobOptions) -> Result<(), Refusal> {
        options.check().map_err(|e| Refusal::new(422, e))?;
        let turn = {
            let mut table = self.table();
            table.turns += 1;
            let open = table.jobs.values().filter(|j| j.record.state.is_open() && j.record.id != id).count();
            if open >= self.limits.open_jobs {
                return Err(Refusal::new(429, format!("{open} jobs are open, which is all there is room for")));
            }
            table.turns
        };
        self.change(id, |job| {
            if !job.record.state.may_go() {
                return Err(Refusal::new(409, format!("this job is {}", job.record.state.name())));
            }
            if !scene::is_whole(&job.folder) {
                return Err(Refusal::new(409, "the photos of this job are not there: give them again"));
            }
            (job.record.state, job.record.options, job.record.turn) = (State::Queued, options, turn);
            job.record.error = None;
            job.progress = Progress::default();
            job.estimates.clear();
            // The flag of an earlier run, which may still see it, stays set.
            job.cancel = Arc::default();
            Ok(())
        })
    }

    /// Stops a job. Whoever computes it hears of it at the next step.
    pub fn cancel(&self, id: &str) -> Result<(), Refusal> {
        let mut unread = None;
        self.change(id, |job| {
            match job.record.state {
                State::Reading => unread = Some(uploads(&job.folder)),
                State::Queued | State::Running => {}
                state => return Err(Refusal::new(409, format!("this job is {}", state.name()))),
            }
            job.record.state = State::Cancelled;
            job.cancel.store(true, Relaxed);
            job.estimates.clear();
            self.metrics.ended(State::Cancelled.name());
            Ok(())
        })?;
        // Nobody reads these photos any more, unless someone is at it: then what comes of it is not looked at.
        unread.iter().for_each(|folder| clear(folder));
        Ok(())
    }

    /// Forgets a job, and what lies on disk of it.
    pub fn remove(&self, id: &str) -> Result<(), Refusal> {
        let mut table = self.table();
        let job = table.jobs.get(id).ok_or_else(no_such)?;
        if matches!(job.record.state, State::Uploading | State::Reading | State::Running) {
            return Err(Refusal::new(409, format!("this job is {}: cancel it first", job.record.state.name())));
        }
        table.forget(id);
        self.changed.notify_all();
        Ok(())
    }

    /// Gives a photo another mask.
    pub fn mend(&self, id: &str, k: usize, png: &[u8]) -> Result<f64, Refusal> {
        // One at a time: pictures take memory, and files are replaced.
        let _one = self.mending.lock().unwrap_or_else(PoisonError::into_inner);
        let folder = {
            let table = self.table();
            let job = table.jobs.get(id).ok_or_else(no_such)?;
            if !job.record.state.may_go() || !scene::is_whole(&job.folder) {
                return Err(Refusal::new(
                    409,
                    format!("this job is {}: its masks cannot be changed now", job.record.state.name()),
                ));
            }
            if job.record.understood["views"].get(k).is_none() {
                return Err(Refusal::new(404, "there is no such photo"));
            }
            job.folder.clone()
        };
        let covers = scene::mend(&folder, k, png)?;
        self.change(id, |job| {
            let view = &mut job.record.understood["views"][k];
            (view["mended"], view["covers"]) = (true.into(), covers.into());
            Ok(covers)
        })
    }

    /// The folder of a job, to read from.
    pub fn folder(&self, id: &str) -> Result<PathBuf, Refusal> {
        let table = self.table();
        Ok(table.jobs.get(id).filter(|j| j.record.state != State::Uploading).ok_or_else(no_such)?.folder.clone())
    }

    /// Rows of the Gaussians of an estimate.
    pub fn estimate(&self, id: &str, number: u64, sample: usize) -> Result<Arc<Vec<u8>>, Refusal> {
        let table = self.table();
        let job = table.jobs.get(id).ok_or_else(no_such)?;
        let estimate = job.estimates.iter().find(|e| e.number == number);
        let gone = if number <= job.published { 410 } else { 404 };
        let estimate =
            estimate.ok_or_else(|| Refusal::new(gone, "this estimate is not there: there are later ones"))?;
        let part = estimate.parts.iter().find(|(s, _)| *s == sample);
        part.map(|(_, rows)| rows.clone()).ok_or_else(|| Refusal::new(404, "this estimate has no such sample"))
    }

    /// Sample `i` of a result as a file.
    pub fn result(&self, id: &str, i: usize, format: Format) -> Result<(Vec<u8>, String), Refusal> {
        let (folder, up, state) = {
            let table = self.table();
            let job = table.jobs.get(id).ok_or_else(no_such)?;
            if i >= job.record.samples.len() {
                return Err(Refusal::new(404, "this job has no such sample"));
            }
            (job.folder.clone(), job.record.up, job.record.title.clone())
        };
        let cloud = read_ply(&sample_file(&folder, i)).map_err(Refusal::own)?.cloud;
        let frame = Frame::with_up(DVec3::from_array(up)).unwrap_or_default();
        let options = WriteOptions { frame, ..WriteOptions::default() };
        let encoded = freerange_formats::encode(&cloud, format, &options).map_err(Refusal::own)?;
        // Nothing of a client's name may end the header or name a folder.
        let plain: String = state.chars().filter(|c| c.is_ascii_alphanumeric() || "-_".contains(*c)).take(40).collect();
        let plain = if plain.is_empty() { "gaussians".to_owned() } else { plain };
        Ok((encoded.bytes, format!("{plain}-{i}.{format}")))
    }

    /// Rows of the Gaussians of sample `i` of a result.
    pub fn rows(&self, id: &str, i: usize) -> Result<Vec<u8>, Refusal> {
        let folder = {
            let table = self.table();
            let job = table.jobs.get(id).ok_or_else(no_such)?;
            if i >= job.record.samples.len() {
                return Err(Refusal::new(404, "this job has no such sample"));
            }
            job.folder.clone()
        };
        Ok(bytes(&read_ply(&sample_file(&folder, i)).map_err(Refusal::own)?.cloud))
    }

    /// Ends: whoever waits hears of it, whoever computes stops.
    pub fn stop(&self) {
        self.stopping.store(true, Relaxed);
        let table = self.table();
        table.jobs.values().for_each(|j| j.cancel.store(true, Relaxed));
        self.changed.notify_all();
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

    /// The next job in `state`; none when the server ends.
    fn next(&self, state: State) -> Option<String> {
        let mut table = self.table();
        loop {
            if self.stopping.load(Relaxed) {
                return None;
            }
            let of = table.jobs.values().filter(|j| j.record.state == state);
            if let Some(job) = of.min_by_key(|j| (j.record.turn, j.record.created)) {
                return Some(job.record.id.clone());
            }
            table = self.changed.wait(table).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Reads photos, one job after the other, until the server ends.
    pub fn read_all(&self) {
        while let Some(id) = self.next(State::Reading) {
            let Ok((folder, options, cancel)) =
                self.with(&id, |j| (j.folder.clone(), j.record.scene.clone(), j.cancel.clone()))
            else {
                continue;
            };
            let upload = uploads(&folder).join("0/0/0");
            let work = || {
                let understood = scene::prepare(&upload, &folder, &options, &self.limits, &*self.engine)?;
                let first = image::open(scene::view_file(&folder, 0)).map_err(Refusal::own)?.into_rgba8();
                save_thumbnail(&folder, &on_white(&first))?;
                Ok(understood)
            };
            let read = guarded(work);
            clear(&uploads(&folder));
            let turn = {
                let mut table = self.table();
                table.turns += 1;
                table.turns
            };
            let told = self.change(&id, |job| {
                if cancel.load(Relaxed) || job.record.state != State::Reading {
                    // Someone was faster; what was read is there all the same.
                    if let Ok(understood) = read {
                        job.record.understood = understood;
                    }
                    return Ok(());
                }
                match read {
                    Ok(understood) => {
                        job.record.understood = understood;
                        job.record.state = State::Ready;
                        if let Some(options) = job.go.take() {
                            (job.record.state, job.record.options, job.record.turn) = (State::Queued, options, turn);
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
        }
    }

    /// Computes, one job after the other, until the server ends.
    pub fn compute_all(&self) {
        while let Some(id) = self.next(State::Queued) {
            let started = self.change(&id, |job| {
                if job.record.state != State::Queued {
                    return Err(Refusal::new(409, ""));
                }
                job.record.state = State::Running;
                Ok((job.folder.clone(), job.record.options, job.cancel.clone()))
            });
            let Ok((folder, options, cancel)) = started else { continue };
            let begin = Instant::now();
            let outcome = guarded(|| self.compute(&id, &folder, &options, &cancel));
            let spent = begin.elapsed();
            self.metrics.milliseconds.fetch_add(u64::try_from(spent.as_millis()).unwrap_or(u64::MAX), Relaxed);
            let stopping = self.stopping.load(Relaxed);
            let told = self.change(&id, |job| {
                // Cancelled, and perhaps asked to go again since: the flag is this run's own.
                if job.record.state != State::Running || !Arc::ptr_eq(&job.cancel, &cancel) {
                    return Ok(());
                }
                let r = &mut job.record;
                match outcome {
                    Ok(outcome) => {
                        r.samples = outcome
                            .samples
                            .iter()
                            .map(|(seed, c)| SampleRecord { seed: *seed, gaussians: c.len() })
                            .collect();
                        (r.up, r.notes, r.seconds, r.state) = (outcome.up, outcome.notes, outcome.seconds, State::Done);
                    }
                    Err(_) if stopping => {
                        r.error =
                            Some("the server ended while this job was running: press go to compute it again".into());
                        r.state = State::Interrupted;
                    }
                    Err(e) => (r.error, r.state) = (Some(e.text), State::Failed),
                }
                // What is there of a finished job is its result.
                job.estimates.clear();
                self.metrics.ended(job.record.state.name());
                Ok(())
            });
            self.note(told);
        }
    }

    fn note(&self, told: Result<(), Refusal>) {
        if let Err(e) = told
            && e.status != 404
        {
            tracing::error!("a job's record: {}", e.text);
        }
    }

    fn with<T>(&self, id: &str, f: impl FnOnce(&Job) -> T) -> Result<T, Refusal> {
        self.table().jobs.get(id).map(f).ok_or_else(no_such)
    }

    fn compute(&self, id: &str, folder: &Path, options: &JobOptions, cancel: &AtomicBool) -> Result<Outcome, Refusal> {
        let scene = scene::open(folder)?;
        let begin = Instant::now();
        let mut late = false;
        let mut last: Option<Instant> = None;
        let mut broken = None;
        let mut tell = |step: &Step<'_>| {
            late = begin.elapsed() > self.limits.job_time;
            if late || cancel.load(Relaxed) {
                return ControlFlow::Break(());
            }
            // Steps of sampling are few, and each is worth a look.
            let due =
                step.stage == "sample" || last.is_none_or(|at| at.elapsed() >= BETWEEN) || step.done == step.total;
            let parts = match due.then(|| (step.estimate)()) {
                Some(Ok(parts)) => parts,
                Some(Err(e)) => {
                    broken = Some(e);
                    return ControlFlow::Break(());
                }
                None => Vec::new(),
            };
            if !parts.is_empty() {
                last = Some(Instant::now());
            }
            self.publish(id, step, parts, cancel);
            ControlFlow::Continue(())
        };
        let outcome = self.engine.run(&scene, options, &mut tell);
        let outcome = match (outcome, broken) {
            (_, Some(e)) => return Err(Refusal::own(e)),
            (Ok(outcome), _) => outcome,
            (Err(EngineError::Cancelled), _) if late => {
                let most = self.limits.job_time.as_secs();
                return Err(Refusal::new(
                    422,
                    format!("this job took longer than {most} seconds, which is all it may"),
                ));
            }
            (Err(EngineError::Cancelled), _) => return Err(Refusal::new(409, "cancelled")),
            (Err(EngineError::Input(e)), _) => return Err(Refusal::new(422, e)),
            (Err(EngineError::Failed(e)), _) => return Err(Refusal::own(e)),
        };
        if cancel.load(Relaxed) {
            return Err(Refusal::new(409, "cancelled"));
        }
        for (i, (_, cloud)) in outcome.samples.iter().enumerate() {
            write_ply(cloud, &sample_file(folder, i)).map_err(Refusal::own)?;
        }
        if let Some((_, cloud)) = outcome.samples.first() {
            let camera = &scene.views[0].camera;
            let (w, h) = small(camera.width, camera.height);
            // Drawn large and made small, which is smoother.
            let large = Camera::resized(camera, 3 * w, 3 * h);
            let picture = self.engine.picture(cloud, &large).map_err(Refusal::own)?;
            save_thumbnail(folder, &picture)?;
        }
        Ok(outcome)
    }

    /// Shows a step to everyone who looks.
    fn publish(&self, id: &str, step: &Step<'_>, parts: Vec<(usize, Cloud)>, cancel: &AtomicBool) {
        let parts: Vec<_> = parts.into_iter().map(|(sample, cloud)| (sample, Arc::new(bytes(&cloud)))).collect();
        let mut table = self.table();
        let version = table.next_version();
        let Some(job) = table.jobs.get_mut(id) else { return };
        if cancel.load(Relaxed) || job.record.state != State::Running {
            return;
        }
        let Step { stage, sample, done, total, loss, .. } = *step;
        job.progress = Progress { stage, sample, done, total, loss: loss.filter(|l| l.is_finite()) };
        job.version = version;
        if !parts.is_empty() {
            job.published += 1;
            self.metrics.estimates.fetch_add(1, Relaxed);
            if job.estimates.len() == ESTIMATES {
                job.estimates.pop_front();
            }
            job.estimates.push_back(Estimate { number: job.published, stage, parts });
        }
        self.changed.notify_all();
    }
}

impl Arriving<'_> {
    /// Everything is there: it may be read.
    pub fn submit(
        mut self,
        title: String,
        scene: SceneOptions,
        go: Option<JobOptions>,
        passed_over: Vec<String>,
    ) -> Result<String, Refusal> {
        self.board.change(&self.id, |job| {
            (job.record.title, job.record.scene, job.record.passed_over) = (title, scene, passed_over);
            (job.record.state, job.go) = (State::Reading, go);
            Ok(())
        })?;
        self.submitted = true;
        Ok(std::mem::take(&mut self.id))
    }
}

impl Table {
    fn next_version(&mut self) -> u64 {
        self.versions += 1;
        self.versions
    }

    fn job(&mut self, record: Record, folder: PathBuf) -> Job {
        Job {
            record,
            folder,
            version: self.next_version(),
            progress: Progress::default(),
            estimates: VecDeque::new(),
            published: 0,
            cancel: Arc::default(),
            touched: Instant::now(),
            go: None,
        }
    }

    /// Who waits, in order.
    fn waiting(&self) -> Vec<u64> {
        let queued = self.jobs.values().filter(|j| j.record.state == State::Queued);
        let mut turns: Vec<u64> = queued.map(|j| j.record.turn).collect();
        turns.sort_unstable();
        turns
    }

    fn forget(&mut self, id: &str) {
        let job = self.jobs.remove(id);
        job.into_iter().for_each(|job| clear(&job.folder));
    }
}

impl Job {
    /// What changes while it is on its way.
    fn status(&self, waiting: &[u64]) -> Value {
        let (r, p) = (&self.record, &self.progress);
        let running = r.state == State::Running;
        let estimate = self.estimates.back().map(|e| {
            let parts: Vec<_> =
                e.parts.iter().map(|(s, rows)| json!({ "sample": s, "gaussians": rows.len() / ROW })).collect();
            json!({ "number": e.number, "stage": e.stage, "parts": parts })
        });
        json!({
            "id": r.id, "title": r.title, "created": r.created, "state": r.state, "error": r.error,
            "position": waiting.iter().position(|t| *t == r.turn).filter(|_| r.state == State::Queued),
            "stage": running.then_some(p.stage), "sample": p.sample, "done": p.done, "total": p.total, "loss": p.loss,
            "estimate": estimate, "version": self.version,
        })
    }
}

/// Bytes of a Gaussian.
const ROW: usize = 4 * freerange_splat::channel::COUNT;

fn bytes(cloud: &Cloud) -> Vec<u8> {
    cloud.rows().iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// Whether a text can be a job's.
pub fn is_id(text: &str) -> bool {
    text.len() == 16 && text.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b))
}

/// Runs what might panic: a job may fail, the server must not.
fn guarded<T>(work: impl FnOnce() -> Result<T, Refusal>) -> Result<T, Refusal> {
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(work)).unwrap_or_else(|_| Err(Refusal::own("a job panicked")))
}

fn on_white(image: &RgbaImage) -> RgbaImage {
    to_picture(&composite(image, [1.0; 3]), image.width(), image.height())
}

fn small(width: u32, height: u32) -> (u32, u32) {
    let scale = f64::from(THUMBNAIL) / f64::from(width.max(height).max(1));
    let side = |v: u32| ((f64::from(v) * scale).round() as u32).max(1);
    (side(width), side(height))
}

fn save_thumbnail(folder: &Path, picture: &RgbaImage) -> Result<(), Refusal> {
    let (w, h) = small(picture.width(), picture.height());
    let beside = folder.join("thumbnail.new.png");
    resize_area(picture, w, h).save(&beside).map_err(Refusal::own)?;
    fs::rename(&beside, thumbnail_file(folder)).map_err(Refusal::own)
}
