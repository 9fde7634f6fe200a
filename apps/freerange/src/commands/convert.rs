//! `freerange convert`

use std::path::PathBuf;

use freerange_formats::{Format, Frame, SpzVersion, WriteOptions, read, write};

use crate::error::CliError;

/// Convert Gaussians between .ply, .splat, .spz, .sog, .glb and .html, by the extensions of the two files.
///
/// .glb and .spz have +y up by definition. The others are in whatever frame they were made in, which --frame tells:
/// what is read is turned from the one to the other only where two files differ in it. An .html is a page that shows
/// the Gaussians in any browser, offline. A .ply may be compressed (as SuperSplat writes it); colour that depends on
/// the viewing direction is left out.
#[derive(clap::Args)]
pub struct Args {
    /// File to read.
    input: PathBuf,
    /// File to write.
    output: PathBuf,
    /// Frame of files that do not fix their own: z-up (this program's), y-up, or y-down (most programs that train on
    /// COLMAP's cameras). FROM:TO turns between them, as in y-down:z-up.
    #[arg(long, value_name = "FRAME", default_value = "z-up", value_parser = parse_frames)]
    frame: (Frame, Frame),
    /// Version of .spz to write: 3, which all readers take, or 4.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u8).range(3..=4))]
    spz_version: u8,
}

/// `FRAME` or `FROM:TO`.
fn parse_frames(text: &str) -> Result<(Frame, Frame), String> {
    let (from, to) = text.split_once(':').unwrap_or((text, text));
    Ok((from.parse()?, to.parse()?))
}

pub fn run(args: &Args) -> Result<(), CliError> {
    Format::of(&args.output)?; // before anything is read
    let (from, to) = args.frame;
    let mut loaded = read(&args.input, from)?;
    if from != to {
        loaded.cloud.transform(1.0, from.to(to), glam::DVec3::ZERO);
    }
    let spz_version = if args.spz_version == 4 { SpzVersion::V4 } else { SpzVersion::V3 };
    let notes = write(&loaded.cloud, &args.output, &WriteOptions { frame: to, spz_version })?;
    for note in loaded.notes.iter().chain(&notes) {
        eprintln!("note: {note}");
    }
    println!("{} ({} Gaussians)", args.output.display(), loaded.cloud.len());
    Ok(())
}
