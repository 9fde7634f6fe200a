//! How good the averaged weights are on objects that training does not see: now and then, always in the same way.

use std::{ops::ControlFlow, sync::Arc};

use burn::tensor::{Device, Tensor};
use freerange_data::{Object, ObjectSource};
use freerange_gaussians::{Gaussians, channel};
use freerange_model::{Checkpoint, FreeRange, ModelConfig};
use freerange_optim::psnr_over_white;
use freerange_raster::{RasterConfig, render};
use freerange_scene::camera::{
    View,
    image_ops::{composite, sheet, to_picture},
};
use freerange_util::Invalid;
use image::RgbaImage;

use crate::{
    TrainError,
    batch::Batch,
    batch::choose_views,
    batch::step_rng,
    config::{Stage, TrainConfig},
    ranks::{Ranks, gather},
    train,
};
use freerange_diffusion::{
    photometric::Photometric,
    sample::{Estimate, FlowConfig, FlowSampler, Refiner, RefinerConfig},
};

/// What was measured.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Figures {
    /// Flow-matching loss.
    pub flow: f32,
    /// L1 over input views.
    pub seen: f32,
    /// L1 over other views.
    pub held: f32,
    /// Mean PSNR, in dB over white, of other views of what the model samples.
    pub psnr: f64,
    /// Samples that is the mean of.
    pub samples: usize,
    /// Of the first samples of this rank: other views of the object above the same of the sample.
    #[serde(skip)]
    pub pictures: Vec<RgbaImage>,
}

/// The objects to measure on.
#[derive(Debug)]
pub(crate) struct Validation {
    objects: Vec<(u64, Arc<Object>)>, // this rank's, with their numbers
    seed: u64,
}

/// What was measured on an object.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Measured {
    object: u64,
    losses: [f32; 3],
    psnr: Vec<f64>,
}

impl Measured {
    /// As bytes: exact, and no number is lost that is not finite.
    fn write(&self, bytes: &mut Vec<u8>) {
        bytes.extend(self.object.to_le_bytes());
        bytes.extend(self.losses.iter().flat_map(|x| x.to_le_bytes()));
        bytes.extend((self.psnr.len() as u32).to_le_bytes());
        bytes.extend(self.psnr.iter().flat_map(|x| x.to_le_bytes()));
    }

    /// The first of `bytes`, which then begin with the next one.
    fn read(bytes: &mut &[u8]) -> Option<Self> {
        fn take<const N: usize>(bytes: &mut &[u8]) -> Option<[u8; N]> {
            let (own, rest) = bytes.split_first_chunk()?;
            *bytes = rest;
            Some(*own)
        }
        let object = u64::from_le_bytes(take(bytes)?);
        let mut losses = [0.0; 3];
        for loss in &mut losses {
            *loss = f32::from_le_bytes(take(bytes)?);
        }
        let count = u32::from_le_bytes(take(bytes)?);
        let psnr = (0..count).map(|_| Some(f64::from_le_bytes(take(bytes)?))).collect::<Option<_>>()?;
        Some(Self { object, losses, psnr })
    }
}

impl Figures {
    /// Over what all ranks have measured: sums in the objects' order, so that it does not matter which rank had which.
    pub(crate) fn of(ranks: &dyn Ranks, own: Vec<Measured>) -> Result<Self, TrainError> {
        let mut bytes = Vec::new();
        own.iter().for_each(|m| m.write(&mut bytes));
        let mut all = Vec::new();
        for told in gather(ranks, &bytes)? {
            let mut told = told.as_slice();
            while !told.is_empty() {
                let torn = || TrainError::Ranks { problem: "a measurement was cut short".into() };
                all.push(Measured::read(&mut told).ok_or_else(torn)?);
            }
        }
        all.sort_by_key(|m| m.object);
        let mut sums = [0f32; 3];
        for measured in &all {
            sums.iter_mut().zip(measured.losses).for_each(|(sum, x)| *sum += x);
        }
        let [flow, seen, held] = sums.map(|x| x / all.len() as f32);
        let psnr: Vec<f64> = all.iter().flat_map(|m| m.psnr.iter().copied()).collect();
        let mut sum = 0.0;
        psnr.iter().for_each(|x| sum += x);
        Ok(Self { flow, seen, held, psnr: sum / psnr.len() as f64, samples: psnr.len(), pictures: Vec::new() })
    }
}

/// Views of an object that samples are compared with, at most.
const COMPARED: usize = 8;
/// Samples that there are pictures of, at most, and views on each.
const PICTURED: (usize, usize) = (4, 4);

/// The first views of an object above the same of a sample, over white.
fn picture(sample: &Gaussians, views: &[View]) -> Result<RgbaImage, TrainError> {
    const WHITE: [f32; 3] = [1.0; 3];
    let (mut truth, mut renders) = (Vec::new(), Vec::new());
    for View { camera, image, .. } in views.iter().take(PICTURED.1) {
        truth.push(to_picture(&composite(image, WHITE), camera.width, camera.height));
        let render = render(sample.rows(), &[*camera], &[WHITE], &RasterConfig::default())?;
        renders.push(to_picture(&render.rgb, camera.width, camera.height));
    }
    Ok(sheet(&[truth, renders]))
}

impl Validation {
    /// Takes a rank's share of the first `count` of `available` objects of `source`.
    pub fn new(
        source: &dyn ObjectSource,
        available: u64,
        count: usize,
        seed: u64,
        [rank, world]: [usize; 2],
    ) -> Result<Self, TrainError> {
        let own = (rank as u64..(count as u64).min(available)).step_by(world);
        let objects = own.map(|i| Ok((i, Arc::new(source.object(i)?)))).collect::<Result<_, TrainError>>()?;
        Ok(Self { objects, seed })
    }

    /// Refuses objects of which no sample could ever be compared with anything, on no rank: a run would have no best weights.
    pub fn require_comparisons<M>(&self, ranks: &dyn Ranks, config: &TrainConfig<M>) -> Result<(), TrainError> {
        let own = self.objects.iter().any(|(number, object)| !self.tasks(object, config, *number).is_empty());
        if gather(ranks, &[u8::from(own)])?.contains(&vec![1]) {
            return Ok(());
        }
        let fits = "initial fits of their input views, which the refiner begins with (data.object.input_fits), and ";
        let fits = if config.refiner.is_some() { fits } else { "" };
        let expected = format!("objects with {fits}views beside the input views to compare with");
        Err(Invalid::new("validation.objects", expected, "none").into())
    }

    /// Measures `checkpoint`, whose weights are also in `tracked`, a model on a differentiating device.
    ///
    /// # Errors
    /// [`TrainError::Cancelled`] where `interrupted` says so, which is asked before every object and step of sampling.
    pub fn measure(
        &self,
        checkpoint: &Checkpoint,
        tracked: &FreeRange,
        config: &TrainConfig,
        stage: &Stage,
        device: &Device,
        interrupted: &dyn Fn() -> bool,
    ) -> Result<(Vec<Measured>, Vec<RgbaImage>), TrainError> {
        let photometric = Photometric::new(&checkpoint.normalization, device);
        let rms = Tensor::<1>::from_floats(checkpoint.gradient_rms, device).reshape([1, 1, channel::COUNT]);
        let model_config = ModelConfig { image_size: stage.image_size, ..config.model.clone() };
        let (mut measured, mut pictures) = (Vec::new(), Vec::new());
        for (number, object) in &self.objects {
            if interrupted() {
                return Err(TrainError::Cancelled);
            }
            // Times, noise and views are the same every time.
            let mut rng = step_rng(self.seed, *number);
            let one = std::slice::from_ref(object);
            let batch =
                Batch::draw(one, stage, &model_config, &config.loss, &checkpoint.normalization, &mut rng, device)?;
            let losses = train::step(tracked, batch, &photometric, &rms, &config.loss, device)?;
            let figures = Tensor::cat(vec![losses.flow, losses.seen, losses.held], 0).into_data();
            let figures = figures.try_to_vec::<f32>().map_err(TrainError::device)?;
            let &[flow, seen, held] = figures.as_slice() else { return Err(TrainError::device(&figures)) };
            let mut psnr = Vec::new();
            for (inputs, others, fit) in self.tasks(object, config, *number) {
                let found = self.reconstruct(checkpoint, config, stage, &inputs, fit.as_ref(), device, interrupted)?;
                psnr.push(psnr_over_white(&found, &others)?);
                if pictures.len() < PICTURED.0 {
                    pictures.push(picture(&found, &others)?);
                }
            }
            measured.push(Measured { object: *number, losses: [flow, seen, held], psnr });
        }
        Ok((measured, pictures))
    }

    /// What the model makes of some views: a refinement of `fit`, or a sample from noise.
    fn reconstruct(
        &self,
        checkpoint: &Checkpoint,
        config: &TrainConfig,
        stage: &Stage,
        inputs: &[View],
        fit: Option<&Gaussians>,
        device: &Device,
        interrupted: &dyn Fn() -> bool,
    ) -> Result<Gaussians, TrainError> {
        // The size that objects come in is the size that they are sampled and compared at.
        let lod_depth = (!config.model.kind.one_pass()).then_some(stage.depth);
        let go_on = |_: &Estimate| if interrupted() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
        let mut found = match (&config.refiner, fit) {
            (Some(refiner), Some(fit)) => {
                let config = &RefinerConfig { lod_depth, ..refiner.clone() };
                Refiner { checkpoint, config, device }.refine(&[inputs], std::slice::from_ref(fit), go_on)?
            }
            _ => {
                let config = &FlowConfig { lod_depth, ..config.sample.clone() };
                FlowSampler { checkpoint, config, device }.sample(&[inputs], &[self.seed], go_on)?
            }
        };
        Ok(found.remove(0))
    }

    /// What is measured of an object: each of its fits where the model refines fits, else one choice of views.
    /// Nothing where no view is left to compare with.
    fn tasks<M>(&self, object: &Object, config: &TrainConfig<M>, number: u64) -> Vec<Task> {
        let (fewest, most) = config.loss.input_views;
        let of = |(chosen, rest): (Vec<&View>, Vec<&View>), fit| {
            let views = |views: Vec<&View>| views.into_iter().cloned().collect::<Vec<View>>();
            (views(chosen), views(rest.into_iter().take(COMPARED).collect()), fit)
        };
        let tasks = if config.refiner.is_none() {
            let mut rng = step_rng(!self.seed, number);
            let count = 4usize.clamp(fewest, most);
            vec![of(choose_views(&object.views, count, false, &mut rng), None)]
        } else {
            let fits = object.input_fits.iter().take(2); // around the object, and from one side
            let fits = fits.map(|fit| {
                let (chosen, rest) = (0..object.views.len()).partition::<Vec<usize>, _>(|i| fit.views.contains(i));
                let [chosen, rest] = [chosen, rest].map(|set| set.into_iter().map(|i| &object.views[i]).collect());
                of((chosen, rest), Some(fit.gaussians.clone()))
            });
            fits.collect()
        };
        tasks.into_iter().filter(|(_, rest, _)| !rest.is_empty()).collect()
    }
}

/// Input views, views to compare with, and the fit to start from.
type Task = (Vec<View>, Vec<View>, Option<Gaussians>);
