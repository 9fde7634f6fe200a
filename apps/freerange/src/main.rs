//! `freerange`: posed photos in, 3D Gaussians out.

mod commands;
mod error;
mod output;
mod photos;
mod pipeline;
mod progress;
mod ranks;
#[cfg(test)]
mod reference;
mod runtime;
mod signals;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use error::EXIT_CODE;
use signals::Signals;

/// Posed photos in, 3D Gaussians out.
///
/// Reconstructs one object from two or more photos with cameras; four is the measured case. A network refines initial fits,
/// then an optimization on the photos follows. Exit codes: 0 done, 1 failed, 2 bad input.
#[derive(Parser)]
#[command(name = "freerange", version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    /// More messages on standard error (or set RUST_LOG).
    #[arg(short, long, global = true, hide_short_help = true)]
    verbose: bool,
}

#[derive(Subcommand)]
enum Command {
    Reconstruct(Box<commands::reconstruct::Args>),
    Inspect(commands::inspect::Args),
    Poses(commands::poses::Args),
    Serve(Box<commands::serve::Args>),
    Render(commands::render::Args),
    Convert(commands::convert::Args),
    /// Measure a method on objects with validation views; compare reports; ablations.
    ///
    /// Images are compared on white at their own resolution. Writes report.html, report.md, report.json and a record of each
    /// object. Run the same command again to continue a stopped run. If an object fails, the others go on and the exit
    /// code is 1.
    Eval(Box<commands::eval::Args>),
    /// List and download the published weights of metrics. Needs a build with `--features networks`.
    #[command(subcommand)]
    Weights(commands::weights::Command),
    Train(commands::train::Args),
    /// Build and inspect training data.
    #[command(subcommand)]
    Data(commands::data::Command),
    Bench(commands::bench::Args),
    Devices(commands::devices::Args),
    /// Inspect, shrink, average and export models.
    #[command(subcommand)]
    Model(commands::model::Command),
}

/// Lets `freerange ... | head` end quietly, as other programs do: Rust turns the signal of a closed pipe into a panic.
#[cfg(unix)]
fn end_with_a_closed_pipe() {
    // SAFETY: no other thread is there yet, and the default action runs no code of ours.
    unsafe { libc::signal(libc::SIGPIPE, libc::SIG_DFL) };
}

fn main() -> ExitCode {
    #[cfg(unix)]
    end_with_a_closed_pipe();
    freerange_model::keep_freed_memory();
    let cli = Cli::parse();
    // Before there are other threads. The other commands take signals themselves, or leave nothing behind.
    if let Command::Reconstruct(_) | Command::Inspect(_) | Command::Render(_) | Command::Model(_) | Command::Data(_) =
        cli.command
    {
        let taken = Signals::take().on_first(|| output::abandon(EXIT_CODE));
        if let Err(e) = taken {
            eprintln!("error: {e}");
            return ExitCode::from(e.exit_code());
        }
    }
    // CubeCL tries several kernels for each job and reports each that a device cannot run; what matters ends as an error.
    let level = if cli.verbose { "debug" } else { "warn,cubecl_runtime=off,cubecl_wgpu=off" };
    let filter = tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| level.into());
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    let result = match cli.command {
        Command::Reconstruct(args) => commands::reconstruct::run(&args),
        Command::Inspect(args) => commands::inspect::run(&args),
        Command::Poses(args) => commands::poses::run(&args),
        Command::Serve(args) => commands::serve::run(&args),
        Command::Render(args) => commands::render::run(&args),
        Command::Convert(args) => commands::convert::run(&args),
        Command::Eval(args) => commands::eval::run(&args),
        Command::Weights(command) => commands::weights::run(&command),
        Command::Train(args) => commands::train::run(&args),
        Command::Data(command) => commands::data::run(&command),
        Command::Bench(args) => commands::bench::run(&args),
        Command::Devices(args) => commands::devices::run(&args),
        Command::Model(command) => commands::model::run(&command),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            let text = e.to_string();
            // Another rank says it.
            if !text.is_empty() {
                eprintln!("error: {text}");
            }
            ExitCode::from(e.exit_code())
        }
    }
}
