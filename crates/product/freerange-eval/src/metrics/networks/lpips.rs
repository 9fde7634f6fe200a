//! LPIPS (Zhang et al. 2018), version 0.1 of the weights, as in the package `lpips` 0.1.4.

use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};

use super::{
    conv::{Conv, Shape, max_pool},
    source::{Source, TensorFile, tensor},
};
use crate::metrics::MetricsError;

/// The network under LPIPS. The original paper recommends AlexNet for evaluation; papers on radiance fields mostly
/// report VGG16. Values of the two are not comparable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LpipsNet {
    /// AlexNet of torchvision.
    Alex,
    /// VGG16 of torchvision.
    Vgg,
}

/// One convolution of a backbone.
struct Layer {
    /// Number in torchvision's `features`.
    index: usize,
    shape: Shape,
    /// Kernel width of a max pooling in steps of 2 before it; 0 for none.
    pool: usize,
    /// Whether its activations are compared.
    tap: bool,
}

impl LpipsNet {
    fn layers(self) -> Vec<Layer> {
        let layer = |index, shape, pool, tap| Layer { index, shape, pool, tap };
        match self {
            Self::Alex => vec![
                layer(0, Shape::new(3, 64, 11, 4, 2), 0, true),
                layer(3, Shape::new(64, 192, 5, 1, 2), 3, true),
                layer(6, Shape::new(192, 384, 3, 1, 1), 3, true),
                layer(8, Shape::new(384, 256, 3, 1, 1), 0, true),
                layer(10, Shape::new(256, 256, 3, 1, 1), 0, true),
            ],
            Self::Vgg => {
                let (mut out, mut index, mut inputs) = (Vec::new(), 0, 3);
                for (stage, (width, count)) in [(64, 2), (128, 2), (256, 3), (512, 3), (512, 3)].into_iter().enumerate()
                {
                    for i in 0..count {
                        let pool = if stage > 0 && i == 0 { 2 } else { 0 };
                        out.push(layer(index, Shape::new(inputs, width, 3, 1, 1), pool, i + 1 == count));
                        inputs = width;
                        index += 2; // the ReLU
                    }
                    index += 1; // the pooling
                }
                out
            }
        }
    }
}

/// The distance with its network.
#[derive(Clone, Debug)]
pub struct Lpips {
    layers: Vec<(Conv, usize, bool)>, // convolution, pooling before it, tap
    heads: Vec<Tensor<2>>,            // [1, channels] each
    scale: Tensor<4>,                 // [1, 3, 1, 1]
    shift: Tensor<4>,
}

impl Lpips {
    /// Reads torchvision's `alexnet-owt-7be5be79.pth` or `vgg16-397923af.pth` (or the same as `.safetensors`) and the
    /// heads, `alex.pth` or `vgg.pth` of the folder `weights/v0.1` of the package `lpips`.
    ///
    /// # Errors
    /// Names the file and the tensor that is missing or does not fit.
    pub fn load(net: LpipsNet, backbone: &Path, heads: &Path, device: &Device) -> Result<Self, MetricsError> {
        let mut heads = TensorFile::open(heads, None)?;
        Self::build(net, &mut TensorFile::open(backbone, None)?, &mut heads, device)
    }

    pub(crate) fn build(
        net: LpipsNet,
        backbone: &mut impl Source,
        heads: &mut impl Source,
        device: &Device,
    ) -> Result<Self, MetricsError> {
        let mut out = Self {
            layers: Vec::new(),
            heads: Vec::new(),
            // The package's own mean and deviation, of images in -1..1.
            shift: row([-0.030, -0.088, -0.188], device),
            scale: row([0.458, 0.448, 0.450], device),
        };
        for layer in net.layers() {
            let conv = Conv::load(backbone, &format!("features.{}", layer.index), layer.shape, device)?;
            out.layers.push((conv, layer.pool, layer.tap));
            if layer.tap {
                let name = format!("lin{}.model.1.weight", out.heads.len());
                let head = tensor(heads, &name, [1, layer.shape.outputs, 1, 1], device)?;
                out.heads.push(head.reshape([1, layer.shape.outputs]));
            }
        }
        Ok(out)
    }

    /// Activations of the compared layers. `images`: `[b, 3, h, w]` in 0..1.
    pub(crate) fn features(&self, images: Tensor<4>) -> Vec<Tensor<4>> {
        let mut x = (images * 2.0 - 1.0 - self.shift.clone()) / self.scale.clone();
        let mut out = Vec::new();
        for (conv, pool, tap) in &self.layers {
            if *pool > 0 {
                x = max_pool(x, *pool, 2, 0);
            }
            x = conv.forward(x);
            if *tap {
                out.push(x.clone());
            }
        }
        out
    }

    /// Activations of the last layer, averaged over its pixels. `images`: `[b, 3, h, w]` in 0..1. `[b, channels]`
    pub(crate) fn deepest(&self, images: Tensor<4>) -> Tensor<2> {
        let deepest = self.features(images).pop().expect("a backbone has layers");
        let [b, channels, h, w] = deepest.dims();
        deepest.reshape([b, channels, h * w]).mean_dim(2).reshape([b, channels])
    }

    /// The distances of `b` pairs of images in 0..1, both `[b, 3, h, w]`; 0 for equal images. `[b]`
    ///
    /// # Panics
    /// If the shapes differ, or `h` or `w` is below [`Metric::smallest_side`](crate::metrics::Metric::smallest_side).
    pub fn distance(&self, first: Tensor<4>, second: Tensor<4>) -> Tensor<1> {
        assert_eq!(first.dims(), second.dims(), "LPIPS compares images of one size");
        // One after the other, not as one batch: equal images then give equal bits.
        let layers = self.features(first).into_iter().zip(self.features(second));
        let distances = layers.zip(&self.heads).map(|((a, b), head)| layer_distance(a, b, head));
        distances.reduce(|sum, x| sum + x).expect("a backbone has layers")
    }
}

/// Weighted squared difference of the unit feature vectors, averaged over the pixels. `[b]`
pub(crate) fn layer_distance(a: Tensor<4>, b: Tensor<4>, head: &Tensor<2>) -> Tensor<1> {
    let [batch, channels, h, w] = a.dims();
    let unit = |x: Tensor<4>| {
        let x = x.reshape([batch, channels, h * w]);
        let norm = (x.clone() * x.clone()).sum_dim(1).sqrt() + 1e-10; // [b, 1, h * w]
        x / norm
    };
    let difference = unit(a) - unit(b);
    let squares = difference.clone() * difference;
    let weighted = head.clone().reshape([1, 1, channels]).repeat_dim(0, batch).matmul(squares); // [b, 1, h * w]
    weighted.mean_dim(2).reshape([batch])
}

fn row(values: [f32; 3], device: &Device) -> Tensor<4> {
    Tensor::from_data(TensorData::new(values.to_vec(), [1, 3, 1, 1]), device)
}
