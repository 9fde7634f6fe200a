//! Tests against the golden vectors, and of the fused operations against their readable twins.

mod block;
mod checkpoint;
mod dinov2;
mod dit;
mod encoder;
mod one_pass;
mod ops;

use burn::tensor::{Device, Tensor, TensorData};
use freerange_vectors::Vectors;
pub use freerange_vectors::{assert_close, path};

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

/// The tensors of a golden file.
pub struct Golden(Vectors);

impl Golden {
    pub fn read(file: &str) -> Self {
        Self(Vectors::read(file))
    }

    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.0.names()
    }

    pub fn tensor<const D: usize>(&self, name: &str, device: &Device) -> Tensor<D> {
        Tensor::from_data(TensorData::new(self.0.floats(name).to_vec(), self.0.shape(name).to_vec()), device)
    }

    /// Holds `found` to the golden tensor, within `tolerance` of its largest value.
    pub fn check<const D: usize>(&self, name: &str, found: Tensor<D>, tolerance: f32) {
        assert_eq!(found.dims().as_slice(), self.0.shape(name), "{name}");
        assert_close(name, &numbers(found), self.0.floats(name), tolerance);
    }

    /// Holds `found` to the golden tensor, within `tolerance`.
    pub fn check_absolute<const D: usize>(&self, name: &str, found: Tensor<D>, tolerance: f32) {
        let largest = self.0.floats(name).iter().fold(1e-6f32, |m, x| m.max(x.abs()));
        self.check(name, found, tolerance / largest);
    }
}

pub fn numbers<const D: usize>(t: Tensor<D>) -> Vec<f32> {
    t.into_data().convert::<f32>().try_into_vec::<f32>().unwrap()
}
