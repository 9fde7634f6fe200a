//! The main job as one function: posed images in the user's frame in, Gaussians in the user's frame out.

use std::{ops::ControlFlow, time::Instant};

use burn::tensor::Device;
use freerange_camera::{CanonicalFrame, FrameConfig, Similarity, Up, View, canonical_from_user, image_ops::composite};
use freerange_fit::{RefineConfig, frame_of, quick_fit, refine, tree_slice};
use freerange_flow::sample::{SampleConfig, reconstruct};
use freerange_metrics::{psnr, ssim_3dgs};
use freerange_model::Checkpoint;
use freerange_splat::Cloud;
use serde::Serialize;

use crate::{
    error::CliError,
    pictures::{WHITE, render_view},
    progress::Progress,
};

/// What a reconstruction should do beyond sampling.
#[derive(Clone, Debug)]
pub struct Options {
    /// How to sample.
    pub sample: SampleConfig,
    /// One result per seed.
    pub seeds: Vec<u64>,
    /// Leave the network out: what sampling would start from is the sample. The control of every comparison.
    pub without_network: bool,
    /// Steps of 3DGS-MCMC on the input views after sampling; 0 for none.
    pub refine: usize,
    /// Which way is up in the user's frame.
    pub up: Up,
    /// Show no progress: the caller has a bar of its own.
    pub quiet: bool,
}

/// One sample.
#[derive(Clone, Debug)]
pub struct Sample {
    /// The seed it was drawn with.
    pub seed: u64,
    /// As sampled, in the canonical frame.
    pub plain: Cloud,
    /// After refinement, in the canonical frame; the same as `plain` without it.
    pub refined: Cloud,
}

/// A reconstruction and what it took.
#[derive(Clone, Debug)]
pub struct Reconstruction {
    /// One per seed.
    pub samples: Vec<Sample>,
    /// Where the object was found.
    pub frame: CanonicalFrame,
    /// Seconds per stage, in order.
    pub seconds: Vec<(&'static str, f64)>,
}

/// Samples Gaussians for `views`, and refines them if asked to.
pub fn run(
    views: &[View],
    checkpoint: &Checkpoint,
    options: &Options,
    device: &Device,
) -> Result<Reconstruction, CliError> {
    let mut seconds = Vec::new();
    let begin = Instant::now();
    let (mut frame, mut canonical) = to_canonical(views, options.up)?;
    seconds.push(("frame", begin.elapsed().as_secs_f64()));

    let begin = Instant::now();
    let bar = |label: &str, total: usize| match options.quiet {
        true => Progress::silent(),
        false => Progress::new(label, total as u64),
    };
    let fits = match &options.sample.start {
        None => None,
        Some(start) => {
            let mut bar = bar("fitting", start.fit.iterations);
            let mut fit = quick_fit(&canonical, &start.fit, 0, |p| {
                bar.at(p.step as u64, &format!("loss {:.4}", p.loss));
                ControlFlow::Continue(())
            })?;
            bar.finish();
            // The fit knows better than the masks where the object is; it moves along, so that one is enough.
            if !frame.kept {
                let correction = frame_of(&fit, &canonical)?;
                fit.transform(correction.scale, correction.rotation, correction.translation);
                canonical = moved(&canonical, &correction);
                frame.canonical_from_user = correction.after(&frame.canonical_from_user);
                let (shift, scale) = (correction.translation.length(), correction.scale);
                frame.notes.push(format!("the quick fit moved it by {shift:.3} and scaled it by {scale:.3}"));
            }
            seconds.push(("fit", begin.elapsed().as_secs_f64()));
            Some([fit])
        }
    };

    let begin = Instant::now();
    let mut sampling = bar("sampling", options.sample.steps);
    let clouds = match (&fits, options.without_network) {
        (Some([fit]), true) => {
            let slice = tree_slice(fit, options.sample.depth.unwrap_or(checkpoint.depth))?;
            vec![vec![slice; options.seeds.len()]]
        }
        (None, true) => return Err(CliError::input("sample.start: expected a quick fit to start from, found none")),
        (fits, false) => {
            let fits = fits.as_ref().map(|f| f.as_slice());
            reconstruct(checkpoint, &[&canonical], fits, &options.sample, &options.seeds, device, |step| {
                sampling.at(step.index as u64, "");
            })?
        }
    };
    sampling.finish();
    seconds.push(("sample", begin.elapsed().as_secs_f64()));

    let begin = Instant::now();
    let mut samples = Vec::with_capacity(clouds.len());
    for (&seed, plain) in options.seeds.iter().zip(clouds.into_iter().flatten()) {
        let refined = match options.refine {
            0 => plain.clone(),
            steps => {
                let mut bar = bar("refining", steps);
                let config = RefineConfig { steps, seed, ..RefineConfig::default() };
                let refined = refine(&plain, &canonical, &config, |p| {
                    bar.at(p.step as u64, &format!("loss {:.4}", p.loss));
                    ControlFlow::Continue(())
                })?;
                bar.finish();
                refined
            }
        };
        samples.push(Sample { seed, plain, refined });
    }
    if options.refine > 0 {
        seconds.push(("refine", begin.elapsed().as_secs_f64()));
    }
    Ok(Reconstruction { samples, frame, seconds })
}

/// The views in the canonical frame, and how they got there.
pub fn to_canonical(views: &[View], up: Up) -> Result<(CanonicalFrame, Vec<View>), CliError> {
    let frame = canonical_from_user(views, &FrameConfig { up, ..FrameConfig::default() })?;
    let canonical = moved(views, &frame.canonical_from_user);
    Ok((frame, canonical))
}

fn moved(views: &[View], to: &Similarity) -> Vec<View> {
    views.iter().map(|v| View { camera: v.camera.transformed(to), ..v.clone() }).collect()
}

/// Takes a cloud from the canonical frame to the user's.
pub fn to_user(cloud: &Cloud, canonical_from_user: &Similarity) -> Cloud {
    let back = canonical_from_user.inverse();
    let mut cloud = cloud.clone();
    cloud.transform(back.scale, back.rotation, back.translation);
    cloud
}

/// Agreement of renders with the images of one view, on white at the image's own resolution.
#[derive(Clone, Debug, Serialize)]
pub struct ViewScore {
    /// The view.
    pub name: String,
    /// Peak signal-to-noise ratio, dB.
    pub psnr: f64,
    /// Structural similarity as the 3DGS papers compute it (11 x 11 Gaussian window, zero padding).
    pub ssim: f64,
}

/// Scores of a set of views.
#[derive(Clone, Debug, Serialize)]
pub struct Scores {
    /// Mean over the views, dB.
    pub psnr: f64,
    /// Mean over the views.
    pub ssim: f64,
    /// Every view.
    pub views: Vec<ViewScore>,
}

/// Compares renders of `cloud` with `views`; both in one frame. Returns none for no views.
pub fn score(cloud: &Cloud, views: &[View]) -> Result<Option<Scores>, CliError> {
    let scored = views
        .iter()
        .map(|view| {
            let (w, h) = view.image.dimensions();
            // As a viewer would see it: clamped to the range of a picture.
            let render: Vec<f32> = render_view(cloud, &view.camera)?.iter().map(|x| x.clamp(0.0, 1.0)).collect();
            let truth = composite(&view.image, WHITE);
            Ok(ViewScore {
                name: view.name.clone(),
                psnr: psnr(&render, &truth)?,
                ssim: ssim_3dgs(&render, &truth, w as usize, h as usize)?,
            })
        })
        .collect::<Result<Vec<_>, CliError>>()?;
    if scored.is_empty() {
        return Ok(None);
    }
    let mean = |f: fn(&ViewScore) -> f64| scored.iter().map(f).sum::<f64>() / scored.len() as f64;
    Ok(Some(Scores { psnr: mean(|v| v.psnr), ssim: mean(|v| v.ssim), views: scored }))
}
