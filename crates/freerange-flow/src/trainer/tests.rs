use std::io::{Seek, SeekFrom, Write};

use freerange_build::{BuildOptions, Items, build};

use super::*;
use crate::sample::SampleConfig;

/// A model and objects of the smallest kind.
const SMALL: &str = r#"
seed = 5

[model]
image_size = 16
hidden = 16
blocks = 1
heads = 2
registers = 2
gaussians_per_token = 4
time_features = 8

[model.encoder]
kind = "patch"
patch_size = 8
channels = 4

[data]
window = 3
fresh = 1
workers = 2
statistics_objects = 2

[data.object]
views = 4
samples_per_axis = 1

[data.object.cameras]
resolution = 16

[data.object.surface]
points = 64

[data.shard]
objects_per_shard = 4
validation = 0.0
test = 0.0
min_psnr = 0.0

[loss]
held_views = 0
held = false
input_views = [2, 2]
render_size = 16
gradient_size = 16

[[stage]]
depth = 4
image_size = 16
batch = 2
steps = 40
"#;

fn config() -> TrainConfig {
    let config: TrainConfig = toml::from_str(SMALL).unwrap();
    config.validate().unwrap();
    config
}

fn open(config: &TrainConfig, folder: &Path, initial: Option<Initial>) -> Trainer {
    Trainer::open(config.clone(), folder, initial, &Device::flex(), |_| {}).unwrap()
}

/// Makes the next batch one that no loss can be computed of.
fn spoil(trainer: &mut Trainer) {
    let batch = trainer.ahead.as_mut().unwrap().as_mut().unwrap();
    batch.conditioning.images = batch.conditioning.images.clone().mul_scalar(f32::NAN);
}

fn numbers(weights: &Weights) -> Vec<f32> {
    weights.0.iter().flat_map(|w| w.clone().into_data().try_to_vec::<f32>().unwrap()).collect()
}

fn state(trainer: &Trainer) -> (Vec<f32>, Vec<f32>, [f32; channel::COUNT]) {
    (numbers(&Weights::of(&trainer.model)), numbers(&trainer.average), trainer.progress.gradient_square)
}

#[test]
fn a_step_that_is_not_finite_changes_nothing_and_training_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let mut trainer = open(&config(), folder.path(), None);
    trainer.step().unwrap();
    let before = state(&trainer);
    spoil(&mut trainer);
    let report = trainer.step().unwrap();
    assert!(report.loss.is_nan() && report.step == 2 && report.skipped == 1, "{report:?}");
    assert!(state(&trainer) == before);
    assert_eq!(serde_json::to_value(&report).unwrap()["loss"], serde_json::Value::Null);
    trainer.save().unwrap();

    let mut again = open(&config(), folder.path(), None);
    for trainer in [&mut trainer, &mut again] {
        let report = trainer.step().unwrap();
        assert!(report.loss.is_finite() && report.step == 3 && report.skipped == 1, "{report:?}");
    }
    assert!(state(&trainer) != before);
    assert!(state(&trainer) == state(&again));
}

#[test]
fn a_model_that_always_fails_ends_with_its_state() {
    let folder = tempfile::tempdir().unwrap();
    let mut trainer = open(&config(), folder.path(), None);
    trainer.step().unwrap();
    for _ in 1..NOT_FINITE_IN_A_ROW {
        spoil(&mut trainer);
        trainer.step().unwrap();
    }
    spoil(&mut trainer);
    let error = trainer.step().unwrap_err();
    assert!(matches!(error, FlowError::NotFinite { steps: NOT_FINITE_IN_A_ROW, last: 6, .. }), "{error}");
    trainer.save().unwrap();
    let mut again = open(&config(), folder.path(), None);
    let report = again.step().unwrap();
    assert!(report.loss.is_finite() && report.step == 7 && report.skipped == 5, "{report:?}");
}

#[test]
fn an_unreadable_object_is_left_out_and_the_run_can_be_resumed_around_it() {
    let place = tempfile::tempdir().unwrap();
    let path = |name: &str| place.path().join(name);
    let mut config = config();
    config.data.shards = Some(path("shards").to_str().unwrap().into());
    let store = Store::local(&path("shards"));
    build(&config.build_config(), &Items::generated(12, 1), &store, &BuildOptions::default(), |_| ()).unwrap();
    let shards = Shards::open(&store, &[4], Some(Split::Train)).unwrap().shuffled_by(config.seed);
    let broken = shards.id(4).to_owned();
    let of = |s: &&freerange_data::ShardRecord| s.objects.iter().any(|o| o.id == broken);
    let shard = shards.manifest().shards.iter().find(of).unwrap();
    let object = shard.objects.iter().find(|o| o.id == broken).unwrap();
    let mut file = std::fs::File::options().write(true).open(path("shards").join(shard.name())).unwrap();
    file.seek(SeekFrom::Start(object.offset)).unwrap();
    file.write_all(&vec![0xa5; object.bytes as usize]).unwrap();
    drop(file);

    let steps = |folder: &str, until: u64| {
        let mut trainer = open(&config, &path(folder), None);
        let mut reports = Vec::new();
        while trainer.step_count() < until {
            reports.push(trainer.step().map(|r| (r.step, r.loss)).unwrap());
        }
        trainer.save().unwrap();
        (reports, trainer.progress)
    };
    let (expected, end) = steps("whole", 7);
    assert_eq!((end.broken, end.first_object), (1, Some(8)), "objects 0 to 7 but for 4 have left the window");
    let mut found = Vec::new();
    for until in 1..=7 {
        found.extend(steps("pieces", until).0);
    }
    assert_eq!(found, expected);
    assert_eq!(steps("pieces", 7).1.broken, 1);
}

#[test]
fn a_run_keeps_what_its_initial_checkpoint_knows_of_gradients() {
    let [first, second, third] = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let mut trainer = open(&config(), first.path(), None);
    trainer.step().unwrap();
    trainer.save().unwrap();
    let path = first.path().join("checkpoint.safetensors");
    let mut checkpoint = Checkpoint::load(&path, &Device::flex()).unwrap();
    checkpoint.gradient_rms = [1e3; channel::COUNT];
    let mut trainer = open(&config(), second.path(), Some(Initial { checkpoint: &checkpoint, remeasure: false }));
    trainer.step().unwrap();
    // One batch has a hundredth of the say.
    for rms in trainer.gradient_rms() {
        assert!((0.99..1.01).contains(&(rms / (1e3 * GRADIENT_STATISTIC_DECAY.sqrt()))), "{rms}");
    }
    // What is divided by half as much has half the gradient.
    checkpoint.normalization.std = checkpoint.normalization.std.map(|s| 2.0 * s);
    let trainer = open(&config(), third.path(), Some(Initial { checkpoint: &checkpoint, remeasure: true }));
    for rms in trainer.gradient_rms() {
        assert!((rms - 500.0).abs() < 1.0, "{rms}");
    }
}

#[test]
fn training_in_f16_is_refused() {
    let mut config = config();
    config.optimizer.compute = Compute::F16;
    let error = config.validate().unwrap_err().to_string();
    assert!(error.contains("optimizer.compute") && error.contains("f16"), "{error}");
}

#[test]
fn a_run_finds_its_shards_from_any_folder() {
    let place = tempfile::tempdir().unwrap();
    let run = place.path().join("run");
    std::fs::create_dir_all(place.path().join("a/shards")).unwrap();
    std::fs::create_dir(&run).unwrap();
    let with = |shards: &str| {
        let shards = place.path().join(shards).to_str().unwrap().to_owned();
        TrainConfig { data: crate::config::DataConfig { shards: Some(shards), ..config().data }, ..config() }
    };
    check_same_run(&with("a/shards"), &run).unwrap();
    check_same_run(&with("run/../a/shards"), &run).unwrap();
    std::fs::create_dir(place.path().join("other")).unwrap();
    check_same_run(&with("other"), &run).unwrap_err();
    // A folder relative to the working directory is kept as one that is not.
    let kept = std::fs::read_to_string(run.join("config.toml")).unwrap();
    assert!(toml::from_str::<TrainConfig>(&kept).unwrap().data.shards.is_some_and(|s| Path::new(&s).is_absolute()));
}

#[test]
fn other_objects_are_measured_now_and_then_and_nothing_else_changes() {
    let place = tempfile::tempdir().unwrap();
    let mut measured = config();
    measured.validation = crate::ValidationConfig { every: 2, objects: 2 };
    measured.sample = SampleConfig { steps: 2, cfg_scale: 1.0, gradient_size: 16, ..SampleConfig::default() };
    let run = |name: &str, config: &TrainConfig, until: u64| {
        let mut trainer = open(config, &place.path().join(name), None);
        let (mut losses, mut found) = (Vec::new(), Vec::new());
        while trainer.step_count() < until {
            losses.push(trainer.step().unwrap().loss);
            let validated = trainer.validate().unwrap();
            assert_eq!(validated.is_some(), config.validation.every > 0 && trainer.step_count().is_multiple_of(2));
            found.extend(validated.map(|v| serde_json::to_value(&v).unwrap()));
        }
        trainer.save().unwrap();
        (losses, found, trainer.progress.best)
    };
    let (losses, found, best) = run("whole", &measured, 6);
    assert_eq!(run("without", &config(), 6).0, losses);
    let best = best.unwrap();
    let psnr = |v: &serde_json::Value| v["validation"]["psnr"].as_f64().unwrap();
    assert_eq!(best.psnr, found.iter().map(psnr).fold(f64::MIN, f64::max));
    assert!(psnr(&found[0]) != psnr(&found[1]) && found.iter().all(|v| psnr(v) > 3.0), "{found:?}");
    assert_eq!((found[2]["step"].as_u64(), found[2]["seen_samples"].as_u64()), (Some(6), Some(12)));
    let checkpoint = Checkpoint::load(&place.path().join("whole/best.safetensors"), &Device::flex()).unwrap();
    assert_eq!(checkpoint.provenance["steps"].as_u64(), Some(best.step));

    // Stopped between measurements, and resumed.
    let mut pieces = Vec::new();
    for until in [1, 3, 5, 6] {
        pieces.extend(run("pieces", &measured, until).1);
    }
    assert_eq!(pieces, found);

    // Shards have objects for it, or the run does not start.
    measured.data.shards = Some(place.path().join("shards").to_str().unwrap().into());
    let store = Store::local(&place.path().join("shards"));
    build(&measured.build_config(), &Items::generated(4, 1), &store, &BuildOptions::default(), |_| ()).unwrap();
    let failed = Trainer::open(measured, &place.path().join("none"), None, &Device::flex(), |_| {}).err().unwrap();
    assert!(failed.to_string().contains("Validation"), "{failed}");
    assert!(!place.path().join("none").exists());
}

#[test]
fn the_frozen_encoder_is_neither_averaged_nor_optimised_nor_saved() {
    let place = tempfile::tempdir().unwrap();
    let golden = freerange_vectors::path("dino/mlp_img56");
    let weights = EncoderWeights { name: "golden".into(), folder: golden.clone() };
    let mut config = config();
    let encoder = Dinov2::load(&golden, &Device::flex()).unwrap();
    config.model.encoder = EncoderConfig::Dinov2(encoder.config().clone());
    config.model.image_size = 28;
    config.stages[0].image_size = 28;
    let open =
        || Trainer::open_with(config.clone(), place.path(), None, Some(&weights), &Device::flex(), |_| {}).unwrap();
    let mut trainer = open();
    trainer.step().unwrap();
    let trained = trainer.model().parameters();
    assert!(trained.iter().all(|p| p.name.starts_with("dit.")));
    assert_eq!(trainer.average.0.len(), trained.len());
    assert!(trainer.model().encoder().dinov2().is_none());
    let path = trainer.save().unwrap();

    // What is used is what the file holds, and a run that goes on has it again.
    let loaded = Checkpoint::load_with_dinov2(&path, encoder.clone(), &Device::flex()).unwrap();
    assert_eq!(loaded.model.encoder().dinov2().unwrap().origin().unwrap().sha256, encoder.origin().unwrap().sha256);
    let image = Tensor::<4>::ones([1, 3, 28, 28], &Device::flex()).mul_scalar(0.3);
    let features = |e: &Dinov2, image: Tensor<4>| e.patch_features(image).into_data().try_to_vec::<f32>().unwrap();
    let mut again = open();
    let frozen = again.frozen.clone().unwrap();
    assert_eq!(features(&frozen, image.clone()), features(&encoder, image));
    let (a, b) = (trainer.step().unwrap(), again.step().unwrap());
    assert_eq!((a.loss, a.gradient_norm), (b.loss, b.gradient_norm));
    assert!(state(&trainer) == state(&again));
}

/// The gradient of a step is the mean over its parts, each by its share of the objects.
#[test]
fn a_batch_may_be_computed_in_parts() {
    let place = tempfile::tempdir().unwrap();
    let with = |batch: usize, micro_batch: Option<usize>| {
        let mut config = config();
        config.stages[0].batch = batch;
        config.stages[0].micro_batch = micro_batch;
        config.validate().unwrap();
        config
    };
    let steps = |name: &str, config: &TrainConfig, until: u64| {
        let mut trainer = open(config, &place.path().join(name), None);
        let mut found = Vec::new();
        while trainer.step_count() < until {
            let report = trainer.step().unwrap();
            found.push((report.step, report.loss, report.gradient_norm));
        }
        trainer.save().unwrap();
        (found, state(&trainer))
    };
    // All at once is all at once, however it is said.
    assert!(steps("none", &with(3, None), 3) == steps("all", &with(3, Some(3)), 3));

    // Two objects and then one, by hand.
    let config = with(3, Some(2));
    let mut trainer = open(&config, &place.path().join("by hand"), None);
    let rms = Tensor::<1>::from_floats(trainer.gradient_rms(), &trainer.device).reshape([1, 1, channel::COUNT]);
    let mut sums: Vec<f32> = Vec::new();
    let mut loss = 0.0;
    for (part, share) in [(0, 2.0 / 3.0), (1, 1.0 / 3.0)] {
        let batch = trainer.draw(0, part).unwrap();
        assert_eq!(batch.t.len(), 2 - part);
        let (photometric, config) = (&trainer.photometric, &config.loss);
        let losses = train::step(trainer.model(), batch, photometric, &rms, config, &trainer.device).unwrap();
        loss += share * losses.total.clone().into_data().try_to_vec::<f32>().unwrap()[0];
        let gradients = Flat::of(&mut losses.total.backward(), trainer.model()).values();
        sums.resize(gradients.len(), 0.0);
        sums.iter_mut().zip(gradients).for_each(|(sum, g)| *sum += share * g);
    }
    let norm = sums.iter().map(|g| g * g).sum::<f32>().sqrt();
    let (found, end) = steps("parts", &config, 4);
    assert!((found[0].1 - loss).abs() < 1e-5 * loss.abs(), "{found:?} {loss}");
    assert!((found[0].2 - norm).abs() < 1e-4 * norm, "{found:?} {norm}");

    // Stopped and resumed as if never stopped.
    let mut pieces = Vec::new();
    for until in 1..=4 {
        pieces.extend(steps("pieces", &config, until).0);
    }
    assert_eq!(pieces, found);
    assert!(steps("pieces", &config, 4).1 == end);
}
