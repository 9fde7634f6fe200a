//! One file per command: its arguments, and what it prints and writes.

pub mod bench;
pub mod convert;
pub mod data;
pub mod devices;
pub mod eval;
pub mod export;
pub mod inspect;
pub mod model;
pub mod poses;
pub mod reconstruct;
pub mod render;
pub mod serve;
pub mod train;
pub mod weights;
