//! The main job through the front door: what is told on the way, how it is stopped, what is refused.

use std::{ops::ControlFlow, path::Path};

use freerange::{
    Camera, Device, Error, Options, Progress, Reconstructor, SampleConfig, Scene, Similarity, Stage, View, score,
    to_canonical,
};
use freerange_camera::{FrameConfig, Window};
use glam::{DQuat, DVec3};

fn model() -> Reconstructor {
    Reconstructor::shipped(&Device::flex()).unwrap()
}

fn bowl() -> Vec<View> {
    Scene::load(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/bowl"))).unwrap().inputs
}

/// Quick to run, with every stage.
fn short(model: &Reconstructor) -> Options {
    let mut options = model.options().unwrap();
    options.sample.start.as_mut().expect("the shipped model starts from a fit").fit.iterations = 20;
    options.sample.steps = 3;
    options.seeds = vec![4, 5];
    options.sample.refine = 4;
    options.sample.ensemble = 1;
    (options.sample.mirror, options.sample.turn) = (0.0, 0.0);
    options
}

fn go(_: &Progress<'_>) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

/// The scene in another frame: cameras moved, turned and scaled.
fn elsewhere(views: &[View], to: &Similarity) -> Vec<View> {
    views.iter().map(|v| View { camera: v.camera.transformed(to), ..v.clone() }).collect()
}

#[test]
fn every_step_is_told_and_the_last_estimate_is_the_result_in_the_users_frame() {
    let model = model();
    let mut options = short(&model);
    // Away from the canonical frame, where nothing that stays in it would agree with the cameras.
    let to = Similarity { scale: 3.0, rotation: DQuat::from_rotation_z(0.4), translation: DVec3::new(5.0, -2.0, 1.0) };
    let views = elsewhere(&bowl(), &to);
    let mut told = Vec::new();
    let mut estimates = Vec::new();
    let result = model
        .run(&views, &options, &mut |p| {
            told.push((p.stage, p.sample, p.done, p.total));
            let estimate = p.estimate().unwrap();
            // Of the fits (what moves the frame, and one for each sample) the first is shown.
            assert_eq!(estimate.is_some(), p.done > 0 && (p.stage != Stage::Fit || p.done <= 20));
            assert_eq!(p.loss.is_some(), matches!(p.stage, Stage::Fit | Stage::Refine) && p.done > 0);
            estimates.extend(estimate.map(|clouds| (p.stage, p.sample, clouds)));
            ControlFlow::Continue(())
        })
        .unwrap();
    let steps = |stage, sample, total: usize| (0..=total).map(move |done| (stage, sample, done, total));
    let expected: Vec<_> = [(Stage::Frame, 0, 0, 1)]
        .into_iter()
        .chain(steps(Stage::Fit, 0, 60))
        .chain(steps(Stage::Sample, 0, 3))
        .chain(steps(Stage::Refine, 0, 4))
        .chain(steps(Stage::Refine, 1, 4))
        .collect();
    assert_eq!(told, expected);
    assert_eq!(
        result.seconds.iter().map(|s| s.0).collect::<Vec<_>>(),
        [Stage::Frame, Stage::Fit, Stage::Sample, Stage::Refine]
    );
    let unrefined: Vec<_> = result.samples.iter().map(|s| s.unrefined.clone().unwrap()).collect();
    let of = |stage, sample| {
        let of = estimates.iter().filter(move |e| (e.0, e.1) == (stage, sample));
        of.map(|e| e.2.clone()).collect::<Vec<_>>()
    };
    let sampled = of(Stage::Sample, 0);
    assert!(sampled.len() == 3 && sampled[2] == unrefined && sampled[1] != unrefined);
    // Of fits and refinements the states: the last one of a refinement is the result.
    let fitted = of(Stage::Fit, 0);
    assert!(fitted.len() == 20 && fitted.windows(2).all(|pair| pair[0].len() == 1 && pair[0] != pair[1]));
    let before = score(&fitted[0][0], &views).unwrap().unwrap().psnr;
    let after = score(&fitted[19][0], &views).unwrap().unwrap().psnr;
    assert!(before > 10.0 && after > before, "in the frame of the cameras, and better: {before} dB, {after} dB");
    for (i, sample) in result.samples.iter().enumerate() {
        let refined = of(Stage::Refine, i);
        assert_eq!(refined.len(), 4);
        assert!(refined[3][0].len() == sample.gaussians.len() && refined[0] != refined[3]);
        // But for the labels of axes, which are made canonical at the end.
        let means = |cloud: &freerange::Cloud| (0..cloud.len()).map(|k| cloud.mean(k)).collect::<Vec<_>>();
        assert_eq!(means(&refined[3][0]), means(&sample.gaussians));
    }
    assert_eq!(result.samples.iter().map(|s| s.seed).collect::<Vec<_>>(), [4, 5]);
    assert_ne!(unrefined[0], unrefined[1]);
    // In the frame of the cameras: what is seen there is the bowl.
    for sample in &result.samples {
        let found = score(&sample.gaussians, &views).unwrap().unwrap().psnr;
        assert!(found > 18.0, "{found} dB");
    }

    // The same without anyone who looks.
    assert_eq!(model.run(&views, &options, &mut go).unwrap().samples[1].gaussians, result.samples[1].gaussians);
    options.sample.refine = 0;
    let plain = model.run(&views, &options, &mut go).unwrap();
    assert!(plain.samples.iter().all(|s| s.unrefined.is_none()));
    assert_eq!(plain.samples[0].gaussians, unrefined[0]);
    // But for rounding, a sample is the same whatever is drawn beside it: so is its fit, and the frame.
    options.seeds = vec![5];
    let alone = model.run(&views, &options, &mut go).unwrap();
    assert_eq!(alone.canonical_from_user, plain.canonical_from_user);
    let apart = |a: &freerange::Cloud, b: &freerange::Cloud| {
        (0..a.len()).map(|k| a.mean(k).distance(b.mean(k))).fold(0.0, f64::max)
    };
    let [same, other] = [&unrefined[1], &unrefined[0]].map(|cloud| apart(&alone.samples[0].gaussians, cloud));
    assert!(same < 0.1 * other, "{same} {other}");
}

/// The first sample is what it is without the other members, what comes of it is not.
#[test]
fn an_ensemble_is_refined_together() {
    let model = model();
    let views = bowl();
    let mut options = short(&model);
    options.seeds.truncate(1);
    let (mut own, mut told, mut estimates) = (Vec::new(), Vec::new(), Vec::new());
    let alone = model
        .run(&views, &options, &mut |p| {
            own.extend(p.estimate().unwrap().map(|clouds| (p.stage, clouds)));
            ControlFlow::Continue(())
        })
        .unwrap();
    options.sample.ensemble = 3;
    let together = model
        .run(&views, &options, &mut |p| {
            told.push((p.stage, p.done, p.total));
            estimates.extend(p.estimate().unwrap().map(|clouds| (p.stage, clouds)));
            ControlFlow::Continue(())
        })
        .unwrap();
    let steps = |stage, total: usize| (0..=total).map(move |done| (stage, done, total));
    let expected: Vec<_> = steps(Stage::Fit, 60).chain(steps(Stage::Sample, 9)).collect();
    assert_eq!(told[1..1 + expected.len()], expected);
    // Of the members, which are worked on side by side, the first is shown, and what is shown of it is what it is alone.
    for (stage, count) in [(Stage::Fit, 20), (Stage::Sample, 3)] {
        let of = |all: &[(Stage, Vec<freerange::Cloud>)]| {
            all.iter().filter(|e| e.0 == stage).map(|e| e.1.clone()).collect::<Vec<_>>()
        };
        assert!(of(&estimates).len() == count && of(&estimates) == of(&own), "{stage}");
    }
    assert_eq!(alone.samples[0].unrefined, together.samples[0].unrefined);
    // However many threads there are, and within a pool, where the caller is one of them.
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let same = one.install(|| model.run(&views, &options, &mut go)).unwrap();
    assert_eq!(same.samples[0].gaussians, together.samples[0].gaussians);
    assert_ne!(alone.samples[0].gaussians, together.samples[0].gaussians);
    assert_eq!(alone.canonical_from_user, together.canonical_from_user);
}

/// A bowl is its own mirror image: mirrored photos are shown, and the user is told so.
#[test]
fn mirrored_photos_are_further_views() {
    let model = model();
    let views = bowl();
    let mut options = short(&model);
    options.seeds.truncate(1);
    let run = |options: &freerange::Options| {
        let mut told = Vec::new();
        let made = model.run(&views, options, &mut |p| {
            told.push((p.stage, p.done, p.total));
            ControlFlow::Continue(())
        });
        (made.unwrap(), told)
    };
    let (without, _) = run(&options);
    let noted = |made: &freerange::Reconstruction| made.notes.iter().any(|note| note.contains("mirror image"));
    options.sample.mirror = 1e-6;
    let (contradicted, _) = run(&options);
    options.sample.mirror = 100.0;
    let (with, told) = run(&options);
    assert_eq!([&without, &contradicted, &with].map(noted), [false, false, true]);
    assert_eq!(with.shown, without.shown);
    assert_ne!(with.samples[0].gaussians, without.samples[0].gaussians);
    let steps: Vec<_> = told.iter().filter(|t| t.0 == Stage::Mirror).collect();
    let (first, last) = (steps[0], steps[steps.len() - 1]);
    assert!(
        first.1 == 0 && last.1 == last.2 && steps.windows(2).all(|pair| pair[0].1 <= pair[1].1),
        "{first:?} {last:?}"
    );
    assert!(told.windows(2).all(|pair| pair[0].0 <= pair[1].0), "stages come in their order");

    for last in [0, 5] {
        let mut after = 0;
        let stopped = model.run(&views, &options, &mut |p| {
            after += usize::from(after > 0);
            if (p.stage, p.done) == (Stage::Mirror, last) {
                after = 1;
            }
            if after > 0 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        assert!(matches!(stopped, Err(Error::Cancelled)) && after == 1, "{last}: told {after} times");
    }
}

/// A bowl may be turned about its axis: turned outlines are fitted to, and the user is told so, in one stage with mirrored photos.
#[test]
fn turned_outlines_are_fitted_to() {
    let model = model();
    let views = bowl();
    let mut options = short(&model);
    options.seeds.truncate(1);
    let run = |mirror, turn, refine| {
        let mut options = options.clone();
        (options.sample.mirror, options.sample.turn, options.sample.refine) = (mirror, turn, refine);
        let mut told = Vec::new();
        let made = model.run(&views, &options, &mut |p| {
            told.push((p.stage, p.done, p.total));
            ControlFlow::Continue(())
        });
        let made = made.unwrap();
        let noted = ["mirror image", "keep its outlines"].map(|what| made.notes.iter().any(|n| n.contains(what)));
        told.retain(|t| t.0 == Stage::Mirror);
        (noted, made, told)
    };
    let (noted, without, told) = run(0.0, 0.0, 0);
    assert!(noted == [false, false] && told.is_empty());
    let (noted, contradicted, _) = run(0.0, 1e-6, 0);
    assert_eq!((noted, &contradicted.samples[0].gaussians), ([false, false], &without.samples[0].gaussians));
    let (noted, turned, _) = run(0.0, 100.0, 0);
    assert_eq!(noted, [false, true]);
    assert_ne!(turned.samples[0].gaussians, without.samples[0].gaussians);
    let (noted, both, told) = run(100.0, 100.0, 0);
    assert_eq!(noted, [true, true]);
    assert_ne!(both.samples[0].gaussians, turned.samples[0].gaussians);
    let (first, last) = (told[0], told[told.len() - 1]);
    assert!(first.1 == 0 && last.1 == last.2, "{first:?} {last:?}");
    assert!(told.windows(2).all(|pair| pair[0].1 <= pair[1].1 && pair[0].2 == pair[1].2), "one stage");
    // Refinement is held to them as well.
    let [plain, held] = [0.0, 100.0].map(|turn| run(0.0, turn, 3).1.samples.remove(0));
    assert_ne!(plain.gaussians, held.gaussians);
}

/// From pure noise; what is mended or polished starts from that sample and stays near it.
#[test]
fn a_sample_from_noise_is_mended() {
    let model = model();
    let views = bowl();
    let mut options = short(&model);
    // Rough samples, and a few of them: single ones differ by as much as mending is worth.
    options.seeds = vec![4, 5, 6];
    options.sample = SampleConfig { steps: 1, polish: 0, mend: 0, refine: 0, ..options.sample.without_start() };
    let quality = |options: &Options| {
        let made = model.run(&views, options, &mut go).unwrap();
        let scores = made.samples.iter().map(|s| score(&s.gaussians, &views).unwrap().unwrap().psnr);
        scores.sum::<f64>() / made.samples.len() as f64
    };
    let before = quality(&options);
    options.sample.mend = 3;
    let after = quality(&options);
    assert!(after > before + 0.5, "{before} dB, mended {after} dB");
    options.sample.mend = 0;
    options.sample.polish = 60;
    let after = quality(&options);
    assert!(after > before + 1.0, "{before} dB, polished {after} dB");
}

/// Polishing and mending take longer than sampling does: they are told of, and can be stopped, too.
#[test]
fn all_that_is_done_from_noise_is_told() {
    let (model, views) = (model(), bowl());
    let mut options = short(&model);
    options.sample = options.sample.without_start();
    options.sample =
        SampleConfig { steps: 2, polish: 5, mend: 2, ensemble: 2, refine: 1, photometric_repeats: 1, ..options.sample };
    let mut told = Vec::new();
    model
        .run(&views, &options, &mut |p| {
            if p.stage == Stage::Sample {
                let estimates = p.estimate().unwrap().map_or(0, |clouds| clouds.len());
                told.push((p.done, p.total, p.loss.is_some(), estimates));
            }
            ControlFlow::Continue(())
        })
        .unwrap();
    // Of each member: the network's steps, with estimates of both samples, then two samples polished, then mended. Members are worked on side by
    // side: of the second, whose estimates nobody is shown, something may come anywhere.
    let total = 2 * (2 + 2 * 5 + 2 * 2);
    assert!(told.iter().map(|t| (t.0, t.1)).eq((0..=total).map(|done| (done, total))), "{told:?}");
    assert_eq!(told.iter().filter(|t| t.2).count(), 2 * 2 * 5);
    let shown: Vec<usize> = told.iter().map(|t| t.3).filter(|count| *count > 0).collect();
    assert_eq!(shown, [2, 2]);

    for last in [5, 14] {
        let mut reached = 0;
        let stopped = model.run(&views, &options, &mut |p| {
            reached = if p.stage == Stage::Sample { p.done } else { 0 };
            if reached == last { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        assert!(matches!(stopped, Err(Error::Cancelled)) && reached == last, "{last}: {reached}");
    }
}

#[test]
fn it_stops_where_it_is_told_to() {
    let (model, views) = (model(), bowl());
    let options = short(&model);
    for (stage, done) in
        [(Stage::Frame, 0), (Stage::Fit, 2), (Stage::Sample, 0), (Stage::Sample, 1), (Stage::Refine, 1)]
    {
        let mut after = 0;
        let stopped = model.run(&views, &options, &mut |p| {
            if (p.stage, p.done) == (stage, done) || after > 0 {
                after += 1;
                return ControlFlow::Break(());
            }
            ControlFlow::Continue(())
        });
        assert!(matches!(stopped, Err(Error::Cancelled)), "{stage} {done}");
        assert_eq!(after, 1, "{stage} {done}: nothing is told any more");
    }
}

#[test]
fn what_cannot_be_used_is_named() {
    let (model, views) = (model(), bowl());
    let options = model.options().unwrap();
    let refused = |views: &[View], options: &Options, words: &[&str]| {
        let error = model.run(views, options, &mut |_| panic!("work was begun")).unwrap_err().to_string();
        assert!(words.iter().all(|w| error.contains(w)), "{error}");
    };
    let change = |f: &dyn Fn(&mut View)| {
        let mut views = views.clone();
        f(&mut views[1]);
        views
    };
    let name = views[1].name.as_str();
    refused(&change(&|v| v.camera.width += 1), &options, &[name, "513 x 512", "512 x 512"]);
    refused(&change(&|v| v.camera.fx = f64::NAN), &options, &[name, "camera"]);
    refused(&change(&|v| v.camera = Camera { fy: 0.0, ..v.camera }), &options, &[name, "camera"]);
    let with = |f: &dyn Fn(&mut Options)| {
        let mut options = options.clone();
        f(&mut options);
        options
    };
    refused(&views, &with(&|o| o.sample.steps = 0), &["sample.steps"]);
    refused(
        &views,
        &with(&|o| (o.without_network, o.sample) = (true, o.sample.clone().without_start())),
        &["sample.start"],
    );
    let alone = model.run(&views[..1], &options, &mut go).unwrap_err().to_string();
    assert!(alone.contains("at least 2 views"), "{alone}");
    assert!(matches!(model.run(&views[..0], &options, &mut go), Err(Error::Camera(_))));
    assert!(model.run(&views, &with(&|o| o.seeds.clear()), &mut go).unwrap().samples.is_empty());
}

#[test]
fn threads_may_share_a_model() {
    fn shared<T: Send + Sync>() {}
    shared::<Reconstructor>();
}

/// The view on a larger sheet, transparent around it.
fn on_a_sheet(view: &View, w: u32, h: u32, left: u32, top: u32) -> View {
    let mut image = image::RgbaImage::new(w, h);
    image::imageops::replace(&mut image, &view.image, left.into(), top.into());
    let c = view.camera;
    let camera = Camera { width: w, height: h, cx: c.cx + f64::from(left), cy: c.cy + f64::from(top), ..c };
    View { name: view.name.clone(), camera, image }
}

#[test]
fn photos_of_any_shape_and_size_are_seen_undistorted() {
    let (model, bowl) = (model(), bowl());
    let small = {
        let image = freerange_camera::image_ops::resize_area(&bowl[2].image, 300, 300);
        View { camera: bowl[2].camera.resized(300, 300), image, name: bowl[2].name.clone() }
    };
    let photos =
        [on_a_sheet(&bowl[0], 700, 512, 150, 0), on_a_sheet(&bowl[1], 512, 640, 0, 30), small, bowl[3].clone()];
    // Two are cut to squares about the object, the others are squares.
    let (_, canonical) = to_canonical(&photos, &FrameConfig::default()).unwrap();
    let windows: Vec<_> = canonical.iter().map(Window::framed).collect();
    assert_eq!(windows.iter().map(Option::is_some).collect::<Vec<_>>(), [true, true, false, false]);
    let square = |(v, w): (&View, &Option<Window>)| w.map_or_else(|| v.clone(), |w| w.cut(v).into_owned());
    let squares: Vec<View> = photos.iter().zip(&windows).map(square).collect();
    let mut options = model.options().unwrap();
    options.sample =
        SampleConfig { steps: 4, mirror: 0.0, turn: 0.0, polish: 0, refine: 0, ..options.sample.without_start() };
    let run = |views: &[View], options: &Options| model.run(views, options, &mut go).unwrap().samples.remove(0);
    // What the network and its guidance see of a photo is what a square camera would have seen.
    assert_eq!(run(&photos, &options).gaussians, run(&squares, &options).gaussians);
    // Fit, sampling and refinement take them as they are, and the bowl is where the cameras saw it.
    let mut options = short(&model);
    options.sample.refine = 40;
    let sample = run(&photos, &options);
    let of = |cloud| score(cloud, &bowl).unwrap().unwrap().psnr;
    let (before, after) = (of(sample.unrefined.as_ref().unwrap()), of(&sample.gaussians));
    assert!(before > 18.0 && after > before, "{before} dB, refined {after} dB");
}

#[test]
fn the_model_is_shown_as_many_views_as_it_knows() {
    let model = model();
    assert_eq!(model.views(), 6, "the shipped checkpoint learned from two to six");
    let scene = Scene::load(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/bowl"))).unwrap();
    let mut views = scene.inputs.clone();
    views.extend(scene.further);
    assert!(views.len() > 6);
    let mut options = short(&model);
    options.sample.refine = 0;
    options.seeds = vec![0];
    let whole = model.run(&views, &options, &mut go).unwrap();
    assert!(whole.shown.len() == 6 && whole.shown.is_sorted());
    let note = whole.notes.iter().find(|n| n.contains("6 of")).unwrap();
    assert!(whole.shown.iter().all(|&i| note.contains(&views[i].name)), "{note}");
    options.views = Some(3);
    let three = model.run(&views, &options, &mut go).unwrap();
    assert_eq!(three.shown.len(), 3);
    let alone: Vec<View> = three.shown.iter().map(|&i| views[i].clone()).collect();
    options.views = None;
    let found = model.run(&alone, &options, &mut go).unwrap();
    assert_eq!((found.shown, &found.samples[0].gaussians), (vec![0, 1, 2], &three.samples[0].gaussians));
    // Further views of one place say nothing new.
    let doubled: Vec<View> = views.iter().take(4).cycle().take(12).cloned().collect();
    assert_eq!(model.run(&doubled, &options, &mut go).unwrap().shown, [0, 1, 2, 3]);
    options.views = Some(0);
    assert!(model.run(&views, &options, &mut go).unwrap_err().to_string().contains("views"));
}
