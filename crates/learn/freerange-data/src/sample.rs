//! One object as the entries of a shard, and back.
//!
//! | entry | content |
//! |---|---|
//! | `KEY.json` | [`Metadata`] |
//! | `KEY.cameras.json` | name, size, intrinsics and pose of every view; see [`CAMERAS`] |
//! | `KEY.gaussians.safetensors` | `depth_08` f32 `[256, 14]`, ...: the slices, channels as in [`freerange_gaussians::channel`]; `leaves` f32 `[n, 14]`, where they are kept: the Gaussians before the tree; `input_fit_00` f16 `[n, 14]`, ...: quick fits of some of the views; `input_fit_00_target`, ...: the same Gaussians fitted to all views |
//! | `KEY.000.webp`, ... | the views, 8-bit RGBA with straight alpha, in the order of the cameras; or `KEY.000.png`, ... |

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;

use freerange_gaussians::{Gaussians, channel};
use freerange_scene::camera::{Camera, View, ViewSets};
use glam::{DMat3, DMat4, DVec4};
use half::f16;
use image::codecs::{png::PngDecoder, webp::WebPDecoder};
use image::{ColorType, DynamicImage, ImageDecoder, ImageResult, RgbaImage};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};

use crate::{DataError, HeldOutPsnr, ImageFormat, InputFit, Object, Split};

/// Ends of the names of an object's entries but its views.
pub(crate) const METADATA: &str = "json";
pub(crate) const CAMERAS: &str = "cameras.json";
pub(crate) const GAUSSIANS: &str = "gaussians.safetensors";

/// Largest number of views of an object.
pub const MAX_VIEWS: usize = 1000;
/// Largest side of a view, in pixels.
pub const MAX_SIDE: u32 = 8192;
/// Pixels that the views of an object may have together: 1 GiB decoded.
const MAX_PIXELS: u64 = 1 << 28;
/// Most quick fits of an object.
pub const MAX_FITS: usize = 64;
/// Deepest slice.
pub const MAX_DEPTH: u32 = 22;

/// What is known of an object besides its views and Gaussians.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Metadata {
    /// The object's name: the key of its entries.
    pub id: String,
    /// Where it comes from.
    pub source: String,
    /// License of the object, as an SPDX identifier.
    pub license: String,
    /// SHA-256 of the mesh file; `None` for a generated object.
    pub file_sha256: Option<String>,
    /// What was ignored or repaired when the mesh was read.
    pub notes: Vec<String>,
    /// Seed of what was drawn for it.
    pub seed: u64,
    /// SHA-256 of what the folder was made with.
    pub plan_sha256: String,
    /// The part of the data it belongs to.
    pub split: Split,
    /// Number of Gaussians before the tree.
    pub gaussians: u64,
    /// How well Gaussians show it; `None` where not measured.
    pub psnr: Option<HeldOutPsnr>,
    /// Whether the Gaussians are too bad to train on.
    pub flagged: bool,
    /// The views that each quick fit saw, by number.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub input_fits: Vec<Vec<usize>>,
    /// The views that evaluation gives to a model, and those that it scores, by number; `None` where there are too few.
    pub evaluation: Option<ViewSets>,
}

/// `KEY.cameras.json`. Axes are OpenCV's (x right, y down, z forward), the world is the canonical frame (+z up, object
/// inside the sphere of radius 0.5), pixel centers lie at +0.5.
#[derive(serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Cameras {
    convention: String,
    views: Vec<Posed>,
}

const CONVENTION: &str = "opencv";

#[derive(serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Posed {
    name: String,
    width: u32,
    height: u32,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    world_to_camera: [[f64; 4]; 4], // rows
}

/// Where in a folder of shards something was found.
#[derive(Clone, Copy)]
pub(crate) struct EntryOfShard<'a> {
    pub shard: &'a Path,
    pub sample: &'a str,
    pub entry: &'a str,
}

impl EntryOfShard<'_> {
    /// Another entry of the same object.
    pub fn of<'a>(&'a self, entry: &'a str) -> EntryOfShard<'a> {
        EntryOfShard { entry, ..*self }
    }

    pub fn error(&self, expected: impl Into<String>, found: impl ToString) -> DataError {
        DataError::Sample {
            shard: self.shard.into(),
            sample: self.sample.into(),
            entry: self.entry.into(),
            expected: Into::<String>::into(expected).into(),
            found: found.to_string().into(),
        }
    }
}

/// Name of the entry of view `i`, without the key.
pub(crate) fn view_entry(i: usize, format: ImageFormat) -> String {
    format!("{i:03}.{}", format.ending())
}

/// Name of the tensor of the Gaussians before the tree.
const LEAVES: &str = "leaves";

/// Names of the tensors of initial fit `i` and of its target.
fn fit_names(i: usize) -> [String; 2] {
    [format!("input_fit_{i:02}"), format!("input_fit_{i:02}_target")]
}

fn tensor_name(depth: u32) -> String {
    format!("depth_{depth:02}")
}

/// Whether `key` can name an object: up to 64 of `A-Z a-z 0-9 - _`.
pub fn is_key(key: &str) -> bool {
    (1..=64).contains(&key.len()) && key.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_')
}

/// The entries of an object in the order of a shard: what follows `KEY.` in the name, and the bytes.
/// `shard` is for messages only.
///
/// # Errors
/// [`DataError::Sample`] for whatever [`Shards`](crate::Shards) would refuse to read.
pub fn encode(
    object: &Object,
    leaves: Option<&Gaussians>,
    metadata: &Metadata,
    format: ImageFormat,
    shard: &Path,
) -> Result<Vec<(String, Vec<u8>)>, DataError> {
    let place = EntryOfShard { shard, sample: &object.id, entry: METADATA };
    if !is_key(&object.id) || metadata.id != object.id {
        return Err(place.error("an id of 1 to 64 characters A-Z a-z 0-9 - _", format!("{:?}", metadata.id)));
    }
    let json =
        |entry, value: serde_json::Result<Vec<u8>>| value.map_err(|e| place.of(entry).error("values JSON can hold", e));

    let cameras: Vec<Camera> = object.views.iter().map(|v| v.camera).collect();
    check_cameras(&cameras, place.of(CAMERAS))?;
    let views = object.views.iter().map(|v| {
        let Camera { width, height, fx, fy, cx, cy, world_to_camera } = v.camera;
        let world_to_camera = world_to_camera.transpose().to_cols_array_2d();
        Posed { name: v.name.clone(), width, height, fx, fy, cx, cy, world_to_camera }
    });
    let cameras = Cameras { convention: CONVENTION.into(), views: views.collect() };
    let mut entries = vec![
        (METADATA.into(), json(METADATA, serde_json::to_vec_pretty(metadata))?),
        (CAMERAS.into(), json(CAMERAS, serde_json::to_vec(&cameras))?),
        (GAUSSIANS.into(), encode_gaussians(object, leaves, place.of(GAUSSIANS))?),
    ];
    for (i, view) in object.views.iter().enumerate() {
        let name = view_entry(i, format);
        let size = (view.camera.width, view.camera.height);
        if view.image.dimensions() != size {
            let (w, h) = view.image.dimensions();
            return Err(place
                .of(&name)
                .error(format!("the camera's {} x {} pixels", size.0, size.1), format!("{w} x {h}")));
        }
        let mut file = Cursor::new(Vec::new());
        let as_format = match format {
            ImageFormat::Png => image::ImageFormat::Png,
            ImageFormat::Webp => image::ImageFormat::WebP, // lossless
        };
        view.image
            .write_to(&mut file, as_format)
            .map_err(|e| place.of(&name).error("an image the format can hold", e))?;
        entries.push((name, file.into_inner()));
    }
    Ok(entries)
}

fn encode_gaussians(object: &Object, leaves: Option<&Gaussians>, place: EntryOfShard) -> Result<Vec<u8>, DataError> {
    let bytes_of = |cloud: &Gaussians| -> Vec<u8> { cloud.rows().iter().flat_map(|v| v.to_le_bytes()).collect() };
    let mut tensors = Vec::with_capacity(object.slices.len() + 1);
    for (&depth, cloud) in &object.slices {
        if depth > MAX_DEPTH || cloud.len() != 1 << depth {
            let expected = format!("2^depth Gaussians at depths up to {MAX_DEPTH}");
            return Err(place.error(expected, format!("{} at depth {depth}", cloud.len())));
        }
        cloud.check_finite()?;
        tensors.push((tensor_name(depth), Dtype::F32, cloud.len(), bytes_of(cloud)));
    }
    if let Some(leaves) = leaves {
        leaves.check_finite()?;
        tensors.push((LEAVES.into(), Dtype::F32, leaves.len(), bytes_of(leaves)));
    }
    for (i, fit) in object.input_fits.iter().enumerate() {
        for (name, cloud) in fit_names(i).into_iter().zip([&fit.gaussians, &fit.target]) {
            let halves: Vec<f16> = cloud.rows().iter().map(|v| f16::from_f32(*v)).collect();
            if let Some(bad) = halves.iter().position(|v| !v.is_finite()) {
                return Err(place.error("initial fits of numbers that 16 bits hold", cloud.rows()[bad]));
            }
            let bytes = halves.iter().flat_map(|v| v.to_le_bytes()).collect();
            tensors.push((name, Dtype::F16, cloud.len(), bytes));
        }
    }
    let view = |dtype, n: usize, bytes| TensorView::new(dtype, vec![n, channel::COUNT], bytes);
    let refused = |e| place.error("tensors safetensors can hold", e);
    let views = tensors.iter().map(|(name, dtype, n, bytes)| Ok((name, view(*dtype, *n, bytes)?)));
    let views = views.collect::<Result<Vec<_>, _>>().map_err(refused)?;
    safetensors::serialize(views, None).map_err(refused)
}

/// `KEY.json`.
pub(crate) fn decode_metadata(bytes: &[u8], place: EntryOfShard) -> Result<Metadata, DataError> {
    let metadata: Metadata = serde_json::from_slice(bytes).map_err(|e| place.error("the object's metadata", e))?;
    if metadata.id != place.sample {
        return Err(place.error(format!("id {:?}", place.sample), format!("{:?}", metadata.id)));
    }
    Ok(metadata)
}

/// `KEY.cameras.json`: names and cameras of `count` views.
pub(crate) fn decode_cameras(
    bytes: &[u8],
    count: usize,
    place: EntryOfShard,
) -> Result<Vec<(String, Camera)>, DataError> {
    let cameras: Cameras = serde_json::from_slice(bytes).map_err(|e| place.error("the cameras of the views", e))?;
    if cameras.convention != CONVENTION {
        return Err(place.error(format!("convention {CONVENTION:?}"), format!("{:?}", cameras.convention)));
    }
    if cameras.views.len() != count {
        return Err(place.error(format!("{count} cameras, one per view"), cameras.views.len()));
    }
    let (names, cameras): (Vec<String>, Vec<Camera>) = cameras
        .views
        .into_iter()
        .map(|v| {
            let Posed { name, width, height, fx, fy, cx, cy, world_to_camera } = v;
            let world_to_camera = DMat4::from_cols_array_2d(&world_to_camera).transpose();
            (name, Camera { width, height, fx, fy, cx, cy, world_to_camera })
        })
        .unzip();
    check_cameras(&cameras, place)?;
    Ok(names.into_iter().zip(cameras).collect())
}

fn check_cameras(cameras: &[Camera], place: EntryOfShard) -> Result<(), DataError> {
    if !(1..=MAX_VIEWS).contains(&cameras.len()) {
        return Err(place.error(format!("1 to {MAX_VIEWS} views"), cameras.len()));
    }
    for (i, c) in cameras.iter().enumerate() {
        let size = format!("{} x {} pixels in view {i}", c.width, c.height);
        if !(1..=MAX_SIDE).contains(&c.width) || !(1..=MAX_SIDE).contains(&c.height) {
            return Err(place.error(format!("sides of 1 to {MAX_SIDE} pixels"), size));
        }
        if (c.width, c.height) != (cameras[0].width, cameras[0].height) {
            return Err(place.error("views of one size", size));
        }
        let intrinsics = [c.fx, c.fy, c.cx, c.cy];
        if !intrinsics.iter().all(|v| v.is_finite()) || c.fx <= 0.0 || c.fy <= 0.0 {
            return Err(
                place.error("finite intrinsics with positive focal lengths", format!("{intrinsics:?} in view {i}"))
            );
        }
        let r = DMat3::from_mat4(c.world_to_camera);
        let rigid = (r * r.transpose()).abs_diff_eq(DMat3::IDENTITY, 1e-4)
            && r.determinant() > 0.0
            && c.world_to_camera.row(3) == DVec4::W
            && c.world_to_camera.w_axis.is_finite();
        if !rigid {
            return Err(place.error("a rotation and a translation", format!("{} in view {i}", c.world_to_camera)));
        }
    }
    let pixels = cameras.iter().map(|c| u64::from(c.width) * u64::from(c.height)).sum::<u64>();
    if pixels > MAX_PIXELS {
        return Err(place.error(format!("at most {MAX_PIXELS} pixels in all views"), pixels));
    }
    Ok(())
}

/// `KEY.000.webp` or `KEY.000.png` of `camera`'s size.
pub(crate) fn decode_view(
    bytes: &[u8],
    format: ImageFormat,
    name: String,
    camera: Camera,
    place: EntryOfShard,
) -> Result<View, DataError> {
    let reader = Cursor::new(bytes);
    let image = match format {
        ImageFormat::Png => pixels(PngDecoder::new(reader), &camera, "a PNG file", place)?,
        ImageFormat::Webp => pixels(WebPDecoder::new(reader), &camera, "a WebP file", place)?,
    };
    Ok(View { name, camera, image })
}

fn pixels(
    decoder: ImageResult<impl ImageDecoder>,
    camera: &Camera,
    kind: &str,
    place: EntryOfShard,
) -> Result<RgbaImage, DataError> {
    let broken = |e| place.error(kind, e);
    let decoder = decoder.map_err(broken)?;
    // Before decoding: a few bytes can claim gigabytes of pixels.
    // Without a transparent pixel, a WebP file may come as RGB.
    let (size, color) = (decoder.dimensions(), decoder.color_type());
    if size != (camera.width, camera.height) || !matches!(color, ColorType::Rgba8 | ColorType::Rgb8) {
        let expected = format!("{} x {} pixels of 8-bit RGB(A)", camera.width, camera.height);
        return Err(place.error(expected, format!("{} x {} of {color:?}", size.0, size.1)));
    }
    Ok(DynamicImage::from_decoder(decoder).map_err(broken)?.into_rgba8())
}

/// Of `KEY.gaussians.safetensors` the slices at `depths`.
pub(crate) fn decode_slices(
    bytes: &[u8],
    depths: &[u32],
    place: EntryOfShard,
) -> Result<BTreeMap<u32, Gaussians>, DataError> {
    let tensors = SafeTensors::deserialize(bytes).map_err(|e| place.error("a safetensors file", e))?;
    depths
        .iter()
        .map(|&depth| {
            let name = tensor_name(depth);
            let tensor = tensors.tensor(&name).map_err(|_| DataError::Depth {
                object: place.sample.into(),
                expected: depth,
                found: depths_in(&tensors),
            })?;
            let cloud = cloud(&tensor, &name, Some(1usize << depth.min(MAX_DEPTH)), place)?;
            Ok((depth, cloud))
        })
        .collect()
}

/// Of `KEY.gaussians.safetensors` the Gaussians before the tree, where they are kept.
pub(crate) fn decode_leaves(bytes: &[u8], place: EntryOfShard) -> Result<Option<Gaussians>, DataError> {
    let tensors = SafeTensors::deserialize(bytes).map_err(|e| place.error("a safetensors file", e))?;
    tensors.tensor(LEAVES).ok().map(|tensor| cloud(&tensor, LEAVES, None, place)).transpose()
}

/// Of `KEY.gaussians.safetensors` the quick fits, one for each set of `views`; `count` views has the object.
pub(crate) fn decode_fits(
    bytes: &[u8],
    views: &[Vec<usize>],
    count: usize,
    place: EntryOfShard,
) -> Result<Vec<InputFit>, DataError> {
    if views.len() > MAX_FITS {
        return Err(place.of(METADATA).error(format!("at most {MAX_FITS} input_fits"), views.len()));
    }
    let tensors = SafeTensors::deserialize(bytes).map_err(|e| place.error("a safetensors file", e))?;
    let fit = |(i, views): (usize, &Vec<usize>)| {
        let fine = !views.is_empty() && views.len() <= count && views.iter().all(|&v| v < count);
        if !fine {
            let expected = format!("input_fits of 1 to {count} views, by numbers below {count}");
            return Err(place.of(METADATA).error(expected, format!("{views:?}")));
        }
        let [name, target] = fit_names(i);
        let gaussians = half_cloud(&tensors, &name, None, place)?;
        let target = half_cloud(&tensors, &target, Some(gaussians.len()), place)?;
        Ok(InputFit { views: views.clone(), gaussians, target })
    };
    views.iter().enumerate().map(fit).collect()
}

/// A tensor `[rows, 14]` of finite f16; where no number of rows is given, any power of two.
fn half_cloud(
    tensors: &SafeTensors,
    name: &str,
    rows: Option<usize>,
    place: EntryOfShard,
) -> Result<Gaussians, DataError> {
    let tensor = tensors.tensor(name).map_err(|_| place.error(format!("tensor {name}"), "none"))?;
    let fits = matches!(tensor.shape(), &[n, channel::COUNT]
        if rows.map_or(n.is_power_of_two() && n <= 1 << MAX_DEPTH, |rows| rows == n));
    if tensor.dtype() != Dtype::F16 || !fits {
        let found = format!("{:?} {:?}", tensor.dtype(), tensor.shape());
        let rows = rows.map_or("2^n".into(), |n| n.to_string());
        return Err(place.error(format!("tensor {name} of F16 [{rows}, {}]", channel::COUNT), found));
    }
    let values = tensor.data().as_chunks::<2>().0.iter().map(|b| f16::from_le_bytes(*b).to_f32());
    let cloud = Gaussians::from_rows(values.collect());
    cloud.check_finite().map_err(|e| place.error(format!("finite numbers in tensor {name}"), e))?;
    Ok(cloud)
}

/// A tensor `[rows, 14]` of finite f32; any number of rows where none is given.
fn cloud(tensor: &TensorView, name: &str, rows: Option<usize>, place: EntryOfShard) -> Result<Gaussians, DataError> {
    let fits = matches!(tensor.shape(), &[n, channel::COUNT] if rows.is_none_or(|rows| rows == n));
    if tensor.dtype() != Dtype::F32 || !fits {
        let found = format!("{:?} {:?}", tensor.dtype(), tensor.shape());
        let rows = rows.map_or("n".into(), |n| n.to_string());
        return Err(place.error(format!("tensor {name} of F32 [{rows}, {}]", channel::COUNT), found));
    }
    let values = tensor.data().as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b));
    let cloud = Gaussians::from_rows(values.collect());
    cloud.check_finite().map_err(|e| place.error(format!("finite numbers in tensor {name}"), e))?;
    Ok(cloud)
}

fn depths_in(tensors: &SafeTensors) -> Vec<u32> {
    let names = tensors.names();
    let mut depths: Vec<u32> =
        names.into_iter().filter_map(|n| n.strip_prefix("depth_")?.parse().ok()).take(64).collect();
    depths.sort_unstable();
    depths
}
