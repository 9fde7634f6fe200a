//! The one way from files to a scene: of program, library, Python, page and evaluation.

use std::path::Path;

use crate::camera::{FrameConfig, Up, View};
use freerange_util::Note;
use glam::DVec3;

use crate::{
    LoadConfig, Loaded, SceneError, load,
    read::{Cameras, ReadConfig, cameras_with},
    up_of,
};

/// Photos with cameras, read and cut out.
#[derive(Clone, Debug)]
pub struct Scene {
    /// The cameras, as their program wrote them.
    pub cameras: Cameras,
    /// The photos as views: undistorted, alpha the object's mask. Their positions are relative to the origin of `cameras`.
    pub loaded: Loaded,
    /// Which way is up, and where the object is, as far as it is known.
    pub frame: FrameConfig,
    /// What was understood, assumed, changed or left out, for the user to read.
    pub notes: Vec<Note>,
}

/// How a scene is read. The default takes what is there.
#[derive(Clone, Debug, Default)]
pub struct SceneConfig {
    /// Which cameras, and how.
    pub cameras: ReadConfig,
    /// Masks, sizes, and what is known of the object's place.
    pub photos: LoadConfig,
    /// Which way is up; none: by the cameras' format, by what the object stands on, or by the cameras.
    pub up: Option<Up>,
}

impl Scene {
    /// Reads the photos of cameras that are read already.
    ///
    /// # Errors
    /// Names file and field, what was expected and what was found.
    pub fn load(cameras: Cameras, config: &SceneConfig) -> Result<Self, SceneError> {
        let photos = &config.photos;
        let loaded = load(&cameras, photos)?;
        let mut notes: Vec<Note> = cameras.notes.iter().chain(&loaded.notes).cloned().collect();
        let up = config.up.unwrap_or_else(|| {
            let (up, note) = up_of(&cameras, &loaded);
            notes.extend(note);
            up
        });
        let center = photos.hints.center.map(|c| c - cameras.origin);
        let frame = FrameConfig { up, center, radius: photos.hints.radius, ..FrameConfig::default() };
        Ok(Self { cameras, loaded, frame, notes })
    }
}

/// Views that are only compared with: all of a scene's, with positions relative to `origin`, which is that of the scene that
/// they are compared with; and what there is to say of them.
///
/// # Errors
/// As [`Scene::load`]; views without masks, since an estimated one is nothing to measure by.
pub fn views_to_compare(path: &Path, origin: DVec3) -> Result<(Vec<View>, Vec<Note>), SceneError> {
    let mut cameras = cameras_with(path, &ReadConfig::default())?;
    cameras.subtract(origin);
    let Scene { loaded, notes, .. } = Scene::load(cameras, &SceneConfig { up: Some(Up::Z), ..SceneConfig::default() })?;
    if loaded.estimate.is_some() {
        return Err(SceneError::Mask {
            name: path.display().to_string(),
            expected: "views to compare with that have masks (alpha, files, or a plain background)".into(),
            found: "none".into(),
        });
    }
    Ok((loaded.views.into_iter().chain(loaded.further).collect(), notes))
}
