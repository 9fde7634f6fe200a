//! Textures: colors over surfaces.

use std::sync::Arc;

use glam::{Vec2, Vec3, Vec4};

use crate::mesh::noise;
use crate::mesh::pattern::Pattern;
use crate::mesh::picture::Map;
use crate::mesh::raster::Raster;

/// A texture: linear color as a function of the rest position `p` (within the sphere of radius 0.5) and of (u, v).
/// Colors are linear and within [0, 1].
#[derive(Clone, Debug)]
pub enum Texture {
    /// One color.
    Flat(Vec3),
    /// From `a` to `b` along `direction`, between the projections `range[0]` and `range[1]`.
    Gradient {
        /// Start color.
        a: Vec3,
        /// End color.
        b: Vec3,
        /// Unit direction.
        direction: Vec3,
        /// Projections where it starts and ends.
        range: [f32; 2],
    },
    /// Alternating stripes across `direction`; the share `duty` of each period has color `b`.
    Stripes {
        /// Ground.
        a: Vec3,
        /// Stripe.
        b: Vec3,
        /// Direction across the stripes; its length is the number of periods per unit.
        direction: Vec3,
        /// Phase.
        phase: f32,
        /// Width of a stripe as a share of the period.
        duty: f32,
        /// Width of the soft edge as a share of the period.
        soft: f32,
    },
    /// A solid checkerboard with `scale` cells per unit.
    Checker {
        /// First color.
        a: Vec3,
        /// Second color.
        b: Vec3,
        /// Cells per unit along each axis.
        scale: Vec3,
    },
    /// A checkerboard in (u, v).
    CheckerUv {
        /// First color.
        a: Vec3,
        /// Second color.
        b: Vec3,
        /// Cells along u and v.
        cells: Vec2,
    },
    /// Jittered balls of one color in another.
    Dots {
        /// Ground.
        a: Vec3,
        /// Dots.
        b: Vec3,
        /// Dots per unit.
        scale: f32,
        /// Radius in cells, below 0.6.
        radius: f32,
        /// Noise seed.
        seed: u32,
    },
    /// Fractal noise between two colors.
    Noise {
        /// Color of low values.
        a: Vec3,
        /// Color of high values.
        b: Vec3,
        /// Features per unit, per axis.
        scale: Vec3,
        /// Octaves of noise.
        octaves: u32,
        /// Steepness about the middle value.
        contrast: f32,
        /// Noise seed.
        seed: u32,
    },
    /// Growth rings about an axis with fine grain along it.
    Wood {
        /// Early wood.
        a: Vec3,
        /// Late wood.
        b: Vec3,
        /// Unit axis of the trunk.
        axis: Vec3,
        /// Rings per unit.
        rings: f32,
        /// How much noise bends the rings.
        warp: f32,
        /// Noise seed.
        seed: u32,
    },
    /// Veins along warped planes.
    Marble {
        /// Ground.
        a: Vec3,
        /// Vein.
        b: Vec3,
        /// Direction across the veins; its length is the number of veins per unit.
        direction: Vec3,
        /// How much noise bends the veins.
        warp: f32,
        /// Thinness of the veins.
        sharpness: f32,
        /// Noise seed.
        seed: u32,
    },
    /// Cells with colors between `a` and `b` and seams of color `edge`.
    Voronoi {
        /// Color range of the cells.
        a: Vec3,
        /// Color range of the cells.
        b: Vec3,
        /// Seam color.
        edge: Vec3,
        /// Cells per unit.
        scale: f32,
        /// Seam width in cells.
        width: f32,
        /// Noise seed.
        seed: u32,
    },
    /// Bands along a direction: color `colors[i]` up to the projection `stops[i]`, the last color above.
    Bands {
        /// Unit direction.
        direction: Vec3,
        /// Ascending projections, one fewer than colors.
        stops: Vec<f32>,
        /// Colors, at least one.
        colors: Vec<Vec3>,
    },
    /// A picture over (u, v).
    Print(Arc<Raster>),
    /// A picture from a file; its alpha is the surface's alpha.
    Image(Map),
    /// Woven, knitted, brushed, glazed and other made surfaces.
    Pattern(Box<Pattern>),
    /// Dirt and scratches over another texture.
    Worn(Box<Wear>),
    /// `over` where a thresholded noise is high, else `base`: stains, glaze, crust.
    Patches {
        /// Below the threshold.
        base: Box<Texture>,
        /// Above the threshold.
        over: Box<Texture>,
        /// Features per unit.
        scale: f32,
        /// Threshold of the noise.
        threshold: f32,
        /// Half width of the transition.
        soft: f32,
        /// Noise seed.
        seed: u32,
    },
}

fn smoothstep(lo: f32, hi: f32, x: f32) -> f32 {
    let t = ((x - lo) / (hi - lo).max(1e-6)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

impl Texture {
    /// Linear color and alpha at rest position `p` and surface coordinates `uv`. Pictures from files are averaged over
    /// about the length `footprint` in (u, v).
    pub fn rgba(&self, p: Vec3, uv: Vec2, footprint: f32) -> Vec4 {
        match self {
            Self::Image(map) => map.sample(uv, footprint),
            other => other.color(p, uv).extend(1.0),
        }
    }

    /// Linear color at rest position `p` and surface coordinates `uv`.
    pub fn color(&self, p: Vec3, uv: Vec2) -> Vec3 {
        match self {
            Self::Flat(color) => *color,
            Self::Gradient { a, b, direction, range } => a.lerp(*b, smoothstep(range[0], range[1], p.dot(*direction))),
            Self::Stripes { a, b, direction, phase, duty, soft } => {
                let x = (p.dot(*direction) + phase).rem_euclid(1.0);
                let inside = smoothstep(0.0, *soft, x) * (1.0 - smoothstep(duty - soft, *duty, x));
                a.lerp(*b, inside)
            }
            Self::Checker { a, b, scale } => {
                // An offset keeps cell borders off the planes of symmetry, where faces tend to lie.
                let cell = (p * *scale + Vec3::splat(0.37)).floor().as_ivec3();
                if (cell.x + cell.y + cell.z) & 1 == 0 { *a } else { *b }
            }
            Self::CheckerUv { a, b, cells } => {
                let cell = (uv * *cells).floor().as_ivec2();
                if (cell.x + cell.y) & 1 == 0 { *a } else { *b }
            }
            Self::Dots { a, b, scale, radius, seed } => {
                let (d, _, _) = noise::worley(p * *scale, *seed);
                a.lerp(*b, 1.0 - smoothstep(0.9 * radius, 1.1 * radius, d))
            }
            Self::Noise { a, b, scale, octaves, contrast, seed } => {
                let n = noise::fbm(p * *scale, *seed, *octaves);
                a.lerp(*b, (0.5 + (n - 0.5) * contrast).clamp(0.0, 1.0))
            }
            Self::Wood { a, b, axis, rings, warp, seed } => {
                let along = p.dot(*axis);
                let across = p - along * *axis;
                // Stretch the noise along the grain.
                let q = across * 3.0 + along * *axis * 0.6;
                let radius = (across + Vec3::splat(0.31)).length() + warp * (noise::fbm(q, *seed, 2) - 0.5);
                let ring = (radius * rings).rem_euclid(1.0);
                let late = smoothstep(0.2, 0.85, ring) * (1.0 - smoothstep(0.85, 1.0, ring));
                let grain = noise::value(across * 60.0 + along * *axis * 4.0, seed.wrapping_add(7));
                a.lerp(*b, (0.75 * late + 0.35 * grain).min(1.0))
            }
            Self::Marble { a, b, direction, warp, sharpness, seed } => {
                let x = p.dot(*direction) + warp * (noise::fbm(p * 4.0, *seed, 4) - 0.5);
                let vein = 1.0 - (2.0 * (x - x.floor()) - 1.0).abs();
                a.lerp(*b, vein.powf(*sharpness))
            }
            Self::Voronoi { a, b, edge, scale, width, seed } => {
                let (d1, d2, id) = noise::worley(p * *scale, *seed);
                edge.lerp(a.lerp(*b, noise::unit(id)), smoothstep(0.5 * width, *width, d2 - d1))
            }
            Self::Bands { direction, stops, colors } => {
                let x = p.dot(*direction);
                let i = stops.iter().take_while(|&&s| x > s).count();
                colors.get(i).or(colors.last()).copied().unwrap_or(Vec3::splat(0.5))
            }
            Self::Print(raster) => raster.sample(uv),
            Self::Image(map) => map.sample(uv, 0.0).truncate(),
            Self::Pattern(pattern) => pattern.color(p, uv),
            Self::Worn(wear) => wear.color(p, uv),
            Self::Patches { base, over, scale, threshold, soft, seed } => {
                let t = smoothstep(threshold - soft, threshold + soft, noise::fbm(p * *scale, *seed, 3));
                match t {
                    0.0 => base.color(p, uv),
                    1.0 => over.color(p, uv),
                    _ => base.color(p, uv).lerp(over.color(p, uv), t),
                }
            }
        }
    }
}

/// Stains, dust towards the foot, and scratches over another texture.
#[derive(Clone, Debug)]
pub struct Wear {
    /// What is worn.
    pub base: Texture,
    /// Color of the dirt.
    pub dirt: Vec3,
    /// Strength of stains, of the dirt near the foot, and of scratches, each 0 to 1.
    pub amounts: Vec3,
    /// Stains per unit.
    pub scale: f32,
    /// Noise seed.
    pub seed: u32,
}

impl Wear {
    /// Linear color at rest position `p` and surface coordinates `uv`.
    pub fn color(&self, p: Vec3, uv: Vec2) -> Vec3 {
        let base = self.base.color(p, uv);
        let stain = ((noise::fbm(p * self.scale, self.seed, 4) - 0.52) * 6.0).clamp(0.0, 1.0);
        let low = (-0.1 - p.z).clamp(0.0, 0.4) * 2.5 * noise::value(p * 11.0, self.seed ^ 1);
        let soil = (self.amounts.x * stain + self.amounts.y * low).clamp(0.0, 0.85);
        let color = base.lerp(self.dirt, soil);
        if self.amounts.z == 0.0 {
            return color;
        }
        // Scratches: thin level lines of a stretched noise.
        let n = noise::value(Vec3::new(p.x * 3.0 + p.z, p.y * 3.0 - p.z, p.z * 22.0), self.seed ^ 2);
        let scratch = if (n - 0.5).abs() < 0.012 { self.amounts.z } else { 0.0 };
        let pale = (1.5 * color + 0.08).min(Vec3::ONE);
        color.lerp(pale, scratch).clamp(Vec3::ZERO, Vec3::ONE)
    }
}
