//! `freerange data quality`

use std::path::PathBuf;

use freerange_data::build::{GaussianSource, Quality, measure_quality};

use super::build::{InputArgs, Settings};
use crate::{error::CliError, progress::Progress};

/// Arguments of `data quality`.
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    input: InputArgs,
    #[command(flatten)]
    settings: Settings,
    /// Numbers of Gaussians, powers of two up to --leaves.
    #[arg(long, value_delimiter = ',', default_values_t = [256usize, 1024])]
    counts: Vec<usize>,
    /// Measure only this many objects, evenly spread.
    #[arg(long)]
    objects: Option<u64>,
    /// Write a JSON line per object to this file as soon as it is measured.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

pub fn run(args: &Args) -> Result<(), CliError> {
    let items = args.input.items()?.spread(args.objects.unwrap_or(u64::MAX));
    let config = args.settings.without_input_fits(Some(GaussianSource::Fit))?;
    let mut bar = Progress::new("measuring", items.len());
    let mut table: Vec<Quality> = Vec::new();
    let mut lines = String::new();
    for index in 0..items.len() {
        let Some(item) = items.get(index) else { break };
        let quality = measure_quality(&item, &config, &args.counts)?;
        if let Some(path) = &args.output {
            lines += &serde_json::to_string(&quality).map_err(CliError::input)?;
            lines.push('\n');
            let written = freerange_util::write_atomically(path, |f| std::io::Write::write_all(f, lines.as_bytes()));
            written.map_err(|e| CliError::file(path, e))?;
        }
        bar.at(index + 1, &item.id);
        table.push(quality);
    }
    bar.finish();
    print(&table, &args.counts);
    Ok(())
}

fn print(table: &[Quality], counts: &[usize]) {
    let Some(first) = table.first() else { return };
    let optimized = first.by_count.iter().any(|c| c.optimized.is_some());
    let mut columns = vec![format!("fit {}", first.gaussians)];
    for n in counts {
        columns.push(format!("fit {n}"));
        columns.push(format!("slice {n}"));
        if optimized {
            columns.push(format!("optimized {n}"));
        }
        columns.push(format!("surface {n}"));
    }
    println!("| object | {} |", columns.join(" | "));
    println!("|---|{}", "---|".repeat(columns.len()));
    let row = |name: &str, values: &[f64]| {
        let values: Vec<String> = values.iter().map(|v| format!("{v:.2}")).collect();
        println!("| {name} | {} |", values.join(" | "));
    };
    let mut sum = vec![0.0; columns.len()];
    for q in table {
        let mut values = vec![q.full];
        for c in &q.by_count {
            values.extend([c.fit, c.slice]);
            values.extend(c.optimized);
            values.push(c.surface);
        }
        row(&q.id, &values);
        sum.iter_mut().zip(&values).for_each(|(s, v)| *s += v / table.len() as f64);
    }
    row(&format!("mean of {}", table.len()), &sum);
    let seconds = table.iter().map(|q| q.full_seconds).sum::<f64>() / table.len() as f64;
    println!("seconds per fit of {}: {seconds:.1}", first.gaussians);
}
