//! Cutting an object out of one plain background colour.

use image::{Rgba, RgbaImage};
use std::collections::VecDeque;

/// How far a pixel may lie from the background colour, in 8-bit steps of its worst channel, and still be
/// background: enough for JPEG's noise.
pub const BACKGROUND_TOLERANCE: u8 = 12;
/// The part of the image's border that must be background.
const BORDER_SHARE: f64 = 0.9;
/// Objects smaller than this part of the image are not believed.
const SMALLEST_OBJECT: f64 = 1e-4;
/// Width of the soft edge in pixels: where a camera or renderer mixes object and background.
const EDGE: u8 = 2;

fn near(p: &Rgba<u8>, background: [u8; 3]) -> bool {
    (0..3).all(|c| p[c].abs_diff(background[c]) <= BACKGROUND_TOLERANCE)
}

/// Gives an opaque image an alpha channel: `(the object, the background colour)`, or what it shows instead.
///
/// The background is the median colour of the image's border, and must fill nine tenths of it within
/// [`BACKGROUND_TOLERANCE`]. It is flooded from the border, so that parts of the object may have its colour; what
/// the object encloses (a cup's handle) stays opaque. Along the edge, two pixels wide, each pixel is taken as a
/// mixture of the background and the object's colour next to it.
pub fn cut_out(image: &RgbaImage) -> Result<(RgbaImage, [u8; 3]), String> {
    let (w, h) = image.dimensions();
    if w < 8 || h < 8 {
        return Err(format!("an image of {w} x {h} pixels, too small to tell"));
    }
    let border: Vec<(u32, u32)> =
        (0..w).flat_map(|x| [(x, 0), (x, h - 1)]).chain((1..h - 1).flat_map(|y| [(0, y), (w - 1, y)])).collect();
    let background: [u8; 3] = std::array::from_fn(|c| {
        let mut values: Vec<u8> = border.iter().map(|&(x, y)| image.get_pixel(x, y)[c]).collect();
        values.sort_unstable();
        values[values.len() / 2]
    });
    let seeds: Vec<(u32, u32)> =
        border.iter().copied().filter(|&(x, y)| near(image.get_pixel(x, y), background)).collect();
    let share = seeds.len() as f64 / border.len() as f64;
    if share < BORDER_SHARE {
        return Err(format!("a border of which only {:.0} % has one colour", 100.0 * share));
    }

    // 0 is background, 1.. the distance to it (chessboard), `u8::MAX` whatever lies deeper.
    let mut depth = vec![u8::MAX; w as usize * h as usize];
    let index = |x: u32, y: u32| y as usize * w as usize + x as usize;
    let mut queue: VecDeque<(u32, u32)> = VecDeque::new();
    for (x, y) in seeds {
        depth[index(x, y)] = 0;
        queue.push_back((x, y));
    }
    while let Some((x, y)) = queue.pop_front() {
        let around = [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)];
        for (nx, ny) in around.into_iter().filter(|&(nx, ny)| nx < w && ny < h) {
            if depth[index(nx, ny)] != 0 && near(image.get_pixel(nx, ny), background) {
                depth[index(nx, ny)] = 0;
                queue.push_back((nx, ny));
            }
        }
    }
    let object = depth.iter().filter(|d| **d != 0).count();
    if (object as f64) < SMALLEST_OBJECT * depth.len() as f64 {
        return Err(format!("nothing but the colour {background:?}"));
    }
    let window = |x: u32, y: u32, r: u32| {
        let (xs, ys) = (x.saturating_sub(r)..=(x + r).min(w - 1), y.saturating_sub(r)..=(y + r).min(h - 1));
        ys.flat_map(move |y| xs.clone().map(move |x| (x, y)))
    };
    for ring in 1..=EDGE {
        for y in 0..h {
            for x in 0..w {
                if depth[index(x, y)] == u8::MAX && window(x, y, 1).any(|(x, y)| depth[index(x, y)] == ring - 1) {
                    depth[index(x, y)] = ring;
                }
            }
        }
    }

    let mut out = image.clone();
    for (x, y, p) in out.enumerate_pixels_mut() {
        match depth[index(x, y)] {
            0 => *p = Rgba([0; 4]),
            u8::MAX => p[3] = 255,
            _ => {
                let inside = window(x, y, u32::from(EDGE) + 1).filter(|&(x, y)| depth[index(x, y)] == u8::MAX);
                *p = unmix(*p, background, inside.map(|(x, y)| image.get_pixel(x, y)));
            }
        }
    }
    Ok((out, background))
}

/// Splits a pixel into `alpha object + (1 - alpha) background`, with the object's colour taken from its neighbours.
/// Where those are missing or look like the background, the pixel stays opaque.
fn unmix<'a>(p: Rgba<u8>, background: [u8; 3], inside: impl Iterator<Item = &'a Rgba<u8>>) -> Rgba<u8> {
    let (mut sum, mut count) = ([0.0f32; 3], 0.0f32);
    for q in inside {
        (0..3).for_each(|c| sum[c] += f32::from(q[c]));
        count += 1.0;
    }
    let opaque = Rgba([p[0], p[1], p[2], 255]);
    if count == 0.0 {
        return opaque;
    }
    let b = background.map(f32::from);
    let object: [f32; 3] = std::array::from_fn(|c| sum[c] / count - b[c]);
    let (mut along, mut length) = (0.0, 0.0);
    for c in 0..3 {
        along += (f32::from(p[c]) - b[c]) * object[c];
        length += object[c] * object[c];
    }
    let contrast = 2.0 * f32::from(BACKGROUND_TOLERANCE);
    if length < contrast * contrast {
        return opaque;
    }
    let alpha = (along / length).clamp(0.0, 1.0);
    if alpha >= 0.995 {
        return opaque;
    }
    if alpha < 0.004 {
        return Rgba([0; 4]);
    }
    let colour = |c: usize| (b[c] + (f32::from(p[c]) - b[c]) / alpha).round().clamp(0.0, 255.0) as u8;
    Rgba([colour(0), colour(1), colour(2), (255.0 * alpha).round() as u8])
}
