//! Where training objects come from: triangle meshes in ([`mesh`]), a generator of household objects ([`generate`]), and
//! views of both ([`render`]).
//!
//! Architecture invariant: no Gaussians and no tensors.

pub mod generate;
pub mod mesh;
pub mod render;
