//! Reflection off rough surfaces: microfacets with the GGX distribution, Smith's masking and Schlick's Fresnel term.
//!
//! Walter et al., "Microfacet models for refraction through rough surfaces" (2007); Heitz, "Understanding the
//! masking-shadowing function" (2014). Light that bounces between facets is added by a factor, as in Turquin,
//! "Practical multiple scattering compensation for microfacet models" (2019).

use std::f32::consts::{PI, TAU};
use std::sync::LazyLock;

use glam::{Vec2, Vec3};

/// Cosines of the viewing angle and roughnesses in [`TABLE`].
const SIZE: usize = 24;

/// Smoother surfaces would need an image of the surroundings, which the light does not keep.
pub const MIN_ROUGHNESS: f32 = 0.12;

/// For surroundings of radiance one: the share of the normal reflectance that is reflected, and the share that is
/// reflected besides, at grazing angles. `[roughness, cosine]`
static TABLE: LazyLock<Vec<Vec2>> = LazyLock::new(|| {
    let at = |i: usize| (i as f32 / (SIZE - 1) as f32).max(0.02);
    (0..SIZE * SIZE).map(|i| split_sum(at(i % SIZE), at(i / SIZE), 24)).collect()
});

/// Smith's auxiliary function.
fn lambda(cos: f32, a2: f32) -> f32 {
    0.5 * ((1.0 + a2 * (1.0 - cos * cos) / (cos * cos)).sqrt() - 1.0)
}

/// Integral of the reflection over directions, with `n` squared samples of the facets seen from `cos`.
fn split_sum(cos: f32, roughness: f32, n: usize) -> Vec2 {
    let a = roughness * roughness;
    let view = Vec3::new((1.0 - cos * cos).sqrt(), 0.0, cos);
    let stretched = (view * Vec3::new(a, a, 1.0)).normalize();
    let (x, y) = (Vec3::Y, stretched.cross(Vec3::Y));
    let mut sum = Vec2::ZERO;
    for i in 0..n * n {
        let (u, v) = (((i / n) as f32 + 0.5) / n as f32, ((i % n) as f32 + 0.5) / n as f32);
        // Heitz, "Sampling the GGX distribution of visible normals" (2018).
        let (r, phi) = (u.sqrt(), TAU * v);
        let p = r * phi.cos();
        let s = 0.5 * (1.0 + stretched.z);
        let q = (1.0 - s) * (1.0 - p * p).sqrt() + s * r * phi.sin();
        let h = p * x + q * y + (1.0 - p * p - q * q).max(0.0).sqrt() * stretched;
        let half = Vec3::new(a * h.x, a * h.y, h.z.max(0.0)).normalize_or_zero();
        let h_v = view.dot(half).max(0.0);
        let light = 2.0 * h_v * half - view;
        if light.z > 0.0 {
            let own = lambda(cos, a * a);
            let passed = (1.0 + own) / (1.0 + own + lambda(light.z, a * a));
            let grazing = (1.0 - h_v).powi(5);
            sum += passed * Vec2::new(1.0 - grazing, grazing);
        }
    }
    sum / (n * n) as f32
}

/// How a point reflects towards the viewer.
pub struct Reflection {
    f0: Vec3,
    cos_eye: f32,
    a2: f32,
    /// Facets' mutual reflections.
    gain: Vec3,
    /// Reflected share of light that comes from everywhere.
    pub total: Vec3,
}

impl Reflection {
    /// Of a surface of reflectance `f0` at normal incidence, seen at the cosine `cos_eye`.
    pub fn new(f0: Vec3, roughness: f32, cos_eye: f32) -> Self {
        let roughness = roughness.clamp(MIN_ROUGHNESS, 1.0);
        let place = |v: f32| (v * (SIZE - 1) as f32).clamp(0.0, (SIZE - 1) as f32 - 1e-3);
        let (x, y) = (place(cos_eye), place(roughness));
        let at = y as usize * SIZE + x as usize;
        let row = |i: usize| TABLE[i].lerp(TABLE[i + 1], x.fract());
        let split = row(at).lerp(row(at + SIZE), y.fract());
        let gain = Vec3::ONE + f0 * (1.0 / (split.x + split.y).max(0.1) - 1.0);
        let total = ((f0 * split.x + split.y) * gain).min(Vec3::ONE);
        Self { f0, cos_eye: cos_eye.clamp(0.02, 1.0), a2: roughness.powi(4), gain, total }
    }

    /// Reflected share, per steradian, of the light from one direction times its cosine `cos_light`; `n_h` and `h_v` are
    /// the cosines of the half vector with the normal and the viewer.
    pub fn towards(&self, cos_light: f32, n_h: f32, h_v: f32) -> Vec3 {
        let d = self.a2 / (PI * (n_h * n_h * (self.a2 - 1.0) + 1.0).powi(2));
        let masking = 1.0 + lambda(self.cos_eye, self.a2) + lambda(cos_light.max(1e-3), self.a2);
        let fresnel = self.f0 + (Vec3::ONE - self.f0).max(Vec3::ZERO) * (1.0 - h_v).clamp(0.0, 1.0).powi(5);
        self.gain * fresnel * (d / (4.0 * self.cos_eye * masking))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_integral_of_the_lobe_is_the_total() {
        for (f0, roughness, cos) in [(0.04, 0.8, 1.0), (0.04, 0.5, 0.5), (0.9, 0.4, 0.7), (0.9, 1.0, 0.3)] {
            let reflection = Reflection::new(Vec3::splat(f0), roughness, cos);
            let view = Vec3::new((1.0f32 - cos * cos).sqrt(), 0.0, cos);
            let (n, mut sum) = (600, 0.0);
            for i in 0..n * n {
                let (u, phi) = (((i / n) as f32 + 0.5) / n as f32, TAU * ((i % n) as f32 + 0.5) / n as f32);
                let sin = (1.0 - u * u).sqrt();
                let light = Vec3::new(sin * phi.cos(), sin * phi.sin(), u);
                let half = (light + view).normalize();
                // `towards` holds the cosine.
                sum += reflection.towards(u, half.z, half.dot(view)).x * TAU / (n * n) as f32;
            }
            let total = reflection.total.x;
            assert!((sum - total).abs() < 0.02 * total + 0.001, "{f0} {roughness} {cos}: {sum} and {total}");
        }
    }

    #[test]
    fn a_white_metal_loses_no_light_and_a_smooth_one_reflects_by_fresnel() {
        for roughness in [0.2, 0.5, 0.8, 1.0] {
            let total = Reflection::new(Vec3::ONE, roughness, 0.6).total.x;
            assert!((total - 1.0).abs() < 1e-3, "{total}");
        }
        let smooth = Reflection::new(Vec3::splat(0.04), 0.0, 0.5).total.x;
        assert!((smooth - (0.04 + 0.96 * 0.5f32.powi(5))).abs() < 2e-3, "{smooth}");
    }
}
