//! Whatever the device, sums go through the host's memory.

use std::fmt;

use burn::tensor::Tensor;
use ferrompi::{Communicator, ReduceOp, ThreadLevel};

use half::bf16;
use rayon::prelude::*;

use freerange_train::{
    TrainError,
    ranks::{AllReduceDtype, Ranks},
};

/// The processes of an `mpirun`, `srun` or the like.
pub struct Mpi {
    world: Communicator,
    _library: ferrompi::Mpi, // MPI ends when it is dropped, and waits for all ranks to do so
}

impl fmt::Debug for Mpi {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Mpi").field("rank", &self.rank()).field("world", &self.world()).finish()
    }
}

impl Mpi {
    /// Joins the other ranks; once per process, and before anything else is done with MPI.
    ///
    /// # Errors
    /// [`TrainError::Ranks`].
    pub fn start() -> Result<Self, TrainError> {
        // All sums are made by the thread that calls this one.
        let library = ferrompi::Mpi::init_thread(ThreadLevel::Funneled).map_err(failed)?;
        Ok(Self { world: library.world(), _library: library })
    }

    /// The sum in bf16, which MPI does not know: each rank adds up one part of the vector, and tells the others.
    fn sum_rounded(&self, numbers: &mut [f32]) -> Result<(), TrainError> {
        let world = self.world();
        // Two numbers to a word of 32 bits, and equally many words for every rank.
        let part = numbers.len().div_ceil(2 * world).max(1);
        let mut sent = vec![0u32; part * world];
        let words = sent.par_chunks_mut(WORDS).zip(numbers.par_chunks(2 * WORDS));
        words
            .for_each(|(words, numbers)| words.iter_mut().zip(numbers.chunks(2)).for_each(|(w, pair)| *w = pack(pair)));
        let mut received = vec![0u32; part * world];
        self.world.alltoall(&sent, &mut received).map_err(failed)?;
        let mut own = vec![0u32; part];
        own.par_chunks_mut(WORDS).enumerate().for_each(|(chunk, words)| {
            for (i, word) in words.iter_mut().enumerate() {
                let theirs = |rank: usize| unpack(received[rank * part + chunk * WORDS + i]);
                let sum = (0..world).map(theirs).fold([0.0; 2], |[a, b], [x, y]| [a + x, b + y]);
                *word = pack(&sum);
            }
        });
        let all = &mut sent;
        self.world.allgather(&own, all).map_err(failed)?;
        let numbers = numbers.par_chunks_mut(2 * WORDS).zip(all.par_chunks(WORDS));
        numbers.for_each(|(numbers, words)| {
            numbers
                .chunks_mut(2)
                .zip(words)
                .for_each(|(pair, &word)| pair.copy_from_slice(&unpack(word)[..pair.len()]));
        });
        Ok(())
    }

    /// What the MPI library calls itself, on one line.
    pub fn library() -> String {
        let text = ferrompi::Mpi::library_version().unwrap_or_default();
        let line = text.lines().next().unwrap_or_default();
        line.split_whitespace().collect::<Vec<_>>().join(" ")
    }
}

/// Words per piece of work.
const WORDS: usize = 1 << 14;

/// One or two numbers, rounded.
fn pack(pair: &[f32]) -> u32 {
    let bits = |x: &f32| u32::from(bf16::from_f32(*x).to_bits());
    pair.iter().rev().fold(0, |word, x| (word << 16) | bits(x))
}

fn unpack(word: u32) -> [f32; 2] {
    [word as u16, (word >> 16) as u16].map(|bits| bf16::from_bits(bits).to_f32())
}

fn failed(e: ferrompi::Error) -> TrainError {
    TrainError::Ranks { problem: e.to_string() }
}

impl Ranks for Mpi {
    fn rank(&self) -> usize {
        self.world.rank() as usize
    }

    fn world(&self) -> usize {
        self.world.size() as usize
    }

    fn sum(&self, flat: Tensor<1>, dtype: AllReduceDtype) -> Result<Tensor<1>, TrainError> {
        let device = flat.device();
        let mut data = flat.into_data();
        let numbers = data.as_mut_slice::<f32>().map_err(|e| TrainError::Ranks { problem: format!("{e:?}") })?;
        match dtype {
            AllReduceDtype::F32 => self.world.allreduce_inplace(numbers, ReduceOp::Sum).map_err(failed)?,
            AllReduceDtype::Bf16 => self.sum_rounded(numbers)?,
        }
        Ok(Tensor::from_data(data, &device))
    }

    fn abort(&self, code: u8, why: &dyn fmt::Display) -> ! {
        eprintln!("error: rank {} of {}: {why}", self.rank(), self.world());
        self.world.abort(code.into())
    }
}

impl Drop for Mpi {
    fn drop(&mut self) {
        // The end of MPI waits for the others, and they for what this rank does not bring any more.
        if std::thread::panicking() {
            self.world.abort(101);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_numbers_are_a_word() {
        for (x, y) in [(1.0, -0.5), (0.0, 1e-30), (-3.140625, 2f32.powi(100)), (f32::INFINITY, f32::MIN)] {
            let [a, b] = unpack(pack(&[x, y]));
            assert!(
                (a == x || (a - x).abs() <= x.abs() / 256.0)
                    && (b == y || (b - y).abs() <= y.abs() / 256.0 || b.is_infinite())
            );
        }
        assert_eq!(unpack(pack(&[1.5])), [1.5, 0.0]);
        assert!(unpack(pack(&[f32::NAN, 1.0]))[0].is_nan());
    }
}
