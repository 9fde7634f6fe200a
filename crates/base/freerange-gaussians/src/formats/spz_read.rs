//! Reading `.spz` of versions 1 to 4.

use std::io::Read;

use crate::{Gaussians, Harmonics, MAX_DEGREE, RenderMode, Splats, channel, coefficients};
use flate2::bufread::GzDecoder;
use freerange_util::{Invalid, Note};
use glam::{DMat3, DQuat, DVec3};
use half::f16;
use ruzstd::decoding::StreamingDecoder;

use crate::formats::{
    Decoded, Frame,
    bytes::{Cursor, check_expansion},
    error::{ended, problem, stream_problem},
    quantize::{Row, color_of_sh, from_smallest_three, logit_of_byte, set_rotation},
    spz::{ANTIALIASED, COLOR_SCALE, COORDINATES, EXTENSIONS, HEADER_4, MAGIC, OUR_TIME},
};

/// Bytes per Gaussian without spherical harmonics, at least.
const BYTES: usize = 16;
/// Most bytes of extensions.
const EXTENSIONS_LIMIT: usize = 1 << 16;
/// The extension that limits the viewer's camera.
const SAFE_ORBIT: u32 = 0xadbe_0002;

/// What the headers of all versions say.
struct Header {
    version: u32,
    count: usize,
    /// Of the spherical harmonics.
    degree: usize,
    bits: u8,
    flags: u8,
}

impl Header {
    /// After the magic number: 12 bytes, of which the last means something in version 4 only.
    fn read(cursor: &mut Cursor, file: usize) -> Result<(Self, u8), Invalid> {
        let version = cursor.u32("version")?;
        if !(1..=4).contains(&version) {
            return Err(problem("version", "1, 2, 3 or 4", version));
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
        let each = BYTES + 3 * coefficients(degree.into());
        let count = check_expansion("count of Gaussians", count.into(), each, file)?;
        Ok((Self { version, count, degree: degree.into(), bits, flags }, last))
    }

    fn position_bytes(&self) -> usize {
        if self.version == 1 { 6 } else { 9 }
    }

    fn rotation_bytes(&self) -> usize {
        if self.version <= 2 { 3 } else { 4 }
    }

    /// Bytes of positions, opacities, colors, scales, rotations, harmonics.
    fn lengths(&self) -> [usize; 6] {
        let harmonics = 3 * coefficients(self.degree);
        [self.position_bytes(), 1, 3, 3, self.rotation_bytes(), harmonics].map(|each| each * self.count)
    }
}

/// The parts of a file, decompressed.
struct Parts {
    header: Header,
    streams: [Vec<u8>; 6],
    extensions: Vec<u8>,
}

/// `told`: whether the user says which axes the numbers have.
pub fn decode(bytes: &[u8], told: bool) -> Result<Decoded, Invalid> {
    let parts = match bytes {
        [0x1f, 0x8b, ..] => legacy(bytes)?,
        _ => streamed(bytes)?,
    };
    let (axes, mut notes) = extensions(&parts.extensions)?;
    // Our own have the axes that the format defines.
    let ours = matches!(bytes, [0x1f, 0x8b, _, _, time @ ..] if time.starts_with(&OUR_TIME.to_le_bytes()));
    let axes = axes.or(ours.then_some(DMat3::IDENTITY));
    let mut splats = unpack(&parts.header, parts.streams.each_ref().map(|s| &s[..]))?;
    if parts.header.degree > MAX_DEGREE {
        let left = 3 * (coefficients(parts.header.degree) - coefficients(MAX_DEGREE));
        notes.push(Note::dropped(format!(
            "{left} coefficients per Gaussian (color that depends on the viewing direction) are left out: beyond degree \
             {MAX_DEGREE}"
        )));
    }
    if parts.header.flags & ANTIALIASED != 0 {
        splats.mode = RenderMode::Mip;
        if !ours {
            let text = "the file is marked as made for antialiased rendering (some writers mark all of theirs)";
            notes.push(Note::understood(text));
        }
    }
    let frame = match axes {
        _ if told => None,
        Some(axes) => Some(right_handed(&mut splats, axes)),
        None => {
            notes.push(Note::assumed(
                "the file does not tell its axes: taken as +y up, as the format is defined; most converters keep those \
                 of the .ply they read, often -y up: if this is upside down, --frame y-down:z-up turns it",
            ));
            Some(Frame::Y_UP)
        }
    };
    Ok(Decoded { splats, frame, notes })
}

/// The frame whose numbers `axes` takes to those of the format; of a left-handed one, everything is mirrored.
fn right_handed(splats: &mut Splats, axes: DMat3) -> Frame {
    let mut turn = axes;
    if axes.determinant() < 0.0 {
        splats.invert();
        turn = -axes;
    }
    Frame::turned_to_y_up(DQuat::from_mat3(&turn))
}

/// Versions 1 to 3: all in one gzip stream.
fn legacy(bytes: &[u8]) -> Result<Parts, Invalid> {
    let mut stream = GzDecoder::new(bytes);
    let start = up_to(&mut stream, 16, "gzip stream")?;
    let mut cursor = Cursor { left: &start };
    magic(&mut cursor)?;
    let (header, _) = Header::read(&mut cursor, bytes.len())?;
    if header.version == 4 {
        return Err(problem("version", "1, 2 or 3 within a gzip stream", 4));
    }
    let mut streams: [Vec<u8>; 6] = Default::default();
    for (stream_out, (length, name)) in streams.iter_mut().zip(header.lengths().into_iter().zip(NAMES)) {
        *stream_out = up_to(&mut stream, length, name)?;
        if stream_out.len() < length {
            return Err(problem(name, format!("{length} bytes"), ended(stream_out.len())));
        }
    }
    let extensions = match header.flags & EXTENSIONS {
        0 => Vec::new(),
        _ => up_to(&mut stream, EXTENSIONS_LIMIT, "extensions")?,
    };
    Ok(Parts { header, streams, extensions })
}

const NAMES: [&str; 6] = ["positions", "opacities", "colors", "scales", "rotations", "harmonics"];

/// Version 4: a ZSTD stream each, after a table of their sizes.
fn streamed(bytes: &[u8]) -> Result<Parts, Invalid> {
    let mut cursor = Cursor { left: bytes };
    magic(&mut cursor)?;
    let (header, count) = Header::read(&mut cursor, bytes.len())?;
    if header.version != 4 {
        return Err(problem("version", "4 outside of a gzip stream", header.version));
    }
    let streams_expected = if header.degree > 0 { 6 } else { 5 };
    if count != streams_expected && header.count > 0 {
        return Err(problem("count of streams", streams_expected.to_string(), count));
    }
    let start = cursor.u32("place of the table")?;
    let start = usize::try_from(start).ok().filter(|t| *t >= HEADER_4 && *t <= bytes.len());
    let Some(start) = start else { return Err(problem("place of the table", "one within the file", "another")) };
    let mut table = Cursor { left: &bytes[start..] };
    let mut sizes = [[0u64; 2]; 6];
    for size in &mut sizes[..usize::from(count).min(6)] {
        *size = [table.u64("table")?, table.u64("table")?];
    }
    let mut streams: [Vec<u8>; 6] = Default::default();
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
            return Err(problem(NAMES[k], format!("{length} bytes"), ended(streams[k].len())));
        }
    }
    let extensions = if header.flags & EXTENSIONS == 0 { Vec::new() } else { bytes[HEADER_4..start].to_vec() };
    Ok(Parts { header, streams, extensions })
}

/// What takes the file's axes to right, up, back, if the records say so; and what is not heeded.
fn extensions(bytes: &[u8]) -> Result<(Option<DMat3>, Vec<Note>), Invalid> {
    let (mut axes, mut notes) = (None, Vec::new());
    let mut cursor = Cursor { left: bytes };
    while !cursor.left.is_empty() && notes.len() < 20 {
        let kind = cursor.u32("extension, type")?;
        let length = cursor.u32("extension, length")?;
        let record = cursor.take("extension", length as usize)?;
        match kind {
            COORDINATES => axes = Some(axes_of(Cursor { left: record }.u32("extension, coordinate system")?)?),
            SAFE_ORBIT => {
                notes.push(Note::dropped("limits of the viewer's camera (SPZ_ADOBE_safe_orbit_camera) are left out"));
            }
            _ => notes.push(Note::dropped(format!("extension {kind:#010x} ({length} bytes) is left out"))),
        }
    }
    Ok((axes, notes))
}

/// What takes numbers in coordinate system 1 to 16 to right, up, back, as the reference library does: of LFD, RFD, LBU
/// and RBU it is half a turn about x away from what the letters say, in reading and writing alike. 0 is the format's own.
fn axes_of(system: u32) -> Result<DMat3, Invalid> {
    if system > 16 {
        return Err(problem("extension, coordinate system", "0 to 16", system));
    }
    let Some(bits) = system.checked_sub(1) else { return Ok(DMat3::IDENTITY) };
    let sign = |bit: u32| if bits >> bit & 1 == 1 { 1.0 } else { -1.0 };
    let (x, y, z) = (DVec3::X * sign(0), DVec3::Y, DVec3::Z);
    // The columns are where the file's x, y and z go.
    Ok(match bits < 8 {
        true => DMat3::from_cols(x, y * sign(1), z * -sign(2)),
        false => DMat3::from_cols(x, z * -sign(1), y * sign(2)),
    })
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
    read.map_err(|e| stream_problem(field, &e))?;
    Ok(bytes)
}

fn unpack(header: &Header, streams: [&[u8]; 6]) -> Result<Splats, Invalid> {
    let [positions, opacities, colors, scales, rotations, harmonics] = streams;
    let unit = 0.5f64.powi(header.bits.into());
    let mut rows = Vec::with_capacity(header.count * channel::COUNT);
    for i in 0..header.count {
        let mut row = Row::default();
        for k in 0..3 {
            row[k] = match header.version {
                1 => {
                    let p = &positions[2 * (3 * i + k)..][..2];
                    f16::from_le_bytes([p[0], p[1]]).to_f32()
                }
                _ => {
                    let p = &positions[3 * (3 * i + k)..][..3];
                    // The sign is the highest of 24 bits.
                    let fixed = i32::from_le_bytes([0, p[0], p[1], p[2]]) >> 8;
                    (f64::from(fixed) * unit) as f32
                }
            };
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
    let degree = header.degree.min(MAX_DEGREE);
    let (width, all) = (3 * coefficients(degree), 3 * coefficients(header.degree));
    let kept = |row: &[u8]| row[..width].iter().map(|v| (f32::from(*v) - 128.0) / 128.0).collect::<Vec<_>>();
    let harmonics = harmonics.chunks_exact(all.max(1)).flat_map(kept).collect();
    Ok(Splats { harmonics: Harmonics::from_rows(degree, harmonics), ..Gaussians::from_rows(rows).into() })
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
