//! Picture strips: what a method was shown, what it should have made, what it made, and where it is wrong.

use freerange_scene::camera::{
    View,
    image_ops::{composite, resize_area, sheet, shrunk_size, to_picture},
};
use image::{RgbaImage, codecs::jpeg::JpegEncoder};

use crate::EvalError;

/// Longest side of one picture in pixels.
const SIDE: u32 = 128;
/// Validation views that are shown.
const COLUMNS: usize = 6;
/// JPEG quality.
const QUALITY: u8 = 75;
const WHITE: [f32; 3] = [1.0; 3];

/// A JPEG of four rows: input views; validation views, evenly picked; renders of these; mean absolute error over the
/// channels (white none, through red to black at half the range or more). `renders`: `[h, w, 3]` for each validation view.
///
/// # Errors
/// [`EvalError::Picture`].
pub fn strip(inputs: &[View], validation: &[View], renders: &[Vec<f32>]) -> Result<Vec<u8>, EvalError> {
    let shown: Vec<usize> = (0..validation.len()).step_by(validation.len().div_ceil(COLUMNS).max(1)).collect();
    let mut rows = [inputs.iter().map(|v| small(&v.image)).collect::<Vec<_>>(), vec![], vec![], vec![]];
    for i in shown {
        let truth = &validation[i].image;
        let (w, h) = truth.dimensions();
        let error = error_map(&renders[i], &composite(truth, WHITE));
        rows[1].push(small(truth));
        rows[2].push(small(&to_picture(&renders[i], w, h)));
        rows[3].push(small(&to_picture(&error, w, h)));
    }
    let mut bytes = Vec::new();
    let sheet = image::DynamicImage::ImageRgba8(sheet(&rows)).into_rgb8();
    sheet.write_with_encoder(JpegEncoder::new_with_quality(&mut bytes, QUALITY))?;
    Ok(bytes)
}

/// The picture within [`SIDE`], aspect kept. Transparent parts let the sheet's white through.
fn small(image: &RgbaImage) -> RgbaImage {
    let (width, height) = shrunk_size(image.dimensions(), SIDE);
    resize_area(image, width, height)
}

/// White at 0, red at a quarter, black at a half and beyond.
fn error_map(render: &[f32], truth: &[f32]) -> Vec<f32> {
    let pixels = render.as_chunks::<3>().0.iter().zip(truth.as_chunks::<3>().0);
    pixels
        .flat_map(|(a, b)| {
            let error = 4.0 * (0..3).map(|c| (a[c] - b[c]).abs()).sum::<f32>() / 3.0;
            let pale = (1.0 - error).clamp(0.0, 1.0);
            [(2.0 - error).clamp(0.0, 1.0), pale, pale]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use freerange_scene::camera::Camera;
    use glam::DVec3;
    use image::Rgba;

    use super::*;

    #[test]
    fn errors_get_darker() {
        let map = error_map(&[0.0; 12], &[[0.0; 3], [0.25; 3], [0.5; 3], [1.0; 3]].concat());
        assert_eq!(map, [[1.0, 1.0, 1.0], [1.0, 0.0, 0.0], [0.0; 3], [0.0; 3]].concat());
    }

    #[test]
    fn a_strip_has_four_rows_of_at_most_six_validation_views() {
        let camera = Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, 0.8, 256, 128);
        let view =
            |c: u8| View { name: String::new(), camera, image: RgbaImage::from_pixel(256, 128, Rgba([c, c, c, 255])) };
        let validation: Vec<View> = (0..12).map(|i| view(i * 20)).collect();
        let renders = vec![vec![0.5; 256 * 128 * 3]; 12];
        let bytes = strip(&[view(9), view(10)], &validation, &renders).unwrap();
        let sheet = image::load_from_memory(&bytes).unwrap().into_rgb8();
        assert_eq!(sheet.dimensions(), (6 * 128, 4 * 64));
        // The third row shows the renders, the place right of the two inputs is white.
        assert!(sheet.get_pixel(64, 2 * 64 + 32).0.iter().all(|c| c.abs_diff(128) < 6));
        assert!(sheet.get_pixel(500, 32).0.iter().all(|c| *c > 250));
    }
}
