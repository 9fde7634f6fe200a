//! Small pictures that are drawn, not read.

use std::sync::LazyLock;

use glam::{Vec2, Vec3};

use crate::mesh::srgb::{linear_to_srgb, srgb_to_linear};

static DECODE: LazyLock<[f32; 256]> = LazyLock::new(|| std::array::from_fn(|i| srgb_to_linear(i as f32 / 255.0)));

/// A small sRGB-encoded picture, row 0 at the top.
#[derive(Clone, Debug, PartialEq)]
pub struct Raster {
    width: usize,
    height: usize,
    pixels: Vec<[u8; 4]>,
}

impl Raster {
    /// A picture of one color (linear). Sides of zero become one.
    pub fn new(width: usize, height: usize, fill: Vec3) -> Self {
        let (width, height) = (width.max(1), height.max(1));
        Self { width, height, pixels: vec![encode(fill); width * height] }
    }

    /// A picture of sRGB-encoded pixels, row 0 at the top. Both sides are at least 1.
    pub fn from_encoded(width: usize, height: usize, pixels: Vec<[u8; 4]>) -> Self {
        debug_assert_eq!(pixels.len(), width * height);
        Self { width, height, pixels }
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Sets a pixel to a linear color; ignores points outside.
    pub fn set(&mut self, x: i32, y: i32, color: Vec3) {
        if x >= 0 && y >= 0 && (x as usize) < self.width && (y as usize) < self.height {
            self.pixels[y as usize * self.width + x as usize] = encode(color);
        }
    }

    /// Mean color, linear.
    pub fn mean(&self) -> Vec3 {
        let decode = |e: u8| f64::from(DECODE[e as usize]);
        let sum: glam::DVec3 =
            self.pixels.iter().map(|&[r, g, b, _]| glam::DVec3::new(decode(r), decode(g), decode(b))).sum();
        (sum / self.pixels.len() as f64).as_vec3()
    }

    /// Bilinear look-up in linear light; v points up, u wraps around, v is clamped.
    pub fn sample(&self, uv: Vec2) -> Vec3 {
        let x = uv.x.rem_euclid(1.0) * self.width as f32 - 0.5;
        let y = ((1.0 - uv.y) * self.height as f32 - 0.5).clamp(0.0, (self.height - 1) as f32);
        let (x0, y0) = (x.floor(), y.floor());
        let (fx, fy) = (x - x0, y - y0);
        let wrap = |x: i32| x.rem_euclid(self.width as i32) as usize;
        let (x0, x1) = (wrap(x0 as i32), wrap(x0 as i32 + 1));
        let y0 = y0 as usize;
        let y1 = (y0 + 1).min(self.height - 1);
        let at = |x: usize, y: usize| {
            let [r, g, b, _] = self.pixels[y * self.width + x];
            Vec3::new(DECODE[r as usize], DECODE[g as usize], DECODE[b as usize])
        };
        at(x0, y0).lerp(at(x1, y0), fx).lerp(at(x0, y1).lerp(at(x1, y1), fx), fy)
    }
}

fn encode(c: Vec3) -> [u8; 4] {
    let e = |x: f32| (linear_to_srgb(x) * 255.0 + 0.5) as u8;
    [e(c.x), e(c.y), e(c.z), 255]
}
