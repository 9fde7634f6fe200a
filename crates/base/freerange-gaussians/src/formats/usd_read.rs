//! Reading OpenUSD's `ParticleField3DGaussianSplat` from `.usda` and `.usdz`, without composition: what other layers add
//! is not looked for. Binary layers are refused: their reader allocates what a file claims.
//!
//! No validator checks that arrays are of one length, or that quaternions have one: it is done here.

use std::{
    borrow::Cow,
    io::{Cursor, Read},
};

use crate::{Gaussians, Harmonics, MAX_DEGREE, Splats, channel, coefficients};
use freerange_util::{Invalid, Note};
use glam::{DMat3, DMat4, DQuat, DVec3};
use zip::ZipArchive;

use crate::formats::{
    Decoded, Frame,
    error::{archive_problem, problem},
    placed::{EXPECTED, Similarity},
    quantize::{Row, color_of_sh, encoded, log_scale, logit, set_rotation},
    usd::{COEFFICIENTS, DEGREE, DISPLAY_COLOR, OPACITIES, ORIENTATIONS, POSITIONS, PRIM, SCALES},
    usd_text::{Layer, Prim, Value, find, parse},
};

/// The first bytes of a binary layer, and of a `.usdz`.
const CRATE: &[u8] = b"PXR-USDC";
const ARCHIVE: &[u8] = b"PK";

pub fn decode(bytes: &[u8]) -> Result<Decoded, Invalid> {
    let text = if bytes.starts_with(ARCHIVE) { first_layer(bytes)? } else { Cow::Borrowed(bytes) };
    if text.starts_with(CRATE) {
        let expected = "a text layer (.usda), as `usdcat x.usdc -o x.usda` of OpenUSD writes it";
        return Err(problem("layer", expected, "a binary one (.usdc)"));
    }
    let text = std::str::from_utf8(&text).map_err(|e| problem("layer", "text in UTF-8", e))?;
    let stage = Stage { layer: parse(text)? };
    let mut found = Found::default();
    for prim in stage.layer.prims.iter().filter(|p| p.specifier == "def" && p.kind == PRIM) {
        stage.gaussians(prim, &mut found)?;
    }
    if found.positions.is_empty() {
        return Err(problem("stage", format!("a prim of type {PRIM}"), "none"));
    }
    let metadata = |name: &str| find(&stage.layer.metadata, name);
    let frame = match metadata("upAxis").and_then(|v| v.words.first()).map(String::as_str) {
        Some("Z") => Frame::Z_UP,
        Some("Y") | None => Frame::Y_UP,
        Some(other) => return Err(problem("upAxis", "\"Y\" or \"Z\"", other)),
    };
    if let Some([unit]) = metadata("metersPerUnit").map(|v| &v.numbers[..])
        && *unit != 1.0
    {
        let text = format!("a unit of the stage is {unit} meters: numbers are kept as they are");
        found.notes.push(Note::understood(text));
    }
    let Found { mut splats, positions, notes } = found;
    splats.place(&positions);
    Ok(Decoded { splats, frame: Some(frame), notes })
}

/// The first file of an archive, its root layer.
fn first_layer(bytes: &[u8]) -> Result<Cow<'static, [u8]>, Invalid> {
    let broken = |e: &dyn std::fmt::Display| archive_problem(bytes, "a .usdz archive", e);
    let mut archive = ZipArchive::new(Cursor::new(bytes)).map_err(|e| broken(&e))?;
    let first = archive.by_index(0).map_err(|e| broken(&e))?;
    // Files in it are stored as they are.
    let limit = bytes.len() as u64;
    let mut layer = Vec::new();
    first.take(limit + 1).read_to_end(&mut layer).map_err(|e| broken(&e))?;
    if layer.len() as u64 > limit {
        return Err(problem("archive", "files that are not compressed", "a compressed one"));
    }
    Ok(Cow::Owned(layer))
}

#[derive(Default)]
struct Found {
    splats: Splats,
    positions: Vec<DVec3>,
    notes: Vec<Note>,
}

struct Stage {
    layer: Layer,
}

impl Stage {
    /// The numbers of an array, `width` each: of the attribute, or of the one of 16 bits beside it (`...h`).
    fn numbers(&self, prim: &Prim, name: &str, width: usize) -> Result<Option<Vec<f32>>, Invalid> {
        for name in [name, &format!("{name}h")] {
            if let Some(value) = find(&prim.attributes, name) {
                if !value.numbers.is_empty() && value.width != width || !value.words.is_empty() {
                    let expected = format!("an array of {width} numbers each");
                    return Err(problem(format!("{}, {name}", prim.path), expected, "another value"));
                }
                return Ok(Some(value.numbers.iter().map(|v| *v as f32).collect()));
            }
        }
        Ok(None)
    }

    fn needed(&self, prim: &Prim, name: &str, width: usize) -> Result<Vec<f32>, Invalid> {
        let missing = || problem(format!("{}, {name}", prim.path), "its values", "none that hold at all times");
        self.numbers(prim, name, width)?.ok_or_else(missing)
    }

    /// Appends the Gaussians of `prim`.
    fn gaussians(&self, prim: &Prim, found: &mut Found) -> Result<(), Invalid> {
        let (path, place) = (&prim.path, self.place(prim)?);
        let positions = self.needed(prim, POSITIONS, 3)?;
        let orientations = self.needed(prim, ORIENTATIONS, 4)?;
        let scales = self.needed(prim, SCALES, 3)?;
        let opacities = self.needed(prim, OPACITIES, 1)?;
        let count = positions.len() / 3;
        let lengths =
            [(ORIENTATIONS, orientations.len() / 4), (SCALES, scales.len() / 3), (OPACITIES, opacities.len())];
        for (name, length) in lengths {
            if length != count {
                let expected = format!("{count} values, as there are positions");
                return Err(problem(format!("{path}, {name}"), expected, length));
            }
        }
        let (colors, mut harmonics) = self.radiance(prim, count, &mut found.notes)?;
        harmonics.turn(DMat3::from_quat(place.rotation));
        let mut rows = Vec::with_capacity(count * channel::COUNT);
        for i in 0..count {
            let bad = |name: &str, expected: &str, found: &dyn std::fmt::Display| {
                Err(problem(format!("{path}, {name}, element {i}"), expected, found))
            };
            let mut row = Row::default();
            let position = DVec3::from_array([0, 1, 2].map(|k| positions[3 * i + k].into()));
            found.positions.push(place.apply(position));
            for k in 0..3 {
                let scale = scales[3 * i + k];
                if scale < 0.0 {
                    return bad(SCALES, "a number, at least 0", &scale);
                }
                row[channel::LOG_SCALE.start + k] = log_scale(f64::from(scale) * place.scale);
                row[channel::COLOR.start + k] = colors[3 * i + k];
            }
            let [w, x, y, z] = [0, 1, 2, 3].map(|k| f64::from(orientations[4 * i + k]));
            let q = DQuat::from_xyzw(x, y, z, w);
            if q.length() == 0.0 {
                return bad(ORIENTATIONS, "a quaternion of unit length", &"one of length 0");
            }
            let q = place.rotation * q;
            set_rotation(&mut row, [q.w, q.x, q.y, q.z]);
            if opacities[i] < 0.0 || opacities[i] > 1.0 {
                return bad(OPACITIES, "0 to 1", &opacities[i]);
            }
            row[channel::LOGIT_OPACITY] = logit(opacities[i].into());
            rows.extend(row);
        }
        found.splats.append(&Splats { harmonics, ..Gaussians::from_rows(rows).into() });
        Ok(())
    }

    /// Colors, and what depends on the viewing direction.
    fn radiance(&self, prim: &Prim, count: usize, notes: &mut Vec<Note>) -> Result<(Vec<f32>, Harmonics), Invalid> {
        let path = &prim.path;
        let Some(values) = self.numbers(prim, COEFFICIENTS, 3)? else {
            let shown = self.numbers(prim, DISPLAY_COLOR, 3)?.filter(|c| c.len() == 3 * count || c.len() == 3);
            let Some(shown) = shown else {
                let expected = format!("it, or {DISPLAY_COLOR} of {count} values");
                return Err(problem(format!("{path}, {COEFFICIENTS}"), expected, "neither"));
            };
            notes.push(Note::assumed(format!("{path} has no {COEFFICIENTS}: colors are its {DISPLAY_COLOR}")));
            let colors = shown.iter().cycle().take(3 * count).map(|v| encoded(f64::from(*v)) as f32).collect();
            return Ok((colors, Harmonics::default()));
        };
        let degree = match find(&prim.attributes, DEGREE).map(|v| &v.numbers[..]) {
            Some(&[degree]) if (0.0..=8.0).contains(&degree) => degree as usize,
            None => 3, // as the schema says
            Some(other) => return Err(problem(format!("{path}, {DEGREE}"), "0 to 8", format!("{other:?}"))),
        };
        let each = (degree + 1).pow(2);
        if values.len() != 3 * each * count {
            let expected = format!("{each} values (degree {degree}) for each of {count} Gaussians");
            return Err(problem(format!("{path}, {COEFFICIENTS}"), expected, values.len() / 3));
        }
        let kept = degree.min(MAX_DEGREE);
        if degree > kept {
            let text = format!("color that depends on the viewing direction is left out beyond degree {MAX_DEGREE}");
            notes.push(Note::dropped(text));
        }
        let rows = || values.chunks_exact(3 * each);
        let colors = rows().flat_map(|row| row[..3].iter().map(|v| color_of_sh(f64::from(*v)))).collect();
        let rest = rows().flat_map(|row| row[3..][..3 * coefficients(kept)].iter().copied()).collect();
        Ok((colors, Harmonics::from_rows(kept, rest)))
    }

    /// Where `prim` and the prims above it put its points.
    fn place(&self, prim: &Prim) -> Result<Similarity, Invalid> {
        let mut place = Similarity::NONE;
        let mut next = Some(prim);
        while let Some(prim) = next {
            let own = Similarity::from_matrix(transform(prim)?);
            let own =
                own.ok_or_else(|| problem(format!("{}, xformOpOrder", prim.path), EXPECTED, "another transform"))?;
            place = own.after(&place);
            next = prim.parent.map(|p| &self.layer.prims[p]);
        }
        Ok(place)
    }
}

/// The product of a prim's own `xformOp`s, the first of which is applied last.
fn transform(prim: &Prim) -> Result<DMat4, Invalid> {
    let mut matrix = DMat4::IDENTITY;
    for name in find(&prim.attributes, "xformOpOrder").map_or(&[][..], |v| &v.words) {
        let value = find(&prim.attributes, name);
        let kind = name.strip_prefix("xformOp:").map(|rest| rest.split(':').next().unwrap_or(rest));
        let Some(operation) = kind.zip(value).and_then(|(kind, value)| operation(kind, value)) else {
            let name: String = name.chars().take(60).collect();
            let expected = "translate, scale, orient, rotateX, rotateY, rotateZ, rotateXYZ or transform, with a value";
            return Err(problem(format!("{}, xformOpOrder", prim.path), expected, name));
        };
        matrix *= operation;
    }
    Ok(matrix)
}

/// One step of a transform. Angles are in degrees; matrices are written with translations in the last row.
fn operation(kind: &str, value: &Value) -> Option<DMat4> {
    let numbers = &value.numbers;
    let vector = || Some(DVec3::from_array(numbers[..].try_into().ok()?));
    let angle = || Some(if let [angle] = numbers[..] { angle.to_radians() } else { return None });
    Some(match kind {
        "translate" => DMat4::from_translation(vector()?),
        "scale" => DMat4::from_scale(vector()?),
        "orient" => {
            let [w, x, y, z]: [f64; 4] = numbers[..].try_into().ok()?;
            DMat4::from_quat(DQuat::from_xyzw(x, y, z, w).normalize())
        }
        "rotateX" => DMat4::from_rotation_x(angle()?),
        "rotateY" => DMat4::from_rotation_y(angle()?),
        "rotateZ" => DMat4::from_rotation_z(angle()?),
        "rotateXYZ" => {
            let [x, y, z] = vector()?.to_array().map(f64::to_radians);
            DMat4::from_rotation_z(z) * DMat4::from_rotation_y(y) * DMat4::from_rotation_x(x)
        }
        "transform" => DMat4::from_cols_array(&numbers[..].try_into().ok()?),
        _ => return None,
    })
}
