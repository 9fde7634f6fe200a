//! The derivative of blending with respect to each splat.
//!
//! A tile takes its splats from far to near, [`BATCH`] records at a time, and of these some at a time in two steps. First,
//! units are pixels: each walks the splats backwards, as the CPU path does, and notes d loss / d ln(alpha) and the blending
//! weight. Then units are columns of pixels of one splat, and add up what was noted; few sums per tile and splat remain,
//! which go to memory with one atomic addition each. Sums over pixels through shared memory take fewer instructions than
//! reducing nine numbers across a plane for each splat, and are the same on devices with any planes or none.

use super::draw::{MAX_ALPHA, SCRATCH, exponent, fetch, largest, place, scan};
use super::math::*;
use super::project::{CAMERA, LN_255, RECORD, SUMS};
use super::{THREADS, TILE};
use cubecl::prelude::*;

/// Splats whose records are in shared memory at a time.
const BATCH: usize = 64;
/// Splats that go through the two steps at a time: these take 2 KiB of shared memory each. A power of two up to 16.
const CHUNK: usize = 8;
/// In the second step, units that share a splat, and the distance of the rows that one of them sums over.
const LANES: usize = THREADS / CHUNK;
const ROWS: usize = LANES / TILE;
/// Floats between the sums of one kind and the next: one more than units, so that reading across takes all memory banks.
const PITCH: usize = LANES + 1;

/// A number in memory to which many units add.
#[cube]
pub trait Accumulator: CubePrimitive {
    fn add(cell: &Atomic<Self>, value: f32);
}

/// Native atomic addition.
#[cube]
impl Accumulator for f32 {
    fn add(cell: &Atomic<f32>, value: f32) {
        cell.fetch_add(value);
    }
}

/// The bits of a float, on devices that cannot add floats atomically.
///
/// Takes the old sum out, leaving 0, and puts the new one there; what others have put there in the meantime is taken along,
/// and added in turn. Nothing is lost whatever the order. (A loop over compare-and-exchange would have to know whether the
/// exchange took place, which may fail without a reason on some devices.)
#[cube]
impl Accumulator for u32 {
    fn add(cell: &Atomic<u32>, value: f32) {
        let mut rest = value;
        while rest != 0.0f32 {
            let sum = f32::from_bits(cell.exchange(0u32)) + rest;
            rest = f32::from_bits(cell.exchange(sum.to_bits()));
        }
    }
}

/// Adds to `sums` what `d_image` = d loss / d image means for each splat.
#[cube(launch_unchecked)]
pub fn backward<A: Accumulator>(
    records: &[F4],     // [images, n, RECORD], by index
    order: &[u32],      // [images, n]
    mask: &[u32],       // [images, tiles, words]
    cameras: &[f32],    // [all images, CAMERA]
    d_image: &[F4],     // [all images, height, width]
    pixels: &[u32],     // [2, all images, height, width]
    sums: &[Atomic<A>], // [images, n, SUMS]
    frame: Frame,
    all_pixels: u32,
) {
    if CUBE_POS < frame.images as usize * frame.tiles as usize {
        let unit = UNIT_POS as usize;
        let at = place(&frame);
        let base = at.image * frame.n as usize;
        let mut hits = Shared::<[u32]>::new_slice(BATCH);
        let mut splats = Shared::<[F4]>::new_slice(BATCH * RECORD);
        let mut scratch = Shared::<[u32]>::new_slice(SCRATCH);
        // First `g` = d loss / d ln(alpha), [CHUNK, pixels], and the weights, [CHUNK, pixels]; then the sums of each unit.
        let mut noted = Shared::<[f32]>::new_slice(2 * CHUNK * THREADS);

        // In the first step, this unit's pixel.
        let image = frame.first as usize + at.image;
        let first_pixel = image * (frame.height * frame.width) as usize;
        let mut t = 0.0f32;
        let mut last = 0u32;
        let mut d = vec3(0.0f32, 0.0f32, 0.0f32);
        // The color seen behind the last splat, times d loss / d color.
        let mut behind = 0.0f32;
        if at.inside {
            let pixel = frame.first as usize * (frame.height * frame.width) as usize + at.pixel;
            t = f32::from_bits(pixels[pixel]);
            last = pixels[all_pixels as usize + pixel];
            let d_pixel = d_image[pixel];
            d.x = d_pixel.extract(0usize);
            d.y = d_pixel.extract(1usize);
            d.z = d_pixel.extract(2usize);
            let c = image * CAMERA + 20;
            behind = d.x * cameras[c] + d.y * cameras[c + 1] + d.z * cameras[c + 2] - d_pixel.extract(3usize);
        }

        // In the second step, this unit's splat of the chunk, and its pixels: those of one column, `rows` apart.
        let slot = unit / LANES;
        let lane = unit % LANES;
        let column = at.corner_x + (lane % TILE) as u32;
        let row = at.corner_y + (lane / TILE) as u32;
        let mut d_red = Array::<f32>::new(CHUNK);
        let mut d_green = Array::<f32>::new(CHUNK);
        let mut d_blue = Array::<f32>::new(CHUNK);
        #[unroll]
        for i in 0..CHUNK {
            let y = row + (i * ROWS) as u32;
            d_red[i] = 0.0f32;
            d_green[i] = 0.0f32;
            d_blue[i] = 0.0f32;
            if column < frame.width && y < frame.height {
                let d_pixel = d_image[first_pixel + (y * frame.width + column) as usize];
                d_red[i] = d_pixel.extract(0usize);
                d_green[i] = d_pixel.extract(1usize);
                d_blue[i] = d_pixel.extract(2usize);
            }
        }
        let column_x = f32::cast_from(column) + 0.5f32;
        let row_y = f32::cast_from(row) + 0.5f32;

        // Ranks below this one have been drawn in this tile.
        let end = largest(last, &mut scratch);
        // Words from here on have been dealt with.
        let mut words = end.div_ceil(32u32);
        while words > 0u32 {
            let word = words - 1u32 - min(UNIT_POS, words - 1u32);
            let mut bits = 0u32;
            if UNIT_POS < words {
                bits = mask[at.mask + word as usize];
                if end - word * 32u32 < 32u32 {
                    bits &= (1u32 << (end - word * 32u32)) - 1u32;
                }
            }
            let (start, total) = scan(bits.count_ones(), &mut scratch);
            let mut next = start;
            let mut batch = 0u32;
            while batch < total {
                while bits != 0u32 && next < batch + BATCH as u32 {
                    let top = 31u32 - bits.leading_zeros();
                    hits[(next - batch) as usize] = word * 32u32 + top;
                    bits ^= 1u32 << top;
                    next += 1u32;
                }
                sync_cube();
                let count = min(total - batch, BATCH as u32);
                fetch(records, order, base, &hits, &mut splats, count);
                sync_cube();
                let mut first = 0u32;
                while first < count {
                    #[unroll]
                    for k in 0..CHUNK {
                        let i = first + k as u32;
                        let mut g = 0.0f32;
                        let mut weight = 0.0f32;
                        if i < count && hits[i as usize] < last {
                            let s = i as usize * RECORD;
                            let b = splats[s + 1];
                            let e = exponent(splats[s], b, at.x, at.y);
                            if e >= -LN_255 {
                                let alpha = min(e.exp(), MAX_ALPHA);
                                // The transmittance in front of it
                                t /= 1.0f32 - alpha;
                                weight = t * alpha;
                                let color = d.x * b.extract(2usize)
                                    + d.y * b.extract(3usize)
                                    + d.z * splats[s + 2].extract(0usize);
                                let difference = color - behind;
                                behind += alpha * difference;
                                // No derivative through the upper bound on alpha.
                                g = select(alpha < MAX_ALPHA, weight * difference, 0.0f32);
                            }
                        }
                        noted[k * THREADS + unit] = g;
                        noted[(CHUNK + k) * THREADS + unit] = weight;
                    }
                    sync_cube();

                    let i = first + slot as u32;
                    let mut sum = 0.0f32;
                    let mut sum_y = 0.0f32;
                    let mut sum_yy = 0.0f32;
                    let mut red = 0.0f32;
                    let mut green = 0.0f32;
                    let mut blue = 0.0f32;
                    let mut dx = 0.0f32;
                    if i < count {
                        let a = splats[i as usize * RECORD];
                        dx = column_x - a.extract(0usize);
                        let first_dy = row_y - a.extract(1usize);
                        #[unroll]
                        for j in 0..CHUNK {
                            let cell = slot * THREADS + j * LANES + lane;
                            let g = noted[cell];
                            let weight = noted[CHUNK * THREADS + cell];
                            let dy = first_dy + comptime!((j * ROWS) as f32);
                            sum += g;
                            sum_y += g * dy;
                            sum_yy += g * dy * dy;
                            red += weight * d_red[j];
                            green += weight * d_green[j];
                            blue += weight * d_blue[j];
                        }
                    }
                    sync_cube();

                    let cell = slot * SUMS * PITCH + lane;
                    noted[cell] = sum;
                    noted[cell + PITCH] = sum * dx;
                    noted[cell + 2 * PITCH] = sum_y;
                    noted[cell + 3 * PITCH] = sum * dx * dx;
                    noted[cell + 4 * PITCH] = sum_y * dx;
                    noted[cell + 5 * PITCH] = sum_yy;
                    noted[cell + 6 * PITCH] = red;
                    noted[cell + 7 * PITCH] = green;
                    noted[cell + 8 * PITCH] = blue;
                    sync_cube();

                    let i = first + (unit / SUMS) as u32;
                    if unit < CHUNK * SUMS && i < count {
                        let mut total = 0.0f32;
                        for other in 0..LANES {
                            total += noted[unit * PITCH + other];
                        }
                        let index = order[base + hits[i as usize] as usize];
                        if total != 0.0f32 {
                            A::add(&sums[(base + index as usize) * SUMS + unit % SUMS], total);
                        }
                    }
                    sync_cube();
                    first += CHUNK as u32;
                }
                batch += BATCH as u32;
            }
            words -= min(words, THREADS as u32);
        }
    }
}
