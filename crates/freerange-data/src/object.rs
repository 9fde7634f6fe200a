//! One training object, made from a seed.

use std::collections::BTreeMap;

use freerange_camera::View;
use freerange_fit::FitConfig;
use freerange_mesh::{CameraConfig, GeneratorConfig, LightingConfig, Scene, generate, orbit_cameras, render};
use freerange_splat::{Alignment, Cloud, LodTree};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::fitted::{fitted_gaussians, polished};
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
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(1);
        let mesh = Scene::new(generate(seed, &config.generator)?, &config.lighting.sample(&mut rng))?;
        let cameras = orbit_cameras(config.views, &mut rng, &config.cameras);
        let views: Vec<View> = cameras
            .into_iter()
            .enumerate()
            .map(|(i, camera)| View {
                name: format!("{i:03}"),
                image: render(&mesh, &camera, config.samples_per_axis),
                camera,
            })
            .collect();
        let leaves = match config.gaussians {
            GaussianSource::Surface => surface_gaussians(&mesh, &config.surface, &mut rng),
            GaussianSource::Fit => fitted_gaussians(&mesh, &views, config, &mut rng)?,
        };
        let tree = LodTree::build_to_depth(&leaves, depths.iter().copied().max().unwrap_or(0), config.alignment)?;
        let polished = |depth| polished(tree.slice(depth)?, &views, config.polish, seed);
        let slices = depths.iter().map(|&depth| Ok((depth, polished(depth)?))).collect::<Result<_, DataError>>()?;
        Ok(Self { id: format!("generated-{seed:08}"), views, slices })
    }
}
