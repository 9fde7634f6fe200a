//! `.sog` version 2: a zip archive of `meta.json` and lossless WebP pictures, one pixel per Gaussian, in the user's
//! frame.
//!
//! `means_l` and `means_u` hold the low and the high byte of 16 bits per coordinate, of `sign(x) ln(1 + |x|)` between
//! least and greatest; `quats` the smallest three of `w x y z` in 8 bits each, and in alpha 252 + the number of the
//! largest; `scales` numbers of entries in a codebook of 256 log-scales; `sh0` those of colour coefficients, and in
//! alpha the opacity. Source: developer.playcanvas.com, "SOG format".

use std::io::{Cursor, Write};

use freerange_splat::{Cloud, channel};
use image_webp::{ColorType, WebPEncoder};
use serde::{Deserialize, Serialize};
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

use crate::{
    Encoded,
    quantize::{byte, sh_of_color, smallest_three, unorm8},
};

/// `meta.json`.
#[derive(Debug, Deserialize, Serialize)]
pub struct Meta {
    pub version: u32,
    pub count: u64,
    pub means: Means,
    pub scales: Coded,
    pub quats: Files,
    pub sh0: Coded,
    #[serde(rename = "shN", default, skip_serializing_if = "Option::is_none")]
    pub harmonics: Option<serde_json::Value>,
}

#[derive(Debug, Deserialize, Serialize)]
pub struct Means {
    pub mins: [f64; 3],
    pub maxs: [f64; 3],
    pub files: [String; 2],
}

#[derive(Debug, Deserialize, Serialize)]
pub struct Coded {
    pub codebook: Vec<f32>,
    pub files: [String; 1],
}

#[derive(Debug, Deserialize, Serialize)]
pub struct Files {
    pub files: [String; 1],
}

/// Entries of a codebook.
pub const CODES: usize = 256;

pub fn encode(cloud: &Cloud) -> Encoded {
    let n = cloud.len();
    let at = |i: usize, c: usize| f64::from(cloud.row(i)[c]);
    let folded = |v: f64| v.abs().ln_1p().copysign(v);
    let [mins, maxs] = [f64::min as fn(f64, f64) -> f64, f64::max]
        .map(|pick| [0, 1, 2].map(|c| (0..n).map(|i| folded(at(i, c))).reduce(pick).expect("Gaussians")));
    let all = |columns: std::ops::Range<usize>, value: &dyn Fn(f32) -> f64| -> Vec<f64> {
        cloud.iter().flat_map(|row| row[columns.clone()].iter().map(|v| value(*v))).collect()
    };
    let scales: Vec<f32> = codebook(all(channel::LOG_SCALE, &|v| v.into()));
    let colors: Vec<f32> = codebook(all(channel::COLOR, &sh_of_color));

    // As near to a square as whole blocks of four pixels allow.
    let width = (n as f64).sqrt().ceil() as usize;
    let width = width.next_multiple_of(4);
    let height = n.div_ceil(width).next_multiple_of(4);
    let mut pictures: [Vec<u8>; 5] = Default::default();
    for i in 0..n {
        let fixed = [0, 1, 2].map(|c| {
            let range = maxs[c] - mins[c];
            let part = if range > 0.0 { (folded(at(i, c)) - mins[c]) / range } else { 0.0 };
            ((part * 65535.0).round() as u16).to_le_bytes()
        });
        let q = cloud.rotation(i);
        let (largest, others) = smallest_three([q.w, q.x, q.y, q.z]);
        let others = others.map(|v| byte((v * std::f64::consts::SQRT_2 * 0.5 + 0.5) * 255.0));
        let pixels = [
            opaque(fixed.map(|b| b[0])),
            opaque(fixed.map(|b| b[1])),
            [others[0], others[1], others[2], 252 + largest as u8],
            opaque([3, 4, 5].map(|c| nearest(&scales, at(i, c)))),
            with_alpha([11, 12, 13].map(|c| nearest(&colors, sh_of_color(cloud.row(i)[c]))), unorm8(cloud.opacity(i))),
        ];
        pictures.iter_mut().zip(pixels).for_each(|(picture, pixel)| picture.extend(pixel));
    }
    let names = ["means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp"].map(String::from);
    let [low, high, quats, scale_name, color_name] = names.clone();
    let meta = Meta {
        version: 2,
        count: n as u64,
        means: Means { mins, maxs, files: [low, high] },
        scales: Coded { codebook: scales, files: [scale_name] },
        quats: Files { files: [quats] },
        sh0: Coded { codebook: colors, files: [color_name] },
        harmonics: None,
    };
    let meta = serde_json::to_vec(&meta).expect("finite numbers and strings");
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    // Readers of parts of the archive want it stored; pictures are compressed already. No time: the same Gaussians give
    // the same bytes.
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    let mut add = |name: &str, bytes: &[u8]| {
        let written = archive.start_file(name, options).map_err(std::io::Error::from);
        written.and_then(|()| archive.write_all(bytes)).expect("memory can be written to");
    };
    add("meta.json", &meta);
    for (name, mut picture) in names.iter().zip(pictures) {
        picture.resize(4 * width * height, 0);
        let mut bytes = Vec::new();
        let encoder = WebPEncoder::new(&mut bytes);
        encoder
            .encode(&picture, width as u32, height as u32, ColorType::Rgba8)
            .expect("a picture of at most 4096 pixels' side");
        add(name, &bytes);
    }
    Encoded { bytes: archive.finish().expect("memory can be written to").into_inner(), notes: Vec::new() }
}

fn opaque([r, g, b]: [u8; 3]) -> [u8; 4] {
    [r, g, b, 255]
}

fn with_alpha([r, g, b]: [u8; 3], alpha: u8) -> [u8; 4] {
    [r, g, b, alpha]
}

/// [`CODES`] numbers in order that stand for `values` with little squared error: Lloyd's iteration from quantiles.
/// Exact where there are no more different values than codes.
fn codebook(mut values: Vec<f64>) -> Vec<f32> {
    const ROUNDS: usize = 30;
    values.sort_unstable_by(f64::total_cmp);
    let mut codes = values.clone();
    codes.dedup();
    if codes.len() > CODES {
        let mut sums = Vec::with_capacity(values.len() + 1); // of all values before
        sums.push(0.0);
        values.iter().for_each(|v| sums.push(sums[sums.len() - 1] + v));
        codes = (0..CODES).map(|k| values[(2 * k + 1) * values.len() / (2 * CODES)]).collect();
        for _ in 0..ROUNDS {
            let mut from = 0;
            for k in 0..CODES {
                let to = match codes.get(k + 1) {
                    Some(next) => from + values[from..].partition_point(|v| *v <= (codes[k] + next) / 2.0),
                    None => values.len(),
                };
                if to > from {
                    codes[k] = (sums[to] - sums[from]) / (to - from) as f64;
                }
                from = to;
            }
        }
    }
    // Readers expect all entries; those that nobody names may be anything.
    codes.resize(CODES, *codes.last().expect("Gaussians"));
    codes.iter().map(|c| *c as f32).collect()
}

/// The number of the code nearest to `value`.
fn nearest(codes: &[f32], value: f64) -> u8 {
    let after = codes.partition_point(|c| f64::from(*c) < value).min(CODES - 1);
    let before = after.saturating_sub(1);
    let apart = |k: usize| (f64::from(codes[k]) - value).abs();
    if apart(before) <= apart(after) { before as u8 } else { after as u8 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codebooks_are_exact_for_few_values_and_close_for_many() {
        let few = codebook(vec![3.0, -1.0, 3.0, 0.5]);
        assert_eq!((few.len(), &few[..4]), (CODES, &[-1.0, 0.5, 3.0, 3.0][..]));
        assert_eq!([-1.0, 0.5, 3.0].map(|v| few[usize::from(nearest(&few, v))]), [-1f32, 0.5, 3.0]);
        // Evenly spread values: no worse than twice the error of evenly spread codes.
        let many: Vec<f64> = (0..10_000).map(|i| f64::from(i * 7919 % 10_000) / 10_000.0).collect();
        let codes = codebook(many.clone());
        assert!(codes.is_sorted());
        let error = many.iter().map(|v| (f64::from(codes[usize::from(nearest(&codes, *v))]) - v).powi(2)).sum::<f64>()
            / 10_000.0;
        let even = (1.0 / 256f64).powi(2) / 12.0;
        assert!(error < 2.0 * even, "{error} {even}");
    }
}
