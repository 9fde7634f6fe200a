//! Matrix products of any size.
//!
//! The scheme is Goto and van de Geijn's (2008): a block of the right operand as wide as the result stays packed for all
//! threads, and each thread takes a few strips of the left one through it. A left operand whose lines lie across memory is
//! packed by all threads together too, row of memory by row of memory.

use rayon::prelude::*;

use super::{
    super::{Shared, matrix::Matrix},
    Destination, SIDE, Start, Tile, Unit,
    pack::Lines,
    with_tiles,
};

/// Steps of a packed block, at most: a strip of 40 KiB stays in the first cache.
const STEPS: usize = 20;
/// Left strips per piece of work, at most.
const STRIPS: usize = 4;

/// Tiles that several tasks fill in different places.
#[derive(Clone, Copy)]
struct SharedTiles(*mut [Tile; 2]);
// SAFETY: tasks write to disjoint steps only.
unsafe impl Send for SharedTiles {}
// SAFETY: as above.
unsafe impl Sync for SharedTiles {}

impl SharedTiles {
    /// # Safety
    /// The step must lie within the buffer.
    unsafe fn step(self, i: usize) -> *mut [Tile; 2] {
        // SAFETY: the caller's promise.
        unsafe { self.0.add(i) }
    }
}

/// Packs some steps of all strips in parallel, strip by strip.
fn pack(lines: &Lines, first: usize, steps: usize, out: &mut [Tile]) {
    let strips = lines.strips();
    let out = out.as_chunks_mut::<2>().0;
    assert_eq!(out.len(), strips * steps);
    let out = SharedTiles(out.as_mut_ptr());
    // SAFETY: each step of each strip is packed once, all within the buffer.
    let pack = |strip: usize, step: usize| {
        lines.pack_step(strip, first + step, unsafe { &mut *out.step(strip * steps + step) })
    };
    if lines.is_deep() {
        (0..strips).into_par_iter().for_each(|strip| (0..steps).for_each(|step| pack(strip, step)));
    } else {
        (0..steps).into_par_iter().for_each(|step| (0..strips).for_each(|strip| pack(strip, step)));
    }
}

/// `bias + a b`, where `a` is `[m, k]` and `b` `[k, n]`, rounded to bf16, and the bias is the same for every row.
/// Only where available.
pub fn product([m, k, n]: [usize; 3], a: Matrix, b: Matrix, bias: Option<&[f32]>) -> Vec<f32> {
    let (left, right) = (Lines::left(a, m, k), Lines::right(b, k, n));
    let mut out = Vec::with_capacity(m * n);
    let target = Shared(out.as_mut_ptr());
    let steps = left.steps();
    let block = steps.div_ceil(steps.div_ceil(STEPS).max(1)).max(1);
    // How work is cut into pieces changes nothing but who does it.
    let strips = left.strips().div_ceil(2 * rayon::current_num_threads()).clamp(1, STRIPS);
    let whole_left = if left.is_deep() { 0 } else { 2 * left.strips() * block };
    with_tiles(2 * right.strips() * block + whole_left, |tiles| {
        let (right_tiles, left_tiles) = tiles.split_at_mut(2 * right.strips() * block);
        for first in (0..steps.max(1)).step_by(block) {
            let depth = block.min(steps - first);
            let right_tiles = &mut right_tiles[..2 * right.strips() * depth];
            pack(&right, first, depth, right_tiles);
            if !left.is_deep() {
                pack(&left, first, depth, &mut left_tiles[..2 * left.strips() * depth]);
            }
            let (right_tiles, left_tiles) = (&*right_tiles, &*left_tiles);
            let multiply = |top: usize, left_tiles: &[Tile]| {
                let unit = Unit::new();
                for (j, right_tiles) in strips_of(right_tiles, depth, right.strips()).enumerate() {
                    let count = strips.min(left.strips() - top);
                    for (i, left_tiles) in strips_of(left_tiles, depth, count).enumerate() {
                        let (row, column) = ((top + i) * SIDE, j * SIDE);
                        let (rows, columns) = (SIDE.min(m - row), SIDE.min(n - column));
                        let start = match bias {
                            _ if first > 0 => Start::Result,
                            Some(bias) => Start::Row(&bias[column..]),
                            None => Start::Zeros,
                        };
                        // SAFETY: this task alone writes these rows, all within `out`; what it reads, it has written.
                        unsafe {
                            let out = target.at(row * n + column);
                            unit.multiply(
                                left_tiles,
                                right_tiles,
                                start,
                                Destination { out, stride: n, rows, columns },
                            );
                        }
                    }
                }
            };
            (0..left.strips().div_ceil(strips)).into_par_iter().for_each(|piece| {
                let top = piece * strips;
                let count = strips.min(left.strips() - top);
                if !left.is_deep() {
                    return multiply(top, &left_tiles[2 * top * depth..][..2 * count * depth]);
                }
                with_tiles(2 * count * depth, |tiles| {
                    let packed = tiles.as_chunks_mut::<2>().0;
                    for (i, out) in packed.iter_mut().enumerate() {
                        left.pack_step(top + i / depth, first + i % depth, out);
                    }
                    multiply(top, tiles);
                });
            });
        }
    });
    // SAFETY: every row and column was written, with no depth at all too.
    unsafe { out.set_len(m * n) };
    out
}

/// So many packed strips; of no tiles where there is no depth.
fn strips_of(tiles: &[Tile], steps: usize, n: usize) -> impl Iterator<Item = &[Tile]> {
    (0..n).map(move |i| &tiles[2 * steps * i..][..2 * steps])
}
