//! Downloads from a server of our own.

use std::{
    collections::HashMap,
    io::{BufRead, BufReader, Write},
    net::TcpListener,
    sync::{Arc, Mutex},
};

use super::*;
use crate::metrics::weights::Weights;

/// What the server says to a path.
#[derive(Clone, Default)]
struct Answer {
    body: Vec<u8>,
    /// Bytes after which the connection is closed.
    cut: Option<usize>,
}

#[derive(Clone, Default)]
struct Server {
    answers: Arc<Mutex<HashMap<String, Answer>>>,
    requests: Arc<Mutex<Vec<String>>>,
    address: String,
}

const COMMIT: &str = "0123456789abcdef0123456789abcdef01234567";

impl Server {
    fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let server = Self { address: format!("http://{}", listener.local_addr().unwrap()), ..Default::default() };
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
                shared.requests.lock().unwrap().push(path);
                let Some(a) = answer else {
                    let _ = stream
                        .write_all(b"HTTP/1.1 404 Not Found\r\nContent-Length: 4\r\nConnection: close\r\n\r\nnone");
                    continue;
                };
                let head = format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\nConnection: close\r\n\r\n", a.body.len());
                // The client may hang up early.
                let _ = stream.write_all(head.as_bytes());
                let _ = stream.write_all(&a.body[..a.cut.unwrap_or(a.body.len())]);
            }
        });
        server
    }

    fn put(&self, path: &str, answer: Answer) {
        self.answers.lock().unwrap().insert(path.to_owned(), answer);
    }

    fn body(&self, path: &str, body: &[u8]) {
        self.put(path, Answer { body: body.to_vec(), cut: None });
    }

    /// What the hub says of a repository: its commit, and its files. It keeps a SHA-256 of large ones only.
    fn publish(&self, repository: &str, model: &[u8], config: &[u8]) {
        let commit = format!("{{\"sha\":\"{COMMIT}\"}}");
        self.body(&format!("/api/models/{repository}/revision/main"), commit.as_bytes());
        let files = format!(
            "[{{\"path\":\"config.json\",\"size\":{}}},\
             {{\"path\":\"model.safetensors\",\"size\":{},\"lfs\":{{\"oid\":\"{}\"}}}}]",
            config.len(),
            model.len(),
            sha(model)
        );
        self.body(&format!("/api/models/{repository}/tree/{COMMIT}"), files.as_bytes());
    }

    fn options(&self) -> FetchOptions {
        FetchOptions { hub: self.address.clone(), timeout: 5.0 }
    }

    fn url(&self, path: &str) -> &'static str {
        format!("{}{path}", self.address).leak()
    }

    fn take_requests(&self) -> Vec<String> {
        std::mem::take(&mut self.requests.lock().unwrap())
    }
}

fn sha(bytes: &[u8]) -> String {
    freerange_util::sha256(bytes)
}

fn set_of(files: Vec<WeightFile>) -> WeightSet {
    WeightSet { name: "test", purpose: "", license: "", files: files.leak() }
}

fn quiet(_: &str, _: u64, _: Option<u64>) {}

/// Names of all files below a folder.
fn files_in(folder: &Path) -> Vec<String> {
    let mut out = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        match path.is_dir() {
            true => out.extend(files_in(&path)),
            false => out.push(path.file_name().unwrap().to_string_lossy().into_owned()),
        }
    }
    out.sort();
    out
}

#[test]
fn hub_files_come_once_and_are_checked() {
    let server = Server::start();
    let (model, config) = (vec![7u8; 300_000], b"{}".to_vec());
    server.publish("facebook/dinov2-small", &model, &config);
    server.body(&format!("/facebook/dinov2-small/resolve/{COMMIT}/model.safetensors"), &model);
    server.body(&format!("/facebook/dinov2-small/resolve/{COMMIT}/config.json"), &config);
    let folder = tempfile::tempdir().unwrap();
    let mut seen = Vec::new();
    let mut progress = |name: &str, done: u64, total: Option<u64>| seen.push((name.to_owned(), done, total));
    let files = fetch("dinov2-small", folder.path(), &server.options(), &mut progress).unwrap();
    assert_eq!(std::fs::read(&files[0]).unwrap(), model);
    assert_eq!(std::fs::read(&files[1]).unwrap(), config);
    assert!(seen.contains(&("model.safetensors".to_owned(), 300_000, Some(300_000))));
    assert_eq!(
        files_in(folder.path()),
        ["config.json", "config.json.sha256", "model.safetensors", "model.safetensors.sha256"]
    );
    assert_eq!(Weights::new([folder.path().to_owned()]).find("dinov2-small").unwrap(), files);

    server.take_requests();
    fetch("dinov2-small", folder.path(), &server.options(), &mut quiet).unwrap();
    assert!(server.take_requests().is_empty(), "nothing is downloaded twice");
    std::fs::write(&files[0], b"damaged").unwrap();
    let weights = Weights::new([folder.path().to_owned()]);
    assert!(matches!(weights.open("dinov2-small", &mut Vec::new()), Err(MetricsError::Checksum { .. })));
    fetch("dinov2-small", folder.path(), &server.options(), &mut quiet).unwrap();
    assert_eq!(std::fs::read(&files[0]).unwrap(), model, "a damaged file is fetched anew");

    // The hub's file is not the one that it lists.
    std::fs::remove_file(&files[0]).unwrap();
    server.publish("facebook/dinov2-small", &[8; 300_000], &config);
    let error = fetch("dinov2-small", folder.path(), &server.options(), &mut quiet).unwrap_err();
    assert!(matches!(error, MetricsError::Checksum { .. }), "{error}");
    assert!(!files[0].exists());
}

#[test]
fn failed_downloads_leave_nothing() {
    let server = Server::start();
    let folder = tempfile::tempdir().unwrap();
    let target = |path: &str, sha256: &'static str| {
        set_of(vec![WeightFile { path: "a/b.pth", origin: Origin::Url(server.url(path)), sha256, twin: None }])
    };
    let fetched = |set: &WeightSet| fetch_set(set, folder.path(), &server.options(), &mut quiet);

    let error = fetched(&target("/none.pth", "")).unwrap_err();
    assert!(matches!(&error, MetricsError::Download { reason, .. } if reason.contains("404")), "{error}");
    let body = vec![3u8; 100_000];
    server.put("/cut.pth", Answer { body: body.clone(), cut: Some(40_000) });
    let error = fetched(&target("/cut.pth", "")).unwrap_err();
    assert!(matches!(&error, MetricsError::Download { url, .. } if url.ends_with("/cut.pth")), "{error}");
    server.body("/wrong.pth", &body);
    let error = fetched(&target("/wrong.pth", "deadbeef")).unwrap_err();
    assert!(matches!(&error, MetricsError::Checksum { expected, .. } if expected == "deadbeef"), "{error}");
    let error = fetch("dinov2-small", folder.path(), &server.options(), &mut quiet).unwrap_err();
    assert!(matches!(&error, MetricsError::Download { reason, .. } if reason.contains("404")), "{error}");
    assert_eq!(files_in(folder.path()), [""; 0]);

    let prefix = sha(&body)[..8].to_owned().leak();
    fetched(&target("/wrong.pth", prefix)).unwrap();
    assert_eq!(files_in(folder.path()), ["b.pth", "b.pth.sha256"]);

    let nobody = FetchOptions { hub: "http://127.0.0.1:9".to_owned(), timeout: 2.0 };
    assert!(matches!(fetch("dinov2-base", folder.path(), &nobody, &mut quiet), Err(MetricsError::Download { .. })));
}

#[test]
fn archives_give_only_what_is_wanted() {
    let server = Server::start();
    let mut writer = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default();
    for (name, text) in [
        ("lora/adapter_config.json", "{}"),
        ("lora/adapter_model.bin", "weights"),
        ("lora/../../escaped", "no"),
        ("lora/sub/deep.txt", "no"),
        ("net.pth.tar", "net"),
        ("large_and_unused.pth", "no"),
        ("/absolute", "no"),
    ] {
        writer.start_file(name, options).unwrap();
        writer.write_all(text.as_bytes()).unwrap();
    }
    server.body("/all.zip", &writer.finish().unwrap().into_inner());
    server.body("/broken.zip", b"PK\x03\x04 and nothing else");
    let folder = tempfile::tempdir().unwrap();
    let inner = folder.path().join("inner");
    let file = |path: &'static str, archive: &str, member: &'static str| WeightFile {
        path,
        origin: Origin::Zip { url: server.url(archive), member },
        sha256: "",
        twin: None,
    };
    let set = set_of(vec![file("x/net.pth.tar", "/all.zip", "net.pth.tar"), file("x/lora/", "/all.zip", "lora/")]);
    let found = fetch_set(&set, &inner, &server.options(), &mut quiet).unwrap();
    assert_eq!(std::fs::read(&found[0]).unwrap(), b"net");
    assert!(found[1].is_dir());
    let expected = ["adapter_config.json", "adapter_model.bin", "net.pth.tar"];
    let names: Vec<String> = files_in(folder.path()).into_iter().filter(|name| !name.ends_with(".sha256")).collect();
    assert_eq!(names, expected);
    assert_eq!(server.take_requests().len(), 1, "one archive, one download");
    fetch_set(&set, &inner, &server.options(), &mut quiet).unwrap();
    assert!(server.take_requests().is_empty());

    let error = fetch_set(&set_of(vec![file("y", "/all.zip", "missing")]), &inner, &server.options(), &mut quiet);
    assert!(matches!(&error, Err(MetricsError::Download { reason, .. }) if reason.contains("`y`")), "{error:?}");
    let error = fetch_set(&set_of(vec![file("z", "/broken.zip", "net")]), &inner, &server.options(), &mut quiet);
    assert!(matches!(&error, Err(MetricsError::Download { .. })), "{error:?}");
}
