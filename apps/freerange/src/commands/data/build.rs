//! `freerange data build` and `freerange data generate`

use std::path::{Path, PathBuf};
use std::sync::Mutex;

use freerange_data::build::{BuildConfig, BuildOptions, GaussianSource, Items, Seconds, Share, Summary, build};
use freerange_data::{HeldOutPsnr, Store};
use freerange_eval::memory::peak_memory;

use crate::{
    error::CliError,
    progress::Progress,
    runtime::{TrainConfig, build_config},
};

/// Arguments of `data build`.
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    input: InputArgs,
    #[command(flatten)]
    settings: Settings,
    #[command(flatten)]
    work: Work,
}

/// Arguments of `data generate`.
#[derive(clap::Args)]
pub struct GenerateArgs {
    /// Objects to make.
    #[arg(long, default_value_t = 1000)]
    objects: u64,
    /// Seed of the first object; object i has this plus i.
    #[arg(long, default_value_t = 0)]
    first_seed: u64,
    #[command(flatten)]
    settings: Settings,
    #[command(flatten)]
    work: Work,
}

/// Which meshes.
#[derive(clap::Args)]
pub struct InputArgs {
    /// Folder of .glb, .gltf, .obj and .ply files, one such file, or a list (.jsonl).
    ///
    /// Lines of a list: {"path": "chair.glb", "license": "CC-BY-4.0", "source": "...", "id": "...", "split": "train"}.
    input: PathBuf,
    /// License of the meshes (SPDX), for files whose list entry has none.
    #[arg(long, default_value = "unknown")]
    license: String,
    /// Prefix of each file's path in its metadata, for files whose list entry has no source.
    #[arg(long, default_value = "")]
    source: String,
}

impl InputArgs {
    /// What the user gave.
    pub fn path(&self) -> &Path {
        &self.input
    }

    /// The meshes.
    pub fn items(&self) -> Result<Items, CliError> {
        let list = self.input.extension().is_some_and(|e| e == "jsonl");
        Ok(match list {
            true => Items::list(&self.input, &self.source, &self.license)?,
            false => Items::find(&self.input, &self.source, &self.license)?,
        })
    }
}

/// How objects are made and stored.
#[derive(Clone, Debug, clap::Args)]
pub struct Settings {
    /// Configuration whose table `data` is used: tiny, base, paper, or a file.
    #[arg(long, default_value = "tiny")]
    config: PathBuf,
    /// Random seed of cameras, light, fits and splits [default: the configuration's].
    #[arg(long)]
    seed: Option<u64>,
    /// Target Gaussians: a 3DGS-MCMC fit, or points on the surface (faster, less exact).
    #[arg(long, value_enum)]
    gaussians: Option<Source>,
    /// Gaussians of the full fit, before the level-of-detail tree [default: the configuration's].
    #[arg(long, value_name = "N")]
    leaves: Option<usize>,
    /// Also store the full fit.
    #[arg(long)]
    keep_leaves: bool,
    /// Depths of the stored slices, such as 8,10,12 [default: the configuration's].
    #[arg(long, value_delimiter = ',')]
    depths: Option<Vec<u32>>,
    /// Views per object [default: the configuration's].
    #[arg(long)]
    views: Option<usize>,
    /// Width and height of the views in pixels [default: the configuration's].
    #[arg(long)]
    resolution: Option<u32>,
    /// Steps of the full fit [default: the configuration's].
    #[arg(long)]
    iterations: Option<usize>,
    /// Optimization steps on each slice; 0 keeps the tree's slices [default: the configuration's].
    #[arg(long)]
    slice_iterations: Option<usize>,
    /// Initial fits of a few views, stored with each object [default: the configuration's].
    #[arg(long, value_name = "N")]
    fits: Option<usize>,
    /// Objects per shard [default: the configuration's].
    #[arg(long)]
    objects_per_shard: Option<u64>,
    /// Least PSNR in dB on held-out views; worse objects are flagged [default: the configuration's].
    #[arg(long)]
    min_psnr: Option<f64>,
}

/// Ways to make Gaussians.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum Source {
    /// 3DGS-MCMC on the rendered views.
    Fit,
    /// Points on the mesh.
    Surface,
}

impl Settings {
    /// The configuration of a command that makes no initial fits.
    pub fn without_input_fits(&self, default_source: Option<GaussianSource>) -> Result<BuildConfig, CliError> {
        if self.fits.is_some() {
            return Err(CliError::input("--fits: this command makes no initial fits"));
        }
        Self { fits: Some(0), ..self.clone() }.build_config(default_source)
    }

    /// The configuration with what the arguments change. `default_source` where neither says where Gaussians come from.
    pub fn build_config(&self, default_source: Option<GaussianSource>) -> Result<BuildConfig, CliError> {
        let mut config = build_config(&TrainConfig::load(&self.config)?);
        let given = self.gaussians.map(|s| match s {
            Source::Fit => GaussianSource::Fit,
            Source::Surface => GaussianSource::Surface,
        });
        let object = &mut config.object;
        object.gaussians = given.or(default_source).unwrap_or(object.gaussians);
        if let Some(n) = self.leaves {
            object.surface.points = n;
            object.fit.cap_max = n;
            object.fit.initial = n;
        }
        object.views = self.views.unwrap_or(object.views);
        object.cameras.resolution = self.resolution.unwrap_or(object.cameras.resolution);
        object.fit.iterations = self.iterations.unwrap_or(object.fit.iterations);
        object.slice_iterations = self.slice_iterations.unwrap_or(object.slice_iterations);
        object.input_fits = self.fits.unwrap_or(object.input_fits);
        config.shard.leaves |= self.keep_leaves;
        config.shard.objects_per_shard = self.objects_per_shard.unwrap_or(config.shard.objects_per_shard);
        config.shard.min_psnr = self.min_psnr.unwrap_or(config.shard.min_psnr);
        config.depths = self.depths.clone().unwrap_or(config.depths);
        config.seed = self.seed.unwrap_or(config.seed);
        config.validate()?;
        Ok(config)
    }
}

/// How the work is done. None of it changes what comes out.
#[derive(clap::Args)]
struct Work {
    /// Output folder, or s3://BUCKET/PREFIX or gs://BUCKET/PREFIX (build with --features cloud).
    #[arg(short, long)]
    output: String,
    /// Build only part I of N of the shards, I from 0 to N - 1.
    ///
    /// Any number of machines may share one output.
    #[arg(long, value_name = "I/N", default_value = "0/1")]
    shard: Share,
    /// Objects built at once; memory grows with it [default: number of cores].
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    workers: usize,
    /// Try failed objects again.
    #[arg(long)]
    retry_failed: bool,
    /// Print a line per object.
    #[arg(long)]
    each: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Runs `data build`.
pub fn run(args: &Args) -> Result<(), CliError> {
    // A mesh is there to be fitted: the surface is for making objects faster than training consumes them.
    make(&args.input.items()?, &args.settings.build_config(Some(GaussianSource::Fit))?, &args.work)
}

/// Runs `data generate`.
pub fn run_generate(args: &GenerateArgs) -> Result<(), CliError> {
    make(&Items::generated(args.objects, args.first_seed), &args.settings.build_config(None)?, &args.work)
}

fn make(items: &Items, config: &BuildConfig, work: &Work) -> Result<(), CliError> {
    let store = Store::open(&work.output)?;
    let options = BuildOptions { share: work.shard, workers: work.workers, retry_failed: work.retry_failed };
    let bar: Mutex<Option<Progress>> = Mutex::new(None);
    let summary = build(config, items, &store, &options, |done| {
        let Ok(mut bar) = bar.lock() else { return };
        let bar = bar.get_or_insert_with(|| Progress::new("objects", done.count[1]));
        if work.each
            && let Some(result) = &done.result
        {
            match result {
                Ok((psnr, seconds)) => eprintln!("{:40} {}; {}", done.id, psnr_line(psnr), seconds_line(seconds)),
                Err(reason) => eprintln!("{:40} failed: {reason}", done.id),
            }
        }
        bar.at(done.count[0], done.id);
    })?;
    if let Some(bar) = bar.into_inner().ok().flatten() {
        bar.finish();
    }
    if work.json {
        println!("{}", serde_json::to_string_pretty(&summary).map_err(CliError::input)?);
    } else {
        print(&summary, &work.output, work.shard);
    }
    // A share without shards is no failure: there may be more processes than shards.
    match summary.objects == 0 && !summary.failures.is_empty() {
        true => Err(CliError::input("no object could be made")),
        false => Ok(()),
    }
}

/// `leaves 30.1 dB, depth 8: 24.0`
pub fn psnr_line(psnr: &HeldOutPsnr) -> String {
    let slices: Vec<String> = psnr.slices.iter().map(|(d, p)| format!("{p:.2} at depth {d}")).collect();
    format!("{:.2} dB before the tree, {}", psnr.leaves, slices.join(", "))
}

/// `read 0.1 s, ...`
pub fn seconds_line(seconds: &Seconds) -> String {
    let stages: Vec<String> = seconds.stages().iter().map(|(name, s)| format!("{name} {s:.2}")).collect();
    format!("{:.2} s ({})", seconds.total(), stages.join(", "))
}

fn print(summary: &Summary, output: &str, share: Share) {
    println!(
        "{} objects made, {} there already, {} failed, {} flagged as bad fits; {} shards, {:.1} MB in {}",
        summary.made,
        summary.skipped,
        summary.failures.len(),
        summary.flagged.len(),
        summary.shards,
        summary.bytes as f64 / 1e6,
        Path::new(output).display()
    );
    if summary.made > 0 {
        println!("per object, on one core: {}", seconds_line(&summary.seconds));
    }
    if let Some(psnr) = &summary.psnr {
        println!("PSNR on held-out views: {}", psnr_line(psnr));
    }
    if let Some(bytes) = peak_memory() {
        println!("peak memory: {:.0} MiB", bytes as f64 / f64::from(1 << 20));
    }
    for id in &summary.flagged {
        println!("  flagged: {id}");
    }
    for failure in &summary.failures {
        println!("  failed: {}: {}", failure.id, failure.reason);
    }
    match summary.complete {
        true => println!("complete: manifest.json is written"),
        false => println!("share {}/{} is done; others are not", share.index, share.count),
    }
}
