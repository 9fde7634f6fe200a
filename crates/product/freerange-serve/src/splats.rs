//! Files of Gaussians that clients send, to be looked at, cropped and converted as results are.

use std::{fs, path::Path};

use freerange_gaussians::{
    Gaussians,
    formats::{Format, Frame, Frames, Loaded, WriteOptions, encode, parse},
};
use freerange_scene::camera::{Camera, Up};
use freerange_util::{Stop, Stopped, write_atomically};
use glam::DVec3;
use image::RgbaImage;
use serde_json::{Value, json};

use crate::{Limits, Refusal, error::chain, plain, record::sample_file};

/// What was found in a file.
pub struct Found {
    /// In the form of what is understood of photos, without any.
    pub understood: Value,
    pub gaussians: usize,
    /// The direction of up in the file's frame.
    pub up: [f64; 3],
    /// Seen from before.
    pub camera: Camera,
    pub cloud: Gaussians,
}

/// Bytes of memory that a byte of a file takes while it is read and written again, at most: formats that compress take more.
fn memory_per_byte(format: Format) -> u64 {
    match format {
        Format::Spz | Format::Sog | Format::Usdz => 20,
        Format::Ply | Format::Splat | Format::Glb | Format::Usda | Format::Html => 5,
    }
}

/// Whether to go on: between steps, none of which can be stopped itself.
fn check(stop: &Stop, limits: &Limits) -> Result<(), Refusal> {
    stop.check().map_err(|stopped| match stopped {
        Stopped::Cancelled => Refusal::new(409, "cancelled"),
        Stopped::Late => {
            let most = limits.read_time.as_secs_f64();
            Refusal::new(422, format!("reading this file took longer than {most} seconds, which is the limit"))
        }
    })
}

/// Reads the Gaussians of `file`, and writes them as the first sample of the job in `folder`, unless `stop` says otherwise by then. `up`
/// overrides what the file says.
pub fn prepare(file: &Path, folder: &Path, up: Option<Up>, limits: &Limits, stop: &Stop) -> Result<Found, Refusal> {
    let beside = file.parent().unwrap_or(folder);
    let refused = |text: &str| Refusal::new(422, plain::sentence(text, beside));
    let format = Format::of_input(file).map_err(|e| refused(&chain(&e)))?;
    let bytes = fs::metadata(file).map_err(Refusal::file(file))?.len();
    let [needed, most] = [bytes.saturating_mul(memory_per_byte(format)), limits.memory].map(|b| b.div_ceil(1 << 20));
    if needed > most {
        let text = format!("a file of Gaussians of this size may take {needed} MB of memory: {most} MB is the limit");
        return Err(Refusal::new(413, text));
    }
    let chosen = match up {
        Some(Up::Z) => Some(Frame::Z_UP),
        Some(Up::Y) => Some(Frame::Y_UP),
        Some(Up::Direction(up)) => Frame::with_up(up),
        Some(Up::Cameras) | None => None,
    };
    let frames = Frames { from: chosen, to: chosen };
    // From the bytes alone: whatever else the file names is not looked for.
    let bytes = fs::read(file).map_err(Refusal::file(file))?;
    check(stop, limits)?;
    let name = Path::new(file.file_name().unwrap_or_default());
    let Loaded { splats, frame, notes } = parse(format, &bytes, name, frames).map_err(|e| refused(&chain(&e)))?;
    if splats.cloud.is_empty() {
        return Err(refused("there are no Gaussians in this file"));
    }
    check(stop, limits)?;
    let options = WriteOptions { frame, ..WriteOptions::default() };
    let encoded = encode(&splats, Format::Ply, &options).map_err(|e| refused(&chain(&e)))?;
    // Who cancelled a job may have removed it since: its folder is elsewhere then.
    check(stop, limits)?;
    let sample = sample_file(folder, 0);
    write_atomically(&sample, |w| std::io::Write::write_all(w, &encoded.bytes)).map_err(Refusal::file(&sample))?;
    let (center, radius) = place(&splats.cloud);
    let up = frame.up();
    let notes: Vec<String> = notes.iter().map(|note| plain::sentence(note, beside)).collect();
    let understood = json!({
        "center": center.to_array(), "radius": radius, "up": up.to_array(), "views": [], "notes": notes, "warnings": [],
        "format": format!(".{format}"), "masks": "none",
    });
    let side = if up.x.abs() < 0.9 { DVec3::X } else { DVec3::Y };
    let eye = center + radius * (2.5 * up.cross(side).normalize_or_zero() + up);
    let camera = Camera::look_at(eye, center, up, 0.9, 256, 256);
    Ok(Found { understood, gaussians: splats.cloud.len(), up: up.to_array(), camera, cloud: splats.cloud })
}

/// Middle and radius of most Gaussians: a few that lie far away change nothing.
fn place(cloud: &Gaussians) -> (DVec3, f64) {
    let at = |mut values: Vec<f64>, part: f64| {
        let i = ((values.len() - 1) as f64 * part) as usize;
        *values.select_nth_unstable_by(i, f64::total_cmp).1
    };
    let all = 0..cloud.len();
    let center = DVec3::from_array([0, 1, 2].map(|k| at(all.clone().map(|i| cloud.mean(i)[k]).collect(), 0.5)));
    let radius = at(all.map(|i| cloud.mean(i).distance(center) + cloud.scale(i).max_element()).collect(), 0.95);
    (center, radius.max(1e-9))
}

/// A picture of them that stands for the job, if one can be made.
pub fn thumbnail(engine: &dyn crate::Engine, found: &Found) -> RgbaImage {
    engine.picture(&found.cloud, &found.camera).unwrap_or_else(|e| {
        tracing::warn!("no picture of the Gaussians: {e}");
        RgbaImage::new(1, 1)
    })
}
