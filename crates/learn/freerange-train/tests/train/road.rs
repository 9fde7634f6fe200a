//! The whole road on one object: train, save, load, sample, render. The guard against silent breakage.

use std::{ops::ControlFlow, sync::Arc};

use burn::tensor::Device;
use freerange_data::ObjectSource;
use freerange_data::build::{Generated, MakingConfig};
use freerange_diffusion::{
    FlowError,
    photometric::Photometric,
    sample::{Estimate, FlowConfig, FlowSampler, Refiner, RefinerConfig},
    targets::Targets,
};
use freerange_gaussians::{Gaussians, Normalization, channel};
use freerange_model::Checkpoint;
use freerange_optim::tree_slice;
use freerange_raster::metrics::psnr;
use freerange_raster::{RasterConfig, render};
use freerange_scene::camera::{View, image_ops::composite};
use freerange_train::{
    batch::Batch,
    batch::step_rng,
    config::{FrameJitter, RateSchedule, Symmetries},
    trainer::{Initial, Trainer},
};

type TrainConfig = freerange_train::config::TrainConfig<MakingConfig>;

/// A model that learns one object in about a minute.
const ONE_OBJECT: &str = r#"
seed = 3

[model]
image_size = 32
hidden = 64
blocks = 2
heads = 2
registers = 2
gaussians_per_token = 4
time_features = 32

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
held_views = 2
render_size = 32
gradient_size = 32
coupling = "tree"

[optimizer]
learning_rate = 3e-3
final_learning_rate = 1e-4
warmup = 20
ema = 0.98

[[stage]]
depth = 6
image_size = 32
batch = 8
steps = STEPS

[sample]
steps = 20
cfg_scale = 1.0
gradient_size = 32
coupling = "tree"
"#;

fn config(steps: u64) -> TrainConfig {
    let config: TrainConfig = toml::from_str(&ONE_OBJECT.replace("STEPS", &steps.to_string())).unwrap();
    config.validate().unwrap();
    config
}

fn train(config: &TrainConfig, folder: &std::path::Path, stop_at: u64) -> Vec<f32> {
    let mut trainer = Trainer::open(config.clone(), folder, None, &Device::flex(), |_| {}).unwrap();
    let mut losses = Vec::new();
    while trainer.step_count() < stop_at {
        losses.push(trainer.step().unwrap().loss);
    }
    trainer.save().unwrap();
    losses
}

fn go(_: &Estimate<'_>) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

/// Samples of `objects` from noise: object by object, and of each one seed after the other.
fn sample(checkpoint: &Checkpoint, objects: &[&[View]], config: &FlowConfig, seeds: &[u64]) -> Vec<Gaussians> {
    FlowSampler { checkpoint, config, device: &Device::flex() }.sample(objects, seeds, go).unwrap()
}

/// Mean PSNR of renders of `rows` against `views`, on white.
fn quality(rows: &[f32], views: &[View]) -> f64 {
    let cameras: Vec<_> = views.iter().map(|v| v.camera).collect();
    let rgb = render(rows, &cameras, &vec![[1.0; 3]; views.len()], &RasterConfig::default()).unwrap().rgb;
    let truth: Vec<f32> = views.iter().flat_map(|v| composite(&v.image, [1.0; 3])).collect();
    psnr(&rgb, &truth).unwrap()
}

#[test]
fn one_object_is_learned_sampled_and_rendered() {
    let folder = tempfile::tempdir().unwrap();
    let config = config(700);
    let losses = train(&config, folder.path(), 700);
    let mean = |x: &[f32]| x.iter().sum::<f32>() / x.len() as f32;
    assert!(
        mean(&losses[650..]) < 0.3 * mean(&losses[..20]),
        "the loss fell from {} to {}",
        mean(&losses[..20]),
        mean(&losses[650..])
    );

    let device = Device::flex();
    let checkpoint = Checkpoint::load(&folder.path().join("checkpoint.safetensors"), &device).unwrap();
    let source = Generated {
        config: config.data.making.object.clone(),
        depths: config.depths(),
        seed: config.seed.wrapping_mul(1 << 32),
    };
    let object = source.object(0).unwrap();
    let (inputs, unseen) = object.views.split_at(4);
    let clouds = sample(&checkpoint, &[inputs], &config.sample, &[5, 6]);
    assert_eq!(clouds.len(), 2);
    assert_ne!(clouds[0], clouds[1], "another seed is another sample");

    let target = quality(object.slice(6).unwrap().rows(), unseen);
    let white = quality(&[], unseen);
    for cloud in &clouds {
        assert_eq!(cloud.len(), 64);
        let found = quality(cloud.rows(), unseen);
        assert!(
            found > white + 0.6 * (target - white),
            "unseen views: {found:.2} dB, a white image {white:.2} dB, the Gaussians that were learned {target:.2} dB"
        );
    }

    let guided = |lambda_pg: f32| {
        sample(&checkpoint, &[inputs], &FlowConfig { lambda_pg, ..config.sample.clone() }, &[5]).remove(0)
    };
    assert_ne!(guided(0.0), guided(50.0));

    // A single step is guided, too: its result is.
    let single = |lambda_pg: f32| {
        let one = FlowConfig { steps: 1, lambda_pg, ..config.sample.clone() };
        sample(&checkpoint, &[inputs], &one, &[5]).remove(0)
    };
    assert_ne!(single(0.0), single(50.0));

    // Every step's estimate is told, the last of which is the result, and whoever is told can stop it.
    let mut told = Vec::new();
    let sampler = FlowSampler { checkpoint: &checkpoint, config: &config.sample, device: &device };
    let result = sampler.sample(&[inputs], &[5, 6], |step| {
        told.push((step.index, step.clouds().unwrap()));
        ControlFlow::Continue(())
    });
    assert_eq!(told.iter().map(|(index, _)| *index).collect::<Vec<_>>(), (0..20).collect::<Vec<_>>());
    assert_eq!(told[19].1, result.unwrap());
    assert_ne!(told[18].1, told[19].1);
    let mut steps = 0;
    let stopped = sampler.sample(&[inputs], &[5], |step| {
        steps += 1;
        if step.index == 2 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    assert!(matches!(stopped, Err(FlowError::Cancelled)) && steps == 3);

    // Another batch: two objects (the second sees other views), one seed.
    let both = sample(&checkpoint, &[inputs, unseen], &config.sample, &[5]);
    let worst =
        |a: &Gaussians, b: &Gaussians| a.rows().iter().zip(b.rows()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert_eq!(both.len(), 2);
    let off = worst(&both[0], &clouds[0]);
    assert!(off < 1e-2, "the same seed in another batch gives the same sample, up to rounding: off by {off}");
    let alone = sample(&checkpoint, &[unseen], &config.sample, &[5]);
    assert!(worst(&both[1], &alone[0]) < 1e-2);
    assert_ne!(both[0], both[1]);
}

#[test]
fn a_resumed_run_continues_as_if_never_stopped() {
    let (whole, halves) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let config = config(8);
    let expected = train(&config, whole.path(), 8);
    let mut found = train(&config, halves.path(), 4);
    found.extend(train(&config, halves.path(), 8));
    assert_eq!(found, expected);
    let bytes = |folder: &tempfile::TempDir| {
        let device = Device::flex();
        let checkpoint = Checkpoint::load(&folder.path().join("checkpoint.safetensors"), &device).unwrap();
        checkpoint.model.parameters()
    };
    assert_eq!(bytes(&whole), bytes(&halves));
}

#[test]
fn another_configuration_in_the_same_folder_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    train(&config(2), folder.path(), 1);
    let mut other = config(2);
    other.optimizer.learning_rate = 1.0;
    let e = Trainer::open(other, folder.path(), None, &Device::flex(), |_| {}).err().expect("refused").to_string();
    assert!(e.contains("another configuration"), "{e}");
}

/// As a branch does whose rate is brought down: the average goes on from where it was, and follows faster.
#[test]
fn a_run_may_go_on_with_another_end_and_another_average() {
    let average = |ema: f32| {
        let folder = tempfile::tempdir().unwrap();
        train(&config(4), folder.path(), 2);
        let mut other = config(3);
        other.optimizer.ema = ema;
        other.optimizer.schedule = RateSchedule::Constant { decay: 1 };
        let losses = train(&other, folder.path(), 3);
        assert_eq!(losses.len(), 1);
        let checkpoint = Checkpoint::load(&folder.path().join("checkpoint.safetensors"), &Device::flex()).unwrap();
        (losses, checkpoint.model.parameters())
    };
    let ((losses, none), (others, slow)) = (average(0.0), average(0.9999));
    assert_eq!(losses, others);
    assert_ne!(none, slow);
}

#[test]
fn an_initial_checkpoint_of_another_architecture_is_refused() {
    let (first, second) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    train(&config(1), first.path(), 1);
    let device = Device::flex();
    let checkpoint = Checkpoint::load(&first.path().join("checkpoint.safetensors"), &device).unwrap();
    let mut other = config(1);
    other.model.hidden = 32;
    let initial = Initial { checkpoint: &checkpoint, remeasure: false };
    let e = Trainer::open(other, second.path(), Some(initial), &device, |_| {}).err().expect("refused").to_string();
    assert!(e.contains("architecture"), "{e}");
    assert_eq!(second.path().read_dir().unwrap().count(), 0, "nothing is written for a run that cannot start");
}

#[test]
fn an_initial_checkpoint_gives_its_statistics_unless_they_are_to_be_measured() {
    let (first, second, third) =
        (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    train(&config(1), first.path(), 1);
    let device = Device::flex();
    let load =
        |folder: &tempfile::TempDir| Checkpoint::load(&folder.path().join("checkpoint.safetensors"), &device).unwrap();
    let checkpoint = load(&first);
    let mut other = config(1);
    other.data.making.object.surface.opacity = 0.5;
    for (folder, remeasure) in [(&second, false), (&third, true)] {
        let initial = Initial { checkpoint: &checkpoint, remeasure };
        Trainer::open(other.clone(), folder.path(), Some(initial), &device, |_| {}).unwrap().save().unwrap();
    }
    assert_eq!(load(&second).normalization, checkpoint.normalization);
    let (old, new) = (checkpoint.normalization.mean, load(&third).normalization.mean);
    assert!(old[channel::LOGIT_OPACITY] > new[channel::LOGIT_OPACITY] + 1.0, "{old:?} {new:?}");
}

#[test]
fn a_moved_frame_changes_nothing_that_is_seen() {
    let still = config(1);
    let mut moved = still.clone();
    moved.loss.frame_jitter = FrameJitter { scale: 0.1, center: 0.1 };
    let device = Device::flex();
    let source = Generated { config: still.data.making.object.clone(), depths: vec![6], seed: 5 };
    let object = Arc::new(source.object(0).unwrap());
    let normalization = Normalization { mean: [0.0; channel::COUNT], std: [1.0; channel::COUNT] };
    let photometric = Photometric::new(&normalization, &device);
    let draw = |config: &TrainConfig, seed: u64| {
        let mut rng = step_rng(seed, 0);
        let objects = [object.clone()];
        Batch::draw(&objects, &config.stages[0], &config.model, &config.loss, &normalization, &mut rng, &device)
            .unwrap()
    };
    let mut shifts = Vec::new();
    for seed in 0..4 {
        let (a, b) = (draw(&still, seed), draw(&moved, seed));
        let rows = |batch: &Batch| batch.data.clone().into_data().try_to_vec::<f32>().unwrap();
        let (rows_a, rows_b) = (rows(&a), rows(&b));
        shifts.push(rows_b[channel::LOG_SCALE.start] - rows_a[channel::LOG_SCALE.start]);
        let loss = |batch: &Batch, targets: &Targets| {
            photometric.l1(batch.data.clone(), targets).unwrap().into_data().try_to_vec::<f32>().unwrap()[0]
        };
        for (x, y) in [
            (&a.seen, &b.seen),
            (&a.gradient_targets, &b.gradient_targets),
            (a.held.as_ref().unwrap(), b.held.as_ref().unwrap()),
        ] {
            let (x, y) = (loss(&a, x), loss(&b, y));
            assert!((x - y).abs() < 1e-3 * x, "seed {seed}: {x} {y}");
        }
        // The frame is another one all the same.
        assert!(loss(&a, &b.seen) > 1.1 * loss(&a, &a.seen), "seed {seed}");
    }
    assert!(shifts.iter().all(|s| s.abs() > 1e-4 && s.abs() <= 0.2 + 1e-5), "{shifts:?}");
    assert!(shifts.iter().any(|s| (s - shifts[0]).abs() > 1e-3), "each draw is another one: {shifts:?}");
}

#[test]
fn another_object_of_the_same_data_agrees_with_its_photos() {
    let plain = config(1);
    let mut varied = plain.clone();
    varied.loss.symmetries = Symmetries { space: true, color: true };
    let device = Device::flex();
    let source = Generated { config: plain.data.making.object.clone(), depths: vec![6], seed: 5 };
    let object = Arc::new(source.object(0).unwrap());
    let normalization = Normalization { mean: [0.0; channel::COUNT], std: [1.0; channel::COUNT] };
    let photometric = Photometric::new(&normalization, &device);
    let (mut own, mut others, mut before) = (0.0, 0.0, 0.0);
    for seed in 0..8 {
        let draw = |config: &TrainConfig| {
            let (mut rng, objects) = (step_rng(seed, 0), [object.clone()]);
            Batch::draw(&objects, &config.stages[0], &config.model, &config.loss, &normalization, &mut rng, &device)
                .unwrap()
        };
        let loss = |batch: &Batch, targets: &Targets| {
            photometric.l1(batch.data.clone(), targets).unwrap().into_data().try_to_vec::<f32>().unwrap()[0]
        };
        let (a, b) = (draw(&plain), draw(&varied));
        for (of_a, of_b) in [(&a.seen, &b.seen), (a.held.as_ref().unwrap(), b.held.as_ref().unwrap())] {
            before += loss(&a, of_a);
            own += loss(&b, of_b);
            others += loss(&a, of_b);
        }
    }
    assert!((own - before).abs() < 0.2 * before, "{own} {before}");
    assert!(others > 1.5 * own, "it is another object: {others} {own}");
}

/// Training at the start, from a fit to what it should have been, and refinement.
#[test]
fn a_fit_is_refined() {
    let place = tempfile::tempdir().unwrap();
    let text = ONE_OBJECT
        .replace("STEPS", "160")
        .replace("warmup = 20", "warmup = 5")
        .replace("batch = 8", "batch = 4")
        .replace("views = 8", "views = 16\ninput_fits = 1\ninitial_fit = { iterations = 60, gaussians = 64, render_size = 32 }")
        .replace(
            "[model]",
            "[model]\nestimate_channels = true\nobservation_channels = true\nplace_channels = true\npreconditioning = [0.1, 0.1, 0.1, 0.5, 0.5, 0.5, \
             0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]",
        )
        .replace(
            "[loss]",
            "[loss]\nself_conditioning = 0.5\nestimates = 2\ngradient_at = \"estimate\"\n\
             refinement = { share = 1.0, render_weight = 50.0 }",
        )
        .replace(
            "[sample]",
            "[refiner]\npasses = 3\nretokenize_every = 0\ngradient_size = 32\n\n[sample]",
        );
    let config: TrainConfig = toml::from_str(&text).unwrap();
    config.validate().unwrap();
    let source = Generated {
        config: config.data.making.object.clone(),
        depths: config.depths(),
        seed: config.seed.wrapping_mul(1 << 32),
    };
    let object = Arc::new(source.object(0).unwrap());
    let device = Device::flex();
    let [stage] = config.stages.as_slice() else { panic!("one stage") };

    // At the start nothing shows where the sample should go: it is the fit without noise.
    let normalization = Normalization { mean: [0.0; channel::COUNT], std: [1.0; channel::COUNT] };
    let objects = [object.clone()];
    let draw = |seed, device: &Device| {
        let rng = &mut step_rng(seed, 0);
        Batch::draw(&objects, stage, &config.model, &config.loss, &normalization, rng, device).unwrap()
    };
    let drawn: Vec<Batch> = (0..12).map(|seed| draw(seed, &device)).collect();
    for batch in &drawn {
        let values = |t: &burn::tensor::Tensor<3>| t.clone().into_data().try_to_vec::<f32>().unwrap();
        assert_eq!((batch.t.as_slice(), batch.render_weights.as_slice()), ([0.0].as_slice(), [50.0].as_slice()));
        assert!(values(&batch.noise).iter().all(|&e| e == 0.0));
        assert_eq!(values(batch.fits.as_ref().unwrap()), object.input_fits[0].gaussians.rows());
        assert_eq!(values(&batch.data), object.input_fits[0].target.rows());
    }
    for count in 0..=2 {
        assert!(drawn.iter().any(|batch| batch.estimates == count), "{count} estimates are drawn now and then");
    }

    train(&config, place.path(), 160);
    let checkpoint = Checkpoint::load(&place.path().join("checkpoint.safetensors"), &device).unwrap();
    let fit = &object.input_fits[0];
    let (mut inputs, mut unseen) = (Vec::new(), Vec::new());
    for (i, view) in object.views.iter().enumerate() {
        if fit.views.contains(&i) { inputs.push(view.clone()) } else { unseen.push(view.clone()) }
    }
    let refine = |proposals: &[Gaussians], passes, retokenize_every| {
        let config = &RefinerConfig { passes, retokenize_every, ..config.refiner.clone().unwrap() };
        let mut steps = 0;
        let found =
            Refiner { checkpoint: &checkpoint, config, device: &device }.refine(&[&inputs], proposals, |pass| {
                assert_eq!((pass.t, pass.index), (0.0, steps));
                steps += 1;
                ControlFlow::Continue(())
            });
        assert_eq!(steps, passes);
        found.unwrap()
    };
    let own = fit.gaussians.clone();
    let found = refine(&[own.clone(), own.clone()], 3, 0);
    assert_eq!((found.len(), &found[0]), (2, &found[1]), "nothing is random");
    let [from, to, found] = [&fit.gaussians, &fit.target, &found[0]].map(|cloud| quality(cloud.rows(), &unseen));
    assert!(
        found > from + 0.4 * (to - from) && to > from + 1.0,
        "fit {from:.2} dB, refined {found:.2} dB, at best {to:.2} dB"
    );

    // To group the Gaussians into tokens again is to begin again with them as the proposal.
    let one = |proposal: &Gaussians, passes, every| refine(std::slice::from_ref(proposal), passes, every).remove(0);
    let half = one(&own, 2, 0);
    assert_ne!(tree_slice(&half, 6).unwrap(), half, "refinement moves Gaussians past each other");
    assert_eq!(one(&half, 2, 0), one(&own, 4, 2));
    assert_ne!(one(&own, 4, 0), one(&own, 4, 2));
    let none = Refiner { checkpoint: &checkpoint, config: config.refiner.as_ref().unwrap(), device: &device };
    assert!(none.refine(&[&inputs], &[], go).unwrap_err().to_string().contains("proposals"));
}

/// What a network says that does not look at its images is the same with and without them: no guidance changes it.
#[test]
fn guidance_of_a_network_that_ignores_its_images_changes_nothing() {
    let mut config = config(1);
    config.model.estimate_channels = true;
    config.model.observation_channels = true;
    config.model.preconditioning = Some([0.5; channel::COUNT]);
    config.sample.gradient_at = freerange_diffusion::sample::GradientAt::Estimate;
    config.sample = FlowConfig { steps: 4, lambda_pg: 0.0, ..config.sample };
    let place = tempfile::tempdir().unwrap();
    // Before the first step the last layer is zero: the network corrects nothing.
    train(&config, place.path(), 0);
    let device = Device::flex();
    let checkpoint = Checkpoint::load(&place.path().join("checkpoint.safetensors"), &device).unwrap();
    let source = Generated { config: config.data.making.object.clone(), depths: config.depths(), seed: 7 };
    let views = source.object(0).unwrap().views;
    let guided = |cfg_scale: f32| {
        sample(&checkpoint, &[&views[..4]], &FlowConfig { cfg_scale, ..config.sample.clone() }, &[5]).remove(0)
    };
    let plain = guided(1.0);
    for scale in [0.0, 1.5, 3.0] {
        let difference = guided(scale).rows().iter().zip(plain.rows()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(difference < 1e-3, "s = {scale}: {difference}");
    }
}
