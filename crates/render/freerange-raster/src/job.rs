//! What to render: plain data that travels through the backends.

use crate::RasterConfig;
use freerange_scene::camera::Camera;

/// What to render: plain data that travels through the backends.
#[derive(Debug)]
pub struct Job {
    pub(crate) objects: usize,
    pub(crate) views: usize,
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) cameras: Vec<Camera>,       // [objects * views]
    pub(crate) backgrounds: Vec<[f32; 3]>, // [objects * views]
    pub(crate) config: RasterConfig,
    #[cfg(feature = "gpu")]
    pub(crate) tuning: Tuning,
}

/// How much of what a GPU does at a time. Results are the same but for rounding; tests try all.
#[cfg(feature = "gpu")]
#[derive(Clone, Copy, Debug)]
pub struct Tuning {
    /// Bytes that the buffers of one group of images may take: as many images as fit are drawn together, at least one.
    /// Where there is more than one group, the backward pass prepares each again, instead of keeping all.
    pub group_bytes: u64,
    /// The largest number of keys that one cube sorts; a power of two.
    pub sort_block: usize,
    /// Whether floats are added atomically where the device can.
    pub float_atomics: bool,
    /// Most cubes along one axis of a grid, where the device does not set less.
    pub grid_limit: u32,
}

#[cfg(feature = "gpu")]
impl Default for Tuning {
    fn default() -> Self {
        Self { group_bytes: 512 << 20, sort_block: 2048, float_atomics: true, grid_limit: u32::MAX }
    }
}
