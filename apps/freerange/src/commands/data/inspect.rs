//! `freerange data inspect`

use std::path::PathBuf;

use freerange_data::build::contact_sheet;
use freerange_data::{ObjectSource, Shards, Store, inspect};

use crate::error::CliError;

/// Arguments of `data inspect`.
#[derive(clap::Args)]
pub struct Args {
    /// Folder or URL of shards.
    location: String,
    /// Write a contact sheet of the first objects to this PNG file.
    ///
    /// It shows two views, three slices, and the full fit where it is stored.
    #[arg(long, value_name = "FILE")]
    sheet: Option<PathBuf>,
    /// Objects on the sheet.
    #[arg(long, default_value_t = 24)]
    objects: u64,
    /// Read everything and compare all checksums.
    #[arg(long)]
    verify: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<(), CliError> {
    let store = Store::open(&args.location)?;
    let report = inspect(&store, args.verify)?;
    if let Some(path) = &args.sheet {
        let shards = Shards::open(&store, &report.depths, None)?;
        let count = args.objects.min(shards.len() as u64);
        let objects = (0..count as u32).map(|i| Ok((shards.object(i.into())?, shards.leaves(i.into())?)));
        let sheet = contact_sheet(objects, 2)?;
        sheet.save(path).map_err(|e| CliError::file(path, e))?;
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report).map_err(CliError::input)?);
        return Ok(());
    }
    let counts = |counts: &std::collections::BTreeMap<String, u64>| {
        counts.iter().map(|(name, n)| format!("{n} {name}")).collect::<Vec<_>>().join(", ")
    };
    println!(
        "{} objects in {} shards, {:.1} MB, {}",
        report.objects,
        report.shards,
        report.bytes as f64 / 1e6,
        if report.complete { "complete" } else { "unfinished" }
    );
    println!("parts: {}; licenses: {}", counts(&report.splits), counts(&report.licenses));
    if let (Some(views), Some([w, h]), Some(sets)) = (report.views, report.image_size, report.evaluation) {
        let sets = if sets { "with" } else { "too few for" };
        println!("depths {:?}; {views} views of {w} x {h} pixels, {sets} sets for evaluation", report.depths);
    }
    if let Some([least, median, most]) = report.psnr {
        println!("PSNR before the tree, on held-out views: {least:.2} to {most:.2} dB, median {median:.2}");
    }
    println!(
        "flagged as bad fits: {}; failed: {}; checksums {}",
        report.flagged.len(),
        report.failures.len(),
        if args.verify { "compared" } else { "not compared" }
    );
    for failure in &report.failures {
        println!("  {}: {}", failure.id, failure.reason);
    }
    for (depth, n) in &report.statistics {
        println!("depth {depth}: channel, mean, standard deviation");
        for (name, (mean, std)) in report.channels.iter().zip(n.mean.iter().zip(&n.std)) {
            println!("  {name:14} {mean:9.4} {std:9.4}");
        }
    }
    Ok(())
}
