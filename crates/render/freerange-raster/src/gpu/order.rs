//! Depth order, and which splat may touch which tile.
//!
//! There is no list of intersections, whose length would depend on the data: every tile has one bit per Gaussian, in the
//! order of depth. For the compact sets that we draw (thousands of Gaussians, not millions) that is less memory than the
//! list, and nothing has to be read back, sorted twice, or capped.

use super::math::*;
use super::project::{CULLED, LN_255, RECORD};
use super::{THREADS, TILE};
use cubecl::prelude::*;

/// Sorts each run of `block` keys of an image, equals in index order. `block` is a power of two, at least two.
///
/// A bitonic network in shared memory, on (key, index).
#[cube(launch_unchecked)]
pub fn sort_blocks(
    keys: &mut [u32],    // [images, n]
    indices: &mut [u32], // [images, n], index of the Gaussian whose key this is
    frame: Frame,
    #[comptime] block: usize,
) {
    let n = frame.n as usize;
    let blocks = n.div_ceil(block);
    // The grid may be larger than the number of blocks.
    if CUBE_POS < frame.images as usize * blocks {
        let base = CUBE_POS / blocks * n;
        let first = CUBE_POS % blocks * block;
        let mut key = Shared::<[u32]>::new_slice(block);
        let mut index = Shared::<[u32]>::new_slice(block);
        let mut i = UNIT_POS as usize;
        while i < block {
            let at = first + i;
            let mut k = CULLED.runtime();
            if at < n {
                k = keys[base + at];
            }
            key[i] = k;
            index[i] = at as u32;
            i += THREADS;
        }
        let mut size = 2usize;
        while size <= block {
            let mut stride = size / 2usize;
            while stride > 0usize {
                sync_cube();
                let mut pair = UNIT_POS as usize;
                while pair < block / 2 {
                    let low = pair / stride * stride * 2 + pair % stride;
                    let high = low + stride;
                    let key_low = key[low];
                    let key_high = key[high];
                    let index_low = index[low];
                    let index_high = index[high];
                    let after = key_low > key_high || (key_low == key_high && index_low > index_high);
                    let ascending = (low & size) == 0usize;
                    // `after == ascending`, which CubeCL 0.11 cannot write as CUDA C++ or SPIR-V.
                    if (after && ascending) || (!after && !ascending) {
                        key[low] = key_high;
                        key[high] = key_low;
                        index[low] = index_high;
                        index[high] = index_low;
                    }
                    pair += THREADS;
                }
                stride /= 2usize;
            }
            size *= 2usize;
        }
        sync_cube();
        let mut i = UNIT_POS as usize;
        while i < block {
            if first + i < n {
                keys[base + first + i] = key[i];
                indices[base + first + i] = index[i];
            }
            i += THREADS;
        }
    }
}

/// How many of the sorted `keys[start..end]` are below `limit`.
#[cube]
fn count_below(keys: &[u32], start: usize, end: usize, limit: u32) -> usize {
    let mut low = start;
    let mut high = end;
    while low < high {
        let middle = (low + high) / 2;
        if keys[middle] < limit {
            low = middle + 1;
        } else {
            high = middle;
        }
    }
    low - start
}

/// Puts every visible splat at its rank by depth, and sets its bit in the mask of each tile that it may touch.
#[cube(launch_unchecked)]
pub fn rank_and_mark(
    keys: &[u32],         // [images, n], sorted in blocks
    indices: &[u32],      // [images, n]
    records: &[F4],       // [images, n, RECORD], by index
    order: &mut [u32],    // [images, n], index by rank
    mask: &[Atomic<u32>], // [images, tiles, words], bits by rank
    frame: Frame,
    #[comptime] block: usize,
) {
    let id = CUBE_POS * CUBE_DIM as usize + UNIT_POS as usize;
    let n = frame.n as usize;
    if id < frame.images as usize * n {
        let key = keys[id];
        if key != CULLED {
            let image = id / n;
            let base = image * n;
            let own = id % n / block;
            let mut rank = id % n % block;
            for other in 0..n.div_ceil(block) {
                if other != own {
                    // Equals in blocks before come before.
                    let limit = key + select(other < own, 1u32, 0u32);
                    let start = base + other * block;
                    rank += count_below(keys, start, min(start + block, base + n), limit);
                }
            }
            let index = indices[id];
            order[base + rank] = index;
            mark(records, mask, (base + index as usize) * RECORD, image, rank as u32, &frame);
        }
    }
}

/// The pixel centers of a tile are from 0.5 to 15.5 beyond its corner.
const FIRST: f32 = 0.5;
const LAST: f32 = TILE as f32 - 0.5;

/// Sets the bit `rank` of all tiles of `image` that the splat at `record` may reach.
///
/// Exact but for rounding: for each row of tiles, the extent in x of the ellipse's part within it. As the part is convex,
/// the splat meets all the tiles from the first to the last.
#[cube]
fn mark(records: &[F4], mask: &[Atomic<u32>], record: usize, image: usize, rank: u32, frame: &Frame) {
    let a = records[record];
    let b = records[record + 1];
    let (x, y, l11, l21) = (a.extract(0usize), a.extract(1usize), a.extract(2usize), a.extract(3usize));
    let (l22, ln_opacity) = (b.extract(0usize), b.extract(1usize));
    let reach = max(ln_opacity + LN_255, 1e-12f32).sqrt();
    // The ellipse is x = mean + slope dy +- half_width sqrt(1 - (dy / half_height)^2).
    let slope = -l21 / l11;
    let half_width = reach / l11;
    let half_height = reach / l22;
    // dy of its rightmost point
    let dy_right = -half_height * l21 / (l21 * l21 + l22 * l22).sqrt();
    // For rounding: pixels test the splat again.
    let spare = 0.01f32 + 1e-6f32 * (x.abs() + y.abs() + half_width + half_height * (1.0f32 + slope.abs()));
    let rows = frame.tiles / frame.tiles_across;
    let top = first_tile(y - half_height - spare);
    let end = end_tile(y + half_height + spare, rows);
    let word = (rank / 32) as usize;
    let bit = 1u32 << (rank % 32);
    let mut row = top;
    while row < end {
        let corner = f32::cast_from(row * TILE as u32);
        let low = max(corner + FIRST - spare - y, -half_height);
        let high = min(corner + LAST + spare - y, half_height);
        let left = edge(-dy_right, low, high, -half_width, half_height, slope);
        let right = edge(dy_right, low, high, half_width, half_height, slope);
        let mut column = first_tile(x + left - spare);
        let end = end_tile(x + right + spare, frame.tiles_across);
        while column < end {
            let tile = image * frame.tiles as usize + (row * frame.tiles_across + column) as usize;
            // Every bit is set once: adding is as good as or-ing, and found on more devices.
            mask[tile * frame.words as usize + word].fetch_add(bit);
            column += 1u32;
        }
        row += 1u32;
    }
}

/// The outermost x, from the mean, where dy is from `low` to `high`: at `extreme`, or where they let it come nearest.
#[cube]
fn edge(extreme: f32, low: f32, high: f32, half_width: f32, half_height: f32, slope: f32) -> f32 {
    let dy = min(max(extreme, low), high);
    let v = dy / half_height;
    slope * dy + half_width * max(1.0f32 - v * v, 0.0f32).sqrt()
}

/// The first row or column of tiles with a pixel center at or beyond `at`.
#[cube]
fn first_tile(at: f32) -> u32 {
    // Bounded before the conversion, which has no meaning for what is too large.
    u32::cast_from(clamp(((at - LAST) / TILE as f32).ceil(), 0.0f32, 1e6f32))
}

/// One beyond the last row or column of tiles, of `count`, with a pixel center at or before `at`.
#[cube]
fn end_tile(at: f32, count: u32) -> u32 {
    u32::cast_from(clamp(((at - FIRST) / TILE as f32).floor() + 1.0f32, 0.0f32, f32::cast_from(count)))
}
