//! How training objects are made: what is set of it.

use freerange_assets::generate::GeneratorConfig;
use freerange_assets::render::{CameraConfig, LightingConfig};
use freerange_gaussians::Alignment;
use freerange_optim::{FitConfig, InitialFitConfig};

use crate::build::SurfaceConfig;

/// Where an object's Gaussians come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GaussianSource {
    /// 3DGS-MCMC on the rendered views: the paper's way. Seconds to minutes per object.
    Fit,
    /// Points on the mesh: see [`surface_gaussians`](crate::build::surface_gaussians). Milliseconds per object.
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
    pub slice_iterations: usize,
    /// Initial fits of a few views, each of another set of views: see [`InputFit`](crate::InputFit).
    pub input_fits: usize,
    /// Settings of these initial fits.
    pub initial_fit: InitialFitConfig,
    /// Optimization steps on all views that make the target of each initial fit.
    pub target_iterations: usize,
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
            slice_iterations: 0,
            input_fits: 0,
            initial_fit: InitialFitConfig::default(),
            target_iterations: 250,
            alignment: Alignment::Identity,
            views: 40,
            samples_per_axis: 2,
            generator: GeneratorConfig::default(),
            cameras: CameraConfig { resolution: 512, ..CameraConfig::default() },
            lighting: LightingConfig::default(),
        }
    }
}
