//! RealityCapture's (RealityScan's) "Internal/External camera parameters", CSV.
//!
//! Columns are found by name: `#name`, `x`, `y`, `alt`, `heading`, `pitch`, `roll` (degrees), `f` (35 mm units: the longer side is 36), and
//! where they are there `px`, `py` (from the middle, the same units) and `k1` to `k4`. At zero angles a camera looks down with its top to +y;
//! heading turns it clockwise as seen from above.

use super::{Cameras, Format, Intrinsics, Photo, bytes_of, coefficients, find_image, text_of, world_to_camera};
use crate::{SceneError, error::In};
use freerange_camera::Lens;
use glam::{DMat3, DVec3};
use std::path::{Path, PathBuf};

/// Whether a file's beginning looks like one of these.
pub(super) fn is_one(start: &[u8]) -> bool {
    let text = String::from_utf8_lossy(start).to_ascii_lowercase();
    let header = text.lines().next().unwrap_or("");
    ["name", "heading", "pitch", "roll"].iter().all(|column| header.contains(column))
}

/// Reads the rows: name, intrinsics and lens.
pub fn parse(file: &Path, bytes: &[u8]) -> Result<Vec<(String, Intrinsics, Lens)>, SceneError> {
    let text = text_of(file, bytes)?;
    let mut reader = csv::ReaderBuilder::new().flexible(true).trim(csv::Trim::All).from_reader(text.as_bytes());
    let bad = |e: csv::Error| In(file).malformed("", e);
    let headers: Vec<String> =
        reader.headers().map_err(bad)?.iter().map(|h| h.trim_start_matches('#').trim().to_ascii_lowercase()).collect();
    let column = |name: &str| headers.iter().position(|h| h == name);
    let needed = |name: &str| column(name).ok_or_else(|| In(file).field("line 1", name, "a column", "none"));
    let name_at = needed("name")?;
    let at = [
        needed("x")?,
        needed("y")?,
        needed("alt")?,
        needed("heading")?,
        needed("pitch")?,
        needed("roll")?,
        needed("f")?,
    ];
    const NEEDED: [&str; 7] = ["x", "y", "alt", "heading", "pitch", "roll", "f"];
    const OPTIONAL: [&str; 8] = ["px", "py", "k1", "k2", "k3", "k4", "t1", "t2"];
    let optional = OPTIONAL.map(column);
    let mut rows = Vec::new();
    for record in reader.records() {
        let record = record.map_err(bad)?;
        let place = format!("line {}", record.position().map_or(0, csv::Position::line));
        let number = |name: &str, i: usize| {
            let text = record.get(i).unwrap_or("nothing");
            let value = text.parse().ok().filter(|v: &f64| v.is_finite());
            value.ok_or_else(|| In(file).field(&place, name, "a number", text))
        };
        let mut v = [0.0; 7];
        for ((v, i), name) in v.iter_mut().zip(at).zip(NEEDED) {
            *v = number(name, i)?;
        }
        let mut o = [0.0; 8];
        for ((o, i), name) in o.iter_mut().zip(optional).zip(OPTIONAL) {
            if let Some(i) = i.filter(|&i| record.get(i).is_some_and(|text| !text.is_empty())) {
                *o = number(name, i)?;
            }
        }
        let name = record.get(name_at).unwrap_or("").to_owned();
        if name.is_empty() {
            return Err(In(file).field(&place, "name", "a file name", "nothing"));
        }
        if o[6] != 0.0 || o[7] != 0.0 {
            let advice = "align with a model without t1 and t2, or export undistorted images";
            return Err(In(file).unsupported(&place, "tangential distortion (`t1`, `t2`)", advice));
        }
        coefficients(file, &place, &OPTIONAL[2..6], &o[2..6])?;
        let [x, y, z, heading, pitch, roll, f] = v;
        if !(0.36..=36_000.0).contains(&f) {
            return Err(In(file).field(&place, "f", "a focal length from 0.36 to 36000 (35 mm units)", f));
        }
        if o[0].abs().max(o[1].abs()) > 36.0 {
            return Err(In(file).field(&place, "px", "a principal point within 36 of the middle", o[0]));
        }
        let turned = DMat3::from_rotation_z(-heading.to_radians())
            * DMat3::from_rotation_x(pitch.to_radians())
            * DMat3::from_rotation_y(roll.to_radians());
        // OpenGL's camera axes there, OpenCV's here.
        let axes = DMat3::from_cols(turned.x_axis, -turned.y_axis, -turned.z_axis);
        let world_to_camera = world_to_camera(file, &place, axes, DVec3::new(x, y, z))?;
        let intrinsics = Intrinsics::Relative { focal: f / 36.0, offset: [o[0] / 36.0, o[1] / 36.0], world_to_camera };
        rows.push((name, intrinsics, Lens::brown([o[2], o[3], o[4], o[5]], [0.0; 2])));
    }
    Ok(rows)
}

pub(super) fn read(file: &Path, images: Option<&Path>) -> Result<Cameras, SceneError> {
    let folder = file.parent().unwrap_or(Path::new(""));
    let folders: Vec<PathBuf> = match images {
        Some(images) => vec![images.to_path_buf()],
        None => vec![folder.join("images"), folder.to_path_buf()],
    };
    let photos = parse(file, &bytes_of(file)?)?
        .into_iter()
        .map(|(name, intrinsics, lens)| {
            let image = find_image(&file.display().to_string(), &name, &folders)?;
            Ok(Photo { name, image, mask: None, intrinsics, lens, further: false })
        })
        .collect::<Result<Vec<_>, SceneError>>()?;
    Ok(Cameras { format: Format::Realitycapture, photos, files: vec![file.into()], notes: Vec::new() })
}
