//! SSIM as evaluation tables take it from scikit-image: the same Gaussian window, but only where it lies wholly
//! inside the image. In float64 and without a gradient: it is called once per image.

use crate::metrics::{
    CHANNELS, ImageError,
    error::check_size,
    ssim::{C1, C2, RADIUS, TAPS, window},
};
use rayon::prelude::*;

/// Mean SSIM over the image cropped by 5 pixels, Gaussian window of sigma 1.5, population covariance
/// (`structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1)`).
/// Images `[height, width, 3]` in `[0, 1]`, at least 11 x 11 pixels.
pub fn ssim_skimage_gauss(first: &[f32], second: &[f32], width: usize, height: usize) -> Result<f64, ImageError> {
    cropped(first, second, width, height, 1.0)
}

/// As [`ssim_skimage_gauss`] with (co)variances multiplied by 121 / 120, scikit-image's default
/// (`use_sample_covariance=True`, 11 x 11 window).
pub fn ssim_skimage_sample(first: &[f32], second: &[f32], width: usize, height: usize) -> Result<f64, ImageError> {
    let count = (TAPS * TAPS) as f64;
    cropped(first, second, width, height, count / (count - 1.0))
}

fn cropped(
    first: &[f32],
    second: &[f32],
    width: usize,
    height: usize,
    covariance_factor: f64,
) -> Result<f64, ImageError> {
    check_size(first, second, width, height)?;
    if width < TAPS || height < TAPS {
        return Err(ImageError::TooSmall { needed: TAPS, height, width });
    }
    let weights = window();
    let length = width * CHANNELS;
    let inner = (width - 2 * RADIUS) * CHANNELS;
    let sums: Vec<f64> = (0..height - 2 * RADIUS)
        .into_par_iter()
        .map(|top| {
            let mut down = vec![[0.0f64; 5]; length]; // E[x], E[y], E[xx], E[yy], E[xy]
            for (r, w) in weights.iter().enumerate() {
                let at = (top + r) * length;
                for ((sum, &x), &y) in down.iter_mut().zip(&first[at..]).zip(&second[at..]) {
                    let (x, y) = (f64::from(x), f64::from(y));
                    for (s, v) in sum.iter_mut().zip([x, y, x * x, y * y, x * y]) {
                        *s += w * v;
                    }
                }
            }
            (0..inner)
                .map(|i| {
                    let mut m = [0.0; 5];
                    for (k, w) in weights.iter().enumerate() {
                        for (sum, v) in m.iter_mut().zip(down[i + k * CHANNELS]) {
                            *sum += w * v;
                        }
                    }
                    let [x, y, xx, yy, xy] = m;
                    let variances = covariance_factor * (xx - x * x + yy - y * y);
                    let covariance = covariance_factor * (xy - x * y);
                    (2.0 * x * y + C1) * (2.0 * covariance + C2) / ((x * x + y * y + C1) * (variances + C2))
                })
                .sum()
        })
        .collect();
    Ok(sums.iter().sum::<f64>() / ((height - 2 * RADIUS) * inner) as f64)
}
