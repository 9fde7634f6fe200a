//! The `.ply` files that 3D Gaussian splatting tools exchange.
//!
//! Written: binary little endian, `x y z nx ny nz f_dc_0..2 opacity scale_0..2 rot_0..3`, all float; `f_dc` is the
//! colour as the constant term of spherical harmonics, `opacity` a logit, `scale` a logarithm, `rot` a quaternion wxyz.
//! Read: any order of properties, further properties and elements, ascii and both byte orders, and the compressed form
//! of PlayCanvas. Headers are not trusted: memory grows with the rows that arrive.

use crate::cloud::Row;
use crate::ply_compressed;
use crate::ply_header::{Element, Format, Header, Kind, Property, Scalar, read_header};
use crate::{Cloud, SplatError, channel};
use freerange_core::{IoError, write_atomically};
use std::io::{self, BufRead, BufReader, Read, Write};
use std::{fs::File, path::Path};

/// The constant real spherical harmonic, 1 / (2 sqrt(pi)).
const SH_C0: f64 = 0.282_094_791_773_878_14;

/// The property that each channel is stored in.
const PROPERTIES: [&str; channel::COUNT] = [
    "x", "y", "z", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity", "f_dc_0", "f_dc_1",
    "f_dc_2",
];

/// Columns of the files we write: a channel, or a zero (the normal that nobody uses).
const COLUMNS: [(&str, Option<usize>); 17] = [
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

/// What a `.ply` holds.
#[derive(Clone, Debug, PartialEq)]
pub struct PlyFile {
    /// The Gaussians; all channels finite.
    pub cloud: Cloud,
    /// What was left out or looks odd, one sentence each, for the user.
    pub notes: Vec<String>,
}

/// Reads the Gaussians of a `.ply` file.
///
/// # Errors
/// [`SplatError::Io`]; [`SplatError::PlyHeader`], [`SplatError::PlyProperty`] and [`SplatError::PlyValue`] where the
/// file is no `.ply`, does not hold Gaussians, ends early, or holds a value that is not finite.
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
    let channel_of = columns(&header.elements[at], file)?;
    let mut notes = notes(&header, at);

    for element in &header.elements[..at] {
        values.rows(element, |_, _, _| Ok(()))?;
    }
    let vertex = &header.elements[at];
    // The count may lie: rows beyond the first few are allocated as they arrive.
    let mut data = Vec::with_capacity(vertex.count.min(1 << 16) as usize * channel::COUNT);
    let mut row = Row::default();
    values.rows(vertex, |i, column, value| {
        if let Some(c) = channel_of[column] {
            let value = if channel::COLOR.contains(&c) { value * SH_C0 + 0.5 } else { value };
            row[c] = value as f32;
            if !row[c].is_finite() {
                let name = &vertex.properties[column].name;
                return Err(value_error(file, vertex, i, name, "a finite number", &row[c].to_string()));
            }
        }
        if column + 1 == channel_of.len() {
            data.extend_from_slice(&row);
        }
        Ok(())
    })?;
    let cloud = Cloud::from_rows(data);
    let zero = cloud.iter().filter(|row| row[channel::ROTATION].iter().all(|v| *v == 0.0)).count();
    if zero > 0 {
        notes.push(format!("{zero} Gaussians have a rotation of length zero, which stands for none"));
    }
    Ok(PlyFile { cloud, notes })
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

/// The words before the numbers of an origin in a file's header.
const ORIGIN: &str = "comment origin ";

/// As [`write_ply`], with the origin that positions are relative to, where they would be too large for 32 bits, as a comment:
/// `comment origin X Y Z`.
///
/// # Errors
/// As [`write_ply`].
pub fn write_ply_at(cloud: &Cloud, origin: Option<[f64; 3]>, file: &Path) -> Result<(), SplatError> {
    cloud.check_finite()?;
    let line = origin.map_or(String::new(), |[x, y, z]| format!("{ORIGIN}{x} {y} {z}\n"));
    Ok(write_atomically(file, |w| write_with(cloud, &line, w)).map_err(IoError::at(file))?)
}

/// The origin that [`write_ply_at`] wrote into a file; none where there is none, or the file is no `.ply`.
///
/// # Errors
/// [`SplatError::Io`].
pub fn ply_origin(file: &Path) -> Result<Option<[f64; 3]>, SplatError> {
    let mut start = Vec::new();
    File::open(file).and_then(|f| f.take(4096).read_to_end(&mut start)).map_err(IoError::at(file))?;
    let text = String::from_utf8_lossy(&start);
    let header =
        if text.starts_with("ply") { text.lines().take_while(|l| l.trim() != "end_header") } else { return Ok(None) };
    let numbers = |line: &str| -> Option<[f64; 3]> {
        let words = line.strip_prefix(ORIGIN)?.split_ascii_whitespace();
        words.map(|w| w.parse().ok().filter(|v: &f64| v.is_finite())).collect::<Option<Vec<f64>>>()?.try_into().ok()
    };
    Ok(header.filter_map(numbers).next())
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

fn write_to(cloud: &Cloud, w: &mut impl Write) -> io::Result<()> {
    write_with(cloud, "", w)
}

/// `comments`: whole lines of the header.
fn write_with(cloud: &Cloud, comments: &str, w: &mut impl Write) -> io::Result<()> {
    write!(w, "ply\nformat binary_little_endian 1.0\n{comments}element vertex {}\n", cloud.len())?;
    for (name, _) in COLUMNS {
        writeln!(w, "property float {name}")?;
    }
    w.write_all(b"end_header\n")?;
    for row in cloud {
        for (_, c) in COLUMNS {
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

/// Which channel each property of `vertex` fills, if any.
fn columns(vertex: &Element, file: &Path) -> Result<Vec<Option<usize>>, SplatError> {
    for (c, name) in PROPERTIES.into_iter().enumerate() {
        let Some(property) = vertex.properties.iter().find(|p| p.name == name) else {
            return Err(property_error(file, name, "it, as every file of Gaussians has it", "no such property"));
        };
        match property.kind {
            // Whole numbers can be positions; elsewhere they would be in some other unit.
            Kind::Single(scalar) if scalar.is_float() || channel::MEAN.contains(&c) => {}
            Kind::Single(scalar) => return Err(property_error(file, name, "float or double", scalar.name())),
            Kind::List(..) => return Err(property_error(file, name, "float or double", "a list")),
        }
    }
    Ok(vertex.properties.iter().map(|p| PROPERTIES.iter().position(|name| *name == p.name)).collect())
}

fn notes(header: &Header, vertex: usize) -> Vec<String> {
    let is_rest = |name: &str| name.starts_with("f_rest_");
    let names = || header.elements[vertex].properties.iter().map(|p| p.name.as_str());
    let mut notes = Vec::new();
    let rest = names().filter(|name| is_rest(name)).count();
    if rest > 0 {
        notes.push(format!("{rest} properties f_rest_* (colour that depends on the viewing direction) are left out"));
    }
    let known = |name: &str| COLUMNS.iter().any(|(column, _)| *column == name);
    let others: Vec<_> = names().filter(|name| !known(name) && !is_rest(name)).collect();
    if !others.is_empty() {
        notes.push(format!("properties left out: {}", listed(&others)));
    }
    let others: Vec<_> = header.elements.iter().map(|e| e.name.as_str()).filter(|name| *name != "vertex").collect();
    if !others.is_empty() {
        notes.push(format!("elements left out: {}", listed(&others)));
    }
    notes
}

/// The first few of `names`; headers may hold thousands.
fn listed(names: &[&str]) -> String {
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
