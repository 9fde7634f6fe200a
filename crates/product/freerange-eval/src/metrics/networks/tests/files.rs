//! Files that are not what they should be.

use super::golden;
use crate::metrics::{
    MetricsError,
    networks::source::{Source, TensorFile},
};

fn open(bytes: &[u8], name: &str) -> Result<TensorFile, MetricsError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    TensorFile::open(&path, None)
}

#[test]
fn broken_files_are_named() {
    for name in ["x.pth", "x.safetensors"] {
        for bytes in [&b""[..], b"hello", b"PK\x03\x04", &[0xff; 64], b"\x80\x02}q\x00.", b"<html>404</html>"] {
            if let Err(error) = open(bytes, name) {
                assert!(error.to_string().contains(name), "{error}");
            } else {
                // An empty dictionary is a valid pickle; it holds nothing that a network asks for.
                let error = open(bytes, name).unwrap().values("features.0.weight", &[64]).unwrap_err();
                assert!(error.to_string().contains("is missing"), "{error}");
            }
        }
    }
    let folder = tempfile::tempdir().unwrap();
    assert!(TensorFile::open(folder.path(), None).is_err());
    assert!(TensorFile::open(&folder.path().join("none.pth"), None).err().unwrap().to_string().contains("none.pth"));
}

#[test]
fn cut_and_damaged_checkpoints_do_not_panic() {
    let good = std::fs::read(golden("networks/dino.pth")).unwrap();
    let shape = [48, 16];
    let name = "blocks.0.attn.qkv.weight";
    assert_eq!(open(&good, "x.pth").unwrap().values(name, &shape).unwrap().len(), 48 * 16);
    for cut in (0..good.len()).step_by(good.len() / 97) {
        assert!(open(&good[..cut], "x.pth").and_then(|mut f| f.values(name, &shape)).is_err(), "cut at {cut}");
    }
    // Changed bytes either fail or are noticed by nobody (padding, names of other tensors): they must not panic.
    let mut read = 0;
    for at in (0..good.len()).step_by(good.len() / 301) {
        let mut bytes = good.clone();
        bytes[at] ^= 0x5a;
        if let Ok(values) = open(&bytes, "x.pth").and_then(|mut f| f.values(name, &shape)) {
            assert_eq!(values.len(), 48 * 16);
            read += 1;
        }
    }
    assert!(read < 301, "some damage is found");
}

#[test]
fn tensors_must_fit() {
    let mut file = TensorFile::open(&golden("networks/dino.pth"), None).unwrap();
    let error = file.values("blocks.0.attn.qkv.weight", &[16, 48]).unwrap_err().to_string();
    assert!(error.contains("dino.pth") && error.contains("[48, 16]") && error.contains("[16, 48]"), "{error}");
    let error = file.values("blocks.7.attn.qkv.weight", &[48, 16]).unwrap_err().to_string();
    assert!(error.contains("missing"), "{error}");
    let none = TensorFile::open(&golden("networks/clip.pth.tar"), Some("model")).err().unwrap().to_string();
    assert!(none.contains("clip.pth.tar") && none.contains("model"), "{none}");

    let view = |values: [f32; 2]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let bytes = view([1.0, f32::NAN]);
    let tensor = safetensors::tensor::TensorView::new(safetensors::Dtype::F32, vec![2], &bytes).unwrap();
    let bytes = safetensors::serialize([("x", tensor)], None).unwrap();
    let error = open(&bytes, "x.safetensors").unwrap().values("x", &[2]).unwrap_err().to_string();
    assert!(error.contains("NaN"), "{error}");
}
