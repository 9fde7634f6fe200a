//! Reading compressed `.ply` files, as PlayCanvas and SuperSplat write them.
//!
//! The element `chunk` has bounds of 256 Gaussians each: of positions, log-scales and, in newer files, colors. The
//! element `vertex` has four words of 32 bits: position and log-scale in 11, 10 and 11 bits between these bounds;
//! rotation as the number of the largest of `w x y z` in 2 bits and the others in 10 each; color and opacity in 8 bits
//! each. The element `sh`, if there is one, has further harmonics, channel by channel, in a byte each.

use crate::gaussians::Row;
use crate::ply_columns::{rest_count, rest_number};
use crate::ply_error::{property_error, value_error};
use crate::ply_file::PlyFile;
use crate::ply_header::{Element, Header, Kind, Scalar};
use crate::ply_values::Values;
use crate::{Gaussians, Harmonics, MAX_DEGREE, SplatError, Splats, channel, coefficients};
use freerange_util::Note;
use std::{io::BufRead, path::Path};

/// Gaussians per chunk.
const CHUNK: u64 = 256;
/// The words of a Gaussian.
const WORDS: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
/// The bounds of a chunk, least and greatest of three each; colors may be missing, and are 0 and 1 then.
const BOUNDS: [&str; 18] = [
    "min_x",
    "min_y",
    "min_z",
    "max_x",
    "max_y",
    "max_z",
    "min_scale_x",
    "min_scale_y",
    "min_scale_z",
    "max_scale_x",
    "max_scale_y",
    "max_scale_z",
    "min_r",
    "min_g",
    "min_b",
    "max_r",
    "max_g",
    "max_b",
];
const WITHOUT_COLOR: usize = 12;

/// Whether `vertex` is compressed.
pub(crate) fn is_compressed(vertex: &Element) -> bool {
    vertex.properties.iter().any(|p| p.name == WORDS[0])
}

/// Reads the elements up to `vertex`, which is number `at`.
pub(crate) fn read<R: BufRead>(mut values: Values<'_, R>, header: &Header, at: usize) -> Result<PlyFile, SplatError> {
    let (file, vertex) = (values.file, &header.elements[at]);
    let Some(chunk) = header.elements[..at].iter().find(|e| e.name == "chunk") else {
        return Err(property_error(file, WORDS[0], "an element \"chunk\" before", "none"));
    };
    let bound_of = columns(chunk, &BOUNDS, WITHOUT_COLOR, file, Scalar::is_float, "float or double")?;
    let word_of = columns(vertex, &WORDS, WORDS.len(), file, |s| s == Scalar::U32, "uint")?;

    let mut chunks: Vec<[f32; 18]> = Vec::new();
    for element in &header.elements[..at] {
        let mut bounds = [0.0; 18];
        bounds[15..].fill(1.0);
        values.rows(element, |i, column, value| {
            if element.name != "chunk" {
                return Ok(());
            }
            if let Some(b) = bound_of[column] {
                bounds[b] = value as f32;
                if !bounds[b].is_finite() {
                    let found = bounds[b].to_string();
                    return Err(value_error(file, element, i, BOUNDS[b], "a finite number", &found));
                }
            }
            if column + 1 == bound_of.len() {
                chunks.push(bounds);
            }
            Ok(())
        })?;
    }

    let mut rows = Vec::new();
    let mut words = [0u32; 4];
    values.rows(vertex, |i, column, value| {
        if let Some(w) = word_of[column] {
            words[w] = value as u32; // an ascii file may hold other numbers: clamped
        }
        if column + 1 == word_of.len() {
            let Some(bounds) = usize::try_from(i / CHUNK).ok().and_then(|c| chunks.get(c)) else {
                let found = format!("{} chunks of {CHUNK}", chunks.len());
                return Err(value_error(file, vertex, i, WORDS[0], "a chunk for every Gaussian", &found));
            };
            rows.extend(unpack(words, bounds));
        }
        Ok(())
    })?;
    let (harmonics, notes) = harmonics(&mut values, header, at, vertex.count)?;
    let splats = Splats {
        cloud: Gaussians::from_rows(rows),
        harmonics,
        mode: header.comments.mode.unwrap_or_default(),
        origin: header.comments.origin.unwrap_or_default(),
    };
    Ok(PlyFile { splats, up: header.comments.up, notes })
}

/// Those of the element `sh` after number `at`, of `count` Gaussians.
fn harmonics<R: BufRead>(
    values: &mut Values<'_, R>,
    header: &Header,
    at: usize,
    count: u64,
) -> Result<(Harmonics, Vec<Note>), SplatError> {
    let Some(offset) = header.elements[at + 1..].iter().position(|e| e.name == "sh") else {
        return Ok((Harmonics::default(), Vec::new()));
    };
    for element in &header.elements[at + 1..][..offset] {
        values.rows(element, |_, _, _| Ok(()))?;
    }
    let element = &header.elements[at + 1 + offset];
    let bytes = element.properties.iter().all(|p| p.kind == Kind::Single(Scalar::U8));
    let rest = rest_count(element);
    if !bytes || rest == 0 || rest != element.properties.len() {
        let found = format!("{} properties", element.properties.len());
        return Err(property_error(
            values.file,
            "f_rest_0",
            "an element \"sh\" of 9, 24 or 45 properties uchar",
            &found,
        ));
    }
    if element.count != count {
        let expected = format!("{count} rows, as there are Gaussians");
        return Err(value_error(values.file, element, 0, "f_rest_0", &expected, &element.count.to_string()));
    }
    let degree = (1..=MAX_DEGREE).rev().find(|d| 3 * coefficients(*d) <= rest).unwrap_or(1);
    let (each, width) = (rest / 3, coefficients(degree));
    let numbers: Vec<usize> = element.properties.iter().filter_map(|p| rest_number(&p.name)).collect();
    let mut data = Vec::new();
    let mut row = vec![0f32; 3 * width];
    values.rows(element, |_, column, value| {
        let (k, channel) = (numbers[column] % each, numbers[column] / each);
        if k < width {
            row[3 * k + channel] = harmonic_of_byte(value);
        }
        if column + 1 == numbers.len() {
            data.extend_from_slice(&row);
        }
        Ok(())
    })?;
    let left = rest - 3 * width;
    let text = || format!("{left} of {rest} properties f_rest_* are left out: beyond degree {MAX_DEGREE}");
    let notes = (left > 0).then(|| Note::dropped(text()));
    Ok((Harmonics::from_rows(degree, data), notes.into_iter().collect()))
}

/// Bytes stand for the middles of 256 steps from -4 to 4; the first and the last for the ends.
fn harmonic_of_byte(value: f64) -> f32 {
    let part = match value {
        v if v <= 0.0 => 0.0,
        v if v >= 255.0 => 1.0,
        v => (v + 0.5) / 256.0,
    };
    ((part - 0.5) * 8.0) as f32
}

/// Which of `names` each property of `element` is, if any; the first `needed` have to be there.
fn columns(
    element: &Element,
    names: &[&str],
    needed: usize,
    file: &Path,
    fits: impl Fn(Scalar) -> bool,
    expected: &str,
) -> Result<Vec<Option<usize>>, SplatError> {
    for name in &names[..needed] {
        match element.properties.iter().find(|p| p.name == *name).map(|p| p.kind) {
            Some(Kind::Single(scalar)) if fits(scalar) => {}
            Some(Kind::Single(scalar)) => return Err(property_error(file, name, expected, scalar.name())),
            Some(Kind::List(..)) => return Err(property_error(file, name, expected, "a list")),
            None => return Err(property_error(file, name, "it, as every compressed file has it", "no such property")),
        }
    }
    Ok(element.properties.iter().map(|p| names.iter().position(|name| *name == p.name)).collect())
}

fn unpack([position, rotation, scale, color]: [u32; 4], bounds: &[f32; 18]) -> Row {
    // `v`'s bits from `low` up, `count` of them, as 0..1.
    let part = |v: u32, low: u32, count: u32| {
        let whole = (1u32 << count) - 1;
        f64::from(v >> low & whole) / f64::from(whole)
    };
    let within = |at: usize, k: usize, t: f64| {
        let (least, greatest) = (f64::from(bounds[at + k]), f64::from(bounds[at + 3 + k]));
        least * (1.0 - t) + greatest * t
    };
    let three = |v: u32| [part(v, 21, 11), part(v, 11, 10), part(v, 0, 11)];
    let mut row = Row::default();
    for k in 0..3 {
        row[k] = within(0, k, three(position)[k]) as f32;
        row[channel::LOG_SCALE.start + k] = within(6, k, three(scale)[k]) as f32;
        row[channel::COLOR.start + k] = within(12, k, part(color, 24 - 8 * k as u32, 8)) as f32;
    }
    // The first and the last step stand for half a one each: the logit of its middle.
    let opacity = part(color, 0, 8).clamp(0.25 / 255.0, 254.75 / 255.0);
    row[channel::LOGIT_OPACITY] = (opacity / (1.0 - opacity)).ln() as f32;
    let others = [20, 10, 0].map(|low| (part(rotation, low, 10) - 0.5) * std::f64::consts::SQRT_2);
    let largest = (1.0 - others.iter().map(|v| v * v).sum::<f64>()).max(0.0).sqrt();
    let mut q = others.to_vec();
    q.insert((rotation >> 30) as usize, largest);
    let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    for (channel, v) in row[channel::ROTATION].iter_mut().zip(q) {
        *channel = (v / length) as f32;
    }
    row
}
