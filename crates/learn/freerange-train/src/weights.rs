//! A module's parameters as flat vectors in a fixed order: for averages over the steps of a run, and over runs.

use std::path::PathBuf;

use burn::{
    module::{Module, ModuleMapper, ModuleVisitor, Param},
    tensor::Tensor,
};
use freerange_model::Checkpoint;
use freerange_util::{Invalid, sha256};
use rayon::prelude::*;

use crate::TrainError;

/// All float parameters of a module, flattened, in the order in which the module visits them.
#[derive(Clone, Debug)]
pub(crate) struct Weights(pub Vec<Tensor<1>>);

impl Weights {
    /// Copies the parameters out of `module`, without autodiff.
    pub fn of<M: Module>(module: &M) -> Self {
        struct Collect(Vec<Tensor<1>>);
        impl ModuleVisitor for Collect {
            fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
                let value = param.val().inner();
                let len = value.shape().num_elements();
                self.0.push(value.reshape([len]));
            }
        }
        let mut collect = Collect(Vec::new());
        module.visit(&mut collect);
        Self(collect.0)
    }

    /// A checksum of all bits.
    pub fn checksum(&self) -> String {
        let all: Vec<_> = self.0.iter().map(|w| w.to_data()).collect();
        // Of each tensor's, which are made at the same time.
        let each: Vec<String> = all.par_iter().map(|data| sha256(data.as_bytes())).collect();
        sha256(each.concat().as_bytes())
    }

    /// Puts the values into a module of the same structure.
    pub fn apply<M: Module>(&self, module: M) -> M {
        struct Set(std::vec::IntoIter<Tensor<1>>);
        impl ModuleMapper for Set {
            fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
                let value = self.0.next().expect("as many values as parameters");
                param.map(|old| {
                    let (shape, tracked) = (old.shape(), old.is_require_grad());
                    let new = value.reshape(shape);
                    if old.is_autodiff() { new.autodiff().set_require_grad(tracked) } else { new }
                })
            }
        }
        module.map(&mut Set(self.0.clone().into_iter()))
    }
}

/// The mean of checkpoints, weight by weight. Of runs that began with the same trained weights and saw other batches it is
/// often better than any one of them (Wortsman et al. 2022, "Model soups" and "lo-fi"): training on several machines
/// that never speak to each other. What else a checkpoint holds is the first one's; its provenance names all files.
///
/// # Errors
/// [`TrainError::Config`] where there is none, or where one differs from the first in its architecture, its tree depth or
/// in how its Gaussians were normalized; names the file.
pub fn average(checkpoints: Vec<(PathBuf, Checkpoint)>) -> Result<Checkpoint, TrainError> {
    let names: Vec<String> = checkpoints.iter().map(|(path, _)| path.display().to_string()).collect();
    let count = checkpoints.len() as f32;
    let mut all = checkpoints.into_iter();
    let Some((_, mut mean)) = all.next() else {
        return Err(Invalid::new("checkpoints", "at least one", "none").into());
    };
    let mut sums = Weights::of(&mean.model).0;
    let mut squares = mean.gradient_rms.map(|x| x * x);
    for ((_, other), name) in all.zip(&names[1..]) {
        let alike = |same: bool, what: &str| match same {
            true => Ok(()),
            false => Err(Invalid::new(format!("{name}: {what}"), format!("that of {}", names[0]), "another one")),
        };
        alike(other.config.architecture() == mean.config.architecture(), "architecture")?;
        alike(other.depth == mean.depth, "depth of the tree")?;
        alike(other.normalization == mean.normalization, "normalization of Gaussians")?;
        for (sum, weights) in sums.iter_mut().zip(Weights::of(&other.model).0) {
            *sum = sum.clone() + weights;
        }
        squares.iter_mut().zip(other.gradient_rms).for_each(|(sum, x)| *sum += x * x);
    }
    let means = Weights(sums.into_iter().map(|sum| sum / count).collect());
    mean.model = means.apply(mean.model);
    mean.gradient_rms = squares.map(|sum| (sum / count).sqrt());
    if let Some(provenance) = mean.provenance.as_object_mut() {
        provenance.insert("averaged".into(), names.into());
    }
    Ok(mean)
}
