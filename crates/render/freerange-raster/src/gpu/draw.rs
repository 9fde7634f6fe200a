//! Blending: one cube per tile of an image, one unit per pixel.
//!
//! The units find the splats of their tile together: each takes a word of the tile's mask, a prefix sum over the numbers of
//! bits says where in the tile's list its splats belong, and the list is taken in batches that fit into shared memory.

use super::math::*;
use super::project::{CAMERA, LN_255, RECORD};
use super::{THREADS, TILE};
use cubecl::prelude::*;

/// Blending stops before the splat that would take the transmittance to this or below.
pub const MIN_TRANSMITTANCE: f32 = 1e-4;
/// The largest opacity of a splat at a pixel.
pub const MAX_ALPHA: f32 = 0.99;
/// Elements of the scratch memory of [`scan()`] and [`largest()`].
pub const SCRATCH: usize = THREADS + GROUPS;
const GROUPS: usize = 16;

/// Where a unit is.
#[derive(CubeType)]
pub struct Pixel {
    /// In the group.
    pub image: usize,
    /// First word of the tile's mask.
    pub mask: usize,
    /// Pixel in the images of the group, row-major.
    pub pixel: usize,
    pub inside: bool,
    /// The corner of the tile.
    pub corner_x: u32,
    pub corner_y: u32,
    /// The pixel's center.
    pub x: f32,
    pub y: f32,
}

#[cube]
pub fn place(frame: &Frame) -> Pixel {
    let tiles = frame.tiles as usize;
    let image = CUBE_POS / tiles;
    let tile = (CUBE_POS % tiles) as u32;
    let corner_x = tile % frame.tiles_across * TILE as u32;
    let corner_y = tile / frame.tiles_across * TILE as u32;
    let column = corner_x + UNIT_POS % TILE as u32;
    let row = corner_y + UNIT_POS / TILE as u32;
    Pixel {
        image,
        mask: CUBE_POS * frame.words as usize,
        pixel: (image * frame.height as usize + row as usize) * frame.width as usize + column as usize,
        inside: column < frame.width && row < frame.height,
        corner_x,
        corner_y,
        x: f32::cast_from(column) + 0.5f32,
        y: f32::cast_from(row) + 0.5f32,
    }
}

/// The sum of `count` over the units before this one, and over all. The cube must call it as one.
#[cube]
pub fn scan(count: u32, scratch: &mut Shared<[u32]>) -> (u32, u32) {
    let unit = UNIT_POS as usize;
    let group = unit / GROUPS;
    sync_cube(); // others may still read
    scratch[unit] = count;
    sync_cube();
    let mut before = 0u32;
    for other in group * GROUPS..unit {
        before += scratch[other];
    }
    if unit % GROUPS == GROUPS - 1 {
        scratch[THREADS + group] = before + count;
    }
    sync_cube();
    let mut total = 0u32;
    for other in 0..GROUPS {
        let sum = scratch[THREADS + other];
        total += sum;
        before += select(other < group, sum, 0u32);
    }
    (before, total)
}

/// The largest `value` of all units. The cube must call it as one.
#[cube]
pub fn largest(value: u32, scratch: &mut Shared<[u32]>) -> u32 {
    let unit = UNIT_POS as usize;
    sync_cube();
    scratch[unit] = value;
    sync_cube();
    if unit < GROUPS {
        let mut most = 0u32;
        for other in unit * GROUPS..(unit + 1) * GROUPS {
            most = max(most, scratch[other]);
        }
        scratch[THREADS + unit] = most;
    }
    sync_cube();
    let mut most = 0u32;
    for other in 0..GROUPS {
        most = max(most, scratch[THREADS + other]);
    }
    most
}

/// Copies the records of the splats with the ranks `hits[..count]` to shared memory, as the whole cube.
#[cube]
pub fn fetch(records: &[F4], order: &[u32], base: usize, hits: &Shared<[u32]>, splats: &mut Shared<[F4]>, count: u32) {
    let mut i = UNIT_POS as usize;
    while i < count as usize * RECORD {
        let index = order[base + hits[i / RECORD] as usize];
        splats[i] = records[(base + index as usize) * RECORD + i % RECORD];
        i += THREADS;
    }
}

/// ln(opacity) of a splat, given the first two parts of its record, at the point (`x`, `y`).
#[cube]
pub fn exponent(a: F4, b: F4, x: f32, y: f32) -> f32 {
    let dx = x - a.extract(0usize);
    let dy = y - a.extract(1usize);
    let u = a.extract(2usize) * dx + a.extract(3usize) * dy;
    let v = b.extract(0usize) * dy;
    b.extract(1usize) - u * u - v * v
}

/// Draws all images of the group. With `save`, also notes what the backward pass needs of each pixel: the bits of its
/// transmittance, and one plus the rank of the last splat that was blended, or 0.
#[cube(launch_unchecked)]
pub fn forward(
    records: &[F4],     // [images, n, RECORD], by index
    order: &[u32],      // [images, n]
    mask: &[u32],       // [images, tiles, words]
    cameras: &[f32],    // [all images, CAMERA]
    out: &mut [F4],     // [all images, height, width]
    pixels: &mut [u32], // [2, all images, height, width], if `save`
    frame: Frame,
    all_pixels: u32,
    #[comptime] save: bool,
) {
    // The grid may be larger than the number of tiles.
    if CUBE_POS < frame.images as usize * frame.tiles as usize {
        let at = place(&frame);
        let base = at.image * frame.n as usize;
        let mut hits = Shared::<[u32]>::new_slice(THREADS);
        let mut splats = Shared::<[F4]>::new_slice(THREADS * RECORD);
        let mut scratch = Shared::<[u32]>::new_slice(SCRATCH);
        // A slice of one: CubeCL 0.11 cannot write a single shared atomic as SPIR-V.
        let closed = Shared::<[Atomic<u32>]>::new_slice(1usize);
        if UNIT_POS == 0 {
            closed[0].store(0u32);
        }
        sync_cube();
        let mut open = at.inside;
        if !open {
            closed[0].fetch_add(1u32);
        }
        let mut t = 1.0f32;
        let mut red = 0.0f32;
        let mut green = 0.0f32;
        let mut blue = 0.0f32;
        let mut last = 0u32;

        let mut go_on = true;
        let mut first_word = 0u32;
        while first_word < frame.words && go_on {
            let word = first_word + UNIT_POS;
            let mut bits = 0u32;
            if word < frame.words {
                bits = mask[at.mask + word as usize];
            }
            let (start, total) = scan(bits.count_ones(), &mut scratch);
            let mut next = start;
            let mut batch = 0u32;
            while batch < total && go_on {
                while bits != 0u32 && next < batch + THREADS as u32 {
                    hits[(next - batch) as usize] = word * 32u32 + bits.trailing_zeros();
                    bits &= bits - 1u32;
                    next += 1u32;
                }
                sync_cube();
                let count = min(total - batch, THREADS as u32);
                fetch(records, order, base, &hits, &mut splats, count);
                sync_cube();
                let was_open = open;
                let mut i = 0u32;
                while i < count && open {
                    let s = i as usize * RECORD;
                    let b = splats[s + 1];
                    let e = exponent(splats[s], b, at.x, at.y);
                    if e >= -LN_255 {
                        let alpha = min(e.exp(), MAX_ALPHA);
                        let after = t * (1.0f32 - alpha);
                        if after > MIN_TRANSMITTANCE {
                            let weight = t * alpha;
                            red += weight * b.extract(2usize);
                            green += weight * b.extract(3usize);
                            blue += weight * splats[s + 2].extract(0usize);
                            t = after;
                            last = hits[i as usize] + 1u32;
                        } else {
                            open = false;
                        }
                    }
                    i += 1u32;
                }
                if was_open && !open {
                    closed[0].fetch_add(1u32);
                }
                sync_cube();
                go_on = closed[0].load() < THREADS as u32;
                batch += THREADS as u32;
            }
            first_word += THREADS as u32;
        }

        if at.inside {
            let c = (frame.first as usize + at.image) * CAMERA + 20;
            let pixel = frame.first as usize * (frame.height * frame.width) as usize + at.pixel;
            out[pixel] = pack(red + t * cameras[c], green + t * cameras[c + 1], blue + t * cameras[c + 2], 1.0f32 - t);
            if save {
                pixels[pixel] = t.to_bits();
                pixels[all_pixels as usize + pixel] = last;
            }
        }
    }
}
