//! `freerange bench`

mod kernels;
mod sums;
mod timer;
mod whole;

use freerange::{Compute, DeviceInfo, DeviceName, internal::tensor_device};
use serde::Serialize;

use crate::{
    error::CliError,
    pipeline::parse_precision,
    ranks::{Job, Sums},
    runtime,
};

/// Benchmark a device: the rasterizer, a transformer block, sampling, training.
///
/// Prints Markdown tables with the machine, the commit and the command. Weights are random, objects generated. Times are
/// medians of synchronized calls.
#[derive(clap::Args)]
pub struct Args {
    /// Device: see `freerange devices`.
    #[arg(long, default_value = "auto")]
    device: DeviceName,
    /// All-reduce backend of --only sum.
    #[arg(long, value_enum, default_value_t)]
    sums: Sums,
    /// Parts to measure.
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = Part::ALL)]
    only: Vec<Part>,
    /// Configurations for block, sample and train: names or files [default: tiny; on a GPU tiny, base and paper].
    #[arg(long, value_delimiter = ',')]
    sizes: Vec<String>,
    /// Gaussians per object, for the rasterizer.
    #[arg(long, value_delimiter = ',', default_values_t = [2048, 8192, 50_000])]
    gaussians: Vec<usize>,
    /// Images per call, for the rasterizer.
    #[arg(long, value_delimiter = ',', default_values_t = [1, 4, 16, 64])]
    images: Vec<usize>,
    /// Image sizes in pixels, for the rasterizer.
    #[arg(long, value_delimiter = ',', default_values_t = [224, 512])]
    pixels: Vec<u32>,
    /// Euler steps of one sample from noise.
    #[arg(long, default_value_t = 50)]
    steps: usize,
    /// Objects per batch of samples from noise.
    #[arg(long, default_value_t = 1)]
    objects: usize,
    /// Precision of the transformer [default: bf16 where the device has it, else f32].
    #[arg(long, value_parser = parse_precision)]
    precision: Option<Compute>,
    /// Seconds per measurement, at least three calls.
    #[arg(long, default_value_t = 1.0)]
    seconds: f64,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// What can be measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Part {
    /// The rasterizer, forward and with its gradient.
    Raster,
    /// Attention and one transformer block.
    Block,
    /// Steps and whole samples from noise.
    Sample,
    /// Training steps.
    Train,
    /// All-reduce of a model's gradients over the launched processes, in f32 and bf16. Cannot be combined.
    Sum,
}

impl Part {
    const ALL: [Self; 4] = [Self::Raster, Self::Block, Self::Sample, Self::Train];
}

impl std::fmt::Display for Part {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Raster => "raster",
            Self::Block => "block",
            Self::Sample => "sample",
            Self::Train => "train",
            Self::Sum => "sum",
        })
    }
}

#[derive(Serialize)]
struct BenchReport {
    device: String,
    hardware: String,
    commit: String,
    version: &'static str,
    command: String,
    compute: Compute,
    /// TFLOP/s of a large matrix product in that arithmetic: what "share of peak" refers to.
    peak_tflops: f64,
    raster: Vec<kernels::Raster>,
    block: Vec<kernels::Block>,
    sample: Vec<whole::Sample>,
    train: Vec<whole::Train>,
}

pub fn run(args: &Args) -> Result<(), CliError> {
    if args.only.contains(&Part::Sum) {
        return sums::run(args);
    }
    let device = Job::alone().open(args.device)?;
    let DeviceInfo { name, gpu, properties, .. } = device.info();
    let tensors = tensor_device(&device);
    let compute = args.precision.unwrap_or(Compute::Auto).on(tensors);
    device.require(compute)?;
    let sizes = match args.sizes.is_empty() {
        false => args.sizes.clone(),
        true if gpu => ["tiny", "base", "paper"].map(String::from).to_vec(),
        true => vec!["tiny".into()],
    };
    let timer = timer::Timer { device: tensors.clone(), seconds: args.seconds };
    let mut report = BenchReport {
        device: name,
        hardware: properties.hardware,
        commit: runtime::commit(),
        version: env!("CARGO_PKG_VERSION"),
        command: std::env::args().collect::<Vec<_>>().join(" "),
        compute,
        peak_tflops: timer.peak(compute, gpu)?,
        raster: Vec::new(),
        block: Vec::new(),
        sample: Vec::new(),
        train: Vec::new(),
    };
    let out = Printer { quiet: args.json };
    out.line(&format!("device: {} ({})", report.device, report.hardware));
    out.line(&format!("program: freerange {}, commit {}", report.version, report.commit));
    out.line(&format!("command: {}", report.command));
    out.line(&format!("peak: {:.2} TFLOP/s in {compute:?} (a large matrix product)", report.peak_tflops));
    let wants = |part| args.only.contains(&part);
    if wants(Part::Raster) {
        out.header(&kernels::Raster::HEADER);
        for (&gaussians, &pixels) in args.gaussians.iter().flat_map(|n| args.pixels.iter().map(move |p| (n, p))) {
            for &images in &args.images {
                let line = kernels::raster(&timer, gaussians, images, pixels)?;
                out.row(&line.cells());
                report.raster.push(line);
            }
        }
    }
    if wants(Part::Block) {
        out.header(&kernels::Block::HEADER);
        for size in &sizes {
            let line = kernels::block(&timer, size, compute, report.peak_tflops)?;
            out.row(&line.cells());
            report.block.push(line);
        }
    }
    if wants(Part::Sample) {
        out.header(&whole::Sample::HEADER);
        for size in &sizes {
            let line = whole::sample(&timer, size, args.steps, args.objects, compute, report.peak_tflops)?;
            out.row(&line.cells());
            report.sample.push(line);
        }
    }
    if wants(Part::Train) && compute == Compute::F16 {
        eprintln!("training is left out: in f16, small gradients vanish");
    } else if wants(Part::Train) {
        out.header(&whole::Train::HEADER);
        for size in &sizes {
            for line in whole::train(&timer, size, compute, report.peak_tflops)? {
                out.row(&line.cells());
                report.train.push(line);
            }
        }
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report).map_err(CliError::input)?);
    }
    Ok(())
}

/// Writes tables as they grow, unless JSON is wanted.
struct Printer {
    quiet: bool,
}

impl Printer {
    fn line(&self, text: &str) {
        if !self.quiet {
            println!("{text}");
        }
    }

    fn header(&self, names: &[&str]) {
        self.line(&format!("\n| {} |\n|{}", names.join(" | "), "---|".repeat(names.len())));
    }

    fn row(&self, cells: &[String]) {
        self.line(&format!("| {} |", cells.join(" | ")));
    }
}

/// Milliseconds, three significant digits.
fn ms(seconds: f64) -> String {
    let ms = seconds * 1e3;
    match ms {
        x if x < 10.0 => format!("{x:.3}"),
        x if x < 1000.0 => format!("{x:.1}"),
        x => format!("{x:.0}"),
    }
}

/// Bytes that the device's allocator has reserved; none where it does not tell.
fn reserved(device: &burn::tensor::Device) -> Option<u64> {
    device.memory_pool_usage().map(|usage| usage.bytes_reserved)
}
