//! Reading `.sog` of version 2.

use std::io::{Cursor, Read};

use freerange_core::Invalid;
use freerange_splat::{Cloud, channel};
use image_webp::WebPDecoder;
use zip::ZipArchive;

use crate::{
    Loaded,
    bytes::check_expansion,
    error::problem,
    quantize::{Row, color_of_sh, from_smallest_three, logit_of_byte, set_rotation},
    sog::{CODES, Meta},
};

/// Bytes per Gaussian once decompressed: five pictures of four.
const BYTES: usize = 20;
/// Longest `meta.json`, in bytes.
const META_LIMIT: u64 = 1 << 20;
/// Pixels that a picture may have beyond those of Gaussians, per thousand.
const SPARE: usize = 2000;

pub fn decode(bytes: &[u8]) -> Result<Loaded, Invalid> {
    let archive = ZipArchive::new(Cursor::new(bytes)).map_err(|e| problem("archive", "a zip archive", e))?;
    let mut archive = Archive { archive, size: bytes.len() };
    let meta = archive.file("meta.json", META_LIMIT)?;
    // Version 1 has other fields, whose absence would say less.
    let meta: serde_json::Value = serde_json::from_slice(&meta).map_err(|e| problem("meta.json", "JSON", e))?;
    match meta.get("version") {
        Some(version) if *version == 2 => {}
        Some(version) => return Err(problem("meta.json, version", "2", version)),
        None => return Err(problem("meta.json, version", "2", "none")),
    }
    let meta = Meta::deserialize(&meta)?;
    let count = check_expansion("meta.json, count", meta.count, BYTES, bytes.len())?;
    for (name, codes) in [("scales", &meta.scales.codebook), ("sh0", &meta.sh0.codebook)] {
        if codes.len() != CODES {
            return Err(problem(format!("meta.json, {name}, codebook"), "256 numbers", codes.len()));
        }
    }
    let low = archive.picture(&meta.means.files[0], count)?;
    let high = archive.picture(&meta.means.files[1], count)?;
    let quats = archive.picture(&meta.quats.files[0], count)?;
    let scales = archive.picture(&meta.scales.files[0], count)?;
    let colors = archive.picture(&meta.sh0.files[0], count)?;

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
    if meta.harmonics.is_some() {
        notes.push("shN (colour that depends on the viewing direction) is left out".into());
    }
    Ok(Loaded { cloud: Cloud::from_rows(rows), notes })
}

impl Meta {
    fn deserialize(value: &serde_json::Value) -> Result<Self, Invalid> {
        serde::Deserialize::deserialize(value).map_err(|e| problem("meta.json", "the fields of SOG version 2", e))
    }
}

struct Archive<'a> {
    archive: ZipArchive<Cursor<&'a [u8]>>,
    size: usize,
}

impl Archive<'_> {
    fn file(&mut self, name: &str, limit: u64) -> Result<Vec<u8>, Invalid> {
        let shown: String = name.chars().take(60).collect();
        let mut bytes = Vec::new();
        let entry = self.archive.by_name(name).map_err(|e| problem(&*shown, "such a file in the archive", e))?;
        let read = entry.take(limit + 1).read_to_end(&mut bytes);
        read.map_err(|e| problem(&*shown, "a file in the archive", e))?;
        if bytes.len() as u64 > limit {
            return Err(problem(&*shown, format!("at most {limit} bytes"), "more"));
        }
        Ok(bytes)
    }

    /// The first pixels of a picture, one per Gaussian.
    fn picture(&mut self, name: &str, count: usize) -> Result<Vec<[u8; 4]>, Invalid> {
        // Pictures are compressed already: what the archive makes of one cannot be much more than itself.
        let bytes = self.file(name, 4 * self.size as u64)?;
        let name: String = name.chars().take(60).collect();
        let broken = |e: image_webp::DecodingError| problem(&*name, "a WebP picture", e);
        let mut decoder = WebPDecoder::new(Cursor::new(&bytes)).map_err(broken)?;
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
        Ok(raw.chunks_exact(channels).take(count).map(pixel).collect())
    }
}
