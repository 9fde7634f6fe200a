//! Scenes on disk: one way to read them for program, library and Python.

use std::path::Path;

use freerange_scene::camera::{FrameConfig, View};
use freerange_scene::{
    Loaded, MaskKind, SceneConfig, Whole, cut,
    estimate::Hints,
    read::{Cameras, cameras_with},
};
use freerange_util::{Note, Stop};

use crate::{Error, error::Lift, frame::check_cameras, leave_one_out::leave_one_out, warnings::warnings_of};

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
        Self::load(cameras_with(path, &config.cameras).lift()?, config)
    }

    /// Reads the photos of cameras that are read already.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn load(cameras: Cameras, config: &SceneConfig) -> Result<Self, Error> {
        let mut config = config.clone();
        config.photos.hints.others = config.photos.hints.others.or(Some(leave_one_out));
        let read = freerange_scene::Scene::load(cameras, &config).lift()?;
        Ok(Self { cameras: read.cameras, loaded: read.loaded, frame: read.frame, notes: read.notes })
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
        warnings_of(&self.loaded, &self.frame, network_views)
    }
}

/// Cuts the object out of views that are made, not read: those without a mask in their alpha get one, as the photos of a
/// [`Scene`] do. `hints` say what is known of the object's place.
///
/// # Errors
/// If no mask can be found, or all cameras stand at one place.
pub fn cut_out(views: &mut [View], hints: &Hints) -> Result<Vec<Note>, Error> {
    cut_out_until(views, hints, &Stop::default())
}

fn cut_out_until(views: &mut [View], hints: &Hints, stop: &Stop) -> Result<Vec<Note>, Error> {
    check_cameras(views)?;
    cut(views, &Hints { others: hints.others.or(Some(leave_one_out)), ..*hints }, stop).lift()
}

/// [`cut_out`] of views as [`Scene::loaded`] is of photos that are read: [`warnings_of`] takes it.
///
/// # Errors
/// As there; [`Error::Cancelled`] once it is stopped.
pub fn load_views(mut views: Vec<View>, hints: &Hints, stop: &Stop) -> Result<Loaded, Error> {
    let notes = match (cut_out_until(&mut views, hints, stop), stop.check()) {
        (_, Err(_)) => return Err(Error::Cancelled),
        (notes, Ok(())) => notes?,
    };
    let (photos, whole) = ((0..views.len()).collect(), Whole::default());
    Ok(Loaded { views, photos, whole, further: Vec::new(), masks: MaskKind::Alpha, estimate: None, notes })
}
