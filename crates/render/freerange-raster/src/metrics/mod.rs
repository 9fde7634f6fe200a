//! Image quality: MSE, PSNR, L1, and structural similarity with its gradient.
//!
//! Images are flat `[height, width, 3]` slices of `f32` in `[0, 1]`. Every function refuses slices whose lengths do not
//! match. Pixels that are not finite never pass as good: they make the result NaN.

mod error;
mod pixel;
mod ssim;
mod ssim_cropped;

pub use error::{ImageError, check_size};
pub use pixel::{HIGHEST_PSNR, capped_psnr, l1, mse, psnr, psnr_from_mse};
pub use ssim::{photometric_loss, ssim_3dgs, ssim_with_gradient};
pub use ssim_cropped::{ssim_skimage_gauss, ssim_skimage_sample};

/// Number of color channels of every image here.
pub const CHANNELS: usize = 3;
