//! RealityCapture's (RealityScan's) "Internal/External camera parameters", CSV.
//!
//! Columns are found by name: `#name`, `x`, `y`, `alt`, `heading`, `pitch`, `roll` (degrees), `f` (35 mm units: the longer side is 36), and
//! where they are there `px`, `py` (from the middle, as shares of the longer side), `k1` to `k4`, and `t1`, `t2` (OpenCV's `p1`, `p2`, as
//! nerfstudio and Brush take them). At zero angles a camera looks down with its top to +y; heading turns it clockwise as seen from above.
//! Cameras are those of the stored pixels, whatever EXIF data says. A line `#cameras N` may come before the columns' names.

use super::{Cameras, Format, Intrinsics, Photo, Photos, bytes_of, coefficients, text_of, world_to_camera};
use crate::camera::Lens;
use crate::{SceneError, error::In};
use glam::{DMat3, DVec3};
use std::path::Path;

/// Whether a file's beginning looks like one of these.
pub(super) fn is_one(start: &[u8]) -> bool {
    let text = String::from_utf8_lossy(start).to_ascii_lowercase();
    let header = text.trim_start_matches('\u{feff}').lines().find(|l| !is_count(l)).unwrap_or("");
    ["name", "heading", "pitch", "roll"].iter().all(|column| header.contains(column))
}

/// Whether a line is not the columns' names, but how many cameras there are.
fn is_count(line: &str) -> bool {
    line.trim().is_empty() || line.trim_start_matches('#').trim().to_ascii_lowercase().starts_with("cameras")
}

/// Reads the rows: name, intrinsics and lens.
pub fn parse(file: &Path, bytes: &[u8]) -> Result<Vec<(String, Intrinsics, Lens)>, SceneError> {
    let text = text_of(file, bytes)?;
    // Lines are counted from the file's beginning.
    let before = text.lines().take_while(|l| is_count(l)).count() as u64;
    let body = text.split_inclusive('\n').skip(before as usize).collect::<String>();
    let mut reader = csv::ReaderBuilder::new().flexible(true).trim(csv::Trim::All).from_reader(body.as_bytes());
    let bad = |e: csv::Error| In(file).malformed("", e);
    let headers: Vec<String> =
        reader.headers().map_err(bad)?.iter().map(|h| h.trim_start_matches('#').trim().to_ascii_lowercase()).collect();
    let column = |name: &str| headers.iter().position(|h| h == name);
    let needed = |name: &str| {
        column(name).ok_or_else(|| In(file).field(&format!("line {}", 1 + before), name, "a column", "none"))
    };
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
        let place = format!("line {}", before + record.position().map_or(0, csv::Position::line));
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
        coefficients(file, &place, &OPTIONAL[2..8], &o[2..8])?;
        let [x, y, z, heading, pitch, roll, f] = v;
        if !(0.36..=36_000.0).contains(&f) {
            return Err(In(file).field(&place, "f", "a focal length from 0.36 to 36000 (35 mm units)", f));
        }
        if let Some((v, name)) = o[..2].iter().zip(OPTIONAL).find(|(v, _)| v.abs() > 1.0) {
            return Err(In(file).field(&place, name, "a principal point within 1 (the longer side) of the middle", v));
        }
        let turned = DMat3::from_rotation_z(-heading.to_radians())
            * DMat3::from_rotation_x(pitch.to_radians())
            * DMat3::from_rotation_y(roll.to_radians());
        // OpenGL's camera axes there, OpenCV's here.
        let axes = DMat3::from_cols(turned.x_axis, -turned.y_axis, -turned.z_axis);
        let world_to_camera = world_to_camera(file, &place, axes, DVec3::new(x, y, z))?;
        let intrinsics =
            Intrinsics::Relative { focal: f / 36.0, offset: [o[0], o[1]], world_to_camera, upright: false };
        rows.push((name, intrinsics, Lens::brown([o[2], o[3], o[4], o[5]], [o[6], o[7]])));
    }
    Ok(rows)
}

pub(super) fn read(file: &Path, images: Option<&Path>) -> Result<Cameras, SceneError> {
    let mut found = Photos::beside(file, images);
    let mut photos = Vec::new();
    for (name, intrinsics, lens) in parse(file, &bytes_of(file)?)? {
        if let Some(image) = found.find(&name)? {
            photos.push(Photo { name, image, mask: None, intrinsics, lens, further: false });
        }
    }
    let mut notes = Vec::new();
    found.finish(&mut notes)?;
    Ok(Cameras::new(Format::Realitycapture, photos, vec![file.into()], notes))
}
