//! Tests against the golden vectors, and of the fused operations against their readable twins.

mod block;
mod checkpoint;
mod dinov2;
mod dit;
mod encoder;
mod ops;

use std::collections::BTreeMap;

use burn::tensor::{Device, Tensor, TensorData};

use crate::Compute;

/// The CPU and, with a feature for GPUs, the default one. That there is none makes tests fail.
pub fn devices() -> Vec<Device> {
    #[cfg(feature = "gpu")]
    return vec![Device::flex(), gpu()];
    #[cfg(not(feature = "gpu"))]
    vec![Device::flex()]
}

/// The GPU with each half precision that it has.
pub fn half_devices() -> Vec<(Device, Compute)> {
    #[cfg(not(feature = "gpu"))]
    return Vec::new();
    #[cfg(feature = "gpu")]
    [Compute::Bf16, Compute::F16]
        .into_iter()
        .filter(|compute| {
            let supported = compute.supported(&gpu());
            if !supported {
                eprintln!("not tested: {:?} does not compute in {compute:?}", gpu());
            }
            supported
        })
        .map(|compute| (gpu(), compute))
        .collect()
}

#[cfg(feature = "gpu")]
pub fn gpu() -> Device {
    #[cfg(feature = "cuda")]
    return Device::cuda(0);
    #[cfg(all(feature = "vulkan", not(feature = "cuda")))]
    return Device::vulkan(burn::tensor::DeviceKind::DefaultDevice);
    #[cfg(all(feature = "metal", not(any(feature = "cuda", feature = "vulkan"))))]
    return Device::metal(burn::tensor::DeviceKind::DefaultDevice);
    #[cfg(all(feature = "webgpu", not(any(feature = "cuda", feature = "vulkan", feature = "metal"))))]
    return Device::wgpu(burn::tensor::DeviceKind::DefaultDevice);
    #[cfg(not(any(feature = "cuda", feature = "vulkan", feature = "metal", feature = "webgpu")))]
    panic!("the feature `gpu` alone reaches no device: choose cuda, vulkan, metal or webgpu");
}

/// The tensors of a golden file, as f32.
pub struct Golden(BTreeMap<String, (Vec<usize>, Vec<f32>)>);

impl Golden {
    pub fn read(file: &str) -> Self {
        let bytes = std::fs::read(path(file)).unwrap();
        let tensors = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        let read = |view: &safetensors::tensor::TensorView<'_>| {
            assert_eq!(view.dtype(), safetensors::Dtype::F32);
            view.data().as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
        };
        Self(tensors.iter().map(|(name, view)| (name.to_owned(), (view.shape().to_vec(), read(&view)))).collect())
    }

    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.0.keys().map(String::as_str)
    }

    pub fn tensor<const D: usize>(&self, name: &str, device: &Device) -> Tensor<D> {
        let (shape, values) = self.0.get(name).unwrap_or_else(|| panic!("no golden tensor `{name}`"));
        Tensor::from_data(TensorData::new(values.clone(), shape.clone()), device)
    }

    /// Holds `found` to the golden tensor, within `tolerance` of its largest value.
    pub fn check<const D: usize>(&self, name: &str, found: Tensor<D>, tolerance: f32) {
        let (shape, values) = self.0.get(name).unwrap_or_else(|| panic!("no golden tensor `{name}`"));
        assert_eq!(found.dims().to_vec(), *shape, "{name}");
        assert_close(name, &numbers(found), values, tolerance);
    }

    /// Holds `found` to the golden tensor, within `tolerance`.
    pub fn check_absolute<const D: usize>(&self, name: &str, found: Tensor<D>, tolerance: f32) {
        let largest = self.0[name].1.iter().fold(1e-6f32, |m, x| m.max(x.abs()));
        self.check(name, found, tolerance / largest);
    }
}

/// A file among the golden vectors.
pub fn path(file: &str) -> std::path::PathBuf {
    std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden")).join(file)
}

pub fn numbers<const D: usize>(t: Tensor<D>) -> Vec<f32> {
    t.into_data().convert::<f32>().try_into_vec::<f32>().unwrap()
}

/// Holds every value to the expected one, within `tolerance` of the largest expected one.
pub fn assert_close(name: &str, found: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(found.len(), expected.len(), "{name}");
    let largest = expected.iter().fold(1e-6f32, |m, x| m.max(x.abs()));
    let error = found.iter().zip(expected).fold(0f32, |m, (a, b)| m.max((a - b).abs()));
    assert!(error <= tolerance * largest, "{name}: off by {error} of {largest}");
    assert!(found.iter().all(|x| x.is_finite()), "{name} is not finite");
}
