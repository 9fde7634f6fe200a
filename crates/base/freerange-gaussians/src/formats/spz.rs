//! `.spz`: fixed point, one attribute after the other, compressed. +y up, right-handed (the format calls it RUB).
//!
//! Per Gaussian: position 3 x 24 bits, opacity 8, color 3 x 8 (the coefficient of the constant spherical harmonic,
//! times 0.15), log-scale 3 x 8 (in sixteenths from -10), rotation 32 (the smallest three of `x y z w` in 10 bits
//! each; in version 2 `x y z` in 8 bits each), further harmonics in 8 (in 128ths, coefficient by coefficient). Versions
//! 2 and 3 are a header of 16 bytes and these, as one gzip stream; version 4 a header of 32 bytes, extensions, a table
//! of sizes, and one ZSTD stream per attribute. Source: github.com/nianticlabs/spz.
//!
//! Files of this program say that +y is up: version 4 by the extension for it, the others by the time in the gzip header.

use std::io::Write;

use crate::{Gaussians, RenderMode, Splats, channel};
use flate2::{Compression, GzBuilder};
use ruzstd::encoding::{CompressionLevel, compress_to_vec};

use crate::formats::{
    Encoded,
    quantize::{byte, sh_of_color, smallest_three, unorm8},
    splat::clip_note,
};

/// "NGSP", the first bytes of version 4 and, once decompressed, of those before.
pub const MAGIC: u32 = 0x5053_474e;
/// Color coefficients per unit of a byte's 0..1.
pub const COLOR_SCALE: f64 = 0.15;
/// Bytes of the header of version 4, with which its table begins.
pub const HEADER_4: usize = 32;

/// Bit of the flags: made for a renderer that compensates its blur.
pub const ANTIALIASED: u8 = 1;
/// Bit of the flags: records of extensions follow.
pub const EXTENSIONS: u8 = 2;
/// The extension that tells the axes of the numbers, and its value for those that the format defines: right, up, back.
pub const COORDINATES: u32 = 0xadbe_0003;
const RIGHT_UP_BACK: u32 = 4;
/// The time in the gzip header of our files, by which they are known: a moment of 2014, before there was such a format. Readers pass it over.
pub const OUR_TIME: u32 = u32::from_le_bytes(*b"FRGS");

/// Which version of `.spz` to write.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SpzVersion {
    /// Version 2, which every reader takes; rotations err by up to 10 degrees.
    V2,
    /// Version 3, which all but old readers take.
    #[default]
    V3,
    /// Version 4, which newer readers take; no smaller for few Gaussians.
    V4,
}

impl TryFrom<u8> for SpzVersion {
    type Error = String;

    fn try_from(number: u8) -> Result<Self, String> {
        match number {
            2 => Ok(Self::V2),
            3 => Ok(Self::V3),
            4 => Ok(Self::V4),
            _ => Err("expected 2, 3 or 4".into()),
        }
    }
}

impl std::str::FromStr for SpzVersion {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::try_from(text.parse::<u8>().unwrap_or(0))
    }
}

/// What all versions hold.
struct Packed {
    count: u32,
    degree: u8,
    bits: u8,
    flags: u8,
    streams: [Vec<u8>; 6], // positions, opacities, colors, scales, rotations, harmonics
}

/// `splats` with +y up.
pub fn encode(splats: &Splats, version: SpzVersion) -> Encoded {
    let Splats { cloud, harmonics, .. } = splats;
    let (bits, far) = fractional_bits(cloud);
    let unit = 2f64.powi(bits.into());
    let mut streams: [Vec<u8>; 6] = Default::default();
    let (mut scales_clipped, mut colors_clipped, mut harmonics_clipped) = (0usize, 0usize, 0usize);
    let beyond = |values: &[f64]| usize::from(values.iter().any(|v| !(-0.5..=255.5).contains(v)));
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
        scales_clipped += beyond(&scales);
        colors_clipped += beyond(&colors);
        let rotation = cloud.rotation(i).to_array();
        match version {
            SpzVersion::V2 => streams[4].extend(first_three(rotation)),
            SpzVersion::V3 | SpzVersion::V4 => streams[4].extend(smallest(rotation).to_le_bytes()),
        }
        let rest: Vec<f64> = harmonics.row(i).iter().map(|v| f64::from(*v) * 128.0 + 128.0).collect();
        harmonics_clipped += beyond(&rest);
        streams[5].extend(rest.into_iter().map(byte));
    }
    let mut notes = clip_note(scales_clipped, "standard deviations beyond 4.5e-5 .. 379");
    notes.extend(clip_note(colors_clipped, "colors far beyond 0..1"));
    notes.extend(clip_note(harmonics_clipped, "harmonics beyond -1..1"));
    notes.extend(clip_note(far, "centers too far from the origin"));
    let flags = if splats.mode == RenderMode::Mip { ANTIALIASED } else { 0 };
    let packed = Packed { count: cloud.len() as u32, degree: harmonics.degree() as u8, bits, flags, streams };
    let bytes = match version {
        SpzVersion::V2 => packed.legacy(2),
        SpzVersion::V3 => packed.legacy(3),
        SpzVersion::V4 => packed.streamed(),
    };
    Encoded { bytes, notes }
}

impl Packed {
    fn header(&self, version: u32, flags: u8, last: u8) -> Vec<u8> {
        let words = [MAGIC, version, self.count].map(u32::to_le_bytes).concat();
        [&words[..], &[self.degree, self.bits, flags, last]].concat()
    }

    fn legacy(&self, version: u32) -> Vec<u8> {
        let mut file = GzBuilder::new().mtime(OUR_TIME).write(Vec::new(), Compression::best());
        let written = file.write_all(&self.header(version, self.flags, 0));
        let written = written.and_then(|()| file.write_all(&self.streams.concat())).and_then(|()| file.finish());
        written.expect("memory can be written to")
    }

    fn streamed(&self) -> Vec<u8> {
        let streams: Vec<&[u8]> = self.streams.iter().map(|s| &s[..]).filter(|s| !s.is_empty()).collect();
        let packed: Vec<Vec<u8>> = streams.iter().map(|s| compress_to_vec(*s, CompressionLevel::Fastest)).collect();
        let axes = [COORDINATES, size_of::<u32>() as u32, RIGHT_UP_BACK].map(u32::to_le_bytes).concat();
        let mut file = self.header(4, self.flags | EXTENSIONS, streams.len() as u8);
        file.extend(((HEADER_4 + axes.len()) as u32).to_le_bytes());
        file.resize(HEADER_4, 0);
        file.extend(axes);
        for (stream, packed) in streams.iter().zip(&packed) {
            file.extend((packed.len() as u64).to_le_bytes());
            file.extend((stream.len() as u64).to_le_bytes());
        }
        file.extend(packed.concat());
        file
    }
}

/// Bits behind the point of positions, and how many Gaussians lie too far away even so. Steps are a 2^17th of the
/// object where that fits: finer ones would only compress worse. Readers want 1 to 24.
fn fractional_bits(cloud: &Gaussians) -> (u8, usize) {
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
fn smallest(xyzw: [f64; 4]) -> u32 {
    let (largest, others) = smallest_three(xyzw);
    others.iter().fold(largest as u32, |packed, v| {
        let magnitude = (v.abs() * std::f64::consts::SQRT_2 * 511.0).round().min(511.0) as u32;
        packed << 10 | u32::from(*v < 0.0) << 9 | magnitude
    })
}

/// Version 2: `x y z` of the unit quaternion whose `w` is positive.
fn first_three([x, y, z, w]: [f64; 4]) -> [u8; 3] {
    let sign = if w < 0.0 { -1.0 } else { 1.0 };
    [x, y, z].map(|v| byte(sign * v * 127.5 + 127.5))
}
