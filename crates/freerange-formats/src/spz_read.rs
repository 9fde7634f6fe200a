//! Reading `.spz` of versions 2, 3 and 4.

use std::io::Read;

use flate2::bufread::GzDecoder;
use freerange_core::Invalid;
use freerange_splat::{Cloud, channel};
use ruzstd::decoding::StreamingDecoder;

use crate::{
    Loaded,
    bytes::{Cursor, check_expansion},
    error::problem,
    quantize::{Row, color_of_sh, from_smallest_three, logit_of_byte, set_rotation},
    spz::{COLOR_SCALE, HEADER_4, MAGIC},
};

/// Bytes per Gaussian without spherical harmonics, at least.
const BYTES: usize = 19;
/// Bit of the flags: made for a renderer that compensates its blur.
const ANTIALIASED: u8 = 1;

/// What the headers of all versions say.
struct Header {
    version: u32,
    count: usize,
    /// Coefficients of the higher spherical harmonics per Gaussian, in bytes.
    harmonics: usize,
    bits: u8,
    flags: u8,
}

impl Header {
    /// After the magic number: 12 bytes, of which the last means something in version 4 only.
    fn read(cursor: &mut Cursor, file: usize) -> Result<(Self, u8), Invalid> {
        let version = cursor.u32("version")?;
        if !(2..=4).contains(&version) {
            return Err(problem("version", "2, 3 or 4", version));
        }
        let count = cursor.u32("count of Gaussians")?;
        let degree = cursor.u8("degree of spherical harmonics")?;
        let bits = cursor.u8("fractional bits")?;
        let flags = cursor.u8("flags")?;
        let last = cursor.u8("header")?;
        if degree > 4 {
            return Err(problem("degree of spherical harmonics", "at most 4", degree));
        }
        if bits > 30 {
            return Err(problem("fractional bits", "at most 30", bits));
        }
        let count = check_expansion("count of Gaussians", count.into(), BYTES, file)?;
        let degree = usize::from(degree);
        Ok((Self { version, count, harmonics: 3 * degree * (degree + 2), bits, flags }, last))
    }

    fn rotation_bytes(&self) -> usize {
        if self.version == 2 { 3 } else { 4 }
    }

    /// Bytes of positions, opacities, colours, scales, rotations.
    fn lengths(&self) -> [usize; 5] {
        [9, 1, 3, 3, self.rotation_bytes()].map(|each| each * self.count)
    }
}

pub fn decode(bytes: &[u8]) -> Result<Loaded, Invalid> {
    let (header, streams) = match bytes {
        [0x1f, 0x8b, ..] => legacy(bytes)?,
        _ => streamed(bytes)?,
    };
    unpack(&header, streams.each_ref().map(|s| &s[..]))
}

/// Versions 2 and 3: all in one gzip stream.
fn legacy(bytes: &[u8]) -> Result<(Header, [Vec<u8>; 5]), Invalid> {
    let mut stream = GzDecoder::new(bytes);
    let start = up_to(&mut stream, 16, "gzip stream")?;
    let mut cursor = Cursor { left: &start };
    magic(&mut cursor)?;
    let (header, _) = Header::read(&mut cursor, bytes.len())?;
    if header.version == 4 {
        return Err(problem("version", "2 or 3 within a gzip stream", 4));
    }
    let mut streams: [Vec<u8>; 5] = Default::default();
    for (stream_out, (length, name)) in streams.iter_mut().zip(header.lengths().into_iter().zip(NAMES)) {
        *stream_out = up_to(&mut stream, length, name)?;
        if stream_out.len() < length {
            return Err(problem(name, format!("{length} bytes"), format!("{} and the end", stream_out.len())));
        }
    }
    Ok((header, streams))
}

const NAMES: [&str; 5] = ["positions", "opacities", "colours", "scales", "rotations"];

/// Version 4: a ZSTD stream each, after a table of their sizes.
fn streamed(bytes: &[u8]) -> Result<(Header, [Vec<u8>; 5]), Invalid> {
    let mut cursor = Cursor { left: bytes };
    magic(&mut cursor)?;
    let (header, count) = Header::read(&mut cursor, bytes.len())?;
    if header.version != 4 {
        return Err(problem("version", "4 outside of a gzip stream", header.version));
    }
    let streams_expected = if header.harmonics > 0 { 6 } else { 5 };
    if count != streams_expected && header.count > 0 {
        return Err(problem("count of streams", streams_expected.to_string(), count));
    }
    let table = cursor.u32("place of the table")?;
    let table = usize::try_from(table).ok().filter(|t| *t >= HEADER_4).and_then(|t| bytes.get(t..));
    let Some(left) = table else { return Err(problem("place of the table", "one within the file", "another")) };
    let mut table = Cursor { left };
    let mut sizes = [[0u64; 2]; 6];
    for size in &mut sizes[..usize::from(count).min(6)] {
        *size = [table.u64("table")?, table.u64("table")?];
    }
    let mut streams: [Vec<u8>; 5] = Default::default();
    for (k, length) in header.lengths().into_iter().enumerate() {
        let [packed, claimed] = sizes[k];
        if claimed != length as u64 {
            return Err(problem(format!("table, size of the {}", NAMES[k]), length.to_string(), claimed));
        }
        let packed = table.take(NAMES[k], usize::try_from(packed).unwrap_or(usize::MAX))?;
        if length == 0 {
            continue;
        }
        let broken = |e: &dyn std::fmt::Display| problem(NAMES[k], "a ZSTD stream", e);
        let mut decoder = StreamingDecoder::new(packed).map_err(|e| broken(&e))?;
        streams[k] = up_to(&mut decoder, length, NAMES[k])?;
        if streams[k].len() < length {
            return Err(problem(NAMES[k], format!("{length} bytes"), format!("{} and the end", streams[k].len())));
        }
    }
    Ok((header, streams))
}

fn magic(cursor: &mut Cursor) -> Result<(), Invalid> {
    match cursor.u32("header")? {
        MAGIC => Ok(()),
        other => Err(problem("header", "\"NGSP\"", format!("{:?}", String::from_utf8_lossy(&other.to_le_bytes())))),
    }
}

/// At most `count` bytes, fewer where the stream ends; memory grows with what arrives.
fn up_to(stream: &mut impl Read, count: usize, field: &str) -> Result<Vec<u8>, Invalid> {
    let mut bytes = Vec::new();
    let read = stream.take(count as u64).read_to_end(&mut bytes);
    read.map_err(|e| problem(field, "a compressed stream", e))?;
    Ok(bytes)
}

fn unpack(header: &Header, [positions, opacities, colors, scales, rotations]: [&[u8]; 5]) -> Result<Loaded, Invalid> {
    let unit = 0.5f64.powi(header.bits.into());
    let mut rows = Vec::with_capacity(header.count * channel::COUNT);
    for i in 0..header.count {
        let mut row = Row::default();
        for k in 0..3 {
            let p = &positions[3 * (3 * i + k)..][..3];
            // The sign is the highest of 24 bits.
            let fixed = i32::from_le_bytes([0, p[0], p[1], p[2]]) >> 8;
            row[k] = (f64::from(fixed) * unit) as f32;
            row[channel::LOG_SCALE.start + k] = f32::from(scales[3 * i + k]) / 16.0 - 10.0;
            let coefficient = (f64::from(colors[3 * i + k]) / 255.0 - 0.5) / COLOR_SCALE;
            row[channel::COLOR.start + k] = color_of_sh(coefficient);
        }
        row[channel::LOGIT_OPACITY] = logit_of_byte(opacities[i]);
        let bytes = &rotations[header.rotation_bytes() * i..][..header.rotation_bytes()];
        let [x, y, z, w] = match *bytes {
            [a, b, c, d] => smallest(u32::from_le_bytes([a, b, c, d])),
            [x, y, z] => first_three([x, y, z]),
            _ => unreachable!("rotations have three or four bytes"),
        };
        set_rotation(&mut row, [w, x, y, z]);
        rows.extend(row);
    }
    let mut notes = Vec::new();
    if header.harmonics > 0 {
        notes.push(format!(
            "{} coefficients per Gaussian (colour that depends on the viewing direction) are left out",
            header.harmonics
        ));
    }
    if header.flags & ANTIALIASED != 0 {
        notes.push("the file is marked as made for antialiased rendering, which is not taken into account".into());
    }
    Ok(Loaded { cloud: Cloud::from_rows(rows), notes })
}

/// Version 3 and later: `x y z w`.
fn smallest(packed: u32) -> [f64; 4] {
    let others = [20, 10, 0].map(|shift| {
        let magnitude = f64::from(packed >> shift & 511) / 511.0 * std::f64::consts::FRAC_1_SQRT_2;
        if packed >> shift & 512 == 0 { magnitude } else { -magnitude }
    });
    from_smallest_three((packed >> 30) as usize, others)
}

/// Version 2: `x y z`, `w` being positive.
fn first_three(bytes: [u8; 3]) -> [f64; 4] {
    from_smallest_three(3, bytes.map(|v| f64::from(v) / 127.5 - 1.0))
}
