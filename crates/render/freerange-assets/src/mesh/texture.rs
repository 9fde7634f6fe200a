//! Materials and the textures that colour them.

use std::sync::{Arc, LazyLock};

use glam::{Vec2, Vec3, Vec4};

use crate::mesh::noise;
use crate::mesh::pattern::{Pattern, Wear};
use crate::mesh::picture::Map;

/// Encodes one linear value as sRGB; clamps to [0, 1].
pub fn linear_to_srgb(x: f32) -> f32 {
    let x = x.clamp(0.0, 1.0);
    if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.powf(1.0 / 2.4) - 0.055 }
}

/// Decodes one sRGB value in [0, 1] to linear.
pub fn srgb_to_linear(x: f32) -> f32 {
    if x <= 0.040_45 { x / 12.92 } else { ((x + 0.055) / 1.055).powf(2.4) }
}

static DECODE: LazyLock<[f32; 256]> = LazyLock::new(|| std::array::from_fn(|i| srgb_to_linear(i as f32 / 255.0)));

/// A small sRGB-encoded picture, row 0 at the top.
#[derive(Clone, Debug, PartialEq)]
pub struct Raster {
    width: usize,
    height: usize,
    pixels: Vec<[u8; 4]>,
}

impl Raster {
    /// A picture of one colour (linear). Sides of zero become one.
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

    /// Sets a pixel to a linear colour; ignores points outside.
    pub fn set(&mut self, x: i32, y: i32, color: Vec3) {
        if x >= 0 && y >= 0 && (x as usize) < self.width && (y as usize) < self.height {
            self.pixels[y as usize * self.width + x as usize] = encode(color);
        }
    }

    /// Mean colour, linear.
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

/// A texture: linear colour as a function of the rest position `p` (within the sphere of radius 0.5) and of (u, v).
/// Colours are linear and within [0, 1].
#[derive(Clone, Debug)]
pub enum Texture {
    /// One colour.
    Flat(Vec3),
    /// From `a` to `b` along `direction`, between the projections `range[0]` and `range[1]`.
    Gradient {
        /// Start colour.
        a: Vec3,
        /// End colour.
        b: Vec3,
        /// Unit direction.
        direction: Vec3,
        /// Projections where it starts and ends.
        range: [f32; 2],
    },
    /// Alternating stripes across `direction`; the share `duty` of each period has colour `b`.
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
        /// First colour.
        a: Vec3,
        /// Second colour.
        b: Vec3,
        /// Cells per unit along each axis.
        scale: Vec3,
    },
    /// A checkerboard in (u, v).
    CheckerUv {
        /// First colour.
        a: Vec3,
        /// Second colour.
        b: Vec3,
        /// Cells along u and v.
        cells: Vec2,
    },
    /// Jittered balls of one colour in another.
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
    /// Fractal noise between two colours.
    Noise {
        /// Colour of low values.
        a: Vec3,
        /// Colour of high values.
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
    /// Cells with colours between `a` and `b` and seams of colour `edge`.
    Voronoi {
        /// Colour range of the cells.
        a: Vec3,
        /// Colour range of the cells.
        b: Vec3,
        /// Seam colour.
        edge: Vec3,
        /// Cells per unit.
        scale: f32,
        /// Seam width in cells.
        width: f32,
        /// Noise seed.
        seed: u32,
    },
    /// Bands along a direction: colour `colors[i]` up to the projection `stops[i]`, the last colour above.
    Bands {
        /// Unit direction.
        direction: Vec3,
        /// Ascending projections, one fewer than colours.
        stops: Vec<f32>,
        /// Colours, at least one.
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
    /// Linear colour and alpha at rest position `p` and surface coordinates `uv`. Pictures from files are averaged over
    /// about the length `footprint` in (u, v).
    pub fn rgba(&self, p: Vec3, uv: Vec2, footprint: f32) -> Vec4 {
        match self {
            Self::Image(map) => map.sample(uv, footprint),
            other => other.color(p, uv).extend(1.0),
        }
    }

    /// Linear colour at rest position `p` and surface coordinates `uv`.
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

/// What the alpha of a surface means.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum AlphaMode {
    /// Nothing: the surface is opaque.
    #[default]
    Opaque,
    /// Where it is below the cutoff there is no surface; elsewhere it is opaque.
    Mask {
        /// Least alpha of the surface that is there.
        cutoff: f32,
    },
    /// How much of what lies behind the surface hides.
    Blend,
}

/// How a surface reflects light: a coloured base under a clear specular layer, or a metal.
#[derive(Clone, Debug)]
pub struct Material {
    /// Base colour.
    pub texture: Texture,
    /// Multiplied onto the base colour and its alpha; linear.
    pub factor: Vec4,
    /// What the alpha of the base colour means.
    pub alpha: AlphaMode,
    /// Amplitude of a slow brightness variation over the surface, 0 for none.
    pub variation: f32,
    /// Seed of that variation.
    pub seed: u32,
    /// Specular reflectance at normal incidence of the clear layer; 0.04 for most things, 0 for none.
    pub specular: f32,
    /// Roughness of the reflection, 0.1 (polished) to 1 (matt).
    pub roughness: f32,
    /// 1 for metals: the base colour tints the reflection and nothing is diffuse.
    pub metallic: f32,
    /// Linear values multiplied onto roughness (green) and metallic (blue), as in glTF.
    pub metallic_roughness: Option<Map>,
    /// Normals in tangent space as in glTF (x along u, y up in the picture, z outwards), with the scale of x and y.
    pub normal_map: Option<(Map, f32)>,
    /// Light that the surface gives off; linear radiance.
    pub emission: Vec3,
    /// Colours multiplied onto `emission`.
    pub emission_map: Option<Map>,
    /// Shows its base colour as it is, whatever the light.
    pub unlit: bool,
}

impl Default for Material {
    /// White and matt.
    fn default() -> Self {
        Self {
            texture: Texture::Flat(Vec3::ONE),
            factor: Vec4::ONE,
            alpha: AlphaMode::Opaque,
            variation: 0.0,
            seed: 0,
            specular: 0.0,
            roughness: 1.0,
            metallic: 0.0,
            metallic_roughness: None,
            normal_map: None,
            emission: Vec3::ZERO,
            emission_map: None,
            unlit: false,
        }
    }
}

impl Material {
    /// A matt material without a specular layer.
    pub fn matt(texture: Texture) -> Self {
        Self { texture, ..Self::default() }
    }

    /// Linear base colour at rest position `p` and surface coordinates `uv`, within [0, 1].
    pub fn albedo(&self, p: Vec3, uv: Vec2) -> Vec3 {
        self.rgba(p, uv, Vec4::ONE, 0.0).truncate()
    }

    /// Linear base colour and alpha at rest position `p` and surface coordinates `uv`, times `tint`, within [0, 1].
    /// Pictures are averaged over about the length `footprint` in (u, v).
    pub fn rgba(&self, p: Vec3, uv: Vec2, tint: Vec4, footprint: f32) -> Vec4 {
        let mut color = self.texture.rgba(p, uv, footprint) * self.factor * tint;
        if self.variation != 0.0 {
            let n = noise::fbm(p * 7.0, self.seed, 2) - 0.5;
            color = (color.truncate() * (1.0 + 2.0 * self.variation * n)).extend(color.w);
        }
        color.clamp(Vec4::ZERO, Vec4::ONE)
    }

    /// True if some property comes from a picture of a file.
    pub fn has_pictures(&self) -> bool {
        matches!(self.texture, Texture::Image(_))
            || self.metallic_roughness.is_some()
            || self.normal_map.is_some()
            || self.emission_map.is_some()
    }

    /// Light given off at surface coordinates `uv`; linear. Pictures are averaged over about the length `footprint`.
    pub fn emitted(&self, uv: Vec2, footprint: f32) -> Vec3 {
        match &self.emission_map {
            Some(map) if self.emission != Vec3::ZERO => self.emission * map.sample(uv, footprint).truncate(),
            _ => self.emission,
        }
    }

    /// How much of what lies behind a surface of that alpha is hidden, within [0, 1].
    pub fn opacity(&self, alpha: f32) -> f32 {
        match self.alpha {
            AlphaMode::Opaque => 1.0,
            AlphaMode::Mask { cutoff } => f32::from(u8::from(alpha >= cutoff)),
            AlphaMode::Blend => alpha.clamp(0.0, 1.0),
        }
    }
}
