//! `freerange weights`

use std::path::PathBuf;

use crate::error::CliError;

/// List and download the published weights of metrics.
#[derive(clap::Subcommand)]
pub enum Command {
    /// List the sets of weights, their use, and whether they are present.
    List(List),
    /// Download sets of weights from their authors and check them.
    Fetch(Fetch),
}

/// Arguments of `weights list`.
#[derive(clap::Args)]
pub struct List {
    #[command(flatten)]
    weights: WeightsArgs,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Arguments of `weights fetch`.
#[derive(clap::Args)]
pub struct Fetch {
    /// Names of the sets, as `freerange weights list` shows them.
    #[arg(required = true)]
    names: Vec<String>,
    #[command(flatten)]
    weights: WeightsArgs,
    /// Address of the Hugging Face hub or a mirror.
    #[arg(long, value_name = "URL", default_value = "https://huggingface.co")]
    hub: String,
}

/// Where weights lie.
#[derive(clap::Args)]
struct WeightsArgs {
    /// Folder of weights [default: freerange/weights in your cache folder].
    #[arg(long, value_name = "DIR")]
    weights: Option<PathBuf>,
}

impl WeightsArgs {
    #[cfg(feature = "networks")]
    fn folder(&self) -> Result<PathBuf, CliError> {
        let known = self.weights.clone().or_else(freerange::machine::weights_folder);
        known.ok_or_else(|| CliError::input("no cache folder is known on this system: expected --weights DIR"))
    }
}

#[cfg(feature = "networks")]
pub fn run(command: &Command) -> Result<(), CliError> {
    match command {
        Command::List(args) => list(args),
        Command::Fetch(args) => fetch(args),
    }
}

#[cfg(not(feature = "networks"))]
pub fn run(command: &Command) -> Result<(), CliError> {
    let (weights, what) = match command {
        Command::List(args) => (&args.weights, format!("weights list{}", if args.json { " --json" } else { "" })),
        Command::Fetch(args) => (&args.weights, format!("weights fetch {} from {}", args.names.join(" "), args.hub)),
    };
    let folder = weights.weights.as_ref().map_or(String::new(), |f| format!(" ({})", f.display()));
    let build = "this program was built without networks; build it with `cargo build --release --features fetch`";
    Err(CliError::input(format!("{what}{folder}: {build}")))
}

#[cfg(feature = "networks")]
fn list(args: &List) -> Result<(), CliError> {
    use freerange_eval::metrics::weights::{SETS, Weights};
    let folder = args.weights.folder()?;
    let weights = Weights::new([folder.clone()]);
    let there: Vec<bool> = SETS.iter().map(|set| weights.find(set.name).is_ok()).collect();
    if args.json {
        let entry = |(set, there): (&freerange_eval::metrics::weights::WeightSet, &bool)| {
            let files: Vec<&str> = set.files.iter().map(|f| f.path).collect();
            serde_json::json!({
                "name": set.name, "purpose": set.purpose, "license": set.license, "files": files, "there": there,
            })
        };
        let sets: Vec<_> = SETS.iter().zip(&there).map(entry).collect();
        let json = serde_json::json!({ "folder": folder, "sets": sets });
        println!("{}", serde_json::to_string_pretty(&json).map_err(CliError::input)?);
        return Ok(());
    }
    println!("{}", folder.display());
    for (set, there) in SETS.iter().zip(there) {
        let there = if there { "there" } else { "-" };
        println!("{:16} {there:6} {} ({})", set.name, set.purpose, set.license);
    }
    Ok(())
}

#[cfg(all(feature = "networks", not(feature = "fetch")))]
fn fetch(args: &Fetch) -> Result<(), CliError> {
    use freerange_eval::metrics::weights::{Origin, set};
    // Without the means to download, say what a user has to.
    let mut lines = vec![format!(
        "this program was built without downloads (build it with `cargo build --release --features fetch`, --hub {}); by \
         hand, into {}:",
        args.hub,
        args.weights.folder()?.display()
    )];
    for name in &args.names {
        for file in set(name)?.files {
            let from = match file.origin {
                Origin::Hub { repository, path } => format!("https://huggingface.co/{repository}/resolve/main/{path}"),
                Origin::Url(url) => url.to_owned(),
                Origin::Zip { url, member } => format!("{url}, `{member}` in it"),
            };
            lines.push(format!("  {} from {from}", file.path));
        }
    }
    Err(CliError::input(lines.join("\n")))
}

#[cfg(feature = "fetch")]
fn fetch(args: &Fetch) -> Result<(), CliError> {
    use freerange_eval::metrics::weights::{FetchOptions, fetch, set};
    let folder = args.weights.folder()?;
    for name in &args.names {
        set(name)?; // all names are looked at before the first download
    }
    let options = FetchOptions { hub: args.hub.clone(), ..FetchOptions::default() };
    for name in &args.names {
        let mut bar = crate::progress::Progress::new(name, 0);
        let files = fetch(name, &folder, &options, &mut |file, done, total| {
            bar.of(total.unwrap_or(0));
            bar.at(done, file);
        })?;
        bar.finish();
        files.iter().for_each(|f| println!("{}", f.display()));
    }
    Ok(())
}
