//! What is read of a `.ply` file.

use crate::Splats;
use freerange_util::Note;
use glam::DVec3;

/// What a `.ply` holds.
#[derive(Clone, Debug, PartialEq)]
pub struct PlyFile {
    /// The Gaussians; all channels finite.
    pub splats: Splats,
    /// Which way is up, where the file says so.
    pub up: Option<DVec3>,
    /// What was left out or looks odd, one sentence each, for the user.
    pub notes: Vec<Note>,
}
