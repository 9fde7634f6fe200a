//! Training on many ranks: processes that an MPI launcher started, and sums from card to card through NCCL
//! (**experimental: compiled and linked, but not run on a card yet**).
//!
//! Apart from the training it serves, so that another MPI library does not compile that again. Without its features
//! there is nothing here.
//!
//! Architecture invariant: of the workspace it uses `freerange-train` alone; what is summed is not known here.

#[cfg(feature = "mpi")]
mod mpi;
#[cfg(feature = "nccl")]
mod nccl;

#[cfg(feature = "mpi")]
pub use mpi::Mpi;
#[cfg(feature = "nccl")]
pub use nccl::Nccl;
