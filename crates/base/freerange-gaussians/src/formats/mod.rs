//! 3D Gaussians in the files that viewers, game engines and web pages take.
//!
//! | format | read | written | frame |
//! |---|---|---|---|
//! | `.ply` | standard, compressed | standard, lossless | the user's |
//! | `.splat` | yes | 32 bytes per Gaussian | the user's |
//! | `.spz` | versions 1 to 4 | version 3, or 2, or 4 | +y up, right-handed |
//! | `.sog` | version 2, also as a folder (`meta.json`) | version 2 | the user's |
//! | `.glb` | `KHR_gaussian_splatting`, also as `.gltf` | the same, lossless but for rounding | +y up by the turn of a node; attributes in the user's |
//! | `.usda`, `.usdz` | `ParticleField3DGaussianSplat`, text; also as `.usd` | the same, lossless but for rounding | +z or +y up, as the stage says |
//! | `.html` | our own | a viewer with the splats inside, lossless | the user's, whose up it has |
//!
//! Files that do not fix their frame are in the user's, of which [`Frame`] knows the way up. Color that depends on the
//! viewing direction is kept to degree 3 where the format can hold it. What a file claims is never believed: memory
//! grows with the bytes that are there.

mod bytes;
mod error;
mod frame;
mod glb;
mod glb_accessor;
mod glb_read;
mod html;
mod placed;
mod quantize;
mod sog;
mod sog_read;
mod splat;
mod spz;
mod spz_read;
mod usd;
mod usd_read;
mod usd_text;
pub mod viewer;

use std::{fmt, fs::File, io::Read, io::Write, path::Path};

use crate::{RenderMode, SplatError, Splats, encode_splats, parse_ply};
use freerange_util::{Invalid, IoError, Note, write_atomically};
use glam::DVec3;

pub use error::FormatError;
pub use frame::{Frame, Frames};
pub use spz::SpzVersion;

use bytes::Beside;
use error::problem;

/// The kinds of file that Gaussians are kept in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Format {
    /// `.ply`, as 3D Gaussian splatting programs exchange it; read also in its compressed form.
    Ply,
    /// `.splat`: 32 bytes per Gaussian.
    Splat,
    /// `.spz`: fixed point, compressed as a whole.
    Spz,
    /// `.sog`: lossless WebP pictures in a zip archive.
    Sog,
    /// `.glb`: binary glTF with the extension `KHR_gaussian_splatting`.
    Glb,
    /// `.usda`: OpenUSD's `ParticleField3DGaussianSplat` as text.
    Usda,
    /// `.usdz`: the same in an archive.
    Usdz,
    /// `.html`: a page that shows the Gaussians, and needs nothing else.
    Html,
}

impl Format {
    /// All formats.
    pub const ALL: [Self; 8] =
        [Self::Ply, Self::Splat, Self::Spz, Self::Sog, Self::Glb, Self::Usda, Self::Usdz, Self::Html];

    /// The extension of its files, without the dot.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::Splat => "splat",
            Self::Spz => "spz",
            Self::Sog => "sog",
            Self::Glb => "glb",
            Self::Usda => "usda",
            Self::Usdz => "usdz",
            Self::Html => "html",
        }
    }

    /// The format with this extension, in any case.
    pub fn from_extension(extension: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|f| f.extension().eq_ignore_ascii_case(extension))
    }

    /// The format of the file `path` that is read: by its extension, or its name (`meta.json` of a `.sog` in a folder).
    ///
    /// # Errors
    /// [`FormatError::Unknown`].
    pub fn of_input(path: &Path) -> Result<Self, FormatError> {
        let is = |part: Option<&std::ffi::OsStr>, name: &str| part.is_some_and(|p| p.eq_ignore_ascii_case(name));
        if is(path.extension(), "gltf") {
            Ok(Self::Glb)
        } else if ["usd", "usdc"].into_iter().any(|e| is(path.extension(), e)) {
            Ok(Self::Usda)
        } else if is(path.file_name(), "meta.json") {
            Ok(Self::Sog)
        } else {
            Self::of(path)
        }
    }

    /// The format of the file `path` that is written, by its extension.
    ///
    /// # Errors
    /// [`FormatError::Unknown`].
    pub fn of(path: &Path) -> Result<Self, FormatError> {
        let extension = path.extension().unwrap_or_default().to_string_lossy();
        Self::from_extension(&extension).ok_or_else(|| FormatError::Unknown {
            file: path.into(),
            expected: Self::ALL.map(|f| format!(".{f}")).join(", ").into(),
            found: if extension.is_empty() { "none".into() } else { format!(".{extension}").into() },
        })
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.extension())
    }
}

impl std::str::FromStr for Format {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let expected = || format!("expected one of {}", Self::ALL.map(|f| f.extension()).join(", "));
        Self::from_extension(text).ok_or_else(expected)
    }
}

/// How files are written.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WriteOptions {
    /// The frame of the Gaussians that are handed over.
    pub frame: Frame,
    /// Which version of `.spz` to write.
    pub spz_version: SpzVersion,
}

/// What a file holds.
#[derive(Clone, Debug, PartialEq)]
pub struct Loaded {
    /// The Gaussians; all channels finite.
    pub splats: Splats,
    /// The frame that they are in.
    pub frame: Frame,
    /// What was left out or looks odd, one sentence each, for the user.
    pub notes: Vec<Note>,
}

/// What a format's reader finds.
#[derive(Default)]
struct Decoded {
    splats: Splats,
    /// The frame of the numbers, where the file or its format says so.
    frame: Option<Frame>,
    notes: Vec<Note>,
}

/// The bytes of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct Encoded {
    /// The file. The same Gaussians give the same bytes.
    pub bytes: Vec<u8>,
    /// What the format could not hold, one sentence each, for the user.
    pub notes: Vec<String>,
}

/// Reads a file of any [`Format`], chosen by its name, and turns it as `frames` say.
///
/// # Errors
/// [`FormatError::Unknown`], [`FormatError::Io`]; [`FormatError::Invalid`] and [`FormatError::Gaussians`] where the
/// file does not hold what its extension says.
pub fn read(path: &Path, frames: impl Into<Frames>) -> Result<Loaded, FormatError> {
    let format = Format::of_input(path)?;
    let mut bytes = Vec::new();
    File::open(path).and_then(|mut f| f.read_to_end(&mut bytes)).map_err(IoError::at(path))?;
    let folder = path.parent().unwrap_or(Path::new(""));
    parse_with(format, &bytes, path, frames.into(), &Beside::Folder(folder.into()))
}

/// As [`read`], from the bytes of a file that needs no other beside it; `name` is for messages only.
///
/// # Errors
/// As [`read`].
pub fn parse(format: Format, bytes: &[u8], name: &Path, frames: impl Into<Frames>) -> Result<Loaded, FormatError> {
    parse_with(format, bytes, name, frames.into(), &Beside::Nothing)
}

fn parse_with(
    format: Format,
    bytes: &[u8],
    name: &Path,
    frames: Frames,
    beside: &Beside,
) -> Result<Loaded, FormatError> {
    // What a comment says of up is a default: programs write it whatever the frame of their cameras was.
    let or_up = |up: Option<DVec3>| match up.and_then(Frame::with_up) {
        Some(up) if frames == Frames::default() => Frames::from(up),
        _ => frames,
    };
    let parsed = match format {
        Format::Ply => {
            let file = parse_ply(bytes, name)?;
            Ok((Decoded { splats: file.splats, frame: None, notes: file.notes }, or_up(file.up)))
        }
        Format::Splat => splat::decode(bytes).map(|d| (d, frames)),
        Format::Spz => spz_read::decode(bytes, frames.from.is_some()).map(|d| (d, frames)),
        Format::Sog => sog_read::decode(bytes, beside).map(|d| (d, frames)),
        Format::Glb => glb_read::decode(bytes, beside).map(|d| (d, frames)),
        // Text, binary or an archive: the bytes tell.
        Format::Usda | Format::Usdz => usd_read::decode(bytes).map(|d| (d, frames)),
        Format::Html => html::decode(bytes).map(|(d, up)| (d, or_up(up))),
    };
    let invalid = |problem| FormatError::Invalid { file: name.into(), problem };
    let (decoded, frames) = parsed.map_err(invalid)?;
    let Decoded { mut splats, frame, notes } = finite(decoded).map_err(invalid)?;
    let (from, to) = frames.resolve(frame);
    if from != to {
        splats.transform(1.0, from.to(to), DVec3::ZERO);
    }
    Ok(Loaded { splats, frame: to, notes })
}

/// Writes `splats` to a file of the [`Format`] of its extension, first beside it and then renamed, and returns notes for
/// the user.
///
/// # Errors
/// As [`encode`], and [`FormatError::Unknown`], [`FormatError::Io`].
pub fn write(splats: &Splats, path: &Path, options: &WriteOptions) -> Result<Vec<String>, FormatError> {
    let encoded = encode(splats, Format::of(path)?, options)?;
    let written = write_atomically(path, |w| w.write_all(&encoded.bytes));
    written.map_err(IoError::at(path))?;
    Ok(encoded.notes)
}

/// `splats` as the bytes of a file.
///
/// # Errors
/// [`FormatError::Gaussians`] where a channel is not finite or beyond what numbers of 32 bits can hold, or, but for
/// `.ply`, where there are no Gaussians.
pub fn encode(splats: &Splats, format: Format, options: &WriteOptions) -> Result<Encoded, FormatError> {
    splats.cloud.check_finite()?;
    if splats.cloud.is_empty() && format != Format::Ply {
        return Err(SplatError::Empty.into());
    }
    if splats.cloud.len() > MAX_GAUSSIANS && format != Format::Ply {
        return Err(SplatError::TooMany { limit: MAX_GAUSSIANS, found: splats.cloud.len() }.into());
    }
    let mut encoded = match format {
        Format::Ply => Encoded { bytes: encode_splats(splats, options.frame.up())?, notes: Vec::new() },
        Format::Splat => splat::encode(&splats.cloud),
        Format::Sog => sog::encode(splats),
        Format::Glb => glb::encode(splats, options.frame),
        Format::Usda => usd::encode_text(splats, options.frame),
        Format::Usdz => usd::encode_archive(splats, options.frame),
        Format::Html => html::encode(&splats.cloud, options.frame),
        Format::Spz => {
            let mut turned = splats.clone();
            if options.frame != Frame::Y_UP {
                turned.transform(1.0, options.frame.to(Frame::Y_UP), DVec3::ZERO);
            }
            spz::encode(&turned, options.spz_version)
        }
    };
    encoded.notes.extend(lost(splats, format));
    Ok(encoded)
}

/// What `format` cannot say of `splats`.
fn lost(splats: &Splats, format: Format) -> Vec<String> {
    let mut notes = Vec::new();
    if splats.harmonics.degree() > 0 && matches!(format, Format::Splat | Format::Html) {
        notes.push(format!(
            "color that depends on the viewing direction (degree {}) is left out: .{format} holds none",
            splats.harmonics.degree()
        ));
    }
    let mode = match splats.mode {
        RenderMode::Default => None,
        RenderMode::Mip => Some("made for antialiased rendering (mip)"),
        RenderMode::Flat => Some("flat (2D Gaussians)"),
    };
    let said = match format {
        Format::Ply | Format::Sog => true,
        Format::Spz => splats.mode == RenderMode::Mip,
        Format::Splat | Format::Glb | Format::Usda | Format::Usdz | Format::Html => false,
    };
    if let (Some(mode), false) = (mode, said) {
        notes.push(format!("that the Gaussians are {mode} is left out: .{format} cannot say so"));
    }
    if splats.origin != DVec3::ZERO && !matches!(format, Format::Ply | Format::Glb | Format::Usda | Format::Usdz) {
        let [x, y, z] = splats.origin.to_array();
        notes.push(format!(
            "positions are relative to ({x}, {y}, {z}): .{format} has no precision for an object so far from the origin"
        ));
    }
    notes
}

/// Most Gaussians that files of one piece are written with: counts and offsets of all formats fit 32 bits.
const MAX_GAUSSIANS: usize = 1 << 24;

/// Leaves out Gaussians that are not finite, and refuses files without others.
fn finite(mut decoded: Decoded) -> Result<Decoded, Invalid> {
    let cloud = &decoded.splats.cloud;
    let harmonics = &decoded.splats.harmonics;
    let good = |i: &usize| cloud.row(*i).iter().chain(harmonics.row(*i)).all(|v| v.is_finite());
    let kept: Vec<usize> = (0..cloud.len()).filter(good).collect();
    let dropped = cloud.len() - kept.len();
    if dropped > 0 {
        if kept.is_empty() {
            return Err(problem("Gaussians", "at least one of finite numbers", format!("{dropped} of others")));
        }
        decoded.splats = decoded.splats.select(&kept);
        let text = format!("{dropped} Gaussians with numbers that are not finite are left out");
        decoded.notes.push(Note::dropped(text));
    }
    Ok(decoded)
}
