//! Random materials.

use std::sync::Arc;

use glam::{Vec2, Vec3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::generate::config::GeneratorConfig;
use crate::generate::decor;
use crate::generate::label::{Face, Product, Scheme};
use crate::generate::palette::{self, Tone};
use crate::mesh::{Material, Texture};

/// A number log-uniform in [lo, hi).
pub fn log_range(rng: &mut impl Rng, lo: f32, hi: f32) -> f32 {
    rng.random_range(lo.ln()..hi.ln()).exp()
}

/// A unit vector uniform over the sphere.
pub fn unit_vector(rng: &mut impl Rng) -> Vec3 {
    let z = rng.random_range(-1.0..1.0f32);
    let a = rng.random_range(0.0..std::f32::consts::TAU);
    let r = (1.0 - z * z).max(0.0).sqrt();
    Vec3::new(r * a.cos(), r * a.sin(), z)
}

/// The random choices of one object: its generator and what it draws materials by.
pub struct Style<'a> {
    pub rng: ChaCha8Rng,
    pub config: &'a GeneratorConfig,
    /// The hue family that the object's materials prefer.
    theme: Vec3,
}

impl<'a> Style<'a> {
    pub fn new(mut rng: ChaCha8Rng, config: &'a GeneratorConfig) -> Self {
        let tone = palette::tone(&mut rng, config.white_share);
        let theme = palette::color(&mut rng, tone);
        Self { rng, config, theme }
    }

    pub fn range(&mut self, lo: f32, hi: f32) -> f32 {
        self.rng.random_range(lo..hi)
    }

    pub fn log(&mut self, lo: f32, hi: f32) -> f32 {
        log_range(&mut self.rng, lo, hi)
    }

    pub fn count(&mut self, lo: usize, hi: usize) -> usize {
        self.rng.random_range(lo..hi)
    }

    pub fn chance(&mut self, p: f64) -> bool {
        self.rng.random_bool(p)
    }

    pub fn color(&mut self) -> Vec3 {
        let tone = palette::tone(&mut self.rng, self.config.white_share);
        palette::color(&mut self.rng, tone)
    }

    /// A material of one color with the usual random finish.
    pub fn plain(&mut self, color: Vec3) -> Material {
        self.finish(Texture::Flat(color))
    }

    /// Dark plastic or rubber, as handles and caps have it.
    pub fn dark_plastic(&mut self) -> Material {
        let color = palette::color(&mut self.rng, Tone::Dark);
        self.plain(color)
    }

    /// Any material: plain or patterned, in the object's theme or not.
    pub fn material(&mut self) -> Material {
        if self.chance(0.06) {
            return self.metal();
        }
        let color = if self.chance(0.35) { palette::shade(&mut self.rng, self.theme, 0.4) } else { self.color() };
        let patterned = self.rng.random::<f32>() < self.config.pattern_share;
        let texture = if patterned { self.pattern(color) } else { Texture::Flat(color) };
        self.finish(texture)
    }

    /// Wraps a texture in a random finish: gloss, roughness, slight unevenness.
    pub fn finish(&mut self, texture: Texture) -> Material {
        let glossy = self.rng.random::<f32>() < self.config.gloss_share;
        Material {
            texture,
            variation: if self.chance(0.45) { self.range(0.01, 0.15) } else { 0.0 },
            seed: self.rng.random(),
            specular: if glossy || self.chance(0.6) { self.range(0.03, 0.06) } else { 0.0 },
            roughness: if glossy { self.range(0.12, 0.4) } else { self.range(0.45, 1.0) },
            ..Material::default()
        }
    }

    /// A color to go with `a`: a shade of it, a contrast, or anything.
    pub fn partner(&mut self, a: Vec3) -> Vec3 {
        match self.count(0, 10) {
            0..4 => palette::shade(&mut self.rng, a, 0.8),
            4..8 => palette::contrast(&mut self.rng, a),
            _ => self.color(),
        }
    }

    /// Axis-aligned more often than not; z above all.
    fn axis(&mut self) -> Vec3 {
        match self.count(0, 6) {
            0..3 => Vec3::Z,
            3 => Vec3::X,
            4 => Vec3::Y,
            _ => unit_vector(&mut self.rng),
        }
    }

    /// A patterned texture on the ground color `a`.
    pub fn pattern(&mut self, a: Vec3) -> Texture {
        let b = self.partner(a);
        let seed = self.rng.random();
        match self.count(0, 112) {
            100.. => self.cloth(a),
            0..6 => {
                let direction = self.axis();
                let (lo, hi) = (self.range(-0.4, 0.0), self.range(0.05, 0.4));
                Texture::Gradient { a, b, direction, range: [lo, hi] }
            }
            6..15 => {
                let frequency = self.log(2.0, 20.0);
                let duty = self.range(0.15, 0.6);
                Texture::Stripes {
                    a,
                    b,
                    direction: self.axis() * frequency,
                    phase: self.range(0.0, 1.0),
                    duty,
                    soft: if self.chance(0.7) { 0.02 } else { self.range(0.02, 0.4) * duty },
                }
            }
            15..20 => {
                let s = self.log(3.0, 14.0);
                let scale = if self.chance(0.7) { Vec3::splat(s) } else { Vec3::new(s, s, self.log(3.0, 14.0)) };
                Texture::Checker { a, b, scale }
            }
            20..24 => {
                let cells = Vec2::new(self.count(2, 16) as f32 * 2.0, self.count(2, 12) as f32);
                Texture::CheckerUv { a, b, cells }
            }
            24..31 => Texture::Dots { a, b, scale: self.log(3.0, 14.0), radius: self.range(0.18, 0.5), seed },
            31..47 => {
                let s = self.log(2.0, 40.0);
                let stretch = if self.chance(0.3) { Vec3::new(1.0, 1.0, self.log(0.1, 8.0)) } else { Vec3::ONE };
                Texture::Noise {
                    a,
                    b,
                    scale: s * stretch,
                    octaves: self.rng.random_range(2..5),
                    contrast: self.range(1.2, 5.0),
                    seed,
                }
            }
            47..54 => self.wood(),
            54..60 => Texture::Marble {
                a,
                b,
                direction: self.axis() * self.log(1.5, 8.0),
                warp: self.range(0.3, 2.5),
                sharpness: self.range(1.5, 12.0),
                seed,
            },
            60..67 => {
                let edge = if self.chance(0.5) { palette::shade(&mut self.rng, a, 1.2) } else { self.color() };
                Texture::Voronoi { a, b, edge, scale: self.log(3.0, 16.0), width: self.range(0.03, 0.2), seed }
            }
            67..76 => {
                let n = self.count(2, 6);
                let mut stops: Vec<f32> = (1..n).map(|_| self.rng.random_range(-0.4..0.4)).collect();
                stops.sort_by(f32::total_cmp);
                let colors = (0..n).map(|i| if i % 2 == 0 { a } else { self.partner(a) }).collect();
                Texture::Bands { direction: self.axis(), stops, colors }
            }
            76..84 => self.patches(a, b, seed),
            84..91 => self.speckle(a),
            _ => self.drawing(a),
        }
    }

    /// `b` over `a` where noise is high.
    fn patches(&mut self, a: Vec3, b: Vec3, seed: u32) -> Texture {
        let over = if self.chance(0.5) { self.speckle(b) } else { Texture::Flat(b) };
        Texture::Patches {
            base: Box::new(Texture::Flat(a)),
            over: Box::new(over),
            scale: self.log(2.0, 15.0),
            threshold: self.range(0.4, 0.65),
            soft: if self.chance(0.6) { 0.01 } else { self.range(0.02, 0.15) },
            seed,
        }
    }

    /// Ornaments or a label on the ground color `a`.
    fn drawing(&mut self, a: Vec3) -> Texture {
        let scheme = Scheme { ground: a, ..self.scheme() };
        let (w, h) = (self.count(128, 320), self.count(128, 256));
        if self.chance(0.5) {
            let colors = [scheme.ink, scheme.accent];
            return Texture::Print(Arc::new(decor::decor(&mut self.rng, a, colors, w, h)));
        }
        let face = if self.chance(0.7) { Face::Front } else { Face::Side };
        let product = Product::random(&mut self.rng, &scheme);
        Texture::Print(Arc::new(product.draw(&mut self.rng, face, w, h)))
    }

    /// Small spots on a plain ground, like stoneware.
    pub fn speckle(&mut self, a: Vec3) -> Texture {
        let b = self.partner(a);
        Texture::Dots { a, b, scale: self.log(15.0, 45.0), radius: self.range(0.12, 0.35), seed: self.rng.random() }
    }

    pub fn wood(&mut self) -> Texture {
        let a = palette::color(&mut self.rng, Tone::Brown);
        let b = a * self.range(0.35, 0.75) * Vec3::new(1.0, 0.9, 0.8);
        Texture::Wood {
            a,
            b,
            axis: if self.chance(0.7) {
                [Vec3::X, Vec3::Y, Vec3::Z][self.count(0, 3)]
            } else {
                unit_vector(&mut self.rng)
            },
            rings: self.log(6.0, 40.0),
            warp: self.range(0.05, 0.4),
            seed: self.rng.random(),
        }
    }

    /// Printed card, paper or foil; `size` is the face's width and height in units of which the print has 512 pixels.
    pub fn print(&mut self, product: &Product, face: Face, size: Vec2) -> Material {
        let pixels = (512.0 * size).clamp(Vec2::splat(24.0), Vec2::splat(640.0));
        let raster = product.draw(&mut self.rng, face, pixels.x as usize, pixels.y as usize);
        let mut material = self.finish(Texture::Print(Arc::new(raster)));
        material.variation = material.variation.min(0.06);
        material
    }

    pub fn product(&mut self, scheme: &Scheme) -> Product {
        Product::random(&mut self.rng, scheme)
    }

    /// Painted decoration on a ground color, for a surface of that size (as in [`Style::print`]).
    pub fn decor(&mut self, ground: Vec3, size: Vec2) -> Material {
        let colors = [palette::contrast(&mut self.rng, ground), self.partner(ground)];
        let pixels = (512.0 * size).clamp(Vec2::splat(24.0), Vec2::splat(640.0));
        let raster = decor::decor(&mut self.rng, ground, colors, pixels.x as usize, pixels.y as usize);
        self.finish(Texture::Print(Arc::new(raster)))
    }

    pub fn scheme(&mut self) -> Scheme {
        Scheme::random(&mut self.rng, 0.25)
    }
}
