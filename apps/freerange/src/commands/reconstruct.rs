//! `freerange reconstruct`

use std::{path::PathBuf, time::Instant};

use burn::tensor::Device;
use freerange_camera::{
    Scene, Up, View,
    image_ops::{sheet, to_picture},
};
use freerange_flow::sample::{SampleConfig, Solver};
use freerange_model::Compute;
use freerange_splat::write_ply;
use serde::Serialize;

use crate::{
    device::{DeviceName, parse_compute, require},
    error::CliError,
    output::OutputFolder,
    pictures::{on_white, render_view, write_turntable},
    pipeline::{self, Options, Scores, score, to_user},
    runtime::{checkpoint, peak_memory},
};

/// Reconstruct an object from posed images.
///
/// Writes gaussians.ply (in the frame of your cameras), turntable.gif, inputs/ (each input view beside its render)
/// and report.json.
#[derive(clap::Args)]
pub struct Args {
    /// Folder with transforms.json (or transforms_train.json and transforms_test.json), or such a file.
    scene: PathBuf,
    /// Where the results go.
    #[arg(short, long, default_value = "out")]
    output: PathBuf,
    /// Another scene of the same object whose views are only compared with.
    #[arg(long, value_name = "SCENE")]
    validate: Option<PathBuf>,
    #[command(flatten)]
    sampling: Sampling,
    /// Samples to draw; they differ where the images leave the object open.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64))]
    samples: u32,
    /// Print the report as JSON on standard output.
    #[arg(long)]
    json: bool,
}

/// Options of every command that samples.
#[derive(clap::Args)]
pub struct Sampling {
    /// Model to use instead of the shipped one.
    #[arg(long, value_name = "FILE")]
    pub checkpoint: Option<PathBuf>,
    /// Continue from the sample with so many steps of 3DGS-MCMC on the input views, up to 4,096 Gaussians and held in
    /// place where no view looks; 500 are enough.
    #[arg(long, default_value_t = 0, value_name = "STEPS")]
    pub refine: usize,
    /// Seed of the (first) sample.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Steps from noise to Gaussians [default: the checkpoint's].
    #[arg(long)]
    pub steps: Option<usize>,
    /// Start from a quick fit of the input views (fit) or from pure noise (noise) [default: the checkpoint's].
    #[arg(long, value_enum)]
    pub start: Option<StartName>,
    /// Make 2^DEPTH Gaussians [default: the depth of the level-of-detail tree that the checkpoint was trained at].
    #[arg(long, value_parser = clap::value_parser!(u32).range(4..=16))]
    pub depth: Option<u32>,
    /// Classifier-free guidance scale s; 1 is none [default: the checkpoint's].
    #[arg(long)]
    pub guidance: Option<f32>,
    /// Photometric guidance scale lambda; 0 is none [default: the checkpoint's].
    #[arg(long)]
    pub photometric: Option<f32>,
    /// How the steps are taken: euler, heun (two evaluations per step) or multistep [default: the checkpoint's].
    #[arg(long, value_parser = parse_solver)]
    pub solver: Option<Solver>,
    /// Arithmetic of the transformer: f32, or bf16 or f16 where the device has it [default: the checkpoint's].
    #[arg(long, value_parser = parse_compute)]
    pub compute: Option<Compute>,
    /// Which way is up in the scene's frame.
    #[arg(long, value_enum, default_value = "z")]
    pub up: UpName,
    /// Where to compute: auto, cpu, or cuda, metal, vulkan, webgpu with a number if there are several, as in cuda:1.
    #[arg(long, default_value = "auto")]
    pub device: DeviceName,
}

/// Where sampling starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum StartName {
    /// A quick fit of the input views.
    Fit,
    /// Pure noise, as in the paper.
    Noise,
}

/// Which way is up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum UpName {
    /// The z axis (Blender, NeRF, nerfstudio).
    Z,
    /// The y axis.
    Y,
    /// Where the tops of the images point, on average.
    Cameras,
}

/// `euler`, `heun` or `multistep`.
fn parse_solver(text: &str) -> Result<Solver, String> {
    serde_json::from_value(text.into()).map_err(|_| "expected euler, heun or multistep".into())
}

impl Sampling {
    /// Which way is up, as the camera crate calls it.
    pub fn up(&self) -> Up {
        match self.up {
            UpName::Z => Up::Z,
            UpName::Y => Up::Y,
            UpName::Cameras => Up::Cameras,
        }
    }

    /// The checkpoint's own way to sample, with what the user overrides.
    pub fn options(
        &self,
        checkpoint: &freerange_model::Checkpoint,
        samples: u32,
        device: &Device,
    ) -> Result<Options, CliError> {
        let mut sample: SampleConfig = match checkpoint.provenance.get("sample") {
            Some(value) => serde_json::from_value(value.clone())
                .map_err(|e| CliError::input(format!("checkpoint: field `sample` of the metadata: {e}")))?,
            None => SampleConfig::default(),
        };
        sample.steps = self.steps.unwrap_or(sample.steps);
        sample.depth = self.depth.or(sample.depth);
        sample.start = match self.start {
            Some(StartName::Noise) => None,
            Some(StartName::Fit) => Some(sample.start.unwrap_or_default()),
            None => sample.start,
        };
        sample.guidance = self.guidance.unwrap_or(sample.guidance);
        sample.photometric = self.photometric.unwrap_or(sample.photometric);
        sample.solver = self.solver.unwrap_or(sample.solver);
        sample.compute = self.compute.unwrap_or(sample.compute);
        sample.validate()?;
        require(sample.compute, device)?;
        Ok(Options {
            sample,
            seeds: (0..u64::from(samples)).map(|i| self.seed.wrapping_add(i)).collect(),
            without_network: false,
            refine: self.refine,
            up: self.up(),
            quiet: false,
        })
    }
}

#[derive(Serialize)]
struct Report {
    scene: PathBuf,
    notes: Vec<String>,
    sampling: SampleConfig,
    gaussians: usize,
    /// Scale, rotation (x y z w) and translation from the scene's frame to the model's.
    canonical_from_user: freerange_camera::Similarity,
    samples: Vec<SampleReport>,
    seconds: Vec<(&'static str, f64)>,
    peak_memory_bytes: Option<u64>,
}

#[derive(Serialize)]
struct SampleReport {
    seed: u64,
    file: String,
    input_views: Option<Scores>,
    further_views: Option<Scores>,
    /// The same without refinement, where there was one.
    #[serde(skip_serializing_if = "Option::is_none")]
    before_refinement: Option<Before>,
}

#[derive(Serialize)]
struct Before {
    input_views: Option<Scores>,
    further_views: Option<Scores>,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), CliError> {
    let begin = Instant::now();
    let device = args.sampling.device.open()?;
    let scene = Scene::load(&args.scene)?;
    let mut further = scene.further;
    if let Some(path) = &args.validate {
        let other = Scene::load(path)?;
        further.extend(other.inputs);
        further.extend(other.further);
    }
    let checkpoint = checkpoint(args.sampling.checkpoint.as_deref(), &device)?;
    let options = args.sampling.options(&checkpoint, args.samples, &device)?;
    let output = OutputFolder::create("reconstruct", &args.output)?;
    let mut seconds = vec![("load", begin.elapsed().as_secs_f64())];

    let result = pipeline::run(&scene.inputs, &checkpoint, &options, &device)?;
    seconds.extend(&result.seconds);

    let begin = Instant::now();
    let mut samples = Vec::new();
    for (i, sample) in result.samples.iter().enumerate() {
        let suffix = if i == 0 { String::new() } else { format!("-{i}") };
        let file = format!("gaussians{suffix}.ply");
        let user = to_user(&sample.refined, &result.frame.canonical_from_user);
        write_ply(&user, &output.path(&file)?)?;
        write_turntable(&output.path(&format!("turntable{suffix}.gif"))?, &sample.refined, 48, 256)?;
        for (view, picture) in comparisons(&user, &scene.inputs)? {
            output.picture(&format!("inputs{suffix}/{view}.png"), &picture)?;
        }
        let before_refinement = match options.refine {
            0 => None,
            _ => {
                let plain = to_user(&sample.plain, &result.frame.canonical_from_user);
                Some(Before { input_views: score(&plain, &scene.inputs)?, further_views: score(&plain, &further)? })
            }
        };
        samples.push(SampleReport {
            seed: sample.seed,
            file,
            input_views: score(&user, &scene.inputs)?,
            further_views: score(&user, &further)?,
            before_refinement,
        });
    }
    seconds.push(("write", begin.elapsed().as_secs_f64()));

    let mut notes = scene.notes;
    notes.extend(result.frame.notes.clone());
    let report = Report {
        scene: args.scene.clone(),
        notes,
        sampling: options.sample,
        gaussians: result.samples.first().map_or(0, |s| s.refined.len()),
        canonical_from_user: result.frame.canonical_from_user,
        samples,
        seconds,
        peak_memory_bytes: peak_memory(),
    };
    let json = serde_json::to_string_pretty(&report).map_err(CliError::input)?;
    output.write("report.json", json.as_bytes())?;
    output.commit()?;
    match args.json {
        true => println!("{json}"),
        false => print(&report, &args.output),
    }
    Ok(())
}

/// Each input image beside its render.
fn comparisons(cloud: &freerange_splat::Cloud, views: &[View]) -> Result<Vec<(String, image::RgbaImage)>, CliError> {
    views
        .iter()
        .map(|view| {
            let (w, h) = view.image.dimensions();
            let render = to_picture(&render_view(cloud, &view.camera)?, w, h);
            // A view's name may hold folders: keep its last part.
            let name = view.name.rsplit(['/', '\\']).next().unwrap_or("view").to_owned();
            Ok((name, sheet(&[vec![on_white(&view.image), render]])))
        })
        .collect()
}

fn print(report: &Report, output: &std::path::Path) {
    for note in &report.notes {
        println!("note: {note}");
    }
    for sample in &report.samples {
        println!("{} ({} Gaussians, seed {})", output.join(&sample.file).display(), report.gaussians, sample.seed);
        let line = |what: &str, scores: &Option<Scores>| {
            if let Some(s) = scores {
                println!("  {what}: PSNR {:.2} dB, SSIM {:.4} over {} views", s.psnr, s.ssim, s.views.len());
            }
        };
        if let Some(before) = &sample.before_refinement {
            line("input views before refinement", &before.input_views);
            line("further views before refinement", &before.further_views);
        }
        line("input views", &sample.input_views);
        line("further views", &sample.further_views);
    }
    let total: f64 = report.seconds.iter().map(|s| s.1).sum();
    let parts: Vec<String> = report.seconds.iter().map(|(name, s)| format!("{name} {s:.1}")).collect();
    println!(
        "{total:.1} s ({}), peak memory {}",
        parts.join(", "),
        match report.peak_memory_bytes {
            Some(bytes) => format!("{:.0} MiB", bytes as f64 / f64::from(1 << 20)),
            None => "unknown".into(),
        }
    );
}
