//! A module's parameters as flat vectors in a fixed order: for moving averages and global norms.

use burn::{
    module::{Module, ModuleMapper, ModuleVisitor, Param},
    optim::GradientsParams,
    tensor::{Device, Tensor},
};

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

    /// Moves towards `other`: `self <- decay self + (1 - decay) other`.
    pub fn average(&mut self, other: &Self, decay: f32) {
        for (mine, theirs) in self.0.iter_mut().zip(&other.0) {
            *mine = mine.clone() + (theirs.clone() - mine.clone()).mul_scalar(1.0 - decay);
        }
    }
}

/// The joint Euclidean norm of all gradients. `[1]`, on the device.
pub(crate) fn global_norm<M: Module>(gradients: &GradientsParams, module: &M, device: &Device) -> Tensor<1> {
    struct Sum<'a>(&'a GradientsParams, Tensor<1>);
    impl ModuleVisitor for Sum<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if let Some(g) = self.0.get::<D>(param.id) {
                self.1 = self.1.clone() + g.square().sum();
            }
        }
    }
    let mut sum = Sum(gradients, Tensor::zeros([1], &device.clone().inner()));
    module.visit(&mut sum);
    sum.1.sqrt()
}

/// Multiplies all gradients by `factor`.
pub(crate) fn scale<M: Module>(gradients: &mut GradientsParams, module: &M, factor: f32) {
    struct Scale<'a>(&'a mut GradientsParams, f32);
    impl ModuleVisitor for Scale<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if let Some(g) = self.0.remove::<D>(param.id) {
                self.0.register(param.id, g.mul_scalar(self.1));
            }
        }
    }
    module.visit(&mut Scale(gradients, factor));
}
