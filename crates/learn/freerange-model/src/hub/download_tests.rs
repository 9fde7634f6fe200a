//! Downloads from a server of our own.

use std::{
    collections::HashMap,
    io::{BufRead, BufReader, Write},
    net::TcpListener,
    sync::{Arc, Mutex},
};

use freerange_util::hex;
use sha2::{Digest, Sha256};

use super::*;

const COMMIT: &str = "0123456789abcdef0123456789abcdef01234567";
const NEWER: &str = "fedcba9876543210fedcba9876543210fedcba98";

/// Answers by path, and what was asked.
#[derive(Clone, Default)]
struct Server {
    answers: Arc<Mutex<HashMap<String, Vec<u8>>>>,
    asked: Arc<Mutex<Vec<String>>>,
    address: String,
}

impl Server {
    fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let server = Self { address: format!("http://{}", listener.local_addr().unwrap()), ..Self::default() };
        let shared = server.clone();
        // Ends with the test's process.
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let mut stream = stream.unwrap();
                let mut lines = BufReader::new(stream.try_clone().unwrap()).lines().map_while(Result::ok);
                let Some(first) = lines.next() else { continue };
                lines.take_while(|l| !l.is_empty()).for_each(drop);
                let path = first.split(' ').nth(1).unwrap_or("").to_owned();
                let answer = shared.answers.lock().unwrap().get(&path).cloned();
                shared.asked.lock().unwrap().push(path);
                let (status, body) = answer.map_or(("404 Not Found", b"none".to_vec()), |a| ("200 OK", a));
                let head = format!("HTTP/1.1 {status}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n", body.len());
                // The client may hang up early.
                let _ = stream.write_all(head.as_bytes()).and_then(|()| stream.write_all(&body));
            }
        });
        server
    }

    fn put(&self, path: &str, body: impl Into<Vec<u8>>) {
        self.answers.lock().unwrap().insert(path.into(), body.into());
    }

    /// A repository `a/b` whose branch `main` is at `commit`, with these weights.
    fn publish(&self, commit: &str, weights: &[u8]) {
        let sha256 = hex(&Sha256::digest(weights));
        self.put("/api/models/a/b/revision/main", format!("{{\"sha\":\"{commit}\",\"id\":\"a/b\"}}"));
        let tree = format!(
            "[{{\"type\":\"file\",\"path\":\"config.json\",\"size\":2,\"oid\":\"x\"}},\
             {{\"type\":\"file\",\"path\":\"model.safetensors\",\"size\":{},\"oid\":\"y\",\"lfs\":{{\"oid\":\"{sha256}\"}}}}]",
            weights.len()
        );
        self.put(&format!("/api/models/a/b/tree/{commit}"), tree);
        self.put(&format!("/a/b/resolve/{commit}/config.json"), "{}");
        self.put(&format!("/a/b/resolve/{commit}/model.safetensors"), weights);
    }

    fn get(&self, cache: &Path, name: &str) -> Result<crate::hub::Pinned, HubError> {
        let hub = Hub { address: format!("{}/", self.address), timeout: 10.0, ..Hub::new(cache) };
        hub.files(&name.parse()?, &["config.json", "model.safetensors"], &mut |_, done, size| assert!(done <= size))
    }

    fn requests(&self) -> usize {
        self.asked.lock().unwrap().len()
    }
}

#[test]
fn what_a_branch_meant_first_is_kept() {
    let (server, cache) = (Server::start(), tempfile::tempdir().unwrap());
    server.publish(COMMIT, b"first");
    let pinned = server.get(cache.path(), "hf:a/b").unwrap();
    let weights = pinned.folder.join("model.safetensors");
    assert_eq!((pinned.commit.as_str(), std::fs::read(&weights).unwrap()), (COMMIT, b"first".to_vec()));
    let requests = server.requests();
    server.publish(NEWER, b"second");
    assert_eq!(server.get(cache.path(), "hf:a/b").unwrap(), pinned);
    assert_eq!(server.get(cache.path(), &format!("hf:a/b@{COMMIT}")).unwrap(), pinned);
    assert_eq!(server.requests(), requests, "what is there needs no network");
    // Who names the commit gets it.
    let newer = server.get(cache.path(), &format!("hf:a/b@{NEWER}")).unwrap();
    assert_eq!(std::fs::read(newer.folder.join("model.safetensors")).unwrap(), b"second");
    // A damaged file comes anew, as long as it is the one that was pinned.
    std::fs::write(&weights, b"worst").unwrap();
    assert_eq!(server.get(cache.path(), "hf:a/b").unwrap(), pinned);
    assert_eq!(std::fs::read(&weights).unwrap(), b"first");
    std::fs::write(&weights, b"worst").unwrap();
    server.publish(COMMIT, b"other");
    let error = server.get(cache.path(), "hf:a/b").unwrap_err();
    assert!(matches!(error, HubError::Checksum { .. }), "{error}");
}

#[test]
fn what_does_not_fit_is_refused_and_leaves_nothing() {
    let tree = format!("/api/models/a/b/tree/{COMMIT}");
    let weights = format!("/a/b/resolve/{COMMIT}/model.safetensors");
    let cases: [(&str, &str, &str); 7] = [
        ("/api/models/a/b/revision/main", "<html>", "no answer of a hub"),
        ("/api/models/a/b/revision/main", "{\"sha\":\"../..\"}", "40 hexadecimal digits"),
        (&tree, "[]", "expected the file config.json"),
        (&tree, "[{\"path\":\"config.json\",\"size\":99999999999999}]", "at most"),
        (&weights, "cut", "expected 5 bytes, 3 came"),
        (&weights, "longer", "expected 5 bytes, more came"),
        (&weights, "ferst", "expected SHA-256"),
    ];
    for (path, answer, words) in cases {
        let (server, cache) = (Server::start(), tempfile::tempdir().unwrap());
        server.publish(COMMIT, b"first");
        server.put(path, answer);
        let error = server.get(cache.path(), "hf:a/b").unwrap_err().to_string();
        assert!(error.contains(words) && error.contains(&server.address), "{error}");
        let place = cache.path().join("hub/a/b");
        assert!(!place.join("refs").exists(), "{words}");
        let files = std::fs::read_dir(place.join(COMMIT)).map_or(0, |f| {
            f.filter(|e| !["config.json", "pins.json"].contains(&e.as_ref().unwrap().file_name().to_str().unwrap()))
                .count()
        });
        assert_eq!(files, 0, "{words}");
    }
    let (server, cache) = (Server::start(), tempfile::tempdir().unwrap());
    let error = server.get(cache.path(), "hf:a/b").unwrap_err().to_string();
    assert!(error.contains("404"), "{error}");
}
