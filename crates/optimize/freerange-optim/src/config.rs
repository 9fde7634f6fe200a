//! What a fit can be told, with its defaults.

use crate::FitError;
use freerange_util::{Background, Invalid, ensure};
use serde::{Deserialize, Serialize};

/// Learning rate of each kind of channel, per step of Adam.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rates {
    /// Centers, in world units.
    pub mean: f64,
    /// Logarithms of the standard deviations.
    pub scale: f64,
    /// Components of the unit quaternion.
    pub rotation: f64,
    /// Logit of the opacity.
    pub opacity: f64,
    /// Color, sRGB-encoded 0..1.
    pub color: f64,
}

/// Settings of [`fit`](crate::fit). The defaults suit objects in the canonical frame (a sphere of radius 0.5 about
/// the origin). They are 3DGS-MCMC's published values where those do not depend on the size of the world.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FitConfig {
    /// Optimization steps.
    pub iterations: usize,
    /// Number of Gaussians never exceeded, and reached if there are enough growth steps.
    pub cap_max: usize,
    /// Number of Gaussians to start with, where none are given; at most `cap_max`.
    pub initial: usize,
    /// Their opacity at the start, 0..1. Fits that start from points on a surface take it, too.
    pub initial_opacity: f64,
    /// Their standard deviation at the start, in multiples of the distance to the three nearest neighbors.
    pub initial_scale: f64,
    /// Radius of the sphere around the origin that holds the object. World units.
    pub radius: f64,
    /// Steps between two rounds of relocation and growth.
    pub refine_every: usize,
    /// First step with such a round.
    pub growth_start: usize,
    /// Fraction of the iterations after which there are no more such rounds, 0..1.
    pub growth_stop: f64,
    /// Factor by which the number of Gaussians grows in one round, at least 1.
    pub growth: f64,
    /// Learning rates at the start.
    pub rates: Rates,
    /// Learning rate of the centers at the end, reached exponentially. The others are constant.
    pub final_mean_rate: f64,
    /// Weight of 1 - SSIM; that of L1 is the rest. 0..1
    pub lambda_ssim: f64,
    /// Weight of the mean opacity in the loss.
    pub opacity_regularizer: f64,
    /// Weight of the mean standard deviation in the loss.
    pub scale_regularizer: f64,
    /// Strength of the noise that moves faint Gaussians, in multiples of the centers' current learning rate.
    pub noise_lr: f64,
    /// Gaussians of at most this opacity are dead and are relocated. 0..1
    pub dead_opacity: f64,
    /// Background of the renders. Views without transparency are compared as they are, with their background.
    pub background: Background,
    /// Views compared at each step.
    pub views_per_step: usize,
    /// Longest side, in pixels, at which views are compared; larger ones are shrunk. None: as they are.
    pub render_size: Option<u32>,
    /// Seed of everything drawn.
    pub seed: u64,
}

impl Default for FitConfig {
    fn default() -> Self {
        Self {
            iterations: 3000,
            cap_max: 4096,
            initial: 2048,
            initial_opacity: 0.5,
            initial_scale: 0.5,
            radius: 0.5,
            refine_every: 100,
            growth_start: 500,
            growth_stop: 5.0 / 6.0,
            growth: 1.05,
            // The published rates are 1.6e-4 times the extent of the cameras for the centers, also down to a hundredth,
            // and 5e-3 for the sizes, for 30,000 steps. Fits of small objects in 100 to 3000 steps gain most from more:
            // 1 to 2 dB on scanned ones, and their slices as much.
            rates: Rates { mean: 3e-3, scale: 1e-2, rotation: 1e-3, opacity: 0.05, color: 2.5e-3 },
            final_mean_rate: 3e-5,
            lambda_ssim: 0.2,
            opacity_regularizer: 0.01,
            scale_regularizer: 0.01,
            noise_lr: 5e5,
            dead_opacity: 0.005,
            background: Background::Random,
            views_per_step: 1,
            render_size: None,
            seed: 0,
        }
    }
}

/// Settings of [`optimize`](crate::optimize). The defaults suit objects in the canonical frame (a sphere of radius 0.5 about
/// the origin).
#[derive(Clone, Debug, PartialEq)]
pub struct OptimizationConfig {
    /// Optimization steps; each one looks at one view, and every other one at an anchor render.
    pub steps: usize,
    /// Number of Gaussians at the end, or before the [`layer`](Self::layer); a cloud that has more keeps its number.
    pub gaussians: usize,
    /// Learning rates of 2,000 steps or more, at the start. Of fewer steps, scale, rotation and opacity have higher ones: up to
    /// three times these, for 400 steps or less.
    pub rates: Rates,
    /// Longest side, in pixels, at which views are compared; larger ones are shrunk.
    pub render_size: u32,
    /// Part of the steps, the last ones, that have one layer of flat Gaussians where photos see the object's surface: up to
    /// [`gaussians`](Self::gaussians) more. 0: no layer. 0..1
    pub layer: f64,
    /// Part of the other steps, the first ones, that compare views at [`coarse_size`](Self::coarse_size): what they see is coarse as yet. 0..1
    pub coarse: f64,
    /// Longest side in pixels at which these steps compare views. Smaller views are compared as they are.
    pub coarse_size: u32,
    /// Part of each side of a view that the steps after these compare: a window about a random point of the object. 1: all of it. 0..1
    pub window: f64,
    /// What keeps the cloud where no view looks.
    pub anchors: AnchorConfig,
    /// Seed of everything drawn.
    pub seed: u64,
}

impl Default for OptimizationConfig {
    fn default() -> Self {
        Self {
            steps: 400,
            gaussians: 8192,
            rates: Rates { mean: 1.5e-3, scale: 5e-3, rotation: 1e-3, opacity: 0.05, color: 2.5e-3 },
            render_size: 256,
            layer: 0.0,
            coarse: 0.0,
            coarse_size: 256,
            window: 1.0,
            anchors: AnchorConfig::default(),
            seed: 0,
        }
    }
}

/// Pictures of the cloud before an optimization, taken from all around it: further views that the optimized one has to agree
/// with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AnchorConfig {
    /// Weight of the mean absolute difference from a picture, beside a loss of weight 1 on a view. 0: no anchors.
    pub weight: f64,
    /// Number of pictures.
    pub views: usize,
    /// Their width and height in pixels.
    pub size: u32,
}

impl Default for AnchorConfig {
    fn default() -> Self {
        Self { weight: 0.1, views: 12, size: 96 }
    }
}

// All of these are written so that NaN fails them.

fn finite_not_negative(field: &str, v: f64) -> Result<(), Invalid> {
    ensure(v >= 0.0 && v.is_finite(), field, "a finite number, at least 0", v)
}

fn positive(field: &str, v: f64) -> Result<(), Invalid> {
    ensure(v > 0.0 && v.is_finite(), field, "a finite number above 0", v)
}

fn fraction(field: &str, v: f64) -> Result<(), Invalid> {
    ensure((0.0..=1.0).contains(&v), field, "a number from 0 to 1", v)
}

fn at_least_one(field: &str, v: usize) -> Result<(), Invalid> {
    ensure(v >= 1, field, "at least 1", v)
}

impl Rates {
    fn check(&self) -> Result<(), Invalid> {
        finite_not_negative("rates.mean", self.mean)?;
        finite_not_negative("rates.scale", self.scale)?;
        finite_not_negative("rates.rotation", self.rotation)?;
        finite_not_negative("rates.opacity", self.opacity)?;
        finite_not_negative("rates.color", self.color)
    }
}

/// Enough for any use, and few enough that their memory (about 200 bytes each) does not decide.
const MAX_GAUSSIANS: usize = 1 << 24;

impl FitConfig {
    /// Refuses values that no fit can work with.
    pub fn check(&self) -> Result<(), FitError> {
        at_least_one("iterations", self.iterations)?;
        let most = self.cap_max;
        ensure((1..=MAX_GAUSSIANS).contains(&most), "cap_max", "1 to 16777216", most)?;
        ensure((1..=most).contains(&self.initial), "initial", "1 to cap_max", self.initial)?;
        let strict = |v: f64| v > 0.0 && v < 1.0;
        ensure(strict(self.initial_opacity), "initial_opacity", "between 0 and 1", self.initial_opacity)?;
        ensure(strict(self.dead_opacity), "dead_opacity", "between 0 and 1", self.dead_opacity)?;
        positive("initial_scale", self.initial_scale)?;
        positive("radius", self.radius)?;
        at_least_one("refine_every", self.refine_every)?;
        fraction("growth_stop", self.growth_stop)?;
        let grows = self.growth >= 1.0 && self.growth.is_finite();
        ensure(grows, "growth", "a finite number, at least 1", self.growth)?;
        self.rates.check()?;
        positive("rates.mean", self.rates.mean)?;
        positive("final_mean_rate", self.final_mean_rate)?;
        fraction("lambda_ssim", self.lambda_ssim)?;
        finite_not_negative("opacity_regularizer", self.opacity_regularizer)?;
        finite_not_negative("scale_regularizer", self.scale_regularizer)?;
        finite_not_negative("noise_lr", self.noise_lr)?;
        at_least_one("views_per_step", self.views_per_step)?;
        Ok(ensure(self.render_size != Some(0), "render_size", "at least 1 pixel", 0)?)
    }
}

/// Rounds of relocation and growth of an optimization, spread evenly over the steps up to [`GROWTH_STOP`].
const GROWTH_ROUNDS: usize = 16;
/// Part of the steps of an optimization after which there are no more rounds of growth: the last Gaussians have to settle.
const GROWTH_STOP: f64 = 5.0 / 6.0;
/// Learning rate of the centers at the end of an optimization, reached exponentially. The others are constant.
const FINAL_MEAN_RATE: f64 = 1.5e-5;

/// Steps of an optimization up to which scale, rotation and opacity have `HASTE` times their learning rates, and from which
/// on they have these. Fast rates make up for few steps (docs/research/experiments/optimization.md).
const SHORT: f64 = 400.0;
const LONG: f64 = 2000.0;
const HASTE: f64 = 3.0;

impl Rates {
    fn hastened(self, steps: usize) -> Self {
        let Self { mean, scale, rotation, opacity, color } = self;
        let short = ((LONG / steps.max(1) as f64).ln() / (LONG / SHORT).ln()).clamp(0.0, 1.0);
        let haste = HASTE.powf(short);
        Self { mean, scale: haste * scale, rotation: haste * rotation, opacity: haste * opacity, color }
    }
}

/// Photos that the defaults of an optimization are for, and those from which on more change nothing.
const PHOTOS: usize = 4;
const MOST_PHOTOS: usize = 16;
/// Times as many steps as for few photos.
const MOST_STEPS: f64 = 5.0;

/// Up to so many pixels, the longest side, pictures grow with the number of photos.
const MOST_GROWN: u32 = 512;

/// What [`OptimizationConfig::coarse`] and [`OptimizationConfig::window`] are where detail is asked for.
const COARSE: f64 = 0.6;
const WINDOW: f64 = 0.6;

/// So many times as much anchors weigh beside windows, in which the object's pixels count for more than in whole views.
const BESIDE_WINDOWS: f64 = 1.5;

/// What [`OptimizationConfig::layer`] is there.
const LAYER: f64 = 0.25;
/// So many times as much anchors weigh beside the layer: they show what the steps before it made, from all around.
const BESIDE_LAYER: f64 = 4.0;
/// Learning rates of the centers beside the layer, at first and at the end: the surface is to stay.
const LAYER_MEAN_RATES: [f64; 2] = [1e-4, 1e-5];

impl OptimizationConfig {
    /// These settings, which are for up to four photos, for so many: more steps, five times as many for sixteen, more of their pixels, up
    /// to 512, less weight of anchors, since more of the object is seen, and no layer: where photos overlap they agree on the surface
    /// themselves. From sixteen photos on nothing changes any more.
    #[must_use]
    pub fn for_photos(self, photos: usize) -> Self {
        let photos = photos.clamp(PHOTOS, MOST_PHOTOS);
        let [more, most] = [photos, MOST_PHOTOS].map(|n| n as f64 / PHOTOS as f64);
        let grown = |size: u32| ((f64::from(size) * more.sqrt()).round() as u32).min(size.max(MOST_GROWN));
        Self {
            steps: (self.steps as f64 * MOST_STEPS.powf(more.ln() / most.ln())).round() as usize,
            render_size: grown(self.render_size),
            anchors: AnchorConfig { weight: self.anchors.weight / more.powf(1.5), ..self.anchors },
            layer: if photos > PHOTOS { 0.0 } else { self.layer },
            ..self
        }
    }

    /// These settings for finer detail: so many times the size of pictures and the Gaussians, and so much less weight of the anchors, whose own pictures
    /// are small; at first at half that size, and in the end with a layer on the surface. From 3 on half as many times the steps as well: 2
    /// needs no more of them. 1 changes nothing.
    /// Photos, whose longest side has `longest` pixels, have no finer detail than their pixels: it is as much as they can show at most.
    #[must_use]
    pub fn detailed(self, detail: usize, longest: u32) -> Self {
        let detail = detail.min(longest.div_ceil(self.render_size.max(1)) as usize);
        if detail < 2 {
            return self;
        }
        let grown = |size: u32| size.saturating_mul(detail as u32);
        Self {
            steps: self.steps.saturating_mul(detail) / 2,
            gaussians: self.gaussians.saturating_mul(detail),
            render_size: grown(self.render_size),
            layer: LAYER,
            coarse: COARSE,
            window: WINDOW,
            coarse_size: (grown(self.coarse_size) / 2).max(1),
            anchors: AnchorConfig { weight: BESIDE_WINDOWS * self.anchors.weight / detail as f64, ..self.anchors },
            ..self
        }
    }

    /// Anchors of the steps with the layer.
    pub(crate) fn anchors_of_layer(&self) -> AnchorConfig {
        AnchorConfig { weight: BESIDE_LAYER * self.anchors.weight, ..self.anchors }
    }

    /// The fit of so many steps that goes on from a cloud of `start` Gaussians.
    pub(crate) fn fit(&self, start: usize, steps: usize) -> FitConfig {
        let most = self.gaussians.max(start);
        // A round comes at every multiple of the interval but step 0.
        let last = GROWTH_STOP * steps as f64;
        let interval = ((last / (GROWTH_ROUNDS + 1) as f64) as usize).max(1);
        let rounds = ((last / interval as f64).ceil() as i32 - 1).max(1);
        FitConfig {
            iterations: steps,
            cap_max: most,
            initial: start,
            refine_every: interval,
            growth_start: interval,
            growth_stop: GROWTH_STOP,
            // One Gaussian more, since rounds round down.
            growth: (most as f64 / start as f64).powf(1.0 / f64::from(rounds)) + 1.0 / start as f64,
            rates: self.rates.hastened(steps),
            final_mean_rate: FINAL_MEAN_RATE,
            render_size: Some(self.render_size),
            seed: self.seed,
            ..FitConfig::default()
        }
    }

    /// The fit of so many steps of a cloud with a layer: neither relocation nor noise.
    pub(crate) fn fit_of_layer(&self, start: usize, steps: usize) -> FitConfig {
        let [mean, final_mean_rate] = LAYER_MEAN_RATES;
        FitConfig {
            iterations: steps,
            cap_max: start,
            initial: start,
            growth_stop: 0.0,
            noise_lr: 0.0,
            rates: Rates { mean, ..self.rates },
            final_mean_rate,
            render_size: Some(self.render_size),
            seed: self.seed,
            ..FitConfig::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_photos_are_optimized_longer_and_larger_and_held_less() {
        let config = OptimizationConfig::default();
        for photos in [0, 2, 4] {
            assert_eq!(config.clone().for_photos(photos), config);
        }
        let eight = config.clone().for_photos(8);
        assert_eq!((eight.steps, eight.render_size), (894, 362));
        assert!((eight.anchors.weight - 0.1 / 8f64.sqrt()).abs() < 1e-12);
        let sixteen = config.clone().for_photos(16);
        assert_eq!((sixteen.steps, sixteen.render_size, sixteen.anchors.weight), (2000, 512, 0.1 / 8.0));
        assert_eq!(config.clone().for_photos(usize::MAX), sixteen);
        // What is as large already stays.
        let detailed = config.clone().detailed(2, 4000).for_photos(8);
        assert_eq!((detailed.steps, detailed.render_size, detailed.gaussians), (894, 512, 16_384));
        assert_eq!(config.clone().detailed(4, 4000).for_photos(16).render_size, 1024);
        let layers = [2, 4, 5, 16].map(|photos| config.clone().detailed(2, 512).for_photos(photos).layer);
        assert_eq!(layers, [0.25, 0.25, 0.0, 0.0]);
    }

    #[test]
    fn few_steps_have_faster_rates() {
        let of = |steps: usize| OptimizationConfig::default().fit(1000, steps).rates;
        let usual = Rates { mean: 1.5e-3, scale: 5e-3, rotation: 1e-3, opacity: 0.05, color: 2.5e-3 };
        assert_eq!((of(2000), of(100_000)), (usual, usual), "those of 3DGS, but for centers");
        for (steps, times) in [(1, 3.0), (400, 3.0), (894, 3f64.sqrt()), (1999, 1.0)] {
            let Rates { mean, scale, rotation, opacity, color } = of(steps);
            assert_eq!((mean, color), (usual.mean, usual.color));
            for (found, usual) in [(scale, usual.scale), (rotation, usual.rotation), (opacity, usual.opacity)] {
                assert!((found / usual - times).abs() < 2e-3, "{steps}: {}", found / usual);
            }
        }
    }

    #[test]
    fn detail_is_size_and_gaussians_and_later_steps() {
        let config = OptimizationConfig::default();
        for detail in [0, 1] {
            assert_eq!(config.clone().detailed(detail, 4000), config);
        }
        let two = config.clone().detailed(2, 512);
        assert_eq!(
            (two.steps, two.gaussians, two.render_size, two.anchors.weight),
            (400, 16_384, 512, 1.5 * 0.1 / 2.0)
        );
        assert_eq!((two.layer, two.coarse, two.coarse_size, two.window), (0.25, 0.6, 256, 0.6));
        assert!((two.anchors_of_layer().weight - 0.3).abs() < 1e-12);
        let four = config.clone().detailed(4, 4000);
        assert_eq!((four.steps, four.gaussians, four.render_size, four.coarse_size), (800, 32_768, 1024, 512));
        assert_eq!(four.anchors.weight, 1.5 * 0.1 / 4.0);
        // No more than photos show.
        assert_eq!(config.clone().detailed(4, 512), two);
        assert_eq!(config.clone().detailed(4, 257), two);
        assert_eq!(config.clone().detailed(4, 256), config);
    }

    #[test]
    fn defaults_pass_and_survive_serde() {
        FitConfig::default().check().unwrap();
        let text = serde_json::to_string(&FitConfig::default()).unwrap();
        assert_eq!(serde_json::from_str::<FitConfig>(&text).unwrap(), FitConfig::default());
    }

    #[test]
    fn unknown_fields_are_refused() {
        assert!(serde_json::from_str::<FitConfig>("{\"iteration\": 3}").is_err());
    }

    #[test]
    fn impossible_values_are_named() {
        let refused = |change: &dyn Fn(&mut FitConfig), field: &str| {
            let mut config = FitConfig::default();
            change(&mut config);
            let message = config.check().unwrap_err().to_string();
            assert!(message.starts_with(field), "{message}");
        };
        refused(&|c| c.iterations = 0, "iterations");
        refused(&|c| c.cap_max = usize::MAX, "cap_max");
        refused(&|c| c.initial = c.cap_max + 1, "initial");
        refused(&|c| c.noise_lr = f64::NAN, "noise_lr");
        refused(&|c| c.growth = 0.9, "growth");
        refused(&|c| c.lambda_ssim = 1.1, "lambda_ssim");
        refused(&|c| c.rates.color = f64::INFINITY, "rates.color");
        refused(&|c| c.render_size = Some(0), "render_size");
        refused(&|c| c.rates.mean = 0.0, "rates.mean");
        refused(&|c| c.final_mean_rate = f64::NAN, "final_mean_rate");
    }

    /// However few the steps and large the start, the fit is possible and its growth reaches the number asked for.
    #[test]
    fn an_optimization_grows_to_its_number() {
        for (steps, start) in [(400, 1024), (1, 1024), (20, 1), (1000, 5000), (7, 3)] {
            let config = OptimizationConfig { steps, ..Default::default() };
            let fit = config.fit(start, steps);
            fit.check().unwrap();
            let due = |step: &usize| {
                *step >= fit.growth_start
                    && step.is_multiple_of(fit.refine_every)
                    && (*step as f64) < fit.growth_stop * steps as f64
            };
            let rounds = (0..steps).filter(due).count();
            assert_eq!(rounds > 0, steps > 2, "{rounds} of {GROWTH_ROUNDS}");
            assert!(rounds <= 2 * GROWTH_ROUNDS, "{rounds} of {GROWTH_ROUNDS}");
            let grown = (0..rounds).fold(start, |count, _| crate::mcmc::grown(count, &fit));
            assert!(rounds == 0 || grown == start.max(8192), "{grown} after {rounds}");
        }
    }
}
