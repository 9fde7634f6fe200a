//! `.spz`: fixed point, one attribute after the other, compressed. +y up, right-handed (the format calls it RUB).
//!
//! Per Gaussian: position 3 x 24 bits, opacity 8, colour 3 x 8 (the coefficient of the constant spherical harmonic,
//! times 0.15), log-scale 3 x 8 (in sixteenths from -10), rotation 32 (the smallest three of `x y z w` in 10 bits
//! each). Version 3 is a header of 16 bytes and these, as one gzip stream; version 4 a header of 32 bytes, a table of
//! sizes, and one ZSTD stream per attribute. Source: github.com/nianticlabs/spz.

use std::io::Write;

use flate2::{Compression, write::GzEncoder};
use freerange_splat::{Cloud, channel};
use ruzstd::encoding::{CompressionLevel, compress_to_vec};

use crate::{
    Encoded,
    quantize::{byte, sh_of_color, smallest_three, unorm8},
    splat::clip_note,
};

/// "NGSP", the first bytes of version 4 and, once decompressed, of those before.
pub const MAGIC: u32 = 0x5053_474e;
/// Colour coefficients per unit of a byte's 0..1.
pub const COLOR_SCALE: f64 = 0.15;
/// Bytes of the header of version 4, with which its table begins.
pub const HEADER_4: usize = 32;

/// Which version of `.spz` to write.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SpzVersion {
    /// Version 3, which all readers take.
    #[default]
    V3,
    /// Version 4, which newer readers take; no smaller for few Gaussians.
    V4,
}

/// `cloud` with +y up.
pub fn encode(cloud: &Cloud, version: SpzVersion) -> Encoded {
    let (bits, far) = fractional_bits(cloud);
    let unit = 2f64.powi(bits.into());
    let mut streams: [Vec<u8>; 5] = Default::default(); // positions, opacities, colours, scales, rotations
    let (mut scales_clipped, mut colors_clipped) = (0usize, 0usize);
    for (i, row) in cloud.iter().enumerate() {
        for v in &row[channel::MEAN] {
            let limit = f64::from((1 << 23) - 1);
            let fixed = (f64::from(*v) * unit).round().clamp(-limit, limit) as i32;
            streams[0].extend(&fixed.to_le_bytes()[..3]);
        }
        streams[1].push(unorm8(cloud.opacity(i)));
        let colors = [11, 12, 13].map(|c| sh_of_color(row[c]) * COLOR_SCALE * 255.0 + 127.5);
        streams[2].extend(colors.map(byte));
        let scales = [3, 4, 5].map(|c| (f64::from(row[c]) + 10.0) * 16.0);
        streams[3].extend(scales.map(byte));
        let beyond = |values: [f64; 3]| usize::from(values.iter().any(|v| !(-0.5..=255.5).contains(v)));
        scales_clipped += beyond(scales);
        colors_clipped += beyond(colors);
        streams[4].extend(rotation(cloud.rotation(i).to_array()).to_le_bytes());
    }
    let count = cloud.len() as u32;
    let mut notes = clip_note(scales_clipped, "standard deviations beyond 4.5e-5 .. 379");
    notes.extend(clip_note(colors_clipped, "colours far beyond 0..1"));
    notes.extend(clip_note(far, "centres too far from the origin"));
    let bytes = match version {
        SpzVersion::V3 => legacy(count, bits, &streams.concat()),
        SpzVersion::V4 => streamed(count, bits, &streams),
    };
    Encoded { bytes, notes }
}

fn legacy(count: u32, bits: u8, payload: &[u8]) -> Vec<u8> {
    let mut file = GzEncoder::new(Vec::new(), Compression::best());
    let header = [&MAGIC.to_le_bytes()[..], &3u32.to_le_bytes(), &count.to_le_bytes(), &[0, bits, 0, 0]].concat();
    let written = file.write_all(&header).and_then(|()| file.write_all(payload)).and_then(|()| file.finish());
    written.expect("memory can be written to")
}

fn streamed(count: u32, bits: u8, streams: &[Vec<u8>; 5]) -> Vec<u8> {
    let packed = streams.each_ref().map(|s| compress_to_vec(&s[..], CompressionLevel::Fastest));
    let mut file = [&MAGIC.to_le_bytes()[..], &4u32.to_le_bytes(), &count.to_le_bytes()].concat();
    file.extend([0, bits, 0, streams.len() as u8]);
    file.extend((HEADER_4 as u32).to_le_bytes());
    file.resize(HEADER_4, 0);
    for (stream, packed) in streams.iter().zip(&packed) {
        file.extend((packed.len() as u64).to_le_bytes());
        file.extend((stream.len() as u64).to_le_bytes());
    }
    file.extend(packed.concat());
    file
}

/// Bits behind the point of positions, and how many Gaussians lie too far away even so. Steps are a 2^17th of the
/// object where that fits: finer ones would only compress worse. Readers want 1 to 24.
fn fractional_bits(cloud: &Cloud) -> (u8, usize) {
    let Some((low, high)) = cloud.bounds() else { return (12, 0) };
    let size = (high - low).max_element();
    let farthest = low.abs().max(high.abs()).max_element();
    let fine = if size > 0.0 { 17.0 - size.log2() } else { 24.0 };
    // 24 bits with the sign: |position| 2^bits < 2^23.
    let fits = if farthest > 0.0 { 23.0 - (farthest * (1.0 + 1e-6)).log2() } else { 24.0 };
    let bits = fine.ceil().min(fits.floor()).clamp(1.0, 24.0);
    let limit = 2f64.powf(23.0 - bits);
    (bits as u8, (0..cloud.len()).filter(|&i| cloud.mean(i).abs().max_element() >= limit).count())
}

/// A unit quaternion `x y z w`: the number of the largest component in the top 2 bits, then the others, sign and 9 bits
/// each.
fn rotation(xyzw: [f64; 4]) -> u32 {
    let (largest, others) = smallest_three(xyzw);
    others.iter().fold(largest as u32, |packed, v| {
        let magnitude = (v.abs() * std::f64::consts::SQRT_2 * 511.0).round().min(511.0) as u32;
        packed << 10 | u32::from(*v < 0.0) << 9 | magnitude
    })
}
