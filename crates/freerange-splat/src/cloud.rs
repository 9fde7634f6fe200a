//! The cloud: N Gaussians of 14 channels each, in the raw (unconstrained) parametrisation.

/// Where each parameter of a Gaussian lives among its [`CHANNELS`](channel::COUNT) channels.
pub mod channel {
    use std::ops::Range;

    /// Channels per Gaussian.
    pub const COUNT: usize = 14;
    /// Centre, in world units.
    pub const MEAN: Range<usize> = 0..3;
    /// Natural logarithm of the standard deviation along each local axis, in world units.
    pub const LOG_SCALE: Range<usize> = 3..6;
    /// Rotation from the local to the world axes: quaternion `w x y z`, not necessarily of unit length.
    pub const ROTATION: Range<usize> = 6..10;
    /// Logit of the opacity.
    pub const LOGIT_OPACITY: usize = 10;
    /// Colour, in sRGB-encoded units; 0..1 in ordinary clouds, but not clamped.
    pub const COLOR: Range<usize> = 11..14;
}

/// N Gaussians, row-major `[n, 14]`; see [`channel`] for the columns.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cloud {
    data: Vec<f32>, // [n, 14]
}

impl Cloud {
    /// Wraps `data`, row-major `[n, 14]`.
    ///
    /// # Panics
    /// If the length is no multiple of 14: a programming error, as files are checked when they are read.
    pub fn from_rows(data: Vec<f32>) -> Self {
        assert_eq!(data.len() % channel::COUNT, 0, "a cloud has {} channels per Gaussian", channel::COUNT);
        Self { data }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.data.len() / channel::COUNT
    }

    /// Whether there is no Gaussian.
    pub fn is_empty(&self) -> bool {
        self.data.is_empty()
    }

    /// All channels, row-major `[n, 14]`.
    pub fn rows(&self) -> &[f32] {
        &self.data
    }

    /// All channels, row-major `[n, 14]`, to change in place.
    pub fn rows_mut(&mut self) -> &mut [f32] {
        &mut self.data
    }

    /// The channels, giving up the cloud. `[n, 14]`
    pub fn into_rows(self) -> Vec<f32> {
        self.data
    }

    /// The 14 channels of Gaussian `i`.
    pub fn row(&self, i: usize) -> &[f32; channel::COUNT] {
        self.data.as_chunks::<{ channel::COUNT }>().0.get(i).expect("index within the cloud")
    }
}
