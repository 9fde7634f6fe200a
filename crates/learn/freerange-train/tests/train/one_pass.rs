//! Models that predict in one pass are trained, saved, resumed and asked for Gaussians like the flow's.

use std::{ops::ControlFlow, path::Path};

use burn::tensor::Device;
use freerange_data::ObjectSource;
use freerange_data::build::{Generated, MakingConfig};
use freerange_diffusion::sample::{FlowConfig, FlowSampler};
use freerange_model::Checkpoint;
use freerange_optim::psnr_over_white;
use freerange_scene::camera::View;
use freerange_train::{TrainError, trainer::Trainer};

type TrainConfig = freerange_train::config::TrainConfig<MakingConfig>;

const KINDS: [&str; 3] = [
    "kind = \"latent_tokens\"\nlatent_tokens = 32",
    "kind = \"pixel_aligned\"",
    "kind = \"voxel_aligned\"\nvolume = { tokens_per_side = 3, cells_per_token_side = 2, gaussians_per_cell = 1 }",
];

const CONFIG: &str = r#"
seed = 3

[model]
KIND
image_size = 32
hidden = 48
blocks = 2
heads = 2
registers = 2
gaussians_per_token = 2
gradient_channels = false

[model.encoder]
kind = "patch"
patch_size = 8
channels = 4

[data]
window = 1
fresh = 0
workers = 1
statistics_objects = 1

[data.object]
views = 8
samples_per_axis = 1

[data.object.cameras]
resolution = 32

[data.object.surface]
points = 512

[loss]
flow = false
unconditional = 0.0
input_views = [2, 4]
held_views = 2
render_size = 32

[optimizer]
learning_rate = 1e-3
final_learning_rate = 1e-4
warmup = 10
ema = 0.9

[[stage]]
depth = 6
image_size = 32
batch = 4
steps = STEPS

[sample]
steps = 1
cfg_scale = 1.0
lambda_pg = 0.0
"#;

fn config(kind: &str, steps: u64) -> TrainConfig {
    toml::from_str(&CONFIG.replace("KIND", kind).replace("STEPS", &steps.to_string())).unwrap()
}

fn train(config: &TrainConfig, folder: &Path, stop_at: u64) -> Checkpoint {
    let mut trainer = Trainer::open(config.clone(), folder, None, &Device::flex(), |_| {}).unwrap();
    while trainer.step_count() < stop_at {
        trainer.step().unwrap();
    }
    Checkpoint::load(&trainer.save().unwrap(), &Device::flex()).unwrap()
}

/// Input views and others of the object that is trained on.
fn views(config: &TrainConfig) -> (Vec<View>, Vec<View>) {
    let making = config.data.making.object.clone();
    let object = Generated { config: making, depths: vec![6], seed: config.seed.wrapping_mul(1 << 32) }.object(0);
    let mut views = object.unwrap().views;
    let others = views.split_off(3);
    (views, others)
}

#[test]
fn each_kind_learns_an_object() {
    // Until it has found where to be opaque, a model of many faint Gaussians is best when it shows nothing.
    for (kind, steps) in KINDS.into_iter().zip([100, 200, 300]) {
        let config = config(kind, steps);
        config.validate().unwrap();
        let folder = tempfile::tempdir().unwrap();
        let (inputs, others) = views(&config);
        let quality = |checkpoint: &Checkpoint| {
            let mut told = 0;
            let sampler = FlowSampler { checkpoint, config: &config.sample, device: &Device::flex() };
            let found = sampler.sample(&[&inputs], &[0], |estimate| {
                told += estimate.clouds().unwrap().len();
                ControlFlow::Continue(())
            });
            let found = found.unwrap();
            assert_eq!((told, found.len()), (1, 1));
            assert_eq!(found[0].len(), checkpoint.config.gaussians(6, inputs.len()));
            psnr_over_white(&found[0], &others).unwrap()
        };
        let before = quality(&train(&config, folder.path(), 1));
        let after = quality(&train(&config, folder.path(), steps));
        assert!(after > before + 2.0, "{kind}: {before:.2} dB, {after:.2} dB");
    }
}

#[test]
fn each_kind_resumes_as_if_never_stopped() {
    for kind in KINDS {
        let config = config(kind, 6);
        let [whole, halves] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let expected = train(&config, whole.path(), 6).model.parameters();
        train(&config, halves.path(), 3);
        assert!(train(&config, halves.path(), 6).model.parameters() == expected, "{kind}");
    }
}

#[test]
fn settings_of_the_flow_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let config = config(KINDS[1], 1);
    let checkpoint = train(&config, folder.path(), 1);
    let (inputs, _) = views(&config);
    let sample = |sample: FlowConfig, seeds: &[u64]| {
        let sampler = FlowSampler { checkpoint: &checkpoint, config: &sample, device: &Device::flex() };
        sampler.sample(&[&inputs], seeds, |_| ControlFlow::Continue(())).unwrap_err().to_string()
    };
    let own = || config.sample.clone();
    for (field, found) in [
        ("sample.steps", sample(FlowConfig { steps: 50, ..own() }, &[0])),
        ("sample.cfg_scale", sample(FlowConfig { cfg_scale: 2.0, ..own() }, &[0])),
        ("sample.lambda_pg", sample(FlowConfig { lambda_pg: 1.0, ..own() }, &[0])),
        ("sample.lod_depth", sample(FlowConfig { lod_depth: Some(5), ..own() }, &[0])),
        ("seeds", sample(own(), &[0, 1])),
    ] {
        assert!(found.contains(field) && found.contains("pixel_aligned"), "{field}: {found}");
    }
    let loss = |change: &dyn Fn(&mut TrainConfig)| {
        let mut config = self::config(KINDS[0], 1);
        change(&mut config);
        config.validate().map_err(|e: TrainError| e.to_string()).unwrap_err()
    };
    for (field, found) in [
        ("loss.flow", loss(&|c| c.loss.flow = true)),
        ("loss.unconditional", loss(&|c| c.loss.unconditional = 0.1)),
        ("sample.steps", loss(&|c| c.sample.steps = 4)),
        ("refiner", loss(&|c| c.refiner = Some(Default::default()))),
        ("stage.depth", loss(&|c| c.stages[0].depth = 5)),
        ("loss: expected at least one term", loss(&|c| (c.loss.seen, c.loss.held) = (false, false))),
    ] {
        assert!(found.contains(field), "{field}: {found}");
    }
}
