//! What ranks tell each other in a step: one vector, unless gradients are rounded.

use burn::tensor::{Device, Tensor};

use super::{AllReduceDtype, Ranks};
use crate::{TrainError, flat::Flat};

/// What one rank brings.
pub(crate) struct Own {
    /// Gradients and figures of its objects, each by its share of the batch; none where that failed.
    pub found: Option<(Flat, Tensor<1>)>,
    /// From the beginning of the step until now.
    pub seconds: f64,
    /// Numbers of its virtual ranks, and of the first object of each one's window.
    pub positions: Vec<(usize, u64)>,
    /// Objects of its virtual ranks that could not be read: before those windows, and in all.
    pub broken: [u64; 2],
    /// Whether it is out of time.
    pub stop: bool,
}

/// What all of them know afterwards.
#[derive(Debug)]
pub(crate) struct Agreed {
    /// Parameters that a gradient reached on some rank.
    pub present: Vec<bool>,
    /// [`Own::seconds`], by rank.
    pub seconds: Vec<f32>,
    /// [`Own::positions`], by virtual rank.
    pub positions: Vec<u64>,
    /// Sums of [`Own::broken`].
    pub broken: [u64; 2],
    /// Whether somebody is out of time.
    pub stop: bool,
    /// The first rank that failed.
    pub failed: Option<usize>,
}

/// The places in that vector: first the gradients, one parameter after the other, and then what is looked at on the host:
/// figures, which parameters have a gradient, seconds, positions, unreadable objects, who is out of time, who has failed.
pub(crate) struct Layout {
    /// Numbers of each parameter.
    pub parameters: Vec<usize>,
    /// Number of figures.
    pub figures: usize,
    /// Number of ranks.
    pub world: usize,
    /// Number of virtual ranks of all ranks.
    pub virtual_ranks: usize,
}

/// Whole numbers are told in pieces of so many bits, which 32-bit numbers hold exactly.
const BITS: u32 = 20;
/// So many pieces for one number.
const PIECES: usize = 3;

impl Layout {
    /// The sums over all ranks: gradients of all parameters, and what is to be looked at on the host.
    pub fn sum(
        &self,
        ranks: &dyn Ranks,
        own: Own,
        dtype: AllReduceDtype,
        device: &Device,
    ) -> Result<(Flat, Tensor<1>), TrainError> {
        let mut parts = self.parts(ranks.rank(), own, device);
        let mut sizes: Vec<usize> = parts.iter().map(|part| part.dims()[0]).collect();
        let (gradients, tail) = match dtype {
            AllReduceDtype::F32 => {
                let mut parts = ranks.sum(Tensor::cat(parts, 0), dtype)?.split_with_sizes(sizes, 0);
                let tail = parts.pop().expect("the last one");
                (parts, tail)
            }
            // Gradients may be rounded, the rest may not.
            AllReduceDtype::Bf16 => {
                let tail = ranks.sum(parts.pop().expect("the last one"), AllReduceDtype::F32)?;
                sizes.pop();
                (ranks.sum(Tensor::cat(parts, 0), dtype)?.split_with_sizes(sizes, 0), tail)
            }
        };
        Ok((Flat(gradients.into_iter().map(Some).collect()), tail))
    }

    /// What `rank` gives: gradients of all parameters, and one more tensor for everything else.
    fn parts(&self, rank: usize, own: Own, device: &Device) -> Vec<Tensor<1>> {
        let zeros = |len: usize| Tensor::<1>::zeros([len], device);
        let failed = own.found.is_none();
        let (gradients, figures) = match own.found {
            Some((gradients, figures)) => (gradients.0, figures),
            None => (vec![None; self.parameters.len()], zeros(self.figures)),
        };
        let mut told = vec![0.0; self.parameters.len() + self.world + PIECES * self.virtual_ranks + 3 + self.world];
        let (present, rest) = told.split_at_mut(self.parameters.len());
        let (seconds, rest) = rest.split_at_mut(self.world);
        let (positions, rest) = rest.split_at_mut(PIECES * self.virtual_ranks);
        let (others, who) = rest.split_at_mut(3);
        present.iter_mut().zip(&gradients).for_each(|(x, g)| *x = f32::from(u8::from(g.is_some())));
        seconds[rank] = own.seconds as f32;
        for (virtual_rank, position) in own.positions {
            for (i, piece) in positions[PIECES * virtual_rank..][..PIECES].iter_mut().enumerate() {
                *piece = ((position >> (BITS * i as u32)) & ((1 << BITS) - 1)) as f32;
            }
        }
        // Few enough to be exact.
        others.copy_from_slice(&[own.broken[0] as f32, own.broken[1] as f32, f32::from(u8::from(own.stop))]);
        who[rank] = f32::from(u8::from(failed));
        let mut parts: Vec<Tensor<1>> =
            gradients.into_iter().zip(&self.parameters).map(|(g, &len)| g.unwrap_or_else(|| zeros(len))).collect();
        parts.push(Tensor::cat(vec![figures, Tensor::from_floats(told.as_slice(), device)], 0));
        parts
    }

    /// What the numbers after the figures say.
    pub fn read(&self, told: &[f32]) -> Agreed {
        let (present, rest) = told.split_at(self.parameters.len());
        let (seconds, rest) = rest.split_at(self.world);
        let (positions, rest) = rest.split_at(PIECES * self.virtual_ranks);
        let (others, failed) = rest.split_at(3);
        let number = |pieces: &[f32]| pieces.iter().rev().fold(0, |sum, &x| (sum << BITS) + x as u64);
        Agreed {
            present: present.iter().map(|&x| x > 0.0).collect(),
            seconds: seconds.to_vec(),
            positions: positions.chunks(PIECES).map(number).collect(),
            broken: [others[0] as u64, others[1] as u64],
            stop: others[2] > 0.0,
            failed: failed.iter().position(|&x| x > 0.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ranks::threads::among;

    #[test]
    fn everything_arrives() {
        for dtype in [AllReduceDtype::F32, AllReduceDtype::Bf16] {
            check(dtype);
        }
    }

    fn check(dtype: AllReduceDtype) {
        let big = (1u64 << 59) + 12_345_678_901;
        let found = among(2, |ranks| {
            let device = Device::flex();
            let layout = Layout { parameters: vec![2, 3, 1], figures: 2, world: 2, virtual_ranks: 4 };
            let (rank, x) = (ranks.rank(), ranks.rank() as f32);
            let tensor = |numbers: &[f32]| Tensor::<1>::from_floats(numbers, &device);
            // The second parameter has a gradient on one rank only, the third on none.
            let second = (rank == 1).then(|| tensor(&[4.0, 5.0, 6.0]));
            let gradients = Flat(vec![Some(tensor(&[1.0 + x, 2.0])), second, None]);
            let own = Own {
                found: Some((gradients, tensor(&[0.5, x]))),
                seconds: 1.5 + f64::from(x),
                positions: vec![(rank, 7 + rank as u64), (rank + 2, big + rank as u64)],
                broken: [1, 2 + rank as u64],
                stop: rank == 1,
            };
            let (gradients, tail) = layout.sum(&*ranks, own, dtype, &device).unwrap();
            let tail = tail.into_data().try_to_vec::<f32>().unwrap();
            let failing = Own { found: None, seconds: 0.0, positions: vec![], broken: [0; 2], stop: false };
            let fine = Some((Flat(vec![None, None, None]), tensor(&[0.0; 2])));
            let own = if rank == 1 { failing } else { Own { found: fine, ..failing } };
            let failed = layout.sum(&*ranks, own, dtype, &device).unwrap().1.into_data().try_to_vec::<f32>().unwrap();
            (gradients.values(), tail[..2].to_vec(), layout.read(&tail[2..]), layout.read(&failed[2..]))
        });
        for (gradients, figures, agreed, failed) in found {
            assert_eq!(gradients, [3.0, 4.0, 4.0, 5.0, 6.0, 0.0]);
            assert_eq!(figures, [1.0, 1.0]);
            assert_eq!((&agreed.present[..], &agreed.seconds[..]), (&[true, true, false][..], &[1.5, 2.5][..]));
            assert_eq!(agreed.positions, [7, 8, big, big + 1]);
            assert_eq!((agreed.broken, agreed.stop, agreed.failed), ([2, 5], true, None));
            assert_eq!((failed.failed, failed.stop), (Some(1), false));
        }
    }
}
