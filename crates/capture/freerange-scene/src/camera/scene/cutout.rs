//! Cutting an object out of one plain background color.

use image::{Rgba, RgbaImage};
use std::collections::VecDeque;

/// How far a pixel may lie from the background color, in 8-bit steps of its worst channel, and still be
/// background: enough for JPEG's noise.
pub const BACKGROUND_TOLERANCE: u8 = 12;
/// The part of the image's border that must be background.
const BORDER_SHARE: f64 = 0.9;
/// Objects smaller than this part of the image are not believed.
const SMALLEST_OBJECT: f64 = 1e-4;
/// Width of the soft edge in pixels: where a camera or renderer mixes object and background.
const EDGE: u8 = 2;
/// What a rim of nothing leaves of an image at least, and how wide it is at most where it is narrowest; shares of the image.
const RIM_FILL: f64 = 0.6;
const RIM_WIDTH: f64 = 0.1;

fn near(p: &Rgba<u8>, background: [u8; 3]) -> bool {
    (0..3).all(|c| p[c].abs_diff(background[c]) <= BACKGROUND_TOLERANCE)
}

/// Gives an image an alpha channel: `(the object, the background color)`, or what it shows instead.
///
/// The background is the median color of the image's border, and must fill nine tenths of it within
/// [`BACKGROUND_TOLERANCE`]. It is flooded from the border, so that parts of the object may have its color; what
/// the object encloses (a cup's handle) stays opaque. Along the edge, two pixels wide, each pixel is taken as a
/// mixture of the background and the object's color next to it.
///
/// Undistorted photos have an empty rim: transparent, or black. It is no backdrop. The border is then that of what is shown.
pub fn cut_out(image: &RgbaImage) -> Result<(RgbaImage, [u8; 3]), String> {
    let found = find_backdrop(image)?;
    Ok((found.separate(image), found.color))
}

/// The plain backdrop of an image, or what it shows instead: what [`cut_out`] looks for.
pub(crate) fn find_backdrop(image: &RgbaImage) -> Result<Backdrop, String> {
    let (w, h) = image.dimensions();
    if w < 8 || h < 8 {
        return Err(format!("an image of {w} x {h} pixels, too small to judge"));
    }
    let shown: Vec<bool> = image.pixels().map(|p| p[3] >= 128).collect();
    let found = backdrop(image, &shown);
    // Black along the border may be a rim, with the backdrop within it.
    if found.as_ref().is_ok_and(|b| b.color.iter().any(|c| *c > BACKGROUND_TOLERANCE)) {
        return found;
    }
    if let Some(inner) = without_black_rim(image, &shown)
        && let Ok(within) = backdrop(image, &inner)
        && within.color.iter().any(|c| *c > 2 * BACKGROUND_TOLERANCE)
    {
        return Ok(within);
    }
    found
}

/// A plain backdrop: its color, and for every pixel 0 where it or nothing is shown, else `u8::MAX`.
pub(crate) struct Backdrop {
    color: [u8; 3],
    depth: Vec<u8>,
}

/// Marks what is reached from `seeds` over pixels that are `inside`; the seeds themselves too.
fn flood(w: u32, h: u32, seeds: &[(u32, u32)], inside: impl Fn(u32, u32) -> bool) -> Vec<bool> {
    let index = |x: u32, y: u32| y as usize * w as usize + x as usize;
    let mut reached = vec![false; w as usize * h as usize];
    let mut queue: VecDeque<(u32, u32)> = seeds.iter().copied().collect();
    seeds.iter().for_each(|&(x, y)| reached[index(x, y)] = true);
    while let Some((x, y)) = queue.pop_front() {
        for (nx, ny) in around(x, y, w, h) {
            if !reached[index(nx, ny)] && inside(nx, ny) {
                reached[index(nx, ny)] = true;
                queue.push_back((nx, ny));
            }
        }
    }
    reached
}

/// The four neighbors within the image.
fn around(x: u32, y: u32, w: u32, h: u32) -> impl Iterator<Item = (u32, u32)> {
    [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)]
        .into_iter()
        .filter(move |&(x, y)| x < w && y < h)
}

/// The pixels along the image's border.
fn frame_of(w: u32, h: u32) -> Vec<(u32, u32)> {
    (0..w).flat_map(|x| [(x, 0), (x, h - 1)]).chain((1..h - 1).flat_map(|y| [(0, y), (w - 1, y)])).collect()
}

/// The plain backdrop of what is `shown`, or what is there instead.
fn backdrop(image: &RgbaImage, shown: &[bool]) -> Result<Backdrop, String> {
    let (w, h) = image.dimensions();
    let index = |x: u32, y: u32| y as usize * w as usize + x as usize;
    // What is empty and joined to the image's border, and the pixels along it.
    let frame = frame_of(w, h);
    let empty_seeds: Vec<(u32, u32)> = frame.iter().copied().filter(|&(x, y)| !shown[index(x, y)]).collect();
    let empty = flood(w, h, &empty_seeds, |x, y| !shown[index(x, y)]);
    let mut border: Vec<(u32, u32)> = frame.into_iter().filter(|&(x, y)| shown[index(x, y)]).collect();
    if !empty_seeds.is_empty() {
        for y in 1..h - 1 {
            border.extend(
                (1..w - 1)
                    .map(|x| (x, y))
                    .filter(|&(x, y)| shown[index(x, y)] && around(x, y, w, h).any(|(x, y)| empty[index(x, y)])),
            );
        }
    }
    if border.is_empty() {
        return Err("an image that is transparent everywhere".into());
    }
    let color: [u8; 3] = std::array::from_fn(|c| {
        let mut values: Vec<u8> = border.iter().map(|&(x, y)| image.get_pixel(x, y)[c]).collect();
        values.sort_unstable();
        values[values.len() / 2]
    });
    let seeds: Vec<(u32, u32)> = border.iter().copied().filter(|&(x, y)| near(image.get_pixel(x, y), color)).collect();
    let share = seeds.len() as f64 / border.len() as f64;
    if share < BORDER_SHARE {
        return Err(format!("a border of which only {:.0} % has one color", 100.0 * share));
    }
    let reached = flood(w, h, &seeds, |x, y| shown[index(x, y)] && near(image.get_pixel(x, y), color));
    let depth: Vec<u8> = reached.iter().zip(shown).map(|(r, s)| if *r || !s { 0 } else { u8::MAX }).collect();
    let object = depth.iter().filter(|d| **d != 0).count();
    if (object as f64) < SMALLEST_OBJECT * depth.len() as f64 {
        return Err(format!("nothing but the color {color:?}"));
    }
    Ok(Backdrop { color, depth })
}

/// What is shown within a black rim: none where black along the border is no such rim, but a backdrop or the object.
fn without_black_rim(image: &RgbaImage, shown: &[bool]) -> Option<Vec<bool>> {
    let (w, h) = image.dimensions();
    let inner = inside_black(image, shown);
    fills_frame(&inner, w, h, RIM_FILL).then_some(inner)
}

/// What is shown within the black along the border of an image, where that black is its backdrop.
pub(crate) fn within_black(image: &RgbaImage) -> Option<Vec<bool>> {
    let (w, h) = image.dimensions();
    let frame = if w < 8 || h < 8 { Vec::new() } else { frame_of(w, h) };
    // Nine tenths are, if it is; a look at the border is cheap.
    let black = frame.iter().filter(|(x, y)| near(image.get_pixel(*x, *y), [0; 3])).count();
    if 2 * black <= frame.len() || find_backdrop(image).ok()?.color.iter().any(|c| *c > BACKGROUND_TOLERANCE) {
        return None;
    }
    let shown: Vec<bool> = image.pixels().map(|p| p[3] >= 128).collect();
    Some(inside_black(image, &shown))
}

/// What is shown and not joined to the image's border over black.
fn inside_black(image: &RgbaImage, shown: &[bool]) -> Vec<bool> {
    let (w, h) = image.dimensions();
    let index = |x: u32, y: u32| y as usize * w as usize + x as usize;
    let black = |x: u32, y: u32| !shown[index(x, y)] || near(image.get_pixel(x, y), [0; 3]);
    let seeds: Vec<(u32, u32)> = frame_of(w, h).into_iter().filter(|&(x, y)| black(x, y)).collect();
    let rim = flood(w, h, &seeds, black);
    // Where it ends it is mixed with what it surrounds.
    let within = |x: u32, y: u32| {
        let (xs, ys) = (
            x.saturating_sub(EDGE.into())..=(x + u32::from(EDGE)).min(w - 1),
            y.saturating_sub(EDGE.into())..=(y + u32::from(EDGE)).min(h - 1),
        );
        !ys.into_iter().any(|y| xs.clone().any(|x| rim[index(x, y)]))
    };
    (0..h).flat_map(|y| (0..w).map(move |x| (x, y))).map(|(x, y)| within(x, y)).collect()
}

/// Whether what is shown comes near all four sides of the image, and fills at least this share of it: all but a rim.
pub fn fills_frame(shown: &[bool], w: u32, h: u32, least: f64) -> bool {
    let (mut low, mut high) = ((w, h), (0, 0));
    let mut count = 0usize;
    for (i, _) in shown.iter().enumerate().filter(|(_, s)| **s) {
        let (x, y) = ((i % w as usize) as u32, (i / w as usize) as u32);
        low = (low.0.min(x), low.1.min(y));
        high = (high.0.max(x), high.1.max(y));
        count += 1;
    }
    let near = |low: u32, high: u32, side: u32| {
        let margin = RIM_WIDTH * f64::from(side) + f64::from(EDGE);
        f64::from(low) <= margin && f64::from(high) >= f64::from(side) - 1.0 - margin
    };
    count as f64 >= least * shown.len() as f64 && near(low.0, high.0, w) && near(low.1, high.1, h)
}

impl Backdrop {
    /// The object before it, with its soft edge. `image`: the one that it was found in.
    pub(crate) fn separate(&self, image: &RgbaImage) -> RgbaImage {
        let (w, h) = image.dimensions();
        let index = |x: u32, y: u32| y as usize * w as usize + x as usize;
        let (background, mut depth) = (self.color, self.depth.clone());
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
        out
    }
}

/// Splits a pixel into `alpha object + (1 - alpha) background`, with the object's color taken from its neighbors.
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
    let color = |c: usize| (b[c] + (f32::from(p[c]) - b[c]) / alpha).round().clamp(0.0, 255.0) as u8;
    Rgba([color(0), color(1), color(2), (255.0 * alpha).round() as u8])
}
