//! Measures that look at each value alone.

use crate::metrics::ImageError;

fn mean_over(first: &[f32], second: &[f32], term: impl Fn(f64) -> f64) -> Result<f64, ImageError> {
    if first.len() != second.len() {
        return Err(ImageError::Mismatch { first: first.len(), second: second.len() });
    }
    if first.is_empty() {
        return Err(ImageError::Empty);
    }
    let sum: f64 = first.iter().zip(second).map(|(&a, &b)| term(f64::from(a) - f64::from(b))).sum();
    Ok(sum / first.len() as f64)
}

/// Mean squared error over all values of two equally long images.
pub fn mse(first: &[f32], second: &[f32]) -> Result<f64, ImageError> {
    mean_over(first, second, |d| d * d)
}

/// Mean absolute error over all values of two equally long images.
pub fn l1(first: &[f32], second: &[f32]) -> Result<f64, ImageError> {
    mean_over(first, second, f64::abs)
}

/// Peak signal-to-noise ratio in dB for a peak of 1, from the MSE over all values; infinite for identical images.
pub fn psnr(first: &[f32], second: &[f32]) -> Result<f64, ImageError> {
    mse(first, second).map(psnr_from_mse)
}

/// Where means of PSNR are taken, equal images count so many dB: 8-bit images cannot differ by so little.
pub const HIGHEST_PSNR: f64 = 100.0;

/// [`psnr`], at most [`HIGHEST_PSNR`], so that it has a mean. NaN where a value of the images is NaN.
pub fn capped_psnr(first: &[f32], second: &[f32]) -> Result<f64, ImageError> {
    let db = psnr(first, second)?;
    // `min` would make the best of what is no number.
    Ok(if db > HIGHEST_PSNR { HIGHEST_PSNR } else { db })
}

/// PSNR in dB of a mean squared error, for a peak of 1.
pub fn psnr_from_mse(mse: f64) -> f64 {
    -10.0 * mse.log10()
}
