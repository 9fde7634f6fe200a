//! Reads `tests/golden`, the vectors of independent references. For tests alone: whatever is wrong with a file panics.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use half::f16;
use safetensors::{Dtype, SafeTensors};
use serde_json::Value;

/// The file `name` among the vectors, as in `dit/pieces.safetensors`.
pub fn path(name: &str) -> PathBuf {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../golden")).join(name)
}

/// What the JSON file `name` among the vectors says.
pub fn json(name: &str) -> Value {
    json_at(&path(name))
}

/// What a JSON file says.
pub fn json_at(path: &Path) -> Value {
    let text = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    serde_json::from_slice(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The tensors of a file.
#[derive(Clone, Debug)]
pub struct Vectors(BTreeMap<String, (Vec<usize>, Numbers)>);

/// Of one tensor, row-major.
#[derive(Clone, Debug)]
enum Numbers {
    Floats(Vec<f32>),
    Ints(Vec<i32>),
    Bytes(Vec<u8>),
}

impl Vectors {
    /// The file `name` among the vectors, as in `dit/pieces.safetensors`.
    pub fn read(name: &str) -> Self {
        Self::open(&path(name))
    }

    /// A file of F32, F16 (read as f32), I32, U8 and BOOL.
    pub fn open(path: &Path) -> Self {
        let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let file = SafeTensors::deserialize(&bytes).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let read = |(name, view): (&str, safetensors::tensor::TensorView<'_>)| {
            let data = view.data();
            let numbers = match view.dtype() {
                Dtype::F32 => Numbers::Floats(data.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect()),
                Dtype::F16 => {
                    Numbers::Floats(data.as_chunks().0.iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect())
                }
                Dtype::I32 => Numbers::Ints(data.as_chunks().0.iter().map(|b| i32::from_le_bytes(*b)).collect()),
                Dtype::U8 | Dtype::BOOL => Numbers::Bytes(data.to_vec()),
                other => panic!("{}: `{name}` is of {other:?}", path.display()),
            };
            (name.to_owned(), (view.shape().to_vec(), numbers))
        };
        Self(file.iter().map(read).collect())
    }

    /// The names of all tensors, in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.0.keys().map(String::as_str)
    }

    /// Whether there is such a tensor.
    pub fn has(&self, name: &str) -> bool {
        self.0.contains_key(name)
    }

    /// The shape of a tensor.
    pub fn shape(&self, name: &str) -> &[usize] {
        &self.get(name).0
    }

    /// The numbers of a tensor of floats.
    pub fn floats(&self, name: &str) -> &[f32] {
        match &self.get(name).1 {
            Numbers::Floats(values) => values,
            other => panic!("`{name}` is no tensor of floats: {other:?}"),
        }
    }

    /// The numbers of a tensor of floats, in 64 bits.
    pub fn doubles(&self, name: &str) -> Vec<f64> {
        self.floats(name).iter().map(|x| f64::from(*x)).collect()
    }

    /// The numbers of a tensor of I32.
    pub fn ints(&self, name: &str) -> &[i32] {
        match &self.get(name).1 {
            Numbers::Ints(values) => values,
            other => panic!("`{name}` is no tensor of integers: {other:?}"),
        }
    }

    /// The numbers of a tensor of U8 or BOOL.
    pub fn bytes(&self, name: &str) -> &[u8] {
        match &self.get(name).1 {
            Numbers::Bytes(values) => values,
            other => panic!("`{name}` is no tensor of bytes: {other:?}"),
        }
    }

    fn get(&self, name: &str) -> &(Vec<usize>, Numbers) {
        self.0.get(name).unwrap_or_else(|| panic!("no tensor `{name}`, but {:?}", self.0.keys()))
    }
}

/// Holds every value to the expected one, within `tolerance` of the largest expected one.
#[track_caller]
pub fn assert_close(name: &str, found: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(found.len(), expected.len(), "{name}");
    assert!(found.iter().all(|x| x.is_finite()), "{name} is not finite");
    let largest = expected.iter().fold(1e-12f32, |m, x| m.max(x.abs()));
    let error = found.iter().zip(expected).fold(0f32, |m, (a, b)| m.max((a - b).abs()));
    assert!(error <= tolerance * largest, "{name}: off by {error} of {largest}");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tensors_of_every_kind_are_read() {
        let lod = Vectors::read("lod/tree2.safetensors");
        assert_eq!(lod.shape("in/means"), [2, 3]);
        assert_eq!(lod.floats("in/means").len(), 6);
        assert_eq!(lod.ints("tree/parent").len(), 3);
        let picture = Vectors::read("metrics/networks/resize.safetensors");
        let name = picture.names().next().unwrap();
        assert_eq!(picture.bytes(name).len(), picture.shape(name).iter().product::<usize>());
        assert!(json("flow/sampler0.json")["meta"].is_object());
    }

    #[test]
    #[should_panic(expected = "off by 0.5 of 2")]
    fn what_is_not_close_fails() {
        assert_close("x", &[1.0, 2.5], &[1.0, 2.0], 0.2);
    }

    #[test]
    #[should_panic(expected = "not finite")]
    fn what_is_no_number_fails() {
        assert_close("x", &[f32::NAN], &[1.0], 0.2);
    }
}
