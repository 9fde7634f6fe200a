//! `freerange reconstruct`

mod batch;
mod holdout;

use std::{
    ops::ControlFlow,
    path::{Path, PathBuf},
    time::Instant,
};

use freerange::{
    Cloud, Compute, Device, DeviceName, EncoderPlaces, Listed, Options, Reconstructor, SETTINGS_SCHEMA, SampleConfig,
    Scores, Solver, Stage, View, checkpoint_sha256,
    pictures::{on_white, render_view, write_turntable},
    score,
};
use freerange_camera::{
    FrameConfig, canonical_from_user,
    image_ops::{sheet, to_picture},
};
use freerange_core::Note;
use freerange_eval::memory::peak_memory;
use freerange_formats::{Format, Frame, WriteOptions};
use freerange_scene::write_colmap;
use freerange_splat::{Splats, write_ply_at};
use freerange_surface::{MeshConfig, MeshFormat, mesh_of, save};
use serde::Serialize;

use crate::{
    error::CliError,
    output::OutputFolder,
    photos::{Photos, Scene, UpChoice},
    progress::Progress,
    ranks::Job,
    runtime::{commit, local, local_or_shipped},
};
use holdout::Holdout;

/// Reconstruct an object from posed images.
///
/// Writes gaussians.ply (in the frame of your cameras; --format for others), turntable.gif, inputs/ (each input view
/// beside its render) and report.json. Of several scenes each gets such a folder in the output, and scenes.json is their table; those that
/// are finished are passed over, and one that cannot be made does not end the others.
#[derive(clap::Args)]
pub struct Args {
    /// Folder of photos with cameras: transforms.json (or transforms_train.json and transforms_test.json), a COLMAP model, Polycam's
    /// keyframes, a Metashape .xml or a RealityCapture .csv; or such a file. Several: each gets a folder of its own in the output.
    #[arg(required_unless_present = "list")]
    scene: Vec<PathBuf>,
    /// A file that names a scene on each line, relative to itself; lines that begin with # are passed over.
    #[arg(long, value_name = "FILE")]
    list: Option<PathBuf>,
    /// Of many scenes make only share I of N (from 0), as in an array of jobs. Without it, processes of mpirun or srun share them themselves.
    #[arg(long, value_name = "I/N", value_parser = share)]
    share: Option<(usize, usize)>,
    /// Of many scenes make those again that are finished.
    #[arg(long)]
    restart: bool,
    /// Where the results go.
    #[arg(short, long, default_value = "out")]
    output: PathBuf,
    /// Another scene of the same object whose views are only compared with.
    #[arg(long, value_name = "SCENE")]
    validate: Option<PathBuf>,
    /// Photos to compare with instead of using them: so many, at even steps through the photos, or their names (NAME,NAME).
    #[arg(long, value_name = "N|NAMES")]
    holdout: Option<Holdout>,
    /// Views that the model is shown, from all around the object, if there are more [default: as many as it has seen at
    /// once in training, six for the shipped one]. Refinement looks at all.
    #[arg(long, value_name = "K", value_parser = clap::value_parser!(u16).range(1..=256))]
    views: Option<u16>,
    /// Start from these Gaussians instead of initial fits: a file of any format, in the frame of the cameras.
    #[arg(long, value_name = "FILE", conflicts_with = "list")]
    init: Option<PathBuf>,
    #[command(flatten)]
    photos: Photos,
    #[command(flatten)]
    sampling: Sampling,
    /// Samples to draw; they differ where the images leave the object open.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64))]
    samples: u32,
    /// Also write the Gaussians in these formats: splat, spz, sog, glb, html (a page that shows them), or colmap (a folder with the photos,
    /// their cameras, and the Gaussians' middles as points); and mesh.glb, mesh.ply, mesh.obj: triangles with vertex colors.
    #[arg(long, value_name = "FORMATS", value_delimiter = ',', value_parser = parse_written)]
    format: Vec<Written>,
    /// Print the report as JSON on standard output.
    #[arg(long)]
    json: bool,
}

/// What results are written as.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Written {
    /// A file of Gaussians.
    Gaussians(Format),
    /// COLMAP's sparse model.
    Colmap,
    /// A triangle mesh.
    Mesh(MeshFormat),
}

fn parse_written(text: &str) -> Result<Written, String> {
    match text {
        "colmap" => Ok(Written::Colmap),
        "mesh.glb" => Ok(Written::Mesh(MeshFormat::Glb)),
        "mesh.ply" => Ok(Written::Mesh(MeshFormat::Ply)),
        "mesh.obj" => Ok(Written::Mesh(MeshFormat::Obj)),
        other => other
            .parse()
            .map(Written::Gaussians)
            .map_err(|expected: String| format!("{expected}, colmap, mesh.glb, mesh.ply, mesh.obj")),
    }
}

impl std::fmt::Display for Written {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Gaussians(format) => format.fmt(f),
            Self::Colmap => f.write_str("colmap"),
            Self::Mesh(format) => write!(f, "mesh.{format}"),
        }
    }
}

/// Options of every command that samples.
#[derive(Clone, clap::Args)]
pub struct Sampling {
    /// Model to use instead of the shipped one: a file, or hf:owner/name[@revision] for one on the Hugging Face hub.
    /// What a revision meant when it was first used is kept in the cache.
    #[arg(long, value_name = "FILE")]
    pub checkpoint: Option<PathBuf>,
    /// Folder of the weights (config.json, model.safetensors) of the checkpoint's frozen encoder, if it has one [default:
    /// where it was when the model was trained, or where `freerange weights fetch` puts it].
    #[arg(long, value_name = "FOLDER", requires = "checkpoint")]
    pub encoder_weights: Option<PathBuf>,
    /// Continue from the sample with so many steps of 3DGS-MCMC on the input views, with more Gaussians and held in place
    /// where no view looks; 500 are enough, 1000 somewhat sharper, 0 is none. Of more than four views a quarter of it for
    /// each, up to sixteen [default: the checkpoint's].
    #[arg(long, value_name = "STEPS")]
    pub refine: Option<usize>,
    /// How fine the detail is that refinement looks for, 1 to 16: so many times 256 pixels, at which photos are compared, and
    /// 8,192 Gaussians, as far as the photos have these pixels. More lowers LPIPS, and hardly changes PSNR, in more time; 1 is
    /// quickest [default: the checkpoint's].
    #[arg(long, value_name = "TIMES")]
    pub detail: Option<usize>,
    /// Begin that refinement with so many samples together, and hold it at their mean pictures; 1 is the sample alone [default: the checkpoint's].
    #[arg(long, value_name = "SAMPLES", value_parser = clap::value_parser!(u8).range(1..=64))]
    pub ensemble: Option<u8>,
    /// Fit a sample from pure noise to the input views in so many steps before it is mended; 0 is none [default: the checkpoint's].
    #[arg(long, value_name = "STEPS")]
    pub polish: Option<usize>,
    /// Mend a sample from pure noise in so many passes, as fits are mended; 0 is none [default: the checkpoint's].
    #[arg(long, value_name = "PASSES")]
    pub mend: Option<usize>,
    /// Put the Gaussians that a fit is mended to in the order of a tree of their own after every so many steps; 0 is never
    /// [default: the checkpoint's].
    #[arg(long, value_name = "STEPS")]
    pub regroup: Option<usize>,
    /// Take photos mirrored about the object's plane of symmetry as further input views where, by a fit of both, the photos doubt
    /// it by at most so much; 0 is never [default: the checkpoint's].
    #[arg(long, value_name = "MOST")]
    pub mirror: Option<f32>,
    /// Fit to outlines turned about the object's axis as well where, by a fit of both, the photos contradict them by at most so much;
    /// 0 is never [default: the checkpoint's].
    #[arg(long, value_name = "MOST")]
    pub turn: Option<f32>,
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
    /// Classifier-free guidance scale s; 1 is none, and goes alone with a start from a fit [default: the checkpoint's].
    #[arg(long = "cfg-scale", alias = "guidance")]
    pub guidance: Option<f32>,
    /// Photometric guidance scale lambda; 0 is none [default: the checkpoint's].
    #[arg(long = "lambda-pg", alias = "photometric")]
    pub photometric: Option<f32>,
    /// How the steps are taken: euler, heun (two evaluations per step), multistep, or hold (only estimates are fed back)
    /// [default: the checkpoint's].
    #[arg(long, value_parser = parse_solver)]
    pub solver: Option<Solver>,
    /// Arithmetic of the transformer: f32, bf16 or f16 where the device has it, or auto, the faster of the first two [default:
    /// the checkpoint's].
    #[arg(long, value_parser = parse_compute)]
    pub compute: Option<Compute>,
    /// Which way is up in the scene's frame: z, y, cameras (where the tops of the photos point), a direction X,Y,Z, or auto:
    /// z where the cameras' format has it so, else from what the object stands on, or the cameras.
    #[arg(long, default_value = "auto", allow_hyphen_values = true)]
    pub up: UpChoice,
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

/// A solver by its name.
fn parse_solver(text: &str) -> Result<Solver, String> {
    serde_json::from_value(text.into()).map_err(|_| "expected euler, heun, multistep or hold".into())
}

fn share(text: &str) -> Result<(usize, usize), String> {
    let parts = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
    match parts {
        Some((i, n)) if i < n => Ok((i, n)),
        _ => Err("expected I/N with I from 0 to N - 1, as in 0/4".into()),
    }
}

/// `f32`, `bf16`, `f16` or `auto`.
pub fn parse_compute(text: &str) -> Result<Compute, String> {
    serde_json::from_value(text.into()).map_err(|_| "expected f32, bf16, f16 or auto".into())
}

impl Sampling {
    /// The model that the user names, or the shipped one.
    pub fn open(&self, device: &Device) -> Result<Reconstructor, CliError> {
        Ok(match &self.checkpoint {
            Some(path) => Reconstructor::load(&local(path)?, &EncoderPlaces::at(self.encoder_weights.clone()), device)?,
            None => Reconstructor::shipped(device)?,
        })
    }

    /// SHA-256 of that model's checkpoint.
    pub fn checkpoint_sha256(&self) -> Result<String, CliError> {
        Ok(checkpoint_sha256(local_or_shipped(self.checkpoint.as_deref())?.as_deref())?)
    }

    /// The model's own way to sample, with what the user overrides.
    pub fn options(&self, model: &Reconstructor, samples: u32) -> Result<Options, CliError> {
        let mut options = model.options()?;
        if self.start == Some(StartName::Noise) {
            options.sample = options.sample.without_start();
        }
        let sample = &mut options.sample;
        sample.steps = self.steps.unwrap_or(sample.steps);
        sample.depth = self.depth.or(sample.depth);
        sample.start = match self.start {
            Some(StartName::Noise) => None,
            Some(StartName::Fit) => Some(sample.start.take().unwrap_or_default()),
            None => sample.start.take(),
        };
        sample.cfg_scale = self.guidance.unwrap_or(sample.cfg_scale);
        sample.lambda_pg = self.photometric.unwrap_or(sample.lambda_pg);
        sample.solver = self.solver.unwrap_or(sample.solver);
        sample.compute = self.compute.unwrap_or(sample.compute);
        sample.refine = self.refine.unwrap_or(sample.refine);
        sample.detail = self.detail.unwrap_or(sample.detail);
        sample.polish = self.polish.unwrap_or(sample.polish);
        sample.mend = self.mend.unwrap_or(sample.mend);
        sample.regroup = self.regroup.unwrap_or(sample.regroup);
        sample.mirror = self.mirror.unwrap_or(sample.mirror);
        sample.turn = self.turn.unwrap_or(sample.turn);
        sample.ensemble = self.ensemble.map_or(sample.ensemble, usize::from);
        options.seeds = (0..u64::from(samples)).map(|i| self.seed.wrapping_add(i)).collect();
        options.frame.up = self.up.or_z();
        model.check(&options)?;
        Ok(options)
    }
}

/// Shows on the screen how far a reconstruction has come.
#[derive(Default)]
struct Watch {
    bar: Option<((Stage, usize), Progress)>,
}

impl Watch {
    fn at(&mut self, told: &freerange::Progress<'_>) {
        let label = match told.stage {
            Stage::Mirror => "looking for symmetry",
            Stage::Fit => "fitting",
            Stage::Sample => "sampling",
            Stage::Refine => "refining",
            _ => return,
        };
        let task = (told.stage, told.sample);
        if self.bar.as_ref().is_none_or(|(at, _)| *at != task) {
            self.finish();
            self.bar = Some((task, Progress::new(label, told.total as u64)));
        }
        if let Some((_, bar)) = &mut self.bar {
            bar.at(told.done as u64, &told.loss.map_or(String::new(), |loss| format!("loss {loss:.4}")));
        }
    }

    fn finish(&mut self) {
        if let Some((_, bar)) = self.bar.take() {
            bar.finish();
        }
    }
}

/// What a result was made by.
#[derive(Clone, Serialize)]
struct Program {
    /// Version and commit of the program.
    version: &'static str,
    commit: String,
    /// Where it was computed.
    device: String,
    checkpoint_sha256: String,
}

impl Program {
    fn of(model: &Reconstructor, checkpoint_sha256: String) -> Self {
        let device = Listed::of(model.device()).to_string();
        Self { version: env!("CARGO_PKG_VERSION"), commit: commit(), device, checkpoint_sha256 }
    }
}

#[derive(Serialize)]
struct SceneReport {
    scene: PathBuf,
    /// What made it.
    #[serde(flatten)]
    program: Program,
    /// What was understood, assumed, changed or left out, and what may make the result wrong.
    notes: Vec<Note>,
    settings_schema: u32,
    /// What was subtracted from all positions of the scene: results are relative to it.
    #[serde(skip_serializing_if = "Option::is_none")]
    origin: Option<[f64; 3]>,
    sampling: SampleConfig,
    /// Names of the views that the model was shown.
    views_shown: Vec<String>,
    /// Names of the photos that were held out: the last of the further views.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    held_out: Vec<String>,
    gaussians: usize,
    /// Scale, rotation (x y z w) and translation from the scene's own frame, before `origin` is subtracted, to the model's.
    canonical_from_user: freerange::Similarity,
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
    let job = Job::start_if(batch::asked(args) && args.share.is_none())?;
    let result = run_in(args, &job);
    job.end(result)
}

fn run_in(args: &Args, job: &Job) -> Result<(), CliError> {
    if batch::asked(args) {
        return batch::run(args, job);
    }
    if args.restart {
        return Err(CliError::input("--restart: expected several scenes, found one: it is always made anew"));
    }
    let begin = Instant::now();
    let path = &args.scene[0];
    let device = job.open(args.sampling.device)?;
    let model = args.sampling.open(&device)?;
    // What cannot be done is refused before photos are read and cut out.
    args.sampling.options(&model, args.samples)?;
    let program = Program::of(&model, args.sampling.checkpoint_sha256()?);
    let scene = args.photos.load(args.photos.cameras(path)?, args.sampling.up)?;
    let (report, json) = reconstruct(args, path, scene, &model, &program, &args.output, begin, || Ok(()))?;
    match args.json {
        true => {
            tell(&report.notes);
            println!("{json}");
        }
        false => print(&report, &args.output),
    }
    Ok(())
}

/// The Gaussians of a file, in the frame of the views.
fn init(file: &Path, views: &[View], config: &FrameConfig) -> Result<Cloud, CliError> {
    // The canonical frame has +z up.
    let up = canonical_from_user(views, config)?.canonical_from_user.rotation.inverse() * glam::DVec3::Z;
    let loaded = freerange_formats::read(file, Frame::with_up(up).unwrap_or_default())?;
    loaded.notes.iter().for_each(|note| eprintln!("note: {}: {note}", file.display()));
    let degree = loaded.splats.harmonics.degree();
    if degree > 0 {
        eprintln!(
            "note: {}: colors that depend on the viewing direction (degree {degree}) are left out",
            file.display()
        );
    }
    Ok(loaded.splats.into_cloud())
}

/// Makes one scene and writes its results; the report, also as JSON. `begin`: when it was begun to be read; `commit`: is called before
/// anything in the folder changes.
fn reconstruct(
    args: &Args,
    path: &Path,
    scene: Scene,
    model: &Reconstructor,
    program: &Program,
    folder: &Path,
    begin: Instant,
    commit: impl FnOnce() -> Result<(), CliError>,
) -> Result<(SceneReport, String), CliError> {
    let warnings = scene.warnings(model)?;
    let origin = Some(scene.cameras.origin).filter(|o| *o != glam::DVec3::ZERO).map(|o| o.to_array());
    let mut inputs = scene.loaded.views;
    let mut further = scene.loaded.further;
    if let Some(path) = &args.validate {
        further.extend(Photos::further(path, scene.cameras.origin)?);
    }
    let held = args.holdout.as_ref().map(|h| h.take(&mut inputs)).transpose()?.unwrap_or_default();
    let held_out = held.iter().map(|v| v.name.clone()).collect();
    further.extend(held);
    let mut options = args.sampling.options(model, args.samples)?;
    options.views = args.views.map(usize::from);
    options.frame = scene.frame;
    options.init = args.init.as_deref().map(|file| init(file, &inputs, &options.frame)).transpose()?;
    let output = OutputFolder::create("reconstruct", folder)?;
    let mut seconds = vec![("load", begin.elapsed().as_secs_f64())];

    let mut watch = Watch::default();
    let result = model.run(&inputs, &options, &mut |told| {
        watch.at(told);
        ControlFlow::Continue(())
    })?;
    watch.finish();
    seconds.extend(result.seconds.iter().map(|(stage, seconds)| (stage.name(), *seconds)));

    let begin = Instant::now();
    // The canonical frame has +z up.
    let up = result.canonical_from_user.rotation.inverse() * glam::DVec3::Z;
    let frame = Frame::with_up(up).unwrap_or_default();
    let mut notes = scene.notes;
    notes.extend(warnings);
    let mut samples = Vec::new();
    for (i, sample) in result.samples.iter().enumerate() {
        let suffix = if i == 0 { String::new() } else { format!("-{i}") };
        let file = format!("gaussians{suffix}.ply");
        write_ply_at(&sample.gaussians, origin, &output.path(&file)?)?;
        let splats = Splats { origin: origin.unwrap_or_default().into(), ..sample.gaussians.clone().into() };
        let mut mesh = None; // one for all of its formats
        for format in &args.format {
            let format = match format {
                Written::Mesh(format) => {
                    let name = format!("mesh{suffix}.{format}");
                    match mesh.get_or_insert_with(|| mesh_of(&splats, &MeshConfig::default())) {
                        Ok(mesh) => save(mesh, &output.path(&name)?, frame.to(Frame::Y_UP))?,
                        // The Gaussians are there all the same.
                        Err(e) => notes.push(Note::dropped(format!("{name}: {e}"))),
                    }
                    continue;
                }
                Written::Gaussians(Format::Ply) => continue,
                Written::Gaussians(format) => format,
                Written::Colmap => {
                    let folder = output.path(&format!("colmap{suffix}/sparse"))?;
                    write_colmap(
                        folder.parent().unwrap_or(&folder),
                        &inputs,
                        origin.unwrap_or_default().into(),
                        &points(&sample.gaussians),
                    )?;
                    continue;
                }
            };
            let name = if *format == Format::Html { "view" } else { "gaussians" };
            let options = WriteOptions { frame, ..WriteOptions::default() };
            let path = output.path(&format!("{name}{suffix}.{format}"))?;
            let lost = freerange_formats::write(&splats, &path, &options)?;
            notes.extend(lost.into_iter().map(|note| Note::dropped(format!("{name}{suffix}.{format}: {note}"))));
        }
        write_turntable(&output.path(&format!("turntable{suffix}.gif"))?, &sample.canonical, 48, 256)?;
        for (view, picture) in comparisons(&sample.gaussians, &inputs)? {
            output.picture(&format!("inputs{suffix}/{view}.png"), &picture)?;
        }
        let before_refinement = match &sample.unrefined {
            None => None,
            Some(plain) => Some(Before { input_views: score(plain, &inputs)?, further_views: score(plain, &further)? }),
        };
        samples.push(SampleReport {
            seed: sample.seed,
            file,
            input_views: score(&sample.gaussians, &inputs)?,
            further_views: score(&sample.gaussians, &further)?,
            before_refinement,
        });
    }
    seconds.push(("write", begin.elapsed().as_secs_f64()));

    notes.extend(result.notes.into_iter().map(Note::understood));
    let report = SceneReport {
        scene: path.into(),
        program: program.clone(),
        notes,
        settings_schema: SETTINGS_SCHEMA,
        origin,
        sampling: options.sample,
        views_shown: result.shown.iter().map(|&i| inputs[i].name.clone()).collect(),
        held_out,
        gaussians: result.samples.first().map_or(0, |s| s.gaussians.len()),
        canonical_from_user: in_scene(&result.canonical_from_user, origin),
        samples,
        seconds,
        peak_memory_bytes: peak_memory(),
    };
    let json = serde_json::to_string_pretty(&report).map_err(CliError::input)?;
    output.write("report.json", json.as_bytes())?;
    commit()?;
    output.commit()?;
    Ok((report, json))
}

/// Opacity below which a Gaussian is no point of the surface.
const FAINT: f64 = 0.1;

/// Gaussians as points: middles and colors.
fn points(cloud: &freerange::Cloud) -> Vec<(glam::DVec3, [u8; 3])> {
    let byte = |v: f64| (255.0 * v.clamp(0.0, 1.0)).round() as u8;
    let solid = (0..cloud.len()).filter(|i| cloud.opacity(*i) >= FAINT);
    solid.map(|i| (cloud.mean(i), cloud.color(i).to_array().map(byte))).collect()
}

/// A transform from positions relative to `origin`, for positions as the scene has them.
fn in_scene(from_local: &freerange::Similarity, origin: Option<[f64; 3]>) -> freerange::Similarity {
    let shift = freerange::Similarity {
        translation: -glam::DVec3::from_array(origin.unwrap_or_default()),
        ..freerange::Similarity::IDENTITY
    };
    from_local.after(&shift)
}

/// Each input image beside its render.
fn comparisons(cloud: &freerange::Cloud, views: &[View]) -> Result<Vec<(String, image::RgbaImage)>, CliError> {
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

/// Notes and warnings, on standard error.
fn tell(notes: &[Note]) {
    notes.iter().for_each(|note| eprintln!("{note}"));
}

fn print(report: &SceneReport, output: &Path) {
    tell(&report.notes);
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
