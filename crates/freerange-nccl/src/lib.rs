//! Sums between cards through NCCL. Which ranks there are, and what they say to each other beside tensors on cards, is left
//! to others (MPI). **Experimental: compiled and linked, but not run on a card yet.**

#[cfg(feature = "nccl")]
mod nccl;

#[cfg(feature = "nccl")]
pub use nccl::Nccl;
