//! Downloading weights: from the Hugging Face hub and from their authors' own addresses.

use std::{
    collections::BTreeSet,
    fs::File,
    io::{Read, Write},
    path::{Path, PathBuf},
    time::Duration,
};

use freerange_util::{beside, hex, persist, write_atomically};
use hf_hub::{
    Repo, RepoType,
    api::sync::{ApiBuilder, ApiError},
};
use sha2::{Digest, Sha256};
use tempfile::NamedTempFile;

use super::{NOTE, Origin, WeightFile, WeightSet, check, is_there, members, note_of, set};
use crate::metrics::MetricsError;

/// The largest download.
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
    let wait = Some(Duration::try_from_secs_f64(options.timeout).unwrap_or(Duration::from_secs(60)));
    let config = ureq::Agent::config_builder().timeout_connect(wait).timeout_recv_response(wait).build();
    let mut client = Client { agent: config.into(), options, progress };
    let mut archives = BTreeSet::new();
    for file in set.files {
        if is_intact(folder, file)? {
            continue;
        }
        match file.origin {
            Origin::Hub { repository, path } => {
                let (url, published) = client.hub_file(repository, path)?;
                client.file(
                    &url,
                    &folder.join(file.path),
                    if published.is_empty() { file.sha256 } else { &published },
                )?;
            }
            Origin::Url(url) => client.file(url, &folder.join(file.path), file.sha256)?,
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

struct Client<'a> {
    agent: ureq::Agent,
    options: &'a FetchOptions,
    progress: &'a mut dyn FnMut(&str, u64, Option<u64>),
}

impl Client<'_> {
    /// A hub file's address, at the commit that the main branch is at, and its SHA-256 where the hub keeps one (of
    /// large files it is the ETag; small ones have a Git hash, which is shorter).
    fn hub_file(&self, repository: &str, path: &str) -> Result<(String, String), MetricsError> {
        let fail = |url: &str, e: ApiError| MetricsError::Download { url: url.to_owned(), reason: e.to_string() };
        let api =
            ApiBuilder::new().with_endpoint(self.options.hub.clone()).with_progress(false).with_token(None).build();
        let api = api.map_err(|e| fail(&self.options.hub, e))?;
        let url = |revision: &str| {
            api.repo(Repo::with_revision(repository.to_owned(), RepoType::Model, revision.to_owned())).url(path)
        };
        let main = url("main");
        let metadata = api.metadata(&main).map_err(|e| fail(&main, e))?;
        let commit = metadata.commit_hash();
        let is_hex = |text: &str| text.bytes().all(|b| b.is_ascii_hexdigit());
        if commit.len() != 40 || !is_hex(commit) {
            return Err(MetricsError::Download {
                url: main,
                reason: format!("the hub names no commit but {commit:?}"),
            });
        }
        let etag = metadata.etag();
        let published = if etag.len() == 64 && is_hex(etag) { etag.to_lowercase() } else { String::new() };
        Ok((url(commit), published))
    }

    /// Downloads to a temporary file beside `target`, and returns it with its hash.
    fn download(&mut self, url: &str, target: &Path) -> Result<(NamedTempFile, String), MetricsError> {
        let fail = |reason: String| MetricsError::Download { url: url.to_owned(), reason };
        let response = self.agent.get(url).call().map_err(|e| fail(e.to_string()))?;
        let total = response.body().content_length();
        if total.is_some_and(|n| n > LARGEST) {
            return Err(fail(format!("the file has {} bytes, expected at most {LARGEST}", total.unwrap_or(0))));
        }
        let folder = target.parent().unwrap_or(Path::new("."));
        std::fs::create_dir_all(folder).map_err(|e| MetricsError::io(folder, e))?;
        let mut file = beside(target).map_err(|e| MetricsError::io(folder, e))?;
        let name = target.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let mut body = response.into_body().into_reader();
        let mut hash = Sha256::new();
        let mut buffer = vec![0; 1 << 18];
        let mut done = 0;
        loop {
            let n = body.read(&mut buffer).map_err(|e| fail(format!("after {done} bytes: {e}")))?;
            if n == 0 {
                break;
            }
            done += n as u64;
            if done > LARGEST {
                return Err(fail(format!("more than {LARGEST} bytes came")));
            }
            hash.update(&buffer[..n]);
            file.write_all(&buffer[..n]).map_err(|e| MetricsError::io(folder, e))?;
            (self.progress)(&name, done, total);
        }
        match total {
            Some(total) if total != done => Err(fail(format!("cut short: {done} of {total} bytes came"))),
            _ => Ok((file, hex(&hash.finalize()))),
        }
    }

    fn file(&mut self, url: &str, target: &Path, published: &str) -> Result<(), MetricsError> {
        let (file, found) = self.download(url, target)?;
        if !found.starts_with(published) {
            let (path, expected) = (target.to_owned(), published.to_owned());
            return Err(MetricsError::Checksum { path, expected, found });
        }
        keep(file, target, &found)
    }

    /// Downloads an archive and unpacks the members that `set` wants of it.
    fn archive(&mut self, url: &str, folder: &Path, set: &WeightSet) -> Result<(), MetricsError> {
        let name = url.rsplit('/').next().unwrap_or(url);
        let (file, _) = self.download(url, &folder.join(name))?;
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
