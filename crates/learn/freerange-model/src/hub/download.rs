//! Downloads, bounded and checked.

use std::{
    io::{Read, Write},
    path::Path,
    time::Duration,
};

use freerange_util::{IoError, beside, hex, persist};
use serde::Deserialize;
use sha2::{Digest, Sha256};
use tempfile::NamedTempFile;

use crate::hub::{Hub, HubError, HubModel, Pins, is_commit, write};

/// Longest answer that is no file, in bytes.
const ANSWER_LIMIT: u64 = 8 << 20;
/// Largest file, in bytes.
const FILE_LIMIT: u64 = 64 << 30;

/// What the hub says of a revision.
#[derive(Deserialize)]
struct Revision {
    sha: String,
}

/// What the hub says of a file.
#[derive(Deserialize)]
struct Entry {
    path: String,
    size: u64,
    /// Of large files; their `oid` is a SHA-256.
    lfs: Option<Large>,
}

#[derive(Deserialize)]
struct Large {
    oid: String,
}

impl Hub {
    /// Downloads files into the folder of their commit, pins their hashes, and returns the commit.
    pub(crate) fn download(
        &self,
        model: &HubModel,
        commit: Option<String>,
        place: &Path,
        missing: &[&str],
        pins: &mut Pins,
        progress: &mut dyn FnMut(&str, u64, u64),
    ) -> Result<String, HubError> {
        let wait = Some(Duration::try_from_secs_f64(self.timeout).unwrap_or(Duration::from_secs(60)));
        let agent: ureq::Agent =
            ureq::Agent::config_builder().timeout_connect(wait).timeout_recv_response(wait).build().into();
        let (address, HubModel { owner, name, revision }) = (self.address.trim_end_matches('/'), model);
        let commit = match commit {
            Some(commit) => commit,
            None => {
                let url = format!("{address}/api/models/{owner}/{name}/revision/{revision}");
                let Revision { sha } = answer(&agent, &url)?;
                if !is_commit(&sha) {
                    let found: String = sha.chars().take(60).collect();
                    return Err(failed(&url, format!("expected a commit of 40 hexadecimal digits, found {found:?}")));
                }
                sha
            }
        };
        let url = format!("{address}/api/models/{owner}/{name}/tree/{commit}");
        let entries: Vec<Entry> = answer(&agent, &url)?;
        let folder = place.join(&commit);
        for file in missing {
            let Some(entry) = entries.iter().find(|e| e.path == *file) else {
                return Err(failed(&url, format!("expected the file {file}, found none of this name")));
            };
            let url = format!("{address}/{owner}/{name}/resolve/{commit}/{file}");
            // What was pinned once stays so, whatever the hub says by now.
            let expected = pins.sha256.get(*file).or(entry.lfs.as_ref().map(|l| &l.oid)).cloned();
            let (temporary, found) = fetch(&agent, &url, &folder, file, entry.size, progress)?;
            if let Some(expected) = expected.filter(|e| *e != found) {
                return Err(HubError::Checksum { url, expected, found });
            }
            let target = folder.join(file);
            persist(temporary, &target).map_err(IoError::at(&target))?;
            pins.sha256.insert((*file).into(), found);
            let text = serde_json::to_vec_pretty(pins).expect("strings");
            write(&folder.join("pins.json"), &text)?;
        }
        Ok(commit)
    }
}

fn failed(url: &str, reason: impl std::fmt::Display) -> HubError {
    HubError::Download { url: url.into(), reason: reason.to_string() }
}

/// JSON from the hub.
fn answer<T: for<'a> Deserialize<'a>>(agent: &ureq::Agent, url: &str) -> Result<T, HubError> {
    let response = agent.get(url).call().map_err(|e| failed(url, e))?;
    let mut bytes = Vec::new();
    let read = response.into_body().into_reader().take(ANSWER_LIMIT).read_to_end(&mut bytes);
    read.map_err(|e| failed(url, e))?;
    serde_json::from_slice(&bytes).map_err(|e| failed(url, format!("no answer of a hub: {e}")))
}

/// A file beside its target, and its hash.
fn fetch(
    agent: &ureq::Agent,
    url: &str,
    folder: &Path,
    name: &str,
    size: u64,
    progress: &mut dyn FnMut(&str, u64, u64),
) -> Result<(NamedTempFile, String), HubError> {
    if size > FILE_LIMIT {
        return Err(failed(url, format!("expected at most {FILE_LIMIT} bytes, found {size}")));
    }
    std::fs::create_dir_all(folder).map_err(IoError::at(folder))?;
    let mut file = beside(&folder.join(name)).map_err(IoError::at(folder))?;
    let mut body = agent.get(url).call().map_err(|e| failed(url, e))?.into_body().into_reader();
    let (mut hash, mut done, mut buffer) = (Sha256::new(), 0, vec![0; 1 << 18]);
    loop {
        let n = body.read(&mut buffer).map_err(|e| failed(url, format!("after {done} of {size} bytes: {e}")))?;
        done += n as u64;
        if n == 0 || done > size {
            break;
        }
        hash.update(&buffer[..n]);
        file.write_all(&buffer[..n]).map_err(IoError::at(folder))?;
        progress(name, done, size);
    }
    match done == size {
        true => Ok((file, hex(&hash.finalize()))),
        false => {
            Err(failed(url, format!("expected {size} bytes, {} came", if done > size { "more" } else { "fewer" })))
        }
    }
}

#[cfg(test)]
#[path = "download_tests.rs"]
mod tests;
