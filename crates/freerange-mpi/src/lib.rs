//! Ranks that an MPI launcher has started. A crate of its own, so that a program for another MPI library is made without
//! compiling the rest again.

#[cfg(feature = "mpi")]
mod mpi;

#[cfg(feature = "mpi")]
pub use mpi::Mpi;
