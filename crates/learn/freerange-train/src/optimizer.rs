//! AdamW (Loshchilov and Hutter 2019), the joint norm of gradients, and the moving average of the weights.
//!
//! On the CPU everything that happens to a parameter in a step happens in one pass over memory: passes are what an
//! optimizer costs.

#[cfg(test)]
mod tests;

use std::path::Path;

use burn::{
    module::{Module, ModuleMapper, Param},
    tensor::{Device, Tensor, TensorData},
};
use freerange_util::IoError;
use multiversion::multiversion;
use rayon::prelude::*;
use safetensors::{Dtype, SafeTensors, tensor::TensorView};

use crate::{
    TrainError,
    config::{Decay, OptimizerConfig},
    flat::{Flat, PIECE, is_cpu, take},
    ranks::{Ranks, from_first, tensor_of_first},
    weights::Weights,
};

/// What is added to the root of the second moment.
const EPSILON: f32 = 1e-8;

/// The optimizer's state.
pub(crate) struct AdamW {
    moments: Vec<Option<[Tensor<1>; 2]>>, // as in `Flat`; none of parameters that never had a gradient
}

/// What a step needs to know besides the gradients.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Step {
    /// Its number, from 1.
    pub time: u64,
    pub rate: f64,
    /// What gradients are multiplied by first.
    pub clip: f32,
    /// Of the average of the weights.
    pub ema: f32,
}

/// A step's numbers for one parameter.
#[derive(Clone, Copy)]
struct Factors {
    clip: f32,
    betas: [f32; 2],
    /// What weights keep.
    keep: f32,
    /// Of the first moment, its correction included.
    rate: f32,
    /// Of the second moment's root: its correction.
    root: f32,
    ema: f32,
}

impl Factors {
    fn new(config: &OptimizerConfig, step: Step, rank: usize) -> Self {
        let betas = [config.betas.0, config.betas.1];
        // Moments start at zero, and are short by this at first.
        let [first, second] = betas.map(|beta| 1.0 - f64::from(beta).powf(step.time as f64));
        let decayed = config.decay == Decay::All || rank >= 2;
        let decay = if decayed { f64::from(config.weight_decay) } else { 0.0 };
        Self {
            clip: step.clip,
            betas,
            keep: (1.0 - step.rate * decay) as f32,
            rate: (step.rate / first) as f32,
            root: second.sqrt().recip() as f32,
            ema: step.ema,
        }
    }
}

impl AdamW {
    /// For a module of so many parameters.
    pub fn new(parameters: usize) -> Self {
        Self { moments: vec![None; parameters] }
    }

    /// The state of rank 0, on every rank.
    pub fn follow_first(&mut self, ranks: &dyn Ranks, weights: &Weights) -> Result<(), TrainError> {
        let present: Vec<u8> = self.moments.iter().map(|m| m.is_some().into()).collect();
        let present = from_first(ranks, &present)?;
        for ((moments, present), w) in self.moments.iter_mut().zip(present).zip(&weights.0) {
            *moments = match (moments.take(), present) {
                (_, 0) => None,
                (own, _) => {
                    let [m, v] = own.unwrap_or_else(|| [w.zeros_like(), w.zeros_like()]);
                    Some([tensor_of_first(ranks, m)?, tensor_of_first(ranks, v)?])
                }
            };
        }
        Ok(())
    }

    /// The module after a step, which `average` follows. A module of which there is no other copy is changed in place.
    pub fn step<M: Module>(
        &mut self,
        module: M,
        gradients: Flat,
        average: &mut Weights,
        config: &OptimizerConfig,
        step: Step,
    ) -> M {
        struct Update<'a, I>(I, &'a OptimizerConfig, Step);
        impl<'a, I> ModuleMapper for Update<'_, I>
        where
            I: Iterator<Item = ((&'a mut Option<[Tensor<1>; 2]>, &'a mut Tensor<1>), Option<Tensor<1>>)>,
        {
            fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
                let ((moments, average), gradient) = self.0.next().expect("as many as parameters");
                let Some(gradient) = gradient else {
                    let weights = param.val().inner();
                    let len = weights.shape().num_elements();
                    follow(average, weights.reshape([len]), self.2.ema);
                    return param;
                };
                let factors = Factors::new(self.1, self.2, D);
                param.map(|old| {
                    let (shape, tracked) = (old.shape(), old.is_require_grad());
                    let weights = old.inner().reshape([shape.num_elements()]);
                    let moments = moments.get_or_insert_with(|| [weights.zeros_like(), weights.zeros_like()]);
                    let update = if is_cpu(&weights.device()) { update_in_place } else { update };
                    let new = update(weights, moments, average, gradient, &factors);
                    new.reshape(shape).autodiff().set_require_grad(tracked)
                })
            }
        }
        let parameters = self.moments.iter_mut().zip(&mut average.0).zip(gradients.0);
        module.map(&mut Update(parameters, config, step))
    }

    /// # Errors
    /// [`TrainError::State`].
    pub fn save(&self, path: &Path) -> Result<(), TrainError> {
        let broken = |problem: String| TrainError::State { path: path.into(), problem };
        let stored: Vec<(String, TensorData)> = self
            .moments
            .iter()
            .enumerate()
            .filter_map(|(i, moments)| Some((i, moments.as_ref()?)))
            .flat_map(|(i, moments)| moments.iter().enumerate().map(move |(j, m)| (format!("{i}.{j}"), m.to_data())))
            .collect();
        let views = stored.iter().map(|(name, data)| {
            let view = TensorView::new(Dtype::F32, data.shape().to_vec(), data.as_bytes());
            (name, view.expect("as many bytes as numbers"))
        });
        safetensors::serialize_to_file(views, None, path).map_err(|e| broken(e.to_string()))
    }

    /// The state that [`save`](Self::save) wrote, for these weights.
    ///
    /// # Errors
    /// [`TrainError::State`], [`TrainError::Io`].
    pub fn load(path: &Path, weights: &Weights, device: &Device) -> Result<Self, TrainError> {
        let broken = |problem: String| TrainError::State { path: path.into(), problem };
        let bytes = std::fs::read(path).map_err(IoError::at(path))?;
        let file = SafeTensors::deserialize(&bytes).map_err(|e| broken(e.to_string()))?;
        let read = |name: String, len: usize| match file.tensor(&name) {
            Ok(t) if t.dtype() == Dtype::F32 && t.shape() == [len] => {
                let values = t.data().as_chunks::<4>().0.iter().map(|x| f32::from_le_bytes(*x)).collect::<Vec<_>>();
                Ok(Tensor::from_data(TensorData::new(values, [len]), device))
            }
            Ok(t) => {
                Err(broken(format!("tensor `{name}`: expected {len} of F32, found {:?} {:?}", t.shape(), t.dtype())))
            }
            Err(e) => Err(broken(format!("tensor `{name}`: {e}"))),
        };
        let moments = weights.0.iter().enumerate().map(|(i, w)| {
            if file.tensor(&format!("{i}.0")).is_err() {
                return Ok(None);
            }
            let len = w.dims()[0];
            Ok(Some([read(format!("{i}.0"), len)?, read(format!("{i}.1"), len)?]))
        });
        Ok(Self { moments: moments.collect::<Result<_, TrainError>>()? })
    }
}

/// New weights; moments and average move along. With the CPU's tensors, in place.
fn update_in_place(
    weights: Tensor<1>,
    moments: &mut [Tensor<1>; 2],
    average: &mut Tensor<1>,
    gradient: Tensor<1>,
    f: &Factors,
) -> Tensor<1> {
    let device = weights.device();
    let (mut weights, gradient) = (weights.into_data(), gradient.into_data());
    let [first, second] = moments;
    let mut state = [&mut *first, &mut *second, &mut *average].map(take);
    {
        fn numbers(data: &mut TensorData) -> rayon::slice::ChunksMut<'_, f32> {
            data.as_mut_slice::<f32>().expect("f32").par_chunks_mut(PIECE)
        }
        let [m, v, e] = state.each_mut().map(numbers);
        let g = gradient.as_slice::<f32>().expect("f32").par_chunks(PIECE);
        numbers(&mut weights).zip(g).zip(m.zip(v)).zip(e).for_each(|(((p, g), (m, v)), e)| pass(p, g, m, v, e, f));
    }
    [*first, *second, *average] = state.map(|data| Tensor::from_data(data, &device));
    Tensor::from_data(weights, &device)
}

/// The same with any device's tensors.
fn update(
    weights: Tensor<1>,
    moments: &mut [Tensor<1>; 2],
    average: &mut Tensor<1>,
    gradient: Tensor<1>,
    f: &Factors,
) -> Tensor<1> {
    let [m, v] = moments;
    let g = gradient.mul_scalar(f.clip);
    *m = m.clone().mul_scalar(f.betas[0]) + g.clone().mul_scalar(1.0 - f.betas[0]);
    *v = v.clone().mul_scalar(f.betas[1]) + g.square().mul_scalar(1.0 - f.betas[1]);
    let change = m.clone().mul_scalar(f.rate) / v.clone().sqrt().mul_scalar(f.root).add_scalar(EPSILON);
    let weights = weights.mul_scalar(f.keep) - change;
    follow(average, weights.clone(), f.ema);
    weights
}

fn follow(average: &mut Tensor<1>, weights: Tensor<1>, decay: f32) {
    *average = average.clone() + (weights - average.clone()).mul_scalar(1.0 - decay);
}

/// What [`update`] does to each number.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn pass(
    weights: &mut [f32],
    gradient: &[f32],
    first: &mut [f32],
    second: &mut [f32],
    average: &mut [f32],
    f: &Factors,
) {
    let numbers = weights.iter_mut().zip(gradient).zip(first.iter_mut().zip(second)).zip(average);
    for (((p, g), (m, v)), e) in numbers {
        let g = f.clip * g;
        *m = f.betas[0] * *m + (1.0 - f.betas[0]) * g;
        *v = f.betas[1] * *v + (1.0 - f.betas[1]) * g * g;
        *p = f.keep * *p - f.rate * *m / (f.root * v.sqrt() + EPSILON);
        *e += (1.0 - f.ema) * (*p - *e);
    }
}
