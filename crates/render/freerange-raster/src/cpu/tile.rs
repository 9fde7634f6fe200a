//! Blending the splats of a band, block by block, and the derivative of that with respect to each splat.
//!
//! One vector lane is one pixel of a block. Everything here is inlined into functions that are compiled for several
//! instruction sets (see `mod.rs`), with loops over lanes that have no branches.

use super::bin::{BAND, BLOCK, CHUNK, Chunk, Lists, blocks_across};
use super::math::{LANES, Pixels, exp2, fma, min};
use super::project::{LOG2_255, SUMS, Splat};
use super::sums;

/// Blending stops before the splat that would take the transmittance to this or below.
pub const MIN_TRANSMITTANCE: f32 = 1e-4;
/// The largest opacity of a splat at a pixel.
pub const MAX_ALPHA: f32 = 0.99;
/// How often, in splats, a block is checked for having become opaque.
const CHECK: usize = 8;

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

/// The state of the pixels of a block between splats.
#[derive(Clone, Copy)]
struct Block {
    /// Transmittance, 0 once blending has stopped.
    t: Pixels,
    rgb: [Pixels; 3],
    depth: Pixels,
    end: End,
}

/// Where blending ended at the pixels of a block.
#[derive(Clone, Copy, Debug)]
struct End {
    /// Transmittance that the background is seen through.
    t: Pixels,
    /// How many of the block's splats were blended: the first ones.
    count: [u32; LANES],
}

/// A band and what it needs to be drawn again, backwards.
#[derive(Debug)]
pub struct Band {
    pub top: usize,
    /// From near to far.
    pub splats: Vec<Splat>,
    chunks: Vec<Chunk>,
    ends: Vec<End>, // [blocks]
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

/// Opacity of `s` at (`dx`, `dy`) from its mean, 0 where below 1/255.
#[inline(always)]
fn opacity<const FMA: bool>(s: &Splat, dx: f32, dy: f32) -> f32 {
    let u = fma::<FMA>(s.l21, dy, s.l11 * dx);
    let v = s.l22 * dy;
    let exponent = fma::<FMA>(-u, u, fma::<FMA>(-v, v, s.log2_opacity));
    // Far away the power is any number, which is not taken.
    let alpha = min(exp2::<FMA>(exponent), MAX_ALPHA);
    if exponent >= -LOG2_255 { alpha } else { 0.0 }
}

/// Pixel centers of the block whose corner is at (`x`, `y`).
#[inline(always)]
fn centers(x: f32, y: f32) -> [Pixels; 2] {
    [X.map(|lane| x + lane), Y.map(|lane| y + lane)]
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
    let end = End { t: [1.0; LANES], count: [0; LANES] };
    let empty = Block { t: [0.0; LANES], rgb: [[0.0; LANES]; 3], depth: [0.0; LANES], end };
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
            let t = block.end.t[l];
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
    Band { top, splats, chunks, ends: blocks.iter().map(|block| block.end).collect() }
}

/// Blends the splats `list` of `run` into the block whose corner is at (`x`, `y`). Whether it can take more.
#[inline(always)]
fn blend<const FMA: bool, const DEPTH: bool>(block: &mut Block, run: &[Splat], list: &[u16], x: f32, y: f32) -> bool {
    let Block { mut t, rgb: [mut red, mut green, mut blue], mut depth, end } = *block;
    let End { t: mut t_final, mut count } = end;
    let [px, py] = centers(x, y);
    let mut open = true;
    for group in list.chunks(CHECK) {
        for &i in group {
            let s = &run[usize::from(i)];
            for l in 0..LANES {
                let alpha = opacity::<FMA>(s, px[l] - s.x, py[l] - s.y);
                let next = t[l] * (1.0 - alpha);
                let go_on = next > MIN_TRANSMITTANCE;
                count[l] += u32::from(go_on);
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
    *block = Block { t, rgb: [red, green, blue], depth, end: End { t: t_final, count } };
    open
}

/// Pulls d loss / d image back to the splats of `band`: `sums` has a row for each, see [`SUMS`]. Returns
/// d loss / d background.
#[inline(always)]
pub fn backward<const FMA: bool, const AVX2: bool, const DEPTH: bool>(
    band: &Band,
    background: [f32; 3],
    grads: &RowGrads,
    sums: &mut [[f32; SUMS]],
) -> [f32; 3] {
    let across = blocks_across(grads.width);
    let mut d_background = [0f32; 3];
    for (i, end) in band.ends.iter().enumerate() {
        let (x0, y0) = (i % across * BLOCK[0], i / across * BLOCK[1]);
        let mut d = [[0f32; LANES]; 4]; // d loss / d (red, green, blue, depth)
        let mut behind = [0f32; LANES]; // the color seen behind the last splat, times d loss / d color
        each_inside(x0, y0, grads.width, grads.height, |l, pixel| {
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
        for c in 0..3 {
            d_background[c] += end.t.iter().zip(&d[c]).map(|(t, d)| t * d).sum::<f32>();
        }
        let centers = centers(x0 as f32, (band.top + y0) as f32);
        far_to_near::<FMA, AVX2, DEPTH>(band, i, centers, behind, &d, sums);
    }
    d_background
}

/// Goes through the splats of `block` from far to near, and adds what they do at its pixels to their rows of `sums`.
///
/// The transmittance in front of a splat follows from that behind it, t / (1 - alpha); what is seen in front of it
/// likewise: behind += alpha (color - behind), where colors are times d loss / d color.
#[inline(always)]
fn far_to_near<const FMA: bool, const AVX2: bool, const DEPTH: bool>(
    band: &Band,
    block: usize,
    [px, py]: [Pixels; 2],
    mut behind: Pixels,
    d: &[Pixels; 4],
    sums: &mut [[f32; SUMS]],
) {
    let End { mut t, count } = band.ends[block];
    let d = *d;
    let blended = count.iter().fold(0, |most, count| most.max(*count as usize));
    let mut first: usize = band.chunks.iter().map(|chunk| chunk.of_block(block).len()).sum();
    for chunk in band.chunks.iter().rev() {
        let list = chunk.of_block(block);
        first -= list.len();
        let list = &list[..list.len().min(blended.saturating_sub(first))];
        for (k, &i) in list.iter().enumerate().rev() {
            let (k, i) = ((first + k) as u32, chunk.first + usize::from(i));
            let s = &band.splats[i];
            let mut pixels = sums::Terms::default();
            for l in 0..LANES {
                let (dx, dy) = (px[l] - s.x, py[l] - s.y);
                let alpha = opacity::<FMA>(s, dx, dy);
                let alpha = if k < count[l] { alpha } else { 0.0 };
                t[l] /= 1.0 - alpha;
                let weight = alpha * t[l];
                let mut color = s.color[0] * d[0][l];
                color = fma::<FMA>(s.color[1], d[1][l], color);
                color = fma::<FMA>(s.color[2], d[2][l], color);
                if DEPTH {
                    color = fma::<FMA>(s.depth, d[3][l], color);
                }
                let difference = color - behind[l];
                behind[l] = fma::<FMA>(alpha, difference, behind[l]);
                // d loss / d ln(alpha). No derivative through the upper bound on alpha.
                pixels.g[l] = if alpha < MAX_ALPHA { weight * difference } else { 0.0 };
                pixels.weight[l] = weight;
                pixels.dx[l] = dx;
                pixels.dy[l] = dy;
            }
            sums::add::<AVX2, DEPTH>(&pixels, &d, &mut sums[i]);
        }
    }
}
