//! Gaussians that have moved, in the order of a tree of their own, and what belongs to them one by one with them.

use burn::tensor::{Device, Tensor, TensorData};
use freerange_splat::{Alignment, Cloud, LodTree, channel};

use crate::{FlowError, photometric::Photometric, sample::clouds};

/// The Gaussians of a batch as the trees of its objects have them: as those of a fit are given to the network.
pub(crate) struct Reordered {
    clouds: Vec<Cloud>,
    orders: Vec<Vec<usize>>, // which one each of them was
}

impl Reordered {
    /// Of normalised Gaussians, `[b, n, 14]`, `n` a power of two. A GPU is waited for.
    pub(crate) fn new(normalized: Tensor<3>, photometric: &Photometric) -> Result<Self, FlowError> {
        let mut new = Self { clouds: Vec::new(), orders: Vec::new() };
        for cloud in clouds(photometric.denormalize(normalized), 1)?.into_iter().flatten() {
            let tree = LodTree::build(&cloud, Alignment::Identity)?;
            new.clouds.push(tree.slice(tree.depth_max())?);
            new.orders.push(tree.leaf_order().collect());
        }
        Ok(new)
    }

    /// These Gaussians. `[b, n, 14]`
    pub(crate) fn normalized(&self, photometric: &Photometric, device: &Device) -> Tensor<3> {
        photometric.normalize(stacked(&self.clouds, device))
    }

    /// What these Gaussians should be, `[b, n, 14]`, one by one as they were: in their order, with their names of axes.
    pub(crate) fn targets(&self, normalized: Tensor<3>, photometric: &Photometric) -> Result<Tensor<3>, FlowError> {
        let device = normalized.device();
        let targets = clouds(photometric.denormalize(normalized), 1)?.into_iter().flatten();
        let targets = targets
            .zip(&self.orders)
            .zip(&self.clouds)
            .map(|((target, order), own)| target.select(order.iter().copied()).named_like(own));
        Ok(photometric.normalize(stacked(&targets.collect::<Vec<_>>(), &device)))
    }

    /// Rows of any other kind, `[b, n, c]`, one for each of them as they were, in their order.
    pub(crate) fn rows(&self, rows: Tensor<3>) -> Tensor<3> {
        let device = rows.device();
        let each = self.orders.iter().enumerate().map(|(b, order)| {
            let order: Vec<i64> = order.iter().map(|&i| i as i64).collect();
            rows.clone().narrow(0, b, 1).select(1, Tensor::from_data(order.as_slice(), &device))
        });
        Tensor::cat(each.collect(), 0)
    }
}

fn stacked(clouds: &[Cloud], device: &Device) -> Tensor<3> {
    let shape = [clouds.len(), clouds.first().map_or(0, Cloud::len), channel::COUNT];
    let rows: Vec<f32> = clouds.iter().flat_map(|cloud| cloud.rows()).copied().collect();
    Tensor::from_data(TensorData::new(rows, shape), device)
}

#[cfg(test)]
mod tests {
    use super::*;
    use freerange_fit::tree_slice;
    use freerange_splat::Normalization;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const N: usize = 64;

    /// Gaussians of one object in no order, normalised.
    fn example(seed: u64) -> Vec<f32> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        (0..N * channel::COUNT).map(|_| rng.random_range(-1.0..1.0)).collect()
    }

    fn tensor(objects: &[Vec<f32>]) -> Tensor<3> {
        let width = objects[0].len() / N;
        Tensor::from_data(TensorData::new(objects.concat(), [objects.len(), N, width]), &Device::flex())
    }

    fn values(tensor: Tensor<3>) -> Vec<f32> {
        tensor.into_data().try_to_vec().unwrap()
    }

    #[test]
    fn gaussians_are_as_a_tree_has_them_and_what_belongs_to_them_follows() {
        let normalization = Normalization { mean: [0.1; 14], std: std::array::from_fn(|i| 0.5 + 0.1 * i as f32) };
        let device = Device::flex();
        let photometric = Photometric::new(&normalization, &device);
        let objects = [example(1), example(2)];
        let reordered = Reordered::new(tensor(&objects), &photometric).unwrap();
        let found = values(reordered.normalized(&photometric, &device));
        for (object, found) in objects.iter().zip(found.chunks_exact(N * channel::COUNT)) {
            let mut cloud = normalization.denormalize(object);
            cloud.canonicalize_rotations();
            assert_eq!(found, normalization.normalize(&tree_slice(&cloud, N.ilog2()).unwrap()), "as a fit is given");
        }

        // Their own numbers say which they were.
        let numbers: Vec<f32> = (0..N).map(|i| i as f32).collect();
        let numbers = values(reordered.rows(tensor(&[numbers.clone(), numbers])));
        let place = |row: usize| row / N * N + numbers[row] as usize;
        let before = objects.concat();
        let same = |a: f32, b: f32| (a - b).abs() < 1e-5;
        for (row, now) in found.chunks_exact(channel::COUNT).enumerate() {
            let then = &before[place(row) * channel::COUNT..][..channel::COUNT];
            let unnamed = [channel::MEAN, channel::LOGIT_OPACITY..channel::COUNT];
            assert!(unnamed.into_iter().flatten().all(|c| same(now[c], then[c])), "row {row} was {}", place(row));
        }
        // Where they should be themselves, they are; where they should move, each one moves as it should have.
        let targets = values(reordered.targets(tensor(&objects), &photometric).unwrap());
        assert!(targets.iter().zip(&found).all(|(&a, &b)| same(a, b)));
        let along = |i: usize| if i % channel::COUNT == channel::MEAN.start { 0.25 } else { 0.0 };
        let moved = objects.each_ref().map(|object| object.iter().enumerate().map(|(i, x)| x + along(i)).collect());
        let targets = values(reordered.targets(tensor(&moved), &photometric).unwrap());
        let expected = found.iter().enumerate().map(|(i, x)| x + along(i));
        assert!(targets.iter().zip(expected).all(|(&a, b)| same(a, b)));
    }

    #[test]
    fn what_is_no_number_has_no_tree() {
        let device = Device::flex();
        let photometric = Photometric::new(&Normalization { mean: [0.0; 14], std: [1.0; 14] }, &device);
        let mut object = example(3);
        object[17] = f32::NAN;
        assert!(matches!(Reordered::new(tensor(&[object]), &photometric), Err(FlowError::Splat(_))));
    }
}
