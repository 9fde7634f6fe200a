//! `freerange serve`

use std::{net::IpAddr, ops::ControlFlow, path::PathBuf, process::Command, sync::Arc, time::Duration};

use freerange::{
    Camera, Detect, Gaussians, Init, Quality, Reconstructor, View, choose_views, internal::leave_one_out,
    pictures::render_view,
};
use freerange_scene::camera::image_ops::to_picture;
use freerange_scene::estimate::LeaveOneOut;
use freerange_serve::{
    Engine, EngineError, Example, JobOptions, Limits, Outcome, Scene, ServeConfig, ServeError, Server, Step,
};
use freerange_util::IoError;
use image::RgbaImage;

use crate::{error::CliError, pipeline::PipelineArgs, ranks::Job, signals::Signals};

/// Serve a web page: drop photos with cameras, correct masks, watch the Gaussians appear.
///
/// Listens on this machine only and loads nothing from elsewhere. Options of the pipeline are the defaults of its jobs. Ctrl-C ends it.
#[derive(clap::Args)]
pub struct Args {
    /// Open the page in the browser.
    #[arg(long)]
    open: bool,
    /// Port to listen at; 0 takes a free one.
    #[arg(long, default_value_t = 7878)]
    port: u16,
    /// Address to listen at; beyond this machine (0.0.0.0) it needs --token.
    #[arg(long, default_value = "127.0.0.1", value_name = "ADDRESS")]
    host: IpAddr,
    /// Access token: at least 16 letters, digits or - . _ ~.
    ///
    /// Browsers open http://ADDRESS/?token=TOKEN. Programs send the header `Authorization: Bearer TOKEN`.
    #[arg(long)]
    token: Option<String>,
    /// Allowed Host header beside addresses, such as the name behind a proxy; may be repeated.
    #[arg(long, value_name = "HOST")]
    name: Vec<String>,
    /// Folder that keeps jobs beyond the server's end [default: a temporary folder].
    #[arg(long, value_name = "FOLDER")]
    keep: Option<PathBuf>,
    /// Most seconds that a job may compute.
    #[arg(long, value_name = "SECONDS", default_value_t = 900, value_parser = clap::value_parser!(u64).range(1..=604_800))]
    max_time: u64,
    /// Most megabytes of files per job.
    #[arg(long, value_name = "MB", default_value_t = 512, value_parser = clap::value_parser!(u64).range(1..=65_536))]
    max_upload: u64,
    /// Most megapixels per photo.
    #[arg(long, value_name = "MP", default_value_t = 50, value_parser = clap::value_parser!(u64).range(1..=268))]
    max_pixels: u64,
    /// Most open jobs: in preparation, waiting or computing.
    #[arg(long, value_name = "JOBS", default_value_t = 32, value_parser = clap::value_parser!(u16).range(1..=10_000))]
    max_jobs: u16,
    #[command(flatten)]
    pipeline: PipelineArgs,
}

macro_rules! bowl {
    ($($name:literal),*) => { &[$(($name, include_bytes!(concat!("../../../../examples/bowl/", $name)))),*] };
}

/// Part of the program, for those who have no photos at hand.
const EXAMPLE: Example = Example {
    name: "bowl",
    files: bowl!["transforms_train.json", "train/000.png", "train/001.png", "train/002.png", "train/003.png"],
};

/// Runs the command.
pub fn run(args: &Args) -> Result<(), CliError> {
    let config = ServeConfig {
        host: args.host,
        port: args.port,
        token: args.token.clone(),
        names: args.name.clone(),
        keep: args.keep.clone(),
        example: Some(EXAMPLE),
        limits: Limits {
            job_time: Duration::from_secs(args.max_time),
            bytes: args.max_upload << 20,
            file_bytes: Limits::default().file_bytes.min(args.max_upload << 20),
            pixels: args.max_pixels * 1_000_000,
            open_jobs: args.max_jobs.into(),
            ..Limits::default()
        },
    };
    config.check()?;
    let signals = Signals::take();
    #[cfg(unix)]
    // SAFETY: ignoring runs no code of ours. A connection that a client has closed must not end the program.
    unsafe {
        libc::signal(libc::SIGPIPE, libc::SIG_IGN);
    }
    let device = Job::alone().open(args.pipeline.device)?;
    let model = args.pipeline.open(&device)?;
    if let Some(file) = args.pipeline.init_file() {
        let text = format!("--init: expected fit or flow for jobs of many objects, found {}", file.display());
        return Err(CliError::input(text));
    }
    args.pipeline.options(&model, 1)?;
    let place = match &args.pipeline.checkpoint {
        Some(path) => path.display().to_string(),
        None => "the shipped model".into(),
    };
    let engine = Local { model, pipeline: args.pipeline.clone(), name: format!("{place} on {}", args.pipeline.device) };
    let server = Server::bind(&config, Arc::new(engine))?;
    let stopper = server.stopper();
    signals.on_first(move || stopper.stop())?;
    let url = match &args.token {
        Some(token) => format!("{}?token={token}", server.url()),
        None => server.url(),
    };
    println!("{url}");
    if args.open {
        open(&url);
    }
    server.run().map_err(CliError::failure)
}

/// Hands the address to the system's browser.
fn open(url: &str) {
    let (program, first): (&str, &[&str]) = match std::env::consts::OS {
        "macos" => ("open", &[]),
        "windows" => ("cmd", &["/C", "start", ""]),
        _ => ("xdg-open", &[]),
    };
    if let Err(e) = Command::new(program).args(first).arg(url).spawn() {
        eprintln!("note: --open: {program}: {e}; open the address above");
    }
}

impl From<ServeError> for CliError {
    fn from(e: ServeError) -> Self {
        match e {
            ServeError::Folder(IoError { path, source }) => Self::file(&path, source),
            e => Self::input(e),
        }
    }
}

/// A model in this process.
struct Local {
    model: Reconstructor,
    pipeline: PipelineArgs,
    name: String,
}

fn engine_error(e: freerange::Error) -> EngineError {
    if matches!(e, freerange::Error::Cancelled) {
        return EngineError::Cancelled;
    }
    told(e.into())
}

fn told(e: CliError) -> EngineError {
    match e.exit_code() {
        2 => EngineError::Input(e.to_string()),
        _ => EngineError::Failed(e.to_string()),
    }
}

impl Engine for Local {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn choose(&self, views: &[View]) -> Result<Vec<usize>, String> {
        let most = self.model.network_views().map_err(|e| e.to_string())?;
        choose_views(views, most).map_err(|e| e.to_string())
    }

    fn leave_one_out(&self) -> Option<LeaveOneOut> {
        Some(leave_one_out)
    }

    fn run(
        &self,
        scene: &Scene,
        wanted: &JobOptions,
        tell: &mut dyn FnMut(&Step<'_>) -> ControlFlow<()>,
    ) -> Result<Outcome, EngineError> {
        let mut choices = self.pipeline.choices();
        if let Some(quality) = wanted.quality {
            choices.quality = match quality {
                freerange_serve::Quality::Draft => Quality::Draft,
                freerange_serve::Quality::Default => Quality::Default,
                freerange_serve::Quality::High => Quality::High,
            };
        }
        choices.iterations = wanted.iterations.or(choices.iterations);
        let symmetry = wanted.symmetry.map(|s| match s {
            freerange_serve::Symmetry::Auto => Detect::Auto,
            freerange_serve::Symmetry::Off => Detect::Off,
        });
        choices.symmetry = symmetry.or(choices.symmetry);
        let init = wanted.init.map(|init| match init {
            freerange_serve::Init::Fit => Init::Fit,
            freerange_serve::Init::Flow => Init::Flow,
        });
        choices.init = init.or(choices.init);
        let mut options = self.model.options_of(&choices).map_err(engine_error)?;
        let first = wanted.seed.unwrap_or(self.pipeline.seed);
        options.seeds = (0..u64::from(wanted.samples.unwrap_or(1))).map(|i| first.wrapping_add(i)).collect();
        options.frame = scene.frame;
        let run = self.model.run(&scene.views, &options, &mut |p| {
            let preview = || p.preview().map_err(|e| e.to_string());
            let (stage, sample, done, total, loss) = (p.stage.name(), p.sample, p.done, p.total, p.loss);
            tell(&Step { stage, sample, done, total, loss, preview: &preview })
        });
        let result = run.map_err(engine_error)?;
        let up = result.up().to_array();
        Ok(Outcome {
            samples: result.samples.into_iter().map(|s| (s.seed, s.gaussians)).collect(),
            up,
            notes: result.notes.into_iter().map(|note| note.text).collect(),
            seconds: result.seconds.iter().map(|(stage, s)| (stage.name().to_owned(), *s)).collect(),
        })
    }

    fn picture(&self, cloud: &Gaussians, camera: &Camera) -> Result<RgbaImage, String> {
        let rgb = render_view(cloud, camera).map_err(|e| e.to_string())?;
        Ok(to_picture(&rgb, camera.width, camera.height))
    }
}
