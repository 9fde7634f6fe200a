//! A mesh in its light, photographed; and the seconds that the stages of making an object take.

use std::time::Instant;

use freerange_assets::mesh::Mesh;
use freerange_assets::render::{Scene, orbit_cameras, render};
use freerange_scene::camera::{Camera, View};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::build::{BuildError, ObjectConfig};

/// Seconds of one thread per stage of making an object.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Seconds {
    /// Reading or generating the mesh.
    pub read: f64,
    /// Its acceleration structure and baked light.
    pub scene: f64,
    /// Rendering its views, those that are held out among them.
    pub render: f64,
    /// Its Gaussians.
    pub fit: f64,
    /// The tree and its slices.
    pub tree: f64,
    /// Quick fits of some of the views.
    pub input_fits: f64,
    /// Comparing Gaussians with the views that are held out.
    pub measure: f64,
    /// Encoding and writing.
    pub write: f64,
}

impl Seconds {
    /// Each stage with its name, in order.
    pub fn stages(&self) -> [(&'static str, f64); 8] {
        [
            ("read", self.read),
            ("scene", self.scene),
            ("render", self.render),
            ("fit", self.fit),
            ("tree", self.tree),
            ("input fits", self.input_fits),
            ("measure", self.measure),
            ("write", self.write),
        ]
    }

    /// Sum over the stages.
    pub fn total(&self) -> f64 {
        self.stages().iter().map(|s| s.1).sum()
    }

    /// Stage by stage, `self + factor * other`.
    pub(crate) fn add(&mut self, other: &Self, factor: f64) {
        let Self { read, scene, render, fit, tree, input_fits, measure, write } = self;
        let mine = [read, scene, render, fit, tree, input_fits, measure, write];
        mine.into_iter().zip(other.stages()).for_each(|(a, (_, b))| *a += factor * b);
    }
}

/// A lit mesh and its views.
pub(crate) struct Photographed {
    pub scene: Scene,
    pub views: Vec<View>,
    /// Views from other cameras, for measuring.
    pub held_out: Vec<View>,
    /// Generator of what is drawn next.
    pub rng: ChaCha8Rng,
}

impl Photographed {
    /// Draws lighting and cameras, and renders.
    pub fn new(
        mesh: Mesh,
        seed: u64,
        config: &ObjectConfig,
        held_out: usize,
        seconds: &mut Seconds,
    ) -> Result<Self, BuildError> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(1);
        let start = Instant::now();
        let scene = Scene::new(mesh, &config.lighting.sample(&mut rng))?;
        add_elapsed(&mut seconds.scene, start);

        let start = Instant::now();
        let photograph = |cameras: Vec<Camera>| -> Vec<View> {
            let view = |(i, camera)| {
                let image = render(&scene, &camera, config.samples_per_axis);
                View { name: format!("{i:03}"), image, camera }
            };
            cameras.into_iter().enumerate().map(view).collect()
        };
        let views = photograph(orbit_cameras(config.views, &mut rng, &config.cameras));
        // A stream of their own: whether something is measured must not change the object.
        let mut other = ChaCha8Rng::seed_from_u64(seed);
        other.set_stream(2);
        let held_out = match held_out {
            0 => Vec::new(),
            n => photograph(orbit_cameras(n, &mut other, &config.cameras)),
        };
        add_elapsed(&mut seconds.render, start);
        Ok(Self { scene, views, held_out, rng })
    }
}

pub(crate) fn add_elapsed(stage: &mut f64, start: Instant) {
    *stage += start.elapsed().as_secs_f64();
}
