//! 3D Gaussians in the files that viewers, game engines and web pages take.
//!
//! | format | read | written | frame |
//! |---|---|---|---|
//! | `.ply` | standard, compressed | standard, lossless | the user's |
//! | `.splat` | yes | 32 bytes per Gaussian | the user's |
//! | `.spz` | versions 2, 3, 4 | version 3, or 4 | +y up, right-handed |
//! | `.sog` | version 2 | version 2 | the user's |
//! | `.glb` | `KHR_gaussian_splatting` | the same, lossless but for rounding | +y up by the turn of a node; attributes in the user's |
//! | `.html` | our own | a viewer with the splats inside, lossless | the user's |
//!
//! Files that do not fix their frame are in the user's, of which [`Frame`] knows the way up. Colour that depends on the
//! viewing direction is left out, and said so. What a file claims is never believed: memory grows with the bytes that
//! are there.

mod bytes;
mod error;
mod frame;
mod glb;
mod glb_read;
mod html;
mod quantize;
mod sog;
mod sog_read;
mod splat;
mod spz;
mod spz_read;
pub mod viewer;

use std::{fmt, fs::File, io::Read, io::Write, path::Path};

use freerange_core::{Invalid, IoError, write_atomically};
use freerange_splat::{Cloud, SplatError, encode_ply, parse_ply};
use glam::DVec3;

pub use error::FormatError;
pub use frame::Frame;
pub use spz::SpzVersion;

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
    /// `.html`: a page that shows the Gaussians, and needs nothing else.
    Html,
}

impl Format {
    /// All formats.
    pub const ALL: [Self; 6] = [Self::Ply, Self::Splat, Self::Spz, Self::Sog, Self::Glb, Self::Html];

    /// The extension of its files, without the dot.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::Splat => "splat",
            Self::Spz => "spz",
            Self::Sog => "sog",
            Self::Glb => "glb",
            Self::Html => "html",
        }
    }

    /// The format with this extension, in any case.
    pub fn from_extension(extension: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|f| f.extension().eq_ignore_ascii_case(extension))
    }

    /// The format of the file `path`, by its extension.
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

    /// The frame that the format's definition fixes, if it does.
    pub fn fixed_frame(self) -> Option<Frame> {
        matches!(self, Self::Spz | Self::Glb).then_some(Frame::Y_UP)
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
    pub cloud: Cloud,
    /// What was left out or looks odd, one sentence each, for the user.
    pub notes: Vec<String>,
}

/// The bytes of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct Encoded {
    /// The file. The same Gaussians give the same bytes.
    pub bytes: Vec<u8>,
    /// What the format could not hold, one sentence each, for the user.
    pub notes: Vec<String>,
}

/// Reads a file of any [`Format`], chosen by its extension. Gaussians come in `frame`: files that fix their own are
/// turned, others are taken to be in it.
///
/// # Errors
/// [`FormatError::Unknown`], [`FormatError::Io`]; [`FormatError::Invalid`] and [`FormatError::Gaussians`] where the
/// file does not hold what its extension says.
pub fn read(path: &Path, frame: Frame) -> Result<Loaded, FormatError> {
    let format = Format::of(path)?;
    let mut bytes = Vec::new();
    File::open(path).and_then(|mut f| f.read_to_end(&mut bytes)).map_err(IoError::at(path))?;
    parse(format, &bytes, path, frame)
}

/// As [`read`], from the bytes of a file; `name` is for messages only.
///
/// # Errors
/// As [`read`].
pub fn parse(format: Format, bytes: &[u8], name: &Path, frame: Frame) -> Result<Loaded, FormatError> {
    let parsed = match format {
        Format::Ply => {
            let file = parse_ply(bytes, name)?;
            return Ok(Loaded { cloud: file.cloud, notes: file.notes });
        }
        Format::Splat => splat::decode(bytes),
        Format::Spz => spz_read::decode(bytes),
        Format::Sog => sog_read::decode(bytes),
        Format::Glb => glb_read::decode(bytes),
        Format::Html => html::decode(bytes),
    };
    let mut loaded = parsed.and_then(checked).map_err(|problem| FormatError::Invalid { file: name.into(), problem })?;
    if let Some(fixed) = format.fixed_frame() {
        turn(&mut loaded.cloud, fixed, frame);
    }
    Ok(loaded)
}

/// Writes `cloud` to a file of the [`Format`] of its extension, first beside it and then renamed, and returns notes for
/// the user.
///
/// # Errors
/// As [`encode`], and [`FormatError::Unknown`], [`FormatError::Io`].
pub fn write(cloud: &Cloud, path: &Path, options: &WriteOptions) -> Result<Vec<String>, FormatError> {
    let encoded = encode(cloud, Format::of(path)?, options)?;
    let written = write_atomically(path, |w| w.write_all(&encoded.bytes));
    written.map_err(IoError::at(path))?;
    Ok(encoded.notes)
}

/// `cloud` as the bytes of a file.
///
/// # Errors
/// [`FormatError::Gaussians`] where a channel is not finite or beyond what numbers of 32 bits can hold, or, but for
/// `.ply`, where there are no Gaussians.
pub fn encode(cloud: &Cloud, format: Format, options: &WriteOptions) -> Result<Encoded, FormatError> {
    cloud.check_finite()?;
    if cloud.is_empty() && format != Format::Ply {
        return Err(SplatError::Empty.into());
    }
    if cloud.len() > MAX_GAUSSIANS && format != Format::Ply {
        return Err(SplatError::TooMany { limit: MAX_GAUSSIANS, found: cloud.len() }.into());
    }
    let encoded = match format {
        Format::Ply => Encoded { bytes: encode_ply(cloud)?, notes: Vec::new() },
        Format::Splat => splat::encode(cloud),
        Format::Sog => sog::encode(cloud),
        Format::Glb => glb::encode(cloud, options.frame),
        Format::Html => html::encode(cloud, options.frame),
        Format::Spz => {
            let mut turned = cloud.clone();
            turn(&mut turned, options.frame, Frame::Y_UP);
            spz::encode(&turned, options.spz_version)
        }
    };
    Ok(encoded)
}

/// Most Gaussians that files of one piece are written with: counts and offsets of all formats fit 32 bits.
const MAX_GAUSSIANS: usize = 1 << 24;

fn turn(cloud: &mut Cloud, from: Frame, to: Frame) {
    if from != to {
        cloud.transform(1.0, from.to(to), DVec3::ZERO);
    }
}

/// Refuses Gaussians that are not finite.
fn checked(loaded: Loaded) -> Result<Loaded, Invalid> {
    match loaded.cloud.check_finite() {
        Err(SplatError::Value { row, name, found, .. }) => {
            Err(problem(format!("Gaussian {row}, {name}"), "a finite number", found))
        }
        _ => Ok(loaded),
    }
}
