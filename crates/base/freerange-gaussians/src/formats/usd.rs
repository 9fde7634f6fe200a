//! `.usda` and `.usdz`: OpenUSD's `ParticleField3DGaussianSplat` (OpenUSD 26.03 and later), as text, or that text in an
//! archive.
//!
//! +z up or +y up, as the stage's `upAxis` says; one unit is called a meter. Standard deviations are linear, opacities
//! 0..1, quaternions `w x y z`, harmonics coefficient by coefficient from the constant on. `extent` holds three standard
//! deviations of every Gaussian, since nobody computes it. Source: OpenUSD's generated schema.

use std::{
    fmt::Write as _,
    io::{Cursor, Write as _},
};

use crate::Splats;
use glam::DVec3;
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

use crate::formats::{
    Encoded, Frame,
    quantize::{linear, sh_of_color},
};

/// The schema.
pub const PRIM: &str = "ParticleField3DGaussianSplat";
/// Its attributes.
pub const POSITIONS: &str = "positions";
pub const ORIENTATIONS: &str = "orientations";
pub const SCALES: &str = "scales";
pub const OPACITIES: &str = "opacities";
pub const DEGREE: &str = "radiance:sphericalHarmonicsDegree";
pub const COEFFICIENTS: &str = "radiance:sphericalHarmonicsCoefficients";
pub const DISPLAY_COLOR: &str = "primvars:displayColor";

/// Data of files in an archive begin at multiples of this.
const ALIGNMENT: u16 = 64;

/// The text of a stage.
pub fn encode_text(splats: &Splats, frame: Frame) -> Encoded {
    // A stage says one of two axes.
    let z_up = frame == Frame::Z_UP;
    let mut turned = splats.clone();
    if !z_up && frame != Frame::Y_UP {
        turned.transform(1.0, frame.to(Frame::Y_UP), DVec3::ZERO);
    }
    Encoded { bytes: stage(&turned, z_up).into_bytes(), notes: Vec::new() }
}

/// The text of a stage in an archive.
pub fn encode_archive(splats: &Splats, frame: Frame) -> Encoded {
    let text = encode_text(splats, frame);
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored).with_alignment(ALIGNMENT);
    let written = archive.start_file("gaussians.usda", options).map_err(std::io::Error::from);
    written.and_then(|()| archive.write_all(&text.bytes)).expect("memory can be written to");
    Encoded { bytes: archive.finish().expect("memory can be written to").into_inner(), notes: text.notes }
}

fn stage(splats: &Splats, z_up: bool) -> String {
    let Splats { cloud, harmonics, .. } = splats;
    let n = 0..cloud.len();
    let largest = f64::from(f32::MAX);
    let mut text = format!(
        "#usda 1.0\n(\n    defaultPrim = \"Gaussians\"\n    doc = \"free-range {}\"\n    metersPerUnit = 1\n    \
         upAxis = \"{}\"\n)\n\ndef {PRIM} \"Gaussians\"\n{{\n",
        env!("CARGO_PKG_VERSION"),
        if z_up { "Z" } else { "Y" }
    );
    let (low, high) = extent(splats);
    let floats = |v: DVec3| tuple(&v.to_array().map(|v| v.clamp(-largest, largest) as f32));
    attribute(&mut text, "float3[] extent", [floats(low), floats(high)], "");
    attribute(
        &mut text,
        &format!("float[] {OPACITIES}"),
        n.clone().map(|i| format!("{:?}", cloud.opacity(i) as f32)),
        "",
    );
    let quaternion = |i: usize| {
        let q = cloud.rotation(i);
        tuple(&[q.w, q.x, q.y, q.z].map(|v| v as f32))
    };
    attribute(&mut text, &format!("quatf[] {ORIENTATIONS}"), n.clone().map(quaternion), "");
    attribute(&mut text, &format!("point3f[] {POSITIONS}"), n.clone().map(|i| tuple(&cloud.row(i)[..3])), "");
    let shown = |i: usize| floats(cloud.color(i).map(|c| linear(c.clamp(0.0, 1.0))));
    let per_vertex = " (\n        interpolation = \"vertex\"\n    )";
    attribute(&mut text, &format!("color3f[] {DISPLAY_COLOR}"), n.clone().map(shown), per_vertex);
    text += "    uniform token projectionModeHint = \"perspective\"\n";
    let coefficients = n.clone().flat_map(|i| {
        let constant = tuple(&cloud.row(i)[11..14].iter().map(|c| sh_of_color(*c) as f32).collect::<Vec<_>>());
        std::iter::once(constant).chain(harmonics.row(i).as_chunks::<3>().0.iter().map(|c| tuple(c)))
    });
    let each = (harmonics.degree() + 1).pow(2);
    let about = format!(" (\n        elementSize = {each}\n        interpolation = \"vertex\"\n    )");
    attribute(&mut text, &format!("float3[] {COEFFICIENTS}"), coefficients, &about);
    // A stage that does not say so means 3.
    let _ = writeln!(text, "    uniform int {DEGREE} = {}", harmonics.degree());
    attribute(&mut text, &format!("float3[] {SCALES}"), n.map(|i| floats(cloud.scale(i))), "");
    text += "    uniform token sortingModeHint = \"zDepth\"\n";
    if splats.origin != DVec3::ZERO {
        let [x, y, z] = splats.origin.to_array();
        let _ = writeln!(text, "    double3 xformOp:translate = ({x:?}, {y:?}, {z:?})");
        text += "    uniform token[] xformOpOrder = [\"xformOp:translate\"]\n";
    }
    text + "}\n"
}

/// A line of an array.
fn attribute(text: &mut String, name: &str, values: impl IntoIterator<Item = String>, about: &str) {
    let _ = write!(text, "    {name} = [");
    for (i, value) in values.into_iter().enumerate() {
        *text += if i == 0 { "" } else { ", " };
        *text += &value;
    }
    *text += "]";
    *text += about;
    *text += "\n";
}

/// The shortest text that reads back as the same numbers.
fn tuple(values: &[f32]) -> String {
    let values: Vec<String> = values.iter().map(|v| format!("{v:?}")).collect();
    format!("({})", values.join(", "))
}

/// The corners of the box around all Gaussians, to three standard deviations.
fn extent(splats: &Splats) -> (DVec3, DVec3) {
    let mut corners = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for i in 0..splats.cloud.len() {
        let covariance = splats.cloud.covariance(i);
        let reach = 3.0 * DVec3::new(covariance.x_axis.x, covariance.y_axis.y, covariance.z_axis.z).map(f64::sqrt);
        let mean = splats.cloud.mean(i);
        corners = (corners.0.min(mean - reach), corners.1.max(mean + reach));
    }
    corners
}
