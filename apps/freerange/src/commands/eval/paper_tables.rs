//! `freerange eval paper-tables`

use std::path::PathBuf;

use freerange_eval::paper_tables::PaperTables;
use freerange_util::write_atomically;

use super::paper_pictures::PictureArgs;
use crate::error::CliError;

/// Arguments of `eval paper-tables`.
#[derive(clap::Args)]
pub struct Args {
    /// Folder of the rows' evaluations, as `tools/tables.sh` makes it.
    rows: PathBuf,
    /// Write the tables to this Markdown file instead of standard output.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Also write the tables' data to this folder, which can replace ROWS later.
    #[arg(long, value_name = "DIR")]
    keep: Option<PathBuf>,
    /// Seed of the bootstrap.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    #[command(flatten)]
    pictures: PictureArgs,
}

pub fn run(args: &Args) -> Result<(), CliError> {
    args.pictures.check()?;
    let tables = PaperTables::read(&args.rows, args.seed)?;
    if let Some(place) = &args.keep {
        tables.keep(place)?;
    }
    args.pictures.run()?;
    let text = tables.markdown();
    match &args.output {
        None => print!("{}", text.trim_start()),
        Some(path) => {
            let text = text.trim_start().as_bytes();
            write_atomically(path, |file| std::io::Write::write_all(file, text))
                .map_err(|e| CliError::file(path, e))?;
        }
    }
    Ok(())
}
