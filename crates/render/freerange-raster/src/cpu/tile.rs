//! Blending the splats of a band, block by block, and the derivative of that with respect to each splat.
//!
//! One vector lane is one pixel of a block. Everything here is inlined into functions that are compiled for several
//! instruction sets (see `mod.rs`), with loops over lanes that have no branches.

use super::bin::{BAND, BLOCK, CHUNK, Chunk, Lists, blocks_across};
use super::math::{LANES, exp2, fma, max, min};
use super::project::{LOG2_255, SUMS, Splat};

/// Blending stops before the splat that would take the transmittance to this or below.
pub const MIN_TRANSMITTANCE: f32 = 1e-4;
/// The largest opacity of a splat at a pixel.
pub const MAX_ALPHA: f32 = 0.99;
/// How often, in splats, a block is checked for having become opaque.
const CHECK: usize = 8;

type Pixels = [f32; LANES];

/// Pixel center of each lane, from the corner of its block.
const X: Pixels = lanes(0, 0.5);
const Y: Pixels = lanes(1, 0.5);

const fn lanes(axis: usize, offset: f32) -> Pixels {
    assert!(BLOCK[0] * BLOCK[1] == LANES && BAND.is_multiple_of(BLOCK[1]));
    let mut out = [0.0; LANES];
    let mut l = 0;
    while l < LANES {
        out[l] = (if axis == 0 { l % BLOCK[0] } else { l / BLOCK[0] }) as f32 + offset;
        l += 1;
    }
    out
}

/// 1, x, y, x^2, x y, y^2 of each lane, from the middle of its block.
const MOMENTS: [[f32; 8]; LANES] = {
    let mut out = [[0.0; 8]; LANES];
    let mut l = 0;
    while l < LANES {
        let (x, y) = (X[l] - 0.5 * BLOCK[0] as f32, Y[l] - 0.5 * BLOCK[1] as f32);
        out[l] = [1.0, x, y, x * x, x * y, y * y, 0.0, 0.0];
        l += 1;
    }
    out
};

/// The state of the pixels of a block between splats.
#[derive(Clone, Copy)]
struct Block {
    /// Transmittance, 0 once blending has stopped.
    t: Pixels,
    /// Transmittance that the background is seen through.
    t_final: Pixels,
    rgb: [Pixels; 3],
    depth: Pixels,
}

/// A band and what it needs to be drawn again, backwards.
#[derive(Debug)]
pub struct Band {
    pub top: usize,
    /// From near to far.
    pub splats: Vec<Splat>,
    pub chunks: Vec<Chunk>,
}

/// Image rows of a band. `color` has `stride` floats per pixel; if that is 4, the fourth is alpha.
pub struct Rows<'a> {
    pub width: usize,
    pub height: usize,
    pub stride: usize,
    pub color: &'a mut [f32],
    /// Empty if not asked for.
    pub alpha: &'a mut [f32],
    /// Empty if not asked for.
    pub depth: &'a mut [f32],
}

/// d loss / d [`Rows`].
pub struct RowGrads<'a> {
    pub width: usize,
    pub height: usize,
    pub stride: usize,
    pub color: &'a [f32],
    pub alpha: &'a [f32],
    pub depth: &'a [f32],
}

/// Calls `f(lane, pixel)` for the lanes of the block at (`x0`, `y0`) that lie within the rows.
#[inline(always)]
fn each_inside(x0: usize, y0: usize, width: usize, height: usize, mut f: impl FnMut(usize, usize)) {
    for y in 0..BLOCK[1].min(height - y0) {
        for x in 0..BLOCK[0].min(width - x0) {
            f(y * BLOCK[0] + x, (y0 + y) * width + x0 + x);
        }
    }
}

/// Opacity of `s` at each pixel of the block whose corner is at (`x`, `y`), 0 where below 1/255.
#[inline(always)]
fn opacity<const FMA: bool>(s: &Splat, x: f32, y: f32, l: usize) -> f32 {
    let u0 = fma::<FMA>(s.l11, x - s.x, s.l21 * (y - s.y));
    let v0 = s.l22 * (y - s.y);
    let u = fma::<FMA>(s.l11, X[l], fma::<FMA>(s.l21, Y[l], u0));
    let v = fma::<FMA>(s.l22, Y[l], v0);
    let exponent = fma::<FMA>(-u, u, fma::<FMA>(-v, v, s.log2_opacity));
    let alpha = min(exp2::<FMA>(max(exponent, -20.0)), MAX_ALPHA);
    if exponent >= -LOG2_255 { alpha } else { 0.0 }
}

/// Draws a band of splats, which are in depth order, in front of `background`.
#[inline(always)]
pub fn draw<const FMA: bool, const DEPTH: bool>(
    top: usize,
    splats: Vec<Splat>,
    background: [f32; 3],
    lists: &mut Lists,
    rows: &mut Rows,
) -> Band {
    let across = blocks_across(rows.width);
    let count = across * rows.height.div_ceil(BLOCK[1]);
    let empty = Block { t: [0.0; LANES], t_final: [1.0; LANES], rgb: [[0.0; LANES]; 3], depth: [0.0; LANES] };
    let mut blocks = vec![empty; count];
    for (i, block) in blocks.iter_mut().enumerate() {
        each_inside(i % across * BLOCK[0], i / across * BLOCK[1], rows.width, rows.height, |l, _| block.t[l] = 1.0);
    }
    let mut open = vec![true; across * (BAND / BLOCK[1])];
    let mut chunks = Vec::with_capacity(splats.len().div_ceil(CHUNK));
    for (c, run) in splats.chunks(CHUNK).enumerate() {
        let chunk = Chunk::new::<FMA>(c * CHUNK, run, top, rows.width, &open, lists);
        let mut any_open = false;
        for (i, block) in blocks.iter_mut().enumerate() {
            if !open[i] {
                continue;
            }
            let (x, y) = ((i % across * BLOCK[0]) as f32, (top + i / across * BLOCK[1]) as f32);
            open[i] = blend::<FMA, DEPTH>(block, run, chunk.of_block(i), x, y);
            any_open |= open[i];
        }
        chunks.push(chunk);
        if !any_open {
            break;
        }
    }
    for (i, block) in blocks.iter().enumerate() {
        each_inside(i % across * BLOCK[0], i / across * BLOCK[1], rows.width, rows.height, |l, pixel| {
            let t = block.t_final[l];
            for c in 0..3 {
                rows.color[pixel * rows.stride + c] = fma::<FMA>(t, background[c], block.rgb[c][l]);
            }
            if rows.stride == 4 {
                rows.color[pixel * 4 + 3] = 1.0 - t;
            } else {
                rows.alpha[pixel] = 1.0 - t;
            }
            if DEPTH {
                rows.depth[pixel] = block.depth[l];
            }
        });
    }
    Band { top, splats, chunks }
}

/// Blends the splats `list` of `run` into the block whose corner is at (`x`, `y`). Whether it can take more.
#[inline(always)]
fn blend<const FMA: bool, const DEPTH: bool>(block: &mut Block, run: &[Splat], list: &[u16], x: f32, y: f32) -> bool {
    let Block { mut t, mut t_final, rgb: [mut red, mut green, mut blue], mut depth } = *block;
    let mut open = true;
    for group in list.chunks(CHECK) {
        for &i in group {
            let s = &run[usize::from(i)];
            for l in 0..LANES {
                let alpha = opacity::<FMA>(s, x, y, l);
                let next = t[l] * (1.0 - alpha);
                let go_on = next > MIN_TRANSMITTANCE;
                let weight = if go_on { t[l] * alpha } else { 0.0 };
                t[l] = if go_on { next } else { 0.0 };
                t_final[l] = if go_on { next } else { t_final[l] };
                red[l] = fma::<FMA>(weight, s.color[0], red[l]);
                green[l] = fma::<FMA>(weight, s.color[1], green[l]);
                blue[l] = fma::<FMA>(weight, s.color[2], blue[l]);
                if DEPTH {
                    depth[l] = fma::<FMA>(weight, s.depth, depth[l]);
                }
            }
        }
        open = t.iter().fold(0, |any, v| any | v.to_bits()) != 0;
        if !open {
            break;
        }
    }
    *block = Block { t, t_final, rgb: [red, green, blue], depth };
    open
}

/// What the splats of one block do at each of its pixels, from near to far. Outlives a call, and only grows.
#[derive(Default)]
pub struct Scratch {
    /// Positions in the band.
    splats: Vec<u32>,
    /// First alpha, later d loss / d ln(alpha); and the blending weight.
    pixels: Vec<[Pixels; 2]>,
    /// How many of them are in use.
    count: usize,
}

/// Pulls d loss / d image back to the splats of `band`: `sums` has a row for each, see [`SUMS`]. Returns
/// d loss / d background.
#[inline(always)]
pub fn backward<const FMA: bool, const DEPTH: bool>(
    band: &Band,
    background: [f32; 3],
    grads: &RowGrads,
    scratch: &mut Scratch,
    sums: &mut [[f32; SUMS]],
) -> [f32; 3] {
    let across = blocks_across(grads.width);
    let mut d_background = [0f32; 3];
    for i in 0..across * grads.height.div_ceil(BLOCK[1]) {
        let (x0, y0) = (i % across * BLOCK[0], i / across * BLOCK[1]);
        let mut t = [0f32; LANES];
        let mut d = [[0f32; LANES]; 4]; // d loss / d (red, green, blue, depth)
        let mut behind = [0f32; LANES]; // the color seen behind the last splat, times d loss / d color
        each_inside(x0, y0, grads.width, grads.height, |l, pixel| {
            t[l] = 1.0;
            for c in 0..3 {
                d[c][l] = grads.color[pixel * grads.stride + c];
                behind[l] += d[c][l] * background[c];
            }
            if grads.stride == 4 {
                behind[l] -= grads.color[pixel * 4 + 3];
            } else if !grads.alpha.is_empty() {
                behind[l] -= grads.alpha[pixel];
            }
            if DEPTH {
                d[3][l] = grads.depth[pixel];
            }
        });
        let corner = [x0 as f32, (band.top + y0) as f32];
        let t_final = near_to_far::<FMA>(band, i, corner, t, scratch);
        for c in 0..3 {
            d_background[c] += t_final.iter().zip(&d[c]).map(|(t, d)| t * d).sum::<f32>();
        }
        far_to_near::<FMA, DEPTH>(band, behind, &d, scratch);
        add_up::<FMA>(band, corner, &d, scratch, sums);
    }
    d_background
}

/// Blends the splats of `block` as [`draw`] did, noting alpha and weight of each. `t` is 1 at pixels of the image.
/// Returns the transmittance of all of them.
#[inline(always)]
fn near_to_far<const FMA: bool>(
    band: &Band,
    block: usize,
    [x, y]: [f32; 2],
    mut t: Pixels,
    scratch: &mut Scratch,
) -> Pixels {
    let mut t_final = [1f32; LANES];
    // Room for all beforehand: a call that may grow a vector would push the lanes out of the registers.
    let count = band.chunks.iter().map(|chunk| chunk.of_block(block).len()).sum();
    if scratch.splats.len() < count {
        scratch.splats.resize(count, 0);
        scratch.pixels.resize(count, [[0.0; LANES]; 2]);
    }
    let mut k = 0;
    for chunk in &band.chunks {
        let run = &band.splats[chunk.first..];
        for group in chunk.of_block(block).chunks(CHECK) {
            for &i in group {
                let s = &run[usize::from(i)];
                let mut noted = [[0f32; LANES]; 2];
                for l in 0..LANES {
                    let alpha = opacity::<FMA>(s, x, y, l);
                    let next = t[l] * (1.0 - alpha);
                    let go_on = next > MIN_TRANSMITTANCE;
                    noted[0][l] = if go_on { alpha } else { 0.0 };
                    noted[1][l] = if go_on { t[l] * alpha } else { 0.0 };
                    t[l] = if go_on { next } else { 0.0 };
                    t_final[l] = if go_on { next } else { t_final[l] };
                }
                scratch.splats[k] = (chunk.first + usize::from(i)) as u32;
                scratch.pixels[k] = noted;
                k += 1;
            }
            if t.iter().fold(0, |any, v| any | v.to_bits()) == 0 {
                scratch.count = k;
                return t_final;
            }
        }
    }
    scratch.count = k;
    t_final
}

/// Replaces the alphas by d loss / d ln(alpha) = weight (color - color behind), where colors are times
/// d loss / d color. What is seen in front of a splat follows from what is seen behind it:
/// behind += alpha (color - behind).
#[inline(always)]
fn far_to_near<const FMA: bool, const DEPTH: bool>(
    band: &Band,
    mut behind: Pixels,
    d: &[Pixels; 4],
    scratch: &mut Scratch,
) {
    let d = *d;
    let count = scratch.count;
    for (&i, pixels) in scratch.splats[..count].iter().zip(&mut scratch.pixels[..count]).rev() {
        let s = &band.splats[i as usize];
        let [alpha, weight] = *pixels;
        let mut g = [0f32; LANES];
        for l in 0..LANES {
            let mut color = s.color[0] * d[0][l];
            color = fma::<FMA>(s.color[1], d[1][l], color);
            color = fma::<FMA>(s.color[2], d[2][l], color);
            if DEPTH {
                color = fma::<FMA>(s.depth, d[3][l], color);
            }
            let difference = color - behind[l];
            behind[l] = fma::<FMA>(alpha[l], difference, behind[l]);
            // No derivative through the upper bound on alpha.
            g[l] = if alpha[l] < MAX_ALPHA { weight[l] * difference } else { 0.0 };
        }
        pixels[0] = g;
    }
}

/// Sums over the pixels of the block: products with fixed columns, a small matrix product.
#[inline(always)]
fn add_up<const FMA: bool>(
    band: &Band,
    [x, y]: [f32; 2],
    d: &[Pixels; 4],
    scratch: &Scratch,
    sums: &mut [[f32; SUMS]],
) {
    let mut columns = [[0f32; 4]; LANES];
    for l in 0..LANES {
        columns[l] = [d[0][l], d[1][l], d[2][l], d[3][l]];
    }
    // Rows of eight as they are: knowing the numbers, the compiler would take them apart.
    let moments = std::hint::black_box(&MOMENTS);
    let middle = [x + 0.5 * BLOCK[0] as f32, y + 0.5 * BLOCK[1] as f32];
    for (&i, [g, weight]) in scratch.splats[..scratch.count].iter().zip(&scratch.pixels) {
        let mut m = [0f32; 8];
        let mut color = [0f32; 4];
        for l in 0..LANES {
            for k in 0..8 {
                m[k] = fma::<FMA>(g[l], moments[l][k], m[k]);
            }
            for k in 0..4 {
                color[k] = fma::<FMA>(weight[l], columns[l][k], color[k]);
            }
        }
        // Moments about the mean of the splat instead of the middle of the block.
        let s = &band.splats[i as usize];
        let (cx, cy) = (middle[0] - s.x, middle[1] - s.y);
        let (sx, sy) = (fma::<FMA>(cx, m[0], m[1]), fma::<FMA>(cy, m[0], m[2]));
        let sum = &mut sums[i as usize];
        sum[0] += m[0];
        sum[1] += sx;
        sum[2] += sy;
        sum[3] += m[3] + cx * (m[1] + sx);
        sum[4] += m[4] + cy * m[1] + cx * sy;
        sum[5] += m[5] + cy * (m[2] + sy);
        for k in 0..4 {
            sum[6 + k] += color[k];
        }
    }
}
