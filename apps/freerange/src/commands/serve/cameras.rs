//! Cameras of photos that have none: the page's photos through the engine of `freerange poses`.

use std::{
    path::{Path, PathBuf},
    sync::{Arc, OnceLock},
};

use freerange_scene::read::photos_in;
use freerange_serve::{EngineError, FoundCameras, Search, SearchStep};

use super::told;
use crate::{
    commands::poses::{self, ADVICE, Bounds, STEPS, Told},
    error::CliError,
};

/// What the page says where no engine is there.
const MISSING: &str = "this server cannot find cameras, since neither COLMAP nor pycolmap is installed on it: send a file of \
                       cameras too, or fill in Turntable for photos of one even turn";

/// An engine that finds cameras, looked for once.
#[derive(Default)]
pub struct Finder {
    engine: OnceLock<Option<poses::Engine>>,
}

impl Finder {
    /// pycolmap in `python`; where none is named, whatever is there, which is looked for meanwhile.
    pub fn new(python: Option<&Path>) -> Result<Arc<Self>, CliError> {
        let finder = Arc::new(Self::default());
        if let Some(python) = python {
            drop(finder.engine.set(Some(poses::Engine::find(Some(python))?)));
        }
        let looks = finder.clone();
        let look = move || {
            looks.engine();
        };
        std::thread::Builder::new().name("engines".into()).spawn(look).map_err(CliError::failure)?;
        Ok(finder)
    }

    fn engine(&self) -> Option<&poses::Engine> {
        self.engine.get_or_init(|| poses::Engine::find(None).ok()).as_ref()
    }

    /// Name and version, or a sentence where there is none.
    pub fn name(&self) -> Result<String, String> {
        self.engine().map(poses::Engine::name).ok_or_else(|| MISSING.into())
    }

    /// Finds the cameras of photos.
    pub fn find(&self, search: &Search<'_>, tell: &mut dyn FnMut(SearchStep)) -> Result<FoundCameras, EngineError> {
        let engine = self.engine().ok_or_else(|| EngineError::Input(MISSING.into()))?;
        let masks: PathBuf = search.photos.join("masks");
        let poses = poses::Search {
            engine,
            scene: search.scene,
            work: Some(search.work),
            masks: masks.is_dir().then_some(masks.as_path()),
            uneven: search.uneven,
            seed: 0,
            bounds: Bounds {
                stop: search.stop.clone(),
                memory: Some(search.memory),
                photos_memory: Some(search.photos_memory),
            },
        };
        let files = photos_in(search.photos).map_err(|e| told(e.into()))?;
        let found = poses.run(&files, &mut |news| {
            if let Told::Step(stage, _, done) = news {
                tell(SearchStep { stage, done: done as usize, total: STEPS as usize + 1 });
            }
        });
        if search.stop.check().is_err() {
            return Err(EngineError::Cancelled);
        }
        let found = found.map_err(told)?;
        if !found.judgement.refused.is_empty() {
            let reasons = found.judgement.refused.join("; ");
            return Err(EngineError::Input(format!("no cameras that can be relied on: {reasons}; {ADVICE}")));
        }
        let (all, left_out) = (found.names.len(), found.judgement.left_out.len());
        let note = format!("{} of {all} photos have cameras, found by {}", all - left_out, found.done.engine);
        Ok(FoundCameras { notes: vec![note], warnings: found.judgement.warnings })
    }
}
