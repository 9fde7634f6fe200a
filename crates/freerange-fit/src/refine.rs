//! 3DGS-MCMC that goes on from a cloud that is already good: what a generated sample needs to agree with the photos.

use crate::{
    FitError, FitProgress, RefineConfig,
    fit::{checked, next_views, optimise},
    hold::Hold,
    views::Targets,
};
use freerange_camera::View;
use freerange_splat::Cloud;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::ops::ControlFlow;

/// Improves a cloud's agreement with posed views, and shows more detail by more Gaussians.
///
/// Few views say little of the rest of the object, and Gaussians that only they judge leave the object's surface. Hence a
/// [`Hold`](crate::HoldConfig): at every step, a picture of the cloud as it was, from somewhere around the object, is one
/// more view to agree with, though less. `others` are more clouds of the same object, of which nothing is kept but that these
/// pictures are the mean of all: where guesses differ, their mean is nearer to the truth than most. `progress` hears of every step, and ends with what there is by
/// `ControlFlow::Break`. The same input gives the same bytes.
///
/// # Errors
/// If there are no views, or they differ in size from their camera; if the configuration is impossible;
/// if the cloud is empty or not finite; or if the optimisation diverges.
pub fn refine(
    cloud: &Cloud,
    others: &[Cloud],
    views: &[View],
    config: &RefineConfig,
    progress: impl FnMut(&FitProgress) -> ControlFlow<()>,
) -> Result<Cloud, FitError> {
    config.check()?;
    let targets = Targets::new(views, config.render_size)?;
    let start = checked(cloud, usize::MAX)?;
    let fit = config.fit(start.len());
    fit.check()?;
    let others = others.iter().map(|other| checked(other, usize::MAX)).collect::<Result<Vec<_>, _>>()?;
    let held: Vec<&Cloud> = std::iter::once(&start).chain(&others).collect();
    let hold = Hold::new(&held, &config.hold)?;
    let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
    // A stream of its own: the photos come in the same order with and without a hold.
    let mut hold_rng = ChaCha8Rng::seed_from_u64(config.seed);
    hold_rng.set_stream(1);
    let mut queue = Vec::new();
    let holding = |objective: &mut _, cloud: &_, background| {
        let chosen = next_views(&mut queue, hold.views(), 1, &mut hold_rng);
        chosen.into_iter().try_for_each(|view| hold.add(objective, cloud, view, background))
    };
    optimise(start, &targets, &fit, &mut rng, holding, progress)
}
