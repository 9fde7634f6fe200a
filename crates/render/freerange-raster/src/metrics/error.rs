//! Why two images cannot be compared.

/// Why two images cannot be compared.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
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
    /// The image is too small, or too narrow for its length, for a metric.
    #[error("this metric needs at least {needed} x {needed} pixels, found {width} x {height}")]
    TooSmall {
        /// The smallest width and height in pixels.
        needed: usize,
        /// Image height in pixels.
        height: usize,
        /// Image width in pixels.
        width: usize,
    },
    /// A pixel is NaN or infinite.
    #[error("{image}: value {index} is {value}, expected a number in 0..1")]
    NotFinite {
        /// Which of the two images.
        image: &'static str,
        /// Index of the value in the image's slice.
        index: usize,
        /// What it is, as text.
        value: String,
    },
}

/// Checks that both images are non-empty and `[height, width, 3]`.
///
/// # Errors
/// [`ImageError::Empty`], [`ImageError::Length`].
pub fn check_size(first: &[f32], second: &[f32], width: usize, height: usize) -> Result<(), ImageError> {
    let expected = width.checked_mul(height).and_then(|n| n.checked_mul(super::CHANNELS)).unwrap_or(usize::MAX);
    if expected == 0 {
        return Err(ImageError::Empty);
    }
    for (image, found) in [("first image", first.len()), ("second image", second.len())] {
        if found != expected {
            return Err(ImageError::Length { image, height, width, expected, found });
        }
    }
    Ok(())
}
