//! One training object, made of a mesh and a seed.

use std::collections::BTreeMap;
use std::time::Instant;

use crate::{DataError, HeldOutPsnr, Object, ObjectSource};
use freerange_assets::generate::generate;
use freerange_assets::mesh::Mesh;
use freerange_gaussians::{Gaussians, LodTree};
use freerange_optim::psnr_over_white;

use crate::build::fitted::{fitted_gaussians, optimized};
use crate::build::input_fit::input_fits;
use crate::build::photographed::{Photographed, Seconds, add_elapsed};
use crate::build::{BuildError, GaussianSource, ObjectConfig, surface_gaussians};

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

/// An object and what is known from its making.
pub(crate) struct MadeObject {
    pub object: Object,
    /// The Gaussians before the tree.
    pub leaves: Gaussians,
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
    let slice =
        |&depth: &u32| Ok((depth, optimized(tree.slice(depth)?, &photographed.views, config.slice_iterations, seed)?));
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
