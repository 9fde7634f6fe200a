//! Inception-v3 (Szegedy et al. 2015) as FID uses it: the weights of TensorFlow's 2015 graph, in pytorch-fid's file.
//!
//! The graph differs from torchvision's model: average poolings leave the padding out of the mean, and the last block
//! takes the maximum where the paper averages. 1008 classes; only the 2048 pooled features are wanted here.

use std::path::Path;

use burn::tensor::{Device, Tensor};

use super::{
    conv::{Conv, Shape, average_3x3, max_pool},
    source::{Source, TensorFile},
};
use crate::metrics::MetricsError;

/// The network up to its last pooling.
#[derive(Clone, Debug)]
pub struct Inception {
    stem: Vec<Conv>,
    a: Vec<BlockA>,
    b: BlockB,
    c: Vec<BlockC>,
    d: BlockD,
    e: Vec<BlockE>,
}

/// Loads convolutions below a name.
struct Loader<'a, S> {
    source: &'a mut S,
    device: &'a Device,
}

impl<S: Source> Loader<'_, S> {
    fn conv(&mut self, name: &str, shape: Shape) -> Result<Conv, MetricsError> {
        Conv::load_normed(self.source, name, shape, 1e-3, self.device)
    }

    /// A chain `NAME_1`, `NAME_2`, ... of (outputs, kernel, stride); "same" padding where the stride is 1.
    fn chain(
        &mut self,
        name: &str,
        mut inputs: usize,
        steps: &[(usize, [usize; 2], usize)],
    ) -> Result<Chain, MetricsError> {
        let mut out = Vec::new();
        for (i, &(outputs, kernel, stride)) in steps.iter().enumerate() {
            let padding = if stride == 1 { kernel.map(|k| k / 2) } else { [0, 0] };
            let shape = Shape { inputs, outputs, kernel, stride, padding };
            out.push(self.conv(&format!("{name}_{}", i + 1), shape)?);
            inputs = outputs;
        }
        Ok(Chain(out))
    }

    fn pointwise(&mut self, name: &str, inputs: usize, outputs: usize) -> Result<Conv, MetricsError> {
        self.conv(name, Shape::new(inputs, outputs, 1, 1, 0))
    }
}

#[derive(Clone, Debug)]
struct Chain(Vec<Conv>);

impl Chain {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        self.0.iter().fold(x, |x, conv| conv.forward(x))
    }
}

/// A pointwise convolution of 3 x 3 means. The two commute (the mean's weights sum to one), and the mean of the fewer
/// outputs is cheaper.
fn pooled(conv: &Conv, x: Tensor<4>) -> Tensor<4> {
    burn::tensor::activation::relu(average_3x3(conv.linear(x)))
}

const SQUARE_1: [usize; 2] = [1, 1];
const SQUARE_3: [usize; 2] = [3, 3];
const SQUARE_5: [usize; 2] = [5, 5];
const ROW_3: [usize; 2] = [1, 3];
const ROW_7: [usize; 2] = [1, 7];
const COLUMN_3: [usize; 2] = [3, 1];
const COLUMN_7: [usize; 2] = [7, 1];

#[derive(Clone, Debug)]
struct BlockA {
    one: Conv,
    five: Chain,
    three: Chain,
    pool: Conv,
}

impl BlockA {
    fn load<S: Source>(l: &mut Loader<'_, S>, name: &str, inputs: usize, pool: usize) -> Result<Self, MetricsError> {
        let three = [(64, SQUARE_1, 1), (96, SQUARE_3, 1), (96, SQUARE_3, 1)];
        Ok(Self {
            one: l.pointwise(&format!("{name}.branch1x1"), inputs, 64)?,
            five: l.chain(&format!("{name}.branch5x5"), inputs, &[(48, SQUARE_1, 1), (64, SQUARE_5, 1)])?,
            three: l.chain(&format!("{name}.branch3x3dbl"), inputs, &three)?,
            pool: l.pointwise(&format!("{name}.branch_pool"), inputs, pool)?,
        })
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let parts = vec![
            self.one.forward(x.clone()),
            self.five.forward(x.clone()),
            self.three.forward(x.clone()),
            pooled(&self.pool, x),
        ];
        Tensor::cat(parts, 1)
    }
}

#[derive(Clone, Debug)]
struct BlockB {
    three: Conv,
    double: Chain,
}

impl BlockB {
    fn load<S: Source>(l: &mut Loader<'_, S>, name: &str) -> Result<Self, MetricsError> {
        let double = [(64, SQUARE_1, 1), (96, SQUARE_3, 1), (96, SQUARE_3, 2)];
        Ok(Self {
            three: l.conv(&format!("{name}.branch3x3"), Shape::new(288, 384, 3, 2, 0))?,
            double: l.chain(&format!("{name}.branch3x3dbl"), 288, &double)?,
        })
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        Tensor::cat(vec![self.three.forward(x.clone()), self.double.forward(x.clone()), max_pool(x, 3, 2, 0)], 1)
    }
}

#[derive(Clone, Debug)]
struct BlockC {
    one: Conv,
    seven: Chain,
    double: Chain,
    pool: Conv,
}

impl BlockC {
    fn load<S: Source>(l: &mut Loader<'_, S>, name: &str, width: usize) -> Result<Self, MetricsError> {
        let seven = [(width, SQUARE_1, 1), (width, ROW_7, 1), (192, COLUMN_7, 1)];
        let double =
            [(width, SQUARE_1, 1), (width, COLUMN_7, 1), (width, ROW_7, 1), (width, COLUMN_7, 1), (192, ROW_7, 1)];
        Ok(Self {
            one: l.pointwise(&format!("{name}.branch1x1"), 768, 192)?,
            seven: l.chain(&format!("{name}.branch7x7"), 768, &seven)?,
            double: l.chain(&format!("{name}.branch7x7dbl"), 768, &double)?,
            pool: l.pointwise(&format!("{name}.branch_pool"), 768, 192)?,
        })
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let parts = vec![
            self.one.forward(x.clone()),
            self.seven.forward(x.clone()),
            self.double.forward(x.clone()),
            pooled(&self.pool, x),
        ];
        Tensor::cat(parts, 1)
    }
}

#[derive(Clone, Debug)]
struct BlockD {
    three: Chain,
    seven: Chain,
}

impl BlockD {
    fn load<S: Source>(l: &mut Loader<'_, S>, name: &str) -> Result<Self, MetricsError> {
        let seven = [(192, SQUARE_1, 1), (192, ROW_7, 1), (192, COLUMN_7, 1), (192, SQUARE_3, 2)];
        Ok(Self {
            three: l.chain(&format!("{name}.branch3x3"), 768, &[(192, SQUARE_1, 1), (320, SQUARE_3, 2)])?,
            seven: l.chain(&format!("{name}.branch7x7x3"), 768, &seven)?,
        })
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        Tensor::cat(vec![self.three.forward(x.clone()), self.seven.forward(x.clone()), max_pool(x, 3, 2, 0)], 1)
    }
}

#[derive(Clone, Debug)]
struct BlockE {
    one: Conv,
    three: Conv,
    three_split: [Conv; 2],
    double: Chain,
    double_split: [Conv; 2],
    pool: Conv,
    /// Whether the pooling takes the maximum.
    maximum: bool,
}

impl BlockE {
    fn load<S: Source>(l: &mut Loader<'_, S>, name: &str, inputs: usize, maximum: bool) -> Result<Self, MetricsError> {
        let name = |part: &str| format!("{name}.{part}");
        let shape =
            |kernel: [usize; 2]| Shape { inputs: 384, outputs: 384, kernel, stride: 1, padding: kernel.map(|k| k / 2) };
        Ok(Self {
            one: l.pointwise(&name("branch1x1"), inputs, 320)?,
            three: l.pointwise(&name("branch3x3_1"), inputs, 384)?,
            three_split: [
                l.conv(&name("branch3x3_2a"), shape(ROW_3))?,
                l.conv(&name("branch3x3_2b"), shape(COLUMN_3))?,
            ],
            double: l.chain(&name("branch3x3dbl"), inputs, &[(448, SQUARE_1, 1), (384, SQUARE_3, 1)])?,
            double_split: [
                l.conv(&name("branch3x3dbl_3a"), shape(ROW_3))?,
                l.conv(&name("branch3x3dbl_3b"), shape(COLUMN_3))?,
            ],
            pool: l.pointwise(&name("branch_pool"), inputs, 192)?,
            maximum,
        })
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let mut parts = vec![self.one.forward(x.clone())];
        let three = self.three.forward(x.clone());
        parts.extend(self.three_split.iter().map(|conv| conv.forward(three.clone())));
        let double = self.double.forward(x.clone());
        parts.extend(self.double_split.iter().map(|conv| conv.forward(double.clone())));
        parts.push(if self.maximum { self.pool.forward(max_pool(x, 3, 1, 1)) } else { pooled(&self.pool, x) });
        Tensor::cat(parts, 1)
    }
}

impl Inception {
    /// Width of the features.
    pub const WIDTH: usize = 2048;

    /// Width and height of the input, in pixels.
    pub const SIDE: usize = 299;

    /// Reads pytorch-fid's `pt_inception-2015-12-05-6726825d.pth`.
    ///
    /// # Errors
    /// Names the file and the tensor that is missing or does not fit.
    pub fn load(path: &Path, device: &Device) -> Result<Self, MetricsError> {
        Self::build(&mut TensorFile::open(path, None)?, device)
    }

    pub(crate) fn build(source: &mut impl Source, device: &Device) -> Result<Self, MetricsError> {
        let l = &mut Loader { source, device };
        let stem = [
            ("Conv2d_1a_3x3", Shape::new(3, 32, 3, 2, 0)),
            ("Conv2d_2a_3x3", Shape::new(32, 32, 3, 1, 0)),
            ("Conv2d_2b_3x3", Shape::new(32, 64, 3, 1, 1)),
            ("Conv2d_3b_1x1", Shape::new(64, 80, 1, 1, 0)),
            ("Conv2d_4a_3x3", Shape::new(80, 192, 3, 1, 0)),
        ];
        Ok(Self {
            stem: stem.into_iter().map(|(name, shape)| l.conv(name, shape)).collect::<Result<_, _>>()?,
            a: vec![
                BlockA::load(l, "Mixed_5b", 192, 32)?,
                BlockA::load(l, "Mixed_5c", 256, 64)?,
                BlockA::load(l, "Mixed_5d", 288, 64)?,
            ],
            b: BlockB::load(l, "Mixed_6a")?,
            c: vec![
                BlockC::load(l, "Mixed_6b", 128)?,
                BlockC::load(l, "Mixed_6c", 160)?,
                BlockC::load(l, "Mixed_6d", 160)?,
                BlockC::load(l, "Mixed_6e", 192)?,
            ],
            d: BlockD::load(l, "Mixed_7a")?,
            e: vec![BlockE::load(l, "Mixed_7b", 1280, false)?, BlockE::load(l, "Mixed_7c", 2048, true)?],
        })
    }

    /// The pooled features of images in -1..1. `[b, 3, 299, 299]` to `[b, 2048]`
    ///
    /// # Panics
    /// If the images are not RGB or too small for the network (75 pixels).
    pub fn features(&self, images: Tensor<4>) -> Tensor<2> {
        let mut x = images;
        for (i, conv) in self.stem.iter().enumerate() {
            if i == 3 {
                x = max_pool(x, 3, 2, 0);
            }
            x = conv.forward(x);
        }
        x = max_pool(x, 3, 2, 0);
        x = self.a.iter().fold(x, |x, block| block.forward(x));
        x = self.b.forward(x);
        x = self.c.iter().fold(x, |x, block| block.forward(x));
        x = self.d.forward(x);
        x = self.e.iter().fold(x, |x, block| block.forward(x));
        let [batch, channels, h, w] = x.dims();
        x.reshape([batch, channels, h * w]).mean_dim(2).reshape([batch, channels])
    }
}
