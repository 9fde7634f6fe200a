//! Whole runs: they go on as if never stopped, whatever stops them, and refuse what they cannot use.

use std::{
    io::{Seek, SeekFrom, Write},
    path::Path,
};

use burn::tensor::Tensor;
use freerange_data::build::{BuildConfig, BuildOptions, Items, MakingConfig, build};
use freerange_data::{Shards, Split, Store};
use freerange_model::EncoderConfig;

use super::{
    folder::claim,
    step::{GRADIENT_STATISTIC_DECAY, NO_GRADIENT_IN_A_ROW, NOT_FINITE_IN_A_ROW},
    *,
};
use crate::{
    config::{DataConfig, Stage},
    flat::Flat,
    ranks::threads::among,
    train,
};
use freerange_diffusion::sample::{FlowConfig, RefinerConfig};
use glam::DMat4;

type TrainConfig = crate::config::TrainConfig<MakingConfig>;

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

/// How shards for it are made.
fn build_config(config: &TrainConfig) -> BuildConfig {
    config.data.making.build_config(config.seed, &config.depths())
}

fn open(config: &TrainConfig, folder: &Path, initial: Option<Initial>) -> Trainer {
    Trainer::open(config.clone(), folder, initial, &Device::flex(), |_| {}).unwrap()
}

/// Measures, if that is due; nobody asks to end meanwhile.
fn validate(trainer: &mut Trainer) -> Option<Validated> {
    trainer.validate().unwrap().continue_value().unwrap()
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

    let third = |mut trainer: Trainer| {
        let report = trainer.step().unwrap();
        assert!(report.loss.is_finite() && report.step == 3 && report.skipped == 1, "{report:?}");
        state(&trainer)
    };
    let after = third(trainer);
    assert!(after != before);
    assert!(after == third(open(&config(), folder.path(), None)));
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
    assert!(matches!(error, TrainError::NotFinite { steps: NOT_FINITE_IN_A_ROW, last: 6, .. }), "{error}");
    trainer.save().unwrap();
    drop(trainer);
    let mut again = open(&config(), folder.path(), None);
    let report = again.step().unwrap();
    assert!(report.loss.is_finite() && report.step == 7 && report.skipped == 5, "{report:?}");
}

/// Of one pass, whose losses are renders alone: of cameras that look away they have no gradient.
#[test]
fn a_model_without_gradients_ends_with_its_state() {
    let text = SMALL
        .replace("[model]", "[model]\nkind = \"latent_tokens\"\nlatent_tokens = 4\ngradient_channels = false")
        .replace("held_views = 0\nheld = false", "flow = false\nunconditional = 0.0\nheld_views = 1")
        .replace("steps = 40", "steps = 100");
    let text = format!("{text}\n[sample]\nsteps = 1\ncfg_scale = 1.0\nlambda_pg = 0.0\n");
    let config: TrainConfig = toml::from_str(&text).unwrap();
    config.validate().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let mut trainer = open(&config, folder.path(), None);
    let looking_away = |trainer: &mut Trainer| {
        let batch = trainer.ahead.as_mut().unwrap().as_mut().unwrap();
        let targets = [Some(&mut batch.seen), batch.held.as_mut()].into_iter().flatten();
        for camera in targets.flat_map(|targets| targets.cameras.iter_mut().flatten()) {
            camera.world_to_camera = DMat4::from_rotation_y(std::f64::consts::PI) * camera.world_to_camera;
        }
        trainer.step()
    };
    assert!(trainer.step().unwrap().gradient_norm > 0.0);
    for _ in 0..2 {
        // A step with gradients begins the count again.
        for _ in 1..NO_GRADIENT_IN_A_ROW {
            assert_eq!(looking_away(&mut trainer).unwrap().gradient_norm, 0.0);
        }
        assert!(trainer.step().unwrap().gradient_norm > 0.0);
    }
    (1..NO_GRADIENT_IN_A_ROW).for_each(|_| drop(looking_away(&mut trainer).unwrap()));
    let error = looking_away(&mut trainer).unwrap_err();
    assert!(matches!(error, TrainError::NoGradient { steps: NO_GRADIENT_IN_A_ROW, .. }), "{error}");
    trainer.save().unwrap();
}

#[test]
fn an_unreadable_object_is_left_out_and_the_run_can_be_resumed_around_it() {
    let place = tempfile::tempdir().unwrap();
    let path = |name: &str| place.path().join(name);
    let mut config = config();
    config.data.shards = Some(path("shards").to_str().unwrap().into());
    let store = Store::local(&path("shards"));
    build(&build_config(&config), &Items::generated(12, 1), &store, &BuildOptions::default(), |_| ()).unwrap();
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
fn a_run_may_be_told_where_gaussians_lie_that_its_initial_checkpoint_was_not() {
    let [first, second, third] = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let mut narrow = config();
    narrow.model.estimate_channels = true;
    narrow.model.observation_channels = true;
    let mut wide = narrow.clone();
    wide.model.place_channels = true;
    let begun = |config: &TrainConfig, folder: &Path, from: Option<&Path>| {
        let path = from.map(|from| from.join("checkpoint.safetensors"));
        let checkpoint = path.map(|path| Checkpoint::load(&path, &Device::flex()).unwrap());
        let initial = checkpoint.as_ref().map(|checkpoint| Initial { checkpoint, remeasure: false });
        let trainer = Trainer::open(config.clone(), folder, initial, &Device::flex(), |_| {})?;
        trainer.save()?;
        Ok::<_, TrainError>(numbers(&Weights::of(&trainer.model)))
    };
    let before = begun(&narrow, first.path(), None).unwrap();
    let after = begun(&wide, second.path(), Some(first.path())).unwrap();
    let more = narrow.model.hidden * narrow.model.gaussians_per_token * freerange_model::PLACE;
    assert_eq!(after.len(), before.len() + more);
    let told = |values: &[f32]| values.iter().copied().filter(|&x| x != 0.0).collect::<Vec<f32>>();
    assert_eq!(told(&after), told(&before), "what it does not know of weighs nothing");
    let refused = begun(&narrow, third.path(), Some(second.path())).unwrap_err().to_string();
    assert!(refused.contains("architecture of the initial checkpoint"), "{refused}");
}

#[test]
fn training_in_f16_is_refused() {
    let mut config = config();
    config.optimizer.compute = Compute::F16;
    let error = config.validate().unwrap_err().to_string();
    assert!(error.contains("optimizer.compute") && error.contains("f16"), "{error}");
}

#[test]
fn an_optimizer_that_cannot_take_a_step_is_refused() {
    let refused = |text: &str| {
        let field = text.split(" =").next().unwrap();
        let config = SMALL.replace("[[stage]]", &format!("[optimizer]\n{text}\n\n[[stage]]"));
        let config: TrainConfig = toml::from_str(&config).unwrap();
        let error = config.validate().unwrap_err().to_string();
        assert!(error.contains(&format!("optimizer.{field}: expected")), "{text}: {error}");
    };
    for bad in ["betas = [1.0, 0.95]", "betas = [0.9, 1.0]", "betas = [-0.1, 0.9]", "betas = [nan, 0.9]"] {
        refused(bad);
    }
    refused("learning_rate = nan");
    refused("learning_rate = inf");
    refused("final_learning_rate = -1e-6");
    refused("weight_decay = nan");
    refused("weight_decay = -0.01");
    refused("clip = nan");
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
    claim(&with("a/shards"), &run).unwrap();
    claim(&with("run/../a/shards"), &run).unwrap();
    std::fs::create_dir(place.path().join("other")).unwrap();
    claim(&with("other"), &run).unwrap_err();
    // A folder relative to the working directory is kept as one that is not.
    let kept = std::fs::read_to_string(run.join("config.toml")).unwrap();
    assert!(toml::from_str::<TrainConfig>(&kept).unwrap().data.shards.is_some_and(|s| Path::new(&s).is_absolute()));
}

#[test]
fn other_objects_are_measured_now_and_then_and_nothing_else_changes() {
    let place = tempfile::tempdir().unwrap();
    let mut measured = config();
    measured.validation = crate::ValidationConfig { every: 2, objects: 2 };
    measured.sample = FlowConfig { steps: 2, cfg_scale: 1.0, gradient_size: 16, ..FlowConfig::default() };
    let run = |name: &str, config: &TrainConfig, until: u64| {
        let mut trainer = open(config, &place.path().join(name), None);
        let (mut losses, mut found) = (Vec::new(), Vec::new());
        while trainer.step_count() < until {
            losses.push(trainer.step().unwrap().loss);
            let validated = validate(&mut trainer);
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
    build(&build_config(&measured), &Items::generated(4, 1), &store, &BuildOptions::default(), |_| ()).unwrap();
    let failed = Trainer::open(measured, &place.path().join("none"), None, &Device::flex(), |_| {}).err().unwrap();
    assert!(failed.to_string().contains("Validation"), "{failed}");
    assert!(!place.path().join("none").exists());
}

#[test]
fn the_frozen_encoder_is_neither_averaged_nor_optimized_nor_saved() {
    let place = tempfile::tempdir().unwrap();
    let golden = freerange_vectors::path("dino/mlp_img56");
    let weights = freerange_model::EncoderWeights { name: "golden".into(), folder: golden.clone() };
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
    let next = |mut trainer: Trainer| {
        let report = trainer.step().unwrap();
        (report.loss, report.gradient_norm, state(&trainer))
    };
    let expected = next(trainer);
    let again = open();
    let frozen = again.frozen.clone().unwrap();
    assert_eq!(features(&frozen, image.clone()), features(&encoder, image));
    assert!(next(again) == expected);
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

/// Shards of objects for a configuration, and that with them: they are read in no time.
fn with_shards(mut config: TrainConfig, place: &Path) -> TrainConfig {
    let store = Store::local(&place.join("shards"));
    build(&build_config(&config), &Items::generated(40, 1), &store, &BuildOptions::default(), |_| ()).unwrap();
    config.data.shards = Some(place.join("shards").to_str().unwrap().into());
    config
}

/// Four virtual ranks, two stages with different batches, depths and parts, objects that come and go, validation.
fn in_virtual_ranks() -> TrainConfig {
    let mut config = config();
    config.data = DataConfig { virtual_ranks: 4, window: 12, fresh: 4, ..config.data };
    config.stages[0] = Stage { depth: 3, batch: 8, micro_batch: Some(1), steps: 5, ..config.stages[0].clone() };
    config.stages.push(Stage { depth: 4, batch: 4, micro_batch: None, steps: 25, ..config.stages[0].clone() });
    config.validation = crate::ValidationConfig { every: 4, objects: 3 };
    config.sample = FlowConfig { steps: 1, cfg_scale: 1.0, gradient_size: 16, ..FlowConfig::default() };
    config.validate().unwrap();
    config
}

fn open_among(ranks: Rc<dyn Ranks>, config: &TrainConfig, folder: &Path) -> Result<Trainer, TrainError> {
    let among = Among { ranks, identity: vec![("program".into(), "this one".into())] };
    Trainer::open_among(among, config.clone(), folder, None, None, &Device::flex(), |_| {})
}

/// What a rank reports: losses and norms of the steps, figures of validations, checksums and positions at the end.
type Told = (Vec<[f32; 5]>, Vec<Figures>, [String; 2], Vec<u64>);

/// Goes on in `folder` until a step, with so many ranks; what each of them has to say.
fn told(world: usize, config: &TrainConfig, folder: &Path, until: u64) -> Vec<Told> {
    among(world, |ranks| {
        let mut trainer = open_among(ranks.clone(), config, folder).unwrap();
        assert_eq!(trainer.virtual_ranks.len(), config.data.virtual_ranks / world);
        let (mut steps, mut figures) = (Vec::new(), Vec::new());
        while trainer.step_count() < until {
            let r = trainer.step().unwrap();
            assert_eq!(r.rank_seconds.len(), if world > 1 { world } else { 0 });
            steps.push([r.loss, r.flow, r.seen, r.held, r.gradient_norm]);
            // Pictures are of a rank's own objects.
            figures.extend(validate(&mut trainer).map(|v| Figures { pictures: Vec::new(), ..v.validation }));
        }
        trainer.save().unwrap();
        let checksums = [Weights::of(&trainer.model).checksum(), trainer.average.checksum()];
        (steps, figures, checksums, trainer.progress.first_objects.clone())
    })
}

fn close(found: &[[f32; 5]], expected: &[[f32; 5]]) {
    assert_eq!(found.len(), expected.len());
    for (step, (a, b)) in found.iter().zip(expected).enumerate() {
        for (a, b) in a.iter().zip(b) {
            assert!((a - b).abs() <= 1e-5 * b.abs().max(1e-3), "step {step}: {a} and {b}: {found:?} {expected:?}");
        }
    }
}

#[test]
fn any_number_of_ranks_trains_the_same() {
    let place = tempfile::tempdir().unwrap();
    let mut config = in_virtual_ranks();
    config.data.making.shard.validation = 0.2;
    let config = with_shards(config, place.path());
    let alone = told(1, &config, &place.path().join("1"), 20).remove(0);
    assert!(alone.0.iter().any(|step| step[0] != alone.0[0][0]) && alone.1.len() == 5);
    for world in [2, 4] {
        let all = told(world, &config, &place.path().join(world.to_string()), 20);
        for rank in &all {
            assert!(*rank == all[0], "ranks have come apart");
        }
        close(&all[0].0, &alone.0);
        assert_eq!(all[0].3, alone.3);
        for (a, b) in all[0].1.iter().zip(&alone.1) {
            assert!((a.psnr - b.psnr).abs() < 1e-3 && a.samples == b.samples, "{a:?} {b:?}");
            assert!((a.flow - b.flow).abs() < 1e-4 * b.flow, "{a:?} {b:?}");
        }
    }
    // From one to two, to one, to four: as if never changed.
    let folder = place.path().join("changing");
    let (mut steps, mut last) = (Vec::new(), None);
    for (world, until) in [(1, 3), (2, 7), (1, 11), (4, 16), (2, 20)] {
        let rank = told(world, &config, &folder, until).remove(0);
        steps.extend(rank.0);
        last = Some(rank.3);
    }
    close(&steps, &alone.0);
    assert_eq!(last, Some(alone.3));
    // The same number of ranks, stopped and resumed: to the bit.
    let whole = told(2, &config, &place.path().join("2"), 24).remove(0);
    let folder = place.path().join("pieces");
    let pieces = [9, 20, 24].map(|until| told(2, &config, &folder, until).remove(0));
    assert_eq!(pieces[2].2, whole.2);
}

#[test]
fn an_object_that_one_rank_cannot_read_is_left_out_on_all() {
    let place = tempfile::tempdir().unwrap();
    let path = |name: &str| place.path().join(name);
    let mut config = in_virtual_ranks();
    config.validation.every = 0;
    let config = with_shards(config, place.path());
    let shards =
        Shards::open(&Store::local(&path("shards")), &[3, 4], Some(Split::Train)).unwrap().shuffled_by(config.seed);
    let broken = shards.id(13).to_owned();
    let of = |s: &&freerange_data::ShardRecord| s.objects.iter().any(|o| o.id == broken);
    let shard = shards.manifest().shards.iter().find(of).unwrap();
    let object = shard.objects.iter().find(|o| o.id == broken).unwrap();
    let mut file = std::fs::File::options().write(true).open(path("shards").join(shard.name())).unwrap();
    file.seek(SeekFrom::Start(object.offset)).unwrap();
    file.write_all(&vec![0xa5; object.bytes as usize]).unwrap();
    drop(file);
    let run = |world: usize, folder: &str, until: u64| {
        let found = among(world, |ranks| {
            let mut trainer = open_among(ranks, &config, &path(folder)).unwrap();
            let mut reports = Vec::new();
            while trainer.step_count() < until {
                let r = trainer.step().unwrap();
                reports.push([r.loss, r.flow, r.seen, r.held, r.gradient_norm]);
            }
            trainer.save().unwrap();
            (reports, trainer.progress.broken, trainer.progress.first_objects.clone())
        });
        found.into_iter().next().unwrap()
    };
    let alone = run(1, "1", 6);
    // VirtualRank 1 is one object ahead of the others.
    assert_eq!((alone.1, &alone.2[..]), (1, &[24, 29, 26, 27][..]));
    let two = run(2, "2", 6);
    close(&two.0, &alone.0);
    assert_eq!((two.1, two.2), (alone.1, alone.2.clone()));
    let mut pieces = run(2, "pieces", 2).0;
    pieces.extend(run(4, "pieces", 5).0);
    let last = run(1, "pieces", 6);
    pieces.extend(last.0);
    close(&pieces, &alone.0);
    assert_eq!((last.1, last.2), (alone.1, alone.2));
}

#[test]
fn where_one_rank_fails_all_stop_at_the_same_step_and_can_go_on() {
    let place = tempfile::tempdir().unwrap();
    let config = in_virtual_ranks();
    let found = among(2, |ranks| {
        let mut trainer = open_among(ranks.clone(), &config, &place.path().join("run")).unwrap();
        (0..3).for_each(|_| drop(trainer.step().unwrap()));
        if ranks.rank() == 1 {
            trainer.ahead = Some(Err(TrainError::NoViews));
        }
        let error = trainer.step().unwrap_err();
        trainer.save().unwrap();
        (error, trainer.step_count())
    });
    assert!(matches!(found[0], (TrainError::Elsewhere { rank: 1 }, 3)), "{:?}", found[0]);
    assert!(matches!(found[1], (TrainError::NoViews, 3)), "{:?}", found[1]);
    let again = told(2, &config, &place.path().join("run"), 6).remove(0);
    let never = told(2, &config, &place.path().join("never"), 6).remove(0);
    assert_eq!((&again.2, &again.3), (&never.2, &never.3));
}

#[test]
fn ranks_that_cannot_train_together_are_refused() {
    let place = tempfile::tempdir().unwrap();
    let refused = |world: usize, change: fn(&mut TrainConfig)| {
        let found = among(world, |ranks| {
            let mut config = in_virtual_ranks();
            if ranks.rank() + 1 == world {
                change(&mut config);
            }
            open_among(ranks, &config, &place.path().join("run")).err().expect("refused").to_string()
        });
        assert!(!place.path().join("run").exists());
        found
    };
    for text in refused(3, |_| ()) {
        assert_eq!(text, "data.virtual_ranks: expected a multiple of the number of ranks, 3, found 4");
    }
    for text in refused(2, |config| config.loss.seen = false) {
        assert!(
            text.starts_with("rank 1: configuration: expected ") && text.contains(" as on rank 0, found "),
            "{text}"
        );
    }
    let found = refused(2, |config| config.data.shards = Some("/nowhere/at/all".into()));
    assert!(found[0] == "rank 1 has failed" && found[1].contains("/nowhere/at/all"), "{found:?}");
}

#[test]
fn all_ranks_stop_when_one_is_to_and_weights_that_came_apart_are_told() {
    let place = tempfile::tempdir().unwrap();
    let config = in_virtual_ranks();
    among(2, |ranks| {
        let mut trainer = open_among(ranks.clone(), &config, &place.path().join("run")).unwrap();
        assert!(!trainer.step().unwrap().stop);
        if ranks.rank() == 1 {
            trainer.stop_when(|| true);
        }
        assert!(trainer.step().unwrap().stop);
        trainer.save().unwrap();
        if ranks.rank() == 1 {
            trainer.average.0[0] = trainer.average.0[0].clone() + 1e-3;
        }
        let error = trainer.save().unwrap_err().to_string();
        assert!(error.contains("rank 1: averaged weights after step 2"), "{error}");
    });
}

#[test]
fn virtual_ranks_divide_batch_and_window() {
    let refused = |change: fn(&mut TrainConfig)| {
        let mut config = in_virtual_ranks();
        change(&mut config);
        config.validate().unwrap_err().to_string()
    };
    let found = [
        refused(|c| c.data.window = 10),
        refused(|c| c.data.fresh = 2),
        refused(|c| c.stages[1].batch = 6),
        refused(|c| c.data.virtual_ranks = 0),
    ];
    assert_eq!(found[0], "data.window: expected a multiple of data.virtual_ranks, 4, found 10");
    assert_eq!(found[1], "data.fresh: expected a multiple of data.virtual_ranks, 4, found 2");
    assert_eq!(found[2], "stage.batch: expected a multiple of data.virtual_ranks, 4, found 6");
    assert_eq!(found[3], "data.virtual_ranks: expected 1 to 4096, found 0");
}

/// A run whose model refines initial fits, on objects that have none.
fn from_fits() -> TrainConfig {
    let mut config = config();
    config.validation = crate::ValidationConfig { every: 1, objects: 1 };
    config.refiner = Some(RefinerConfig { gradient_size: 16, ..RefinerConfig::default() });
    config
}

#[test]
fn a_run_that_could_never_compare_a_sample_is_refused() {
    let place = tempfile::tempdir().unwrap();
    let refused = |config: TrainConfig| {
        let run = place.path().join("run");
        let error = Trainer::open(config, &run, None, &Device::flex(), |_| {}).err().expect("refused");
        assert!(!run.exists());
        error.to_string()
    };
    let text = refused(from_fits());
    assert!(text.contains("validation.objects") && text.contains("the refiner"), "{text}");
    let mut config = config();
    config.validation = crate::ValidationConfig { every: 1, objects: 1 };
    config.loss.input_views = (4, 4);
    let text = refused(config);
    assert!(text.contains("validation.objects") && text.contains("views"), "{text}");
}

#[test]
fn a_measurement_that_is_no_number_is_never_the_best() {
    let of = |psnr: f64| Best { step: 7, psnr };
    for lost in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        assert!(!of(lost).is_better_than(None) && !of(lost).is_better_than(Some(of(3.0))));
    }
    assert!(of(3.0).is_better_than(None) && of(3.5).is_better_than(Some(of(3.0))));
    assert!(!of(3.0).is_better_than(Some(of(3.0))), "the first of equals");
}

/// A run that measures after every second step.
fn measuring() -> TrainConfig {
    let mut config = config();
    config.validation = crate::ValidationConfig { every: 2, objects: 2 };
    config.sample = FlowConfig { steps: 1, cfg_scale: 1.0, gradient_size: 16, ..FlowConfig::default() };
    config
}

#[test]
fn a_measurement_that_is_due_is_made_when_the_run_goes_on() {
    let place = tempfile::tempdir().unwrap();
    let folder = |name: &str| place.path().join(name);
    let two = |name: &str| {
        let mut trainer = open(&measuring(), &folder(name), None);
        (0..2).for_each(|_| drop(trainer.step().unwrap()));
        trainer
    };
    let told = |trainer: &mut Trainer| serde_json::to_value(validate(trainer).unwrap()).unwrap();
    let mut whole = two("whole");
    let expected = told(&mut whole);
    assert!(validate(&mut whole).is_none() && whole.measured() == 2);
    whole.save().unwrap();
    // One that was made is not made again.
    drop(whole);
    assert!(validate(&mut open(&measuring(), &folder("whole"), None)).is_none());

    // Saved at once after the step, or given up in the middle: by the first object, and by the first step of sampling.
    let saved = two("saved");
    saved.save().unwrap();
    drop(saved);
    assert!(!folder("saved").join("best.safetensors").exists());
    for asked in 0..4 {
        let mut trainer = open(&measuring(), &folder("saved"), None);
        let times = std::cell::Cell::new(0);
        trainer.interrupt_when(move || times.replace(times.get() + 1) == asked);
        assert!(trainer.validate().unwrap().is_break() && trainer.progress.best.is_none());
        trainer.save().unwrap();
    }
    let mut again = open(&measuring(), &folder("saved"), None);
    assert!(!again.is_finished() && again.measured() == 0);
    assert_eq!(told(&mut again), expected);
    let best = |name: &str| std::fs::read(folder(name).join("best.safetensors")).unwrap();
    // The header has the time that training took.
    let weights = |bytes: Vec<u8>| bytes[8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize..].to_vec();
    assert!(weights(best("saved")) == weights(best("whole")));
}

#[test]
fn a_state_of_before_measurements_were_recorded_has_been_measured() {
    let place = tempfile::tempdir().unwrap();
    let mut trainer = open(&measuring(), place.path(), None);
    (0..2).for_each(|_| drop(trainer.step().unwrap()));
    trainer.save().unwrap();
    drop(trainer);
    let file = place.path().join("state-000000002/progress.json");
    let mut progress: serde_json::Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    progress.as_object_mut().unwrap().remove("measured").unwrap();
    std::fs::write(&file, progress.to_string()).unwrap();
    assert!(validate(&mut open(&measuring(), place.path(), None)).is_none());
}

#[test]
fn what_is_automatic_is_chosen_once_for_a_run() {
    use freerange_model::Compute;
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("state-000000000/progress.json");
    let recorded = || -> serde_json::Value { serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap() };
    let begin = |compute: Compute| {
        let mut config = config();
        config.optimizer.compute = compute;
        let mut said = Vec::new();
        let opened = Trainer::open(config, place.path(), None, &Device::flex(), |line| said.push(line.to_owned()));
        opened.unwrap().save().unwrap();
        said.into_iter().find_map(|line| line.strip_prefix("computing in ").map(str::to_owned)).unwrap()
    };
    let chosen = begin(Compute::Auto);
    assert_eq!(recorded()["compute"], chosen);
    // Begun on another machine.
    let other = if chosen == "f32" { "bf16" } else { "f32" };
    let mut progress = recorded();
    progress["compute"] = other.into();
    std::fs::write(&file, progress.to_string()).unwrap();
    assert_eq!(begin(Compute::Auto), other);
    assert_eq!(recorded()["compute"], other);
    // What is asked for holds, and is what goes on.
    let asked = if chosen == "f32" { Compute::F32 } else { Compute::Bf16 };
    assert_eq!(begin(asked), chosen);
    assert_eq!(begin(Compute::Auto), chosen);
}

#[test]
fn a_step_in_parts_can_be_given_up() {
    let place = tempfile::tempdir().unwrap();
    let mut config = config();
    config.stages[0] = Stage { batch: 3, micro_batch: Some(1), ..config.stages[0].clone() };
    let three = |name: &str, part: Option<u32>| {
        let folder = place.path().join(name);
        let mut trainer = open(&config, &folder, None);
        trainer.step().unwrap();
        if let Some(part) = part {
            let times = std::cell::Cell::new(0);
            trainer.interrupt_when(move || times.replace(times.get() + 1) == part);
            assert!(matches!(trainer.step(), Err(TrainError::Cancelled)));
            assert_eq!(trainer.step_count(), 1);
            trainer.save().unwrap();
            drop(trainer);
            trainer = open(&config, &folder, None);
        }
        (0..2).for_each(|_| drop(trainer.step().unwrap()));
        state(&trainer)
    };
    let expected = three("whole", None);
    for part in 0..3 {
        assert!(three(&format!("given up at {part}"), Some(part)) == expected, "part {part}");
    }
}

#[test]
fn all_ranks_give_a_measurement_up_where_one_is_asked_to_end() {
    let place = tempfile::tempdir().unwrap();
    let mut config = in_virtual_ranks();
    config.validation.every = 1;
    among(2, |ranks| {
        let mut trainer = open_among(ranks.clone(), &config, &place.path().join("run")).unwrap();
        trainer.step().unwrap();
        if ranks.rank() == 1 {
            trainer.interrupt_when(|| true);
        }
        assert!(trainer.validate().unwrap().is_break() && trainer.measured() == 0);
        trainer.interrupt_when(|| false);
        assert_eq!(validate(&mut trainer).unwrap().step, 1);
        // What only rank 0 writes fails on all of them.
        trainer.step().unwrap();
        if ranks.rank() == 0 {
            std::fs::remove_file(place.path().join("run/best.safetensors")).unwrap();
            std::fs::create_dir(place.path().join("run/best.safetensors")).unwrap();
        }
        trainer.progress.best = None;
        trainer.validate().unwrap_err();
        trainer.save().unwrap();
        if ranks.rank() == 0 {
            std::fs::remove_file(place.path().join("run/checkpoint.safetensors")).unwrap();
            std::fs::create_dir(place.path().join("run/checkpoint.safetensors")).unwrap();
        }
        trainer.save().unwrap_err();
    });
}

#[test]
fn a_folder_is_one_process_s() {
    let place = tempfile::tempdir().unwrap();
    let open = || Trainer::open(config(), place.path(), None, &Device::flex(), |_| {});
    let first = open().unwrap();
    let text = open().err().expect("refused").to_string();
    let folder = place.path().display().to_string();
    assert!(text.contains(&folder) && text.contains("another process"), "{text}");
    first.save().unwrap();
    drop(first);
    assert_eq!(open().unwrap().step_count(), 0);
}
