//! Models on the Hugging Face hub: names, a cache that pins what came, downloads.
//!
//! `hf:owner/name@revision` names a repository at a branch, tag or commit. What a branch or tag meant when it was first
//! used is written down with the SHA-256 of every file: from then on the same name gives the same bytes, offline too,
//! and files are checked whenever they are used. Who wants what is new names a commit, or removes the folder.
//!
//! In the cache: `hub/OWNER/NAME/refs/REVISION` holds a commit, `hub/OWNER/NAME/COMMIT/` the files and `pins.json`.

#[cfg(feature = "download")]
mod client;
#[cfg(feature = "download")]
mod download;
mod error;

use std::{
    collections::BTreeMap,
    fmt,
    fs::File,
    io::{self, Write},
    path::{Path, PathBuf},
    str::FromStr,
};

use freerange_util::{IoError, sha256_of};
use serde::{Deserialize, Serialize};

#[cfg(feature = "download")]
pub use client::{Client, Entry};
pub use error::HubError;

/// A repository of a model on the hub, at a revision.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HubModel {
    owner: String,
    name: String,
    revision: String,
}

impl FromStr for HubModel {
    type Err = HubError;

    /// `hf:owner/name`, at the branch `main`, or `hf:owner/name@revision`.
    fn from_str(text: &str) -> Result<Self, HubError> {
        let parsed = text.strip_prefix("hf:").and_then(|rest| {
            let (repository, revision) = rest.split_once('@').unwrap_or((rest, "main"));
            let (owner, name) = repository.split_once('/')?;
            // These become names of folders: nothing may lead out of the cache.
            let plain = |s: &str| {
                let allowed = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
                (1..=96).contains(&s.len()) && !s.starts_with('.') && s.chars().all(allowed)
            };
            let all_plain = plain(owner) && plain(name) && plain(revision);
            all_plain.then(|| Self { owner: owner.into(), name: name.into(), revision: revision.into() })
        });
        parsed.ok_or_else(|| HubError::Name { found: text.chars().take(200).collect() })
    }
}

impl fmt::Display for HubModel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "hf:{}/{}@{}", self.owner, self.name, self.revision)
    }
}

/// Files that are in the cache, and checked.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pinned {
    /// Where they lie.
    pub folder: PathBuf,
    /// The commit that they are of.
    pub commit: String,
}

/// A cache of models, and the hub behind it.
#[derive(Clone, Debug, PartialEq)]
pub struct Hub {
    /// The cache; `hub` in it is ours.
    pub cache: PathBuf,
    /// Address of the hub or of a mirror of it.
    pub address: String,
    /// Seconds to wait for a connection, and for a server's first answer.
    pub timeout: f64,
}

/// `pins.json`: SHA-256 of files by name.
#[derive(Debug, Default, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Pins {
    sha256: BTreeMap<String, String>,
}

impl Hub {
    /// The public hub.
    pub fn new(cache: impl Into<PathBuf>) -> Self {
        Self { cache: cache.into(), address: "https://huggingface.co".into(), timeout: 60.0 }
    }

    /// The files `names` of `model`: those in the cache if they are all there and whole, else downloaded (feature
    /// `download`). A damaged file is downloaded anew, and has to have the hash that was pinned.
    ///
    /// `progress` is called with a file's name, the bytes so far, and the size.
    ///
    /// # Errors
    /// [`HubError::Missing`] without downloads; else if the hub cannot be reached or has no such file, what comes is
    /// cut short or has another hash, or the cache cannot be read or written.
    pub fn files(
        &self,
        model: &HubModel,
        names: &[&str],
        progress: &mut dyn FnMut(&str, u64, u64),
    ) -> Result<Pinned, HubError> {
        let place = self.cache.join("hub").join(&model.owner).join(&model.name);
        let reference = place.join("refs").join(&model.revision);
        let known = if is_commit(&model.revision) { Some(model.revision.clone()) } else { read_reference(&reference)? };
        let mut missing = names.to_vec();
        let mut pins = Pins::default();
        if let Some(commit) = &known {
            let folder = place.join(commit);
            pins = read_pins(&folder)?;
            missing.clear();
            for name in names {
                if !is_whole(&folder.join(name), pins.sha256.get(*name))? {
                    missing.push(name);
                }
            }
            if missing.is_empty() {
                return Ok(Pinned { folder, commit: commit.clone() });
            }
        }
        let commit = self.download(model, known, &place, &missing, &mut pins, progress)?;
        if !is_commit(&model.revision) {
            write(&reference, commit.as_bytes())?;
        }
        Ok(Pinned { folder: place.join(&commit), commit })
    }

    #[cfg(not(feature = "download"))]
    fn download(
        &self,
        model: &HubModel,
        _: Option<String>,
        place: &Path,
        missing: &[&str],
        _: &mut Pins,
        _: &mut dyn FnMut(&str, u64, u64),
    ) -> Result<String, HubError> {
        Err(HubError::Missing { model: model.to_string(), folder: place.into(), files: missing.join(", ") })
    }
}

/// Whether `text` names a commit, by 40 hexadecimal digits.
fn is_commit(text: &str) -> bool {
    text.len() == 40 && text.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b))
}

fn read_reference(path: &Path) -> Result<Option<String>, HubError> {
    match std::fs::read_to_string(path) {
        Ok(text) if is_commit(text.trim()) => Ok(Some(text.trim().into())),
        Ok(text) => {
            let found = text.chars().take(60).collect();
            Err(HubError::Cache { path: path.into(), expected: "a commit of 40 hexadecimal digits".into(), found })
        }
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(IoError::at(path)(e).into()),
    }
}

fn read_pins(folder: &Path) -> Result<Pins, HubError> {
    let path = folder.join("pins.json");
    match std::fs::read(&path) {
        Ok(bytes) => serde_json::from_slice(&bytes).map_err(|e| HubError::Cache {
            path,
            expected: "hashes of files, as this program wrote them".into(),
            found: e.to_string(),
        }),
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(Pins::default()),
        Err(e) => Err(IoError::at(&path)(e).into()),
    }
}

/// Whether a file is there with the hash that was pinned.
fn is_whole(path: &Path, pinned: Option<&String>) -> Result<bool, HubError> {
    let Some(pinned) = pinned else { return Ok(false) };
    match File::open(path).and_then(|mut file| sha256_of(&mut file)) {
        Ok(found) => Ok(found == *pinned),
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(e) => Err(IoError::at(path)(e).into()),
    }
}

/// Writes a file whole or not at all; folders are made.
fn write(path: &Path, bytes: &[u8]) -> Result<(), HubError> {
    let folder = path.parent().unwrap_or(Path::new("."));
    let written = std::fs::create_dir_all(folder)
        .and_then(|()| freerange_util::write_atomically(path, |file| file.write_all(bytes)));
    Ok(written.map_err(IoError::at(path))?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_plain() {
        let model: HubModel = "hf:some-one/free_range.v2".parse().unwrap();
        assert_eq!(model.to_string(), "hf:some-one/free_range.v2@main");
        let model: HubModel = "hf:a/b@v1.0".parse().unwrap();
        assert_eq!(model.revision, "v1.0");
        let long = format!("hf:a/{}", "b".repeat(97));
        for bad in [
            "a/b",
            "hf:a",
            "hf:/b",
            "hf:a/",
            "hf:a/b@",
            "hf:../b",
            "hf:a/..",
            "hf:a/b@..",
            "hf:a/b/c",
            "hf:a/b@x/y",
            "hf:a\\c/b",
            &long,
        ] {
            let error = bad.parse::<HubModel>().unwrap_err().to_string();
            assert!(error.contains("hf:owner/name[@revision]"), "{error}");
        }
    }

    /// A cache that holds one file of a commit, under the branch `main`.
    fn cache(bytes: &[u8]) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let commit = "0123456789abcdef0123456789abcdef01234567";
        let place = folder.path().join("hub/a/b");
        write(&place.join("refs/main"), commit.as_bytes()).unwrap();
        let mut pins = Pins::default();
        pins.sha256.insert("model.safetensors".into(), sha256_of(&mut &bytes[..]).unwrap());
        write(&place.join(commit).join("pins.json"), &serde_json::to_vec(&pins).unwrap()).unwrap();
        let file = place.join(commit).join("model.safetensors");
        write(&file, bytes).unwrap();
        (folder, file)
    }

    #[test]
    fn what_is_in_the_cache_needs_no_network() {
        let (folder, file) = cache(b"weights");
        // Nobody answers there.
        let hub = Hub { address: "http://127.0.0.1:9".into(), timeout: 0.5, ..Hub::new(folder.path()) };
        let get = |name: &str| hub.files(&name.parse().unwrap(), &["model.safetensors"], &mut |_, _, _| {});
        let pinned = get("hf:a/b").unwrap();
        assert_eq!(pinned.folder.join("model.safetensors"), file);
        assert_eq!(get(&format!("hf:a/b@{}", pinned.commit)).unwrap(), pinned);
        // What was changed is not what was pinned.
        std::fs::write(&file, b"weighty").unwrap();
        assert!(get("hf:a/b").is_err() && get("hf:a/other").is_err());
        std::fs::write(folder.path().join("hub/a/b/refs/main"), b"../../..").unwrap();
        let error = get("hf:a/b").unwrap_err().to_string();
        assert!(
            error.contains("refs") && error.contains("40 hexadecimal digits") && error.contains("../../.."),
            "{error}"
        );
    }

    #[cfg(not(feature = "download"))]
    #[test]
    fn without_downloads_what_is_missing_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let model = "hf:a/b".parse().unwrap();
        let error = Hub::new(folder.path()).files(&model, &["model.safetensors"], &mut |_, _, _| {}).unwrap_err();
        let message = error.to_string();
        assert!(
            ["hf:a/b@main", "model.safetensors", "--features fetch"].iter().all(|w| message.contains(w)),
            "{message}"
        );
    }
}
