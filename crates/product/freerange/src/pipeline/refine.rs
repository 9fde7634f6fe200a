//! Step 4, refine. In: proposals of any number of Gaussians, and the network's views. Out: as many sets of `2^lod_depth`
//! Gaussians, each corrected by the network ([`Refiner`]; docs/research/decisions.md). A model without a refiner leaves proposals as
//! they are.
//!
//! Cost: `passes` evaluations of the network for each proposal, 7 seconds of two cores for four.

use std::ops::ControlFlow;

use freerange_diffusion::sample::{Estimate, Refiner};
use freerange_gaussians::Gaussians;
use freerange_optim::tree_slice;
use freerange_util::side_by_side;

use super::{
    CanonicalScene,
    symmetry::Targets,
    watch::{Watch, flow},
};
use crate::{Device, Error, Options, Reconstructor, Stage, error::Lift, progress::Preview};

/// Hears of the network's estimate after each of its evaluations.
pub(crate) type OnEstimate<'a> = dyn FnMut(&Estimate<'_>) -> ControlFlow<()> + 'a;

/// Lets the network correct each proposal.
pub(crate) fn refine(
    model: &Reconstructor,
    scene: &CanonicalScene<'_>,
    targets: &Targets<'_>,
    options: &Options,
    proposals: Vec<Gaussians>,
    watch: &mut Watch<'_>,
) -> Result<Vec<Gaussians>, Error> {
    let Some(config) = &options.pipeline.refine else { return Ok(proposals) };
    if options.without_network {
        // As many Gaussians as the network would make.
        let depth = config.lod_depth.unwrap_or(model.checkpoint().depth);
        return proposals.iter().map(|cloud| tree_slice(cloud, depth).lift()).collect();
    }
    let refiner = Refiner { checkpoint: model.checkpoint(), config, device: &model.device().0 };
    let refine = |i: usize, progress: &mut OnEstimate<'_>| {
        let views = targets.of_network(i, proposals.len());
        Ok(refiner.refine(&[views], std::slice::from_ref(&proposals[i]), progress).lift()?.remove(0))
    };
    each(model, Stage::Refine, scene, [proposals.len(), config.passes], &refine, watch)
}

/// `count` results of the network, each of so many `steps`: beside each other on the CPU, one after the other on a GPU,
/// which has one queue. Previews show the first.
pub(crate) fn each(
    model: &Reconstructor,
    stage: Stage,
    scene: &CanonicalScene<'_>,
    [count, steps]: [usize; 2],
    make: &(dyn Fn(usize, &mut OnEstimate<'_>) -> Result<Gaussians, Error> + Sync),
    watch: &mut Watch<'_>,
) -> Result<Vec<Gaussians>, Error> {
    let (mut done, total, place) = (0, count * steps, &scene.canonical_from_user);
    watch.report(stage, [0, total], None, None)?;
    let mut stopped = Ok(());
    let mut report = |preview: Option<Preview<'_>>| {
        done += 1;
        stopped = watch.report(stage, [done, total], None, preview.map(|p| (p, place)));
        flow(&stopped)
    };
    let made: Result<Vec<Gaussians>, Error> = if *model.device() == Device::cpu() {
        let job = |i: usize| {
            move |tell: &mut dyn FnMut(_) -> ControlFlow<()>| {
                make(i, &mut |estimate| tell((i == 0).then(|| estimate.clouds())))
            }
        };
        let mut failed = Ok(());
        let made = side_by_side((0..count).map(job).collect(), |_, clouds| match clouds.transpose() {
            Ok(clouds) => report(clouds.as_deref().map(Preview::Read)),
            Err(error) => {
                failed = Err(error);
                ControlFlow::Break(())
            }
        });
        failed.lift()?;
        made.into_iter().collect()
    } else {
        let one = |i: usize| make(i, &mut |estimate| report((i == 0).then_some(Preview::Network(estimate))));
        (0..count).map(one).collect()
    };
    stopped?;
    made
}
