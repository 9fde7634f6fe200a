//! The crate's error.

/// Why two images cannot be compared.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum MetricsError {
    /// An image's slice has another length than its size says.
    #[error("{image}: expected {expected} values ({height} x {width} x 3), found {found}")]
    Length {
        /// Which of the two images.
        image: &'static str,
        /// Image height in pixels.
        height: usize,
        /// Image width in pixels.
        width: usize,
        /// `height * width * 3`.
        expected: usize,
        /// The slice's length.
        found: usize,
    },
    /// The two images differ in size.
    #[error("the images differ in size: {first} and {second} values")]
    Mismatch {
        /// Number of values of the first image.
        first: usize,
        /// Number of values of the second image.
        second: usize,
    },
    /// There is not one pixel.
    #[error("the images are empty")]
    Empty,
    /// The window of the cropped SSIM does not fit into the image.
    #[error("this SSIM needs at least {needed} x {needed} pixels, found {width} x {height}")]
    TooSmall {
        /// Window width in pixels.
        needed: usize,
        /// Image height in pixels.
        height: usize,
        /// Image width in pixels.
        width: usize,
    },
}

/// Both images are non-empty and `[height, width, 3]`.
pub(crate) fn check_size(first: &[f32], second: &[f32], width: usize, height: usize) -> Result<(), MetricsError> {
    let expected = width.checked_mul(height).and_then(|n| n.checked_mul(crate::CHANNELS)).unwrap_or(usize::MAX);
    if expected == 0 {
        return Err(MetricsError::Empty);
    }
    for (image, found) in [("first image", first.len()), ("second image", second.len())] {
        if found != expected {
            return Err(MetricsError::Length { image, height, width, expected, found });
        }
    }
    Ok(())
}
