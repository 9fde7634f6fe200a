//! Small vectors, and the layout of what the kernels hand to each other.

use cubecl::prelude::*;

/// Three floats.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
pub struct V3 {
    pub x: f32,
    pub y: f32,
    pub z: f32,
}

#[cube]
pub fn vec3(x: f32, y: f32, z: f32) -> V3 {
    V3 { x, y, z }
}

#[cube]
pub fn dot(a: &V3, b: &V3) -> f32 {
    a.x * b.x + a.y * b.y + a.z * b.z
}

#[cube]
pub fn cross(a: &V3, b: &V3) -> V3 {
    V3 { x: a.y * b.z - a.z * b.y, y: a.z * b.x - a.x * b.z, z: a.x * b.y - a.y * b.x }
}

#[cube]
pub fn add(a: &V3, b: &V3) -> V3 {
    V3 { x: a.x + b.x, y: a.y + b.y, z: a.z + b.z }
}

#[cube]
pub fn scaled(a: &V3, by: f32) -> V3 {
    V3 { x: a.x * by, y: a.y * by, z: a.z * by }
}

/// Component by component.
#[cube]
pub fn times(a: &V3, b: &V3) -> V3 {
    V3 { x: a.x * b.x, y: a.y * b.y, z: a.z * b.z }
}

/// `a s + b t`.
#[cube]
pub fn mix(a: &V3, s: f32, b: &V3, t: f32) -> V3 {
    V3 { x: a.x * s + b.x * t, y: a.y * s + b.y * t, z: a.z * s + b.z * t }
}

/// Neither NaN nor infinite, by the bits: compilers for graphics may assume that floats always are.
#[cube]
pub fn finite(v: f32) -> bool {
    (v.to_bits() & 0x7f80_0000u32) != 0x7f80_0000u32
}

/// `e^x`, the argument taken to [-87, 87], where the result is a normal number.
#[cube]
pub fn bounded_exp(x: f32) -> f32 {
    clamp(x, -87.0f32, 87.0f32).exp()
}

/// Four floats in one load.
pub type F4 = Vector<f32, Const<4>>;

#[cube]
pub fn pack(a: f32, b: f32, c: f32, d: f32) -> F4 {
    let mut out = F4::new(a);
    out.insert(1usize, b);
    out.insert(2usize, c);
    out.insert(3usize, d);
    out
}

/// Sizes and limits that all kernels share.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
pub struct Frame {
    /// Images of this group.
    pub images: u32,
    /// Index of the group's first image among all.
    pub first: u32,
    /// Images per object.
    pub views: u32,
    /// Gaussians per object.
    pub n: u32,
    pub width: u32,
    pub height: u32,
    /// Tiles across an image, and in all of it.
    pub tiles_across: u32,
    pub tiles: u32,
    /// Mask words per tile: one bit per Gaussian.
    pub words: u32,
    pub near: f32,
    pub far: f32,
    pub blur: f32,
}
