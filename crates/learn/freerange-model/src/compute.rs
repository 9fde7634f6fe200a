//! In which precision is computed.

use std::fmt;

use burn::tensor::{DType, Device};

/// In which precision the blocks of the transformer compute. Weights, their gradients, the residual stream, sums and
/// statistics are f32 always.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Compute {
    /// In f32.
    #[default]
    F32,
    /// In bf16. On a GPU: operands of products and the activations between them. On a CPU: operands of products on
    /// Intel's tiles (AMX, on Linux) or with AVX-512 BF16 instructions, f32 without either.
    Bf16,
    /// In f16, on GPUs without bf16. For inference: small gradients vanish. On a CPU: f32.
    F16,
    /// In bf16 where the device has it, else in f32: see [`Compute::on`].
    Auto,
}

impl Compute {
    /// Whether a device can compute this way. A CPU takes [`Bf16`](Self::Bf16) as leave to use it where it can, and
    /// has no use for [`F16`](Self::F16).
    pub fn supported(self, device: &Device) -> bool {
        match self {
            Self::F32 | Self::Auto => true,
            Self::Bf16 if is_cpu(device) => true,
            Self::F16 if is_cpu(device) => false,
            Self::Bf16 | Self::F16 => device.supports_dtype(self.dtype()),
        }
    }

    /// The type of activations on a GPU. What is automatic has been [chosen](Self::on) before.
    pub(crate) fn dtype(self) -> DType {
        match self {
            Self::F32 | Self::Auto => DType::F32,
            Self::Bf16 => DType::BF16,
            Self::F16 => DType::F16,
        }
    }
}

/// As configurations name it.
impl fmt::Display for Compute {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::F32 => "f32",
            Self::Bf16 => "bf16",
            Self::F16 => "f16",
            Self::Auto => "auto",
        })
    }
}

/// Whether this is the device of the CPU's kernels.
pub(crate) fn is_cpu(device: &Device) -> bool {
    device.clone().inner() == Device::flex()
}
