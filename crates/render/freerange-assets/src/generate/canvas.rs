//! A small anti-aliased drawing surface for generated prints: filled shapes given by distances, and strokes.

use glam::Vec2;
use glam::Vec3;

use crate::mesh::{Raster, linear_to_srgb};

/// An sRGB-encoded color, 0 to 255 per channel. Shapes are blended in this space: encoding each pixel would cost
/// more than drawing it.
pub type Ink = Vec3;

/// Encodes a linear color.
pub fn ink(linear: Vec3) -> Ink {
    255.0 * Vec3::new(linear_to_srgb(linear.x), linear_to_srgb(linear.y), linear_to_srgb(linear.z))
}

/// A picture under construction, in pixels; y runs down.
pub struct Canvas {
    width: usize,
    height: usize,
    pixels: Vec<[u8; 4]>,
}

impl Canvas {
    pub fn new(width: usize, height: usize, fill: Ink) -> Self {
        let (width, height) = (width.max(1), height.max(1));
        Self { width, height, pixels: vec![bytes(fill); width * height] }
    }

    pub fn size(&self) -> Vec2 {
        Vec2::new(self.width as f32, self.height as f32)
    }

    pub fn into_raster(self) -> Raster {
        Raster::from_encoded(self.width, self.height, self.pixels)
    }

    /// Blends `f(pixel center) = (color, coverage)` over the pixels of the box.
    pub fn paint(&mut self, lo: Vec2, hi: Vec2, mut f: impl FnMut(Vec2) -> (Ink, f32)) {
        let [x0, x1] = range(lo.x, hi.x, self.width);
        let [y0, y1] = range(lo.y, hi.y, self.height);
        for y in y0..y1 {
            let row = &mut self.pixels[y * self.width..][..self.width];
            for (x, pixel) in row.iter_mut().enumerate().take(x1).skip(x0) {
                let (color, cover) = f(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
                if cover >= 1.0 {
                    *pixel = bytes(color);
                } else if cover > 0.0 {
                    let [r, g, b, _] = *pixel;
                    let below = Vec3::new(f32::from(r), f32::from(g), f32::from(b));
                    *pixel = bytes(below.lerp(color, cover));
                }
            }
        }
    }

    /// Fills where the signed distance is negative, with a soft edge of one pixel.
    pub fn fill(&mut self, lo: Vec2, hi: Vec2, color: Ink, distance: impl Fn(Vec2) -> f32) {
        self.paint(lo - 1.0, hi + 1.0, |p| (color, 0.5 - distance(p)));
    }

    pub fn rect(&mut self, lo: Vec2, hi: Vec2, color: Ink) {
        let (center, half) = (0.5 * (lo + hi), 0.5 * (hi - lo));
        self.fill(lo, hi, color, |p| ((p - center).abs() - half).max_element());
    }

    pub fn rounded(&mut self, lo: Vec2, hi: Vec2, radius: f32, color: Ink) {
        let (center, half) = (0.5 * (lo + hi), 0.5 * (hi - lo));
        let r = radius.min(half.min_element()).max(0.0);
        self.fill(lo, hi, color, |p| {
            let q = (p - center).abs() - half + r;
            q.max(Vec2::ZERO).length() + q.max_element().min(0.0) - r
        });
    }

    pub fn ellipse(&mut self, center: Vec2, half: Vec2, color: Ink) {
        self.fill(center - half, center + half, color, |p| ellipse_distance(p - center, half));
    }

    /// A shape of the polar form |p| <= radius * outline(angle).
    pub fn polar(&mut self, center: Vec2, radius: f32, color: Ink, outline: impl Fn(f32) -> f32) {
        let reach = Vec2::splat(1.5 * radius);
        self.fill(center - reach, center + reach, color, |p| {
            let q = p - center;
            q.length() - radius * outline(q.y.atan2(q.x))
        });
    }

    /// A curve of the given half width; the width may taper to `end` times that at its last point.
    pub fn stroke(&mut self, points: &[Vec2], half: f32, end: f32, color: Ink) {
        let last = (points.len().max(2) - 2) as f32 + 1.0;
        for (i, pair) in points.windows(2).enumerate() {
            let at = |t: f32| half * (1.0 + (end - 1.0) * t / last);
            let (r0, r1) = (at(i as f32), at(i as f32 + 1.0));
            let reach = Vec2::splat(r0.max(r1));
            let (a, b) = (pair[0], pair[1]);
            self.fill(a.min(b) - reach, a.max(b) + reach, color, |p| {
                let (d, t) = segment(p, a, b);
                d - r0 - (r1 - r0) * t
            });
        }
    }
}

/// About the distance to an ellipse: exact on it, and its sign everywhere.
pub fn ellipse_distance(p: Vec2, half: Vec2) -> f32 {
    let half = half.max(Vec2::splat(1e-3));
    let (q, g) = (p / half, p / (half * half));
    let k = q.length();
    if k < 1e-6 { -half.min_element() } else { k * (k - 1.0) / g.length().max(1e-9) }
}

/// Distance to a segment, and where along it (0 to 1) the nearest point lies.
pub fn segment(p: Vec2, a: Vec2, b: Vec2) -> (f32, f32) {
    let (d, q) = (b - a, p - a);
    let t = (q.dot(d) / d.length_squared().max(1e-12)).clamp(0.0, 1.0);
    ((q - t * d).length(), t)
}

fn range(lo: f32, hi: f32, size: usize) -> [usize; 2] {
    // Casts saturate, so boxes outside the picture give empty ranges.
    [lo.floor().max(0.0) as usize, (hi.ceil().max(0.0) as usize).min(size)]
}

fn bytes(c: Ink) -> [u8; 4] {
    [(c.x + 0.5) as u8, (c.y + 0.5) as u8, (c.z + 0.5) as u8, 255]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_cover_their_area_and_nothing_outside() {
        let mut c = Canvas::new(64, 48, Vec3::ZERO);
        c.ellipse(Vec2::new(30.0, 20.0), Vec2::new(16.0, 9.0), Vec3::splat(255.0));
        let sum: f32 = c.pixels.iter().map(|p| f32::from(p[0]) / 255.0).sum();
        let area = std::f32::consts::PI * 16.0 * 9.0;
        assert!((sum - area).abs() < 0.02 * area, "{sum} for {area}");
        c.rect(Vec2::new(-50.0, -50.0), Vec2::new(-10.0, 100.0), Vec3::splat(255.0));
        c.rect(Vec2::new(f32::MAX, 0.0), Vec2::new(f32::MAX, 9.0), Vec3::splat(255.0));
        let again: f32 = c.pixels.iter().map(|p| f32::from(p[0]) / 255.0).sum();
        assert_eq!(sum, again);
    }
}
