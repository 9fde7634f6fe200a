//! Gradients of all parameters of a module, flat, and their joint norm.

use burn::{
    module::{Module, ModuleVisitor, Param},
    tensor::{Device, Gradients, Tensor, TensorData},
};
use multiversion::multiversion;
use rayon::prelude::*;

/// Numbers per piece of work; fixed, so that sums do not depend on the number of threads.
pub(crate) const PIECE: usize = 1 << 14;

/// The gradient of each of a module's parameters in the order in which the module visits them, flat; none where none
/// reached it.
pub(crate) struct Flat(pub Vec<Option<Tensor<1>>>);

impl Flat {
    pub fn of<M: Module>(gradients: &mut Gradients, module: &M) -> Self {
        struct Collect<'a>(&'a mut Gradients, Vec<Option<Tensor<1>>>);
        impl ModuleVisitor for Collect<'_> {
            fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
                let gradient = param.val().grad_remove(self.0);
                self.1.push(gradient.map(|g| {
                    let len = g.shape().num_elements();
                    g.reshape([len])
                }));
            }
        }
        let mut collect = Collect(gradients, Vec::new());
        module.visit(&mut collect);
        Self(collect.1)
    }

    /// All values, one parameter after the other.
    #[cfg(test)]
    pub fn values(&self) -> Vec<f32> {
        let values = |g: &Tensor<1>| g.clone().into_data().try_to_vec::<f32>().expect("f32");
        self.0.iter().flatten().flat_map(values).collect()
    }

    /// The sum with those of another part of the batch.
    pub fn add(self, other: Self) -> Self {
        let both = self.0.into_iter().zip(other.0).map(|pair| match pair {
            (Some(a), Some(b)) => Some(a + b),
            (a, b) => a.or(b),
        });
        Self(both.collect())
    }

    /// The joint Euclidean norm. `[1]`, on the device.
    pub fn norm(&mut self, device: &Device) -> Tensor<1> {
        let gradients = self.0.iter_mut().flatten();
        if !is_cpu(device) {
            return gradients.fold(Tensor::zeros([1], device), |sum, g| sum + g.clone().square().sum()).sqrt();
        }
        let mut sum = 0f64;
        for g in gradients {
            let data = take(g);
            sum += square_sum(data.as_slice().expect("f32"));
            *g = Tensor::from_data(data, device);
        }
        Tensor::from_floats([sum.sqrt() as f32], device)
    }
}

/// Whether values lie in this process's memory.
pub(crate) fn is_cpu(device: &Device) -> bool {
    *device == Device::flex()
}

/// The values of a tensor on the CPU, which are moved and not copied if no other tensor has them.
pub(crate) fn take(t: &mut Tensor<1>) -> TensorData {
    let device = t.device();
    std::mem::replace(t, Tensor::empty([0], &device)).into_data()
}

/// The sum of squares, in pieces.
fn square_sum(values: &[f32]) -> f64 {
    /// Of one piece, in lanes.
    #[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
    fn piece(values: &[f32]) -> f64 {
        let (whole, rest) = values.as_chunks::<32>();
        let mut lanes = [0f32; 32];
        for x in whole {
            lanes.iter_mut().zip(x).for_each(|(lane, x)| *lane += x * x);
        }
        lanes.iter().map(|&x| f64::from(x)).sum::<f64>() + rest.iter().map(|x| f64::from(x * x)).sum::<f64>()
    }
    // Added in order, whoever has computed them.
    values.par_chunks(PIECE).map(piece).collect::<Vec<f64>>().iter().sum()
}
