//! Training on several devices: one process, a *rank*, per device. Ranks compute gradients of different objects and add
//! them up; everything else each of them does alike.
//!
//! All that ranks say to each other is sums of vectors. What one of them knows alone, it puts into a place of its own in a
//! vector of zeros.

mod step;
#[cfg(test)]
pub(crate) mod threads;

use std::fmt;

use burn::tensor::{Device, Tensor, TensorData};

use crate::TrainError;
pub(crate) use step::{Agreed, Layout, Own};

/// How numbers travel between ranks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AllReduceDtype {
    /// As they are.
    #[default]
    F32,
    /// With the 8 significant bits of bf16: half of the bytes. What each rank gives is rounded, and so is the sum, which is
    /// formed in 32 bits.
    Bf16,
}

/// The processes that train together, seen from one of them.
pub trait Ranks {
    /// Number of this process, from 0.
    fn rank(&self) -> usize;

    /// Number of processes.
    fn world(&self) -> usize;

    /// The sum of what all ranks give, the same bits on each. Waits for the slowest. Every rank must call it equally often,
    /// with vectors of equal length.
    ///
    /// # Errors
    /// [`TrainError::Ranks`].
    fn sum(&self, flat: Tensor<1>, dtype: AllReduceDtype) -> Result<Tensor<1>, TrainError>;

    /// Says why and ends the processes of all ranks, with this exit code where the launcher passes it on.
    fn abort(&self, code: u8, why: &dyn fmt::Display) -> !;
}

/// One process alone.
#[derive(Clone, Copy, Debug, Default)]
pub struct Single;

impl Ranks for Single {
    fn rank(&self) -> usize {
        0
    }

    fn world(&self) -> usize {
        1
    }

    fn sum(&self, flat: Tensor<1>, _: AllReduceDtype) -> Result<Tensor<1>, TrainError> {
        Ok(flat)
    }

    fn abort(&self, code: u8, why: &dyn fmt::Display) -> ! {
        eprintln!("error: {why}");
        std::process::exit(code.into())
    }
}

/// What every rank has to say, on all ranks, by rank.
///
/// # Errors
/// [`TrainError::Ranks`], also where one of them has more than 16 MiB to say.
pub fn gather(ranks: &dyn Ranks, own: &[u8]) -> Result<Vec<Vec<u8>>, TrainError> {
    /// Whole numbers up to here are exact in 32 bits, sums with zeros included.
    const MOST: usize = 1 << 24;
    let (rank, world) = (ranks.rank(), ranks.world());
    if world == 1 {
        return Ok(vec![own.to_vec()]);
    }
    if own.len() > MOST {
        let problem = format!("rank {rank}: expected at most {MOST} bytes to tell the others, found {}", own.len());
        return Err(TrainError::Ranks { problem });
    }
    let mut lengths = vec![0.0; world];
    lengths[rank] = own.len() as f32;
    let lengths: Vec<usize> = sum_of(ranks, lengths)?.into_iter().map(|x| x as usize).collect();
    let longest = lengths.iter().copied().max().unwrap_or(0);
    let mut slots = vec![0.0; world * longest];
    slots[rank * longest..].iter_mut().zip(own).for_each(|(slot, &byte)| *slot = f32::from(byte));
    let slots = sum_of(ranks, slots)?;
    let told = |rank: usize| slots[rank * longest..][..lengths[rank]].iter().map(|&x| x as u8).collect();
    Ok((0..world).map(told).collect())
}

/// What rank 0 has to say; the others' `own` does not matter.
pub(crate) fn from_first(ranks: &dyn Ranks, own: &[u8]) -> Result<Vec<u8>, TrainError> {
    let own = if ranks.rank() == 0 { own } else { &[] };
    Ok(gather(ranks, own)?.swap_remove(0))
}

/// The tensor of rank 0; the others' may hold anything of the same length.
pub(crate) fn tensor_of_first(ranks: &dyn Ranks, own: Tensor<1>) -> Result<Tensor<1>, TrainError> {
    // Not rank 0's own copy there either: adding zeros makes 0 of -0, and all are to have the same bits.
    ranks.sum(if ranks.rank() == 0 { own } else { own.zeros_like() }, AllReduceDtype::F32)
}

/// [`Ranks::sum`] of a few numbers.
fn sum_of(ranks: &dyn Ranks, numbers: Vec<f32>) -> Result<Vec<f32>, TrainError> {
    let len = numbers.len();
    if len == 0 {
        return Ok(numbers);
    }
    let sum = ranks.sum(Tensor::from_data(TensorData::new(numbers, [len]), &Device::flex()), AllReduceDtype::F32)?;
    sum.into_data().try_to_vec::<f32>().map_err(|e| TrainError::Ranks { problem: format!("{e:?}") })
}

/// Lets all ranks go on, or none: where one of them failed, the others end with [`TrainError::Elsewhere`].
///
/// # Errors
/// Its own error, or that.
pub fn agree<T>(ranks: &dyn Ranks, own: Result<T, TrainError>) -> Result<T, TrainError> {
    if ranks.world() == 1 {
        return own;
    }
    let mut failed = vec![0.0; ranks.world()];
    failed[ranks.rank()] = f32::from(u8::from(own.is_err()));
    let failed = sum_of(ranks, failed)?;
    match (own, failed.iter().position(|&x| x > 0.0)) {
        (Ok(_), Some(rank)) => Err(TrainError::Elsewhere { rank }),
        (own, _) => own,
    }
}

/// Refuses ranks that are not of one kind: `own` are names and values that must be the same on all of them.
///
/// # Errors
/// [`TrainError::Differs`], the same on all ranks.
pub(crate) fn same_on_all(ranks: &dyn Ranks, own: &[(String, String)]) -> Result<(), TrainError> {
    let text = serde_json::to_vec(own).expect("plain text");
    let all = gather(ranks, &text)?;
    let read = |bytes: &Vec<u8>| {
        serde_json::from_slice::<Vec<(String, String)>>(bytes).map_err(|e| TrainError::Ranks { problem: e.to_string() })
    };
    let all = all.iter().map(read).collect::<Result<Vec<_>, _>>()?;
    for (rank, theirs) in all.iter().enumerate() {
        let pairs = (0..theirs.len().max(all[0].len())).map(|i| (all[0].get(i), theirs.get(i)));
        if let Some((expected, found)) = pairs.into_iter().find(|(a, b)| a != b) {
            let value = |pair: Option<&(String, String)>| pair.map_or("nothing".into(), |(_, value)| value.clone());
            let what = expected.or(found).map(|(what, _)| what.clone()).unwrap_or_default();
            return Err(TrainError::Differs { rank, what, expected: value(expected), found: value(found) });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::{threads::among, *};

    #[test]
    fn every_rank_hears_what_every_rank_says() {
        for world in [1, 2, 3] {
            let said = |rank: usize| (0..=255u8).cycle().take(300 * rank).collect::<Vec<u8>>();
            for told in among(world, |ranks| gather(&*ranks, &said(ranks.rank())).unwrap()) {
                assert_eq!(told, (0..world).map(said).collect::<Vec<_>>());
            }
            let first = among(world, |ranks| from_first(&*ranks, &said(ranks.rank() + 1)).unwrap());
            assert!(first.iter().all(|told| *told == said(1)));
        }
    }

    #[test]
    fn one_failure_is_everybody_s() {
        let found = among(3, |ranks| {
            let own = if ranks.rank() == 1 { Err(TrainError::NoViews) } else { Ok(()) };
            (agree(&*ranks, Ok(())).is_ok(), agree(&*ranks, own).unwrap_err())
        });
        assert!(found.iter().all(|(fine, _)| *fine));
        assert!(matches!(found[1].1, TrainError::NoViews));
        assert!([0, 2].iter().all(|&i| matches!(found[i].1, TrainError::Elsewhere { rank: 1 })));
    }

    #[test]
    fn a_rank_that_differs_is_named_with_what_differs() {
        let found = among(3, |ranks| {
            let data = if ranks.rank() == 2 { "bb" } else { "aa" };
            let own = [("program", "1.0"), ("data", data)].map(|(what, value)| (what.into(), value.into()));
            (same_on_all(&*ranks, &own[..1]).is_ok(), same_on_all(&*ranks, &own).unwrap_err().to_string())
        });
        for (same, text) in found {
            assert!(same);
            assert_eq!(text, "rank 2: data: expected aa as on rank 0, found bb");
        }
    }
}
