//! 3DGS-MCMC that goes on from a cloud that is already good: what a generated sample needs to agree with the photos.

use crate::{
    Evidence, FitError, FitProgress, OptimizationConfig,
    anchors::Anchors,
    fit::{checked, descend, looked_at, next_views},
    mcmc::split,
    objective::Objective,
    views::Targets,
};
use freerange_gaussians::Gaussians;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::ops::ControlFlow;

/// Longest side, in pixels, of silhouettes. They come from guesses, which nobody vouches for to the pixel.
const SILHOUETTES: u32 = 128;

/// Improves a cloud's agreement with posed views, and shows more detail by more Gaussians.
///
/// Few views say little of the rest of the object, and Gaussians that only they judge leave the object's surface. Hence
/// [anchors](crate::AnchorConfig): at every other step, a picture of the cloud as it was, from somewhere around the object, is one
/// more view to agree with, though less. `others` are more clouds of the same object. These pictures are the mean of all:
/// where guesses differ, their mean is nearer to the truth than most. Where photos see the surface that the clouds show, the pictures
/// have the photos' colors: print then lies on that surface from everywhere. As guesses differ, the optimization begins with as many
/// of them in one place as there are to be Gaussians, each fainter, so that together they show about what one alone does.
/// Silhouettes, where there are any, come beside the views at every other step.
/// `progress` hears of every step, and ends with what there is by `ControlFlow::Break`. The same input gives the same bytes.
///
/// # Errors
/// If there are no views, or they differ in size from their camera; if the configuration is impossible;
/// if the cloud is empty or not finite; or if the optimization diverges.
pub fn optimize<'a>(
    cloud: &Gaussians,
    others: &[Gaussians],
    seen: impl Into<Evidence<'a>>,
    config: &OptimizationConfig,
    progress: impl FnMut(&FitProgress<'_>) -> ControlFlow<()>,
) -> Result<Gaussians, FitError> {
    let seen = seen.into();
    let targets = Targets::new(seen.views.clone(), Some(config.render_size))?;
    let first = (config.coarse * config.steps as f64) as usize;
    let coarse = (first > 0).then(|| Targets::new(seen.views.clone(), Some(config.coarse_size))).transpose()?;
    let further = seen.silhouettes.len();
    let size = Some(config.render_size.min(SILHOUETTES));
    let silhouettes = (further > 0).then(|| Targets::new(seen, size)).transpose()?;
    let clouds = std::iter::once(cloud).chain(others).map(|cloud| checked(cloud, usize::MAX));
    let clouds = clouds.collect::<Result<Vec<_>, _>>()?;
    let anchors = Anchors::new(&clouds, coarse.as_ref().unwrap_or(&targets), &config.anchors)?;
    let start = together(&clouds, config.gaussians);
    let fit = config.fit(start.len());
    fit.check()?;
    let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
    // A stream of its own: the photos come in the same order with and without anchors.
    let mut anchor_rng = ChaCha8Rng::seed_from_u64(config.seed);
    anchor_rng.set_stream(1);
    let mut queue = Vec::new();
    // Photos have more to tell here than shape: silhouettes come beside them, at every other step.
    let (mut silhouette_queue, mut step) = (Vec::new(), 0);
    let more = |cloud: &Gaussians, background| {
        step += 1;
        let by_silhouette = silhouettes
            .as_ref()
            .filter(|targets| step % 2 == 0 && looked_at(targets.weights[targets.views], &mut anchor_rng));
        let by_silhouette =
            by_silhouette.map(|targets| (targets, next_views(&mut silhouette_queue, further, 1, &mut anchor_rng)));
        // The other ones than those of silhouettes.
        let held = if Anchors::due(step) { anchors.views() } else { 0 };
        let held = next_views(&mut queue, held, 1, &mut anchor_rng);
        let (by_silhouette, held) = rayon::join(
            || by_silhouette.map(|(targets, chosen)| Objective::silhouettes(cloud, targets, &chosen)).transpose(),
            || held.first().map(|&view| anchors.objective(cloud, view, background)).transpose(),
        );
        Ok(by_silhouette?.into_iter().chain(held?).collect())
    };
    let of_step = |step| match &coarse {
        Some(coarse) if step < first => (coarse, 1.0),
        _ => (&targets, config.window),
    };
    descend(start, of_step, &fit, &mut rng, more, progress)
}

/// As many of `clouds` as `most` Gaussians allow, but the first in any case, in one place. Each Gaussian becomes what relocation
/// makes of one of so many copies: were the clouds equal, they would look as one.
fn together(clouds: &[Gaussians], most: usize) -> Gaussians {
    let mut total = 0;
    let fitting = clouds.iter().take_while(|cloud| {
        total += cloud.len();
        total <= most
    });
    let copies = fitting.count();
    if copies < 2 {
        return clouds[0].clone();
    }
    let mut all = Gaussians::from_rows(clouds[..copies].iter().flat_map(Gaussians::rows).copied().collect());
    (0..all.len()).for_each(|i| split(&mut all, i, copies));
    all
}
