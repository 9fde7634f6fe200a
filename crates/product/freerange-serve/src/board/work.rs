//! The thread that computes.

use std::{
    fs,
    io::Cursor,
    ops::ControlFlow,
    path::Path,
    sync::{
        Arc, PoisonError,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    time::{Duration, Instant},
};

use freerange_gaussians::{Gaussians, write_ply};
use freerange_scene::camera::{
    Camera,
    image_ops::{composite, resize_area, to_picture},
};
use image::{ImageFormat, RgbaImage};

use super::{
    Board,
    results::forget_edits,
    table::{Estimate, Progress, bytes},
};
use crate::{
    EngineError, JobOptions, Outcome, Refusal, Step,
    disk::size_of,
    engine::MOST_SAMPLES,
    plain,
    record::{SampleRecord, State, sample_file, thumbnail_file},
    scene,
};

/// Time between two estimates that are published.
const BETWEEN: Duration = Duration::from_millis(100);

/// Estimates of a job that can be had.
const ESTIMATES: usize = 8;

/// Longer side of a thumbnail, in pixels.
const THUMBNAIL: u32 = 160;

impl Board {
    /// The next job to compute; none when the server ends.
    fn next_queued(&self) -> Option<String> {
        let mut table = self.table();
        loop {
            if self.stopping.load(Relaxed) {
                return None;
            }
            let of = table.jobs.values().filter(|j| j.record.state == State::Queued);
            if let Some(job) = of.min_by_key(|j| (j.record.turn, j.record.created)) {
                return Some(job.record.id.clone());
            }
            table = self.changed.wait(table).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Computes, one job after the other, until the server ends.
    pub fn compute_all(&self) {
        while let Some(id) = self.next_queued() {
            // Errors in the log name it.
            let _job = tracing::error_span!("job", %id).entered();
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
            let bytes = size_of(&folder);
            let told = self.change(&id, |job| {
                // Cancelled, and perhaps asked to go again since: the flag is this run's own.
                if job.record.state != State::Running || !Arc::ptr_eq(&job.cancel, &cancel) {
                    return Ok(());
                }
                job.bytes = bytes;
                let r = &mut job.record;
                match outcome {
                    Ok(outcome) => {
                        r.samples = outcome
                            .samples
                            .iter()
                            .map(|(seed, c)| SampleRecord { seed: *seed, gaussians: c.len() })
                            .collect();
                        r.notes = outcome.notes.iter().map(|note| plain::sentence(note, &folder)).collect();
                        (r.up, r.seconds, r.state) = (outcome.up, outcome.seconds, State::Done);
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
            self.trim();
        }
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
            // Passes of the network are few, and each is worth a look.
            let due =
                step.stage == "refine" || last.is_none_or(|at| at.elapsed() >= BETWEEN) || step.done == step.total;
            let parts = match due.then(|| (step.preview)()) {
                Some(Ok(preview)) => preview.map(|cloud| (step.sample, cloud)).into_iter().collect(),
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
            (Err(EngineError::Input(e)), _) => return Err(Refusal::new(422, plain::sentence(&e, folder))),
            (Err(EngineError::Failed(e)), _) => return Err(Refusal::own(e)),
        };
        if cancel.load(Relaxed) {
            return Err(Refusal::new(409, "cancelled"));
        }
        forget_edits(folder, MOST_SAMPLES);
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
    fn publish(&self, id: &str, step: &Step<'_>, parts: Vec<(usize, Gaussians)>, cancel: &AtomicBool) {
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

    pub(super) fn note(&self, told: Result<(), Refusal>) {
        if let Err(e) = told
            && e.status != 404
        {
            tracing::error!("a job's record: {}", e.text);
        }
    }
}

/// Runs what might panic: a job may fail, the server must not.
pub(super) fn guarded<T>(work: impl FnOnce() -> Result<T, Refusal>) -> Result<T, Refusal> {
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(work)).unwrap_or_else(|_| Err(Refusal::own("a job panicked")))
}

pub(super) fn on_white(image: &RgbaImage) -> RgbaImage {
    to_picture(&composite(image, [1.0; 3]), image.width(), image.height())
}

fn small(width: u32, height: u32) -> (u32, u32) {
    let scale = f64::from(THUMBNAIL) / f64::from(width.max(height).max(1));
    let side = |v: u32| ((f64::from(v) * scale).round() as u32).max(1);
    (side(width), side(height))
}

pub(super) fn save_thumbnail(folder: &Path, picture: &RgbaImage) -> Result<(), Refusal> {
    let (w, h) = small(picture.width(), picture.height());
    let beside = folder.join("thumbnail.new.png");
    let mut bytes = Cursor::new(Vec::new());
    resize_area(picture, w, h).write_to(&mut bytes, ImageFormat::Png).map_err(Refusal::own)?;
    fs::write(&beside, bytes.into_inner()).map_err(Refusal::file(&beside))?;
    fs::rename(&beside, thumbnail_file(folder)).map_err(Refusal::file(&beside))
}
