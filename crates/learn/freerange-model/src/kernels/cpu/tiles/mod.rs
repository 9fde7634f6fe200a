//! Tiles of bf16 numbers and their products with f32 sums: on the tile unit of Intel's processors (AMX), or by vectors of
//! bf16 (AVX-512 BF16: AMD's from Zen 4 on, Intel's where the unit is missing or hidden).
//!
//! A tile is 16 rows of 64 bytes. One instruction of the unit adds to 16 x 16 sums the products of 16 rows of the left
//! operand (each 32 numbers deep) and 16 columns of the right one, which wants its numbers in pairs along the depth: row `q`
//! holds pair `q` of every column. That is what one vector instruction wants for one row and 16 columns, too. Operands are
//! rounded to nearest even while they are packed; numbers below f32's normal range count as zero.
//!
//! An operand is packed as *strips* of 32 lines (rows of the left operand, columns of the right one), a strip as *steps*
//! of 32 numbers along the depth, a step as two tiles. Missing lines and numbers are zeros.

mod attention;
mod pack;
mod product;
#[cfg(test)]
mod tests;
mod unit;
mod vectors;

use std::{cell::Cell, marker::PhantomData, sync::OnceLock};

pub use attention::{head_backward, head_forward};
pub use product::product;

/// Lines of a strip, and numbers of a step.
pub const SIDE: usize = 32;
/// Lines of a tile.
const LINES: usize = 16;

/// 16 rows of 64 bytes.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub struct Tile([u32; 256]);

impl Tile {
    pub const ZERO: Self = Self([0; 256]);
}

/// What multiplies tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Engine {
    Tiles,
    Vectors,
}

/// What this CPU and operating system have, the faster where both are there.
fn engine() -> Option<Engine> {
    static ENGINE: OnceLock<Option<Engine>> = OnceLock::new();
    *ENGINE.get_or_init(|| {
        let vectors = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512bf16");
        let engine = if unit::available() { Engine::Tiles } else { Engine::Vectors };
        vectors.then_some(engine)
    })
}

/// Whether this CPU has the instructions, and the operating system lets this process use them.
pub fn available() -> bool {
    engine().is_some()
}

/// What a product is added to.
#[derive(Clone, Copy)]
pub enum Start<'a> {
    Zeros,
    /// What is there.
    Result,
    /// The same for every row, at least as long as the result is wide.
    Row(&'a [f32]),
}

/// Where a product goes: up to 32 rows of up to 32 columns, rows `stride` apart.
#[derive(Clone, Copy)]
pub struct Destination {
    pub out: *mut f32,
    pub stride: usize,
    pub rows: usize,
    pub columns: usize,
}

/// What this thread multiplies with. Tile registers are configured, and released when this is dropped, so that switching
/// threads does not save them.
pub struct Unit(Engine, PhantomData<*const ()>);

impl Unit {
    pub fn new() -> Self {
        Self::of(engine().expect("bf16 instructions"))
    }

    fn of(engine: Engine) -> Self {
        if engine == Engine::Tiles {
            unit::configure();
        }
        Self(engine, PhantomData)
    }

    /// `place = start + left right` for one strip of each operand.
    ///
    /// # Safety
    /// `place` must be valid for writes of its rows and columns, for reads too if it is what to start from, and nothing
    /// else may touch those meanwhile.
    #[inline]
    pub unsafe fn multiply(&self, left: &[Tile], right: &[Tile], start: Start, place: Destination) {
        assert!(left.len() == right.len() && left.len().is_multiple_of(2), "strips of the same depth");
        let Destination { out, stride, rows, columns } = place;
        let (from, from_stride) = match start {
            Start::Zeros => (std::ptr::null(), 0),
            Start::Result => (out.cast_const(), stride),
            Start::Row(row) => {
                assert!(row.len() >= columns, "a start as wide as the result");
                (row.as_ptr(), 0)
            }
        };
        let block = match self.0 {
            Engine::Tiles => unit::block,
            Engine::Vectors => vectors::block,
        };
        let (left, right, steps) = (left.as_ptr(), right.as_ptr(), left.len() / 2);
        if rows == SIDE && columns == SIDE {
            // SAFETY: the engine is there; all of the block is valid, by the caller's promise or as checked.
            return unsafe { block(steps, left, right, from, from_stride, out, stride) };
        }
        // What is at an edge goes by way of a whole block.
        let mut whole = Block([0.0; SIDE * SIDE]);
        if !from.is_null() {
            for (i, row) in whole.0.chunks_exact_mut(SIDE).enumerate().take(rows) {
                // SAFETY: rows and columns that may be read.
                unsafe { std::ptr::copy_nonoverlapping(from.add(i * from_stride), row.as_mut_ptr(), columns) };
            }
        }
        // SAFETY: the engine is there; the block is ours.
        unsafe { block(steps, left, right, whole.0.as_ptr(), SIDE, whole.0.as_mut_ptr(), SIDE) };
        for (i, row) in whole.0.chunks_exact(SIDE).enumerate().take(rows) {
            // SAFETY: rows and columns that may be written.
            unsafe { std::ptr::copy_nonoverlapping(row.as_ptr(), out.add(i * stride), columns) };
        }
    }
}

impl Drop for Unit {
    fn drop(&mut self) {
        if self.0 == Engine::Tiles {
            unit::release();
        }
    }
}

#[repr(C, align(64))]
struct Block([f32; SIDE * SIDE]);

/// Lends so many tiles of this thread's, with anything in them.
pub fn with_tiles<R>(n: usize, f: impl FnOnce(&mut [Tile]) -> R) -> R {
    thread_local!(static KEPT: Cell<Vec<Tile>> = const { Cell::new(Vec::new()) });
    let mut tiles = KEPT.take();
    if tiles.len() < n {
        tiles.resize(n, Tile::ZERO);
    }
    let result = f(&mut tiles[..n]);
    // While `f` waited for other threads, this one may have lent and kept others; the larger buffer stays.
    let other = KEPT.take();
    KEPT.set(if other.len() > tiles.len() { other } else { tiles });
    result
}
