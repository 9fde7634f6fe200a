//! Reading tensors from `.safetensors` files that come from anywhere.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

use burn::tensor::{bf16, f16};
use freerange_util::IoError;
use safetensors::{Dtype, SafeTensors};

use crate::{
    ModelError,
    layers::{Init, Source},
};

/// Reads a whole regular file: memory is bounded by its size on disk.
pub(crate) fn read_bounded(path: &Path) -> Result<Vec<u8>, ModelError> {
    let metadata = std::fs::metadata(path).map_err(IoError::at(path))?;
    if !metadata.is_file() {
        return Err(ModelError::format(path, "file", "it is a folder or a device"));
    }
    Ok(std::fs::read(path).map_err(IoError::at(path))?)
}

/// The tensors of a file. As a [`Source`] it gives out values only where name, shape and type fit.
pub(crate) struct TensorFile<'a> {
    path: PathBuf,
    kind: &'static str,
    tensors: SafeTensors<'a>,
    used: BTreeSet<String>,
}

impl<'a> TensorFile<'a> {
    pub fn parse(path: &Path, kind: &'static str, bytes: &'a [u8]) -> Result<Self, ModelError> {
        let tensors = SafeTensors::deserialize(bytes).map_err(|e| ModelError::format(path, kind, e))?;
        Ok(Self { path: path.to_owned(), kind, tensors, used: BTreeSet::new() })
    }

    /// Refuses a file with tensors that nothing asked for: it belongs to another model.
    pub fn check_all_used(&self) -> Result<(), ModelError> {
        match self.tensors.names().into_iter().find(|name| !self.used.contains(*name)) {
            None => Ok(()),
            Some(name) => {
                let reason = format!("tensor `{name}` does not belong to the configured model");
                Err(ModelError::format(&self.path, self.kind, reason))
            }
        }
    }
}

impl Source for TensorFile<'_> {
    fn values(&mut self, name: &str, shape: &[usize], _: Init) -> Result<Vec<f32>, ModelError> {
        let (path, name) = (self.path.clone(), name.to_owned());
        let Ok(view) = self.tensors.tensor(&name) else {
            return Err(ModelError::MissingTensor { path, name, expected: shape.to_vec() });
        };
        if view.shape() != shape {
            return Err(ModelError::Shape { path, name, expected: shape.to_vec(), found: view.shape().to_vec() });
        }
        let bytes = view.data();
        let values: Vec<f32> = match view.dtype() {
            Dtype::F32 => bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
            Dtype::F16 => bytes.as_chunks().0.iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect(),
            Dtype::BF16 => bytes.as_chunks().0.iter().map(|b| bf16::from_le_bytes(*b).to_f32()).collect(),
            other => return Err(ModelError::Dtype { path, name, found: format!("{other:?}") }),
        };
        if values.iter().any(|x| !x.is_finite()) {
            return Err(ModelError::NotFinite { path, name });
        }
        self.used.insert(name);
        Ok(values)
    }
}
