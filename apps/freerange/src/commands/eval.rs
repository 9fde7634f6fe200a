//! `freerange eval`

use std::{
    ops::ControlFlow,
    path::{Path, PathBuf},
    time::Instant,
};

use freerange_camera::{Scene, View};
use freerange_fit::{FitConfig, Rates, fit};
use freerange_splat::Cloud;
use serde::Serialize;

use super::reconstruct::Sampling;
use crate::{
    error::CliError,
    pictures::{grid, on_white, render_view, to_picture},
    pipeline::{self, Scores, score, to_user},
    progress::Progress,
    runtime::{checkpoint, peak_memory},
};

/// Measure a method on scenes with validation views: PSNR and SSIM, per object and on average.
///
/// Images are compared on white at their own resolution. SSIM is that of the 3DGS papers (11 x 11 Gaussian window,
/// zero padding).
#[derive(clap::Args)]
pub struct Args {
    /// Scenes (folders or transforms files); with --all, one folder that holds a folder per object.
    #[arg(required = true)]
    scenes: Vec<PathBuf>,
    /// Evaluate every folder in SCENES that has the input file.
    #[arg(long)]
    all: bool,
    /// File with the input views, within each scene folder.
    #[arg(long, default_value = "transforms_full.json")]
    inputs: String,
    /// File with the validation views, within each scene folder.
    #[arg(long, default_value = "transforms_val.json")]
    validate: String,
    /// What to measure.
    #[arg(long, value_enum, default_value = "model")]
    method: Method,
    /// Iterations of `--method fit`.
    #[arg(long, default_value_t = 2000)]
    fit_iterations: usize,
    /// Longest side, in pixels, of the images that `--method fit` works on.
    #[arg(long, default_value_t = 128)]
    fit_size: u32,
    #[command(flatten)]
    sampling: Sampling,
    /// Write the first validation views beside their renders into this folder, one picture per object.
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
    /// Write the report as JSON to this file.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Print the report as JSON on standard output.
    #[arg(long)]
    json: bool,
}

/// What makes the Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
enum Method {
    /// The model.
    Model,
    /// 3DGS-MCMC on the input views alone, without a model.
    Fit,
    /// No Gaussians at all: a white image.
    White,
}

#[derive(Serialize)]
struct Report {
    method: Method,
    inputs: String,
    refine: usize,
    psnr: f64,
    ssim: f64,
    objects: Vec<ObjectReport>,
    peak_memory_bytes: Option<u64>,
}

#[derive(Serialize)]
struct ObjectReport {
    object: String,
    gaussians: usize,
    seconds: f64,
    validation: Scores,
    input_views: Option<Scores>,
    /// The same without refinement, where there was one.
    #[serde(skip_serializing_if = "Option::is_none")]
    validation_before_refinement: Option<Scores>,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), CliError> {
    let scenes = find_scenes(args)?;
    let device = args.sampling.device.open()?;
    let checkpoint = match args.method {
        Method::Model => Some(checkpoint(args.sampling.checkpoint.as_deref(), &device)?),
        _ => None,
    };
    if let Some(folder) = &args.pictures {
        std::fs::create_dir_all(folder).map_err(|e| CliError::file(folder, e))?;
    }
    let mut objects = Vec::new();
    for (name, inputs, validation) in &scenes {
        let inputs = Scene::load(inputs)?.inputs;
        let validation = views_of(validation)?;
        let begin = Instant::now();
        let mut plain = None;
        let cloud = match (&checkpoint, args.method) {
            (Some(checkpoint), _) => {
                let options = args.sampling.options(checkpoint, 1, &device)?;
                let result = pipeline::run(&inputs, checkpoint, &options, &device)?;
                let first = result.samples.first().ok_or_else(|| CliError::input("no sample was drawn"))?;
                if options.refine > 0 {
                    plain = Some(to_user(&first.plain, &result.frame.canonical_from_user));
                }
                to_user(&first.refined, &result.frame.canonical_from_user)
            }
            (None, Method::Fit) => fit_alone(&inputs, args)?,
            (None, _) => Cloud::default(),
        };
        let seconds = begin.elapsed().as_secs_f64();
        let scores =
            score(&cloud, &validation)?.ok_or_else(|| CliError::input(format!("{name}: no validation views")))?;
        let before = plain.map(|plain| score(&plain, &validation)).transpose()?.flatten();
        if !args.json {
            let before =
                before.as_ref().map_or_else(String::new, |b| format!("  (PSNR {:.2} before refinement)", b.psnr));
            println!("{name:40} PSNR {:6.2}  SSIM {:.4}  {:6.1} s{before}", scores.psnr, scores.ssim, seconds);
        }
        if let Some(folder) = &args.pictures {
            let path = folder.join(format!("{name}.png"));
            strip(&cloud, &validation)?.save(&path).map_err(|e| CliError::file(&path, e))?;
        }
        objects.push(ObjectReport {
            object: name.clone(),
            gaussians: cloud.len(),
            seconds,
            input_views: score(&cloud, &inputs)?,
            validation: scores,
            validation_before_refinement: before,
        });
    }
    let mean = |f: fn(&ObjectReport) -> f64| objects.iter().map(f).sum::<f64>() / objects.len() as f64;
    let report = Report {
        method: args.method,
        inputs: args.inputs.clone(),
        refine: args.sampling.refine,
        psnr: mean(|o| o.validation.psnr),
        ssim: mean(|o| o.validation.ssim),
        objects,
        peak_memory_bytes: peak_memory(),
    };
    let json = serde_json::to_string_pretty(&report).map_err(CliError::input)?;
    if let Some(path) = &args.output {
        freerange_splat::write_atomically(path, |file| std::io::Write::write_all(file, json.as_bytes()))
            .map_err(|e| CliError::file(path, e))?;
    }
    match args.json {
        true => println!("{json}"),
        false => println!(
            "{:40} PSNR {:6.2}  SSIM {:.4}",
            format!("mean of {}", report.objects.len()),
            report.psnr,
            report.ssim
        ),
    }
    Ok(())
}

/// Name, input file and validation file of every scene.
fn find_scenes(args: &Args) -> Result<Vec<(String, PathBuf, PathBuf)>, CliError> {
    let mut folders = Vec::new();
    for path in &args.scenes {
        if !args.all {
            folders.push(path.clone());
            continue;
        }
        let entries = std::fs::read_dir(path).map_err(|e| CliError::file(path, e))?;
        for entry in entries {
            let entry = entry.map_err(|e| CliError::file(path, e))?.path();
            if entry.join(&args.inputs).is_file() {
                folders.push(entry);
            }
        }
    }
    folders.sort();
    if folders.is_empty() {
        return Err(CliError::input(format!("no folder with {} in {:?}", args.inputs, args.scenes)));
    }
    let name = |p: &Path| p.file_name().map_or_else(|| p.display().to_string(), |n| n.to_string_lossy().into_owned());
    Ok(folders.iter().map(|f| (name(f), f.join(&args.inputs), f.join(&args.validate))).collect())
}

fn views_of(path: &Path) -> Result<Vec<View>, CliError> {
    let scene = Scene::load(path)?;
    Ok(scene.inputs.into_iter().chain(scene.further).collect())
}

/// What a user without a model would do: fit the Gaussians to the input images.
fn fit_alone(inputs: &[View], args: &Args) -> Result<Cloud, CliError> {
    let (frame, canonical) = pipeline::to_canonical(inputs, args.sampling.up())?;
    let config = FitConfig {
        iterations: args.fit_iterations,
        render_size: Some(args.fit_size),
        seed: args.sampling.seed,
        // Chosen for long fits that start from the hull of a few masks.
        rates: Rates { mean: 1.5e-3, scale: 5e-3, ..FitConfig::default().rates },
        final_mean_rate: 1.5e-5,
        ..FitConfig::default()
    };
    let mut bar = Progress::new("fitting", config.iterations as u64);
    let cloud = fit(&canonical, None, &config, |p| {
        bar.at(p.step as u64, &format!("loss {:.4}", p.loss));
        ControlFlow::Continue(())
    })?;
    bar.finish();
    Ok(to_user(&cloud, &frame.canonical_from_user))
}

/// Up to six validation views above their renders.
fn strip(cloud: &Cloud, views: &[View]) -> Result<image::RgbaImage, CliError> {
    let mut rows = [Vec::new(), Vec::new()];
    for view in views.iter().step_by(views.len().div_ceil(6).max(1)) {
        let small = freerange_flow::batch::shrink(view, 192);
        rows[0].push(on_white(&small.image));
        rows[1].push(to_picture(&render_view(cloud, &small.camera)?, small.image.width(), small.image.height()));
    }
    Ok(grid(&rows))
}
