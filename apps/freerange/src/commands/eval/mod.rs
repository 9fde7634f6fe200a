//! `freerange eval`

mod ablations;
mod args;
mod compare;
mod methods;
mod oracle;
mod paper_pictures;
mod paper_tables;
mod sources;

use std::path::{Path, PathBuf};

use freerange_eval::{
    FrechetVgg, Report, RunFolder,
    record::style,
    runner::{Event, Run, Shared, line, report},
};

use crate::{error::CliError, progress::Progress, ranks::Job};
use args::RunArgs;

/// Arguments of `eval`.
#[derive(clap::Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub struct Args {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    run: RunArgs,
    /// Output folder; needed unless --json prints the report alone.
    #[arg(short, long, value_name = "OUT")]
    output: Option<PathBuf>,
    /// Print the report as JSON on standard output.
    #[arg(long)]
    json: bool,
}

#[derive(clap::Subcommand)]
enum Command {
    /// Compare two reports of the same data object by object.
    Compare(compare::Args),
    /// Measure one changed setting of the pipeline after the other, on the same objects.
    Ablations(Box<ablations::Args>),
    /// Write the paper's four tables with its numbers beside those measured here.
    PaperTables(Box<paper_tables::Args>),
}

pub fn run(args: &Args) -> Result<(), CliError> {
    if let Some(Command::Compare(args)) = &args.command {
        return compare::run(args);
    }
    if let Some(Command::PaperTables(args)) = &args.command {
        return paper_tables::run(args);
    }
    let shared = match &args.command {
        Some(Command::Ablations(args)) => args.is_shared(),
        _ => args.run.shard.is_none(),
    };
    let job = Job::start_if(shared)?;
    let result = match &args.command {
        Some(Command::Ablations(args)) => ablations::run(args, &job),
        _ => evaluate(args, &job),
    };
    job.end(result)
}

fn evaluate(args: &Args, job: &Job) -> Result<(), CliError> {
    // Without a folder to keep, results lie in one that goes away.
    let temporary = match (&args.output, args.json) {
        (Some(_), _) => None,
        (None, true) if job.world() == 1 => Some(tempfile::tempdir().map_err(CliError::failure)?),
        (None, true) => {
            return job.together(Err(CliError::input("expected -o OUT, a folder that all processes share")));
        }
        (None, false) => {
            return job.together(Err(CliError::input("expected -o OUT, a folder for the results, or --json")));
        }
    };
    let output: &Path = match (&args.output, &temporary) {
        (Some(path), _) => path,
        (None, Some(folder)) => folder.path(),
        (None, None) => unreachable!("refused above"),
    };
    let a = &args.run;
    let opened = || {
        let device = job.open(a.pipeline.device)?;
        let method = a.open_method(&device)?;
        let (shared, source) = a.open_shared(&device, job)?;
        Ok((device, method, shared, source))
    };
    let (device, method, shared, source) = job.together(opened())?;
    let inputs = a.inputs();
    let settings = a.settings(&method, &inputs, &shared, &source);
    let folder = job.first_then_others(|| Ok(RunFolder::open(output, &settings, a.overwrite && job.first())?))?;
    let run = Run { method: Box::new(method), folder, settings, views: a.views.sets(), inputs, prefix: String::new() };
    let runs = [run];
    job.together(work(&runs, &shared, args.json, job))?;
    if a.shard.is_some() {
        println!("this shard is done; run again without --shard for the report");
        return Ok(());
    }
    let report = || {
        let report = report(&runs[0], &shared, &a.environment(&device))?;
        match args.json {
            true => println!("{}", serde_json::to_string_pretty(&report).map_err(CliError::input)?),
            false => print(&report, output),
        }
        let others = others(&report, &shared.commit);
        if !others.is_empty() {
            eprintln!(
                "some results are of other programs (commit {}; this one is {}): --overwrite makes them again",
                others.join(", "),
                shared.commit
            );
        }
        verdict([&report])
    };
    job.together(if job.first() { report() } else { Ok(()) })
}

/// Works on all cases, and says so on the screen; `quiet`: with a bar alone.
fn work(runs: &[Run], shared: &Shared, quiet: bool, job: &Job) -> Result<(), CliError> {
    if !job.first() {
        return Ok(freerange_eval::runner::work(runs, shared, &mut |_| {})?);
    }
    let mut bar = None;
    freerange_eval::runner::work(runs, shared, &mut |event| match event {
        Event::Cases { done, total, object } => {
            let bar = bar.get_or_insert_with(|| Progress::new("evaluating", total as u64));
            bar.at(done as u64, object);
        }
        Event::Record { run, record } => {
            if let (Some(bar), false) = (&bar, quiet) {
                bar.line(&line(run, record));
            }
        }
    })?;
    if let Some(bar) = bar {
        bar.finish();
    }
    Ok(())
}

/// What a finished run says on the screen.
fn print(report: &Report, output: &Path) {
    for group in report.groups.iter().filter(|g| g.measured > 0) {
        let mut text = format!("{}, {} inputs, {} objects:", group.views, group.inputs, group.measured);
        for (name, spread) in &group.metrics {
            let (label, factor, decimals) = style(name);
            text += &format!("  {label} {:.decimals$}", factor * spread.interval.mean);
        }
        if let Some(fid) = group.fid {
            text += &format!("  FID {fid:.2}");
        }
        if let Some(FrechetVgg { sample, mean, unseen_sample, unseen_mean, .. }) = group.frechet_vgg {
            let text_of = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.2}"));
            text += &format!("  Frechet (VGG16) {sample:.2}, unseen {}", text_of(unseen_sample));
            if mean.is_some() {
                text += &format!(", of means {}, unseen {}", text_of(mean), text_of(unseen_mean));
            }
        }
        println!("{text}  {:.1} s", group.seconds);
    }
    for (metric, reason) in &report.not_computed {
        println!("{metric} not computed: {reason}");
    }
    println!("{}", output.join("report.html").display());
}

/// The commits of other programs that results were taken from.
fn others<'a>(report: &'a Report, commit: &str) -> Vec<&'a str> {
    report.environment.commits.iter().map(String::as_str).filter(|other| *other != commit).collect()
}

/// An error if an object failed, or if there was nothing to measure.
fn verdict<'a>(reports: impl IntoIterator<Item = &'a Report>) -> Result<(), CliError> {
    let (mut measured, mut failed, mut skipped) = (0, Vec::new(), None);
    for report in reports {
        measured += report.measured().count();
        failed.extend(report.failures().map(|(case, reason)| format!("{case}: {reason}")));
        skipped = skipped.or_else(|| report.skipped().next().map(|(case, reason)| format!("{case}: {reason}")));
    }
    if let Some(first) = failed.first() {
        let count = failed.len();
        return Err(CliError::failure(format!("{count} of {} failed, first {first}", measured + count)));
    }
    match (measured, skipped) {
        (0, Some(first)) => {
            Err(CliError::input(format!("nothing to evaluate: every object was skipped, first {first}")))
        }
        _ => Ok(()),
    }
}
