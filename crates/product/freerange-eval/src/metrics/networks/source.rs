//! Weights from the files that the networks' authors publish.

use std::{collections::HashMap, path::Path, path::PathBuf};

use burn::tensor::{Device, Tensor, TensorData, bf16, f16};
use pytorch_reader::{DType, PytorchReader};
use safetensors::{Dtype, SafeTensors};

use crate::metrics::MetricsError;

/// The largest file that is read: several times the largest network here.
const LARGEST_FILE: u64 = 8 << 30;

/// Where a network's weights come from.
pub(crate) trait Source {
    /// The values of the tensor of this name, which must have this shape and be finite.
    fn values(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, MetricsError>;
}

/// A tensor of `source` on a device.
pub(crate) fn tensor<const D: usize>(
    source: &mut impl Source,
    name: &str,
    shape: [usize; D],
    device: &Device,
) -> Result<Tensor<D>, MetricsError> {
    Ok(Tensor::from_data(TensorData::new(source.values(name, &shape)?, shape), device))
}

/// The tensors of a `.safetensors` file or of a file of PyTorch's `torch.save`, by name.
pub(crate) struct TensorFile {
    path: PathBuf,
    tensors: Tensors,
}

/// Shapes and values by name.
type ReadTensors = HashMap<String, (Vec<usize>, Vec<f32>)>;

enum Tensors {
    Read(ReadTensors),
    Lazy(HashMap<String, pytorch_reader::Tensor>),
}

impl TensorFile {
    /// Opens a file; its ending says which kind it is. `key` names the dictionary of the tensors inside a PyTorch file
    /// that holds more than them.
    pub fn open(path: &Path, key: Option<&str>) -> Result<Self, MetricsError> {
        let metadata = std::fs::metadata(path).map_err(|e| MetricsError::io(path, e))?;
        if !metadata.is_file() || metadata.len() > LARGEST_FILE {
            return Err(MetricsError::format(path, "file of weights", "not a regular file of at most 8 GiB"));
        }
        let tensors = if path.extension().is_some_and(|e| e == "safetensors") {
            Tensors::Read(read_safetensors(path)?)
        } else {
            let reader = match key {
                None => PytorchReader::new(path),
                Some(key) => PytorchReader::with_top_level_key(path, key),
            };
            Tensors::Lazy(reader.map_err(|e| MetricsError::format(path, "PyTorch file", e))?.into_tensors())
        };
        Ok(Self { path: path.to_owned(), tensors })
    }

    /// Names of all tensors, in no particular order.
    pub fn names(&self) -> Vec<&str> {
        match &self.tensors {
            Tensors::Read(tensors) => tensors.keys().map(String::as_str).collect(),
            Tensors::Lazy(tensors) => tensors.keys().map(String::as_str).collect(),
        }
    }

    fn error(&self, name: &str, expected: String, found: String) -> MetricsError {
        MetricsError::Tensor { path: self.path.clone(), tensor: name.to_owned(), expected, found }
    }
}

impl Source for TensorFile {
    fn values(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, MetricsError> {
        let found = match &self.tensors {
            Tensors::Read(tensors) => tensors.get(name).map(|(shape, _)| shape.as_slice()),
            Tensors::Lazy(tensors) => tensors.get(name).map(pytorch_reader::Tensor::shape),
        };
        // The shape first: what is read, and its memory, is then bounded by what the network needs.
        match found {
            None => return Err(self.error(name, format!("of shape {shape:?}"), "missing".to_owned())),
            Some(found) if found != shape => {
                return Err(self.error(name, format!("of shape {shape:?}"), format!("of shape {found:?}")));
            }
            Some(_) => {}
        }
        let values = match &self.tensors {
            Tensors::Read(tensors) => tensors[name].1.clone(),
            Tensors::Lazy(tensors) => {
                let tensor = &tensors[name];
                let bytes = tensor.read().map_err(|e| MetricsError::format(&self.path, "PyTorch file", e))?;
                match tensor.dtype() {
                    DType::F32 => bytes.as_chunks().0.iter().map(|b| f32::from_ne_bytes(*b)).collect(),
                    DType::F64 => bytes.as_chunks().0.iter().map(|b| f64::from_ne_bytes(*b) as f32).collect(),
                    DType::F16 => bytes.as_chunks().0.iter().map(|b| f16::from_ne_bytes(*b).to_f32()).collect(),
                    DType::BF16 => bytes.as_chunks().0.iter().map(|b| bf16::from_ne_bytes(*b).to_f32()).collect(),
                    other => {
                        return Err(self.error(name, "of floating-point numbers".to_owned(), format!("of {other:?}")));
                    }
                }
            }
        };
        finite(values).map_err(|value| self.error(name, "finite".to_owned(), format!("holding {value}")))
    }
}

fn finite(values: Vec<f32>) -> Result<Vec<f32>, f32> {
    match values.iter().find(|v| !v.is_finite()) {
        None => Ok(values),
        Some(&value) => Err(value),
    }
}

fn read_safetensors(path: &Path) -> Result<ReadTensors, MetricsError> {
    let bytes = std::fs::read(path).map_err(|e| MetricsError::io(path, e))?;
    let file = SafeTensors::deserialize(&bytes).map_err(|e| MetricsError::format(path, "safetensors file", e))?;
    let mut out = HashMap::new();
    for (name, view) in file.iter() {
        let bytes = view.data();
        let values = match view.dtype() {
            Dtype::F32 => bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
            Dtype::F64 => bytes.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect(),
            Dtype::F16 => bytes.as_chunks().0.iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect(),
            Dtype::BF16 => bytes.as_chunks().0.iter().map(|b| bf16::from_le_bytes(*b).to_f32()).collect(),
            _ => continue, // counters of batches and the like; missing if a network asks for one
        };
        out.insert(name.to_owned(), (view.shape().to_vec(), values));
    }
    Ok(out)
}
