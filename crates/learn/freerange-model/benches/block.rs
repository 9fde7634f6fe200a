//! How fast attention and a whole transformer block are, ours against the same from Burn's own operations.
//!
//! `cargo bench -p freerange-model --bench block -- [--device cpu|gpu] [--size tiny|base|paper] [--compute f32|bf16|f16]
//! [--ours]`, with a feature such as `webgpu` for GPUs; on the CPU, at tiny size and in f32 unless told otherwise. `--ours`
//! leaves out Burn's way, whose attention needs memory for all scores at once when it is differentiated: at paper size, more
//! than most devices have.

use std::time::{Duration, Instant};

use burn::tensor::{Device, Tensor};
use freerange_model::{
    Compute, ModelConfig,
    bench::{Block, Way, noise},
};
use rand::SeedableRng;

#[path = "../../../../tools/machine.rs"]
mod machine;

/// A model's width and heads, and how many tokens its last stage has.
struct Size {
    name: &'static str,
    hidden: usize,
    heads: usize,
    ffn: usize,
    tokens: usize,
}

const SIZES: [Size; 3] = [
    Size { name: "tiny", hidden: 256, heads: 4, ffn: 640, tokens: 408 },
    Size { name: "base", hidden: 512, heads: 8, ffn: 2048, tokens: 1824 },
    Size { name: "paper", hidden: 1024, heads: 16, ffn: 4096, tokens: 9312 },
];

fn device(name: &str) -> Device {
    match name {
        "cpu" => Device::flex(),
        #[cfg(feature = "cuda")]
        "gpu" => Device::cuda(0),
        #[cfg(all(feature = "vulkan", not(feature = "cuda")))]
        "gpu" => Device::vulkan(burn::tensor::DeviceKind::DefaultDevice),
        #[cfg(all(feature = "metal", not(any(feature = "cuda", feature = "vulkan"))))]
        "gpu" => Device::metal(burn::tensor::DeviceKind::DefaultDevice),
        #[cfg(all(feature = "webgpu", not(any(feature = "cuda", feature = "vulkan", feature = "metal"))))]
        "gpu" => Device::wgpu(burn::tensor::DeviceKind::DefaultDevice),
        other => panic!("no device `{other}`: cpu, or gpu with one of the features cuda, vulkan, metal, webgpu"),
    }
}

/// Time of a call that ends with the device idle: the fastest tenth, since other programs may be running.
fn time(device: &Device, mut f: impl FnMut()) -> Duration {
    let mut call = || {
        let start = Instant::now();
        f();
        device.sync().expect("the device runs");
        start.elapsed()
    };
    call(); // compiles and tunes
    let (start, mut times) = (Instant::now(), vec![call()]);
    while times.len() < 5 || (times.len() < 1000 && start.elapsed() < Duration::from_secs(2)) {
        times.push(call());
        if start.elapsed() > Duration::from_secs(60) {
            break;
        }
    }
    times.sort();
    times[times.len() / 10]
}

/// Times of forward alone, and of forward and backward.
fn times(device: &Device, forward: impl Fn(&Device) -> Tensor<3>) -> [Duration; 2] {
    let plain = time(device, || drop(forward(device)));
    let autodiff = device.clone().autodiff();
    [plain, time(device, || drop(forward(&autodiff).sum().backward()))]
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let value = |name: &str| {
        let at = arguments.iter().position(|a| a == name)?;
        arguments.get(at + 1).map(String::as_str)
    };
    let device = device(value("--device").unwrap_or("cpu"));
    let compute = match value("--compute").unwrap_or("f32") {
        "f32" => Compute::F32,
        "bf16" => Compute::Bf16,
        "f16" => Compute::F16,
        other => panic!("no precision `{other}`: f32, bf16 or f16"),
    };
    assert!(compute.supported(&device), "{device:?} does not compute in {compute:?}");
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    println!("{}, {device:?}, {compute:?}", machine::machine(threads));
    println!("cargo bench -p freerange-model --bench block -- {}\n", arguments.join(" "));
    println!("| what | tokens | way | forward, ms | forward and backward, ms |\n|---|---|---|---|---|");

    for size in SIZES.iter().filter(|s| s.name == value("--size").unwrap_or("tiny")) {
        let config =
            ModelConfig { hidden: size.hidden, heads: size.heads, ffn: Some(size.ffn), ..ModelConfig::default() };
        let block = |device: &Device| {
            let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
            Block::new(&config, compute, &mut rng, device).expect("a valid configuration")
        };
        let (plain, trained) = (block(&device), block(&device.clone().autodiff()));
        let of = |on: &Device| if on.is_autodiff() { trained.clone() } else { plain.clone() };
        let (t, d) = (size.tokens, size.hidden);
        let (x, c, qkv) = (noise([1, t, d], &device), noise([1, d], &device), noise([1, t, 3 * d], &device));
        let on = |t: &Tensor<3>, device: &Device| {
            if device.is_autodiff() { Tensor::from_inner(t.clone()).require_grad() } else { t.clone() }
        };
        let c_on = |device: &Device| if device.is_autodiff() { Tensor::from_inner(c.clone()) } else { c.clone() };
        let ours = arguments.iter().any(|a| a == "--ours");
        let row = |what: &str, way: Way, [forward, both]: [Duration; 2]| {
            let ms = |d: Duration| d.as_secs_f64() * 1e3;
            println!("| {} {what} | {t} | {way:?} | {:.2} | {:.2} |", size.name, ms(forward), ms(both));
        };
        for way in [Way::Fused, Way::Burn] {
            if !(ours && way == Way::Burn) {
                row("attention", way, times(&device, |on_| of(on_).attention(way, on(&qkv, on_))));
            }
        }
        for way in [Way::Fused, Way::Recomputed, Way::Burn] {
            if !(ours && way == Way::Burn) {
                row("block", way, times(&device, |on_| of(on_).forward_by(way, on(&x, on_), c_on(on_))));
            }
        }
    }
}
