//! Time of calls that were waited for.

use std::time::Instant;

use burn::tensor::{Device, Distribution, FloatDType, Tensor};
use freerange_model::Compute;

use crate::error::CliError;

/// Times calls on a device.
pub struct Timer {
    /// Where.
    pub device: Device,
    /// How long to measure.
    pub seconds: f64,
}

impl Timer {
    /// Median seconds of a call, after two that compile kernels and choose between them.
    pub fn time<T>(&self, mut call: impl FnMut() -> Result<T, CliError>) -> Result<f64, CliError> {
        for _ in 0..2 {
            call()?;
            self.wait()?;
        }
        let (begin, mut times) = (Instant::now(), Vec::new());
        while times.len() < 3 || (times.len() < 200 && begin.elapsed().as_secs_f64() < self.seconds) {
            let start = Instant::now();
            let kept = call()?;
            self.wait()?;
            times.push(start.elapsed().as_secs_f64());
            drop(kept);
        }
        times.sort_by(f64::total_cmp);
        Ok(times[times.len() / 2])
    }

    /// Waits until the device has done everything.
    pub fn wait(&self) -> Result<(), CliError> {
        self.device.sync().map_err(|e| CliError::failure(format!("the device failed: {e:?}")))
    }

    /// TFLOP/s of a large matrix product.
    pub fn peak(&self, compute: Compute, gpu: bool) -> Result<f64, CliError> {
        let n = if gpu { 8192 } else { 1024 };
        let random = || {
            let x = Tensor::<2>::random([n, n], Distribution::Default, &self.device);
            match compute {
                Compute::F32 | Compute::Auto => x,
                Compute::Bf16 => x.cast(FloatDType::BF16),
                Compute::F16 => x.cast(FloatDType::F16),
            }
        };
        let (a, b) = (random(), random());
        let seconds = self.time(|| Ok(a.clone().matmul(b.clone())))?;
        Ok(2.0 * (n as f64).powi(3) / seconds / 1e12)
    }
}
