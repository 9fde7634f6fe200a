//! Who touches what: depth order, bands of rows, and for each block of pixels the splats that reach it.

use super::project::Splat;

/// Width and height of a block: the pixels that one vector holds.
pub const BLOCK: [usize; 2] = [4, 4];
/// Rows of one band: the unit of parallel work. A multiple of the block height.
pub const BAND: usize = 16;
/// Splats of a band that are assigned to blocks at a time: blocks that have become opaque take no more.
pub const CHUNK: usize = 1024;

const STRIPS: usize = BAND / BLOCK[1];

/// Blocks across an image of `width` pixels.
pub fn blocks_across(width: usize) -> usize {
    width.div_ceil(BLOCK[0])
}

/// Positions of `splats` from near to far; equals keep their order.
pub fn depth_order(splats: &[Splat]) -> Vec<u32> {
    // The bits of positive floats order as the floats do.
    let mut keys: Vec<u64> =
        splats.iter().enumerate().map(|(i, s)| u64::from(s.depth.to_bits()) << 32 | i as u64).collect();
    if keys.len() < 128 {
        keys.sort_unstable();
    } else {
        radix_sort(&mut keys);
    }
    keys.into_iter().map(|key| key as u32).collect()
}

/// Stable sort by the high half of each key, least significant digit first; digits that all keys share are skipped.
fn radix_sort(keys: &mut Vec<u64>) {
    const BITS: u32 = 8;
    const PASSES: usize = 4;
    let mut counts = [[0u32; 1 << BITS]; PASSES];
    let digit = |key: u64, pass: usize| (key >> (32 + BITS * pass as u32)) as usize & ((1 << BITS) - 1);
    for &key in keys.iter() {
        for (pass, count) in counts.iter_mut().enumerate() {
            count[digit(key, pass)] += 1;
        }
    }
    let mut other = vec![0u64; keys.len()];
    for (pass, count) in counts.iter_mut().enumerate() {
        if count.iter().any(|&c| c as usize == keys.len()) {
            continue;
        }
        let mut start = 0;
        for c in count.iter_mut() {
            start += std::mem::replace(c, start);
        }
        for &key in keys.iter() {
            let slot = &mut count[digit(key, pass)];
            other[*slot as usize] = key;
            *slot += 1;
        }
        std::mem::swap(keys, &mut other);
    }
}

/// The splats of each band of an image of `height` rows, each in the order of `order`.
pub fn bands(splats: &[Splat], order: &[u32], height: usize) -> Vec<Vec<Splat>> {
    let count = height.div_ceil(BAND);
    let mut sizes = vec![0usize; count];
    let range = |s: &Splat| usize::from(s.rows[0]) / BAND..=usize::from(s.rows[1]) / BAND;
    for s in splats {
        range(s).for_each(|band| sizes[band] += 1);
    }
    let mut out: Vec<Vec<Splat>> = sizes.into_iter().map(Vec::with_capacity).collect();
    for &i in order {
        let s = &splats[i as usize];
        range(s).for_each(|band| out[band].push(*s));
    }
    out
}

/// Which of a run of splats reach which block of a band.
#[derive(Debug)]
pub struct Chunk {
    /// Position in the band of the first splat of the run.
    pub first: usize,
    offsets: Vec<u32>, // [blocks + 1]
    list: Vec<u16>,
}

impl Chunk {
    /// The splats that reach `block`, as positions in the run, from near to far.
    #[inline(always)]
    pub fn of_block(&self, block: usize) -> &[u16] {
        &self.list[self.offsets[block] as usize..self.offsets[block + 1] as usize]
    }

    /// Assigns at most [`CHUNK`] `splats` to the blocks of the band that starts at row `top`.
    /// Blocks for which `open` is false get none.
    pub fn new(first: usize, splats: &[Splat], top: usize, width: usize, open: &[bool]) -> Self {
        let across = blocks_across(width);
        let mut offsets = vec![0u32; across * STRIPS + 1];
        // (splat, first block, last block) of every splat in every strip of blocks
        let mut runs: Vec<(u16, u16, u16)> = Vec::with_capacity(2 * splats.len());
        let last = (width - 1) as f32;
        for (i, s) in splats.iter().enumerate() {
            let row0 = usize::from(s.rows[0]).max(top) - top;
            let row1 = usize::from(s.rows[1]).min(top + BAND - 1) - top;
            let inverse_height = 1.0 / s.half_height;
            for strip in row0 / BLOCK[1]..=row1 / BLOCK[1] {
                let dy = |row: usize| (top + row) as f32 + 0.5 - s.y;
                let (dy0, dy1) = (dy(row0.max(strip * BLOCK[1])), dy(row1.min(strip * BLOCK[1] + BLOCK[1] - 1)));
                // Its x extent over these rows: the rightmost point, or the nearest to it that lies in the strip.
                let edge = |sign: f32| {
                    let dy = (sign * s.dy_right).max(dy0).min(dy1);
                    let v = dy * inverse_height;
                    s.x + s.slope * dy + sign * s.half_width * (1.0 - v * v).max(0.0).sqrt()
                };
                let (x0, x1) = ((edge(-1.0) - 0.51).ceil().max(0.0), (edge(1.0) - 0.49).floor().min(last));
                if x0 > x1 {
                    continue;
                }
                let (b0, b1) = (x0 as usize / BLOCK[0], x1 as usize / BLOCK[0]);
                for block in strip * across + b0..=strip * across + b1 {
                    offsets[block + 1] += u32::from(open[block]);
                }
                runs.push((i as u16, (strip * across + b0) as u16, (strip * across + b1) as u16));
            }
        }
        let mut sum = 0;
        for o in &mut offsets {
            sum += *o;
            *o = sum;
        }
        let mut next: Vec<u32> = offsets[..offsets.len() - 1].to_vec();
        let mut list = vec![0u16; sum as usize];
        for (i, b0, b1) in runs {
            for block in usize::from(b0)..=usize::from(b1) {
                if open[block] {
                    list[next[block] as usize] = i;
                    next[block] += 1;
                }
            }
        }
        Self { first, offsets, list }
    }
}
