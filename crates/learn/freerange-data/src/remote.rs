//! Places that `object_store` reaches: S3, GCS, HTTP.
//!
//! Its calls are asynchronous; those here wait for them. Failed requests are tried again by `object_store` itself.

use std::fmt;
use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::{Arc, LazyLock};

use bytes::Bytes;
use futures_util::TryStreamExt;
use object_store::path::Path as Key;
use object_store::{ObjectStore, ObjectStoreExt, PutPayload, WriteMultipart};
use tokio::runtime::Runtime;
use url::Url;

use crate::DataError;
use freerange_util::IoError;

/// Bytes per part of an upload; S3 takes at most 10,000 parts, of at least 5 MiB but for the last.
const PART: usize = 16 << 20;

/// One runtime for all places: its threads do the waiting for all readers.
static RUNTIME: LazyLock<io::Result<Runtime>> =
    LazyLock::new(|| tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build());

fn runtime() -> io::Result<&'static Runtime> {
    RUNTIME.as_ref().map_err(|e| io::Error::other(format!("no threads for requests: {e}")))
}

/// A folder in an object store.
#[derive(Clone)]
pub(crate) struct Remote {
    store: Arc<dyn ObjectStore>,
    prefix: Key,
    location: String,
}

impl fmt::Debug for Remote {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Remote").field("location", &self.location).finish_non_exhaustive()
    }
}

/// What reading a whole file gives.
pub(crate) enum Whole {
    Here(Vec<u8>),
    TooLarge,
    Missing,
}

impl Remote {
    /// Opens a URL. Options come from the environment as `object_store` documents them (`AWS_*`, `GOOGLE_*`), which are
    /// those of the providers' own programs.
    pub fn open(location: &str) -> Result<Self, DataError> {
        let problem = |problem: String| DataError::Store { location: location.into(), problem };
        let url = Url::parse(location).map_err(|e| problem(e.to_string()))?;
        let supported = ["s3", "s3a", "gs", "http", "https"];
        if !supported.contains(&url.scheme()) {
            return Err(problem(format!("expected one of {}, found {}", supported.join(", "), url.scheme())));
        }
        let environment = std::env::vars().filter_map(|(key, value)| {
            let key = key.to_ascii_lowercase();
            (key.starts_with("aws_") || key.starts_with("google_")).then_some((key, value))
        });
        let http = url.scheme().starts_with("http").then(|| ("allow_http".to_owned(), "true".to_owned()));
        let (store, prefix) =
            object_store::parse_url_opts(&url, environment.chain(http)).map_err(|e| problem(e.to_string()))?;
        Ok(Self::new(store.into(), prefix, location))
    }

    /// The folder `prefix` of `store`.
    pub fn new(store: Arc<dyn ObjectStore>, prefix: Key, location: &str) -> Self {
        Self { store, prefix, location: location.trim_end_matches('/').into() }
    }

    fn key(&self, name: &str) -> Key {
        name.split('/').filter(|part| !part.is_empty()).fold(self.prefix.clone(), |key, part| key.join(part))
    }

    /// An empty store of its own.
    pub fn in_memory() -> Self {
        Self::new(Arc::new(object_store::memory::InMemory::new()), Key::from("a/b"), "memory://a/b")
    }

    pub fn path(&self, name: &str) -> PathBuf {
        if name.is_empty() { self.location.clone().into() } else { format!("{}/{name}", self.location).into() }
    }

    fn wait<T>(&self, name: &str, work: impl Future<Output = object_store::Result<T>>) -> Result<T, DataError> {
        let done = runtime().and_then(|r| r.block_on(work).map_err(io::Error::from));
        Ok(done.map_err(IoError::at(&self.path(name)))?)
    }

    pub fn size(&self, name: &str) -> Result<Option<u64>, DataError> {
        let key = self.key(name);
        self.wait(name, async {
            match self.store.head(&key).await {
                Ok(meta) => Ok(Some(meta.size)),
                Err(object_store::Error::NotFound { .. }) => Ok(None),
                Err(e) => Err(e),
            }
        })
    }

    /// The whole of `name`, if it has at most `most` bytes.
    pub fn read(&self, name: &str, most: u64) -> Result<Whole, DataError> {
        let key = self.key(name);
        self.wait(name, async {
            match self.store.get(&key).await {
                Ok(found) if found.meta.size > most => Ok(Whole::TooLarge),
                Ok(found) => Ok(Whole::Here(found.bytes().await?.into())),
                Err(object_store::Error::NotFound { .. }) => Ok(Whole::Missing),
                Err(e) => Err(e),
            }
        })
    }

    pub fn range(&self, name: &str, offset: u64, length: u64) -> Result<Vec<u8>, DataError> {
        if length == 0 {
            return Ok(Vec::new());
        }
        let bytes = self.wait(name, self.store.get_range(&self.key(name), offset..offset.saturating_add(length)))?;
        if bytes.len() as u64 != length {
            let short =
                io::Error::new(io::ErrorKind::UnexpectedEof, format!("{length} bytes asked, {} given", bytes.len()));
            return Err(DataError::from(IoError::at(&self.path(name))(short)));
        }
        Ok(bytes.into())
    }

    /// Names directly in the folder `name`.
    pub fn list(&self, name: &str) -> Result<Vec<String>, DataError> {
        let key = self.key(name);
        let found = self.wait(name, self.store.list_with_delimiter(Some(&key)))?;
        Ok(found.objects.iter().filter_map(|o| o.location.filename().map(str::to_owned)).collect())
    }

    /// Removes all below `name`.
    pub fn remove(&self, name: &str) -> Result<(), DataError> {
        let key = self.key(name);
        self.wait(name, async {
            let found: Vec<Key> = self.store.list(Some(&key)).map_ok(|o| o.location).try_collect().await?;
            for location in found {
                match self.store.delete(&location).await {
                    Err(object_store::Error::NotFound { .. }) | Ok(()) => {}
                    Err(e) => return Err(e),
                }
            }
            Ok(())
        })
    }

    pub fn create(&self, name: &str) -> Result<Upload, DataError> {
        Ok(Upload { remote: self.clone(), key: self.key(name), buffer: Vec::new(), parts: None })
    }
}

/// A file on its way. It appears under its name when [finished](Self::finish); given up, it never does.
pub(crate) struct Upload {
    remote: Remote,
    key: Key,
    buffer: Vec<u8>,
    parts: Option<WriteMultipart>, // only where one request is not enough
}

impl Upload {
    pub fn finish(mut self) -> io::Result<()> {
        let rest = std::mem::take(&mut self.buffer);
        let (store, key) = (&self.remote.store, &self.key);
        runtime()?.block_on(async {
            match self.parts.take() {
                None => store.put(key, PutPayload::from(rest)).await.map(|_| ()),
                Some(mut parts) => {
                    parts.put(Bytes::from(rest));
                    parts.finish().await.map(|_| ())
                }
            }
        })?;
        Ok(())
    }
}

impl Write for Upload {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        self.buffer.extend_from_slice(data);
        if self.buffer.len() >= PART {
            let full = Bytes::from(std::mem::take(&mut self.buffer));
            let (store, key) = (&self.remote.store, &self.key);
            let parts = &mut self.parts;
            runtime()?.block_on(async {
                let parts = match parts {
                    Some(parts) => parts,
                    None => parts.insert(WriteMultipart::new_with_chunk_size(store.put_multipart(key).await?, PART)),
                };
                parts.wait_for_capacity(4).await?;
                parts.put(full);
                Ok::<_, object_store::Error>(())
            })?;
        }
        Ok(data.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Store;

    #[test]
    fn large_files_go_up_in_parts() {
        let far = Store::in_memory();
        let bytes: Vec<u8> = (0..2 * PART + 12345).map(|i| (i * 7 % 251) as u8).collect();
        let mut file = far.create("big").unwrap();
        bytes.chunks(1 << 20).for_each(|c| file.write_all(c).unwrap());
        assert_eq!(far.size("big").unwrap(), None);
        let (n, hash) = file.finish().unwrap();
        assert_eq!((n, hash), (bytes.len() as u64, freerange_util::sha256(&bytes)));
        assert!(far.read("big", 1 << 30).unwrap().unwrap() == bytes);
    }

    #[test]
    fn urls_are_checked() {
        for (url, text) in [("ftp://x/y", "expected one of"), ("s3://", "s3://")] {
            let found = Store::open(url).map(|s| s.folder().is_none());
            assert!(
                found.as_ref().is_ok_and(|remote| !remote) || found.as_ref().unwrap_err().to_string().contains(text),
                "{url}: {found:?}"
            );
        }
    }
}
