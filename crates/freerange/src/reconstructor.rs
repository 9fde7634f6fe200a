//! The main job: posed images in the user's frame in, Gaussians in the user's frame out.

use std::{ops::ControlFlow, path::Path, time::Instant};

use burn::tensor::Device;
use freerange_camera::{CanonicalFrame, FrameConfig, Similarity, View, canonical_from_user, inputs_around};
use freerange_core::side_by_side;
use freerange_fit::{Evidence, FitProgress, HoldConfig, QuickFitConfig, RefineConfig, polish, refine, tree_slice};
use freerange_flow::sample::{Estimate, SampleConfig, StartConfig, reconstruct};
use freerange_model::Checkpoint;
use freerange_splat::Cloud;

use crate::{
    EncoderPlaces, Error, Options, Progress, Stage, load_checkpoint,
    placed::{Placed, watched},
    progress::Known,
    require, sampling,
};

/// A model on a device, ready to reconstruct one object after the other.
#[derive(Clone, Debug)]
pub struct Reconstructor {
    checkpoint: Checkpoint,
    device: Device,
}

/// One sample.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Sample {
    /// The seed it was drawn with.
    pub seed: u64,
    /// The Gaussians, in the frame of the views.
    pub gaussians: Cloud,
    /// The same before refinement; none where there was none.
    pub unrefined: Option<Cloud>,
    /// `gaussians` in the canonical frame: around the origin within a radius of 0.5, +z up.
    pub canonical: Cloud,
}

/// A reconstruction and what it took.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Reconstruction {
    /// One per seed.
    pub samples: Vec<Sample>,
    /// Which of the views the model was shown, ascending.
    pub shown: Vec<usize>,
    /// From the frame of the views to the canonical one.
    pub canonical_from_user: Similarity,
    /// What the user should know.
    pub notes: Vec<String>,
    /// Seconds per stage, in order.
    pub seconds: Vec<(Stage, f64)>,
}

impl Reconstructor {
    /// The model that is part of this program.
    ///
    /// # Errors
    /// If the device fails.
    pub fn shipped(device: &Device) -> Result<Self, Error> {
        Ok(Self::new(load_checkpoint(None, &EncoderPlaces::default(), device)?, device))
    }

    /// A model from a file. The weights of a frozen encoder are looked for in `encoders`.
    ///
    /// # Errors
    /// Names the file and what is wrong with it.
    pub fn load(checkpoint: &Path, encoders: &EncoderPlaces, device: &Device) -> Result<Self, Error> {
        Ok(Self::new(load_checkpoint(Some(checkpoint), encoders, device)?, device))
    }

    /// A model that is in memory, on `device`, already.
    pub fn new(checkpoint: Checkpoint, device: &Device) -> Self {
        Self { checkpoint, device: device.clone() }
    }

    /// The model.
    pub fn checkpoint(&self) -> &Checkpoint {
        &self.checkpoint
    }

    /// Where it computes.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// The model's own way to sample and refine: one sample of seed 0, +z up.
    ///
    /// # Errors
    /// If what the checkpoint says of it cannot be used.
    pub fn options(&self) -> Result<Options, Error> {
        let sample = sampling(&self.checkpoint.provenance)?;
        Ok(Options {
            sample,
            seeds: vec![0],
            views: None,
            without_network: false,
            init: None,
            frame: FrameConfig::default(),
        })
    }

    /// Most views that the model has seen at once in training; the paper's four where its checkpoint does not tell.
    pub fn views(&self) -> usize {
        crate::network_views(&self.checkpoint.provenance)
    }

    /// Gaussians that it makes by default, before refinement; of a pixel-aligned model for as many views as it is shown.
    ///
    /// # Errors
    /// If what the checkpoint says of sampling cannot be used.
    pub fn gaussians(&self) -> Result<usize, Error> {
        let depth = sampling(&self.checkpoint.provenance)?.depth_of(self.checkpoint.depth);
        Ok(self.checkpoint.config.gaussians(depth, self.views()))
    }

    /// Refuses options that this model or its device cannot follow.
    ///
    /// # Errors
    /// Names the option.
    pub fn check(&self, options: &Options) -> Result<(), Error> {
        options.sample.validate()?;
        let kind = self.checkpoint.config.kind;
        options.sample.validate_for(kind)?;
        if kind.one_pass() && options.seeds.len() > 1 {
            let expected = format!("one sample: a {} model has one answer", kind.name());
            return Err(Error::input("seeds", expected, options.seeds.len()));
        }
        if options.without_network && options.sample.start.is_none() {
            return Err(Error::input("sample.start", "a quick fit to start from", "none"));
        }
        if options.init.is_some() && options.sample.start.is_none() {
            return Err(Error::input(
                "sample.start",
                "a start from Gaussians, as there are some to start from",
                "none",
            ));
        }
        if options.views == Some(0) {
            return Err(Error::input("views", "at least 1", 0));
        }
        require(options.sample.compute, &self.device)
    }

    /// Samples Gaussians for two or more views of one object, and refines them if asked to.
    ///
    /// `progress` is told of every step, and ends the work by `ControlFlow::Break`.
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
        check_views(views)?;
        let mut tell = |p: &Progress<'_>| match progress(p) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(Error::Cancelled),
        };
        let mut seconds = Vec::new();

        let begin = Instant::now();
        tell(&Progress::new(Stage::Frame, 0, 1))?;
        let mut placed = Placed::new(views, &options.frame, options.views.unwrap_or(self.views()))?;
        seconds.push((Stage::Frame, begin.elapsed().as_secs_f64()));

        // Samples that nothing is made of have no use for others beside them.
        let members = if options.sample.refine > 0 { options.sample.ensemble } else { 1 };
        if options.sample.mirror > 0.0 || options.sample.turn > 0.0 {
            let begin = Instant::now();
            placed.symmetries(&options.sample, &mut tell)?;
            seconds.push((Stage::Mirror, begin.elapsed().as_secs_f64()));
        }
        let mut fits = Vec::new();
        if let Some(init) = &options.init {
            let begin = Instant::now();
            // Where the object is, an initial fit finds out.
            if !placed.settled {
                placed.quick_fits(&QuickFitConfig::default(), &[0], 1, &mut tell)?;
            }
            fits = vec![vec![placed.canonical_init(init)?; options.seeds.len()]; members];
            seconds.push((Stage::Fit, begin.elapsed().as_secs_f64()));
        } else if let Some(StartConfig { fit, .. }) = &options.sample.start {
            let begin = Instant::now();
            fits = placed.quick_fits(fit, &options.seeds, members, &mut tell)?;
            seconds.push((Stage::Fit, begin.elapsed().as_secs_f64()));
        } else if options.sample.polish > 0 && !placed.settled {
            // What is polished begins elsewhere, but where the object is, a quick fit knows best there, too.
            let begin = Instant::now();
            placed.quick_fits(&QuickFitConfig::default(), &[0], 1, &mut tell)?;
            seconds.push((Stage::Fit, begin.elapsed().as_secs_f64()));
        }

        let begin = Instant::now();
        let clouds = self.ensembles(&placed, &fits, options, members, &mut tell)?;
        seconds.push((Stage::Sample, begin.elapsed().as_secs_f64()));

        let begin = Instant::now();
        let mut samples = Vec::with_capacity(clouds.len());
        for (i, members) in clouds.into_iter().enumerate() {
            samples.push(finished(i, members, &placed, options, &mut tell)?);
        }
        if options.sample.refine > 0 {
            seconds.push((Stage::Refine, begin.elapsed().as_secs_f64()));
        }
        let Placed { frame: CanonicalFrame { canonical_from_user, notes, .. }, chosen, .. } = placed;
        Ok(Reconstruction { samples, shown: chosen, canonical_from_user, notes, seconds })
    }

    /// All members of the ensemble of each seed, the sample itself first. `[seeds][members]`
    fn ensembles(
        &self,
        placed: &Placed,
        fits: &[Vec<Cloud>],
        options: &Options,
        members: usize,
        tell: &mut impl FnMut(&Progress<'_>) -> Result<(), Error>,
    ) -> Result<Vec<Vec<Cloud>>, Error> {
        let (mut done, total) = (0, members * steps_of_member(options));
        tell(&Progress::new(Stage::Sample, done, total))?;
        let (place, seen) = (&placed.frame.canonical_from_user, &placed.seen());
        let mut stopped = Ok(());
        let mut step = |loss, known: Option<Known<'_>>| {
            done += 1;
            let estimate = known.map(|known| (known, place));
            stopped = tell(&Progress { loss, estimate, ..Progress::new(Stage::Sample, done, total) });
            if stopped.is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
        };
        // The other members only help the first: nobody is shown them.
        let sample = |member: usize, tell: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>| {
            let fits = fits.get(member).map(Vec::as_slice);
            self.sample(seen, fits, options, member as u64, &mut |told| {
                tell(Step { loss: told.loss, estimate: told.estimate.filter(|_| member == 0) })
            })
        };
        let sampled: Result<Vec<Vec<Cloud>>, Error> = match self.device == Device::flex() {
            // A device has one queue. The first that is ended is the last.
            false => (0..members)
                .map(|member| sample(member, &mut |told| step(told.loss, told.estimate.map(Known::Sampled))))
                .collect(),
            true => {
                let sample = &sample;
                let job = |member| {
                    move |tell: &mut dyn FnMut(_) -> ControlFlow<()>| {
                        sample(member, &mut |told| tell((told.loss, told.estimate.map(Estimate::clouds).transpose())))
                    }
                };
                let mut failed = Ok(());
                let sampled = side_by_side((0..members).map(job).collect(), |_, (loss, clouds)| match clouds {
                    Ok(clouds) => step(loss, clouds.as_deref().map(Known::Read)),
                    Err(error) => {
                        failed = Err(error);
                        ControlFlow::Break(())
                    }
                });
                failed?;
                sampled.into_iter().collect()
            }
        };
        stopped?;
        let mut clouds = vec![Vec::with_capacity(members); options.seeds.len()];
        for sampled in sampled? {
            clouds.iter_mut().zip(sampled).for_each(|(members, cloud)| members.push(cloud));
        }
        Ok(clouds)
    }

    /// One cloud per seed, of member `member` of an ensemble, for views and outlines in the canonical frame and their quick fits, one per seed,
    /// if sampling starts from them.
    fn sample(
        &self,
        seen: &Evidence<'_>,
        fits: Option<&[Cloud]>,
        options: &Options,
        member: u64,
        tell: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> Result<Vec<Cloud>, Error> {
        let config = &options.sample;
        if let (Some(fits), true) = (fits, options.without_network) {
            let depth = config.depth_of(self.checkpoint.depth);
            return fits.iter().map(|fit| Ok(tree_slice(fit, depth)?)).collect();
        }
        // The first member is what it is without the others, which draw from far away.
        let seeds: Vec<u64> = options.seeds.iter().map(|seed| seed.wrapping_add(member << 32)).collect();
        let mut clouds = self.network(seen.views, fits, config, &seeds, |estimate| {
            tell(Step { loss: None, estimate: Some(estimate) })
        })?;
        if config.polishing() > 0 {
            let quick = QuickFitConfig { iterations: config.polishing(), ..QuickFitConfig::default() };
            for (cloud, &seed) in clouds.iter_mut().zip(&seeds) {
                let mut told = ControlFlow::Continue(());
                *cloud = polish(cloud, seen.clone(), &quick, seed, |p| {
                    told = tell(Step { loss: Some(p.loss), estimate: None });
                    told
                })?;
                if told.is_break() {
                    return Err(Error::Cancelled);
                }
            }
        }
        if let Some(mending) = config.mending() {
            for (cloud, seed) in clouds.iter_mut().zip(&seeds) {
                let (fit, seed) = (std::slice::from_ref(&*cloud), std::slice::from_ref(seed));
                let told = |_: &Estimate<'_>| tell(Step { loss: None, estimate: None });
                let mended = self.network(seen.views, Some(fit), &mending, seed, told)?;
                *cloud = mended.into_iter().next().expect("one object, one seed");
            }
        }
        Ok(clouds)
    }

    /// What the network makes of views, starting from `fits`, one per seed, where `config` says so. One cloud per seed.
    fn network(
        &self,
        views: &[View],
        fits: Option<&[Cloud]>,
        config: &SampleConfig,
        seeds: &[u64],
        told: impl FnMut(&Estimate<'_>) -> ControlFlow<()>,
    ) -> Result<Vec<Cloud>, Error> {
        let clouds = reconstruct(&self.checkpoint, &[views], fits, config, seeds, &self.device, told)?;
        Ok(clouds.into_iter().flatten().collect())
    }
}

/// Steps of sampling that are told of each member of an ensemble: the network's, and sample by sample those of polishing and mending.
fn steps_of_member(options: &Options) -> usize {
    let config = &options.sample;
    let mending = config.mending().map_or(0, |mending| mending.steps);
    config.steps + options.seeds.len() * (config.polishing() + mending)
}

/// What is told of a step of sampling.
struct Step<'a> {
    /// Of polishing.
    loss: Option<f64>,
    /// The network's, from the starts that the user knows.
    estimate: Option<&'a Estimate<'a>>,
}

/// Restarts of k-means, as in the evaluation.
const RESTARTS: usize = 10;

/// At most `most` views from all around the object, as the paper's protocol chooses them; ascending.
///
/// # Errors
/// If the cameras do not allow a choice.
pub fn choose_views(views: &[View], most: usize) -> Result<Vec<usize>, Error> {
    let centers: Vec<_> = views.iter().map(|v| v.camera.center()).collect();
    if views.len() <= most {
        return Ok((0..views.len()).collect());
    }
    // Of views from one place the first is enough.
    let size = centers.iter().map(|c| c.distance(centers[0])).fold(0.0, f64::max);
    let mut places: Vec<usize> = Vec::new();
    for i in 0..views.len() {
        if places.iter().all(|&j| centers[i].distance(centers[j]) > 1e-6 * size) {
            places.push(i);
        }
    }
    match places.len() <= most {
        true => Ok(places),
        false => Ok(inputs_around(&centers, &places, most, RESTARTS, 0)?),
    }
}

/// Sample `i`, refined if that is asked for, and in the user's frame, of the members of its ensemble.
fn finished(
    i: usize,
    mut members: Vec<Cloud>,
    placed: &Placed,
    options: &Options,
    tell: &mut impl FnMut(&Progress<'_>) -> Result<(), Error>,
) -> Result<Sample, Error> {
    let (seed, place) = (options.seeds[i], &placed.frame.canonical_from_user);
    let plain = members.remove(0);
    let (canonical, unrefined) = match options.sample.refine {
        0 => (plain, None),
        steps => {
            // What several agree on is held more firmly than a guess.
            let hold = match members.is_empty() {
                true => HoldConfig::default(),
                false => HoldConfig { weight: 0.3, views: 24, ..HoldConfig::default() },
            };
            let config = RefineConfig { steps, hold, seed, ..RefineConfig::default() };
            let sides = placed.canonical.iter().map(|view| view.image.width().max(view.image.height()));
            let config = config.detailed(options.sample.detail, sides.max().unwrap_or(0)).for_photos(placed.photos);
            let fit = |p: &mut dyn FnMut(&FitProgress<'_>) -> _| refine(&plain, &members, placed.all(), &config, p);
            let refined = watched(Stage::Refine, i, place, tell, config.steps, fit)?;
            (refined, Some(to_user(&plain, place)))
        }
    };
    Ok(Sample { seed, gaussians: to_user(&canonical, place), unrefined, canonical })
}

/// Refuses views whose parts do not fit each other.
fn check_views(views: &[View]) -> Result<(), Error> {
    for view in views {
        let field = |what: &str| format!("view `{}`: {what}", view.name);
        let (c, (w, h)) = (&view.camera, view.image.dimensions());
        if (c.width, c.height) != (w, h) || w == 0 || h == 0 {
            let expected = format!("{} x {} pixels, as its camera has, and some", c.width, c.height);
            return Err(Error::input(field("image"), expected, format!("{w} x {h}")));
        }
        let finite = [c.fx, c.fy, c.cx, c.cy].iter().all(|x| x.is_finite()) && c.world_to_camera.is_finite();
        if !finite || c.fx <= 0.0 || c.fy <= 0.0 {
            return Err(Error::input(field("camera"), "finite numbers and focal lengths above 0", format!("{c:?}")));
        }
    }
    Ok(())
}

/// The views in the canonical frame, and how they got there.
///
/// # Errors
/// If there are fewer than two views, or they do not show one object from different places.
pub fn to_canonical(views: &[View], config: &FrameConfig) -> Result<(CanonicalFrame, Vec<View>), Error> {
    let frame = canonical_from_user(views, config)?;
    let canonical = moved(views, &frame.canonical_from_user);
    Ok((frame, canonical))
}

pub(crate) fn moved(views: &[View], to: &Similarity) -> Vec<View> {
    views.iter().map(|v| View { camera: v.camera.transformed(to), ..v.clone() }).collect()
}

/// Takes a cloud from the canonical frame to the user's.
pub fn to_user(cloud: &Cloud, canonical_from_user: &Similarity) -> Cloud {
    let back = canonical_from_user.inverse();
    let mut cloud = cloud.clone();
    cloud.transform(back.scale, back.rotation, back.translation);
    cloud
}
