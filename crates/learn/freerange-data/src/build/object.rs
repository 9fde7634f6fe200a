//! One training object, made of a mesh and a seed.

use std::collections::BTreeMap;
use std::time::Instant;

use crate::{DataError, HeldOutPsnr, Object, ObjectSource};
use freerange_assets::generate::{GeneratorConfig, generate};
use freerange_assets::mesh::Mesh;
use freerange_assets::render::{CameraConfig, LightingConfig, Scene, orbit_cameras, render};
use freerange_gaussians::{Alignment, Cloud, LodTree};
use freerange_optim::{FitConfig, QuickFitConfig, psnr_over_white};
use freerange_scene::camera::{Camera, View};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::build::fitted::{fitted_gaussians, polished};
use crate::build::input_fit::input_fits;
use crate::build::{BuildError, SurfaceConfig, surface_gaussians};

/// Where an object's Gaussians come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GaussianSource {
    /// 3DGS-MCMC on the rendered views: the paper's way. Seconds to minutes per object.
    Fit,
    /// Points on the mesh: see [`surface_gaussians`]. Milliseconds per object.
    #[default]
    Surface,
}

/// How training objects are made.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ObjectConfig {
    /// Where the Gaussians come from.
    pub gaussians: GaussianSource,
    /// Settings of `surface`.
    pub surface: SurfaceConfig,
    /// Settings of `fit`. Its seed is replaced by one drawn for the object.
    pub fit: FitConfig,
    /// Optimization steps on each slice of the tree. 0: the tree's own slices.
    pub polish: usize,
    /// Initial fits of a few views, each of another set of views: see [`InputFit`](crate::InputFit).
    pub input_fits: usize,
    /// Settings of these initial fits.
    pub quick_fit: QuickFitConfig,
    /// Optimization steps on all views that make the refined target of each initial fit.
    pub mend: usize,
    /// How the axes of the Gaussians in the tree are labeled.
    pub alignment: Alignment,
    /// Rendered views per object.
    pub views: usize,
    /// Rays per pixel and axis.
    pub samples_per_axis: u32,
    /// Shapes and materials.
    pub generator: GeneratorConfig,
    /// Where the cameras stand, and their resolution.
    pub cameras: CameraConfig,
    /// Environment and sun.
    pub lighting: LightingConfig,
}

impl Default for ObjectConfig {
    fn default() -> Self {
        Self {
            gaussians: GaussianSource::Surface,
            surface: SurfaceConfig::default(),
            fit: FitConfig::default(),
            polish: 0,
            input_fits: 0,
            quick_fit: QuickFitConfig::default(),
            mend: 250,
            alignment: Alignment::Identity,
            views: 40,
            samples_per_axis: 2,
            generator: GeneratorConfig::default(),
            cameras: CameraConfig { resolution: 512, ..CameraConfig::default() },
            lighting: LightingConfig::default(),
        }
    }
}

/// What a generated object is called.
pub(crate) fn generated_id(seed: u64) -> String {
    format!("generated-{seed:08}")
}

/// Makes object number `seed`, with slices at `depths`. Pure: the same arguments give the same object.
///
/// # Errors
/// A configuration, or Gaussians, that cannot be used.
pub fn generate_object(seed: u64, config: &ObjectConfig, depths: &[u32]) -> Result<Object, BuildError> {
    let mesh = generate(seed, &config.generator)?;
    Ok(make(generated_id(seed), mesh, seed, config, depths, 0)?.object)
}

/// An endless source: object `index` is generated from seed `seed + index`.
#[derive(Clone, Debug)]
pub struct Generated {
    /// How objects are made.
    pub config: ObjectConfig,
    /// Depths of the slices.
    pub depths: Vec<u32>,
    /// Seed of object 0.
    pub seed: u64,
}

impl ObjectSource for Generated {
    fn object(&self, index: u64) -> Result<Object, DataError> {
        generate_object(self.seed.wrapping_add(index), &self.config, &self.depths).map_err(DataError::from_source)
    }
}

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

/// An object and what is known from its making.
pub(crate) struct MadeObject {
    pub object: Object,
    /// The Gaussians before the tree.
    pub leaves: Cloud,
    /// None where no view was held out.
    pub psnr: Option<HeldOutPsnr>,
    pub seconds: Seconds,
}

/// Makes an object of a mesh in the canonical frame. Pure, but for the seconds.
pub(crate) fn make(
    id: String,
    mesh: Mesh,
    seed: u64,
    config: &ObjectConfig,
    depths: &[u32],
    held_out: usize,
) -> Result<MadeObject, BuildError> {
    let mut seconds = Seconds::default();
    let mut photographed = Photographed::new(mesh, seed, config, held_out, &mut seconds)?;

    let start = Instant::now();
    let leaves = match config.gaussians {
        GaussianSource::Surface => surface_gaussians(&photographed.scene, &config.surface, &mut photographed.rng),
        GaussianSource::Fit => fitted_gaussians(&mut photographed, config)?,
    };
    add_elapsed(&mut seconds.fit, start);

    let start = Instant::now();
    let tree = LodTree::build_to_depth(&leaves, depths.iter().copied().max().unwrap_or(0), config.alignment)?;
    let slice = |&depth: &u32| Ok((depth, polished(tree.slice(depth)?, &photographed.views, config.polish, seed)?));
    let slices = depths.iter().map(slice).collect::<Result<BTreeMap<_, _>, BuildError>>()?;
    add_elapsed(&mut seconds.tree, start);

    let start = Instant::now();
    let input_fits = input_fits(&photographed.views, config, seed)?;
    add_elapsed(&mut seconds.input_fits, start);

    let start = Instant::now();
    let psnr = match photographed.held_out.as_slice() {
        [] => None,
        views => {
            let slices = slices.iter().map(|(&d, cloud)| Ok((d, psnr_over_white(cloud, views)?)));
            let slices = slices.collect::<Result<_, BuildError>>()?;
            Some(HeldOutPsnr { leaves: psnr_over_white(&leaves, views)?, slices })
        }
    };
    add_elapsed(&mut seconds.measure, start);
    Ok(MadeObject { object: Object { id, views: photographed.views, slices, input_fits }, leaves, psnr, seconds })
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
