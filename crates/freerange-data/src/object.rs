//! One training object, made of a mesh and a seed.

use std::collections::BTreeMap;
use std::time::Instant;

use freerange_camera::{Camera, View};
use freerange_fit::{FitConfig, QuickFitConfig};
use freerange_generate::{GeneratorConfig, generate};
use freerange_mesh::Mesh;
use freerange_render::{CameraConfig, LightingConfig, Scene, orbit_cameras, render};
use freerange_splat::{Alignment, Cloud, LodTree};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::fitted::{fitted_gaussians, polished};
use crate::input_fit::{InputFit, input_fits};
use crate::quality::psnr_over_white;
use crate::{DataError, SurfaceConfig, surface_gaussians};

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
    /// The `surface` way.
    pub surface: SurfaceConfig,
    /// The `fit` way. Its seed is replaced by one drawn for the object.
    pub fit: FitConfig,
    /// Gradient steps that adapt each slice of the tree to the views. 0: slices are what the tree says.
    pub polish: usize,
    /// Quick fits of some of the views, each of a set of its own, as sampling starts from: see [`InputFit`].
    pub input_fits: usize,
    /// How these are made.
    pub quick_fit: QuickFitConfig,
    /// Gradient steps towards all views that mend each.
    pub mend: usize,
    /// How the axes of the Gaussians in the tree are labelled.
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

/// A training object in the canonical frame.
#[derive(Clone, Debug)]
pub struct Object {
    /// What it is called in logs and shards.
    pub id: String,
    /// Posed images, all of one size.
    pub views: Vec<View>,
    /// Slices of the level-of-detail tree by depth; depth `l` has `2^l` Gaussians in tree order.
    pub slices: BTreeMap<u32, Cloud>,
    /// What a few of the views tell without a network.
    pub input_fits: Vec<InputFit>,
}

impl Object {
    /// The Gaussians at `depth`.
    pub fn slice(&self, depth: u32) -> Result<&Cloud, DataError> {
        self.slices.get(&depth).ok_or_else(|| DataError::Depth {
            object: self.id.clone(),
            expected: depth,
            found: self.slices.keys().copied().collect(),
        })
    }

    /// Makes object number `seed`, with slices at `depths`. Pure: the same arguments give the same object.
    pub fn generate(seed: u64, config: &ObjectConfig, depths: &[u32]) -> Result<Self, DataError> {
        let mesh = generate(seed, &config.generator)?;
        Ok(make(generated_id(seed), mesh, seed, config, depths, 0)?.object)
    }
}

/// What a generated object is called.
pub(crate) fn generated_id(seed: u64) -> String {
    format!("generated-{seed:08}")
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

/// PSNR in dB against views that the Gaussians were not fitted to, over white; mean over the views.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeldOutPsnr {
    /// Of the Gaussians before the tree.
    pub leaves: f64,
    /// Of the slices by depth.
    pub slices: BTreeMap<u32, f64>,
}

/// An object and what is known from its making.
pub(crate) struct Made {
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
) -> Result<Made, DataError> {
    let mut seconds = Seconds::default();
    let mut shot = Photographed::new(mesh, seed, config, held_out, &mut seconds)?;

    let start = Instant::now();
    let leaves = match config.gaussians {
        GaussianSource::Surface => surface_gaussians(&shot.scene, &config.surface, &mut shot.rng),
        GaussianSource::Fit => fitted_gaussians(&mut shot, config)?,
    };
    lap(&mut seconds.fit, start);

    let start = Instant::now();
    let tree = LodTree::build_to_depth(&leaves, depths.iter().copied().max().unwrap_or(0), config.alignment)?;
    let slice = |&depth: &u32| Ok((depth, polished(tree.slice(depth)?, &shot.views, config.polish, seed)?));
    let slices = depths.iter().map(slice).collect::<Result<BTreeMap<_, _>, DataError>>()?;
    lap(&mut seconds.tree, start);

    let start = Instant::now();
    let input_fits = input_fits(&shot.views, config, seed)?;
    lap(&mut seconds.input_fits, start);

    let start = Instant::now();
    let psnr = match shot.held_out.as_slice() {
        [] => None,
        views => {
            let slices = slices.iter().map(|(&d, cloud)| Ok((d, psnr_over_white(cloud, views)?)));
            let slices = slices.collect::<Result<_, DataError>>()?;
            Some(HeldOutPsnr { leaves: psnr_over_white(&leaves, views)?, slices })
        }
    };
    lap(&mut seconds.measure, start);
    Ok(Made { object: Object { id, views: shot.views, slices, input_fits }, leaves, psnr, seconds })
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
    ) -> Result<Self, DataError> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(1);
        let start = Instant::now();
        let scene = Scene::new(mesh, &config.lighting.sample(&mut rng))?;
        lap(&mut seconds.scene, start);

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
        lap(&mut seconds.render, start);
        Ok(Self { scene, views, held_out, rng })
    }
}

pub(crate) fn lap(stage: &mut f64, start: Instant) {
    *stage += start.elapsed().as_secs_f64();
}
