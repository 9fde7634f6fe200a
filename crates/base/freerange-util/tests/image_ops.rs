//! Image helpers against their slow, obvious twins.

use freerange_util::image_ops::{composite, resize_area, sheet, to_f32_rgba, to_picture};
use image::{Rgba, RgbaImage};
use proptest::prelude::*;

fn image(width: u32, height: u32) -> impl Strategy<Value = RgbaImage> {
    let alpha = prop_oneof![Just(0u8), Just(255), any::<u8>()];
    prop::collection::vec((any::<[u8; 3]>(), alpha), (width * height) as usize).prop_map(move |pixels| {
        RgbaImage::from_fn(width, height, |x, y| {
            let ([r, g, b], a) = pixels[(y * width + x) as usize];
            Rgba([r, g, b, a])
        })
    })
}

/// Premultiplied mean of the input over a rectangle, weighted by overlap.
fn area_mean(image: &RgbaImage, x0: f64, x1: f64, y0: f64, y1: f64) -> [f64; 4] {
    let mut sum = [0.0; 4];
    for (x, y, p) in image.enumerate_pixels() {
        let overlap = |low: f64, high: f64, at: u32| (high.min(f64::from(at) + 1.0) - low.max(f64::from(at))).max(0.0);
        let weight = overlap(x0, x1, x) * overlap(y0, y1, y);
        let alpha = weight * f64::from(p[3]);
        for c in 0..3 {
            sum[c] += alpha * f64::from(p[c]);
        }
        sum[3] += alpha;
    }
    let color = |c: usize| if sum[3] > 0.0 { sum[c] / sum[3] } else { 0.0 };
    [color(0), color(1), color(2), sum[3] / ((x1 - x0) * (y1 - y0))]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn shrinking_is_the_area_mean(
        (image, nw, nh) in (1u32..24, 1u32..24).prop_flat_map(|(w, h)| (image(w, h), 1..=w, 1..=h))
    ) {
        let small = resize_area(&image, nw, nh);
        let (sx, sy) = (f64::from(image.width()) / f64::from(nw), f64::from(image.height()) / f64::from(nh));
        for (x, y, p) in small.enumerate_pixels() {
            let (x, y) = (f64::from(x), f64::from(y));
            let expected = area_mean(&image, x * sx, (x + 1.0) * sx, y * sy, (y + 1.0) * sy);
            for c in 0..4 {
                // Half a step of rounding; colors of nearly transparent pixels are not stored.
                let tolerance = if p[3] == 0 && c < 3 { 255.0 } else { 0.501 };
                prop_assert!((f64::from(p[c]) - expected[c]).abs() <= tolerance, "{:?} {:?}", p, expected);
            }
        }
    }

    #[test]
    fn growing_stays_within_the_image_and_keeps_plain_colors(
        (image, nw, nh) in (1u32..8, 1u32..8).prop_flat_map(|(w, h)| (image(w, h), w..4 * w, h..4 * h))
    ) {
        let large = resize_area(&image, nw, nh);
        prop_assert_eq!(large.dimensions(), (nw, nh));
        let plain = RgbaImage::from_pixel(image.width(), image.height(), Rgba([10, 200, 30, 77]));
        prop_assert!(resize_area(&plain, nw, nh).pixels().all(|p| *p == Rgba([10, 200, 30, 77])));
        let most = image.pixels().map(|p| p[3]).max();
        prop_assert!(large.pixels().map(|p| p[3]).max() <= most);
    }

    #[test]
    fn composite_mixes_with_the_background(image in image(5, 4)) {
        let background = [0.2, 0.5, 0.9];
        let mixed = composite(&image, background);
        let values = to_f32_rgba(&image);
        prop_assert_eq!((mixed.len(), values.len()), (60, 80));
        for (i, p) in image.pixels().enumerate() {
            let alpha = f32::from(p[3]) / 255.0;
            for c in 0..3 {
                let expected = alpha * f32::from(p[c]) / 255.0 + (1.0 - alpha) * background[c];
                prop_assert!((mixed[3 * i + c] - expected).abs() < 1e-6);
                prop_assert!((values[4 * i + c] - f32::from(p[c]) / 255.0).abs() < 1e-6);
            }
            prop_assert!((values[4 * i + 3] - alpha).abs() < 1e-6);
        }
    }
}

#[test]
fn a_linear_ramp_grows_linearly() {
    let ramp = RgbaImage::from_fn(2, 1, |x, _| Rgba([100 * x as u8, 0, 0, 255]));
    let red: Vec<u8> = resize_area(&ramp, 4, 1).pixels().map(|p| p[0]).collect();
    assert_eq!(red, [0, 25, 75, 100]);
}

#[test]
fn empty_sizes_give_empty_images() {
    assert_eq!(resize_area(&RgbaImage::new(3, 3), 0, 2).dimensions(), (0, 2));
    assert_eq!(resize_area(&RgbaImage::new(0, 0), 2, 2), RgbaImage::new(2, 2));
}

#[test]
fn pictures_round_clamp_and_stand_in_rows() {
    let picture = to_picture(&[-1.0, 0.5, 2.0, 0.0, 0.25, 1.0], 2, 1);
    assert_eq!(picture.as_raw()[..], [0, 128, 255, 255, 0, 64, 255, 255]);
    let clear = RgbaImage::from_pixel(1, 2, Rgba([9, 9, 9, 0]));
    let two = sheet(&[vec![picture.clone(), clear], vec![picture.clone()]]);
    assert_eq!(two.dimensions(), (3, 3));
    assert_eq!((two.get_pixel(1, 0), two.get_pixel(1, 2)), (picture.get_pixel(1, 0), picture.get_pixel(1, 0)));
    // White where nothing is or what is there is transparent.
    for (x, y) in [(2, 0), (2, 1), (0, 1), (2, 2)] {
        assert_eq!(two.get_pixel(x, y), &Rgba([255; 4]), "{x} {y}");
    }
    assert_eq!(sheet(&[]).dimensions(), (1, 1));
}

#[test]
fn sizes_shrink_by_the_longest_side() {
    use freerange_util::image_ops::shrunk_size;
    assert_eq!(shrunk_size((640, 480), 320), (320, 240));
    assert_eq!(shrunk_size((480, 640), 640), (480, 640));
    assert_eq!(shrunk_size((1000, 1), 10), (10, 1));
}
