//! 3DGS-MCMC that goes on from a cloud that is already good: what a generated sample needs to agree with the photos.

use crate::{
    Evidence, FitError, FitProgress, OptimizationConfig,
    anchors::Anchors,
    fit::{checked, descend, looked_at, next_views},
    mcmc::split,
    objective::Objective,
    surface::layered,
    views::Targets,
};
use freerange_gaussians::Gaussians;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::{cell::Cell, ops::ControlFlow};

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
///
/// For the last steps, where the [configuration](OptimizationConfig::layer) asks for it, one layer of flat Gaussians takes the place
/// of those that photos see, in the photos' colors. These steps improve it beside pictures of what the others made.
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
    mut progress: impl FnMut(&FitProgress<'_>) -> ControlFlow<()>,
) -> Result<Gaussians, FitError> {
    let seen = seen.into();
    let views = Evidence { silhouettes: Vec::new(), ..seen.clone() };
    let targets = Targets::new(views.clone(), Some(config.render_size))?;
    let with_layer = (config.layer * config.steps as f64) as usize;
    let before = config.steps - with_layer;
    let first = (config.coarse * before as f64) as usize;
    let coarse = (first > 0).then(|| Targets::new(views, Some(config.coarse_size))).transpose()?;
    let silhouettes = Silhouettes::new(seen, config)?;
    let clouds = std::iter::once(cloud).chain(others).map(|cloud| checked(cloud, usize::MAX));
    let clouds = clouds.collect::<Result<Vec<_>, _>>()?;
    let small = coarse.as_ref().unwrap_or(&targets);
    let anchors = Anchors::new(&clouds, small, &config.anchors)?;
    let start = together(&clouds, config.gaussians);
    let fit = config.fit(start.len(), before);
    fit.check()?;
    let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
    let stopped = Cell::new(false);
    let mut tell = |done: usize, told: &FitProgress<'_>| {
        let flow = progress(&FitProgress { step: done + told.step, steps: config.steps, ..*told });
        stopped.set(flow.is_break());
        flow
    };
    let mut further = Further::new(&anchors, silhouettes.as_ref(), config.seed);
    let of_step = |step| if step < first { (small, 1.0) } else { (&targets, config.window) };
    let more = |cloud: &Gaussians, background| further.objectives(cloud, background);
    let result = descend(start, of_step, &fit, &mut rng, more, |told| tell(0, told))?;
    if with_layer == 0 || stopped.get() {
        return Ok(result);
    }
    let anchors = Anchors::new(std::slice::from_ref(&result), small, &config.anchors_of_layer())?;
    let most = config.gaussians.max(result.len()).saturating_add(config.gaussians);
    let layered = layered(&result, &targets, most)?;
    let fit = config.fit_of_layer(layered.len(), with_layer);
    let mut further = Further::new(&anchors, silhouettes.as_ref(), config.seed);
    let more = |cloud: &Gaussians, background| further.objectives(cloud, background);
    descend(layered, |_| (&targets, config.window), &fit, &mut rng, more, |told| tell(before, told))
}

/// Silhouettes as an optimization compares them, where there are any.
struct Silhouettes {
    targets: Targets,
    count: usize,
}

impl Silhouettes {
    fn new(seen: Evidence<'_>, config: &OptimizationConfig) -> Result<Option<Self>, FitError> {
        let count = seen.silhouettes.len();
        let size = Some(config.render_size.min(SILHOUETTES));
        (count > 0).then(|| Ok(Self { targets: Targets::new(seen, size)?, count })).transpose()
    }
}

/// What a step looks at beside a view: a silhouette or an anchor render, in turn.
struct Further<'a> {
    anchors: &'a Anchors,
    silhouettes: Option<&'a Silhouettes>,
    /// A stream of its own: the photos come in the same order with and without anchors.
    rng: ChaCha8Rng,
    queue: Vec<usize>,
    silhouette_queue: Vec<usize>,
    step: usize,
}

impl<'a> Further<'a> {
    fn new(anchors: &'a Anchors, silhouettes: Option<&'a Silhouettes>, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(1);
        Self { anchors, silhouettes, rng, queue: Vec::new(), silhouette_queue: Vec::new(), step: 0 }
    }

    /// The objectives of the next step.
    fn objectives(&mut self, cloud: &Gaussians, background: [f32; 3]) -> Result<Vec<Objective>, FitError> {
        self.step += 1;
        // Photos have more to tell here than shape: silhouettes come beside them, at every other step.
        let by_silhouette = self.silhouettes.filter(|Silhouettes { targets, .. }| {
            self.step.is_multiple_of(2) && looked_at(targets.weights[targets.views], &mut self.rng)
        });
        let by_silhouette = by_silhouette.map(|Silhouettes { targets, count }| {
            (targets, next_views(&mut self.silhouette_queue, *count, 1, &mut self.rng))
        });
        // The other ones than those of silhouettes.
        let held = if Anchors::due(self.step) { self.anchors.views() } else { 0 };
        let held = next_views(&mut self.queue, held, 1, &mut self.rng);
        let (by_silhouette, held) = rayon::join(
            || by_silhouette.map(|(targets, chosen)| Objective::silhouettes(cloud, targets, &chosen)).transpose(),
            || held.first().map(|&view| self.anchors.objective(cloud, view, background)).transpose(),
        );
        Ok(by_silhouette?.into_iter().chain(held?).collect())
    }
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
