//! The `.ply` files that 3D Gaussian splatting tools exchange.
//!
//! Written: binary little endian, `x y z nx ny nz f_dc_0..2 f_rest_.. opacity scale_0..2 rot_0..3`, all float; `f_dc` is
//! the color as the constant term of spherical harmonics, `f_rest` the others (all of red, then green, then blue),
//! `opacity` a logit, `scale` a logarithm, `rot` a quaternion wxyz.
//! Read: any order of properties, further properties and elements, ascii and both byte orders, colors as bytes, files
//! of 2D Gaussians, and the compressed form of PlayCanvas. Gaussians that are not finite are left out. Headers are not
//! trusted: memory grows with the rows that arrive.

use crate::ply_columns::{Column, Plan};
use crate::ply_compressed;
use crate::ply_header::{Element, Format, Kind, Property, Scalar, read_header};
use crate::{Cloud, Harmonics, RenderMode, SplatError, Splats, channel, coefficients};
use freerange_util::{IoError, write_atomically};
use glam::DVec3;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::{fs::File, path::Path};

/// The constant real spherical harmonic, 1 / (2 sqrt(pi)).
pub(crate) const SH_C0: f64 = 0.282_094_791_773_878_14;

/// Columns of the files we write: a channel, or a zero (the normal that nobody uses).
pub(crate) const COLUMNS: [(&str, Option<usize>); 17] = [
    ("x", Some(0)),
    ("y", Some(1)),
    ("z", Some(2)),
    ("nx", None),
    ("ny", None),
    ("nz", None),
    ("f_dc_0", Some(11)),
    ("f_dc_1", Some(12)),
    ("f_dc_2", Some(13)),
    ("opacity", Some(10)),
    ("scale_0", Some(3)),
    ("scale_1", Some(4)),
    ("scale_2", Some(5)),
    ("rot_0", Some(6)),
    ("rot_1", Some(7)),
    ("rot_2", Some(8)),
    ("rot_3", Some(9)),
];

/// The log-scale of a standard deviation of zero, which has no logarithm.
pub const SCALE_OF_NONE: f32 = -40.0;
/// The logit of an opacity of 1, which has none either: that of the number of 32 bits next to it.
const LOGIT_OF_ONE: f32 = 16.118_095;

/// What a `.ply` holds.
#[derive(Clone, Debug, PartialEq)]
pub struct PlyFile {
    /// The Gaussians; all channels finite.
    pub splats: Splats,
    /// Which way is up, where the file says so.
    pub up: Option<DVec3>,
    /// What was left out or looks odd, one sentence each, for the user.
    pub notes: Vec<String>,
}

/// Reads the Gaussians of a `.ply` file.
///
/// # Errors
/// [`SplatError::Io`]; [`SplatError::PlyHeader`], [`SplatError::PlyProperty`] and [`SplatError::PlyValue`] where the
/// file is no `.ply`, does not hold Gaussians, ends early, or holds none that is finite.
pub fn read_ply(file: &Path) -> Result<PlyFile, SplatError> {
    let opened = File::open(file).map_err(IoError::at(file))?;
    parse_ply(BufReader::with_capacity(1 << 18, opened), file)
}

/// As [`read_ply`], from anything that can be read; `file` is for messages only.
///
/// # Errors
/// As [`read_ply`].
pub fn parse_ply(mut reader: impl BufRead, file: &Path) -> Result<PlyFile, SplatError> {
    let header = read_header(&mut reader, file)?;
    let Some(at) = header.elements.iter().position(|e| e.name == "vertex") else {
        let names: Vec<_> = header.elements.iter().map(|e| e.name.as_str()).collect();
        return Err(property_error(file, "x", "an element \"vertex\"", &format!("the elements {}", listed(&names))));
    };
    let mut values = Values { reader, format: header.format, file, line: Vec::new(), used: 0 };
    if ply_compressed::is_compressed(&header.elements[at]) {
        return ply_compressed::read(values, &header, at);
    }
    let vertex = &header.elements[at];
    let plan = Plan::new(vertex, header.comments.mode, file)?;
    let mut notes = plan.notes(&header, at);
    for element in &header.elements[..at] {
        values.rows(element, |_, _, _| Ok(()))?;
    }
    let mut rows = read_rows(&mut values, vertex, &plan)?;
    let cloud = Cloud::from_rows(std::mem::take(&mut rows.data));
    if cloud.is_empty() && rows.dropped > 0 {
        return Err(value_error(file, vertex, 0, "x", "at least one Gaussian of finite numbers", "none"));
    }
    notes.extend(rows.notes());
    let zero = cloud.iter().filter(|row| row[channel::ROTATION].iter().all(|v| *v == 0.0)).count();
    if zero > 0 {
        notes.push(format!("{zero} Gaussians have a rotation of length zero, which stands for none"));
    }
    let mut splats = Splats {
        harmonics: Harmonics::from_rows(plan.degree, rows.harmonics),
        cloud,
        mode: plan.mode,
        origin: header.comments.origin.unwrap_or_default(),
    };
    if plan.exact_positions && splats.origin == DVec3::ZERO {
        splats.place(&rows.positions);
    }
    Ok(PlyFile { splats, up: header.comments.up, notes })
}

/// What the rows of Gaussians hold.
#[derive(Default)]
struct Rows {
    data: Vec<f32>,      // [n, 14]
    harmonics: Vec<f32>, // [n, coefficients, 3]
    positions: Vec<DVec3>,
    /// Gaussians left out, opacities at the ends, deviations of zero.
    dropped: usize,
    clamped: usize,
}

impl Rows {
    fn notes(&self) -> Vec<String> {
        let mut notes = Vec::new();
        if self.dropped > 0 {
            notes.push(format!("{} Gaussians with numbers that are not finite are left out", self.dropped));
        }
        if self.clamped > 0 {
            notes.push(format!(
                "{} Gaussians have an infinite opacity or log-scale, taken as the nearest finite one",
                self.clamped
            ));
        }
        notes
    }
}

fn read_rows<R: BufRead>(values: &mut Values<'_, R>, vertex: &Element, plan: &Plan) -> Result<Rows, SplatError> {
    let width = coefficients(plan.degree);
    // The count may lie: rows beyond the first few are allocated as they arrive.
    let mut rows =
        Rows { data: Vec::with_capacity(vertex.count.min(1 << 16) as usize * channel::COUNT), ..Rows::default() };
    let mut row = plan.blank();
    let mut rest = vec![0f32; 3 * width];
    let (mut position, mut clamped) = (DVec3::ZERO, false);
    values.rows(vertex, |_, column, value| {
        match plan.columns[column] {
            Column::Other => {}
            Column::Channel(c) => {
                if channel::MEAN.contains(&c) {
                    position[c] = value;
                }
                let infinite = finite_value(c, value);
                clamped |= infinite.is_some();
                row[c] = infinite.unwrap_or(value as f32);
            }
            Column::Constant(c) => row[c] = (value * SH_C0 + 0.5) as f32,
            Column::Color(c, scale) => row[c] = (value * scale) as f32,
            // Channel by channel in the file.
            Column::Rest(k) if k % plan.rest_each < width => {
                rest[3 * (k % plan.rest_each) + k / plan.rest_each] = value as f32;
            }
            Column::Rest(_) => {}
        }
        if column + 1 == plan.columns.len() {
            if row.iter().chain(&rest).all(|v| v.is_finite()) {
                rows.data.extend_from_slice(&row);
                rows.harmonics.extend_from_slice(&rest);
                rows.clamped += usize::from(clamped);
                if plan.exact_positions {
                    rows.positions.push(position);
                }
            } else {
                rows.dropped += 1;
            }
            clamped = false;
        }
        Ok(())
    })?;
    Ok(rows)
}

/// What stands for an infinite value of channel `c`, where something does: opacities of 0 and 1, deviations of zero.
fn finite_value(c: usize, value: f64) -> Option<f32> {
    match value {
        f64::INFINITY if c == channel::LOGIT_OPACITY => Some(LOGIT_OF_ONE),
        f64::NEG_INFINITY if c == channel::LOGIT_OPACITY => Some(-LOGIT_OF_ONE),
        f64::NEG_INFINITY if channel::LOG_SCALE.contains(&c) => Some(SCALE_OF_NONE),
        _ => None,
    }
}

/// Writes `cloud` to a `.ply` file, first beside it and then renamed. The same cloud gives the same bytes. Reading it
/// back gives the same values in all channels but colour, which is rounded once.
///
/// # Errors
/// [`SplatError::Io`]; [`SplatError::Value`] where a channel is not finite.
pub fn write_ply(cloud: &Cloud, file: &Path) -> Result<(), SplatError> {
    cloud.check_finite()?;
    Ok(write_atomically(file, |w| write_to(cloud, w)).map_err(IoError::at(file))?)
}

/// As [`write_ply`], with a comment that says what positions are relative to where they would be too large for 32 bits.
///
/// # Errors
/// As [`write_ply`].
pub fn write_ply_at(cloud: &Cloud, origin: Option<[f64; 3]>, file: &Path) -> Result<(), SplatError> {
    cloud.check_finite()?;
    let comments: Vec<String> = origin.map(|origin| origin_comment(origin.into())).into_iter().collect();
    let written = write_atomically(file, |w| write_all(cloud, &Harmonics::default(), &comments, w));
    Ok(written.map_err(IoError::at(file))?)
}

fn origin_comment(origin: DVec3) -> String {
    format!("Origin: {}", origin.to_array().map(|v| v.to_string()).join(" "))
}

/// The bytes that [`write_ply`] writes.
///
/// # Errors
/// [`SplatError::Value`] where a channel is not finite.
pub fn encode_ply(cloud: &Cloud) -> Result<Vec<u8>, SplatError> {
    cloud.check_finite()?;
    let mut bytes = Vec::new();
    write_to(cloud, &mut bytes).expect("memory can be written to");
    Ok(bytes)
}

/// `splats` as the bytes of a `.ply`, whose comments say how to draw them, which way is `up`, and what positions are
/// relative to where that is not zero.
///
/// # Errors
/// [`SplatError::Value`] where a channel is not finite.
pub fn encode_splats(splats: &Splats, up: DVec3) -> Result<Vec<u8>, SplatError> {
    splats.cloud.check_finite()?;
    let mode = match splats.mode {
        RenderMode::Default => "default",
        RenderMode::Mip => "mip",
        RenderMode::Flat => "2dgs",
    };
    let up = up.to_array().map(|v| ((v * 1e9).round() / 1e9 + 0.0).to_string()).join(" ");
    let mut comments = vec![format!("SplatRenderMode: {mode}"), format!("Vertical axis: {up}")];
    if splats.origin != DVec3::ZERO {
        comments.push(origin_comment(splats.origin));
    }
    let mut bytes = Vec::new();
    write_all(&splats.cloud, &splats.harmonics, &comments, &mut bytes).expect("memory can be written to");
    Ok(bytes)
}

fn write_to(cloud: &Cloud, w: &mut impl Write) -> io::Result<()> {
    write_all(cloud, &Harmonics::default(), &[], w)
}

fn write_all(cloud: &Cloud, harmonics: &Harmonics, comments: &[String], w: &mut impl Write) -> io::Result<()> {
    w.write_all(b"ply\nformat binary_little_endian 1.0\n")?;
    comments.iter().try_for_each(|text| writeln!(w, "comment {text}"))?;
    writeln!(w, "element vertex {}", cloud.len())?;
    for (name, _) in COLUMNS {
        if name == "opacity" {
            (0..harmonics.width()).try_for_each(|k| writeln!(w, "property float f_rest_{k}"))?;
        }
        writeln!(w, "property float {name}")?;
    }
    w.write_all(b"end_header\n")?;
    let each = coefficients(harmonics.degree());
    for (i, row) in cloud.iter().enumerate() {
        for (name, c) in COLUMNS {
            if name == "opacity" {
                let rest = harmonics.row(i);
                let by_channel = (0..3).flat_map(|channel| (0..each).map(move |k| rest[3 * k + channel]));
                by_channel.into_iter().try_for_each(|v| w.write_all(&v.to_le_bytes()))?;
            }
            let value = match c {
                None => 0.0,
                Some(c) if channel::COLOR.contains(&c) => ((f64::from(row[c]) - 0.5) / SH_C0) as f32,
                Some(c) => row[c],
            };
            w.write_all(&value.to_le_bytes())?;
        }
    }
    Ok(())
}

/// The first few of `names`; headers may hold thousands.
pub(crate) fn listed(names: &[&str]) -> String {
    let shown = names.iter().take(8).map(|n| n.chars().take(40).collect()).collect::<Vec<String>>().join(", ");
    if names.len() > 8 { format!("{shown} and {} more", names.len() - 8) } else { shown }
}

/// The values after the header, row by row.
pub(crate) struct Values<'a, R> {
    reader: R,
    format: Format,
    pub(crate) file: &'a Path,
    /// ascii: the current line, and how much of it is used up.
    line: Vec<u8>,
    used: usize,
}

/// Longest line of an ascii file, in bytes.
const LINE_LIMIT: u64 = 1 << 24;

impl<R: BufRead> Values<'_, R> {
    /// Calls `each(row, column, value)` for all single values of `element`; of lists, for their length.
    pub(crate) fn rows(
        &mut self,
        element: &Element,
        mut each: impl FnMut(u64, usize, f64) -> Result<(), SplatError>,
    ) -> Result<(), SplatError> {
        if element.properties.is_empty() {
            return Ok(()); // rows of no values take no bytes, however many are claimed
        }
        for row in 0..element.count {
            self.start_row(element, row)?;
            for (column, property) in element.properties.iter().enumerate() {
                let value = match property.kind {
                    Kind::Single(scalar) => self.value(scalar, element, row, property)?,
                    Kind::List(count, item) => {
                        let length = self.value(count, element, row, property)?;
                        if !(0.0..=f64::from(u32::MAX)).contains(&length) {
                            let expected = "the length of a list";
                            return Err(value_error(
                                self.file,
                                element,
                                row,
                                &property.name,
                                expected,
                                &length.to_string(),
                            ));
                        }
                        // At most 2^32 steps, and each of them uses bytes up.
                        for _ in 0..length as u64 {
                            self.value(item, element, row, property)?;
                        }
                        length
                    }
                };
                each(row, column, value)?;
            }
            self.end_row(element, row)?;
        }
        Ok(())
    }

    fn value(&mut self, scalar: Scalar, element: &Element, row: u64, property: &Property) -> Result<f64, SplatError> {
        if self.format == Format::Ascii {
            return self.word(scalar, element, row, property);
        }
        let mut bytes = [0; 8];
        let used = &mut bytes[..scalar.bytes()];
        if let Err(source) = self.reader.read_exact(used) {
            return Err(match source.kind() {
                io::ErrorKind::UnexpectedEof => {
                    let expected = format!("{} rows", element.count);
                    value_error(self.file, element, row, &property.name, &expected, "the end of the file")
                }
                _ => IoError::at(self.file)(source).into(),
            });
        }
        if self.format == Format::Big {
            used.reverse();
        }
        let [a, b, c, d, ..] = bytes;
        Ok(match scalar {
            Scalar::I8 => i8::from_le_bytes([a]).into(),
            Scalar::U8 => a.into(),
            Scalar::I16 => i16::from_le_bytes([a, b]).into(),
            Scalar::U16 => u16::from_le_bytes([a, b]).into(),
            Scalar::I32 => i32::from_le_bytes([a, b, c, d]).into(),
            Scalar::U32 => u32::from_le_bytes([a, b, c, d]).into(),
            Scalar::F32 => f32::from_le_bytes([a, b, c, d]).into(),
            Scalar::F64 => f64::from_le_bytes(bytes),
        })
    }

    /// ascii: takes the next line that is not blank.
    fn start_row(&mut self, element: &Element, row: u64) -> Result<(), SplatError> {
        if self.format != Format::Ascii {
            return Ok(());
        }
        loop {
            self.used = 0;
            self.line.clear();
            let read = self.reader.by_ref().take(LINE_LIMIT).read_until(b'\n', &mut self.line);
            let read = read.map_err(IoError::at(self.file))?;
            let fail = |expected: &str, found| {
                Err(value_error(self.file, element, row, &element.properties[0].name, expected, found))
            };
            if read == 0 {
                return fail(&format!("{} rows", element.count), "the end of the file");
            }
            if read as u64 == LINE_LIMIT {
                return fail("a row", "a line too long");
            }
            if !self.line.trim_ascii().is_empty() {
                return Ok(());
            }
        }
    }

    /// ascii: checks that the line is used up, since else all columns may have been taken for others.
    fn end_row(&self, element: &Element, row: u64) -> Result<(), SplatError> {
        let left = self.line.get(self.used..).unwrap_or_default().trim_ascii();
        match (left.is_empty(), element.properties.last()) {
            (false, Some(last)) => {
                let found = quoted(left);
                Err(value_error(self.file, element, row, &last.name, "the end of the line after it", &found))
            }
            _ => Ok(()),
        }
    }

    /// ascii: the next word of the line as a number.
    fn word(&mut self, scalar: Scalar, element: &Element, row: u64, property: &Property) -> Result<f64, SplatError> {
        let left = self.line[self.used..].trim_ascii_start();
        let word = left.split(u8::is_ascii_whitespace).next().unwrap_or_default();
        self.used = self.line.len() - left.len() + word.len();
        let text = std::str::from_utf8(word).ok();
        // A float is rounded once, from text to f32. Whole numbers may be written with a point.
        let number = match scalar {
            Scalar::F32 => text.and_then(|t| t.parse::<f32>().ok()).map(f64::from),
            _ => text.and_then(|t| t.parse::<f64>().ok()),
        };
        number.ok_or_else(|| {
            let found = if word.is_empty() { "the end of the line".into() } else { quoted(word) };
            value_error(self.file, element, row, &property.name, &format!("a number ({})", scalar.name()), &found)
        })
    }
}

/// The start of what a file holds, for messages.
fn quoted(bytes: &[u8]) -> String {
    format!("{:?}", String::from_utf8_lossy(&bytes[..bytes.len().min(40)]))
}

pub(crate) fn property_error(file: &Path, property: &str, expected: &str, found: &str) -> SplatError {
    SplatError::PlyProperty {
        file: file.into(),
        property: property.into(),
        expected: expected.into(),
        found: found.into(),
    }
}

pub(crate) fn value_error(
    file: &Path,
    element: &Element,
    row: u64,
    property: &str,
    expected: &str,
    found: &str,
) -> SplatError {
    SplatError::PlyValue {
        file: file.into(),
        element: element.name.as_str().into(),
        row,
        property: property.into(),
        expected: expected.into(),
        found: found.into(),
    }
}
