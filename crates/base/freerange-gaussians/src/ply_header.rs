//! The header of a `.ply`: text that names elements, and their properties in order.

use freerange_util::IoError;

use crate::{RenderMode, SplatError};
use glam::DVec3;
use std::{io::BufRead, path::Path};

/// Longest line of a header, and longest whole header, in bytes.
const LINE_LIMIT: u64 = 1 << 16;
const HEADER_LIMIT: u64 = 1 << 20;

/// How the values after the header are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Format {
    Ascii,
    Little,
    Big,
}

/// A number's type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::I8 => "char",
            Self::U8 => "uchar",
            Self::I16 => "short",
            Self::U16 => "ushort",
            Self::I32 => "int",
            Self::U32 => "uint",
            Self::F32 => "float",
            Self::F64 => "double",
        }
    }

    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    pub(crate) fn is_float(self) -> bool {
        matches!(self, Self::F32 | Self::F64)
    }
}

/// What a row has in one column.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Single(Scalar),
    /// A count, then as many items.
    List(Scalar, Scalar),
}

#[derive(Clone, Debug)]
pub(crate) struct Property {
    pub name: String,
    pub kind: Kind,
}

#[derive(Clone, Debug)]
pub(crate) struct Element {
    pub name: String,
    /// As the header claims: nothing may be allocated on its word.
    pub count: u64,
    pub properties: Vec<Property>,
}

#[derive(Clone, Debug)]
pub(crate) struct Header {
    pub format: Format,
    pub elements: Vec<Element>,
    pub comments: Comments,
}

/// What comments say that concerns Gaussians; of several of a kind the last counts.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Comments {
    /// `SplatRenderMode: default | mip | 2dgs` (Brush), or `antialiased 0 | 1` (Postshot).
    pub mode: Option<RenderMode>,
    /// `Vertical axis: X Y Z`, or a letter (Brush, whose y and z point down).
    pub up: Option<DVec3>,
    /// `Origin: X Y Z`, what positions are relative to (ours).
    pub origin: Option<DVec3>,
}

impl Comments {
    fn read(&mut self, words: &[&str]) {
        let text = words.join(" ").to_ascii_lowercase();
        let vector = |text: &str| -> Option<DVec3> {
            let numbers: Vec<f64> = text.split(' ').map(str::parse).collect::<Result<_, _>>().ok()?;
            Some(DVec3::from_array(numbers.try_into().ok()?)).filter(|v| v.is_finite())
        };
        match text.split_once(' ') {
            Some(("splatrendermode:", value)) => {
                self.mode = match value {
                    "default" => Some(RenderMode::Default),
                    "mip" => Some(RenderMode::Mip),
                    "2dgs" => Some(RenderMode::Flat),
                    _ => self.mode,
                }
            }
            Some(("antialiased", "1")) => self.mode = Some(RenderMode::Mip),
            Some(("antialiased", "0")) => self.mode = Some(RenderMode::Default),
            Some(("vertical", rest)) => {
                let axis = match rest.strip_prefix("axis: ") {
                    Some("x") => Some(DVec3::X),
                    Some("y") => Some(-DVec3::Y),
                    Some("z") => Some(-DVec3::Z),
                    Some(axis) => vector(axis).filter(|v| v.length_recip().is_normal()),
                    None => None,
                };
                self.up = axis.or(self.up);
            }
            Some(("origin:", value)) => self.origin = vector(value).or(self.origin),
            _ => {}
        }
    }
}

/// Reads up to and with the line `end_header`.
pub(crate) fn read_header(reader: &mut impl BufRead, file: &Path) -> Result<Header, SplatError> {
    let mut lines = Lines { reader, file, number: 0, total: 0 };
    let first = lines.next("the line \"ply\"")?;
    if first != "ply" {
        return Err(lines.error("the line \"ply\"", &first));
    }
    let mut format = None;
    let mut comments = Comments::default();
    let mut elements: Vec<Element> = Vec::new();
    loop {
        let line = lines.next("the line \"end_header\"")?;
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words[..] {
            ["comment", ref words @ ..] => comments.read(words),
            [] | ["obj_info", ..] => {}
            ["end_header"] => break,
            ["format", name, "1.0"] if format.is_none() => {
                format = Some(match name {
                    "ascii" => Format::Ascii,
                    "binary_little_endian" => Format::Little,
                    "binary_big_endian" => Format::Big,
                    _ => return Err(lines.error("ascii, binary_little_endian or binary_big_endian", name)),
                });
            }
            ["element", name, count] => {
                let Ok(count) = count.parse() else { return Err(lines.error("a count of rows", count)) };
                if elements.iter().any(|e| e.name == name) {
                    return Err(lines.error("every element once", &line));
                }
                elements.push(Element { name: name.into(), count, properties: Vec::new() });
            }
            ["property", ref kind @ .., name] => {
                let scalar = |word: &str| Scalar::parse(word).ok_or_else(|| lines.error("a type such as float", word));
                let kind = match *kind {
                    [single] => Kind::Single(scalar(single)?),
                    ["list", count, item] => {
                        let (count, item) = (scalar(count)?, scalar(item)?);
                        if count.is_float() {
                            return Err(lines.error("an integer type for the count of a list", &line));
                        }
                        Kind::List(count, item)
                    }
                    _ => return Err(lines.error("property TYPE NAME or property list TYPE TYPE NAME", &line)),
                };
                let Some(element) = elements.last_mut() else { return Err(lines.error("an element first", &line)) };
                if element.properties.iter().any(|p| p.name == name) {
                    return Err(lines.error("every property of an element once", &line));
                }
                element.properties.push(Property { name: name.into(), kind });
            }
            _ => return Err(lines.error("format (once), element, property, comment or end_header", &line)),
        }
    }
    let Some(format) = format else { return Err(lines.error("a line \"format ...\" before", "end_header")) };
    Ok(Header { format, elements, comments })
}

struct Lines<'a, R> {
    reader: &'a mut R,
    file: &'a Path,
    number: usize,
    total: u64,
}

impl<R: BufRead> Lines<'_, R> {
    fn next(&mut self, expected: &str) -> Result<String, SplatError> {
        self.number += 1;
        let limit = LINE_LIMIT.min(HEADER_LIMIT - self.total);
        let mut bytes = Vec::new();
        let read = std::io::Read::take(&mut *self.reader, limit).read_until(b'\n', &mut bytes);
        self.total += read.map_err(IoError::at(self.file))? as u64;
        if bytes.pop() != Some(b'\n') {
            let found =
                if bytes.len() as u64 + 1 >= limit { "a line or header too long" } else { "the end of the file" };
            return Err(self.error(expected, found));
        }
        if bytes.last() == Some(&b'\r') {
            bytes.pop();
        }
        // Comments may be in any encoding.
        Ok(String::from_utf8_lossy(&bytes).into_owned())
    }

    fn error(&self, expected: &str, found: &str) -> SplatError {
        // Enough to recognize the line by; a hostile one may be long.
        let found: String = found.chars().take(100).collect();
        SplatError::PlyHeader {
            file: self.file.into(),
            line: self.number,
            expected: expected.into(),
            found: format!("{found:?}").into(),
        }
    }
}
