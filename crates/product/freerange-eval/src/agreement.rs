//! Whether print is where it should be: agreement of gradients inside the object.

use freerange_scene::camera::View;
use glam::DVec2;
use image::RgbaImage;

/// Alpha of pixels of the object.
const SOLID: u8 = 253;
/// How far from any other pixel they are, in parts of the image's width, and at least in pixels.
const EDGE: (u32, u32) = (85, 2);
/// Weights of red, green and blue in the brightness.
const BRIGHTNESS: [f32; 3] = [0.299, 0.587, 0.114];

/// The correlation, over all views, of the gradients of brightness of `renders`, `[height, width, 3]` over white, with the
/// true ones, inside the object: 1 where the same print is in the same place, 0 where none or another is. `None` where nothing
/// inside the object has an edge.
pub fn agreement(renders: &[Vec<f32>], views: &[View], truths: &[Vec<f32>]) -> Option<f64> {
    let (mut both, mut of_render, mut of_truth) = (0.0, 0.0, 0.0);
    for ((render, truth), view) in renders.iter().zip(truths).zip(views) {
        let width = view.image.width() as usize;
        for at in inside(&view.image) {
            let [found, expected] = [render, truth].map(|image| gradient(image, width, at));
            both += found.dot(expected);
            of_render += found.length_squared();
            of_truth += expected.length_squared();
        }
    }
    (of_truth > 0.0).then(|| both / (of_render * of_truth).sqrt().max(f64::MIN_POSITIVE))
}

/// Pixels of the object that are not near its edge.
fn inside(image: &RgbaImage) -> Vec<usize> {
    let (w, h) = image.dimensions();
    let edge = (w / EDGE.0).max(EDGE.1);
    // Pixels of the object in a row, up to each pixel; of each column those whose whole stretch of a row is.
    let whole = |len: u32, solid: &dyn Fn(u32) -> bool| {
        let mut sum = 0;
        let until: Vec<u32> = std::iter::once(0).chain((0..len).map(|i| (sum += u32::from(solid(i)), sum).1)).collect();
        let stretch = move |i: u32| {
            i >= edge && i + edge < len && until[(i + edge + 1) as usize] - until[(i - edge) as usize] == 2 * edge + 1
        };
        (0..len).map(stretch).collect::<Vec<bool>>()
    };
    let rows: Vec<Vec<bool>> = (0..h).map(|y| whole(w, &|x| image.get_pixel(x, y).0[3] >= SOLID)).collect();
    let columns = (0..w).map(|x| whole(h, &|y| rows[y as usize][x as usize]));
    let of_column = |(x, column): (usize, Vec<bool>)| {
        column.into_iter().enumerate().filter(|(_, inside)| *inside).map(move |(y, _)| y * w as usize + x)
    };
    columns.enumerate().flat_map(of_column).collect()
}

/// The gradient of brightness at a pixel that has neighbors, per pixel.
fn gradient(image: &[f32], width: usize, at: usize) -> DVec2 {
    let brightness = |at: usize| {
        let pixel = &image[3 * at..3 * at + 3];
        f64::from(pixel.iter().zip(BRIGHTNESS).map(|(x, weight)| weight * x).sum::<f32>())
    };
    0.5 * DVec2::new(brightness(at + 1) - brightness(at - 1), brightness(at + width) - brightness(at - width))
}

#[cfg(test)]
mod tests {
    use freerange_scene::camera::{Camera, image_ops::composite};
    use glam::DVec3;
    use image::Rgba;

    use super::*;

    /// Stripes of brightness on an object that fills the columns from 10 on.
    fn view(shade: impl Fn(u32, u32) -> f64) -> View {
        let camera = Camera::look_at(DVec3::new(0.0, -2.0, 0.0), DVec3::ZERO, DVec3::Z, 0.6, 64, 48);
        let pixel = |x: u32, y: u32| {
            let shade = (255.0 * shade(x, y)).round() as u8;
            Rgba([shade, shade, shade, if x < 10 { 0 } else { 255 }])
        };
        View { name: "view".into(), camera, image: RgbaImage::from_fn(64, 48, pixel) }
    }

    #[test]
    fn print_agrees_where_it_is_in_its_place() {
        let stripes = |period: f64, shift: f64| {
            move |x: u32, _: u32| 0.5 + 0.4 * (std::f64::consts::TAU * (f64::from(x) - shift) / period).sin()
        };
        let of = |truth: &View, render: &View| {
            let over = |v: &View| vec![composite(&v.image, [1.0; 3])];
            agreement(&over(render), std::slice::from_ref(truth), &over(truth))
        };
        let truth = view(stripes(8.0, 0.0));
        for (render, expected) in [
            (view(stripes(8.0, 0.0)), 1.0),
            (view(stripes(8.0, 4.0)), -1.0),
            (view(stripes(8.0, 2.0)), 0.0),
            (view(stripes(4.0, 0.0)), 0.0),
            (view(|_, y| 0.5 + 0.01 * f64::from(y)), 0.0),
            (view(|_, _| 0.5), 0.0),
        ] {
            let found = of(&truth, &render).unwrap();
            assert!((found - expected).abs() < 0.06, "{found} instead of {expected}");
        }
        // The outline is no print.
        assert_eq!(of(&view(|_, _| 0.3), &truth), None);
        let nothing = View { image: RgbaImage::new(64, 48), ..view(|_, _| 0.0) };
        assert_eq!(of(&nothing, &truth), None);
    }

    #[test]
    fn pixels_near_an_edge_are_left_out() {
        let found = inside(&view(|_, _| 0.5).image);
        // Two pixels from the object's left side and from the image's three others.
        assert_eq!(found.len(), (64 - 12 - 2) * (48 - 4));
        assert!(found.iter().all(|at| (12..62).contains(&(at % 64)) && (2..46).contains(&(at / 64))));
    }
}
