//! The two layers with weights, and where weights come from.
//!
//! Weights keep PyTorch's names and layout (`[out, in]`), so that files need no renaming and no transposition.

use burn::{
    module::{Module, Param},
    tensor::{Device, Tensor, TensorData},
};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal, Uniform};

use crate::{ModelError, compute::Compute, ops};

/// Where the values of a new module come from: random numbers, or a file.
pub(crate) trait Source {
    /// The tensor of this full name.
    fn values(&mut self, name: &str, shape: &[usize], init: Init) -> Result<Vec<f32>, ModelError>;
}

/// How a weight starts when it is not read from a file.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Init {
    Zeros,
    Ones,
    /// Normal with this standard deviation.
    Normal(f32),
    /// Glorot and Bengio 2010: uniform in +-sqrt(6 / (in + out)) for a weight `[out, in]`.
    Xavier,
}

/// Random weights.
pub(crate) struct RandomSource<'a, R: Rng>(pub &'a mut R);

impl<R: Rng> Source for RandomSource<'_, R> {
    fn values(&mut self, _: &str, shape: &[usize], init: Init) -> Result<Vec<f32>, ModelError> {
        let n: usize = shape.iter().product();
        let rng = &mut *self.0;
        Ok(match init {
            Init::Zeros => vec![0.0; n],
            Init::Ones => vec![1.0; n],
            Init::Normal(std) => (0..n).map(|_| std * rng.sample::<f32, _>(StandardNormal)).collect(),
            Init::Xavier => {
                let bound = (6.0 / shape.iter().sum::<usize>() as f32).sqrt();
                let uniform = Uniform::new_inclusive(-bound, bound).expect("a finite bound");
                (0..n).map(|_| uniform.sample(rng)).collect()
            }
        })
    }
}

/// Builds modules from a source, below a name prefix.
pub(crate) struct Builder<'a, S> {
    pub source: &'a mut S,
    pub device: &'a Device,
}

impl<S: Source> Builder<'_, S> {
    pub fn param<const D: usize>(
        &mut self,
        name: &str,
        shape: [usize; D],
        init: Init,
    ) -> Result<Param<Tensor<D>>, ModelError> {
        self.reshaped(name, &shape, shape, init)
    }

    /// A parameter that is stored with other axes, in the same order of values.
    pub fn reshaped<const D: usize>(
        &mut self,
        name: &str,
        stored: &[usize],
        shape: [usize; D],
        init: Init,
    ) -> Result<Param<Tensor<D>>, ModelError> {
        let values = self.source.values(name, stored, init)?;
        Ok(Param::from_tensor(Tensor::from_data(TensorData::new(values, shape), self.device)))
    }

    pub fn linear(&mut self, name: &str, inputs: usize, outputs: usize, init: Init) -> Result<Linear, ModelError> {
        let weight = self.param(&format!("{name}.weight"), [outputs, inputs], init)?;
        Ok(Linear::new(weight, self.param(&format!("{name}.bias"), [outputs], Init::Zeros)?))
    }

    pub fn norm_weight(&mut self, name: &str, width: usize) -> Result<NormWeight, ModelError> {
        Ok(NormWeight { weight: self.param(&format!("{name}.weight"), [width], Init::Ones)? })
    }
}

/// `y = x W^T + b`.
#[derive(Module, Debug)]
pub struct Linear {
    /// `[out, in]`
    pub weight: Param<Tensor<2>>,
    /// `[out]`
    pub bias: Param<Tensor<1>>,
    #[module(skip)]
    compute: Compute,
}

impl Linear {
    pub(crate) fn new(weight: Param<Tensor<2>>, bias: Param<Tensor<1>>) -> Self {
        Self { weight, bias, compute: Compute::F32 }
    }

    pub(crate) fn set_compute(&mut self, compute: Compute) {
        self.compute = compute;
    }

    pub(crate) fn compute(&self) -> Compute {
        self.compute
    }

    /// `[..., in]` to `[..., out]`.
    pub fn forward<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        ops::linear(x, self.weight.val(), self.bias.val(), self.compute)
    }
}

/// The learned factors of an RMS norm.
#[derive(Module, Debug)]
pub struct NormWeight {
    /// `[width]`
    pub weight: Param<Tensor<1>>,
}
