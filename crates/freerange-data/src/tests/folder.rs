use std::collections::BTreeSet;
use std::panic::AssertUnwindSafe;
use std::sync::atomic::{AtomicU64, Ordering};

use super::{assert_same, contents, message, metadata_of, tiny_config, toy, toy_config};
use crate::generate::generate_with;
use crate::{
    DataError, GaussianSource, GenerateConfig, Generated, Manifest, Object, ObjectSource, ShardReader, ShardWriter,
    Shards, contact_sheet, generate_shards, inspect,
};

fn quiet(_: u64, _: u64) {}

#[test]
fn a_shard_returns_what_was_put_in() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.tar");
    let objects: Vec<Object> = (0..3).map(toy).collect();
    let write = || {
        let mut writer = ShardWriter::create(&path).unwrap();
        objects.iter().for_each(|o| writer.add(o, &metadata_of(o)).unwrap());
        assert!(message(writer.add(&objects[1], &metadata_of(&objects[1]))).contains("toy-001"));
        writer.finish().unwrap()
    };
    let (bytes, hash) = write();
    assert_eq!(bytes, std::fs::metadata(&path).unwrap().len());
    let reader = ShardReader::open(&path).unwrap();
    assert_eq!(reader.len(), 3);
    assert_eq!(reader.view_counts().collect::<Vec<_>>(), [2, 2, 2]);
    for (i, object) in objects.iter().enumerate() {
        assert_same(&reader.read(i, &[2, 3]).unwrap(), object);
        assert_eq!(reader.metadata(i).unwrap(), metadata_of(object));
        assert_eq!(reader.read(i, &[3]).unwrap().slices.into_keys().collect::<Vec<_>>(), [3]);
        let error = reader.read(i, &[2, 4]).unwrap_err();
        assert!(matches!(error, DataError::Depth { expected: 4, ref found, .. } if *found == [2, 3]), "{error}");
    }
    assert_eq!(write(), (bytes, hash), "equal objects give equal bytes");
}

#[test]
fn objects_that_could_not_be_read_are_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |change: &dyn Fn(&mut Object), text: &str| {
        let mut object = toy(1);
        change(&mut object);
        let mut writer = ShardWriter::create(&folder.path().join("a.tar")).unwrap();
        let found = message(writer.add(&object, &metadata_of(&object)));
        assert!(found.contains(text), "{found}");
    };
    refused(&|o| o.id = "a.b".into(), "id");
    refused(&|o| o.id = String::new(), "id");
    refused(&|o| o.views.clear(), "views");
    refused(&|o| o.views[1].camera.width = 7, "one size");
    refused(&|o| o.views[0].image = image::RgbaImage::new(3, 4), "3 x 4");
    refused(&|o| o.views[0].camera.fx = f64::NAN, "focal");
    refused(&|o| o.views[0].camera.world_to_camera.x_axis *= 2.0, "rotation");
    refused(&|o| drop(o.slices.insert(4, o.slices[&3].clone())), "8 at depth 4");
    refused(&|o| o.slices.get_mut(&3).unwrap().rows_mut()[5] = f32::NAN, "finite");
    assert_eq!(contents(folder.path()).len(), 0);
}

#[test]
fn a_folder_returns_the_generated_objects() {
    let folder = tempfile::tempdir().unwrap();
    let config = GenerateConfig {
        objects: 5,
        objects_per_shard: 2,
        seed: 40,
        depths: vec![3, 5],
        quality_views: 1,
        object: tiny_config(),
        ..Default::default()
    };
    let heard = AtomicU64::new(0);
    let summary = generate_shards(&config, folder.path(), |done, all| {
        assert!(done <= all && all == 5);
        heard.fetch_add(1, Ordering::Relaxed);
    });
    let summary = summary.unwrap();
    assert_eq!((summary.made, summary.skipped, summary.shards, summary.failures.len()), (5, 0, 3, 0));
    assert_eq!(heard.into_inner(), 6);

    let shards = Shards::open(folder.path(), &[3, 5]).unwrap();
    let source = Generated { config: config.object.clone(), depths: vec![3, 5], seed: 40 };
    let mut seeds = BTreeSet::new();
    for i in 0..5 {
        let metadata = shards.metadata(i).unwrap();
        assert!(metadata.psnr[&5] > 5.0 && metadata.psnr[&5].is_finite(), "{metadata:?}");
        assert_eq!(metadata.config_sha256, config.sha256().unwrap());
        assert_same(&shards.object(i).unwrap(), &source.object(metadata.seed - 40).unwrap());
        seeds.insert(metadata.seed);
    }
    assert_eq!(seeds, (40..45).collect());
    let statistics = shards.manifest().statistics(5).unwrap();
    assert_eq!(statistics.count(), 5 * 32);
    assert!(shards.manifest().statistics(4).is_none());

    let report = inspect(folder.path(), true).unwrap();
    assert!(report.complete && report.verified);
    assert_eq!((report.objects, report.shards, report.bytes), (5, 3, summary.bytes));
    assert_eq!((report.views, report.image_size), (Some([3, 3]), Some([32, 32])));
    assert_eq!(report.statistics[&5], statistics.normalization().unwrap());

    let sheet = contact_sheet(&shards, 3, 2).unwrap();
    assert_eq!(sheet.dimensions(), (2 * (5 * 34 + 2), 2 * 34));
    let first = &shards.object(0).unwrap().views[0].image;
    let opaque = first.enumerate_pixels().find(|(_, _, p)| p.0[3] == 255).unwrap();
    assert_eq!(sheet.get_pixel(opaque.0, opaque.1), opaque.2);
    assert!(message(contact_sheet(&shards, 0, 2)).contains("contact sheet"));
    assert!(message(contact_sheet(&shards, u64::MAX, 2)).contains("16384"));
}

#[test]
fn samples_come_in_one_shuffled_order_over_and_over() {
    let folder = tempfile::tempdir().unwrap();
    generate_with(&toy_config(), folder.path(), quiet, |seed| Ok(toy(seed))).unwrap();
    let shards = Shards::open(folder.path(), &[2]).unwrap();
    assert_eq!(shards.len(), 10);
    let id = |i: u64| shards.object(i).unwrap().id;
    let once: Vec<String> = (0..10).map(id).collect();
    assert_eq!(once.iter().cloned().collect::<BTreeSet<_>>(), (7..17).map(|s| format!("toy-{s:03}")).collect());
    assert!(!once.is_sorted(), "{once:?}");
    assert_eq!((10..20).map(id).collect::<Vec<_>>(), once);
    let far = u64::MAX - u64::MAX % 10;
    assert_eq!(id(far), once[0]);
    let again = Shards::open(folder.path(), &[2]).unwrap();
    assert_eq!((0..10).map(|i| again.object(i).unwrap().id).collect::<Vec<_>>(), once);
}

#[test]
fn interruptions_and_threads_leave_no_trace() {
    let [whole, cut, one] = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let config = toy_config();
    let run = |folder: &std::path::Path| generate_with(&config, folder, quiet, |seed| Ok(toy(seed))).unwrap();
    assert_eq!(run(whole.path()).made, 10);
    let expected = contents(whole.path());
    assert_eq!(expected.len(), 5, "three shards, the manifest and the lock");

    // Dies in the second shard, and leaves a torn file as a kill would.
    let dying = |seed| if seed == 13 { panic!("simulated") } else { Ok(toy(seed)) };
    std::panic::catch_unwind(AssertUnwindSafe(|| generate_with(&config, cut.path(), quiet, dying))).unwrap_err();
    std::fs::write(cut.path().join("shard-00001.tar.partial"), b"half").unwrap();
    std::fs::write(cut.path().join("manifest.json.partial"), b"{").unwrap();
    assert!(message(Shards::open(cut.path(), &[2])).contains("expected 3 shards, found 1"));
    assert!(!inspect(cut.path(), true).unwrap().complete);
    let summary = run(cut.path());
    assert_eq!((summary.made, summary.skipped), (6, 4));
    assert_eq!(contents(cut.path()), expected);

    // Nothing left to do; a shard that shrank; a shard without its record.
    assert_eq!((run(cut.path()).made, contents(cut.path()) == expected), (0, true));
    std::fs::write(cut.path().join("shard-00000.tar"), b"short").unwrap();
    assert_eq!((run(cut.path()).made, contents(cut.path()) == expected), (4, true));
    std::fs::remove_file(cut.path().join("manifest.json")).unwrap();
    assert_eq!((run(cut.path()).made, contents(cut.path()) == expected), (10, true));

    rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(|| run(one.path()));
    assert_eq!(contents(one.path()), expected);
}

#[test]
fn failing_objects_are_recorded_and_the_rest_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let broken =
        |what: &str| DataError::Config { field: what.into(), expected: "a whole one".into(), found: "none".into() };
    let make = |seed| if seed % 4 == 0 { Err(broken("mesh")) } else { Ok(toy(seed)) };
    let summary = generate_with(&toy_config(), folder.path(), quiet, make).unwrap();
    assert_eq!(summary.made, 7);
    assert_eq!(summary.failures.iter().map(|f| (f.object, f.seed)).collect::<Vec<_>>(), [(1, 8), (5, 12), (9, 16)]);
    assert!(summary.failures[0].reason.contains("mesh: expected a whole one"));
    assert_eq!(Manifest::load(folder.path()).unwrap().shards[1].failures[0].seed, 12);
    assert_eq!(Shards::open(folder.path(), &[3]).unwrap().len(), 7);
    assert_eq!(inspect(folder.path(), true).unwrap().failures, summary.failures);
    // Not tried again: what is made from a seed does not change.
    let summary = generate_with(&toy_config(), folder.path(), quiet, |_| panic!("nothing to do")).unwrap();
    assert_eq!((summary.made, summary.skipped, summary.failures.len()), (0, 10, 3));

    let folder = tempfile::tempdir().unwrap();
    let none = generate_with(&toy_config(), folder.path(), quiet, |_| Err(broken("generator")));
    assert!(message(none).contains("generator"));
    assert!(!folder.path().join("shard-00000.tar").exists());
}

#[test]
fn another_configuration_or_process_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let config = toy_config();
    generate_with(&config, folder.path(), quiet, |seed| {
        let second = generate_with(&config, folder.path(), quiet, |seed| Ok(toy(seed)));
        assert!(message(second).contains("another process"));
        Ok(toy(seed))
    })
    .unwrap();
    let before = contents(folder.path());
    let mut other = config.clone();
    other.object.surface.spread += 0.01;
    let refused = generate_with(&other, folder.path(), quiet, |seed| Ok(toy(seed)));
    assert!(message(refused).contains("another configuration"));
    assert_eq!(contents(folder.path()), before);
}

#[test]
fn impossible_configurations_are_named() {
    let refused = |change: &dyn Fn(&mut GenerateConfig), field: &str| {
        let mut config = toy_config();
        change(&mut config);
        let found = message(config.validate());
        assert!(found.starts_with(field), "{found}");
    };
    refused(&|c| c.objects = 0, "objects");
    refused(&|c| c.objects_per_shard = u64::MAX, "objects_per_shard");
    refused(&|c| c.depths = vec![3, 2], "depths");
    refused(&|c| c.depths.clear(), "depths");
    refused(&|c| c.depths = vec![40], "depths");
    refused(&|c| c.object.views = 0, "object.views");
    refused(&|c| c.quality_views = 9, "quality_views");
    refused(
        &|c| {
            c.quality_views = 1;
            c.object.gaussians = GaussianSource::Fit;
        },
        "quality_views",
    );
    refused(&|c| (c.quality_views, c.object.polish) = (1, 5), "quality_views");
    toy_config().validate().unwrap();
}
