//! What things are made of: ceramics, fabrics, cane, metals, and the dirt on them.

use glam::{Vec2, Vec3};
use rand::Rng;

use crate::generate::palette::{self, Tone};
use crate::generate::style::Style;
use crate::mesh::{Form, Frame, Pattern, Wear};
use crate::mesh::{Material, Texture};

impl Style<'_> {
    fn pattern_of(&mut self, frame: Frame, form: Form) -> Texture {
        Texture::Pattern(Box::new(Pattern { frame, form, seed: self.rng.random() }))
    }

    fn tone(&mut self, tone: Tone) -> Vec3 {
        palette::color(&mut self.rng, tone)
    }

    /// Two skew directions for flat patterns on solids: they differ on every axis, so no face is without pattern.
    fn skew(&mut self, cells: f32) -> Frame {
        let (a, b) = (Vec3::new(0.8, 0.6, 0.0), Vec3::new(-0.25, 0.35, 0.9));
        let turn = glam::Quat::from_rotation_z(self.range(0.0, 1.5));
        Frame::Solid([turn * a * cells, turn * b * cells])
    }

    /// Porcelain, stoneware, earthenware: plain, speckled, glazed; usually glossy.
    pub fn ceramic(&mut self) -> Material {
        let color = if self.chance(0.45) { self.tone(Tone::White) } else { self.color() };
        let texture = match self.count(0, 12) {
            0..6 => Texture::Flat(color),
            6 => self.speckle(color),
            7..10 => {
                let clay_tone = if self.chance(0.6) { Tone::Brown } else { Tone::White };
                let clay = self.tone(clay_tone);
                let (height, run) = (self.range(-0.35, 0.3), self.range(0.05, 0.5));
                let frame = Frame::Uv(Vec2::ONE);
                self.pattern_of(frame, Form::Glaze { glaze: color, clay, height, run })
            }
            10 => {
                let chips = [self.color(), self.color(), self.tone(Tone::Dark)];
                let scale = self.log(9.0, 26.0);
                self.pattern_of(Frame::Uv(Vec2::ONE), Form::Terrazzo { ground: color, chips, scale })
            }
            _ => self.pattern(color),
        };
        let glazed = self.chance(0.65);
        let mut material = self.finish(texture);
        if glazed {
            material.specular = self.range(0.035, 0.06);
            material.roughness = self.range(0.1, 0.3);
        }
        self.worn(material, 0.12)
    }

    /// Cane, rush, paper cord or fabric in a weave; `frame` says where its strands run.
    pub fn woven(&mut self, frame: Frame) -> Material {
        let warp_tone = if self.chance(0.65) { Tone::Brown } else { Tone::Pastel };
        let warp = self.tone(warp_tone);
        let weft = if self.chance(0.6) { palette::shade(&mut self.rng, warp, 0.35) } else { self.color() };
        let float = self.rng.random_range(1..4);
        let form = Form::Weave { warp, weft, gap: 0.12 * warp, float, thin: self.range(0.7, 1.0) };
        let texture = self.pattern_of(frame, form);
        Material { roughness: self.range(0.5, 0.9), specular: 0.03, ..Material::matt(texture) }
    }

    /// A texture of cloth: woven, knitted, plaid, striped, zigzag.
    pub fn cloth(&mut self, a: Vec3) -> Texture {
        let b = palette::contrast(&mut self.rng, a);
        match self.count(0, 5) {
            0 => {
                let (cells, weft) = (self.log(14.0, 40.0), palette::shade(&mut self.rng, a, 0.6));
                let frame = self.skew(cells);
                let float = self.rng.random_range(1..4);
                self.pattern_of(frame, Form::Weave { warp: a, weft, gap: 0.2 * a, float, thin: 0.95 })
            }
            1 => {
                let cells = self.log(14.0, 34.0);
                let frame = Frame::Around((4.0 * cells).round(), 1.2 * cells);
                let share = self.range(0.0, 0.6);
                self.pattern_of(frame, Form::Knit { a, b, share })
            }
            2 => {
                let cells = self.log(8.0, 26.0);
                let (frame, third) = (self.skew(cells), self.color());
                let hatch = self.range(3.0, 8.0);
                self.pattern_of(frame, Form::Plaid { colors: [a, b, third], hatch })
            }
            3 => {
                let cells = self.log(4.0, 16.0);
                let (frame, steep) = (self.skew(cells), self.range(0.4, 2.0));
                self.pattern_of(frame, Form::Chevron { a, b, steep })
            }
            _ => {
                let direction = Vec3::Z * self.log(3.0, 20.0);
                let (duty, phase) = (self.range(0.15, 0.6), self.range(0.0, 1.0));
                Texture::Stripes { a, b, direction, phase, duty, soft: 0.02 }
            }
        }
    }

    /// Steel, aluminium, brass, copper, iron: brushed, polished or dull.
    pub fn metal(&mut self) -> Material {
        let tint = match self.count(0, 10) {
            // Gold and brass, copper.
            0 => palette::hsv(self.range(0.09, 0.13), self.range(0.4, 0.65), self.range(0.75, 0.92)),
            1 => palette::hsv(self.range(0.03, 0.06), self.range(0.4, 0.6), self.range(0.65, 0.88)),
            // Dark iron and gunmetal.
            2..4 => palette::hsv(0.6, self.range(0.0, 0.08), self.range(0.25, 0.5)),
            _ => palette::hsv(0.6, self.range(0.0, 0.05), self.range(0.55, 0.88)),
        };
        let b = tint * self.range(0.45, 0.85);
        let texture = match self.count(0, 4) {
            // Turned, brushed along, or with slow stains.
            0 => {
                let rows = self.range(4.0, 12.0);
                self.pattern_of(Frame::Around(1.0, rows), Form::Brushed { a: tint, b })
            }
            1 => {
                let frame = Frame::Solid([Vec3::new(2.0, 1.0, 0.0), Vec3::new(-3.0, 6.0, 7.0)]);
                self.pattern_of(frame, Form::Brushed { a: tint, b })
            }
            _ => {
                let scale = Vec3::new(self.range(2.0, 9.0), self.range(2.0, 9.0), self.range(2.0, 9.0));
                let b = palette::shade(&mut self.rng, tint, 0.3);
                Texture::Noise { a: tint, b, scale, octaves: 3, contrast: 1.5, seed: self.rng.random() }
            }
        };
        let material = Material { roughness: self.range(0.15, 0.5), metallic: 1.0, ..Material::matt(texture) };
        self.worn(material, 0.2)
    }

    /// Puts dirt, dust and scratches on some share of materials.
    pub fn worn(&mut self, mut material: Material, share: f64) -> Material {
        if self.chance(share) {
            let tone = if self.chance(0.7) { Tone::Brown } else { Tone::Gray };
            let dirt = self.tone(tone) * self.range(0.2, 0.8);
            let amounts =
                Vec3::new(self.range(0.0, 0.5), self.range(0.0, 0.6), if self.chance(0.4) { 0.6 } else { 0.0 });
            let base = std::mem::replace(&mut material.texture, Texture::Flat(dirt));
            let wear = Wear { base, dirt, amounts, scale: self.log(3.0, 14.0), seed: self.rng.random() };
            material.texture = Texture::Worn(Box::new(wear));
        }
        material
    }

    /// Baked dough: pores and browned patches.
    pub fn crumb(&mut self, crust: Vec3, crumb: Vec3) -> Material {
        let scale = self.log(25.0, 70.0);
        let texture = self.pattern_of(Frame::Uv(Vec2::ONE), Form::Crumb { crust, crumb, scale });
        Material { roughness: 0.9, ..Material::matt(texture) }
    }

    /// Rings about z on a ground, for plates and lids.
    pub fn ringed(&mut self, ground: Vec3) -> Material {
        let b = palette::contrast(&mut self.rng, ground);
        let mut stops = [self.range(0.1, 0.48), self.range(0.1, 0.48), self.range(0.3, 0.49)];
        stops.sort_by(f32::total_cmp);
        let second = if self.chance(0.5) { palette::shade(&mut self.rng, ground, 0.25) } else { b };
        let texture = self.pattern_of(Frame::Uv(Vec2::ONE), Form::Rings { colors: [ground, second, b], stops });
        let mut material = self.finish(texture);
        (material.specular, material.roughness) = (0.045, self.range(0.12, 0.35));
        material
    }

    /// Clear or tinted glass and plastic, opaque: a smooth pale gradient under a polished layer.
    pub fn glass(&mut self) -> Material {
        let hue: f32 = self.rng.random();
        let a = palette::hsv(hue, self.range(0.05, 0.8), self.range(0.3, 0.9));
        let b = a.lerp(Vec3::splat(0.9), self.range(0.2, 0.7));
        let texture =
            Texture::Gradient { a, b, direction: Vec3::Z, range: [self.range(-0.5, -0.1), self.range(0.0, 0.5)] };
        Material { specular: self.range(0.05, 0.09), roughness: self.range(0.1, 0.18), ..Material::matt(texture) }
    }
}
