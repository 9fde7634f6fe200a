//! Shards and records that nobody has checked.

use std::path::{Path, PathBuf};

use freerange_gaussians::channel;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{build_toys, message, metadata_of, open, toy, write_shard};
use crate::build::BuildOptions;
use crate::layout::encode;
use crate::layout::{END, tar_bytes};
use crate::{DataError, ImageFormat, Manifest, ShardReader, Store, inspect};

/// A shard of two toys.
fn shard(folder: &Path) -> (PathBuf, Vec<u8>) {
    let path = folder.join("a.tar");
    write_shard(&path, 1..3, ImageFormat::Png);
    let bytes = std::fs::read(&path).unwrap();
    (path, bytes)
}

/// Opens `bytes` as a shard and reads all of it.
fn read_all(path: &Path, bytes: &[u8]) -> Result<usize, DataError> {
    std::fs::write(path, bytes).unwrap();
    let reader = ShardReader::open(path)?;
    let in_memory = ShardReader::from_bytes(path, bytes.to_vec())?;
    assert_eq!(in_memory.len(), reader.len());
    for i in 0..reader.len() {
        reader.metadata(i)?;
        reader.leaves(i)?;
        reader.read(i, &[2, 3])?;
        in_memory.read(i, &[2, 3])?;
    }
    Ok(reader.len())
}

#[test]
fn cut_off_shards_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (path, bytes) = shard(folder.path());
    assert_eq!(read_all(&path, &bytes).unwrap(), 2);
    for length in (0..bytes.len()).step_by(131).chain([1, 511, 512, 513, bytes.len() - 1]) {
        let found = message(read_all(&path, &bytes[..length]));
        assert!(found.contains("a.tar"), "{found}");
    }
}

#[test]
fn garbage_never_panics() {
    let folder = tempfile::tempdir().unwrap();
    let (path, bytes) = shard(folder.path());
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let noise: Vec<u8> = (0..5000).map(|_| rng.random()).collect();
    assert!(message(read_all(&path, &noise)).contains("not a tar file"));
    let mut refused = 0;
    for _ in 0..500 {
        let mut bytes = bytes.clone();
        for _ in 0..3 {
            let at = rng.random_range(0..bytes.len());
            bytes[at] ^= 1u8 << rng.random_range(0..8);
        }
        refused += u32::from(read_all(&path, &bytes).is_err());
    }
    assert!(refused > 50, "most of a shard this small is structure: {refused}");
}

/// What follows the key in the names of an object's entries, and their bytes.
type Entries = Vec<(String, Vec<u8>)>;

/// A shard of one toy whose entries `change` has changed.
fn with_entries(path: &Path, change: impl FnOnce(&mut Entries)) -> Result<usize, DataError> {
    let object = toy(1);
    let mut entries = encode(&object, None, &metadata_of(&object), ImageFormat::Png, path).unwrap();
    change(&mut entries);
    let mut bytes = tar_bytes(&object.id, &entries, path).unwrap();
    bytes.extend(END);
    read_all(path, &bytes)
}

#[test]
fn messages_name_shard_object_and_entry() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("b.tar");
    let refused = |change: &dyn Fn(&mut Entries), entry: &str, text: &str| {
        let found = message(with_entries(&path, |e| change(e)));
        let place = format!("b.tar: object generated-00000001, entry {entry}: expected ");
        assert!(found.contains(&place) && found.contains(text), "{found}");
    };
    assert_eq!(with_entries(&path, |_| ()).unwrap(), 1);
    refused(&|e| drop(e.remove(0)), "json", "none");
    refused(&|e| drop(e.remove(1)), "cameras.json", "none");
    refused(&|e| drop(e.remove(2)), "gaussians.safetensors", "none");
    refused(&|e| e.truncate(3), "000.webp", "none");
    refused(&|e| drop(e.remove(3)), "001.png", "000.webp");
    refused(&|e| e[4].0 = "001.webp".into(), "001.webp", "001.png");
    refused(&|e| drop(e.pop()), "cameras.json", "1 cameras");
    refused(&|e| e.push(e[0].clone()), "json", "second");
    refused(&|e| e.push(("exe".into(), vec![])), "exe", "002.png");
    let edit = |k: usize, from: &'static str, to: &'static str| {
        move |e: &mut Entries| {
            let text = String::from_utf8(e[k].1.clone()).unwrap();
            assert!(text.contains(from), "{text}");
            e[k].1 = text.replacen(from, to, 1).into();
        }
    };
    refused(&edit(0, "generated-00000001", "generated-00000002"), "json", "generated-00000002");
    refused(&edit(0, "\"seed\"", "\"sead\""), "json", "sead");
    let outside = |e: &mut Entries| {
        let mut metadata: serde_json::Value = serde_json::from_slice(&e[0].1).unwrap();
        metadata["input_fits"] = serde_json::json!([[1], [2]]);
        e[0].1 = serde_json::to_vec(&metadata).unwrap();
    };
    refused(&outside, "json", "[2]");
    refused(&edit(1, "opencv", "opengl"), "cameras.json", "opengl");
    refused(&edit(1, "\"width\":6", "\"width\":0"), "cameras.json", "0 x 4");
    refused(&edit(1, "\"width\":6", "\"width\":4000000000"), "cameras.json", "4000000000 x 4");
    refused(&edit(1, "\"cx\":2.7", "\"cx\":1e999"), "cameras.json", "out of range");
    refused(&edit(1, "\"cx\":2.7", "\"cx\":null"), "cameras.json", "null");
    refused(&|e| e[2].1[0] = 0xff, "gaussians.safetensors", "safetensors");
    refused(&|e| e[2].1.truncate(100), "gaussians.safetensors", "safetensors");
    // The slices in 32 bits come first, then two fits, as they are and target, of four Gaussians in 16 bits each.
    let fits = 4 * 4 * channel::COUNT * 2;
    let nan = |after: usize| {
        move |e: &mut Entries| {
            let end = e[2].1.len() - after;
            e[2].1[end - 4..end].copy_from_slice(&f32::NAN.to_le_bytes());
        }
    };
    refused(&nan(0), "gaussians.safetensors", "input_fit_01_target");
    refused(&nan(fits), "gaussians.safetensors", "depth_03");
    let unnamed = |e: &mut Entries| {
        let at = e[2].1.windows(14).position(|w| w == b"\"input_fit_01\"").unwrap();
        e[2].1[at + 1..at + 13].copy_from_slice(b"input_fit_77");
    };
    refused(&unnamed, "gaussians.safetensors", "input_fit_01");
    let other = |o: &mut Entries, pixels: image::DynamicImage| {
        let mut png = std::io::Cursor::new(Vec::new());
        pixels.write_to(&mut png, image::ImageFormat::Png).unwrap();
        o[4].1 = png.into_inner();
    };
    refused(&|e| e[4].1.truncate(40), "001.png", "PNG");
    refused(&|e| other(e, image::DynamicImage::new_rgba16(6, 4)), "001.png", "Rgba16");
    refused(&|e| other(e, image::DynamicImage::new_rgba8(3000, 3000)), "001.png", "3000 x 3000");
}

/// A tar file of one entry as its header says.
fn single(header: impl FnOnce(&mut tar::Header)) -> Vec<u8> {
    let mut h = tar::Header::new_ustar();
    h.set_path("k.json").unwrap();
    h.set_size(2);
    h.set_entry_type(tar::EntryType::Regular);
    header(&mut h);
    h.set_cksum();
    let mut bytes = h.as_bytes().to_vec();
    bytes.extend_from_slice(b"{}");
    bytes.resize(4 * 512, 0);
    bytes
}

#[test]
fn headers_that_lie_cost_no_memory() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.tar");
    let refused = |bytes: Vec<u8>, text: &str| {
        let found = message(read_all(&path, &bytes));
        assert!(found.contains(text), "{found}");
    };
    refused(single(|_| ()), "cameras.json");
    refused(single(|h| h.set_size(100 << 20)), "cut off");
    refused(single(|h| h.set_size(8 << 30)), "at most");
    refused(single(|h| h.set_size(u64::MAX)), "c.tar");
    refused(single(|h| h.set_entry_type(tar::EntryType::Symlink)), "regular file");
    refused(single(|h| h.set_entry_type(tar::EntryType::GNULongName)), "regular file");
    refused(single(|h| h.set_path("../k.json").unwrap_or_else(|_| h.as_mut_bytes()[0] = b'/')), "KEY.*");
    refused(single(|h| h.set_path("readme").unwrap()), "KEY.*");
}

#[test]
fn manifests_that_do_not_fit_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    assert!(message(open(root, &[2])).contains("expected a folder of shards, found none"));
    build_toys(root, &BuildOptions::default(), |_| Ok(30.0)).unwrap();
    open(root, &[2, 3]).unwrap();
    assert!(message(open(root, &[2, 9])).contains("expected Gaussians at depth 9, found depths [2, 3]"));

    let path = root.join("manifest.json");
    let good = std::fs::read_to_string(&path).unwrap();
    let refused = |from: &str, to: &str, text: &str| {
        assert!(good.contains(from), "{from} in {good}");
        std::fs::write(&path, good.replacen(from, to, 1)).unwrap();
        let found = message(open(root, &[2]));
        assert!(found.contains(text), "{found}");
    };
    refused("{", "", "expected a description");
    refused("\"format\":2", "\"format\":3,\"news\":0", "expected 2, found 3");
    refused("\"config\":{", "\"config\":{\"news\":0,", "plan_sha256");
    refused("\"depths\":", "\"deaths\":", "depths");
    refused("\"depths\":[2,3]", "\"depths\":[3,2]", "plan.depths");
    refused("\"objects\":10", "\"objects\":0", "plan.objects");
    refused("\"objects\":10", "\"objects\":4000000000", "plan_sha256");
    refused("\"index\":1,\"plan", "\"index\":0,\"plan", "shards.index");
    refused("\"index\":1,\"id", "\"index\":0,\"id", "objects.index");
    refused("\"id\":\"generated-00000008\"", "\"id\":\"../x\"", "objects.id");
    refused("\"offset\":0", "\"offset\":512", "objects.offset");
    refused("\"count\":16", "\"count\":17", "statistics of shard 0");
    let record = &serde_json::from_str::<Manifest>(&good).unwrap().shards[0];
    refused(&format!("\"bytes\":{}", record.bytes), "\"bytes\":1", "objects.offset");
    let bytes = format!("\"bytes\":{}", record.objects[0].bytes);
    refused(&bytes, "\"bytes\":18446744073709551615", "objects.offset");
    refused(&format!("\"bytes\":{}", record.bytes), "\"bytes\":9999999", "expected 9999999 bytes");

    std::fs::write(&path, &good).unwrap();
    std::fs::remove_file(root.join("shard-00002.tar")).unwrap();
    assert!(message(open(root, &[2])).contains("shard-00002.tar"));
    std::fs::copy(root.join("shard-00001.tar"), root.join("shard-00002.tar")).unwrap();
    assert!(message(open(root, &[2])).contains("shard-00002.tar"));
}

#[test]
fn checksums_find_what_readers_do_not() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    build_toys(root, &BuildOptions::default(), |_| Ok(30.0)).unwrap();
    let store = Store::local(root);
    inspect(&store, true).unwrap();
    let path = root.join("shard-00001.tar");
    let mut bytes = std::fs::read(&path).unwrap();
    let at = bytes.windows(5).position(|w| w == b"CC0-1").unwrap();
    bytes[at] = b'X';
    std::fs::write(&path, bytes).unwrap();
    inspect(&store, false).unwrap();
    let found = message(inspect(&store, true));
    assert!(found.contains("shard-00001.tar") && found.contains("SHA-256"), "{found}");
}
