//! Small operations on RGBA images: composite, resize, convert, put side by side.
//!
//! Images store straight alpha. Whatever mixes pixels mixes them premultiplied, so that the color of transparent
//! pixels never bleeds into the result.

use std::collections::VecDeque;

use image::{Rgba, RgbaImage};

const TO_UNIT: f32 = 1.0 / 255.0;

/// The image over a plain background: `[h, w, 3]` in `[0, 1]`.
pub fn composite(image: &RgbaImage, background: [f32; 3]) -> Vec<f32> {
    let mut out = vec![0.0; image.as_raw().len() / 4 * 3];
    for (target, p) in out.as_chunks_mut::<3>().0.iter_mut().zip(image.as_raw().as_chunks::<4>().0) {
        let alpha = f32::from(p[3]) * TO_UNIT;
        for c in 0..3 {
            target[c] = alpha * (f32::from(p[c]) * TO_UNIT) + (1.0 - alpha) * background[c];
        }
    }
    out
}

/// The image's values in `[0, 1]`, straight alpha: `[h, w, 4]`.
pub fn to_f32_rgba(image: &RgbaImage) -> Vec<f32> {
    image.as_raw().iter().map(|&v| f32::from(v) * TO_UNIT).collect()
}

/// The opaque picture of `rgb` (`[h, w, 3]`), clamped to `[0, 1]` and rounded to 8 bits.
///
/// # Panics
/// If there are fewer values.
pub fn to_picture(rgb: &[f32], width: u32, height: u32) -> RgbaImage {
    let pixels = rgb.as_chunks::<3>().0;
    RgbaImage::from_fn(width, height, |x, y| {
        let [r, g, b] =
            pixels[y as usize * width as usize + x as usize].map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8);
        Rgba([r, g, b, 255])
    })
}

/// Pictures in rows on a white sheet, which shows where they are transparent.
pub fn sheet(rows: &[Vec<RgbaImage>]) -> RgbaImage {
    let width = rows.iter().map(|r| r.iter().map(|p| p.width()).sum::<u32>()).max().unwrap_or(1).max(1);
    let heights: Vec<u32> = rows.iter().map(|r| r.iter().map(|p| p.height()).max().unwrap_or(0)).collect();
    let mut sheet = RgbaImage::from_pixel(width, heights.iter().sum::<u32>().max(1), Rgba([255; 4]));
    let mut y = 0;
    for (row, height) in rows.iter().zip(heights) {
        let mut x = 0;
        for picture in row {
            image::imageops::overlay(&mut sheet, picture, x, y);
            x += i64::from(picture.width());
        }
        y += i64::from(height);
    }
    sheet
}

/// Width and height with a longest side of at most `longest`, aspect kept; at least 1 pixel each.
pub fn shrunk_size((width, height): (u32, u32), longest: u32) -> (u32, u32) {
    let now = width.max(height);
    if now <= longest {
        return (width, height);
    }
    let shrink = |side: u32| ((f64::from(side) * f64::from(longest) / f64::from(now)).round() as u32).max(1);
    (shrink(width), shrink(height))
}

/// One output sample along an axis: the first input sample it takes, and the weights of those from there on.
struct Tap {
    first: usize,
    weights: Vec<f32>,
    /// 1 / sum of the weights. Kept apart: for whole factors the weights are ones and all sums stay exact.
    scale: f32,
}

/// Shrinking: each output takes what its interval covers. Growing: linear interpolation between pixel centers.
fn taps(from: usize, to: usize) -> Vec<Tap> {
    let ratio = from as f64 / to as f64;
    (0..to)
        .map(|i| {
            let (start, weights): (usize, Vec<f32>) = if to <= from {
                // Products of whole numbers by one division: whole factors give whole borders.
                let border = |k: usize| (k * from) as f64 / to as f64;
                let (low, high) = (border(i), border(i + 1));
                let (first, last) = (low.floor() as usize, (high.ceil() as usize).min(from));
                let covered = |j: usize| high.min((j + 1) as f64) - low.max(j as f64);
                (first, (first..last).map(|j| covered(j) as f32).collect())
            } else {
                let x = ((i as f64 + 0.5) * ratio - 0.5).clamp(0.0, (from - 1) as f64);
                let first = (x.floor() as usize).min(from.saturating_sub(2));
                let f = (x - first as f64) as f32;
                (first, if from == 1 { vec![1.0] } else { vec![1.0 - f, f] })
            };
            let scale = (1.0 / weights.iter().map(|&w| f64::from(w)).sum::<f64>()) as f32;
            Tap { first: start, weights, scale }
        })
        .collect()
}

/// A row of pixels at another width, premultiplied: in units of 255 * 255, alpha of 255.
fn narrow(row: &[[u8; 4]], across: &[Tap], target: &mut [[f32; 4]]) {
    for (tap, t) in across.iter().zip(target) {
        *t = [0.0; 4];
        for (p, &weight) in row[tap.first..].iter().zip(&tap.weights) {
            let wa = weight * f32::from(p[3]);
            t[0] += wa * f32::from(p[0]);
            t[1] += wa * f32::from(p[1]);
            t[2] += wa * f32::from(p[2]);
            t[3] += wa;
        }
    }
}

/// The image at another size: the area average where it shrinks, linear interpolation where it grows, each axis by
/// itself, in premultiplied alpha. Fully transparent results are black. Zero sizes give an empty image.
pub fn resize_area(image: &RgbaImage, width: u32, height: u32) -> RgbaImage {
    let (w, h) = (image.width() as usize, image.height() as usize);
    let (nw, nh) = (width as usize, height as usize);
    if (w, h) == (nw, nh) {
        return image.clone();
    }
    let mut out = RgbaImage::new(width, height);
    if w * h * nw * nh == 0 {
        return out;
    }
    let (across, down) = (taps(w, nw), taps(h, nh));
    let source = image.as_raw().as_chunks::<4>().0;

    // Along the rows first. Narrowed rows, [nw] of (a r, a g, a b, a) in units of 255 * 255 and 255, are made when they are
    // needed and kept as long: all of a photo's would take as much memory as the photo.
    let (mut kept, mut first) = (VecDeque::<Vec<[f32; 4]>>::new(), 0);
    let mut sums = vec![[0.0f32; 4]; nw];
    for (tap, target) in down.iter().zip(out.as_chunks_mut::<4>().0.chunks_exact_mut(nw)) {
        let mut spare = Vec::new();
        while first < tap.first {
            spare.extend(kept.pop_front());
            first += 1;
        }
        while kept.len() < tap.weights.len() {
            let number = first + kept.len();
            let mut row = spare.pop().unwrap_or_else(|| vec![[0.0; 4]; nw]);
            narrow(&source[number * w..][..w], &across, &mut row);
            kept.push_back(row);
        }
        sums.fill([0.0; 4]);
        for (row, &weight) in kept.iter().zip(&tap.weights) {
            for (s, v) in sums.iter_mut().zip(row) {
                for c in 0..4 {
                    s[c] += weight * v[c];
                }
            }
        }
        for ((t, s), column) in target.iter_mut().zip(&sums).zip(&across) {
            let alpha = (s[3] * tap.scale * column.scale + 0.5) as u8;
            if alpha > 0 {
                let color = |c: usize| (s[c] / s[3] + 0.5) as u8;
                *t = [color(0), color(1), color(2), alpha];
            }
        }
    }
    out
}
