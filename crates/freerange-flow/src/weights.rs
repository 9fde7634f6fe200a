//! A module's parameters as flat vectors in a fixed order: for moving averages.

use burn::{
    module::{Module, ModuleMapper, ModuleVisitor, Param},
    tensor::Tensor,
};
use freerange_core::sha256;
use rayon::prelude::*;

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
