//! Checkpoints, the user's or the shipped one, and the published weights that their encoders need.

use std::{
    borrow::Cow,
    path::{Path, PathBuf},
};

use freerange_model::{Checkpoint, Dinov2, EncoderConfig, EncoderWeights, Header};
use freerange_util::{IoError, sha256};

use crate::{Device, Error, error::Lift, machine::weights_folder};

#[cfg(feature = "embedded")]
const SHIPPED: Option<&[u8]> = Some(include_bytes!("../../../../checkpoints/tiny.safetensors"));
#[cfg(not(feature = "embedded"))]
const SHIPPED: Option<&[u8]> = None;

/// The files of a checkpoint, or of the shipped one where there is no path; and what messages call it.
fn read(path: Option<&Path>) -> Result<(Cow<'static, [u8]>, &Path), Error> {
    Ok(match path {
        None => {
            let found = "none: this program was built without the shipped one (feature `embedded`), checkpoints/tiny.safetensors";
            let shipped = SHIPPED.ok_or_else(|| Error::input("--checkpoint", "a checkpoint file", found))?;
            (shipped.into(), Path::new("the shipped checkpoint"))
        }
        Some(path) => {
            // A folder or a device has no size to read up to.
            if !std::fs::metadata(path).map_err(IoError::at(path)).lift()?.is_file() {
                return Err(Error::input(path.display().to_string(), "a checkpoint file", "a folder or a device"));
            }
            (std::fs::read(path).map_err(IoError::at(path)).lift()?.into(), path)
        }
    })
}

/// The bytes of this checkpoint, or of the shipped one.
///
/// # Errors
/// If the file cannot be read.
pub fn checkpoint_bytes(path: Option<&Path>) -> Result<Cow<'static, [u8]>, Error> {
    Ok(read(path)?.0)
}

/// SHA-256, hexadecimal, of this checkpoint, or of the shipped one.
///
/// # Errors
/// If the file cannot be read.
pub fn checkpoint_sha256(path: Option<&Path>) -> Result<String, Error> {
    let (bytes, _) = read(path)?;
    Ok(sha256(&bytes))
}

/// What this checkpoint, or the shipped one, says of itself. Its weights stay unread, and its encoder's are not needed.
///
/// # Errors
/// Names the file and what is wrong with it.
pub fn checkpoint_header(path: Option<&Path>) -> Result<Header, Error> {
    let (bytes, name) = read(path)?;
    Checkpoint::header(&bytes, name).lift()
}

/// Reads this checkpoint, or the shipped one, with its encoder's weights if those are published ones.
///
/// # Errors
/// Names the file and what is wrong with it; where the encoder's weights were looked for, or that others were found.
pub fn load_checkpoint(path: Option<&Path>, encoders: &EncoderPlaces, device: &Device) -> Result<Checkpoint, Error> {
    let (bytes, name) = read(path)?;
    let header = Checkpoint::header(&bytes, name).lift()?;
    let encoder = match (&header.config.encoder, &header.encoder_weights) {
        (EncoderConfig::Dinov2(_), Some(origin)) => {
            let weights = find_encoder(encoders, &origin.name)?;
            let encoder = Dinov2::load_as(&weights.folder, &origin.name, &device.0).lift()?;
            let found = encoder.origin().map_or("", |o| o.sha256.as_str());
            if found != origin.sha256 {
                let expected = format!(
                    "those that {} was trained with, {}, sha256 {}",
                    name.display(),
                    origin.name,
                    origin.sha256
                );
                let field = format!("encoder weights in {}", weights.folder.display());
                return Err(Error::input(field, expected, format!("sha256 {found}")));
            }
            Some(encoder)
        }
        (EncoderConfig::Dinov2(_), None) => {
            let expected = "a model that was trained with published encoder weights";
            return Err(Error::input(name.display().to_string(), expected, "one trained on random ones, in a dry run"));
        }
        (EncoderConfig::Patch(_), _) => None,
    };
    Checkpoint::from_bytes(&bytes, name, encoder, &device.0).lift()
}

/// Where the published weights of frozen encoders are looked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EncoderPlaces {
    /// The very folder, with `config.json` and `model.safetensors`, if the user names one: nothing else is looked at then.
    pub folder: Option<PathBuf>,
    /// Folder of all weights, as `freerange weights fetch` fills it.
    pub cache: Option<PathBuf>,
}

impl Default for EncoderPlaces {
    /// The user's cache.
    fn default() -> Self {
        Self { folder: None, cache: weights_folder() }
    }
}

/// The files of a frozen encoder.
const FILES: [&str; 2] = ["config.json", "model.safetensors"];

impl EncoderPlaces {
    /// This folder and no other, or the user's cache where there is none.
    pub fn at(folder: Option<PathBuf>) -> Self {
        Self { folder, ..Self::default() }
    }
}

/// Finds the weights of this name: a folder, or `hf:owner/name` for the hub's, of which nothing is downloaded.
///
/// # Errors
/// Says where they were looked for.
pub fn find_encoder(encoders: &EncoderPlaces, name: &str) -> Result<EncoderWeights, Error> {
    let places = match (&encoders.folder, hub_name(name)?) {
        (Some(folder), _) => vec![folder.clone()],
        (None, None) => vec![PathBuf::from(name)],
        (None, Some((_, repository))) => encoders.cache.iter().map(|cache| cache.join(repository)).collect(),
    };
    let missing = |folder: &PathBuf| FILES.into_iter().find(|file| !folder.join(file).is_file());
    if let Some(folder) = places.iter().find(|folder| missing(folder).is_none()) {
        return Ok(EncoderWeights { name: name.into(), folder: folder.clone() });
    }
    let looked: Vec<String> = places
        .iter()
        .map(|folder| format!("{} (no {})", folder.display(), missing(folder).unwrap_or_default()))
        .collect();
    let hint = match hub_name(name)? {
        Some((_, repository)) => {
            format!("; `freerange weights fetch {repository}` downloads the known ones, or name")
        }
        None => "; name".into(),
    };
    Err(Error::input(
        format!("encoder weights `{name}`"),
        format!("a folder with {}{hint} their folder (--encoder-weights)", FILES.join(" and ")),
        if looked.is_empty() { "no cache folder on this system".into() } else { looked.join(", ") },
    ))
}

/// The weights that training with this encoder needs: those it names, or those that the user names. None for an encoder
/// of the model's own, for random ones, and where nobody names any.
///
/// # Errors
/// As [`find_encoder`].
pub fn encoder_for_training(
    encoders: &EncoderPlaces,
    encoder: &EncoderConfig,
) -> Result<Option<EncoderWeights>, Error> {
    let named = match encoder {
        EncoderConfig::Dinov2(c) => c.weights.clone(),
        EncoderConfig::Patch(_) => None,
    };
    match (named, &encoders.folder) {
        (Some(name), _) if name.starts_with("hf:") => find_encoder(encoders, &name).map(Some),
        // A checkpoint is read from any working directory.
        (_, Some(folder)) => find_encoder(encoders, &absolute(folder)).map(Some),
        (Some(name), None) => find_encoder(encoders, &absolute(Path::new(&name))).map(Some),
        (None, None) => Ok(None),
    }
}

fn absolute(folder: &Path) -> String {
    std::path::absolute(folder).unwrap_or_else(|_| folder.into()).to_string_lossy().into_owned()
}

/// Owner and name of `hf:owner/name`; none for a folder.
fn hub_name(name: &str) -> Result<Option<(&str, &str)>, Error> {
    let Some(repository) = name.strip_prefix("hf:") else { return Ok(None) };
    // A name from a file must not lead out of the cache.
    let plain = |part: &str| {
        let allowed = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
        !part.is_empty() && !part.starts_with('.') && part.chars().all(allowed)
    };
    match repository.split_once('/') {
        Some((owner, name)) if plain(owner) && plain(name) => Ok(Some((owner, name))),
        _ => Err(Error::input("encoder weights", "a folder or hf:owner/name", format!("`{name}`"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_repositories_or_folders() {
        assert_eq!(hub_name("hf:facebook/dinov2-base").unwrap(), Some(("facebook", "dinov2-base")));
        assert_eq!(hub_name("some/folder").unwrap(), None);
        for bad in ["hf:", "hf:a", "hf:a/", "hf:/b", "hf:a/b/c", "hf:../b", "hf:a/..", "hf:a/b c"] {
            assert!(hub_name(bad).unwrap_err().to_string().contains(bad), "{bad}");
        }
    }

    #[test]
    fn what_is_not_there_is_told_with_all_places() {
        let places = EncoderPlaces { folder: None, cache: Some("no/cache".into()) };
        let error = find_encoder(&places, "hf:facebook/dinov2-base").unwrap_err().to_string();
        assert!(error.contains("no/cache/dinov2-base") && error.contains("weights fetch dinov2-base"), "{error}");
        let places = EncoderPlaces { folder: Some("my/own".into()), ..places };
        let error = find_encoder(&places, "hf:facebook/dinov2-base").unwrap_err().to_string();
        assert!(error.contains("my/own (no config.json)") && !error.contains("no/cache"), "{error}");
        let error = find_encoder(&EncoderPlaces { folder: None, cache: None }, "hf:a/b").unwrap_err().to_string();
        assert!(error.contains("no cache folder"), "{error}");
    }
}
