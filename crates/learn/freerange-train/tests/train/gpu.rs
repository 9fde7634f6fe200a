//! Sampling and training on a GPU give what they give on the CPU.
#![cfg(any(feature = "cuda", feature = "metal", feature = "vulkan", feature = "webgpu"))]

use burn::tensor::{Device, DeviceType, Tensor};
use freerange_data::build::{Generated, MakingConfig};
use freerange_data::{Object, ObjectSource};
use freerange_diffusion::{photometric::Photometric, sample::FlowSampler};
use freerange_gaussians::{Normalization, Statistics};
use freerange_model::{Checkpoint, FreeRange};
use freerange_train::{batch::Batch, batch::step_rng, train, trainer::Trainer};
use std::{ops::ControlFlow, sync::Arc};

type TrainConfig = freerange_train::config::TrainConfig<MakingConfig>;

const SMALL: &str = r#"
seed = 3

[model]
image_size = 32
hidden = 32
blocks = 2
heads = 2
registers = 2
gaussians_per_token = 2
time_features = 32

[model.encoder]
kind = "patch"
patch_size = 8
channels = 4

[data]
window = 2
fresh = 0
workers = 1
statistics_objects = 1

[data.object]
views = 6
samples_per_axis = 1

[data.object.cameras]
resolution = 32

[data.object.surface]
points = 256

[loss]
held_views = 2
render_size = 32
gradient_size = 32
coupling = "tree"

[[stage]]
depth = 5
image_size = 32
batch = 2
steps = 2

[sample]
steps = 3
gradient_size = 32
coupling = "tree"
"#;

/// The first device of the API that the tests were built for.
fn gpu() -> Device {
    let kind = if cfg!(feature = "webgpu") { "webgpu" } else { "the GPU feature" };
    #[cfg(feature = "cuda")]
    let api = DeviceType::Cuda;
    #[cfg(all(feature = "metal", not(feature = "cuda")))]
    let api = DeviceType::Metal;
    #[cfg(all(feature = "vulkan", not(any(feature = "cuda", feature = "metal"))))]
    let api = DeviceType::Vulkan;
    #[cfg(all(feature = "webgpu", not(any(feature = "cuda", feature = "metal", feature = "vulkan"))))]
    let api = DeviceType::Wgpu;
    Device::enumerate(api).into_iter().next().unwrap_or_else(|| panic!("no device for {kind}"))
}

fn config() -> TrainConfig {
    let config: TrainConfig = toml::from_str(SMALL).unwrap();
    config.validate().unwrap();
    config
}

fn objects(config: &TrainConfig) -> Vec<Arc<Object>> {
    let source = Generated { config: config.data.making.object.clone(), depths: config.depths(), seed: 11 };
    (0..2).map(|i| Arc::new(source.object(i).unwrap())).collect()
}

fn normalization(objects: &[Arc<Object>]) -> Normalization {
    let mut statistics = Statistics::default();
    objects.iter().for_each(|o| statistics.add(o.slice(5).unwrap()).unwrap());
    statistics.normalization().unwrap()
}

/// Random weights, also where training starts with zeros: every path carries signal.
fn model(config: &TrainConfig, device: &Device) -> FreeRange {
    use rand::Rng;
    let rng = &mut step_rng(5, 0);
    let model = FreeRange::new(&config.model, rng, device).unwrap();
    let values: Vec<Vec<f32>> = model
        .parameters()
        .into_iter()
        .map(|p| p.values.iter().map(|v| v + rng.random_range(-0.05..0.05)).collect())
        .collect();
    model.set_parameters(&values).unwrap()
}

fn close(found: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(found.len(), expected.len());
    let largest = expected.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    let worst = found.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(largest > 0.0 && worst <= tolerance * largest, "off by {worst} of {largest}");
}

#[test]
fn gpu_samples_as_the_cpu_does() {
    let config = config();
    let objects = objects(&config);
    let views: Vec<_> = objects.iter().map(|o| &o.views[..4]).collect();
    let rows = |device: &Device| {
        let checkpoint = Checkpoint {
            config: config.model.clone(),
            model: model(&config, device),
            normalization: normalization(&objects),
            gradient_rms: [1e-3; 14],
            depth: 5,
            provenance: serde_json::Value::Null,
        };
        let sampler = FlowSampler { checkpoint: &checkpoint, config: &config.sample, device };
        let clouds = sampler.sample(&views, &[1, 2], |_| ControlFlow::Continue(())).unwrap();
        assert_eq!(clouds.len(), 4);
        clouds.iter().flat_map(|c| c.rows().to_vec()).collect::<Vec<f32>>()
    };
    close(&rows(&gpu()), &rows(&Device::flex()), 2e-3);
}

#[test]
fn gpu_has_the_loss_and_the_gradients_of_the_cpu() {
    let config = config();
    let objects = objects(&config);
    let run = |device: &Device, recompute: bool| {
        let model = model(&config, &device.clone().autodiff()).with_recompute(recompute);
        let normalization = normalization(&objects);
        let (stage, rng) = (&config.stages[0], &mut step_rng(9, 1));
        let batch = Batch::draw(&objects, stage, &config.model, &config.loss, &normalization, rng, device).unwrap();
        let photometric = Photometric::new(&normalization, device);
        let rms = Tensor::<3>::full([1, 1, 14], 1e-3, device);
        let losses = train::step(&model, batch, &photometric, &rms, &config.loss, device).unwrap();
        let mut out = vec![losses.total.clone().inner().into_scalar::<f32>()];
        let gradients = losses.total.backward();
        struct Collect<'a>(&'a burn::tensor::Gradients, Vec<f32>);
        impl burn::module::ModuleVisitor for Collect<'_> {
            fn visit_float<const D: usize>(&mut self, param: &burn::module::Param<Tensor<D>>) {
                if let Some(g) = param.val().grad(self.0) {
                    self.1.extend(g.into_data().try_to_vec::<f32>().unwrap());
                }
            }
        }
        let mut collect = Collect(&gradients, Vec::new());
        burn::module::Module::visit(&model, &mut collect);
        out.extend(collect.1);
        out
    };
    let expected = run(&Device::flex(), false);
    for recompute in [false, true] {
        let found = run(&gpu(), recompute);
        close(&found[..1], &expected[..1], 1e-3);
        close(&found[1..], &expected[1..], 5e-3);
    }
}

#[test]
fn gpu_trains_and_saves() {
    let folder = tempfile::tempdir().unwrap();
    let device = gpu();
    let mut trainer = Trainer::open(config(), folder.path(), None, &device, |_| {}).unwrap();
    let report = trainer.step().unwrap();
    assert!(report.loss.is_finite() && report.gradient_norm > 0.0);
    let path = trainer.save().unwrap();
    let on_the_cpu = Checkpoint::load(&path, &Device::flex()).unwrap();
    assert_eq!(on_the_cpu.model.parameters(), Checkpoint::load(&path, &device).unwrap().model.parameters());
}
