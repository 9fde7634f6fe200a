//! Scenes on disk: one way to read them for program, library and Python.

use std::path::Path;

use freerange_camera::{FrameConfig, Up, View};
use freerange_core::Note;
use freerange_scene::{
    LoadConfig, Loaded,
    inspect::view_warnings,
    load,
    read::{Cameras, ReadConfig, cameras_with},
    up_of,
};

use crate::{Error, choose_views, others_show, to_canonical};

/// Photos with cameras, read and cut out.
#[derive(Clone, Debug)]
#[non_exhaustive]
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
    /// Reads a folder of photos with cameras of any kind that the program reads, or a file of cameras, and cuts the object
    /// out.
    ///
    /// # Errors
    /// Names file and field, what was expected and what was found.
    pub fn open(path: &Path) -> Result<Self, Error> {
        Self::open_with(path, &SceneConfig::default())
    }

    /// The same with options.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn open_with(path: &Path, config: &SceneConfig) -> Result<Self, Error> {
        Self::load(cameras_with(path, &config.cameras)?, config)
    }

    /// Reads the photos of cameras that are read already.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn load(cameras: Cameras, config: &SceneConfig) -> Result<Self, Error> {
        let mut photos = config.photos.clone();
        photos.hints.others = photos.hints.others.or(Some(others_show));
        let loaded = load(&cameras, &photos)?;
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

    /// The views to reconstruct from.
    pub fn views(&self) -> &[View] {
        &self.loaded.views
    }

    /// Further views, which are only compared with.
    pub fn further(&self) -> &[View] {
        &self.loaded.further
    }

    /// What may go wrong with these photos and masks, where the network sees up to `network_views` of them.
    ///
    /// # Errors
    /// If the views do not show one object from different places.
    pub fn warnings(&self, network_views: usize) -> Result<Vec<Note>, Error> {
        let (frame, _) = to_canonical(self.views(), &self.frame)?;
        let shown = choose_views(self.views(), network_views)?;
        Ok(view_warnings(&self.loaded, &frame, &shown).into_iter().map(Note::warning).collect())
    }
}
