//! What a run starts from, and who shares it.

use std::rc::Rc;

use freerange_model::Checkpoint;

use crate::ranks::{Ranks, Single};

/// Weights that a new run starts from.
#[derive(Clone, Copy, Debug)]
pub struct Initial<'a> {
    /// The weights, of the same architecture.
    pub checkpoint: &'a Checkpoint,
    /// Normalize Gaussians by the statistics of the run's own data, not by the checkpoint's: for data that
    /// are made in another way, such as fits instead of points on the surface.
    pub remeasure: bool,
}

/// The processes that share a run.
#[derive(Clone)]
pub struct Among {
    /// All of them.
    pub ranks: Rc<dyn Ranks>,
    /// Names and values of what has to be the same on all ranks, besides configuration, data and encoder: such as the program.
    pub identity: Vec<(String, String)>,
}

impl Among {
    /// One process alone.
    pub fn single() -> Self {
        Self { ranks: Rc::new(Single), identity: Vec::new() }
    }
}
