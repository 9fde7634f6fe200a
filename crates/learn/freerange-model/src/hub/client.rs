//! Requests to the hub, and downloads of files, bounded in bytes and in time.

use std::{
    io::{Read, Write},
    path::Path,
    time::Duration,
};

use freerange_util::{IoError, beside, hex};
use serde::Deserialize;
use sha2::{Digest, Sha256};
use tempfile::NamedTempFile;

use crate::hub::{HubError, is_commit};

/// Longest answer that is no file, in bytes.
const ANSWER_LIMIT: u64 = 8 << 20;
/// Largest file, in bytes.
const FILE_LIMIT: u64 = 64 << 30;

/// A client of the hub, or of a mirror of it.
pub struct Client {
    agent: ureq::Agent,
    address: String,
}

/// A file of a repository.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Size in bytes.
    pub size: u64,
    /// SHA-256 in hexadecimal. The hub keeps it for large files only.
    pub sha256: Option<String>,
}

/// What the hub says of a revision.
#[derive(Deserialize)]
struct Revision {
    sha: String,
}

/// What the hub says of a file.
#[derive(Deserialize)]
struct Listed {
    path: String,
    size: u64,
    /// Of large files; their `oid` is a SHA-256.
    lfs: Option<Large>,
}

#[derive(Deserialize)]
struct Large {
    oid: String,
}

impl Client {
    /// A client of the hub at `address`. It waits `timeout` seconds for a connection and for a first answer.
    pub fn new(address: &str, timeout: f64) -> Self {
        let wait = Some(Duration::try_from_secs_f64(timeout).unwrap_or(Duration::from_secs(60)));
        let config = ureq::Agent::config_builder().timeout_connect(wait).timeout_recv_response(wait).build();
        Self { agent: config.into(), address: address.trim_end_matches('/').into() }
    }

    /// The commit that a branch or tag of `repository` (`owner/name`) is at: 40 hexadecimal digits.
    ///
    /// # Errors
    /// [`HubError::Download`] if the hub does not answer or names none.
    pub fn commit(&self, repository: &str, revision: &str) -> Result<String, HubError> {
        let url = format!("{}/api/models/{repository}/revision/{revision}", self.address);
        let Revision { sha } = self.answer(&url)?;
        if is_commit(&sha) {
            return Ok(sha);
        }
        let found: String = sha.chars().take(60).collect();
        Err(failed(&url, format!("expected a commit of 40 hexadecimal digits, found {found:?}")))
    }

    /// The file `path` in the top folder of a repository at a commit, and its address.
    ///
    /// # Errors
    /// [`HubError::Download`] if the hub does not answer or has no such file.
    pub fn entry(&self, repository: &str, commit: &str, path: &str) -> Result<(Entry, String), HubError> {
        let list = format!("{}/api/models/{repository}/tree/{commit}", self.address);
        let listed: Vec<Listed> = self.answer(&list)?;
        let Some(found) = listed.into_iter().find(|entry| entry.path == path) else {
            return Err(failed(&list, format!("expected the file {path}, found none of this name")));
        };
        let url = format!("{}/{repository}/resolve/{commit}/{path}", self.address);
        Ok((Entry { size: found.size, sha256: found.lfs.map(|l| l.oid) }, url))
    }

    /// Downloads a file beside `target`, whose folder is made, and returns it with its SHA-256.
    ///
    /// `progress` is called with the bytes so far, and the size: the expected one, or else what the server says.
    ///
    /// # Errors
    /// [`HubError::Download`] if the file cannot be had or has another size than expected or announced;
    /// [`HubError::Io`] if it cannot be written. Nothing is left behind then.
    pub fn file(
        &self,
        url: &str,
        target: &Path,
        expected: Option<u64>,
        progress: &mut dyn FnMut(u64, Option<u64>),
    ) -> Result<(NamedTempFile, String), HubError> {
        let large = |size: u64| failed(url, format!("expected at most {FILE_LIMIT} bytes, found {size}"));
        if let Some(size) = expected.filter(|&size| size > FILE_LIMIT) {
            return Err(large(size));
        }
        let response = self.agent.get(url).call().map_err(|e| failed(url, e))?;
        let size = expected.or(response.body().content_length());
        let limit = size.unwrap_or(FILE_LIMIT);
        if limit > FILE_LIMIT {
            return Err(large(limit));
        }
        let folder = target.parent().unwrap_or(Path::new("."));
        std::fs::create_dir_all(folder).map_err(IoError::at(folder))?;
        let mut file = beside(target).map_err(IoError::at(folder))?;
        let mut body = response.into_body().into_reader();
        let (mut hash, mut done, mut buffer) = (Sha256::new(), 0, vec![0; 1 << 18]);
        loop {
            let n = body.read(&mut buffer).map_err(|e| failed(url, format!("after {done} bytes: {e}")))?;
            done += n as u64;
            if n == 0 || done > limit {
                break;
            }
            hash.update(&buffer[..n]);
            file.write_all(&buffer[..n]).map_err(IoError::at(folder))?;
            progress(done, size);
        }
        if done > limit {
            return Err(failed(url, format!("expected {limit} bytes, more came")));
        }
        match size {
            Some(size) if done < size => Err(failed(url, format!("expected {size} bytes, {done} came"))),
            _ => Ok((file, hex(&hash.finalize()))),
        }
    }

    /// JSON from the hub.
    fn answer<T: for<'a> Deserialize<'a>>(&self, url: &str) -> Result<T, HubError> {
        let response = self.agent.get(url).call().map_err(|e| failed(url, e))?;
        let mut bytes = Vec::new();
        let read = response.into_body().into_reader().take(ANSWER_LIMIT).read_to_end(&mut bytes);
        read.map_err(|e| failed(url, e))?;
        serde_json::from_slice(&bytes).map_err(|e| failed(url, format!("no answer of a hub: {e}")))
    }
}

fn failed(url: &str, reason: impl std::fmt::Display) -> HubError {
    HubError::Download { url: url.into(), reason: reason.to_string() }
}
