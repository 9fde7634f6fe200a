//! Reading OpenUSD's `ParticleField3DGaussianSplat` from `.usda`, `.usdc` and `.usdz`, without composition: what other
//! layers add is not looked for.
//!
//! No validator checks that arrays are of one length, or that quaternions have one: it is done here.

use std::{
    borrow::Cow,
    io::{Cursor, Read},
};

use freerange_core::Invalid;
use freerange_splat::{Cloud, Harmonics, MAX_DEGREE, Splats, channel, coefficients};
use glam::{DMat3, DMat4, DQuat, DVec3};
use openusd::{
    sdf::{AbstractData, Path, SpecType, Value},
    usda,
    usdc::CrateData,
};
use zip::ZipArchive;

use crate::{
    Decoded, Frame,
    bytes::check_expansion,
    error::problem,
    placed::{EXPECTED, Similarity},
    quantize::{Row, color_of_sh, encoded, log_scale, logit, set_rotation},
    usd::{COEFFICIENTS, DEGREE, DISPLAY_COLOR, OPACITIES, ORIENTATIONS, POSITIONS, PRIM, SCALES},
};

/// The first bytes of a `.usdc`, and of a `.usdz`.
const CRATE: &[u8] = b"PXR-USDC";
const ARCHIVE: &[u8] = b"PK";

pub fn decode(bytes: &[u8]) -> Result<Decoded, Invalid> {
    let layer = if bytes.starts_with(ARCHIVE) { first_layer(bytes)? } else { Cow::Borrowed(bytes) };
    let data: Box<dyn AbstractData> = if layer.starts_with(CRATE) {
        let opened = CrateData::open(Cursor::new(layer.to_vec()), true);
        Box::new(opened.map_err(|e| problem("layer", "a binary layer of OpenUSD", e))?)
    } else {
        let text = std::str::from_utf8(&layer).map_err(|e| problem("layer", "text in UTF-8", e))?;
        Box::new(usda::parse(text).map_err(|e| problem("layer", "a text layer of OpenUSD", e))?)
    };
    let stage = Stage { data: &*data, size: bytes.len() };
    let mut found = Found::default();
    for path in data.spec_paths() {
        let prim = data.spec_type(&path) == Some(SpecType::Prim);
        if prim && stage.token(&path, "typeName")?.as_deref() == Some(PRIM) {
            stage.gaussians(&path, &mut found)?;
        }
    }
    if found.positions.is_empty() {
        return Err(problem("stage", format!("a prim of type {PRIM}"), "none"));
    }
    let root = Path::abs_root();
    let frame = match stage.token(&root, "upAxis")?.as_deref() {
        Some("Z") => Frame::Z_UP,
        Some("Y") | None => Frame::Y_UP,
        Some(other) => return Err(problem("upAxis", "\"Y\" or \"Z\"", other)),
    };
    if let Some(Value::Double(unit)) = stage.field(&root, "metersPerUnit")?.as_deref()
        && *unit != 1.0
    {
        found.notes.push(format!("a unit of the stage is {unit} meters: numbers are kept as they are"));
    }
    let Found { mut splats, positions, notes } = found;
    splats.place(&positions);
    Ok(Decoded { splats, frame: Some(frame), notes })
}

/// The first file of an archive, its root layer.
fn first_layer(bytes: &[u8]) -> Result<Cow<'static, [u8]>, Invalid> {
    let broken = |e: &dyn std::fmt::Display| problem("archive", "a .usdz archive", e);
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
    notes: Vec<String>,
}

struct Stage<'a> {
    data: &'a dyn AbstractData,
    /// Bytes of the file.
    size: usize,
}

impl Stage<'_> {
    fn field(&self, path: &Path, field: &str) -> Result<Option<Cow<'_, Value>>, Invalid> {
        self.data.try_field(path, field).map_err(|e| problem(format!("{path}, {field}"), "a value", e))
    }

    fn token(&self, path: &Path, field: &str) -> Result<Option<String>, Invalid> {
        Ok(match self.field(path, field)?.as_deref() {
            Some(Value::Token(token)) => Some(token.to_string()),
            Some(Value::String(text)) => Some(text.clone()),
            _ => None,
        })
    }

    /// The value of an attribute that does not change with time.
    fn attribute(&self, prim: &Path, name: &str) -> Result<Option<Cow<'_, Value>>, Invalid> {
        let path = prim.append_property(name).map_err(|e| problem(format!("{prim}, {name}"), "an attribute", e))?;
        self.field(&path, "default")
    }

    /// The numbers of an array, `width` each: of the attribute, or of the one of 16 bits beside it (`...h`).
    fn numbers(&self, prim: &Path, name: &str, width: usize) -> Result<Option<Vec<f32>>, Invalid> {
        for name in [name, &format!("{name}h")] {
            if let Some(value) = self.attribute(prim, name)? {
                let numbers = flat(&value, width);
                let expected = format!("an array of {width} numbers each");
                let numbers = numbers.ok_or_else(|| problem(format!("{prim}, {name}"), expected, "another type"))?;
                check_expansion(name, numbers.len() as u64, 4, self.size)?;
                return Ok(Some(numbers));
            }
        }
        Ok(None)
    }

    fn needed(&self, prim: &Path, name: &str, width: usize) -> Result<Vec<f32>, Invalid> {
        let missing = || problem(format!("{prim}, {name}"), "its values", "none that hold at all times");
        self.numbers(prim, name, width)?.ok_or_else(missing)
    }

    /// Appends the Gaussians of `prim`.
    fn gaussians(&self, prim: &Path, found: &mut Found) -> Result<(), Invalid> {
        let place = self.place(prim)?;
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
                return Err(problem(format!("{prim}, {name}"), expected, length));
            }
        }
        let (colors, mut harmonics) = self.radiance(prim, count, &mut found.notes)?;
        harmonics.turn(DMat3::from_quat(place.rotation));
        let mut rows = Vec::with_capacity(count * channel::COUNT);
        for i in 0..count {
            let bad = |name: &str, expected: &str, found: &dyn std::fmt::Display| {
                Err(problem(format!("{prim}, {name}, element {i}"), expected, found))
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
        found.splats.append(&Splats { harmonics, ..Cloud::from_rows(rows).into() });
        Ok(())
    }

    /// Colors, and what depends on the viewing direction.
    fn radiance(&self, prim: &Path, count: usize, notes: &mut Vec<String>) -> Result<(Vec<f32>, Harmonics), Invalid> {
        let Some(values) = self.numbers(prim, COEFFICIENTS, 3)? else {
            let shown = self.numbers(prim, DISPLAY_COLOR, 3)?.filter(|c| c.len() == 3 * count || c.len() == 3);
            let Some(shown) = shown else {
                let expected = format!("it, or {DISPLAY_COLOR} of {count} values");
                return Err(problem(format!("{prim}, {COEFFICIENTS}"), expected, "neither"));
            };
            notes.push(format!("{prim} has no {COEFFICIENTS}: colors are its {DISPLAY_COLOR}"));
            let colors = shown.iter().cycle().take(3 * count).map(|v| encoded(f64::from(*v)) as f32).collect();
            return Ok((colors, Harmonics::default()));
        };
        let degree = match self.attribute(prim, DEGREE)?.as_deref() {
            Some(Value::Int(degree @ 0..=8)) => *degree as usize,
            None => 3, // as the schema says
            Some(_) => return Err(problem(format!("{prim}, {DEGREE}"), "0 to 8", "another value")),
        };
        let each = (degree + 1).pow(2);
        if values.len() != 3 * each * count {
            let expected = format!("{each} values (degree {degree}) for each of {count} Gaussians");
            return Err(problem(format!("{prim}, {COEFFICIENTS}"), expected, values.len() / 3));
        }
        let kept = degree.min(MAX_DEGREE);
        if degree > kept {
            notes.push(format!("color that depends on the viewing direction is left out beyond degree {MAX_DEGREE}"));
        }
        let rows = || values.chunks_exact(3 * each);
        let colors = rows().flat_map(|row| row[..3].iter().map(|v| color_of_sh(f64::from(*v)))).collect();
        let rest = rows().flat_map(|row| row[3..][..3 * coefficients(kept)].iter().copied()).collect();
        Ok((colors, Harmonics::from_rows(kept, rest)))
    }

    /// Where `prim` and the prims above it put its points.
    fn place(&self, prim: &Path) -> Result<Similarity, Invalid> {
        let mut place = Similarity::NONE;
        let mut next = Some(prim.clone());
        while let Some(path) = next.filter(|p| !p.is_abs_root()) {
            let matrix = self.transform(&path)?;
            let own = Similarity::from_matrix(matrix);
            let own = own.ok_or_else(|| problem(format!("{path}, xformOpOrder"), EXPECTED, "another transform"))?;
            place = own.after(&place);
            next = path.parent();
        }
        Ok(place)
    }

    /// The product of a prim's own `xformOp`s, the first of which is applied last.
    fn transform(&self, prim: &Path) -> Result<DMat4, Invalid> {
        let mut matrix = DMat4::IDENTITY;
        let order = self.attribute(prim, "xformOpOrder")?;
        let Some(Value::TokenVec(order)) = order.as_deref() else { return Ok(matrix) };
        for name in order {
            let name = name.to_string();
            let value = self.attribute(prim, &name)?;
            let kind = name.strip_prefix("xformOp:").map(|rest| rest.split(':').next().unwrap_or(rest));
            let operation = kind.zip(value.as_deref()).and_then(|(kind, value)| operation(kind, value));
            let Some(operation) = operation else {
                let name: String = name.chars().take(60).collect();
                let expected =
                    "translate, scale, orient, rotateX, rotateY, rotateZ, rotateXYZ or transform, with a value";
                return Err(problem(format!("{prim}, xformOpOrder"), expected, name));
            };
            matrix *= operation;
        }
        Ok(matrix)
    }
}

/// One step of a transform. Angles are in degrees; matrices are written with translations in the last row.
fn operation(kind: &str, value: &Value) -> Option<DMat4> {
    let numbers = single(value)?;
    let vector = || Some(DVec3::from_array(numbers.get(..3)?.try_into().ok()?));
    let angle = |k: usize| numbers.get(k).map(|v| v.to_radians());
    Some(match kind {
        "translate" => DMat4::from_translation(vector()?),
        "scale" => DMat4::from_scale(vector()?),
        "orient" => {
            let [w, x, y, z] = numbers.try_into().ok()?;
            DMat4::from_quat(DQuat::from_xyzw(x, y, z, w).normalize())
        }
        "rotateX" => DMat4::from_rotation_x(angle(0)?),
        "rotateY" => DMat4::from_rotation_y(angle(0)?),
        "rotateZ" => DMat4::from_rotation_z(angle(0)?),
        "rotateXYZ" => {
            DMat4::from_rotation_z(angle(2)?) * DMat4::from_rotation_y(angle(1)?) * DMat4::from_rotation_x(angle(0)?)
        }
        "transform" => DMat4::from_cols_array(&numbers.try_into().ok()?),
        _ => return None,
    })
}

/// The numbers of a value that is no array; quaternions `w x y z`, matrices row by row.
fn single(value: &Value) -> Option<Vec<f64>> {
    Some(match value {
        Value::Float(v) => vec![(*v).into()],
        Value::Double(v) => vec![*v],
        Value::Half(v) => vec![(*v).into()],
        Value::Vec3f(v) => [v.x, v.y, v.z].map(f64::from).to_vec(),
        Value::Vec3d(v) => vec![v.x, v.y, v.z],
        Value::Vec3h(v) => [v.x, v.y, v.z].map(f64::from).to_vec(),
        Value::Quatf(q) => [q.w, q.x, q.y, q.z].map(f64::from).to_vec(),
        Value::Quatd(q) => vec![q.w, q.x, q.y, q.z],
        Value::Quath(q) => [q.w, q.x, q.y, q.z].map(f64::from).to_vec(),
        Value::Matrix4d(m) => m.0.to_vec(),
        _ => return None,
    })
}

/// The numbers of an array of `width` each; quaternions `w x y z`. None of another type.
fn flat(value: &Value, width: usize) -> Option<Vec<f32>> {
    Some(match (value, width) {
        (Value::FloatVec(v), 1) => v.clone(),
        (Value::HalfVec(v), 1) => v.iter().map(|v| v.to_f32()).collect(),
        (Value::Vec3fVec(v), 3) => v.iter().flat_map(|v| [v.x, v.y, v.z]).collect(),
        (Value::Vec3hVec(v), 3) => v.iter().flat_map(|v| [v.x, v.y, v.z].map(|v| v.to_f32())).collect(),
        (Value::QuatfVec(v), 4) => v.iter().flat_map(|q| [q.w, q.x, q.y, q.z]).collect(),
        (Value::QuathVec(v), 4) => v.iter().flat_map(|q| [q.w, q.x, q.y, q.z].map(|v| v.to_f32())).collect(),
        _ => return None,
    })
}
