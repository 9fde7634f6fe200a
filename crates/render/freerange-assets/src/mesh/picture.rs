//! Pictures from files, laid over a surface.

use std::sync::{Arc, LazyLock};

use glam::{Affine2, Vec2, Vec4};
use image::RgbaImage;

use crate::mesh::srgb::{linear_to_srgb, srgb_to_linear};

static SRGB: LazyLock<[f32; 256]> = LazyLock::new(|| std::array::from_fn(|i| srgb_to_linear(i as f32 / 255.0)));
static LINEAR: LazyLock<[f32; 256]> = LazyLock::new(|| std::array::from_fn(|i| i as f32 / 255.0));

/// What lies beyond the border of a picture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Wrap {
    /// The picture again.
    #[default]
    Repeat,
    /// The picture mirrored.
    Mirror,
    /// The color of the border.
    Clamp,
}

impl Wrap {
    /// The pixel at place `i` of a row or column of `n`.
    fn index(self, i: i64, n: i64) -> usize {
        let k = match self {
            Self::Repeat => i.rem_euclid(n),
            Self::Clamp => i.clamp(0, n - 1),
            Self::Mirror => {
                let k = i.rem_euclid(2 * n);
                k.min(2 * n - 1 - k)
            }
        };
        k as usize
    }
}

/// One size of a picture.
#[derive(Clone, Debug, PartialEq)]
struct Level {
    width: usize,
    height: usize,
    pixels: Vec<[u8; 4]>,
}

/// A picture of 8-bit RGBA, row 0 at the top, together with its smaller copies down to one pixel.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    levels: Vec<Level>,
    srgb: bool,
}

impl Picture {
    /// Makes the smaller copies, each half as wide and high. Colors are averaged in linear light, and those of an
    /// `srgb` picture by the weight of their alpha. Without `srgb` the values are data, taken as linear. An empty
    /// image becomes one white pixel.
    pub fn new(image: RgbaImage, srgb: bool) -> Self {
        let (width, height) = (image.width() as usize, image.height() as usize);
        let pixels: Vec<[u8; 4]> = image.pixels().map(|p| p.0).collect();
        let first = if pixels.is_empty() {
            Level { width: 1, height: 1, pixels: vec![[255; 4]] }
        } else {
            Level { width, height, pixels }
        };
        let mut levels = vec![first];
        while let Some(next) = levels.last().and_then(|last| halved(last, srgb)) {
            levels.push(next);
        }
        Self { levels, srgb }
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.levels[0].width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.levels[0].height
    }

    /// Pixels of the picture, without its smaller copies.
    pub fn pixels(&self) -> &[[u8; 4]] {
        &self.levels[0].pixels
    }

    /// Whether the colors are sRGB-encoded.
    pub fn is_srgb(&self) -> bool {
        self.srgb
    }

    /// True if some pixel's alpha is below 255.
    pub fn has_alpha(&self) -> bool {
        self.pixels().iter().any(|p| p[3] != 255)
    }

    /// Linear color and alpha at `uv`, where (0, 0) is the upper left corner of the picture and (1, 1) the lower
    /// right, averaged over about `footprint` pixels of the full picture along each axis: the two nearest of the
    /// smaller copies, each bilinear, are blended.
    pub fn sample(&self, uv: Vec2, footprint: f32, wrap: [Wrap; 2]) -> Vec4 {
        let level = if footprint > 1.0 { footprint.log2().min((self.levels.len() - 1) as f32) } else { 0.0 };
        let (i, t) = (level as usize, level.fract());
        let a = self.bilinear(i, uv, wrap);
        if t == 0.0 { a } else { a.lerp(self.bilinear(i + 1, uv, wrap), t) }
    }

    fn bilinear(&self, level: usize, uv: Vec2, wrap: [Wrap; 2]) -> Vec4 {
        let Level { width, height, pixels } = &self.levels[level];
        // Beyond 1e9 pixels coordinates mean nothing, but must stay finite.
        let place = |v: f32, size: usize| (v * size as f32 - 0.5).clamp(-1e9, 1e9);
        let (x, y) = (place(uv.x, *width), place(uv.y, *height));
        let (x0, y0) = (x.floor(), y.floor());
        let (fx, fy) = (x - x0, y - y0);
        let columns = pair(wrap[0], x0 as i64, *width);
        let rows = pair(wrap[1], y0 as i64, *height).map(|r| r * width);
        let decode: &[f32; 256] = if self.srgb { &SRGB } else { &LINEAR };
        let at = |i: usize| {
            let [r, g, b, a] = pixels[i];
            let d = |v: u8| decode[usize::from(v)];
            Vec4::new(d(r), d(g), d(b), f32::from(a) * (1.0 / 255.0))
        };
        let top = at(rows[0] + columns[0]).lerp(at(rows[0] + columns[1]), fx);
        let bottom = at(rows[1] + columns[0]).lerp(at(rows[1] + columns[1]), fx);
        top.lerp(bottom, fy)
    }
}

/// The pixels at places `i` and `i + 1` of a row or column.
fn pair(wrap: Wrap, i: i64, n: usize) -> [usize; 2] {
    // Within the picture all ways of wrapping agree, and need no division.
    if i >= 0 && i + 1 < n as i64 {
        return [i as usize, i as usize + 1];
    }
    [wrap.index(i, n as i64), wrap.index(i + 1, n as i64)]
}

/// Up to three old pixels with their weights that make one new pixel of `new` along an axis of `old`.
fn spans(old: usize, new: usize) -> Vec<(usize, [f32; 3])> {
    let ratio = old as f64 / new as f64;
    (0..new)
        .map(|i| {
            let (lo, hi) = (i as f64 * ratio, (i + 1) as f64 * ratio);
            let first = lo as usize;
            let share = |k: usize| {
                let k = (first + k) as f64;
                ((hi.min(k + 1.0) - lo.max(k)).max(0.0) / ratio) as f32
            };
            (first, [share(0), share(1), share(2)])
        })
        .collect()
}

/// The next smaller copy; none of a single pixel.
fn halved(from: &Level, srgb: bool) -> Option<Level> {
    if from.width == 1 && from.height == 1 {
        return None;
    }
    let (width, height) = ((from.width / 2).max(1), (from.height / 2).max(1));
    let (columns, rows) = (spans(from.width, width), spans(from.height, height));
    let decode: &[f32; 256] = if srgb { &SRGB } else { &LINEAR };
    let encode = |v: f32| if srgb { linear_to_srgb(v) } else { v };
    let mut pixels = Vec::with_capacity(width * height);
    for &(y, wy) in &rows {
        for &(x, wx) in &columns {
            let (mut sum, mut weighted, mut weight) = (Vec4::ZERO, Vec4::ZERO, 0.0);
            for (dy, wy) in wy.into_iter().enumerate().filter(|w| w.1 > 0.0) {
                for (dx, wx) in wx.into_iter().enumerate().filter(|w| w.1 > 0.0) {
                    let (px, py) = ((x + dx).min(from.width - 1), (y + dy).min(from.height - 1));
                    let [r, g, b, a] = from.pixels[py * from.width + px];
                    let d = |v: u8| decode[usize::from(v)];
                    let (c, w) = (Vec4::new(d(r), d(g), d(b), f32::from(a) / 255.0), wx * wy);
                    sum += w * c;
                    weighted += w * c.w * c;
                    weight += w * c.w;
                }
            }
            let color = if srgb && weight > 0.0 { weighted / weight } else { sum };
            let code = |v: f32| (v * 255.0 + 0.5) as u8;
            pixels.push([code(encode(color.x)), code(encode(color.y)), code(encode(color.z)), code(sum.w)]);
        }
    }
    Some(Level { width, height, pixels })
}

/// A picture laid over a surface by its (u, v).
#[derive(Clone, Debug)]
pub struct Map {
    /// The picture.
    pub picture: Arc<Picture>,
    /// Picture coordinates from the mesh's (u, v); v runs down, as in glTF: (0, 0) is the upper left.
    pub transform: Affine2,
    /// What lies beyond the borders, along u and along v.
    pub wrap: [Wrap; 2],
}

impl Map {
    /// Lays a picture over the unit square of (u, v), repeated beyond.
    pub fn new(picture: Arc<Picture>) -> Self {
        Self { picture, transform: Affine2::IDENTITY, wrap: [Wrap::Repeat; 2] }
    }

    /// Linear color and alpha at the mesh's `uv`, averaged over about the length `footprint` in (u, v).
    pub fn sample(&self, uv: Vec2, footprint: f32) -> Vec4 {
        let (w, h) = (self.picture.width() as f32, self.picture.height() as f32);
        let scale = (self.transform.matrix2.determinant().abs() * w * h).sqrt();
        self.picture.sample(self.transform.transform_point2(uv), footprint * scale, self.wrap)
    }
}
