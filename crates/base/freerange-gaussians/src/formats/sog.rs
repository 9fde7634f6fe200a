//! `.sog` version 2: a zip archive of `meta.json` and lossless WebP pictures, one pixel per Gaussian, in the user's
//! frame.
//!
//! `means_l` and `means_u` hold the low and the high byte of 16 bits per coordinate, of `sign(x) ln(1 + |x|)` between
//! least and greatest; `quats` the smallest three of `w x y z` in 8 bits each, and in alpha 252 + the number of the
//! largest; `scales` numbers of entries in a codebook of 256 log-scales; `sh0` those of color coefficients, and in
//! alpha the opacity. `shN_labels` has in its first two bytes the number of a row of `shN_centroids`, which holds 64 of
//! them side by side, a pixel for each coefficient of red, green and blue, of a third codebook.
//!
//! Gaussians come in an order in which neighbors in space are neighbors in the pictures, which makes these smaller.
//! Source: developer.playcanvas.com, "SOG format".

use std::io::{Cursor, Write};

use crate::{Gaussians, RenderMode, Splats, channel, coefficients};
use image_webp::{ColorType, EncoderParams, WebPEncoder};
use serde::{Deserialize, Serialize};
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

use crate::formats::{
    Encoded,
    quantize::{byte, sh_of_color, smallest_three, unorm8},
};

/// `meta.json`.
#[derive(Debug, Deserialize, Serialize)]
pub struct Meta {
    pub version: u32,
    /// `antialiased` or `2dgs`, where they are to be drawn so.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<String>,
    pub count: u64,
    pub means: Means,
    pub scales: Coded,
    pub quats: Files,
    pub sh0: Coded,
    #[serde(rename = "shN", default, skip_serializing_if = "Option::is_none")]
    pub harmonics: Option<Harmonic>,
}

/// Spherical harmonics above the constant.
#[derive(Debug, Deserialize, Serialize)]
pub struct Harmonic {
    /// Rows of the palette.
    pub count: u64,
    /// The highest degree.
    pub bands: usize,
    pub codebook: Vec<f32>,
    /// Centroids and labels.
    pub files: [String; 2],
}

/// Centroids in a row of their picture.
pub const CENTROIDS: usize = 64;

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

pub fn encode(splats: &Splats) -> Encoded {
    let n = splats.cloud.len();
    let (mins, maxs, fixed) = positions(&splats.cloud);
    let order = along_curve(&fixed);
    let splats = &splats.select(&order);
    let cloud = &splats.cloud;
    let at = |i: usize, c: usize| f64::from(cloud.row(i)[c]);
    let all = |columns: std::ops::Range<usize>, value: &dyn Fn(f32) -> f64| -> Vec<f64> {
        cloud.iter().flat_map(|row| row[columns.clone()].iter().map(|v| value(*v))).collect()
    };
    let scales: Vec<f32> = codebook(all(channel::LOG_SCALE, &|v| v.into()));
    let colors: Vec<f32> = codebook(all(channel::COLOR, &sh_of_color));

    let mut pictures: [Vec<u8>; 5] = Default::default();
    for i in 0..n {
        let fixed = fixed[order[i]].map(u16::to_le_bytes);
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
    let mut files: Vec<(String, Vec<u8>)> = names.into_iter().zip(pictures.map(|p| square(p, n))).collect();
    let meta = Meta {
        version: 2,
        model: match splats.mode {
            RenderMode::Default => None,
            RenderMode::Mip => Some(ANTIALIASED.into()),
            RenderMode::Flat => Some(FLAT.into()),
        },
        count: n as u64,
        means: Means { mins, maxs, files: [low, high] },
        scales: Coded { codebook: scales, files: [scale_name] },
        quats: Files { files: [quats] },
        sh0: Coded { codebook: colors, files: [color_name] },
        harmonics: harmonics(splats, &mut files),
    };
    files.insert(0, ("meta.json".into(), serde_json::to_vec(&meta).expect("finite numbers and strings")));
    Encoded { bytes: archive(&files), notes: Vec::new() }
}

/// Least and greatest folded coordinates, and where between them each Gaussian is, in 16 bits.
fn positions(cloud: &Gaussians) -> ([f64; 3], [f64; 3], Vec<[u16; 3]>) {
    let folded = |i: usize, c: usize| {
        let v = f64::from(cloud.row(i)[c]);
        v.abs().ln_1p().copysign(v)
    };
    let [mins, maxs] = [f64::min as fn(f64, f64) -> f64, f64::max]
        .map(|pick| [0, 1, 2].map(|c| (0..cloud.len()).map(|i| folded(i, c)).reduce(pick).expect("Gaussians")));
    let fixed = |i: usize| {
        [0, 1, 2].map(|c| {
            let range = maxs[c] - mins[c];
            let part = if range > 0.0 { (folded(i, c) - mins[c]) / range } else { 0.0 };
            (part * 65535.0).round() as u16
        })
    };
    (mins, maxs, (0..cloud.len()).map(fixed).collect())
}

/// Which Gaussian each pixel holds: they follow a Z-order curve through their positions, and run down
/// the columns of the picture, since the encoder predicts from the pixel above.
fn along_curve(positions: &[[u16; 3]]) -> Vec<usize> {
    let place = |p: &[u16; 3]| {
        (0..16).rev().fold(0u64, |place, bit| p.iter().fold(place, |place, v| place << 1 | u64::from(v >> bit & 1)))
    };
    let mut in_space: Vec<usize> = (0..positions.len()).collect();
    in_space.sort_by_key(|i| place(&positions[*i]));
    let width = width(positions.len());
    let mut pixels: Vec<usize> = (0..positions.len()).collect();
    pixels.sort_unstable_by_key(|i| (i % width, i / width));
    let mut order = vec![0; positions.len()];
    pixels.into_iter().zip(in_space).for_each(|(pixel, i)| order[pixel] = i);
    order
}

/// What `model` says of Gaussians that are not drawn as usual.
pub const ANTIALIASED: &str = "antialiased";
pub const FLAT: &str = "2dgs";

/// Adds the pictures of harmonics, where there are any.
fn harmonics(splats: &Splats, files: &mut Vec<(String, Vec<u8>)>) -> Option<Harmonic> {
    let (n, width) = (splats.cloud.len(), splats.harmonics.width());
    if width == 0 {
        return None;
    }
    let (labels, rows) = palette(splats.harmonics.rows(), width);
    let codes = codebook(rows.iter().map(|v| f64::from(*v)).collect());
    let each = coefficients(splats.harmonics.degree());
    let count = rows.len() / width;
    let mut centroids = Vec::with_capacity(4 * each * count);
    rows.as_chunks::<3>().0.iter().for_each(|c| centroids.extend(opaque(c.map(|v| nearest(&codes, v.into())))));
    centroids.resize(4 * each * count.next_multiple_of(CENTROIDS), 0);
    let picture = webp(&centroids, each * CENTROIDS, count.div_ceil(CENTROIDS));
    let pixels = labels.iter().flat_map(|l| opaque([*l as u8, (l >> 8) as u8, 0])).collect();
    let names = ["shN_centroids.webp", "shN_labels.webp"].map(String::from);
    files.extend(names.iter().cloned().zip([picture, square(pixels, n)]));
    Some(Harmonic { count: count as u64, bands: splats.harmonics.degree(), codebook: codes, files: names })
}

/// At most 2^16 rows that stand for those of `data`, and which one does for each. Exact for few; else a quarter of them
/// (4096 at least), by halving the group whose spread is largest along its widest column.
fn palette(data: &[f32], width: usize) -> (Vec<u16>, Vec<f32>) {
    let n = data.len() / width;
    let most = (n / 4).clamp(4096, 1 << 16);
    if n <= most {
        return ((0..n).map(|i| i as u16).collect(), data.to_vec());
    }
    let spread = |group: &[usize]| -> (f64, usize) {
        let mut best = (0.0, 0);
        for c in 0..width {
            let (mut sum, mut squares) = (0.0, 0.0);
            group.iter().map(|i| f64::from(data[i * width + c])).for_each(|v| {
                sum += v;
                squares += v * v;
            });
            let error = squares - sum * sum / group.len() as f64;
            if error > best.0 {
                best = (error, c);
            }
        }
        best
    };
    let mut order: Vec<usize> = (0..n).collect();
    let first = spread(&order);
    // Non-negative floats are ordered as their bits are.
    let mut groups = std::collections::BinaryHeap::from([(first.0.to_bits(), first.1, 0, n)]);
    while groups.len() < most {
        let Some(&(error, column, from, to)) = groups.peek() else { break };
        if error == 0 {
            break;
        }
        groups.pop();
        let middle = (to - from) / 2;
        order[from..to].select_nth_unstable_by(middle, |a, b| {
            data[a * width + column].total_cmp(&data[b * width + column]).then(a.cmp(b))
        });
        for (from, to) in [(from, from + middle), (from + middle, to)] {
            let (error, column) = spread(&order[from..to]);
            groups.push((error.to_bits(), column, from, to));
        }
    }
    let mut groups: Vec<(usize, usize)> = groups.into_iter().map(|(_, _, from, to)| (from, to)).collect();
    groups.sort_unstable();
    let mut labels = vec![0u16; n];
    let mut rows = Vec::with_capacity(groups.len() * width);
    for (label, (from, to)) in groups.into_iter().enumerate() {
        let mean =
            |c: usize| order[from..to].iter().map(|i| f64::from(data[i * width + c])).sum::<f64>() / (to - from) as f64;
        rows.extend((0..width).map(|c| mean(c) as f32));
        order[from..to].iter().for_each(|i| labels[*i] = label as u16);
    }
    (labels, rows)
}

fn width(n: usize) -> usize {
    ((n as f64).sqrt().ceil() as usize).next_multiple_of(4)
}

/// Pixels of `n` Gaussians as a picture as near to a square as whole blocks of four pixels allow.
fn square(mut pixels: Vec<u8>, n: usize) -> Vec<u8> {
    let width = width(n);
    let height = n.div_ceil(width).next_multiple_of(4);
    pixels.resize(4 * width * height, 0);
    webp(&pixels, width, height)
}

/// The smaller of two: each pixel's difference to that above it (smooth pictures), or pixels as they are (noise).
fn webp(pixels: &[u8], width: usize, height: usize) -> Vec<u8> {
    let encoded = [true, false].map(|predicted| {
        let mut bytes = Vec::new();
        let mut encoder = WebPEncoder::new(&mut bytes);
        let mut params = EncoderParams::default();
        params.use_predictor_transform = predicted;
        encoder.set_params(params);
        let encoded = encoder.encode(pixels, width as u32, height as u32, ColorType::Rgba8);
        encoded.expect("an image of at most 4096 pixels' side");
        bytes
    });
    encoded.into_iter().min_by_key(Vec::len).expect("two")
}

fn archive(files: &[(String, Vec<u8>)]) -> Vec<u8> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    // Readers of parts of the archive want it stored; pictures are compressed already. No time: the same Gaussians give
    // the same bytes.
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    for (name, bytes) in files {
        let written = archive.start_file(name.as_str(), options).map_err(std::io::Error::from);
        written.and_then(|()| archive.write_all(bytes)).expect("memory can be written to");
    }
    archive.finish().expect("memory can be written to").into_inner()
}

fn opaque([r, g, b]: [u8; 3]) -> [u8; 4] {
    [r, g, b, 255]
}

fn with_alpha([r, g, b]: [u8; 3], alpha: u8) -> [u8; 4] {
    [r, g, b, alpha]
}

/// Most different values that codes are chosen for; more are put together, next to each other.
const MOST_VALUES: usize = 1 << 12;

/// [`CODES`] numbers in order that stand for `values` with the least squared error. Exact where there are no more
/// different values than codes.
fn codebook(mut values: Vec<f64>) -> Vec<f32> {
    values.sort_unstable_by(f64::total_cmp);
    let weighted = weighted(&values);
    let mut codes: Vec<f64> = match weighted.len() <= CODES {
        true => weighted.into_iter().map(|(value, _)| value).collect(),
        false => best_codes(&weighted),
    };
    // Readers expect all entries; those that nobody names may be anything.
    codes.resize(CODES, *codes.last().expect("Gaussians"));
    codes.iter().map(|c| *c as f32).collect()
}

/// The different values among `values`, which are in order, and how many there are of each; of too many, the means of
/// equal parts of their range.
fn weighted(values: &[f64]) -> Vec<(f64, f64)> {
    let mut found: Vec<(f64, f64)> = Vec::new();
    for value in values {
        match found.last_mut() {
            Some((last, weight)) if last == value => *weight += 1.0,
            _ => found.push((*value, 1.0)),
        }
    }
    if found.len() <= MOST_VALUES {
        return found;
    }
    let (least, greatest) = (values[0], values[values.len() - 1]);
    let part = |v: f64| ((v - least) / (greatest - least) * (MOST_VALUES - 1) as f64) as usize;
    let groups = found.chunk_by(|a, b| part(a.0) == part(b.0));
    let mean = |group: &[(f64, f64)]| {
        let weight: f64 = group.iter().map(|(_, w)| w).sum();
        (group.iter().map(|(v, w)| v * w).sum::<f64>() / weight, weight)
    };
    groups.map(mean).collect()
}

/// The means of [`CODES`] groups of neighbors with the least squared error: dynamic programming over where the groups
/// end, each row by halving, as best beginnings never move back (k-means on a line, exactly).
fn best_codes(points: &[(f64, f64)]) -> Vec<f64> {
    let n = points.len();
    // Of all before: weights, sums and squares, about the middle value for precision.
    let middle = points[n / 2].0;
    let mut before = vec![[0.0f64; 3]; n + 1];
    for (i, (value, weight)) in points.iter().enumerate() {
        let v = value - middle;
        before[i + 1] = [before[i][0] + weight, before[i][1] + weight * v, before[i][2] + weight * v * v];
    }
    let sums = |from: usize, to: usize| [0, 1, 2].map(|k| before[to][k] - before[from][k]);
    let error = |from: usize, to: usize| {
        let [weight, sum, squares] = sums(from, to);
        if to > from { (squares - sum * sum / weight).max(0.0) } else { 0.0 }
    };
    let mut least: Vec<f64> = (0..=n).map(|to| error(0, to)).collect();
    let mut begins: Vec<Vec<u16>> = vec![vec![0; n + 1]];
    for _ in 1..CODES {
        let (mut next, mut begin) = (vec![0.0; n + 1], vec![0u16; n + 1]);
        // Ranges of ends, and of beginnings that may be best for them.
        let mut ranges = vec![(0, n, 0, n)];
        while let Some((low, high, first, last)) = ranges.pop() {
            let to = (low + high) / 2;
            let cost = |from: usize| least[from] + error(from, to);
            let best = (first..=last.min(to)).min_by(|a, b| cost(*a).total_cmp(&cost(*b))).expect("a beginning");
            (next[to], begin[to]) = (cost(best), best as u16);
            if low < to {
                ranges.push((low, to - 1, first, best));
            }
            if to < high {
                ranges.push((to + 1, high, best, last));
            }
        }
        least = next;
        begins.push(begin);
    }
    let mut codes = Vec::with_capacity(CODES);
    let mut to = n;
    for begin in begins.iter().rev() {
        let from = usize::from(begin[to]);
        let [weight, sum, _] = sums(from, to);
        if to > from {
            codes.push(middle + sum / weight);
        }
        to = from;
    }
    codes.reverse();
    codes
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
        assert!(error < 1.001 * even, "{error} {even}");
    }

    /// Without the order the picture is noise, which does not shrink.
    #[test]
    fn neighbors_in_space_share_bytes() {
        let mut state = 1u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 16) as u16
        };
        // A sheet, as surfaces are.
        let positions: Vec<[u16; 3]> = (0..5000)
            .map(|_| {
                let (x, y) = (random(), random());
                [x, y, x / 2 + y / 4]
            })
            .collect();
        let bytes = |order: &[usize]| {
            let high = |i: &usize| opaque(positions[*i].map(|v| (v >> 8) as u8));
            square(order.iter().flat_map(high).collect(), order.len()).len()
        };
        let mut order = along_curve(&positions);
        let (sorted, unsorted) = (bytes(&order), bytes(&(0..5000).collect::<Vec<_>>()));
        assert!(3 * sorted < 2 * unsorted, "{sorted} of {unsorted} bytes");
        order.sort_unstable();
        assert!(order.into_iter().eq(0..5000), "each once");
    }

    #[test]
    fn codes_are_the_best_there_are() {
        // Of no more different values than are looked at one by one. Lloyd's iteration from several beginnings finds
        // nothing better; dense in the middle, with far strays.
        let values: Vec<f64> =
            (0..4000).map(|i| ((f64::from(i) + 0.5) / 2000.0 - 1.0).powi(7) * 5.0 + f64::from(i % 7) * 1e-3).collect();
        let error = |codes: &[f32]| {
            values.iter().map(|v| (f64::from(codes[usize::from(nearest(codes, *v))]) - v).powi(2)).sum::<f64>()
        };
        let codes = codebook(values.clone());
        let found = error(&codes);
        let mut sorted = values.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        for start in 0..3 {
            let at = |k: usize| match start {
                0 => sorted[(2 * k + 1) * sorted.len() / (2 * CODES)],
                1 => sorted[0] + (sorted[3999] - sorted[0]) * (k as f64 + 0.5) / CODES as f64,
                _ => f64::from(codes[k]),
            };
            let mut lloyd: Vec<f32> = (0..CODES).map(|k| at(k) as f32).collect();
            for _ in 0..200 {
                let mut sums = [(0.0, 0.0); CODES];
                for v in &sorted {
                    let sum = &mut sums[usize::from(nearest(&lloyd, *v))];
                    *sum = (sum.0 + v, sum.1 + 1.0);
                }
                for (code, (sum, count)) in lloyd.iter_mut().zip(sums) {
                    *code = if count > 0.0 { (sum / count) as f32 } else { *code };
                }
            }
            assert!(found <= 1.0001 * error(&lloyd), "{start}: {found} {}", error(&lloyd));
        }
    }
}
