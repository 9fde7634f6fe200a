//! Materials: how a surface reflects light, lets it through and gives it off.

use glam::{Vec2, Vec3, Vec4};

use crate::mesh::noise;
use crate::mesh::picture::Map;
use crate::mesh::texture::Texture;

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

/// How a surface reflects light: a colored base under a clear specular layer, or a metal.
#[derive(Clone, Debug)]
pub struct Material {
    /// Base color.
    pub texture: Texture,
    /// Multiplied onto the base color and its alpha; linear.
    pub factor: Vec4,
    /// What the alpha of the base color means.
    pub alpha: AlphaMode,
    /// Amplitude of a slow brightness variation over the surface, 0 for none.
    pub variation: f32,
    /// Seed of that variation.
    pub seed: u32,
    /// Specular reflectance at normal incidence of the clear layer; 0.04 for most things, 0 for none.
    pub specular: f32,
    /// Roughness of the reflection, 0.1 (polished) to 1 (matt).
    pub roughness: f32,
    /// 1 for metals: the base color tints the reflection and nothing is diffuse.
    pub metallic: f32,
    /// Linear values multiplied onto roughness (green) and metallic (blue), as in glTF.
    pub metallic_roughness: Option<Map>,
    /// Normals in tangent space as in glTF (x along u, y up in the picture, z outwards), with the scale of x and y.
    pub normal_map: Option<(Map, f32)>,
    /// Light that the surface gives off; linear radiance.
    pub emission: Vec3,
    /// Colors multiplied onto `emission`.
    pub emission_map: Option<Map>,
    /// Shows its base color as it is, whatever the light.
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

    /// Linear base color at rest position `p` and surface coordinates `uv`, within [0, 1].
    pub fn albedo(&self, p: Vec3, uv: Vec2) -> Vec3 {
        self.rgba(p, uv, Vec4::ONE, 0.0).truncate()
    }

    /// Linear base color and alpha at rest position `p` and surface coordinates `uv`, times `tint`, within [0, 1].
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
