//! `freerange reconstruct`

mod batch;
mod holdout;
mod replaced;
mod written;

use std::{
    ops::ControlFlow,
    path::{Path, PathBuf},
    time::Instant,
};

use freerange::{
    Gaussians, PipelineConfig, Reconstructor, SETTINGS_SCHEMA, Scene, Scores, Stage, View,
    pictures::{on_white, render_view, write_turntable},
    read_gaussians, score,
};
use freerange_eval::memory::peak_memory;
use freerange_gaussians::{
    Splats,
    formats::{Frame, WriteOptions},
};
use freerange_scene::camera::{
    FrameConfig, canonical_from_user,
    image_ops::{sheet, to_picture},
};
use freerange_scene::{KeepWhole, views_to_compare};
use freerange_util::{Note, NoteKind};
use serde::Serialize;

use crate::{
    error::CliError, output::OutputFolder, photos::Photos, pipeline::PipelineArgs, progress::Progress, ranks::Job,
    runtime::commit,
};
use holdout::Holdout;
use written::{Place, Written, parse_written};

/// Reconstruct an object from posed photos.
///
/// Writes gaussians.ply in the frame of the cameras, turntable.gif, inputs/ (each photo beside its render) and report.json.
/// One scene is always computed. An older result in the output folder is named, and replaced when the new one is done.
///
/// Several scenes get a folder each, and scenes.json lists them. Finished scenes are skipped there, and other options are
/// refused unless --overwrite is given. A failing scene does not stop the others.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// Folder with photos and cameras (transforms.json, COLMAP, Polycam, Metashape, RealityCapture, OPF), or the camera file.
    #[arg(required_unless_present = "list")]
    scene: Vec<PathBuf>,
    /// Output folder.
    #[arg(short, long, default_value = "out", help_heading = "Results")]
    output: PathBuf,
    /// Also write splat, spz, sog, glb, usda, usdz, html (a page), mesh.glb, mesh.ply, mesh.obj or colmap.
    ///
    /// Separate several by commas. Meshes have vertex colors. colmap is a folder of photos, cameras, and the Gaussians' centers as points.
    #[arg(long, value_name = "FORMATS", value_delimiter = ',', value_parser = parse_written, help_heading = "Results")]
    format: Vec<Written>,
    /// Number of results with different seeds. From initial fits they differ little; those of `--init flow` are samples.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64), hide_short_help = true, help_heading = "Results")]
    samples: u32,
    /// Print the report as JSON on standard output.
    #[arg(long, hide_short_help = true, help_heading = "Results")]
    json: bool,
    /// Hold out every Nth photo and score the result on it.
    #[arg(long, value_name = "N", conflicts_with = "holdout", value_parser = clap::value_parser!(u32).range(2..), help_heading = "Comparison")]
    holdout_every: Option<u32>,
    /// Hold out the photos of these names (NAME,NAME) and score the result on them.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', hide_short_help = true, help_heading = "Comparison")]
    holdout: Vec<String>,
    /// Also score the result on the views of another scene of the object.
    #[arg(long, value_name = "SCENE", help_heading = "Comparison")]
    eval_scene: Option<PathBuf>,
    #[command(flatten)]
    pipeline: PipelineArgs,
    #[command(flatten)]
    photos: Photos,
    /// File with a scene on each line, relative to the file; lines that begin with # are skipped.
    #[arg(long, value_name = "FILE", help_heading = "Many scenes")]
    list: Option<PathBuf>,
    /// Reconstruct only part I of N of the scenes, I from 0 to N - 1.
    ///
    /// For arrays of jobs. Processes of mpirun or srun divide the scenes by themselves.
    #[arg(long, value_name = "I/N", value_parser = shard, hide_short_help = true, help_heading = "Many scenes")]
    shard: Option<(usize, usize)>,
    /// Reconstruct finished scenes of several again; one scene is always reconstructed.
    #[arg(long, hide_short_help = true, help_heading = "Many scenes")]
    overwrite: bool,
}

const EXAMPLES: &str = "Examples:
  freerange reconstruct examples/bowl                       the example, into out/
  freerange reconstruct photos --masks estimate             photos on a table, with COLMAP's cameras
  freerange reconstruct photos --holdout-every 8 --quality high
  freerange reconstruct a b c -o results                    three scenes and a table of them";

/// The files of a result: its first sample, and what it says of itself.
const GAUSSIANS: &str = "gaussians.ply";
const REPORT: &str = "report.json";

fn shard(text: &str) -> Result<(usize, usize), String> {
    let parts = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
    match parts {
        Some((i, n)) if i < n => Ok((i, n)),
        _ => Err("expected I/N with I from 0 to N - 1, as in 0/4".into()),
    }
}

/// Shows on the screen how far a reconstruction has come.
#[derive(Default)]
struct Watch {
    bar: Option<((Stage, usize), Progress)>,
}

impl Watch {
    fn at(&mut self, p: &freerange::Progress<'_>) {
        let label = match p.stage {
            Stage::Canonicalize if p.total > 1 => "initial fits",
            Stage::Symmetry => "looking for symmetry",
            Stage::Propose => "proposing",
            Stage::Refine => "refining",
            Stage::Optimize => "optimizing",
            _ => return,
        };
        let task = (p.stage, p.sample);
        if self.bar.as_ref().is_none_or(|(at, _)| *at != task) {
            self.finish();
            self.bar = Some((task, Progress::new(label, p.total as u64)));
        }
        if let Some((_, bar)) = &mut self.bar {
            bar.at(p.done as u64, &p.loss.map_or(String::new(), |loss| format!("loss {loss:.4}")));
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
        let device = model.device().to_string();
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
    pipeline: PipelineConfig,
    /// Names of the photos that the network saw.
    network_views: Vec<String>,
    /// Names of the photos that were held out: the last of the further views.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    held_out: Vec<String>,
    gaussians: usize,
    /// Scale, rotation (x y z w) and translation from the scene's own frame, before `origin` is subtracted, to the model's.
    canonical_from_user: freerange::Similarity,
    samples: Vec<SampleReport>,
    seconds: Vec<(&'static str, f64)>,
    /// Of the process so far: in a batch with the scenes before, whose memory is kept for the next.
    peak_memory_bytes: Option<u64>,
}

#[derive(Serialize)]
struct SampleReport {
    seed: u64,
    file: String,
    input_views: Option<Scores>,
    further_views: Option<Scores>,
    /// The same before the optimization, where there was one.
    #[serde(skip_serializing_if = "Option::is_none")]
    before_optimization: Option<Before>,
}

#[derive(Serialize)]
struct Before {
    input_views: Option<Scores>,
    further_views: Option<Scores>,
}

impl Args {
    /// The photos that are compared with.
    fn held_out(&self) -> Result<Holdout, CliError> {
        match (self.holdout_every, self.holdout.as_slice()) {
            (Some(n), _) => Ok(Holdout::Every(n as usize)),
            (None, names) => Holdout::of(names),
        }
    }
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), CliError> {
    let job = Job::start_if(batch::asked(args) && args.shard.is_none())?;
    let result = run_in(args, &job);
    job.end(result)
}

fn run_in(args: &Args, job: &Job) -> Result<(), CliError> {
    if batch::asked(args) {
        return batch::run(args, job);
    }
    if args.overwrite {
        return Err(CliError::input(
            "--overwrite: expected several scenes, found one, which is always reconstructed again",
        ));
    }
    let begin = Instant::now();
    let path = &args.scene[0];
    let device = job.open(args.pipeline.device)?;
    let model = args.pipeline.open(&device)?;
    // What cannot be done is refused before photos are read and cut out.
    args.pipeline.options(&model, args.samples)?;
    let program = Program::of(&model, args.pipeline.checkpoint_sha256()?);
    let scene = args.photos.load(args.photos.cameras(path)?, KeepWhole::Small)?;
    let (report, json) =
        reconstruct(args, path, scene, &model, &program, &args.output, begin, || batch::replace(&args.output))?;
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
fn init(file: &Path, views: &[View], config: &FrameConfig) -> Result<Gaussians, CliError> {
    // The canonical frame has +z up.
    let up = canonical_from_user(views, config)?.canonical_from_user.rotation.inverse() * glam::DVec3::Z;
    let (cloud, notes) = read_gaussians(file, up)?;
    notes.iter().for_each(|note| eprintln!("note: {}: {}", file.display(), note.text));
    Ok(cloud)
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
    let warnings = scene.warnings(model.network_views()?)?;
    let origin = Some(scene.cameras.origin).filter(|o| *o != glam::DVec3::ZERO).map(|o| o.to_array());
    let (mut loaded, mut notes) = (scene.loaded, scene.notes);
    notes.extend(warnings);
    // Only the cut-out photos are used from here on.
    drop(std::mem::take(&mut loaded.whole));
    let (mut inputs, mut further) = (loaded.views, loaded.further);
    if let Some(path) = &args.eval_scene {
        let (views, said) = views_to_compare(path, scene.cameras.origin)?;
        further.extend(views);
        // What is missing there is told; how it was read is not of this scene.
        let missing = |note: &Note| matches!(note.kind, NoteKind::Dropped | NoteKind::Warning);
        notes.extend(said.into_iter().filter(missing));
    }
    let held = args.held_out()?.take(&mut inputs)?;
    let held_out = held.iter().map(|v| v.name.clone()).collect();
    further.extend(held);
    let mut options = args.pipeline.options(model, args.samples)?;
    options.frame = scene.frame;
    let file = args.pipeline.init_file();
    options.init = file.map(|file| init(file, &inputs, &options.frame)).transpose()?;
    let output = OutputFolder::create("reconstruct", folder)?;
    replaced::note(folder, model).iter().for_each(|note| eprintln!("note: {note}"));
    let mut seconds = vec![("load", begin.elapsed().as_secs_f64())];

    let mut watch = Watch::default();
    let result = model.run(&inputs, &options, &mut |told| {
        watch.at(told);
        ControlFlow::Continue(())
    })?;
    watch.finish();
    seconds.extend(result.seconds.iter().map(|(stage, seconds)| (stage.name(), *seconds)));

    let begin = Instant::now();
    let frame = Frame::with_up(result.up()).unwrap_or_default();
    let mut samples = Vec::new();
    for (i, sample) in result.samples.iter().enumerate() {
        samples.push(write_sample(&output, sample, i, frame, origin, &args.format, &inputs, &further, &mut notes)?);
    }
    seconds.push(("write", begin.elapsed().as_secs_f64()));

    notes.extend(result.notes);
    let report = SceneReport {
        scene: path.into(),
        program: program.clone(),
        notes,
        settings_schema: SETTINGS_SCHEMA,
        origin,
        pipeline: options.pipeline,
        network_views: result.network_views.iter().map(|&i| inputs[i].name.clone()).collect(),
        held_out,
        gaussians: result.samples.first().map_or(0, |s| s.gaussians.len()),
        canonical_from_user: in_scene(&result.canonical_from_user, origin),
        samples,
        seconds,
        peak_memory_bytes: peak_memory(),
    };
    let json = serde_json::to_string_pretty(&report).map_err(CliError::input)?;
    output.write(REPORT, json.as_bytes())?;
    commit()?;
    output.commit()?;
    Ok((report, json))
}

/// Writes the files of sample number `i`; what the report says of it.
fn write_sample(
    output: &OutputFolder,
    sample: &freerange::Sample,
    i: usize,
    frame: Frame,
    origin: Option<[f64; 3]>,
    formats: &[Written],
    inputs: &[View],
    further: &[View],
    notes: &mut Vec<Note>,
) -> Result<SampleReport, CliError> {
    let suffix = if i == 0 { String::new() } else { format!("-{i}") };
    let file = if i == 0 { GAUSSIANS.to_owned() } else { format!("gaussians{suffix}.ply") };
    let splats = Splats { origin: origin.unwrap_or_default().into(), ..sample.gaussians.clone().into() };
    let options = WriteOptions { frame, ..WriteOptions::default() };
    freerange_gaussians::formats::write(&splats, &output.path(&file)?, &options)?;
    let place = Place { output, suffix: &suffix, frame, origin: origin.unwrap_or_default() };
    notes.extend(place.write(&splats, formats, inputs)?);
    write_turntable(&output.path(&format!("turntable{suffix}.gif"))?, &sample.canonical, 48, 256)?;
    for view in inputs {
        // A view's name may hold folders: keep its last part.
        let name = view.name.rsplit(['/', '\\']).next().unwrap_or("view");
        output.picture(&format!("inputs{suffix}/{name}.png"), &comparison(&sample.gaussians, view)?)?;
    }
    let before_optimization = match &sample.before_optimization {
        None => None,
        Some(plain) => Some(Before { input_views: score(plain, inputs)?, further_views: score(plain, further)? }),
    };
    Ok(SampleReport {
        seed: sample.seed,
        file,
        input_views: score(&sample.gaussians, inputs)?,
        further_views: score(&sample.gaussians, further)?,
        before_optimization,
    })
}

/// A transform from positions relative to `origin`, for positions as the scene has them.
fn in_scene(from_local: &freerange::Similarity, origin: Option<[f64; 3]>) -> freerange::Similarity {
    let shift = freerange::Similarity {
        translation: -glam::DVec3::from_array(origin.unwrap_or_default()),
        ..freerange::Similarity::IDENTITY
    };
    from_local.after(&shift)
}

/// An input image beside its render.
fn comparison(cloud: &freerange::Gaussians, view: &View) -> Result<image::RgbaImage, CliError> {
    let (w, h) = view.image.dimensions();
    let render = to_picture(&render_view(cloud, &view.camera)?, w, h);
    Ok(sheet(&[vec![on_white(&view.image), render]]))
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
        if let Some(before) = &sample.before_optimization {
            line("input views before optimization", &before.input_views);
            line("further views before optimization", &before.further_views);
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
