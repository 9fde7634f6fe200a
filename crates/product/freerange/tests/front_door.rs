//! The main job through the front door: what is told on the way, how it is stopped, what is refused.

use std::{ops::ControlFlow, path::Path};

use freerange::{
    Camera, Choices, Detect, Device, Error, Gaussians, Init, Options, Progress, Quality, Reconstructor, RefinerConfig,
    Scene, Similarity, Stage, View, score, to_canonical,
};
use freerange_scene::camera::{FrameConfig, Window};
use glam::{DQuat, DVec3};

fn model() -> Reconstructor {
    Reconstructor::shipped(&Device::cpu()).unwrap()
}

fn scene() -> Scene {
    Scene::open(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../examples/bowl"))).unwrap()
}

fn bowl() -> Vec<View> {
    scene().loaded.views
}

/// Quick to run, with every stage but symmetry.
fn short(model: &Reconstructor) -> Options {
    let mut options = model.options().unwrap();
    let pipeline = &mut options.pipeline;
    pipeline.propose.fit.iterations = 20;
    pipeline.propose.count = 1;
    refiner(&mut options).passes = 3;
    options.seeds = vec![4, 5];
    options.pipeline.optimize.iterations = 4;
    options.pipeline.symmetry.detect = Detect::Off;
    options
}

fn refiner(options: &mut Options) -> &mut RefinerConfig {
    options.pipeline.refine.as_mut().expect("the shipped model refines initial fits")
}

fn go(_: &Progress<'_>) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

/// The scene in another frame: cameras moved, turned and scaled.
fn elsewhere(views: &[View], to: &Similarity) -> Vec<View> {
    views.iter().map(|v| View { camera: v.camera.transformed(to), ..v.clone() }).collect()
}

#[test]
fn every_step_is_reported_and_the_last_preview_is_the_result_in_the_users_frame() {
    let model = model();
    let mut options = short(&model);
    // Away from the canonical frame, where nothing that stays in it would agree with the cameras.
    let to = Similarity { scale: 3.0, rotation: DQuat::from_rotation_z(0.4), translation: DVec3::new(5.0, -2.0, 1.0) };
    let views = elsewhere(&bowl(), &to);
    let (mut reports, mut previews) = (Vec::new(), Vec::new());
    let result = model
        .run(&views, &options, &mut |p| {
            reports.push((p.stage, p.sample, p.done, p.total));
            let preview = p.preview().unwrap();
            let begins = p.done == 0;
            assert_eq!(preview.is_some(), !begins && p.total > 1);
            assert_eq!(p.loss.is_some(), preview.is_some() && p.stage != Stage::Refine);
            previews.extend(preview.map(|cloud| (p.stage, p.sample, cloud)));
            ControlFlow::Continue(())
        })
        .unwrap();
    let steps = |stage, sample, total: usize| (0..=total).map(move |done| (stage, sample, done, total));
    // The fit that finds the object is of seed 0: each sample has one of its own.
    let mut expected: Vec<_> = std::iter::once((Stage::Canonicalize, 0, 0, 1)).collect();
    expected.extend(steps(Stage::Canonicalize, 0, 20));
    for sample in 0..2 {
        expected.extend(steps(Stage::Propose, sample, 20));
        expected.extend(steps(Stage::Refine, sample, 3));
        expected.extend(steps(Stage::Optimize, sample, 4));
    }
    assert_eq!(reports, expected);
    let stages: Vec<Stage> = result.seconds.iter().map(|s| s.0).collect();
    assert_eq!(stages, [Stage::Canonicalize, Stage::Symmetry, Stage::Propose, Stage::Refine, Stage::Optimize]);
    let of = |stage, sample| {
        let of = previews.iter().filter(move |e| (e.0, e.1) == (stage, sample));
        of.map(|e| e.2.clone()).collect::<Vec<Gaussians>>()
    };
    let fitted = of(Stage::Propose, 0);
    assert!(fitted.len() == 20 && fitted.windows(2).all(|pair| pair[0] != pair[1]));
    let psnr = |cloud: &Gaussians| score(cloud, &views).unwrap().unwrap().psnr;
    let (before, after) = (psnr(&fitted[0]), psnr(&fitted[19]));
    assert!(before > 10.0 && after > before, "in the frame of the cameras, and better: {before} dB, {after} dB");
    for (i, sample) in result.samples.iter().enumerate() {
        let (refined, optimized) = (of(Stage::Refine, i), of(Stage::Optimize, i));
        let before = sample.before_optimization.as_ref().unwrap();
        assert!(refined.len() == 3 && &refined[2] == before && &refined[1] != before);
        assert!(optimized.len() == 4 && optimized[0] != optimized[3]);
        // But for the labels of axes, which are made canonical at the end.
        let means = |cloud: &Gaussians| (0..cloud.len()).map(|k| cloud.mean(k)).collect::<Vec<_>>();
        assert_eq!(means(&optimized[3]), means(&sample.gaussians));
        let found = psnr(&sample.gaussians);
        assert!(found > 18.0, "{found} dB");
    }
    assert_eq!(result.samples.iter().map(|s| s.seed).collect::<Vec<_>>(), [4, 5]);
    assert_ne!(result.samples[0].gaussians, result.samples[1].gaussians);

    // The same without anyone who looks, and whatever is drawn beside it.
    options.seeds = vec![5];
    let alone = model.run(&views, &options, &mut go).unwrap();
    assert_eq!(alone.samples[0].gaussians, result.samples[1].gaussians);
    assert_eq!(alone.canonical_from_user, result.canonical_from_user);
    options.pipeline.optimize.iterations = 0;
    let plain = model.run(&views, &options, &mut go).unwrap();
    assert!(plain.samples[0].before_optimization.is_none());
    assert_eq!(Some(&plain.samples[0].gaussians), alone.samples[0].before_optimization.as_ref());
}

/// The first proposal is what it is without the others; what comes of them together is not.
#[test]
fn proposals_are_optimized_together() {
    let model = model();
    let views = bowl();
    let mut options = short(&model);
    options.seeds.truncate(1);
    let run = |options: &Options| {
        let (mut reports, mut previews) = (Vec::new(), Vec::new());
        let made = model.run(&views, options, &mut |p| {
            reports.push((p.stage, p.done, p.total));
            previews.extend(p.preview().unwrap().map(|cloud| (p.stage, cloud)));
            ControlFlow::Continue(())
        });
        (made.unwrap(), reports, previews)
    };
    let (alone, _, own) = run(&options);
    options.pipeline.propose.count = 3;
    let (together, reports, previews) = run(&options);
    let steps = |stage, total: usize| (0..=total).map(move |done| (stage, done, total));
    let expected: Vec<_> = steps(Stage::Propose, 60).chain(steps(Stage::Refine, 9)).collect();
    assert_eq!(reports[1..1 + expected.len()], expected);
    // Proposals are worked on beside each other; previews show the first, which is what it is alone.
    for (stage, count) in [(Stage::Propose, 20), (Stage::Refine, 3)] {
        let of =
            |all: &[(Stage, Gaussians)]| all.iter().filter(|e| e.0 == stage).map(|e| e.1.clone()).collect::<Vec<_>>();
        assert!(of(&previews).len() == count && of(&previews) == of(&own), "{stage}");
    }
    assert_eq!(alone.samples[0].before_optimization, together.samples[0].before_optimization);
    // However many threads there are, and within a pool, where the caller is one of them.
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let same = one.install(|| model.run(&views, &options, &mut go)).unwrap();
    assert_eq!(same.samples[0].gaussians, together.samples[0].gaussians);
    assert_ne!(alone.samples[0].gaussians, together.samples[0].gaussians);
    assert_eq!(alone.canonical_from_user, together.canonical_from_user);
}

/// A bowl has a mirror plane and an axis: both add to the targets, and the user hears of it.
#[test]
fn symmetries_add_targets() {
    let model = model();
    let views = bowl();
    let mut options = short(&model);
    options.seeds.truncate(1);
    options.pipeline.optimize.iterations = 0;
    options.pipeline.symmetry.detect = Detect::Auto;
    let run = |reflection, revolution, iterations| {
        let mut options = options.clone();
        options.pipeline.optimize.iterations = iterations;
        let symmetry = &mut options.pipeline.symmetry;
        (symmetry.reflection_threshold, symmetry.revolution_threshold) = (reflection, revolution);
        let mut reports = Vec::new();
        let made = model.run(&views, &options, &mut |p| {
            reports.push((p.stage, p.done, p.total));
            ControlFlow::Continue(())
        });
        let made = made.unwrap();
        let noted = ["symmetric about the plane", "solid of revolution"];
        let noted = noted.map(|what| made.notes.iter().any(|n| n.contains(what)));
        assert!(reports.windows(2).all(|pair| pair[0].0 <= pair[1].0), "stages come in their order");
        reports.retain(|r| r.0 == Stage::Symmetry);
        (noted, made, reports)
    };
    let (noted, without, reports) = run(0.0, 0.0, 0);
    assert!(noted == [false, false] && reports.iter().all(|r| r.2 == 0));
    let (noted, contradicted, _) = run(1e-6, 1e-6, 0);
    assert_eq!((noted, &contradicted.samples[0].gaussians), ([false, false], &without.samples[0].gaussians));
    let (noted, mirrored, _) = run(100.0, 0.0, 0);
    assert_eq!((noted, &mirrored.network_views), ([true, false], &without.network_views));
    let (noted, rotated, _) = run(0.0, 100.0, 0);
    assert_eq!(noted, [false, true]);
    let (noted, both, reports) = run(100.0, 100.0, 0);
    assert_eq!(noted, [true, true]);
    let made = [&without, &mirrored, &rotated, &both].map(|made| &made.samples[0].gaussians);
    assert!((0..4).all(|i| (0..i).all(|j| made[i] != made[j])), "each adds something else");
    let (first, last) = (reports[0], reports[reports.len() - 1]);
    assert!(first.1 == 0 && last.1 == last.2, "{first:?} {last:?}");
    assert!(reports.windows(2).all(|pair| pair[0].1 <= pair[1].1 && pair[0].2 == pair[1].2), "one stage");
    // The optimization agrees with them as well.
    let [plain, held] = [0.0, 100.0].map(|revolution| run(0.0, revolution, 3).1.samples.remove(0));
    assert_ne!(plain.gaussians, held.gaussians);

    // At its threshold a symmetry has half of its weight, which is a half for mirrored photos, and beyond the ramp none.
    let note = mirrored.notes.iter().find(|n| n.contains("symmetric about the plane")).unwrap().to_string();
    assert!(note.contains("weight 0.50"), "{note}");
    let residual: f64 = note.split("residual ").nth(1).unwrap().split(',').next().unwrap().parse().unwrap();
    let (noted, half, _) = run(residual, 0.0, 0);
    assert_eq!(noted, [true, false]);
    let note = half.notes.iter().find(|n| n.contains("symmetric about the plane")).unwrap().to_string();
    let weight: f64 = note.split("weight ").nth(1).unwrap().trim_end_matches([')', '.']).parse().unwrap();
    assert!((0.2..=0.3).contains(&weight), "{note}");
    assert!([&without, &mirrored].iter().all(|made| made.samples[0].gaussians != half.samples[0].gaussians));
    let (noted, beyond, _) = run(residual - 0.11, 0.0, 0);
    assert_eq!((noted, &beyond.samples[0].gaussians), ([false, false], &without.samples[0].gaussians));

    // What was judged with four photos is not applied to more.
    let scene = scene();
    let many = [scene.views(), scene.further()].concat();
    options.pipeline.symmetry.reflection_threshold = 100.0;
    let made = model.run(&many, &options, &mut |p| {
        assert_ne!(p.stage, Stage::Symmetry);
        ControlFlow::Continue(())
    });
    assert!(made.unwrap().notes.iter().any(|n| n.contains("no symmetry is looked for")));
    for last in [0, 5] {
        let mut after = 0;
        let stopped = model.run(&views, &options, &mut |p| {
            after += usize::from(after > 0);
            if (p.stage, p.done) == (Stage::Symmetry, last) {
                after = 1;
            }
            if after > 0 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        assert!(matches!(stopped, Err(Error::Cancelled)) && after == 1, "{last}: told {after} times");
    }
}

/// Samples of the flow take the place of fits: everything after them is the same.
#[test]
fn samples_of_the_flow_are_proposals_too() {
    let (model, views) = (model(), bowl());
    let mut options = short(&model);
    // Rough samples, and a few of them.
    options.seeds = vec![4, 5, 6];
    options.pipeline.propose.init = Init::Flow;
    options.pipeline.propose.flow.steps = 2;
    options.pipeline.optimize.iterations = 0;
    let mut reports = Vec::new();
    let quality = |options: &Options, reports: &mut Vec<_>| {
        let made = model.run(&views, options, &mut |p| {
            reports.push((p.stage, p.sample, p.done, p.total));
            ControlFlow::Continue(())
        });
        let made = made.unwrap();
        let scores = made.samples.iter().map(|s| score(&s.gaussians, &views).unwrap().unwrap().psnr);
        scores.sum::<f64>() / made.samples.len() as f64
    };
    refiner(&mut options).passes = 1;
    let before = quality(&options, &mut reports);
    assert!(reports.contains(&(Stage::Propose, 2, 2, 2)) && reports.contains(&(Stage::Refine, 2, 1, 1)));
    refiner(&mut options).passes = 6;
    let after = quality(&options, &mut reports);
    assert!(after > before, "{before} dB, more passes of the network {after} dB");
    options.pipeline.optimize.iterations = 60;
    let optimized = quality(&options, &mut reports);
    assert!(optimized > after + 0.4, "{after} dB, optimized {optimized} dB");
}

#[test]
fn choices_are_presets_and_fields() {
    let model = model();
    let of = |choices: Choices| model.options_of(&choices).map(|o| o.pipeline).map_err(|e| e.to_string());
    let default = of(Choices::default()).unwrap();
    assert_eq!((default.propose.count, default.optimize.iterations, default.network_views), (4, 400, 6));
    assert_eq!((default.propose.fit.gaussians, default.optimize.max_gaussians()), (2048, 32_768));
    let draft = of(Choices { quality: Quality::Draft, ..Choices::default() }).unwrap();
    assert!(draft.propose.count == 1 && draft.symmetry.detect == Detect::Off && draft.optimize.iterations < 400);
    let plain = of(Choices { iterations: Some(0), ..Choices::default() }).unwrap();
    assert_eq!((plain.optimize.iterations, plain.propose.count), (0, 1));
    let set = |key: &str, value: &str| of(Choices { set: vec![(key.into(), value.into())], ..Choices::default() });
    assert_eq!(set("refine.passes", "5").unwrap().refine.unwrap().passes, 5);
    assert_eq!(set("propose.init", "flow").unwrap().propose.init, Init::Flow);
    assert_eq!(set("propose.flow.lod_depth", "9").unwrap().propose.flow.lod_depth, Some(9));
    let unknown = set("refine.pases", "5").unwrap_err();
    assert!(unknown.contains("refine.pases") && unknown.contains("refine.passes"), "{unknown}");
    assert!(set("refine.passes", "many").unwrap_err().contains("--set refine.passes"));
    assert!(set("refine", "5").unwrap_err().contains("refine.passes"), "no field of its own");
    // Every field is in a record, and read again.
    let record = serde_json::to_value(&default).unwrap();
    assert_eq!(serde_json::from_value::<freerange::PipelineConfig>(record).unwrap(), default);
}

#[test]
fn it_stops_where_it_is_told_to() {
    let (model, views) = (model(), bowl());
    let options = short(&model);
    for (stage, done) in
        [(Stage::Canonicalize, 0), (Stage::Propose, 2), (Stage::Refine, 0), (Stage::Refine, 1), (Stage::Optimize, 1)]
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
    refused(&views, &with(&|o| o.pipeline.propose.flow.steps = 0), &["propose.flow.steps"]);
    refused(&views, &with(&|o| refiner(o).passes = 0), &["refine.passes"]);
    refused(&views, &with(&|o| o.pipeline.optimize.iterations = 0), &["propose.count", "optimization"]);
    refused(&views, &with(&|o| o.pipeline.optimize.max_resolution = 300), &["optimize.max_resolution", "256"]);
    refused(&views, &with(&|o| o.pipeline.network_views = 0), &["network_views"]);
    refused(&views, &with(&|o| o.pipeline.refine = None), &["propose.init"]);
    let flow = |o: &mut Options| {
        *o = freerange::internal::without_network(o.clone(), true);
        o.pipeline.propose.init = Init::Flow;
    };
    refused(&views, &with(&flow), &["propose.init"]);
    let alone = model.run(&views[..1], &options, &mut go).unwrap_err().to_string();
    assert!(alone.contains("at least 2 views"), "{alone}");
    assert!(matches!(model.run(&views[..0], &options, &mut go), Err(Error::Scene(_))));
    assert!(model.run(&views, &with(&|o| o.seeds.clear()), &mut go).unwrap().samples.is_empty());
}

/// World to camera where camera to world is expected: whatever the rounding, wherever masks come from.
#[test]
fn cameras_at_one_place_are_refused() {
    let bowl = bowl();
    let inverted = |shake: f64, shift: DVec3| {
        let of = |(i, v): (usize, &View)| {
            let mut camera = v.camera;
            camera.world_to_camera.w_axis += (shake * DVec3::new(i as f64, -1.0, (3 * i % 2) as f64)).extend(0.0);
            camera.world_to_camera = camera.world_to_camera.inverse();
            let to = Similarity { scale: 2.0, rotation: DQuat::IDENTITY, translation: shift };
            View { camera: camera.transformed(&to), ..v.clone() }
        };
        bowl.iter().enumerate().map(of).collect::<Vec<View>>()
    };
    let model = model();
    for shake in [0.0, 1e-7, 1e-5, 1e-4] {
        let mut views = inverted(shake, DVec3::ZERO);
        let refused = |error: Error| {
            assert!(matches!(&error, Error::Input { field, .. } if field == "cameras") && !error.is_failure());
            let text = error.to_string();
            assert!(text.contains("all of them at one place") && text.contains("world-to-camera"), "{text}");
        };
        refused(model.run(&views, &short(&model), &mut go).unwrap_err());
        refused(to_canonical(&views, &FrameConfig::default()).unwrap_err());
        views.iter_mut().flat_map(|v| v.image.pixels_mut()).for_each(|p| p[3] = 255);
        refused(freerange::cut_out(&mut views, &Default::default()).unwrap_err());
    }
    // An object far from the origin is one all the same.
    let far = Similarity { scale: 1.0, rotation: DQuat::IDENTITY, translation: DVec3::new(4.5e5, 5.2e6, 300.0) };
    to_canonical(&elsewhere(&bowl, &far), &FrameConfig::default()).unwrap();
    // One that is next to nothing is none.
    let config = FrameConfig { radius: Some(1e-4), ..FrameConfig::default() };
    let tiny = to_canonical(&bowl, &config).unwrap_err().to_string();
    assert!(tiny.starts_with("radius: expected an object of a pixel or more"), "{tiny}");
}

#[test]
fn what_may_be_wrong_with_views_is_told_before() {
    let told = |views: Vec<View>| {
        let loaded = freerange::load_views(views, &Default::default(), &freerange::Stop::default()).unwrap();
        let notes = freerange::warnings_of(&loaded, &FrameConfig::default(), 6).unwrap();
        notes.into_iter().map(|n| n.text).collect::<Vec<String>>().join("; ")
    };
    let bowl = bowl();
    let same = scene().warnings(6).unwrap();
    assert_eq!(told(bowl.clone()), same.iter().map(|n| n.text.as_str()).collect::<Vec<_>>().join("; "));
    assert!(told(bowl[..3].to_vec()).contains("only 3 photos"));
    let mut twice = bowl.clone();
    twice.push(View { camera: bowl[0].camera, name: "again".into(), ..bowl[1].clone() });
    assert!(told(twice).contains("different photos have the same pose"));
    let stopped = freerange::Stop::on(std::sync::Arc::new(true.into()), None);
    assert!(matches!(freerange::load_views(bowl, &Default::default(), &stopped), Err(Error::Cancelled)));
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
        let image = freerange_scene::camera::image_ops::resize_area(&bowl[2].image, 300, 300);
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
    let mut options = short(&model);
    options.seeds.truncate(1);
    options.pipeline.optimize.iterations = 0;
    let run = |views: &[View], options: &Options| model.run(views, options, &mut go).unwrap().samples.remove(0);
    // What the network and its guidance see of a photo is what a square camera would have seen.
    assert_eq!(run(&photos, &options).gaussians, run(&squares, &options).gaussians);
    // The optimization takes them as they are, and the bowl is where the cameras saw it.
    options.pipeline.optimize.iterations = 40;
    let sample = run(&photos, &options);
    let of = |cloud| score(cloud, &bowl).unwrap().unwrap().psnr;
    let (before, after) = (of(sample.before_optimization.as_ref().unwrap()), of(&sample.gaussians));
    assert!(before > 18.0 && after > before, "{before} dB, optimized {after} dB");
}

#[test]
fn the_network_sees_as_many_views_as_it_knows() {
    let model = model();
    assert_eq!(model.network_views().unwrap(), 6, "the shipped checkpoint learned from two to six");
    let scene = scene();
    let views = [scene.views(), scene.further()].concat();
    assert!(views.len() > 6);
    let mut options = short(&model);
    options.pipeline.optimize.iterations = 0;
    options.seeds = vec![0];
    let whole = model.run(&views, &options, &mut go).unwrap();
    assert!(whole.network_views.len() == 6 && whole.network_views.is_sorted());
    let note = whole.notes.iter().find(|n| n.contains("6 of")).unwrap();
    assert!(whole.network_views.iter().all(|&i| note.contains(&views[i].name)), "{note}");
    options.pipeline.network_views = 3;
    let three = model.run(&views, &options, &mut go).unwrap();
    assert_eq!(three.network_views.len(), 3);
    let alone: Vec<View> = three.network_views.iter().map(|&i| views[i].clone()).collect();
    options.pipeline.network_views = 6;
    let found = model.run(&alone, &options, &mut go).unwrap();
    assert_eq!((found.network_views, &found.samples[0].gaussians), (vec![0, 1, 2], &three.samples[0].gaussians));
    // Further views of one place say nothing new.
    let doubled: Vec<View> = views.iter().take(4).cycle().take(12).cloned().collect();
    assert_eq!(model.run(&doubled, &options, &mut go).unwrap().network_views, [0, 1, 2, 3]);
}
