//! `freerange data`

use std::{
    path::PathBuf,
    sync::{
        Mutex,
        atomic::{AtomicU64, Ordering},
    },
};

use freerange_data::{
    GaussianSource, GenerateConfig, Shards, contact_sheet, generate_shards, inspect, measure_quality,
};
use freerange_flow::config::TrainConfig;

use crate::{error::CliError, progress::Progress};

/// Make and look at training data.
#[derive(clap::Subcommand)]
pub enum Command {
    /// Make objects and write them as tar shards. Run the same command again to go on where it was stopped.
    Generate(Generate),
    /// Say what a folder of shards holds.
    Inspect(Inspect),
    /// Measure how well Gaussians from the surface and from 3DGS-MCMC show objects, and what they cost.
    Quality(QualityArgs),
}

/// Arguments of `data generate`.
#[derive(clap::Args)]
pub struct Generate {
    /// Folder for the shards.
    #[arg(short, long)]
    output: PathBuf,
    /// Training configuration whose [data.object] and depths are used, such as configs/tiny.toml.
    #[arg(long)]
    config: PathBuf,
    /// Objects to make.
    #[arg(long, default_value_t = 1000)]
    objects: u64,
    /// Objects per shard.
    #[arg(long, default_value_t = 100)]
    objects_per_shard: u64,
    /// Seed of the first object.
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// Arguments of `data inspect`.
#[derive(clap::Args)]
pub struct Inspect {
    /// Folder of shards.
    folder: PathBuf,
    /// Write a contact sheet of the first objects to this PNG file.
    #[arg(long, value_name = "FILE")]
    sheet: Option<PathBuf>,
    /// Read everything and compare all checksums.
    #[arg(long)]
    verify: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Arguments of `data quality`.
#[derive(clap::Args)]
pub struct QualityArgs {
    /// Training configuration whose [data.object] and depths are used.
    #[arg(long)]
    config: PathBuf,
    /// Objects to measure.
    #[arg(long, default_value_t = 10)]
    objects: u64,
    /// Seed of the first object.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Views per object that the Gaussians are not made from.
    #[arg(long, default_value_t = 4)]
    held_out: usize,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(command: &Command) -> Result<(), CliError> {
    match command {
        Command::Generate(args) => generate(args),
        Command::Inspect(args) => look(args),
        Command::Quality(args) => quality(args),
    }
}

fn generate(args: &Generate) -> Result<(), CliError> {
    let config = TrainConfig::load(&args.config)?;
    let config = GenerateConfig {
        objects: args.objects,
        objects_per_shard: args.objects_per_shard,
        seed: args.seed,
        depths: config.depths(),
        object: config.data.object,
        ..GenerateConfig::default()
    };
    let bar = Mutex::new(Progress::new("objects", args.objects));
    let shown = AtomicU64::new(0);
    let summary = generate_shards(&config, &args.output, |done, _| {
        // Threads may report out of order.
        if shown.fetch_max(done, Ordering::Relaxed) < done
            && let Ok(mut bar) = bar.lock()
        {
            bar.at(done, "");
        }
    })?;
    println!(
        "{} objects made, {} there already, {} failed; {} shards, {:.1} MB in {}",
        summary.made,
        summary.skipped,
        summary.failures.len(),
        summary.shards,
        summary.bytes as f64 / 1e6,
        args.output.display()
    );
    for failure in &summary.failures {
        println!("  object {} (seed {}): {}", failure.object, failure.seed, failure.reason);
    }
    Ok(())
}

fn look(args: &Inspect) -> Result<(), CliError> {
    let report = inspect(&args.folder, args.verify)?;
    if let Some(path) = &args.sheet {
        let shards = Shards::open(&args.folder, &report.depths)?;
        let sheet = contact_sheet(&shards, report.objects.min(24), 2)?;
        sheet.save(path).map_err(|e| CliError::file(path, e))?;
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report).map_err(CliError::input)?);
        return Ok(());
    }
    println!(
        "{} objects in {} shards, {:.1} MB, {}",
        report.objects,
        report.shards,
        report.bytes as f64 / 1e6,
        match report.complete {
            true => "complete",
            false => "unfinished",
        }
    );
    println!("depths {:?}, views per object {:?}, image size {:?}", report.depths, report.views, report.image_size);
    println!("licence {}, configuration {}", report.licence, report.config_sha256);
    println!(
        "failed objects: {}; checksums {}",
        report.failures.len(),
        if args.verify { "compared" } else { "not compared" }
    );
    for (depth, n) in &report.statistics {
        println!("depth {depth}: channel, mean, standard deviation");
        for (name, (mean, std)) in report.channels.iter().zip(n.mean.iter().zip(&n.std)) {
            println!("  {name:14} {mean:9.4} {std:9.4}");
        }
    }
    Ok(())
}

fn quality(args: &QualityArgs) -> Result<(), CliError> {
    let config = TrainConfig::load(&args.config)?;
    let depths = config.depths();
    let sources = [GaussianSource::Surface, GaussianSource::Fit];
    let seeds = args.seed..args.seed.saturating_add(args.objects);
    let mut bar = Progress::new("measuring", 2 * args.objects);
    let mut done = 0;
    let table = measure_quality(&config.data.object, &sources, seeds, &depths, args.held_out, |_, source| {
        done += 1;
        bar.at(done, &format!("{source:?}"));
    })?;
    bar.finish();
    if args.json {
        println!("{}", serde_json::to_string_pretty(&table).map_err(CliError::input)?);
        return Ok(());
    }
    println!(
        "{} objects; PSNR in dB over {} held-out views each; seconds of one thread per object",
        args.objects, args.held_out
    );
    for row in &table {
        let psnr: Vec<String> = row.psnr.iter().map(|(d, p)| format!("depth {d}: {p:.2}")).collect();
        let s = row.seconds;
        println!(
            "{:8} {}; scene {:.3} s, views {:.3} s, Gaussians {:.3} s, slices {:.3} s",
            format!("{:?}", row.gaussians).to_lowercase(),
            psnr.join(", "),
            s.scene,
            s.views,
            s.gaussians,
            s.slices
        );
    }
    Ok(())
}
