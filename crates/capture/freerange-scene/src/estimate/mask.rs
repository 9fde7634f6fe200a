//! Masks as pictures, `[h, w]`: what is tidied, grown, blurred and made an alpha channel.

use super::picture::{Picture, bilinear};

/// Parts of a mask, beside its largest, of which less than this share lies within the hull are something else that stands there.
const WITHIN: f32 = 0.5;
/// Holes whose mean log odds are less stay open: handles have them. Others are print in the background's color.
const OPEN: f32 = -1.0;

/// Fills holes that are not background, and drops parts that are small beside the largest or that lie outside of `outline`, where the hull
/// appears.
pub fn tidy(mask: &[bool], odds: &[f32], outline: Option<&[bool]>, picture: &Picture) -> Vec<bool> {
    let (w, h) = (picture.width(), picture.height());
    let mut out = mask.to_vec();
    let holes = parts(mask, false, w, h);
    for hole in holes.iter().filter(|p| !p.iter().any(|k| k % w == 0 || k % w + 1 == w || *k < w || k + w >= w * h)) {
        let mean = hole.iter().map(|k| odds[*k]).sum::<f32>() / hole.len() as f32;
        if mean > OPEN || hole.len() * 2000 < w * h {
            hole.iter().for_each(|k| out[*k] = true);
        }
    }
    let pieces = parts(&out, true, w, h);
    let largest = pieces.iter().map(Vec::len).max().unwrap_or(0);
    let elsewhere = |piece: &[usize]| {
        outline.is_some_and(|o| (piece.iter().filter(|k| o[**k]).count() as f32) < WITHIN * piece.len() as f32)
    };
    for piece in pieces.iter().filter(|p| p.len() < largest && (p.len() * 10 < largest || elsewhere(p))) {
        piece.iter().for_each(|k| out[*k] = false);
    }
    out
}

/// Connected pixels (four neighbors) with this value.
fn parts(mask: &[bool], value: bool, w: usize, h: usize) -> Vec<Vec<usize>> {
    let mut seen = vec![false; mask.len()];
    let mut parts = Vec::new();
    for start in 0..mask.len() {
        if mask[start] != value || seen[start] {
            continue;
        }
        seen[start] = true;
        let mut part = vec![start];
        let mut next = 0;
        while let Some(&k) = part.get(next) {
            next += 1;
            let (x, y) = (k % w, k / w);
            let around =
                [(x > 0, k.wrapping_sub(1)), (x + 1 < w, k + 1), (y > 0, k.wrapping_sub(w)), (y + 1 < h, k + w)];
            for (_, other) in around.into_iter().filter(|(there, _)| *there) {
                if mask[other] == value && !seen[other] {
                    seen[other] = true;
                    part.push(other);
                }
            }
        }
        parts.push(part);
    }
    parts
}

/// The mask and all within `by` pixels of it along each axis.
pub fn grown(mask: &[bool], w: usize, h: usize, by: usize) -> Vec<bool> {
    let pass = |mask: &[bool], n: usize, step: usize, lines: usize, line: usize| -> Vec<bool> {
        let mut out = vec![false; mask.len()];
        for l in 0..lines {
            let at = |i: usize| l * line + i * step;
            let mut until = 0;
            for i in 0..n {
                if mask[at(i)] {
                    (i.saturating_sub(by).max(until)..(i + by + 1).min(n)).for_each(|j| out[at(j)] = true);
                    until = i;
                }
            }
        }
        out
    };
    pass(&pass(mask, w, 1, h, w), h, w, w, 1)
}

pub fn shrunk(mask: &[bool], w: usize, h: usize, by: usize) -> Vec<bool> {
    let inverse: Vec<bool> = mask.iter().map(|m| !m).collect();
    grown(&inverse, w, h, by).iter().map(|m| !m).collect()
}

/// The mask blurred a little.
pub fn smooth(mask: &[bool], w: usize, h: usize) -> Vec<f32> {
    let value = |x: usize, y: usize| f32::from(u8::from(mask[y * w + x]));
    let rows: Vec<f32> = (0..w * h)
        .map(|k| {
            let (x, y) = (k % w, k / w);
            0.25 * value(x.saturating_sub(1), y) + 0.5 * value(x, y) + 0.25 * value((x + 1).min(w - 1), y)
        })
        .collect();
    (0..w * h)
        .map(|k| {
            let (x, y) = (k % w, k / w);
            0.25 * rows[y.saturating_sub(1) * w + x] + 0.5 * rows[k] + 0.25 * rows[(y + 1).min(h - 1) * w + x]
        })
        .collect()
}

/// Values of one picture at the pixels of another of the same shape.
pub fn enlarged(values: &[f32], w: usize, h: usize, nw: usize, nh: usize) -> Vec<f32> {
    let (sx, sy) = (w as f64 / nw as f64, h as f64 / nh as f64);
    (0..nw * nh).map(|k| bilinear(values, w, h, ((k % nw) as f64 + 0.5) * sx, ((k / nw) as f64 + 0.5) * sy)).collect()
}

/// The mask as an alpha channel of this size, with an edge at most a pixel wide: wider ones cost fits of small photos a quarter of a dB.
pub fn soft(mask: &[bool], picture: &Picture, size: (u32, u32)) -> Vec<u8> {
    let (w, h) = (picture.width(), picture.height());
    let values = enlarged(&smooth(mask, w, h), w, h, size.0 as usize, size.1 as usize);
    // Blurred edges are two pixels wide, enlarged ones as much wider as the picture is.
    let slope = 2.0 * (f64::from(size.0) / w as f64).max(1.0) as f32;
    values.iter().map(|v| ((slope * (v - 0.5) + 0.5).clamp(0.0, 1.0) * 255.0).round() as u8).collect()
}
