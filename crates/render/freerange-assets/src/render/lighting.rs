//! Lights around an object, drawn from a seed.

use glam::Vec3;
use rand::Rng;
use serde::{Deserialize, Serialize};

use freerange_util::{Invalid, check};

/// A white environment and one sun.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lighting {
    /// Radiance of the environment, the same in all directions.
    pub environment: f32,
    /// Irradiance of the sun on a surface that faces it.
    pub sun: f32,
    /// Unit direction towards the sun.
    pub sun_direction: Vec3,
    /// Rays per surface point for the baked light, at most 512.
    pub rays: u32,
}

impl Default for Lighting {
    /// Environment 0.85, a sun of 1.0 that falls in from the upper right front.
    fn default() -> Self {
        Self { environment: 0.85, sun: 1.0, sun_direction: Vec3::new(0.4446, -0.4250, 0.7884).normalize(), rays: 32 }
    }
}

/// How lighting varies between objects.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LightingConfig {
    /// Share of objects under exactly the default lighting.
    pub default_share: f32,
    /// Range of the environment's radiance otherwise.
    pub environment: [f32; 2],
    /// Range of the sun's irradiance otherwise.
    pub sun: [f32; 2],
    /// Lowest sine of the sun's elevation otherwise.
    pub min_elevation_sin: f32,
    /// Rays per surface point for the baked light.
    pub rays: u32,
}

impl Default for LightingConfig {
    fn default() -> Self {
        Self { default_share: 0.5, environment: [0.6, 1.0], sun: [0.0, 1.6], min_elevation_sin: 0.15, rays: 32 }
    }
}

impl LightingConfig {
    /// Checks every range.
    pub fn validate(&self) -> Result<(), Invalid> {
        let ordered = |r: [f32; 2]| r[0] >= 0.0 && r[1] >= r[0] && r[1] <= 100.0;
        check((0.0..=1.0).contains(&self.default_share), "default_share", "0 to 1", self.default_share)?;
        check(ordered(self.environment), "environment", "0 <= low <= high <= 100", self.environment)?;
        check(ordered(self.sun), "sun", "0 <= low <= high <= 100", self.sun)?;
        check((-1.0..=1.0).contains(&self.min_elevation_sin), "min_elevation_sin", "-1 to 1", self.min_elevation_sin)?;
        check((1..=512).contains(&self.rays), "rays", "1 to 512", self.rays)
    }

    /// Draws a lighting. The configuration must be valid.
    pub fn sample(&self, rng: &mut impl Rng) -> Lighting {
        let base = Lighting { rays: self.rays, ..Lighting::default() };
        if rng.random::<f32>() < self.default_share {
            return base;
        }
        let z = rng.random_range(self.min_elevation_sin..=1.0);
        let angle = rng.random_range(0.0..std::f32::consts::TAU);
        let r = (1.0 - z * z).max(0.0).sqrt();
        Lighting {
            environment: rng.random_range(self.environment[0]..=self.environment[1]),
            sun: rng.random_range(self.sun[0]..=self.sun[1]),
            sun_direction: Vec3::new(r * angle.cos(), r * angle.sin(), z),
            ..base
        }
    }
}
