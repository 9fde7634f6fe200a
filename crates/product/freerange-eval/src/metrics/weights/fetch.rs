//! Downloading weights: from the Hugging Face hub and from their authors' own addresses.

use std::{
    collections::BTreeSet,
    fs::File,
    io::{Read, Write},
    path::{Path, PathBuf},
};

use freerange_model::hub::{self, HubError};
use freerange_util::{beside, persist, write_atomically};
use tempfile::NamedTempFile;

use super::{NOTE, Origin, WeightFile, WeightSet, check, is_there, members, note_of, set};
use crate::metrics::MetricsError;

/// Largest member of an archive, in bytes.
const LARGEST: u64 = 8 << 30;

/// How weights are downloaded.
#[derive(Clone, Debug, PartialEq)]
pub struct FetchOptions {
    /// Address of the Hugging Face hub or of a mirror of it.
    pub hub: String,
    /// Seconds to wait for a connection, and for a server's first answer.
    pub timeout: f64,
}

impl Default for FetchOptions {
    /// `https://huggingface.co`, 60 seconds.
    fn default() -> Self {
        Self { hub: "https://huggingface.co".to_owned(), timeout: 60.0 }
    }
}

/// Downloads a set of weights into `folder` and returns its files. Files that are there and intact are kept.
///
/// A file gets its name only when it is complete and its SHA-256 is the published one: that of [`WeightFile::sha256`],
/// or the one that the hub keeps for large files. `FILE.sha256` beside it records what came; files are checked against
/// it whenever they are read.
///
/// `progress` is called with the file's name, the bytes so far, and the size where the server says it.
///
/// # Errors
/// If the set is unknown, the server cannot be reached or has no such file, the download is cut short or has another
/// hash, or a file cannot be written.
pub fn fetch(
    name: &str,
    folder: &Path,
    options: &FetchOptions,
    progress: &mut dyn FnMut(&str, u64, Option<u64>),
) -> Result<Vec<PathBuf>, MetricsError> {
    fetch_set(set(name)?, folder, options, progress)
}

pub(super) fn fetch_set(
    set: &WeightSet,
    folder: &Path,
    options: &FetchOptions,
    progress: &mut dyn FnMut(&str, u64, Option<u64>),
) -> Result<Vec<PathBuf>, MetricsError> {
    let mut client = Client { hub: hub::Client::new(&options.hub, options.timeout), progress };
    let mut archives = BTreeSet::new();
    for file in set.files {
        if is_intact(folder, file)? {
            continue;
        }
        match file.origin {
            Origin::Hub { repository, path } => {
                let commit = client.hub.commit(repository, "main")?;
                let (entry, url) = client.hub.entry(repository, &commit, path)?;
                let published = entry.sha256.as_deref().unwrap_or(file.sha256);
                client.file(&url, &folder.join(file.path), Some(entry.size), published)?;
            }
            Origin::Url(url) => client.file(url, &folder.join(file.path), None, file.sha256)?,
            Origin::Zip { url, .. } => {
                if archives.insert(url) {
                    client.archive(url, folder, set)?;
                }
                if !is_there(folder, file) {
                    let reason = format!("the archive has no `{}`", file.path);
                    return Err(MetricsError::Download { url: url.to_owned(), reason });
                }
            }
        }
    }
    Ok(set.files.iter().map(|file| folder.join(file.path)).collect())
}

/// Whether a file (or all files of a folder) are there with the hashes that are known. A damaged file is fetched anew.
fn is_intact(folder: &Path, file: &WeightFile) -> Result<bool, MetricsError> {
    if !is_there(folder, file) {
        return Ok(false);
    }
    for path in members(&folder.join(file.path))? {
        match check(&path, file.sha256) {
            Ok(_) => {}
            Err(MetricsError::Checksum { .. }) => return Ok(false),
            Err(e) => return Err(e),
        }
    }
    Ok(true)
}

impl From<HubError> for MetricsError {
    fn from(e: HubError) -> Self {
        match e {
            HubError::Download { url, reason } => Self::Download { url, reason },
            HubError::Io(e) => Self::io(&e.path, e.source),
            // Names, caches and hashes of models: not asked for here.
            e => Self::Download { url: "the hub".into(), reason: e.to_string() },
        }
    }
}

struct Client<'a> {
    hub: hub::Client,
    progress: &'a mut dyn FnMut(&str, u64, Option<u64>),
}

impl Client<'_> {
    /// Downloads to a temporary file beside `target`, and returns it with its hash.
    fn download(
        &mut self,
        url: &str,
        target: &Path,
        size: Option<u64>,
    ) -> Result<(NamedTempFile, String), MetricsError> {
        let name = target.file_name().unwrap_or_default().to_string_lossy().into_owned();
        Ok(self.hub.file(url, target, size, &mut |done, total| (self.progress)(&name, done, total))?)
    }

    fn file(&mut self, url: &str, target: &Path, size: Option<u64>, published: &str) -> Result<(), MetricsError> {
        let (file, found) = self.download(url, target, size)?;
        if !found.starts_with(published) {
            let (path, expected) = (target.to_owned(), published.to_owned());
            return Err(MetricsError::Checksum { path, expected, found });
        }
        keep(file, target, &found)
    }

    /// Downloads an archive and unpacks the members that `set` wants of it.
    fn archive(&mut self, url: &str, folder: &Path, set: &WeightSet) -> Result<(), MetricsError> {
        let name = url.rsplit('/').next().unwrap_or(url);
        let (file, _) = self.download(url, &folder.join(name), None)?;
        let fail = |reason: String| MetricsError::Download { url: url.to_owned(), reason };
        let open = File::open(file.path()).map_err(|e| MetricsError::io(file.path(), e))?;
        let mut archive = zip::ZipArchive::new(open).map_err(|e| fail(e.to_string()))?;
        let wanted: Vec<(&str, &str)> = set
            .files
            .iter()
            .filter_map(|file| match file.origin {
                Origin::Zip { url: from, member } if from == url => Some((member, file.path)),
                _ => None,
            })
            .collect();
        for i in 0..archive.len() {
            let mut member = archive.by_index(i).map_err(|e| fail(e.to_string()))?;
            let name = member.name().map_err(|e| fail(e.to_string()))?.into_owned();
            // Only plain names below a wanted folder, so that no name leads out of it.
            let inside = |name: &str| !name.is_empty() && !name.contains(['/', '\\']) && !name.starts_with('.');
            let target = wanted.iter().find_map(|(from, to)| {
                let rest = name.strip_prefix(from)?;
                match from.ends_with('/') {
                    true => inside(rest).then(|| folder.join(to).join(rest)),
                    false => rest.is_empty().then(|| folder.join(to)),
                }
            });
            let Some(target) = target.filter(|path| path.extension().is_none_or(|e| e != NOTE)) else { continue };
            let parent = target.parent().unwrap_or(folder);
            std::fs::create_dir_all(parent).map_err(|e| MetricsError::io(parent, e))?;
            let mut out = beside(&target).map_err(|e| MetricsError::io(parent, e))?;
            let n = std::io::copy(&mut (&mut member).take(LARGEST + 1), &mut out)
                .map_err(|e| fail(format!("`{name}`: {e}")))?;
            if n > LARGEST {
                return Err(fail(format!("`{name}` unpacks to more than {LARGEST} bytes")));
            }
            let found = super::hash_file(out.path())?;
            keep(out, &target, &found)?;
        }
        Ok(())
    }
}

/// Gives a complete file its name, and notes its hash beside it.
fn keep(file: NamedTempFile, target: &Path, sha256: &str) -> Result<(), MetricsError> {
    let note = note_of(target);
    // The old note goes first: were we stopped in between, the new file would not fit it.
    match std::fs::remove_file(&note) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(MetricsError::io(&note, e)),
        _ => {}
    }
    persist(file, target).map_err(|e| MetricsError::io(target, e))?;
    write_atomically(&note, |out| writeln!(out, "{sha256}")).map_err(|e| MetricsError::io(&note, e))
}

#[cfg(test)]
#[path = "fetch_tests.rs"]
mod tests;
