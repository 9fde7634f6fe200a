//! From objects to tensors: what the network sees, what it should say, and what renders are compared with.

use std::sync::Arc;

use burn::tensor::{Device, Tensor, TensorData};
use freerange_data::{InputFit, Object};
use freerange_gaussians::{Gaussians, Normalization, channel};
use freerange_model::ModelConfig;
use freerange_scene::camera::{Similarity, View};
use glam::DVec3;
use rand::{Rng, SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use crate::{
    TrainError,
    config::{FrameJitter, LossConfig, Stage},
    symmetry::Symmetry,
};
use freerange_diffusion::{
    conditioning::{Conditioning, shrink},
    path::{cosine_time, render_weight},
    targets::{Images, Targets},
};

/// A color for what lies behind the object.
pub fn draw_background(rng: &mut ChaCha8Rng) -> [f32; 3] {
    std::array::from_fn(|_| rng.random())
}

/// Everything one training step needs.
#[derive(Clone, Debug)]
pub struct Batch {
    /// Clean, normalized Gaussians z_1. `[b, n, 14]`
    pub data: Tensor<3>,
    /// Noise, paired with them. `[b, n, 14]`
    pub noise: Tensor<3>,
    /// The initial fits that are refined, paired with the data; none if paths start from noise. With them noise and times are
    /// 0. `[b, n, 14]`
    pub fits: Option<Tensor<3>>,
    /// How many estimates the network makes, each fed to the next, before the one that is trained.
    pub estimates: usize,
    /// Weight of each sample's rendering losses.
    pub render_weights: Vec<f32>,
    /// Time of each sample.
    pub t: Vec<f32>,
    /// 1 where the sample sees its images, 0 where it is trained unconditionally. `[b, 1, 1]`
    pub conditional: Tensor<3>,
    /// The input views as the encoder takes them.
    pub conditioning: Conditioning,
    /// The input views at the size of the gradient channels.
    pub gradient_targets: Targets,
    /// The input views at the size of the rendering loss.
    pub seen: Targets,
    /// Held-out views at the size of the rendering loss; none if the configuration asks for none.
    pub held: Option<Targets>,
}

impl Batch {
    /// Draws times, noise, views and backgrounds for `objects`, all from `rng`.
    pub fn draw(
        objects: &[Arc<Object>],
        stage: &Stage,
        model: &ModelConfig,
        loss: &LossConfig,
        normalization: &Normalization,
        rng: &mut ChaCha8Rng,
        device: &Device,
    ) -> Result<Self, TrainError> {
        let (b, n) = (objects.len(), 1usize << stage.depth);
        let refinement = loss.refinement.filter(|refinement| rng.random::<f32>() < refinement.share);
        let estimates = draw_estimates(loss, rng);
        let fits = refinement.map(|_| same_fit(objects, stage.depth, loss.held_views, rng)).transpose()?;
        let inputs = rng.random_range(loss.input_views.0..=loss.input_views.1);
        let one_sided = rng.random::<f32>() < loss.one_sided;
        let common = Common { depth: stage.depth, loss, normalization, inputs, one_sided };
        let mut rows = Rows::default();
        for (i, object) in objects.iter().enumerate() {
            rows.draw(object, fits.as_ref().map(|fits| fits[i]), &common, rng)?;
        }

        let at = |views: &[Vec<View>], size: u32| targets(views, size, &rows.backgrounds, device);
        let render_size = stage.render_size.unwrap_or(loss.render_size);
        // Pictures are most of the work, and nothing of it is drawn.
        let (seen_views, held_views): (Vec<Vec<View>>, Vec<Vec<View>>) =
            rows.looks.par_iter().map(|look| (look.moved(&look.seen), look.moved(&look.held))).unzip();
        let seen: Vec<Vec<&View>> = seen_views.iter().map(|o| o.iter().collect()).collect();
        let conditioning = Conditioning::new(&seen, model, device)?;
        let gradient_targets = at(&seen_views, stage.gradient_size.unwrap_or(loss.gradient_size))?;
        let seen = at(&seen_views, render_size)?;
        let held = if loss.held_views > 0 { Some(at(&held_views, render_size)?) } else { None };
        let shape = [b, n, channel::COUNT];
        let tensor = |values: Vec<f32>| Tensor::<3>::from_data(TensorData::new(values, shape), device);
        Ok(Self {
            fits: fits.is_some().then(|| tensor(rows.guesses)),
            estimates,
            data: tensor(rows.data),
            noise: tensor(rows.noise),
            render_weights: match refinement {
                Some(refinement) => vec![refinement.render_weight; b],
                None => rows.t.iter().map(|&t| render_weight(t)).collect(),
            },
            t: rows.t,
            conditional: Tensor::from_data(TensorData::new(rows.conditional, [b, 1, 1]), device),
            conditioning,
            gradient_targets,
            seen,
            held,
        })
    }
}

/// How many estimates of its own the network is fed, one after the other.
fn draw_estimates(loss: &LossConfig, rng: &mut ChaCha8Rng) -> usize {
    match rng.random::<f32>() < loss.self_conditioning {
        true if loss.estimates > 1 => rng.random_range(1..=loss.estimates),
        once => usize::from(once),
    }
}

/// Views at most `size` pixels wide and high, in front of each object's background.
fn targets(views: &[Vec<View>], size: u32, backgrounds: &[[f32; 3]], device: &Device) -> Result<Targets, TrainError> {
    let small: Vec<Vec<View>> = views.par_iter().map(|o| o.iter().map(|v| shrink(v, size)).collect()).collect();
    let small: Vec<Vec<&View>> = small.iter().map(|o| o.iter().collect()).collect();
    Ok(Images::new(&small, device)?.on(backgrounds))
}

/// What is the same for all objects of a batch.
struct Common<'a> {
    depth: u32,
    loss: &'a LossConfig,
    normalization: &'a Normalization,
    /// Input views of an object without a fit.
    inputs: usize,
    one_sided: bool,
}

/// The objects of a batch one after the other: see [`Batch`].
#[derive(Default)]
struct Rows<'a> {
    data: Vec<f32>,
    noise: Vec<f32>,
    guesses: Vec<f32>,
    t: Vec<f32>,
    conditional: Vec<f32>,
    backgrounds: Vec<[f32; 3]>,
    looks: Vec<Look<'a>>,
}

/// Which views of an object, and how they and it are changed.
struct Look<'a> {
    seen: Vec<&'a View>,
    held: Vec<&'a View>,
    symmetry: Symmetry,
    frame: Similarity,
}

impl Look<'_> {
    fn moved(&self, views: &[&View]) -> Vec<View> {
        let moved = |v: &&View| {
            let v = self.symmetry.view(v);
            View { camera: v.camera.transformed(&self.frame), ..v }
        };
        views.iter().map(moved).collect()
    }
}

impl<'a> Rows<'a> {
    fn draw(
        &mut self,
        object: &'a Object,
        fit: Option<&InputFit>,
        common: &Common<'_>,
        rng: &mut ChaCha8Rng,
    ) -> Result<(), TrainError> {
        let &Common { depth, loss, normalization, inputs, one_sided } = common;
        let symmetry = Symmetry::draw(loss.symmetries, rng);
        let slice = match fit {
            Some(fit) => &fit.target,
            None => object.slice(depth)?,
        };
        let order = symmetry.order(fit.map_or(slice, |fit| &fit.gaussians)); // both have it, one by one
        let seen_so = |cloud: &Gaussians| symmetry.gaussians(cloud).select(order.iter().copied());
        let mut slice = match fit {
            None if loss.random_patches => seen_so(slice).shuffled(rng),
            _ => seen_so(slice),
        };
        let values = (1usize << depth) * channel::COUNT;
        let (mut epsilon, time) = match fit {
            // All that the network can say comes from the fit and the images.
            Some(_) => (vec![0.0; values], 0.0),
            None => ((0..values).map(|_| StandardNormal.sample(rng)).collect(), cosine_time(rng.random())),
        };
        // A fit is made of the images: there is no way without them from it.
        let blind = rng.random::<f32>() < loss.unconditional && fit.is_none();
        self.t.push(time);
        self.conditional.push(if blind { 0.0 } else { 1.0 });
        self.backgrounds.push(draw_background(rng));
        let (seen, mut held) = match fit {
            Some(fit) => views_of(fit, &object.views, rng),
            None => choose_views(&object.views, inputs, one_sided, rng),
        };

        let frame = draw_frame(loss.frame_jitter, rng);
        if frame != Similarity::IDENTITY {
            slice.transform(frame.scale, frame.rotation, frame.translation);
        }
        held.truncate(loss.held_views);
        self.looks.push(Look { seen, held, symmetry, frame });
        let clean = normalization.normalize(&slice);
        match fit {
            None => loss.coupling.pair(&mut epsilon, &clean),
            Some(fit) => {
                let mut guess = seen_so(&fit.gaussians);
                if frame != Similarity::IDENTITY {
                    guess.transform(frame.scale, frame.rotation, frame.translation);
                }
                self.guesses.extend(normalization.normalize(&guess));
            }
        }
        self.data.extend(clean);
        self.noise.extend(epsilon);
        Ok(())
    }
}

/// A quick fit of each object, of `2^depth` Gaussians and equally many views: which one, is drawn.
fn same_fit<'a>(
    objects: &'a [Arc<Object>],
    depth: u32,
    held_views: usize,
    rng: &mut ChaCha8Rng,
) -> Result<Vec<&'a InputFit>, TrainError> {
    let most = objects.iter().map(|o| o.input_fits.len()).min().unwrap_or(0);
    let number = if most > 0 { rng.random_range(0..most) } else { 0 };
    let count = objects.first().and_then(|o| o.input_fits.get(number)).map_or(0, |f| f.views.len());
    let fitting = |o: &'a Arc<Object>| {
        let fit = o.input_fits.get(number);
        let enough =
            |f: &&InputFit| f.depth() == depth && f.views.len() == count && count + held_views <= o.views.len();
        fit.filter(enough).ok_or_else(|| TrainError::Fits {
            object: o.id.clone(),
            expected: format!(
                "an initial fit number {number} of {} Gaussians and {count} views, and {held_views} views besides",
                1u64 << depth
            ),
            found: {
                let each: Vec<(usize, usize)> =
                    o.input_fits.iter().map(|f| (f.gaussians.len(), f.views.len())).collect();
                format!("{} views, and fits of (Gaussians, views) {each:?}", o.views.len())
            },
        })
    };
    objects.iter().map(fitting).collect()
}

/// The views of a fit, and the others in random order.
fn views_of<'a>(fit: &InputFit, views: &'a [View], rng: &mut ChaCha8Rng) -> (Vec<&'a View>, Vec<&'a View>) {
    let chosen = fit.views.iter().map(|&i| &views[i]).collect();
    let mut rest: Vec<&View> = (0..views.len()).filter(|i| !fit.views.contains(i)).map(|i| &views[i]).collect();
    rest.shuffle(rng);
    (chosen, rest)
}

/// How far an object's frame is off, for one step.
fn draw_frame(jitter: FrameJitter, rng: &mut ChaCha8Rng) -> Similarity {
    let mut draw = |deviation: f32| match deviation > 0.0 {
        true => {
            let deviations: f64 = StandardNormal.sample(rng);
            f64::from(deviation) * deviations.clamp(-2.0, 2.0)
        }
        false => 0.0,
    };
    let scale = draw(jitter.scale).exp();
    let translation = DVec3::from_array(std::array::from_fn(|_| draw(jitter.center)));
    Similarity { scale, translation, ..Similarity::IDENTITY }
}

/// Splits views into `count` inputs and the rest, both in random order. One-sided: the inputs are those nearest in
/// direction to a randomly chosen one.
pub(crate) fn choose_views<'a>(
    views: &'a [View],
    count: usize,
    one_sided: bool,
    rng: &mut ChaCha8Rng,
) -> (Vec<&'a View>, Vec<&'a View>) {
    let mut order: Vec<&View> = views.iter().collect();
    order.shuffle(rng);
    if one_sided && let Some(first) = order.first() {
        let direction = first.camera.center().normalize();
        order.sort_by(|a, b| {
            let cosine = |v: &View| v.camera.center().normalize().dot(direction);
            cosine(b).total_cmp(&cosine(a))
        });
        order[count.min(views.len())..].shuffle(rng);
    }
    let rest = order.split_off(count.min(order.len()));
    (order, rest)
}

/// The generator of step `step` of a run: independent of how the run got there, so that a resumed run draws the same.
pub fn step_rng(seed: u64, step: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(step.wrapping_add(1));
    rng
}

/// Numbers of a step's generator, in words of 32 bits, that each part of its batch has to itself.
const WORDS_PER_PART: u128 = 1 << 40;

/// The generator of part `part` of a step's batch; part 0 goes on with `rng`, the step's own.
pub(crate) fn part_rng(rng: ChaCha8Rng, part: usize) -> ChaCha8Rng {
    let mut rng = rng;
    if part > 0 {
        rng.set_word_pos(WORDS_PER_PART * part as u128);
    }
    rng
}
