//! Tests of whole trainings, as one program: each of several would compile Burn's generic code again.

mod gpu;
mod one_pass;
mod records;
mod road;
