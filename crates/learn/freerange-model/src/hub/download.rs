//! Downloads of a model's files into the cache, each checked and pinned.

use std::path::Path;

use freerange_util::{IoError, persist};

use crate::hub::{Client, Hub, HubError, HubModel, Pins, write};

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
        let client = Client::new(&self.address, self.timeout);
        let repository = format!("{}/{}", model.owner, model.name);
        let commit = match commit {
            Some(commit) => commit,
            None => client.commit(&repository, &model.revision)?,
        };
        let folder = place.join(&commit);
        for file in missing {
            let (entry, url) = client.entry(&repository, &commit, file)?;
            let target = folder.join(file);
            let (temporary, found) =
                client.file(&url, &target, Some(entry.size), &mut |done, _| progress(file, done, entry.size))?;
            // What was pinned once stays so, whatever the hub says by now.
            let expected = pins.sha256.get(*file).cloned().or(entry.sha256);
            if let Some(expected) = expected.filter(|e| *e != found) {
                return Err(HubError::Checksum { url, expected, found });
            }
            persist(temporary, &target).map_err(IoError::at(&target))?;
            pins.sha256.insert((*file).into(), found);
            let text = serde_json::to_vec_pretty(pins).expect("strings");
            write(&folder.join("pins.json"), &text)?;
        }
        Ok(commit)
    }
}

#[cfg(test)]
#[path = "download_tests.rs"]
mod tests;
