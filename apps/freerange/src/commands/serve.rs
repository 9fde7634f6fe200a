//! `freerange serve`

mod cameras;

use std::{
    env::VarError,
    fs::File,
    io::{ErrorKind, Read, Write},
    net::{IpAddr, SocketAddr},
    ops::ControlFlow,
    path::PathBuf,
    process::Command,
    sync::Arc,
    time::Duration,
};

use freerange::{
    Camera, Detect, Gaussians, Init, Quality, Reconstructor, View, choose_views, internal::leave_one_out,
    pictures::render_view,
};
use freerange_scene::camera::image_ops::to_picture;
use freerange_scene::estimate::LeaveOneOut;
use freerange_serve::{
    Engine, EngineError, Example, FoundCameras, JobOptions, Limits, Outcome, Scene, Search, SearchStep, ServeConfig,
    ServeError, Server, Step,
};
use freerange_util::IoError;
use image::RgbaImage;

use self::cameras::Finder;
use crate::{error::CliError, pipeline::PipelineArgs, ranks::Job, signals::Signals};

/// Serve a web page: drop photos with cameras, correct masks, watch the Gaussians appear.
///
/// Listens on this machine only and loads nothing from elsewhere. Prints a link with a new access token; whoever has the link may use the
/// page. Options of the pipeline are the defaults of its jobs. Ctrl-C ends it.
#[derive(clap::Args)]
pub struct Args {
    /// Open the page in the browser.
    #[arg(long)]
    open: bool,
    /// Port to listen at; 0 takes a free one.
    #[arg(long, default_value_t = 7878)]
    port: u16,
    /// Address to listen at; 0.0.0.0 for all of this machine's.
    #[arg(long, default_value = "127.0.0.1", value_name = "ADDRESS")]
    host: IpAddr,
    /// File that holds the access token: at least 16 letters, digits or - . _ ~ [default: a new one].
    ///
    /// Without this option, the environment variable FREERANGE_TOKEN may hold it. Browsers open http://ADDRESS/?token=TOKEN, or ask for the
    /// token. Programs send the header `Authorization: Bearer TOKEN`.
    #[arg(long, value_name = "FILE", conflicts_with = "no_token")]
    token_file: Option<PathBuf>,
    /// Serve without a token: every user of this machine can see photos and remove jobs.
    #[arg(long)]
    no_token: bool,
    /// Allowed Host header beside addresses, such as the name behind a proxy; may be repeated.
    ///
    /// A link with it is printed: https://HOST/ if --host is loopback, else http://HOST:PORT/.
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
    /// Most megabytes of memory for the photos of a job, while they are read.
    #[arg(long, value_name = "MB", default_value_t = 1024, value_parser = clap::value_parser!(u64).range(16..=1_048_576))]
    max_memory: u64,
    /// Most seconds for reading the photos of a job.
    #[arg(long, value_name = "SECONDS", default_value_t = 300, value_parser = clap::value_parser!(u64).range(1..=604_800))]
    max_read_time: u64,
    /// Most seconds for finding the cameras of a job's photos.
    #[arg(long, value_name = "SECONDS", default_value_t = 1800, value_parser = clap::value_parser!(u64).range(1..=604_800))]
    max_search_time: u64,
    /// Most megabytes of memory for COLMAP or pycolmap; measured on Linux.
    #[arg(long, value_name = "MB", default_value_t = 4096, value_parser = clap::value_parser!(u64).range(16..=1_048_576))]
    max_search_memory: u64,
    /// Most megabytes of all jobs on disk.
    #[arg(long, value_name = "MB", default_value_t = 16_384, value_parser = clap::value_parser!(u64).range(16..=1_048_576_000))]
    max_disk: u64,
    /// Most open jobs: in preparation, waiting or computing.
    #[arg(long, value_name = "JOBS", default_value_t = 32, value_parser = clap::value_parser!(u16).range(1..=10_000))]
    max_jobs: u16,
    /// Python with pycolmap, for photos without cameras [default: COLMAP on the PATH, else python3].
    #[arg(long, value_name = "PROGRAM")]
    python: Option<PathBuf>,
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
    let token = Token::of(args)?;
    let config = ServeConfig {
        host: args.host,
        port: args.port,
        token: token.text.clone(),
        names: args.name.clone(),
        keep: args.keep.clone(),
        example: Some(EXAMPLE),
        limits: Limits {
            job_time: Duration::from_secs(args.max_time),
            bytes: args.max_upload << 20,
            file_bytes: Limits::default().file_bytes.min(args.max_upload << 20),
            pixels: args.max_pixels * 1_000_000,
            open_jobs: args.max_jobs.into(),
            memory: args.max_memory << 20,
            read_time: Duration::from_secs(args.max_read_time),
            search_time: Duration::from_secs(args.max_search_time),
            search_memory: args.max_search_memory << 20,
            disk: args.max_disk << 20,
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
    let finder = Finder::new(args.python.as_deref())?;
    let device = Job::alone().open(args.pipeline.device)?;
    let model = args.pipeline.open(&device)?;
    if let Some(file) = args.pipeline.init_file() {
        let text = format!("--init: expected fit or flow for jobs of many objects, found {}", file.display());
        return Err(CliError::input(text));
    }
    args.pipeline.options_of_jobs(&model, 1)?;
    let place = match &args.pipeline.checkpoint {
        // Where it lies is nobody's business.
        Some(path) => path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned(),
        None => "the shipped model".into(),
    };
    let name = format!("{place} on {device}");
    let engine = Local { model, pipeline: args.pipeline.clone(), name, finder };
    let server = Server::bind(&config, Arc::new(engine))?;
    let stopper = server.stopper();
    signals.on_first(move || stopper.stop())?;
    let query = token.text.as_ref().map(|text| format!("?token={text}")).unwrap_or_default();
    // A secret that came from elsewhere does not belong into logs.
    let shown = if token.is_new { query.as_str() } else { "" };
    let links = std::iter::once(server.url()).chain(args.name.iter().map(|name| named(name, server.address())));
    // At once: who reads the first line only may close the pipe then.
    print!("{}", links.map(|link| format!("{link}{shown}\n")).collect::<String>());
    let _page = if args.open { open(&format!("{}{query}", server.url())) } else { None };
    server.run().map_err(CliError::failure)
}

/// The page's address by the name of a host. On loopback only a proxy of this machine can have that name, and proxies encrypt.
fn named(name: &str, address: SocketAddr) -> String {
    match address.ip().is_loopback() {
        true => format!("https://{name}/"),
        false => format!("http://{name}:{}/", address.port()),
    }
}

/// The access token, and where it came from.
struct Token {
    text: Option<String>,
    /// Whether it was drawn just now: nobody knows it yet.
    is_new: bool,
}

/// Most bytes of a file with a token.
const TOKEN_FILE: u64 = 4096;

impl Token {
    fn of(args: &Args) -> Result<Self, CliError> {
        if args.no_token {
            return Ok(Self { text: None, is_new: false });
        }
        if let Some(path) = &args.token_file {
            let mut text = String::new();
            let read = File::open(path).and_then(|file| file.take(TOKEN_FILE).read_to_string(&mut text));
            read.map_err(|e| CliError::file(path, e))?;
            return Ok(Self { text: Some(text.trim().to_owned()), is_new: false });
        }
        match std::env::var("FREERANGE_TOKEN") {
            Ok(text) => Ok(Self { text: Some(text), is_new: false }),
            Err(VarError::NotPresent) => Ok(Self { text: Some(freerange_serve::draw_token()), is_new: true }),
            Err(VarError::NotUnicode(_)) => Err(CliError::input("FREERANGE_TOKEN: expected text, found other bytes")),
        }
    }
}

/// Hands the link to the system's browser: in a file that only this user can read, since all users see the arguments of programs. The file is
/// there as long as what is returned.
fn open(link: &str) -> Option<tempfile::NamedTempFile> {
    let text = format!(
        "<!doctype html><meta http-equiv=\"refresh\" content=\"0; url={link}\"><a href=\"{link}\">free-range</a>\n"
    );
    let file = tempfile::Builder::new().prefix("freerange-").suffix(".html").tempfile();
    let written = file.and_then(|mut file| file.write_all(text.as_bytes()).map(|()| file));
    let page = match written {
        Ok(page) => page,
        Err(e) => {
            eprintln!("note: --open: {e}; open the address above");
            return None;
        }
    };
    let (program, first): (&str, &[&str]) = match std::env::consts::OS {
        "macos" => ("open", &[]),
        "windows" => ("cmd", &["/C", "start", ""]),
        _ => ("xdg-open", &[]),
    };
    if let Err(e) = Command::new(program).args(first).arg(page.path()).spawn() {
        eprintln!("note: --open: {program}: {e}; open the address above");
    }
    Some(page)
}

impl From<ServeError> for CliError {
    fn from(e: ServeError) -> Self {
        match e {
            ServeError::Folder(IoError { path, source }) => Self::file(&path, source),
            ServeError::Listen { ref source, .. } if source.kind() == ErrorKind::AddrInUse => {
                Self::input(format!("{e}; --port 0 takes a free port"))
            }
            e => Self::input(e),
        }
    }
}

/// A model in this process.
struct Local {
    model: Reconstructor,
    pipeline: PipelineArgs,
    name: String,
    finder: Arc<Finder>,
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

    fn defaults(&self) -> JobOptions {
        let choices = self.pipeline.choices();
        let quality = match choices.quality {
            Quality::Draft => freerange_serve::Quality::Draft,
            Quality::Default => freerange_serve::Quality::Default,
            Quality::High => freerange_serve::Quality::High,
        };
        // Options that cannot be made are an error when a job runs.
        let init = self.model.options_of(&choices).ok().map(|options| match options.pipeline.propose.init {
            Init::Fit => freerange_serve::Init::Fit,
            Init::Flow => freerange_serve::Init::Flow,
        });
        JobOptions { quality: Some(quality), init, ..JobOptions::default() }
    }

    fn choose(&self, views: &[View]) -> Result<Vec<usize>, String> {
        let options = self.model.options_of(&self.pipeline.choices()).map_err(|e| e.to_string())?;
        choose_views(views, options.pipeline.network_views).map_err(|e| e.to_string())
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

    fn camera_finder(&self) -> Result<String, String> {
        self.finder.name()
    }

    fn find_cameras(&self, search: &Search<'_>, tell: &mut dyn FnMut(SearchStep)) -> Result<FoundCameras, EngineError> {
        self.finder.find(search, tell)
    }
}
