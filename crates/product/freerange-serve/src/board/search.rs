//! Photos without cameras: the engine's search, within limits.

use std::{
    fs,
    path::{Path, PathBuf},
    sync::{Arc, atomic::AtomicBool},
    time::Instant,
};

use freerange_scene::read::photos_in;
use freerange_util::{Stop, Stopped};
use image::{ImageDecoder, ImageReader};

use super::{Board, table::Progress, uploads};
use crate::{
    EngineError, FoundCameras, Refusal, Search, SearchStep, plain,
    record::State,
    scene::{SceneOptions, root},
};

/// Bytes of memory that finding the mask of a photo takes, about.
const MASK: u64 = 24 << 20;

/// Whether a photo may bring its own mask, as its head says.
fn has_alpha(photo: &Path) -> bool {
    let reader = ImageReader::open(photo).and_then(ImageReader::with_guessed_format);
    let decoder = reader.ok().and_then(|reader| reader.into_decoder().ok());
    decoder.is_some_and(|decoder| decoder.color_type().has_alpha())
}

impl Board {
    /// Has the engine find the cameras of a job's photos. What is to be said of them, and the folder of the scene.
    pub(super) fn search(
        &self,
        id: &str,
        folder: &Path,
        options: &SceneOptions,
        cancel: &Arc<AtomicBool>,
    ) -> Result<(FoundCameras, PathBuf), Refusal> {
        let (upload, work) = (uploads(folder).join("0/0/0"), uploads(folder).join("2"));
        // As with uploads: above a scene there is nothing but it.
        let scene = uploads(folder).join("1/0/0");
        for folder in [&work, &scene] {
            fs::create_dir_all(folder).map_err(Refusal::own)?;
        }
        let stop = Stop::on(cancel.clone(), Some(Instant::now() + self.limits.search_time));
        let photos = root(&upload).map_err(Refusal::own)?;
        self.check_masks(&photos, options)?;
        let search = Search {
            photos: &photos,
            scene: &scene,
            work: &work,
            uneven: options.uneven,
            stop: &stop,
            memory: self.limits.search_memory,
            photos_memory: self.limits.memory,
        };
        let found = self.engine.find_cameras(&search, &mut |step| self.searched(id, step));
        let plain = |text: &str| {
            plain::sentence(&text.replace(&scene.display().to_string(), &photos.display().to_string()), &photos)
        };
        let mut found = match (found, stop.check()) {
            (_, Err(Stopped::Cancelled)) => return Err(Refusal::new(409, "cancelled")),
            (Err(EngineError::Cancelled), _) | (_, Err(Stopped::Late)) => {
                let most = self.limits.search_time.as_secs_f64();
                let text = format!(
                    "the cameras were not found within {most} seconds, which is all it may take: give fewer photos"
                );
                return Err(Refusal::new(422, text));
            }
            (Err(EngineError::Input(e)), _) => return Err(Refusal::new(422, plain(&e))),
            (Err(EngineError::Failed(e)), _) => return Err(Refusal::own(e)),
            (Ok(found), _) => found,
        };
        for text in found.warnings.iter_mut().chain(&mut found.notes) {
            *text = plain(text);
        }
        Ok((found, scene))
    }

    /// Refuses photos whose masks would take more memory than they may: known now, and not only after minutes.
    fn check_masks(&self, folder: &Path, options: &SceneOptions) -> Result<(), Refusal> {
        let given = !matches!(options.masks.as_deref(), None | Some("auto" | "estimate"));
        if given || folder.join("masks").is_dir() {
            return Ok(());
        }
        // What is odd about photos is said by whoever reads them.
        let photos = photos_in(folder).unwrap_or_default();
        let opaque = photos.iter().filter(|photo| !has_alpha(photo)).count();
        let (needed, most) = (opaque as u64 * MASK, self.limits.memory);
        match needed <= most {
            true => Ok(()),
            false => Err(Refusal::new(
                422,
                format!(
                    "{opaque} photos without masks: expected at most {} MB of memory to find them, which is the limit, found some {} MB; \
                     give fewer photos, or masks with them",
                    most >> 20,
                    needed >> 20
                ),
            )),
        }
    }

    /// Shows a step of a search to everyone who looks.
    fn searched(&self, id: &str, step: SearchStep) {
        let mut table = self.table();
        let version = table.next_version();
        let Some(job) = table.jobs.get_mut(id).filter(|j| j.record.state == State::Reading) else { return };
        let SearchStep { stage, done, total } = step;
        job.progress = Progress { stage, done, total, ..Progress::default() };
        job.version = version;
        self.changed.notify_all();
    }
}
