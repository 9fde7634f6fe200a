//! The values of a `.ply` after its header, one by one, in ascii and both byte orders.

use crate::SplatError;
use crate::ply_error::{END, value_error};
use crate::ply_header::{Element, Format, Kind, Property, Scalar};
use freerange_util::IoError;
use std::io::{self, BufRead, Read};
use std::path::Path;

/// The values after the header, row by row.
pub(crate) struct Values<'a, R> {
    reader: R,
    format: Format,
    pub file: &'a Path,
    /// ascii: the current line, and how much of it is used up.
    line: Vec<u8>,
    used: usize,
}

/// Longest line of an ascii file, in bytes.
const LINE_LIMIT: u64 = 1 << 24;

impl<'a, R: BufRead> Values<'a, R> {
    /// What comes after the header that was just read from `reader`.
    pub fn new(reader: R, format: Format, file: &'a Path) -> Self {
        Self { reader, format, file, line: Vec::new(), used: 0 }
    }

    /// Calls `each(row, column, value)` for all single values of `element`; of lists, for their length.
    pub fn rows(
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
                    value_error(self.file, element, row, &property.name, &expected, END)
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
                return fail(&format!("{} rows", element.count), END);
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
