//! Sizes of all formats for one object, and how long they take to write and read.
//!
//!     cargo run --release -p freerange-gaussians --example formats -- gaussians.ply [FOLDER]
//!
//! With a FOLDER, the files are left there.

use std::{hint::black_box, path::PathBuf, time::Instant};

use freerange_gaussians::formats::{Format, Frame, SpzVersion, WriteOptions, encode, parse, read};

/// The least of a few runs, in milliseconds.
fn fastest<T>(mut run: impl FnMut() -> T) -> f64 {
    let once = || {
        let begin = Instant::now();
        black_box(run());
        begin.elapsed().as_secs_f64() * 1e3
    };
    std::iter::repeat_with(once).take(20).fold(f64::INFINITY, f64::min)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args_os().skip(1).map(PathBuf::from);
    let input = arguments.next().ok_or("expected a file of Gaussians")?;
    let folder = arguments.next();
    let splats = read(&input, Frame::Z_UP)?.splats;
    println!("{}: {} Gaussians\n", input.display(), splats.cloud.len());
    println!("| format | bytes | per Gaussian | write ms | read ms |\n|---|---|---|---|---|");
    let all = Format::ALL.map(|f| (f, SpzVersion::V3, format!(".{f}")));
    for (format, spz_version, name) in all.into_iter().chain([(Format::Spz, SpzVersion::V4, ".spz version 4".into())]) {
        let options = WriteOptions { spz_version, ..WriteOptions::default() };
        let bytes = encode(&splats, format, &options)?.bytes;
        let written = fastest(|| encode(&splats, format, &options));
        let loaded = fastest(|| parse(format, &bytes, &input, Frame::Z_UP));
        let each = bytes.len() as f64 / splats.cloud.len() as f64;
        println!("| {name} | {} | {each:.1} | {written:.2} | {loaded:.2} |", bytes.len());
        if let Some(folder) = &folder {
            let name =
                if spz_version == SpzVersion::V4 { "version4.spz".into() } else { format!("gaussians.{format}") };
            std::fs::write(folder.join(name), bytes)?;
        }
    }
    Ok(())
}
