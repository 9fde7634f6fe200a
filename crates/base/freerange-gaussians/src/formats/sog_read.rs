//! Reading `.sog` of version 2: an archive, or `meta.json` with the pictures beside it.

use std::io::{Cursor, Read};

use crate::{Gaussians, Harmonics, MAX_DEGREE, RenderMode, Splats, channel, coefficients};
use freerange_util::{Invalid, Note};
use image_webp::WebPDecoder;
use zip::ZipArchive;

use crate::formats::{
    Decoded,
    bytes::{Beside, check_expansion},
    error::{archive_problem, json_problem, problem},
    quantize::{Row, color_of_sh, from_smallest_three, logit_of_byte, set_rotation},
    sog::{ANTIALIASED, CENTROIDS, CODES, FLAT, Harmonic, Meta},
};

/// Bytes per Gaussian once decompressed: five pictures of four.
const BYTES: usize = 20;
/// Longest `meta.json`, in bytes.
const META_LIMIT: u64 = 1 << 20;
/// Pixels that a picture may have beyond those of Gaussians, per thousand.
const SPARE: usize = 2000;

/// Longest picture beside `meta.json`, in bytes.
const PICTURE_LIMIT: u64 = 1 << 30;

pub fn decode(bytes: &[u8], beside: &Beside) -> Result<Decoded, Invalid> {
    let mut files = match bytes.trim_ascii_start() {
        [b'{', ..] => Files::Beside(beside),
        _ => {
            let archive =
                ZipArchive::new(Cursor::new(bytes)).map_err(|e| archive_problem(bytes, "a zip archive", e))?;
            Files::Archive { archive, size: bytes.len() }
        }
    };
    let meta = match &mut files {
        Files::Beside(_) if bytes.len() as u64 > META_LIMIT => {
            return Err(problem("meta.json", format!("at most {META_LIMIT} bytes"), bytes.len()));
        }
        Files::Beside(_) => bytes.to_vec(),
        archive => archive.file("meta.json", META_LIMIT)?,
    };
    let meta: serde_json::Value = serde_json::from_slice(&meta).map_err(|e| json_problem("meta.json", "JSON", &e))?;
    match meta.get("version") {
        Some(version) if *version == 2 => {}
        Some(version) => return Err(problem("meta.json, version", "2", version)),
        None => return Err(problem("meta.json, version", "2", "none")),
    }
    let meta = Meta::deserialize(&meta)?;
    let size = match &mut files {
        Files::Archive { size, .. } => *size,
        Files::Beside(beside) => beside.file(&meta.means.files[0], PICTURE_LIMIT)?.len(),
    };
    let count = check_expansion("meta.json, count", meta.count, BYTES, size)?;
    for (name, codes) in [("scales", &meta.scales.codebook), ("sh0", &meta.sh0.codebook)] {
        if codes.len() != CODES {
            return Err(problem(format!("meta.json, {name}, codebook"), "256 numbers", codes.len()));
        }
    }
    let mut get = |name: &str| files.open(name).and_then(|bytes| picture(name, &bytes, count));
    let low = get(&meta.means.files[0])?;
    let high = get(&meta.means.files[1])?;
    let quats = get(&meta.quats.files[0])?;
    let scales = get(&meta.scales.files[0])?;
    let colors = get(&meta.sh0.files[0])?;

    let mut rows = Vec::with_capacity(count * channel::COUNT);
    for i in 0..count {
        let mut row = Row::default();
        for k in 0..3 {
            let fixed = u16::from_le_bytes([low[i][k], high[i][k]]);
            let (least, greatest) = (meta.means.mins[k], meta.means.maxs[k]);
            let folded = least + (greatest - least) * f64::from(fixed) / 65535.0;
            row[k] = folded.abs().exp_m1().copysign(folded) as f32;
            row[channel::LOG_SCALE.start + k] = meta.scales.codebook[usize::from(scales[i][k])];
            row[channel::COLOR.start + k] = color_of_sh(meta.sh0.codebook[usize::from(colors[i][k])].into());
        }
        row[channel::LOGIT_OPACITY] = logit_of_byte(colors[i][3]);
        let [a, b, c, largest] = quats[i];
        let Some(largest) = largest.checked_sub(252) else {
            return Err(problem(format!("{}, pixel {i}, alpha", meta.quats.files[0]), "252 to 255", largest));
        };
        let others = [a, b, c].map(|v| (f64::from(v) / 255.0 - 0.5) * std::f64::consts::SQRT_2);
        set_rotation(&mut row, from_smallest_three(largest.into(), others));
        rows.extend(row);
    }
    let mut notes = Vec::new();
    let mode = match meta.model.as_deref() {
        None => RenderMode::Default,
        Some(ANTIALIASED) => RenderMode::Mip,
        Some(FLAT) => RenderMode::Flat,
        Some(other) => {
            let other: String = other.chars().take(60).collect();
            let text = format!("model {other:?} (how to draw the Gaussians) is not known, and left out");
            notes.push(Note::dropped(text));
            RenderMode::Default
        }
    };
    let harmonics = match &meta.harmonics {
        Some(harmonic) => harmonics(harmonic, &mut files, count)?,
        None => Harmonics::default(),
    };
    let splats = Splats { harmonics, mode, ..Gaussians::from_rows(rows).into() };
    Ok(Decoded { splats, notes, frame: None })
}

fn harmonics(meta: &Harmonic, files: &mut Files, count: usize) -> Result<Harmonics, Invalid> {
    if !(1..=MAX_DEGREE).contains(&meta.bands) {
        return Err(problem("meta.json, shN, bands", "1 to 3", meta.bands));
    }
    if meta.codebook.len() != CODES {
        return Err(problem("meta.json, shN, codebook", "256 numbers", meta.codebook.len()));
    }
    let each = coefficients(meta.bands);
    let palette = files.open(&meta.files[0])?;
    let rows = check_expansion("meta.json, shN, count", meta.count, 4 * each, files.size(&palette))?;
    // Whole rows of pixels; the width is fixed, since centroids lie side by side.
    let (width, palette) = sized_picture(&meta.files[0], &palette, each * rows)?;
    if width != each * CENTROIDS {
        return Err(problem(&meta.files[0], format!("an image {} pixels wide", each * CENTROIDS), width));
    }
    let labels = files.open(&meta.files[1])?;
    let labels = picture(&meta.files[1], &labels, count)?;
    check_expansion("harmonics", (count * each) as u64, 12, files.size(&[]).max(count * BYTES))?;
    let mut data = Vec::with_capacity(3 * each * count);
    for (i, pixel) in labels.iter().enumerate() {
        let label = usize::from(u16::from_le_bytes([pixel[0], pixel[1]]));
        if label >= rows {
            return Err(problem(format!("{}, pixel {i}", meta.files[1]), format!("a number below {rows}"), label));
        }
        for pixel in &palette[each * label..][..each] {
            data.extend(pixel[..3].iter().map(|code| meta.codebook[usize::from(*code)]));
        }
    }
    Ok(Harmonics::from_rows(meta.bands, data))
}

impl Meta {
    fn deserialize(value: &serde_json::Value) -> Result<Self, Invalid> {
        serde::Deserialize::deserialize(value).map_err(|e| problem("meta.json", "the fields of SOG version 2", e))
    }
}

/// Where the pictures are.
enum Files<'a> {
    Archive { archive: ZipArchive<Cursor<&'a [u8]>>, size: usize },
    Beside(&'a Beside),
}

impl Files<'_> {
    /// The bytes that what is decoded may be measured against: of the archive, or of a picture beside `meta.json`.
    fn size(&self, picture: &[u8]) -> usize {
        match self {
            Self::Archive { size, .. } => *size,
            Self::Beside(_) => picture.len(),
        }
    }

    fn open(&mut self, name: &str) -> Result<Vec<u8>, Invalid> {
        // Pictures are compressed already: what the archive makes of one cannot be much more than itself.
        let limit = match self {
            Self::Archive { size, .. } => 4 * *size as u64,
            Self::Beside(_) => PICTURE_LIMIT,
        };
        self.file(name, limit)
    }

    fn file(&mut self, name: &str, limit: u64) -> Result<Vec<u8>, Invalid> {
        let archive = match self {
            Self::Beside(beside) => return beside.file(name, limit),
            Self::Archive { archive, .. } => archive,
        };
        let shown: String = name.chars().take(60).collect();
        let mut bytes = Vec::new();
        let entry = archive.by_name(name).map_err(|e| problem(&*shown, "such a file in the archive", e))?;
        let read = entry.take(limit + 1).read_to_end(&mut bytes);
        read.map_err(|e| problem(&*shown, "a file in the archive", e))?;
        if bytes.len() as u64 > limit {
            return Err(problem(&*shown, format!("at most {limit} bytes"), "more"));
        }
        Ok(bytes)
    }
}

/// The first pixels of a picture, one per Gaussian.
fn picture(name: &str, bytes: &[u8], count: usize) -> Result<Vec<[u8; 4]>, Invalid> {
    let (_, mut pixels) = sized_picture(name, bytes, count)?;
    pixels.truncate(count);
    Ok(pixels)
}

/// The width of a picture, and its pixels, at least `count`.
fn sized_picture(name: &str, bytes: &[u8], count: usize) -> Result<(usize, Vec<[u8; 4]>), Invalid> {
    let name: String = name.chars().take(60).collect();
    let broken = |e: image_webp::DecodingError| problem(&*name, "a WebP image", e);
    let mut decoder = WebPDecoder::new(Cursor::new(bytes)).map_err(broken)?;
    let (width, height) = decoder.dimensions();
    let pixels = width as usize * height as usize;
    let most = count + count * SPARE / 1000 + 4096;
    if !(count..=most).contains(&pixels) || decoder.is_animated() {
        let found = format!("{width} x {height}{}", if decoder.is_animated() { ", animated" } else { "" });
        return Err(problem(&*name, format!("{count} to {most} pixels"), found));
    }
    let channels = if decoder.has_alpha() { 4 } else { 3 };
    let mut raw = vec![0; pixels * channels];
    decoder.read_image(&mut raw).map_err(broken)?;
    let pixel = |p: &[u8]| [p[0], p[1], p[2], p.get(3).copied().unwrap_or(255)];
    Ok((width as usize, raw.chunks_exact(channels).map(pixel).collect()))
}
