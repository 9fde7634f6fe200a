//! Cameras around an object.

use freerange_scene::camera::Camera;
use glam::DVec3;
use rand::Rng;
use serde::{Deserialize, Serialize};

use freerange_util::{Invalid, check};

/// Which part of the sphere the cameras see the object from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Coverage {
    /// All around: the azimuths are stratified.
    #[default]
    Around,
    /// All within `spread_degrees` of one random direction.
    OneSide,
    /// Evenly over the whole sphere, from below too: a Fibonacci lattice from the top to the bottom, turned about z by
    /// a random angle, each camera moved by `sphere_jitter`. `middle_share` has no effect.
    Sphere,
}

/// Cameras that look at the object.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraConfig {
    /// Width and height of the images in pixels.
    pub resolution: u32,
    /// Range of the distance from the origin.
    pub distance: [f64; 2],
    /// Range of the horizontal field of view in degrees, drawn once for all cameras of a call.
    pub fov_degrees: [f64; 2],
    /// Share of cameras between -20 and 60 degrees of elevation, where people look from; the others are uniform
    /// over the sphere.
    pub middle_share: f64,
    /// Largest distance of the looked-at point from the origin.
    pub target_jitter: f64,
    /// Largest roll about the line of sight in degrees.
    pub roll_degrees: f64,
    /// Coverage.
    pub coverage: Coverage,
    /// Half angle of the cluster for [`Coverage::OneSide`], in degrees.
    pub spread_degrees: f64,
    /// How far cameras leave their place in the lattice of [`Coverage::Sphere`]: 0 not at all, 1 anywhere in a cell of
    /// the area that one camera has.
    pub sphere_jitter: f64,
}

impl Default for CameraConfig {
    fn default() -> Self {
        Self {
            resolution: 128,
            distance: [1.5, 2.0],
            fov_degrees: [40.0, 55.0],
            middle_share: 0.75,
            target_jitter: 0.02,
            roll_degrees: 0.0,
            coverage: Coverage::Around,
            spread_degrees: 35.0,
            sphere_jitter: 0.5,
        }
    }
}

impl CameraConfig {
    /// Checks every range.
    pub fn validate(&self) -> Result<(), Invalid> {
        check((1..=8192).contains(&self.resolution), "resolution", "1 to 8192", self.resolution)?;
        let [near, far] = self.distance;
        check(near > 0.6 && far >= near && far <= 1e3, "distance", "0.6 < low <= high <= 1000", self.distance)?;
        let [low, high] = self.fov_degrees;
        check(low >= 1.0 && high >= low && high <= 150.0, "fov_degrees", "1 <= low <= high <= 150", self.fov_degrees)?;
        check((0.0..=1.0).contains(&self.middle_share), "middle_share", "0 to 1", self.middle_share)?;
        check((0.0..=0.5).contains(&self.target_jitter), "target_jitter", "0 to 0.5", self.target_jitter)?;
        check((0.0..=180.0).contains(&self.roll_degrees), "roll_degrees", "0 to 180", self.roll_degrees)?;
        check((0.0..=180.0).contains(&self.spread_degrees), "spread_degrees", "0 to 180", self.spread_degrees)?;
        check((0.0..=1.0).contains(&self.sphere_jitter), "sphere_jitter", "0 to 1", self.sphere_jitter)
    }
}

/// Draws `count` cameras. The configuration must be valid.
pub fn orbit_cameras(count: usize, rng: &mut impl Rng, config: &CameraConfig) -> Vec<Camera> {
    let fov = rng.random_range(config.fov_degrees[0]..=config.fov_degrees[1]).to_radians();
    let turn: f64 = rng.random();
    let axis = direction(rng, turn, config.middle_share);
    let min_cos = config.spread_degrees.to_radians().cos();
    (0..count)
        .map(|i| {
            let eye = match config.coverage {
                Coverage::Around => {
                    let azimuth = turn + (i as f64 + rng.random::<f64>()) / count as f64;
                    direction(rng, azimuth, config.middle_share)
                }
                Coverage::OneSide => cone(rng, axis, min_cos),
                Coverage::Sphere => lattice(rng, i, count, turn, config.sphere_jitter),
            };
            let distance = rng.random_range(config.distance[0]..=config.distance[1]);
            let jitter = config.target_jitter * rng.random::<f64>() * cone(rng, DVec3::Z, -1.0);
            let forward = (jitter - distance * eye).normalize();
            // Straight from above or below any up vector will do.
            let up = if forward.z.abs() > 0.999 { DVec3::Y } else { DVec3::Z };
            let roll = rng.random_range(-1.0..=1.0) * config.roll_degrees.to_radians();
            let up = glam::DQuat::from_axis_angle(forward, roll) * up;
            Camera::look_at(distance * eye, jitter, up, fov, config.resolution, config.resolution)
        })
        .collect()
}

/// Direction `i` of `count` of the Fibonacci lattice: equal bands of z, each turned by the golden angle.
fn lattice(rng: &mut impl Rng, i: usize, count: usize, turn: f64, jitter: f64) -> DVec3 {
    let mut offset = || jitter * (rng.random::<f64>() - 0.5);
    let n = count as f64;
    let z = 1.0 - 2.0 * (i as f64 + 0.5 + offset()) / n;
    let r = (1.0 - z * z).max(0.0).sqrt();
    // A cell of area 4 pi / n is about as wide as its square root; near the poles that is more than a turn.
    let width = (2.0 * std::f64::consts::PI.sqrt() / (n.sqrt() * r.max(1e-9))).min(std::f64::consts::TAU);
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let angle = std::f64::consts::TAU * turn + i as f64 * golden + width * offset();
    DVec3::new(r * angle.cos(), r * angle.sin(), z)
}

/// A unit vector at the given azimuth (in turns) with a random elevation.
fn direction(rng: &mut impl Rng, turns: f64, middle_share: f64) -> DVec3 {
    let z = if rng.random::<f64>() < middle_share {
        rng.random_range((-20f64).to_radians().sin()..60f64.to_radians().sin())
    } else {
        rng.random_range(-1.0..1.0)
    };
    let r = (1.0 - z * z).max(0.0).sqrt();
    let angle = std::f64::consts::TAU * turns;
    DVec3::new(r * angle.cos(), r * angle.sin(), z)
}

/// A unit vector uniform over the cap about `axis` whose cosine is at least `min_cos`.
fn cone(rng: &mut impl Rng, axis: DVec3, min_cos: f64) -> DVec3 {
    let (x, y) = axis.any_orthonormal_pair();
    let cos = rng.random_range(min_cos..=1.0);
    let sin = (1.0 - cos * cos).max(0.0).sqrt();
    let angle = rng.random_range(0.0..std::f64::consts::TAU);
    axis * cos + (x * angle.cos() + y * angle.sin()) * sin
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn directions(count: usize, seed: u64, jitter: f64) -> Vec<DVec3> {
        let config = CameraConfig {
            coverage: Coverage::Sphere,
            sphere_jitter: jitter,
            target_jitter: 0.0,
            ..CameraConfig::default()
        };
        let cameras = orbit_cameras(count, &mut ChaCha8Rng::seed_from_u64(seed), &config);
        cameras.iter().map(|c| c.center().normalize()).collect()
    }

    #[test]
    fn forty_cameras_cover_the_sphere_evenly() {
        for seed in 0..20 {
            for jitter in [0.0, 0.5, 1.0] {
                let d = directions(40, seed, jitter);
                let mean = d.iter().sum::<DVec3>() / 40.0;
                assert!(mean.length() < 0.06, "{mean}");
                // Second moments of the uniform distribution are 1/3.
                for axis in 0..3 {
                    let moment = d.iter().map(|d| d[axis] * d[axis]).sum::<f64>() / 40.0;
                    assert!((moment - 1.0 / 3.0).abs() < 0.06, "{moment}");
                }
                // No direction is far from a camera: a cap of one camera's area has a half angle of 18 degrees.
                let probes = directions(1000, 99, 0.0);
                let gap = probes
                    .iter()
                    .map(|p| d.iter().map(|d| p.angle_between(*d)).fold(9.0, f64::min))
                    .fold(0.0, f64::max)
                    .to_degrees();
                let limit = [26.0, 36.0, 46.0][(2.0 * jitter) as usize];
                assert!(gap < limit, "seed {seed}, jitter {jitter}: {gap}");
            }
        }
    }

    #[test]
    fn seeds_and_jitter_move_the_cameras() {
        assert_eq!(directions(40, 3, 0.5), directions(40, 3, 0.5));
        assert_ne!(directions(40, 3, 0.5), directions(40, 4, 0.5));
        assert_ne!(directions(40, 3, 0.0), directions(40, 3, 0.5));
        assert_eq!(directions(1, 0, 1.0).len(), 1);
        assert!(directions(0, 0, 1.0).is_empty());
        let below = directions(40, 5, 1.0).iter().filter(|d| d.z < -0.5).count();
        assert!((9..=11).contains(&below), "{below}");
    }
}
