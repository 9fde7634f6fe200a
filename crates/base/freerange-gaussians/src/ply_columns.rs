//! What the properties of a `.ply`'s Gaussians are, in files that we write and in those that we read.

use std::path::Path;

use crate::gaussians::Row;
use crate::ply_error::{listed, property_error};
use crate::ply_header::{Element, Header, Kind, Scalar};
use crate::{MAX_DEGREE, RenderMode, SplatError, channel, coefficients};
use freerange_util::Note;

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

/// The properties that each channel is stored in, but for colors.
const PROPERTIES: [&str; 11] =
    ["x", "y", "z", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity"];
/// Colors as the constant term of spherical harmonics; or, where there is none, as such.
const CONSTANTS: [&str; 3] = ["f_dc_0", "f_dc_1", "f_dc_2"];
const COLORS: [&str; 3] = ["red", "green", "blue"];
/// Of 2D Gaussians: not there.
const THIRD_SCALE: &str = "scale_2";

/// What one property is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Column {
    /// A channel as it is.
    Channel(usize),
    /// The constant term of a color channel.
    Constant(usize),
    /// A color channel, to be multiplied.
    Color(usize, f64),
    /// Number k of the further harmonics.
    Rest(usize),
    /// Nothing that is kept.
    Other,
}

/// How rows become Gaussians.
pub(crate) struct Plan {
    /// Of each property.
    pub columns: Vec<Column>,
    /// Of the harmonics that are kept.
    pub degree: usize,
    /// Coefficients per color channel in the file, at least 1.
    pub rest_each: usize,
    /// Whether positions have more than 32 bits.
    pub exact_positions: bool,
    pub mode: RenderMode,
    flat: bool,
}

impl Plan {
    pub fn new(vertex: &Element, told: Option<RenderMode>, file: &Path) -> Result<Self, SplatError> {
        let find = |name: &str| vertex.properties.iter().find(|p| p.name == name).map(|p| p.kind);
        let flat = find(THIRD_SCALE).is_none() && find("scale_0").is_some() && find("scale_1").is_some();
        for (c, name) in PROPERTIES.into_iter().enumerate() {
            match find(name) {
                None if flat && name == THIRD_SCALE => {}
                // Whole numbers can be positions; elsewhere they would be in some other unit.
                Some(Kind::Single(scalar)) if scalar.is_float() || channel::MEAN.contains(&c) => {}
                other => return Err(unusable(file, name, other)),
            }
        }
        let constants = CONSTANTS.iter().any(|name| find(name).is_some()) || COLORS.iter().any(|n| find(n).is_none());
        for name in if constants { CONSTANTS } else { COLORS } {
            match find(name) {
                Some(Kind::Single(scalar)) if scalar.is_float() || !constants && unit(scalar).is_some() => {}
                other => return Err(unusable(file, name, other)),
            }
        }
        let rest = rest_count(vertex);
        let column = |name: &str, kind: Kind| {
            let at = |names: &[&str]| names.iter().position(|n| *n == name);
            if let Some(c) = at(&PROPERTIES) {
                return Column::Channel(c);
            }
            match (at(if constants { &CONSTANTS } else { &COLORS }), kind) {
                (Some(k), Kind::Single(_)) if constants => Column::Constant(channel::COLOR.start + k),
                (Some(k), Kind::Single(scalar)) => Column::Color(channel::COLOR.start + k, unit(scalar).unwrap_or(1.0)),
                _ => rest_number(name).filter(|k| *k < rest).map_or(Column::Other, Column::Rest),
            }
        };
        let degree = (0..=MAX_DEGREE).rev().find(|d| 3 * coefficients(*d) <= rest).unwrap_or(0);
        let exact = |name: &str| matches!(find(name), Some(Kind::Single(s)) if s.bytes() > 2 && s != Scalar::F32);
        Ok(Self {
            columns: vertex.properties.iter().map(|p| column(&p.name, p.kind)).collect(),
            degree,
            rest_each: (rest / 3).max(1),
            exact_positions: PROPERTIES[channel::MEAN].iter().any(|name| exact(name)),
            mode: told.unwrap_or(if flat { RenderMode::Flat } else { RenderMode::Default }),
            flat,
        })
    }

    /// A row before anything is read.
    pub fn blank(&self) -> Row {
        let mut row = Row::default();
        if self.flat {
            row[channel::LOG_SCALE.end - 1] = SCALE_OF_NONE;
        }
        row
    }

    /// What is left out or looks odd.
    pub fn notes(&self, header: &Header, vertex: usize) -> Vec<Note> {
        let mut notes = Vec::new();
        if self.flat {
            let text = "2D Gaussians (no property scale_2): their third standard deviation is next to nothing";
            notes.push(Note::understood(text));
        }
        let names = || header.elements[vertex].properties.iter().map(|p| p.name.as_str());
        let kept = 3 * coefficients(self.degree);
        let rest = names().filter(|name| name.starts_with(REST)).count();
        if rest > kept {
            notes.push(Note::dropped(format!(
                "{} of {rest} properties f_rest_* (color that depends on the viewing direction) are left out: degrees 1 \
                 to {MAX_DEGREE} have 9, 24 and 45",
                rest - kept
            )));
        }
        let known = |name: &str| COLUMNS.iter().any(|(column, _)| *column == name) || name.starts_with(REST);
        let others: Vec<_> =
            names().zip(&self.columns).filter(|(n, c)| **c == Column::Other && !known(n)).map(|(n, _)| n).collect();
        if !others.is_empty() {
            notes.push(Note::dropped(format!("properties left out: {}", listed(&others))));
        }
        let others: Vec<_> = header.elements.iter().map(|e| e.name.as_str()).filter(|name| *name != "vertex").collect();
        if !others.is_empty() {
            notes.push(Note::dropped(format!("elements left out: {}", listed(&others))));
        }
        notes
    }
}

const REST: &str = "f_rest_";

/// k of `f_rest_k`.
pub(crate) fn rest_number(name: &str) -> Option<usize> {
    name.strip_prefix(REST)?.parse().ok()
}

/// How many `f_rest_*` are harmonics: as many as whole degrees have, numbered from 0; else none.
pub(crate) fn rest_count(element: &Element) -> usize {
    let single = |kind| matches!(kind, Kind::Single(_));
    let mut numbers: Vec<_> =
        element.properties.iter().filter(|p| single(p.kind)).filter_map(|p| rest_number(&p.name)).collect();
    numbers.sort_unstable();
    let whole = (1..=MAX_DEGREE + 1).any(|d| 3 * coefficients(d) == numbers.len());
    if whole && numbers.iter().copied().eq(0..numbers.len()) { numbers.len() } else { 0 }
}

/// What integers of this type are multiplied with to be 0..1.
fn unit(scalar: Scalar) -> Option<f64> {
    match scalar {
        Scalar::U8 => Some(1.0 / 255.0),
        Scalar::U16 => Some(1.0 / 65535.0),
        _ => None,
    }
}

fn unusable(file: &Path, name: &str, found: Option<Kind>) -> SplatError {
    match found {
        None => property_error(file, name, "it, as every file of Gaussians has it", "no such property"),
        Some(Kind::Single(scalar)) => property_error(file, name, "float or double", scalar.name()),
        Some(Kind::List(..)) => property_error(file, name, "float or double", "a list"),
    }
}
