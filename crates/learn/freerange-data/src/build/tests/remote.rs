//! Shards far away.

use std::io::Write;
use std::path::PathBuf;

use crate::{ObjectSource, Shards, Store, inspect};

use crate::build::folder::build_with;
use crate::build::{BuildOptions, Item};

fn build_toys(place: &Store) {
    let make = |item: &Item| Ok(super::made(item.seed.unwrap(), 30.0));
    let (config, items) = (super::toy_config(), super::toy_items());
    let summary = build_with(&config, &items, place, &BuildOptions::default(), |_| (), make).unwrap();
    assert!(summary.complete);
}

/// Builds at `far`, and compares with a folder.
fn assert_same_as_here(far: &Store) {
    let near = tempfile::tempdir().unwrap();
    let here = Store::local(near.path());
    build_toys(far);
    build_toys(far); // nothing left to do
    build_toys(&here);
    for name in ["plan.json", "manifest.json", "shard-00000.tar", "shard-00002.json"] {
        assert_eq!(far.read(name, 1 << 30).unwrap(), here.read(name, 1 << 30).unwrap(), "{name}");
    }
    let mut names = here.list("").unwrap();
    names.retain(|n| n != ".lock-0-of-1");
    assert_eq!(far.list("").unwrap(), names);
    assert_eq!(far.list("parts/shard-00000").unwrap(), Vec::<String>::new());
    assert_readable(far, &here);
    assert!(far.range("plan.json", 1 << 20, 5).is_err());
    assert!(far.read("plan.json", 10).unwrap_err().to_string().contains("at most 10 bytes"));
    assert_eq!((far.size("none").unwrap(), far.read("none", 5).unwrap()), (None, None));
}

fn assert_readable(far: &Store, here: &Store) {
    let [a, b] = [far, here].map(|s| Shards::open(s, &[2], None).unwrap());
    for i in 0..10 {
        super::assert_same(&a.object(i).unwrap(), &b.object(i).unwrap());
    }
    assert_eq!(inspect(far, true).unwrap(), inspect(here, true).unwrap());
}

#[test]
fn shards_are_the_same_far_away_as_here() {
    assert_same_as_here(&Store::in_memory());
}

/// With `FREERANGE_TEST_STORE=s3://bucket/empty-prefix` or gs://... and credentials in the environment.
#[test]
#[ignore = "needs FREERANGE_TEST_STORE"]
fn shards_are_the_same_in_a_bucket() {
    assert_same_as_here(&Store::open(&std::env::var("FREERANGE_TEST_STORE").unwrap()).unwrap());
}

#[test]
fn shards_are_read_over_http() {
    let folder = tempfile::tempdir().unwrap();
    let here = Store::local(folder.path());
    build_toys(&here);
    let url = serve(folder.path().to_path_buf());
    let far = Store::open(&format!("{url}/shards")).unwrap();
    assert_readable(&far, &here);
    assert!(far.read("none.json", 10).unwrap().is_none());
    std::fs::write(folder.path().join("shard-00001.tar"), b"short").unwrap();
    assert!(inspect(&far, false).unwrap_err().to_string().contains("shard-00001.tar"));
}

/// A server on this machine that knows HEAD, GET and single ranges, and ends with the process.
fn serve(folder: PathBuf) -> String {
    use std::io::{BufRead, BufReader};
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            let mut lines = BufReader::new(stream.try_clone().unwrap()).lines();
            let request: Vec<String> =
                lines.by_ref().map_while(Result::ok).take_while(|line| !line.is_empty()).collect();
            let Some(mut words) = request.first().map(|l| l.split(' ')) else { continue };
            let (method, path) = (words.next().unwrap(), words.next().unwrap());
            let bytes = path.strip_prefix("/shards/").and_then(|name| std::fs::read(folder.join(name)).ok());
            let range = request.iter().find_map(|l| {
                let (from, to) = l
                    .to_ascii_lowercase()
                    .strip_prefix("range: bytes=")?
                    .split_once('-')
                    .map(|(a, b)| (a.to_owned(), b.to_owned()))?;
                Some((from.parse::<usize>().ok()?, to.parse::<usize>().ok()?))
            });
            let (status, part, all) = match (&bytes, range) {
                (None, _) => ("404 Not Found", &[][..], 0),
                (Some(b), Some((from, to))) if from < b.len() => {
                    ("206 Partial Content", &b[from..(to + 1).min(b.len())], b.len())
                }
                (Some(b), _) => ("200 OK", &b[..], b.len()),
            };
            let place = range.map_or(String::new(), |(from, _)| {
                format!("Content-Range: bytes {from}-{}/{all}\r\n", from + part.len().max(1) - 1)
            });
            let head = format!(
                "HTTP/1.1 {status}\r\nContent-Length: {}\r\n{place}Last-Modified: Sat, 01 Jan 2022 00:00:00 GMT\r\n\
                 Connection: close\r\n\r\n",
                part.len()
            );
            let _ = stream.write_all(head.as_bytes());
            if method == "GET" {
                let _ = stream.write_all(part);
            }
        }
    });
    format!("http://{address}")
}
