//! `freerange eval compare`

use std::path::PathBuf;

use freerange_eval::{
    Report,
    compare::{compare, tables},
};

use crate::error::CliError;

/// Arguments of `eval compare`.
#[derive(clap::Args)]
pub struct Args {
    /// Output folder of `freerange eval`, or its report.json.
    a: PathBuf,
    /// Another one of the same objects and validation images.
    b: PathBuf,
    /// Seed of the bootstrap.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Print JSON instead of Markdown.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<(), CliError> {
    let (a, b) = (Report::load(&args.a)?, Report::load(&args.b)?);
    let comparisons = compare(&a, &b, args.seed)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&comparisons).map_err(CliError::input)?);
        return Ok(());
    }
    for (name, report, path) in [("A", &a, &args.a), ("B", &b, &args.b)] {
        println!("{name}: {} ({})", freerange_eval::table::escape_markdown(&report.method), path.display());
    }
    for table in tables(&comparisons) {
        println!("\n{}", table.markdown());
    }
    Ok(())
}
