//! Who touches what: depth order, bands of rows, and for each block of pixels the splats that reach it.

use super::math::{LANES, floor_index, fma, max, min};
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

/// Room for the lists of all blocks while they grow; outlives a call.
#[derive(Default)]
pub struct Lists {
    lengths: Vec<u32>,          // [blocks]
    entries: Vec<[u16; CHUNK]>, // [blocks]
}

impl Chunk {
    /// The splats that reach `block`, as positions in the run, from near to far.
    #[inline(always)]
    pub fn of_block(&self, block: usize) -> &[u16] {
        &self.list[self.offsets[block] as usize..self.offsets[block + 1] as usize]
    }

    /// Assigns at most [`CHUNK`] `splats` to the blocks of the band that starts at row `top`.
    /// Blocks for which `open` is false get none.
    #[inline(always)]
    pub fn new<const FMA: bool>(
        first: usize,
        splats: &[Splat],
        top: usize,
        width: usize,
        open: &[bool],
        lists: &mut Lists,
    ) -> Self {
        assert!(splats.len() <= CHUNK);
        let across = blocks_across(width);
        let blocks = across * STRIPS;
        lists.lengths.clear();
        lists.lengths.resize(blocks, 0);
        if lists.entries.len() < blocks {
            lists.entries.resize(blocks, [0; CHUNK]);
        }
        let (lengths, entries) = (&mut lists.lengths[..blocks], &mut lists.entries[..blocks]);
        let last = (width - 1) as f32;
        for (g, group) in splats.chunks(LANES).enumerate() {
            let mut s = [[0f32; LANES]; 8];
            for (l, splat) in group.iter().enumerate() {
                s[0][l] = splat.x;
                s[1][l] = splat.y;
                s[2][l] = splat.slope;
                s[3][l] = splat.half_width;
                s[4][l] = splat.half_height;
                s[5][l] = splat.dy_right;
                s[6][l] = f32::from(splat.rows[0]) + 0.5;
                s[7][l] = f32::from(splat.rows[1]) + 0.5;
            }
            for strip in 0..STRIPS {
                let first_row = (top + strip * BLOCK[1]) as f32 + 0.5;
                let last_row = first_row + (BLOCK[1] - 1) as f32;
                let mut range = [[0u32; LANES]; 2]; // blocks across, first and one after the last
                for l in 0..LANES {
                    let [x, y, slope, half_width, half_height, dy_right, row0, row1] =
                        [s[0][l], s[1][l], s[2][l], s[3][l], s[4][l], s[5][l], s[6][l], s[7][l]];
                    let (dy0, dy1) = (max(row0, first_row) - y, min(row1, last_row) - y);
                    let inverse_height = 1.0 / half_height;
                    // Its x extent over these rows: the rightmost point, or the nearest to it that lies in the strip.
                    let edge = |sign: f32| {
                        let dy = min(max(sign * dy_right, dy0), dy1);
                        let v = dy * inverse_height;
                        let half = half_width * max(fma::<FMA>(-v, v, 1.0), 0.0).sqrt();
                        fma::<FMA>(slope, dy, x) + sign * half
                    };
                    // First and last pixel, with a hundredth of a pixel to spare (see `project`).
                    let (x0, x1) = (edge(-1.0) + 0.49, min(edge(1.0) - 0.49, last));
                    let reached = (dy0 <= dy1) & (x1 >= 0.0);
                    range[0][l] = floor_index(min(max(x0, 0.0), last + BLOCK[0] as f32) * (1.0 / BLOCK[0] as f32));
                    range[1][l] = if reached { floor_index(max(x1, 0.0) * (1.0 / BLOCK[0] as f32)) + 1 } else { 0 };
                }
                for l in 0..group.len() {
                    let [b0, b1] = [range[0][l], range[1][l]];
                    for block in b0..b1 {
                        let block = strip * across + block as usize;
                        let length = &mut lengths[block];
                        entries[block][*length as usize % CHUNK] = (g * LANES + l) as u16;
                        *length += 1;
                    }
                }
            }
        }
        let mut offsets = Vec::with_capacity(blocks + 1);
        let mut sum = 0;
        offsets.push(0);
        for (length, open) in lengths.iter_mut().zip(open) {
            *length *= u32::from(*open);
            sum += *length;
            offsets.push(sum);
        }
        let mut list = Vec::with_capacity(sum as usize);
        for (length, entries) in lengths.iter().zip(entries) {
            list.extend_from_slice(&entries[..*length as usize]);
        }
        Self { first, offsets, list }
    }
}
