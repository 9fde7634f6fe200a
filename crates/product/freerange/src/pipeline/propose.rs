//! Step 3, propose. In: targets in the canonical frame. Out: `propose.count` sets of Gaussians in it, each from a seed of its
//! own: initial fits of any number of Gaussians, samples of the learned flow (paper, Section 3.6), or the user's own,
//! [completed](super::complete) by an initial fit.
//!
//! Initial fits take a second of two cores together; a sample of the flow takes 50 evaluations of the network, or 100 with
//! classifier-free guidance.

use std::ops::ControlFlow;

use freerange_diffusion::sample::FlowSampler;
use freerange_gaussians::Gaussians;
use freerange_optim::initial_fit;
use freerange_util::{Note, side_by_side};

use super::{
    CanonicalScene,
    complete::completed,
    refine,
    symmetry::Targets,
    watch::{Watch, flow},
};
use crate::{Error, Init, Options, Reconstructor, Stage, error::Lift, progress::Preview};

/// Numbers that one seed has for its proposals: as many as `propose.count` allows.
const MOST: u64 = 64;

/// The seed of a proposal: those of two seeds differ.
fn number(seed: u64, proposal: usize) -> u64 {
    seed.wrapping_mul(MOST).wrapping_add(proposal as u64)
}

/// Makes the proposals of a seed.
pub(crate) fn propose(
    model: &Reconstructor,
    scene: &mut CanonicalScene<'_>,
    targets: &Targets<'_>,
    options: &Options,
    seed: u64,
    watch: &mut Watch<'_>,
) -> Result<Vec<Gaussians>, Error> {
    let config = &options.pipeline.propose;
    if let Some(init) = &options.init {
        let own = scene.user_proposal(init)?;
        let fit = fits(scene, targets, options, seed, 1, watch)?.remove(0);
        let before = own.len();
        let all = completed(own, &fit, targets.of_network(0, 1))?;
        let added = all.len() - before;
        if added > 0 && watch.sample == 0 {
            let text = format!("{added} Gaussians of an initial fit are added where the file has none");
            scene.notes.push(Note::understood(text));
        }
        // The network refines equal proposals equally: one is enough.
        return Ok(vec![all]);
    }
    match config.init {
        Init::Fit => fits(scene, targets, options, seed, config.count, watch),
        Init::Flow => {
            let flow = &config.flow;
            let sampler = FlowSampler { checkpoint: model.checkpoint(), config: flow, device: &model.device().0 };
            let sample = |member: usize, progress: &mut refine::OnEstimate<'_>| {
                let views = targets.of_network(member, config.count);
                Ok(sampler.sample(&[views], &[number(seed, member)], progress).lift()?.remove(0))
            };
            refine::each(model, Stage::Propose, scene, [config.count, flow.steps], &sample, watch)
        }
    }
}

/// As many initial fits, beside each other.
fn fits(
    scene: &CanonicalScene<'_>,
    targets: &Targets<'_>,
    options: &Options,
    seed: u64,
    count: usize,
    watch: &mut Watch<'_>,
) -> Result<Vec<Gaussians>, Error> {
    let config = &options.pipeline.propose;
    let numbers: Vec<u64> = (0..count).map(|i| number(seed, i)).collect();
    // The fit that found the object's place is that of number 0.
    let known = |number: u64| scene.fit.as_ref().filter(|_| number == 0);
    let total = numbers.iter().filter(|n| known(**n).is_none()).count() * config.fit.iterations;
    let (mut done, evidence) = (0, &targets.of_fits());
    watch.report(Stage::Propose, [0, total], None, None)?;
    let jobs = numbers.iter().enumerate().map(|(i, &number)| {
        // One fit is enough to look at.
        let previewed = i == 0;
        move |tell: &mut dyn FnMut((f64, Option<Gaussians>)) -> ControlFlow<()>| match known(number) {
            Some(known) => Ok(known.clone()),
            None => initial_fit(evidence.clone(), &config.fit, number, |p| {
                tell((p.loss, previewed.then(|| p.cloud.clone())))
            }),
        }
    });
    let mut stopped = Ok(());
    let fits = side_by_side(jobs.collect(), |_, (loss, cloud)| {
        done += 1;
        let preview = cloud.as_ref().map(|cloud| (Preview::Fit(cloud), &scene.canonical_from_user));
        stopped = watch.report(Stage::Propose, [done, total], Some(loss), preview);
        flow(&stopped)
    });
    stopped?;
    fits.into_iter().map(Lift::lift).collect()
}
