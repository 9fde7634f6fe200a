//! `freerange data merge`

use freerange_data::Store;
use freerange_data::build::{collect, merge};

use crate::error::CliError;

/// Arguments of `data merge`.
#[derive(clap::Args)]
pub struct Args {
    /// Output of `data build` or `data generate`; the manifest is written there.
    output: String,
    /// Other outputs of the same configuration and input; their shards are copied first.
    others: Vec<String>,
}

pub fn run(args: &Args) -> Result<(), CliError> {
    let store = Store::open(&args.output)?;
    for other in &args.others {
        println!("{} shards copied from {other}", collect(&store, &Store::open(other)?)?);
    }
    let manifest = merge(&store)?;
    let (found, all) = (manifest.shards.len(), manifest.plan.shard_count());
    if !manifest.is_complete() {
        return Err(CliError::input(format!("{}: {found} of {all} shards are there: build the others", args.output)));
    }
    println!("{} objects in {found} shards: manifest.json is written", manifest.objects().count());
    Ok(())
}
