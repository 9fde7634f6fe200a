//! The main job, posed photos to Gaussians, in five steps.
//!
//! 1. Canonicalize: the user's frame becomes the canonical one, in which the object lies within radius 0.5 about the
//!    origin with +z up; photos are cropped to the object, and views for the network are chosen.
//! 2. Symmetry: with up to four photos, a mirror plane adds mirrored photos to the targets, an axis of revolution adds
//!    rotated silhouettes ([`SymmetryConfig`](crate::SymmetryConfig)).
//! 3. Propose: some sets of Gaussians, by [initial fits](freerange_optim::initial_fit), by the paper's
//!    [`FlowSampler`](freerange_diffusion::sample::FlowSampler), or from the user ([`ProposeConfig`](crate::ProposeConfig)).
//! 4. Refine: the network corrects each proposal ([`Refiner`](freerange_diffusion::sample::Refiner),
//!    [`RefinerConfig`](crate::RefinerConfig)).
//! 5. Optimize: photos decide where they look, the proposals' mean renders where none does
//!    ([`freerange_optim::optimize`], [`OptimizeConfig`](crate::OptimizeConfig)).
//!
//! The result goes back to the user's frame.

mod canonical;
mod complete;
mod optimize;
mod propose;
mod refine;
mod symmetry;
mod watch;

use std::{ops::ControlFlow, path::Path};

pub(crate) use canonical::CanonicalScene;
use freerange_gaussians::Gaussians;
use freerange_scene::camera::{Similarity, View};
use freerange_util::Note;
use glam::DVec3;

use crate::{Error, Options, Progress, Reconstructor, Scene, Stage, to_user, write_gaussians};
use watch::Watch;

/// One sample.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Sample {
    /// The seed it was drawn with.
    pub seed: u64,
    /// The Gaussians, in the frame of the views.
    pub gaussians: Gaussians,
    /// The first proposal as the network left it; none where no optimization followed.
    pub before_optimization: Option<Gaussians>,
    /// `gaussians` in the canonical frame: around the origin within a radius of 0.5, +z up.
    pub canonical: Gaussians,
}

/// A reconstruction and what it took.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Reconstruction {
    /// One per seed.
    pub samples: Vec<Sample>,
    /// Which of the views the network saw, ascending.
    pub network_views: Vec<usize>,
    /// From the frame of the views to the canonical one.
    pub canonical_from_user: Similarity,
    /// What the user should know.
    pub notes: Vec<Note>,
    /// Seconds per stage, in order; of several samples together.
    pub seconds: Vec<(Stage, f64)>,
}

impl Reconstruction {
    /// Which way is up in the frame of the views.
    pub fn up(&self) -> DVec3 {
        // The canonical frame has +z up.
        self.canonical_from_user.rotation.inverse() * DVec3::Z
    }

    /// Writes the first sample as [`write_gaussians`] does.
    ///
    /// # Errors
    /// As there; if there is no sample.
    pub fn write(&self, path: &Path) -> Result<Vec<Note>, Error> {
        let sample = self.samples.first().ok_or_else(|| Error::input("seeds", "one or more", "none"))?;
        write_gaussians(&sample.gaussians, path, self.up())
    }
}

impl Reconstructor {
    /// Reconstructs the object of a scene with the model's own options.
    ///
    /// # Errors
    /// As [`run`](Self::run).
    pub fn reconstruct(&self, scene: &Scene) -> Result<Reconstruction, Error> {
        let options = Options { frame: scene.frame, ..self.options()? };
        self.run(scene.views(), &options, &mut |_| ControlFlow::Continue(()))
    }

    /// Reconstructs an object from two or more views: see the [module](self).
    ///
    /// `progress` hears of every step and ends the work by `ControlFlow::Break`. Memory grows with the pixels of the views
    /// at the sizes that are compared, without another copy of them, and with the number of proposals, not with that of seeds.
    ///
    /// # Errors
    /// [`Error::Cancelled`] where `progress` says so; views or options that cannot be used; a device that fails.
    pub fn run(
        &self,
        views: &[View],
        options: &Options,
        progress: &mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>,
    ) -> Result<Reconstruction, Error> {
        self.check(options)?;
        let config = &options.pipeline;
        let watch = &mut Watch::new(progress);

        let mut scene = watch.timed(Stage::Canonicalize, |w| CanonicalScene::new(views, options, w))?;
        let symmetry = watch.timed(Stage::Symmetry, |w| symmetry::detect(&scene, config, w))?;
        let targets = symmetry.targets(&mut scene);
        let mut samples = Vec::with_capacity(options.seeds.len());
        for (number, &seed) in options.seeds.iter().enumerate() {
            watch.sample = number;
            let proposals =
                watch.timed(Stage::Propose, |w| propose::propose(self, &mut scene, &targets, options, seed, w))?;
            let refined =
                watch.timed(Stage::Refine, |w| refine::refine(self, &scene, &targets, options, proposals, w))?;
            let result = watch.timed(Stage::Optimize, |w| {
                optimize::optimize(&scene, &targets, &config.optimize, &refined, seed, w)
            })?;
            let user = |cloud: &Gaussians| to_user(cloud, &scene.canonical_from_user);
            let before_optimization = (config.optimize.iterations > 0).then(|| user(&refined[0]));
            samples.push(Sample { seed, gaussians: user(&result), before_optimization, canonical: result });
        }
        let CanonicalScene { network_views, canonical_from_user, notes, .. } = scene;
        let seconds = std::mem::take(&mut watch.seconds);
        Ok(Reconstruction { samples, network_views, canonical_from_user, notes, seconds })
    }
}

/// The last step alone, on Gaussians of the frame of the views.
///
/// # Errors
/// As [`Reconstructor::run`].
pub fn optimize_alone(views: &[View], options: &Options, cloud: &Gaussians, seed: u64) -> Result<Gaussians, Error> {
    let mut quiet = |_: &Progress<'_>| ControlFlow::Continue(());
    let watch = &mut Watch::new(&mut quiet);
    let mut scene = CanonicalScene::new(views, options, watch)?;
    let symmetry = symmetry::detect(&scene, &options.pipeline, watch)?;
    let targets = symmetry.targets(&mut scene);
    let proposals = [scene.user_proposal(cloud)?];
    let result = optimize::optimize(&scene, &targets, &options.pipeline.optimize, &proposals, seed, watch)?;
    Ok(to_user(&result, &scene.canonical_from_user))
}
