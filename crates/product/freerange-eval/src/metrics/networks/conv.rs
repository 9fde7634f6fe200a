//! Convolution and pooling, in PyTorch's terms.

use burn::tensor::{
    Device, Tensor, TensorData,
    activation::relu,
    module::{avg_pool2d, conv2d, max_pool2d},
    ops::{AvgPoolOptions, ConvOptions, MaxPoolOptions},
};

use super::source::{Source, tensor};
use crate::metrics::MetricsError;

/// A convolution with bias.
#[derive(Clone, Debug)]
pub(crate) struct Conv {
    weight: Tensor<4>, // [out, in, kh, kw]
    bias: Tensor<1>,
    options: ConvOptions<2>,
}

/// The geometry of a convolution.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shape {
    pub inputs: usize,
    pub outputs: usize,
    pub kernel: [usize; 2],
    pub stride: usize,
    pub padding: [usize; 2],
}

impl Shape {
    pub fn new(inputs: usize, outputs: usize, kernel: usize, stride: usize, padding: usize) -> Self {
        Self { inputs, outputs, kernel: [kernel; 2], stride, padding: [padding; 2] }
    }

    fn options(&self) -> ConvOptions<2> {
        ConvOptions::new([self.stride; 2], self.padding, [1, 1], 1)
    }

    fn weight(&self) -> [usize; 4] {
        [self.outputs, self.inputs, self.kernel[0], self.kernel[1]]
    }
}

impl Conv {
    /// `NAME.weight` and `NAME.bias`.
    pub fn load(source: &mut impl Source, name: &str, shape: Shape, device: &Device) -> Result<Self, MetricsError> {
        Ok(Self {
            weight: tensor(source, &format!("{name}.weight"), shape.weight(), device)?,
            bias: tensor(source, &format!("{name}.bias"), [shape.outputs], device)?,
            options: shape.options(),
        })
    }

    /// `NAME.conv.weight` without bias, followed by the batch norm `NAME.bn` as in inference, both folded into one
    /// convolution.
    pub fn load_normed(
        source: &mut impl Source,
        name: &str,
        shape: Shape,
        epsilon: f64,
        device: &Device,
    ) -> Result<Self, MetricsError> {
        let mut weight = source.values(&format!("{name}.conv.weight"), &shape.weight())?;
        let mut norm = |part: &str| source.values(&format!("{name}.bn.{part}"), &[shape.outputs]);
        let (scale, shift) = (norm("weight")?, norm("bias")?);
        let (mean, variance) = (norm("running_mean")?, norm("running_var")?);
        let mut bias = Vec::with_capacity(shape.outputs);
        for (i, filter) in weight.chunks_exact_mut(shape.inputs * shape.kernel[0] * shape.kernel[1]).enumerate() {
            let factor = f64::from(scale[i]) / (f64::from(variance[i]) + epsilon).sqrt();
            filter.iter_mut().for_each(|w| *w = (f64::from(*w) * factor) as f32);
            bias.push((f64::from(shift[i]) - f64::from(mean[i]) * factor) as f32);
        }
        Ok(Self {
            weight: Tensor::from_data(TensorData::new(weight, shape.weight()), device),
            bias: Tensor::from_data(TensorData::new(bias, [shape.outputs]), device),
            options: shape.options(),
        })
    }

    /// Convolution without activation.
    pub fn linear(&self, x: Tensor<4>) -> Tensor<4> {
        conv2d(x, self.weight.clone(), Some(self.bias.clone()), self.options.clone())
    }

    /// Convolution and ReLU.
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        relu(self.linear(x))
    }
}

pub(crate) fn max_pool(x: Tensor<4>, kernel: usize, stride: usize, padding: usize) -> Tensor<4> {
    let options = MaxPoolOptions::new([kernel; 2]).with_stride([stride; 2]).with_padding([padding; 2]);
    max_pool2d(x, options)
}

/// Mean over 3 x 3 pixels, of those inside the image.
pub(crate) fn average_3x3(x: Tensor<4>) -> Tensor<4> {
    let options = AvgPoolOptions::new([3, 3]).with_stride([1, 1]).with_padding([1, 1]).with_count_include_pad(false);
    avg_pool2d(x, options)
}
