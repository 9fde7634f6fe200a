//! The `.ply` files that 3D Gaussian splatting tools exchange.
//!
//! Written: binary little endian, `x y z nx ny nz f_dc_0..2 f_rest_.. opacity scale_0..2 rot_0..3`, all float; `f_dc` is
//! the color as the constant term of spherical harmonics, `f_rest` the others (all of red, then green, then blue),
//! `opacity` a logit, `scale` a logarithm, `rot` a quaternion wxyz.
//! Read: any order of properties, further properties and elements, ascii and both byte orders, colors as bytes, files
//! of 2D Gaussians, and the compressed form of PlayCanvas. Gaussians that are not finite are left out. Headers are not
//! trusted: memory grows with the rows that arrive.

use crate::ply_columns::{COLUMNS, Column, Plan, SCALE_OF_NONE};
use crate::ply_compressed;
use crate::ply_error::{listed, property_error, value_error};
use crate::ply_file::PlyFile;
use crate::ply_header::{Element, read_header};
use crate::ply_values::Values;
use crate::{Gaussians, Harmonics, RenderMode, SplatError, Splats, channel, coefficients};
use freerange_util::{IoError, Note, write_atomically};
use glam::DVec3;
use std::io::{self, BufRead, BufReader, Write};
use std::{fs::File, path::Path};

/// The constant real spherical harmonic, 1 / (2 sqrt(pi)).
pub(crate) const SH_C0: f64 = 0.282_094_791_773_878_14;

/// The logit of an opacity of 1, which has none either: that of the number of 32 bits next to it.
const LOGIT_OF_ONE: f32 = 16.118_095;

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
    let mut values = Values::new(reader, header.format, file);
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
    let cloud = Gaussians::from_rows(std::mem::take(&mut rows.data));
    if cloud.is_empty() && rows.dropped > 0 {
        return Err(value_error(file, vertex, 0, "x", "at least one Gaussian of finite numbers", "none"));
    }
    notes.extend(rows.notes());
    let zero = cloud.iter().filter(|row| row[channel::ROTATION].iter().all(|v| *v == 0.0)).count();
    if zero > 0 {
        let text = format!("{zero} Gaussians have a rotation of length zero, which stands for none");
        notes.push(Note::understood(text));
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
    fn notes(&self) -> Vec<Note> {
        let mut notes = Vec::new();
        if self.dropped > 0 {
            let text = format!("{} Gaussians with numbers that are not finite are left out", self.dropped);
            notes.push(Note::dropped(text));
        }
        if self.clamped > 0 {
            notes.push(Note::changed(format!(
                "{} Gaussians have an infinite opacity or log-scale, taken as the nearest finite one",
                self.clamped
            )));
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
/// back gives the same values in all channels but color, which is rounded once.
///
/// # Errors
/// [`SplatError::Io`]; [`SplatError::Value`] where a channel is not finite.
pub fn write_ply(cloud: &Gaussians, file: &Path) -> Result<(), SplatError> {
    cloud.check_finite()?;
    Ok(write_atomically(file, |w| write_to(cloud, w)).map_err(IoError::at(file))?)
}

fn origin_comment(origin: DVec3) -> String {
    format!("Origin: {}", origin.to_array().map(|v| v.to_string()).join(" "))
}

/// The bytes that [`write_ply`] writes.
///
/// # Errors
/// [`SplatError::Value`] where a channel is not finite.
pub fn encode_ply(cloud: &Gaussians) -> Result<Vec<u8>, SplatError> {
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

fn write_to(cloud: &Gaussians, w: &mut impl Write) -> io::Result<()> {
    write_all(cloud, &Harmonics::default(), &[], w)
}

fn write_all(cloud: &Gaussians, harmonics: &Harmonics, comments: &[String], w: &mut impl Write) -> io::Result<()> {
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
