//! Folders of shards in the making: interrupted, shared, taken up again, merged.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

use super::{
    assert_same, build_toys, contents, message, metadata_of, open, tiny_config, toy, toy_config, toy_items, write_shard,
};
use crate::build::folder::{build_with, merge};
use crate::build::{
    BuildConfig, BuildError, BuildOptions, GaussianSource, Generated, Items, ShardConfig, Share, build, collect,
    contact_sheet, estimate,
};
use crate::layout::object_bytes;
use crate::{DataError, ImageFormat, Manifest, Object, ObjectSource, ShardReader, Shards, Split, Store, inspect};
use freerange_util::Invalid;

fn one_of(index: u64, count: u64) -> BuildOptions {
    BuildOptions { share: Share { index, count }, ..BuildOptions::default() }
}

#[test]
fn a_shard_returns_what_was_put_in() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.tar");
    for format in [ImageFormat::Png, ImageFormat::Webp] {
        write_shard(&path, 0..3, format);
        let reader = ShardReader::open(&path).unwrap();
        assert_eq!(reader.len(), 3);
        for i in 0..3 {
            let object = toy(i as u64);
            assert_same(&reader.read(i, &[2, 3]).unwrap(), &object);
            assert_eq!(reader.metadata(i).unwrap(), metadata_of(&object));
            assert_eq!(reader.leaves(i).unwrap().unwrap(), object.slices[&3]);
            assert_eq!(reader.id(i), Some(object.id.as_str()));
            assert_eq!(reader.read(i, &[3]).unwrap().slices.into_keys().collect::<Vec<_>>(), [3]);
            let error = reader.read(i, &[2, 4]).unwrap_err();
            assert!(matches!(error, DataError::Depth { expected: 4, ref found, .. } if *found == [2, 3]), "{error}");
        }
        let first = std::fs::read(&path).unwrap();
        write_shard(&path, 0..3, format);
        assert_eq!(std::fs::read(&path).unwrap(), first, "equal objects give equal bytes");
    }
}

#[test]
fn objects_that_could_not_be_read_are_not_written() {
    let refused = |change: &dyn Fn(&mut Object), text: &str| {
        let mut object = toy(1);
        change(&mut object);
        let found = object_bytes(&object, None, &metadata_of(&object), ImageFormat::Png, Path::new("a.tar"));
        let found = message(found);
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
}

#[test]
fn a_folder_returns_the_generated_objects() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::local(folder.path());
    let shard = ShardConfig { objects_per_shard: 2, leaves: true, min_psnr: 0.0, ..ShardConfig::default() };
    let mut config = BuildConfig { depths: vec![3, 5], shard, object: tiny_config(), ..Default::default() };
    config.object.views = 20;
    config.shard.validation = 0.0;
    config.shard.test = 0.0;
    let items = Items::generated(5, 40);
    let heard = AtomicU64::new(0);
    let summary = build(&config, &items, &store, &BuildOptions::default(), |done| {
        assert!(done.count[0] <= 5 && done.count[1] == 5 && done.result.is_some_and(|r| r.is_ok()));
        heard.fetch_add(1, Ordering::Relaxed);
    });
    let summary = summary.unwrap();
    assert_eq!((summary.made, summary.skipped, summary.shards, summary.failures.len()), (5, 0, 3, 0));
    assert!(summary.complete && summary.seconds.total() > 0.0);
    assert_eq!(heard.into_inner(), 5);

    let shards = open(folder.path(), &[3, 5]).unwrap();
    let source = Generated { config: config.object.clone(), depths: vec![3, 5], seed: 40 };
    let mut seeds = BTreeSet::new();
    for i in 0..5 {
        let metadata = shards.metadata(i).unwrap();
        let psnr = metadata.psnr.unwrap();
        assert!(psnr.slices[&5] > 5.0 && psnr.leaves.is_finite(), "{psnr:?}");
        let evaluation = metadata.evaluation.unwrap();
        assert_eq!((evaluation.full.len(), evaluation.partial.len(), evaluation.validation.len()), (4, 4, 12));
        assert_same(&shards.object(i).unwrap(), &source.object(metadata.seed - 40).unwrap());
        assert_eq!(shards.leaves(i).unwrap().unwrap().len() as u64, metadata.gaussians);
        seeds.insert(metadata.seed);
    }
    assert_eq!(seeds, (40..45).collect());
    let statistics = shards.manifest().statistics(5).unwrap();
    assert_eq!(statistics.count(), 5 * 32);
    assert!(shards.manifest().statistics(4).is_none());

    let report = inspect(&store, true).unwrap();
    assert!(report.complete && report.verified && report.evaluation == Some(true));
    assert_eq!((report.objects, report.shards, report.bytes), (5, 3, summary.bytes));
    assert_eq!((report.views, report.image_size), (Some(20), Some([32, 32])));
    assert_eq!(report.statistics[&5], statistics.normalization().unwrap());
    assert_eq!(report.licenses, BTreeMap::from([("CC0-1.0".into(), 5)]));

    let some = |n: u64| (0..n).map(|i| Ok((shards.object(i)?, shards.leaves(i)?))).collect::<Vec<_>>().into_iter();
    let sheet = contact_sheet(some(3), 2).unwrap();
    assert_eq!(sheet.dimensions(), (2 * (6 * 34 + 2), 2 * 34));
    let first = &shards.object(0).unwrap().views[0].image;
    let opaque = first.enumerate_pixels().find(|(_, _, p)| p.0[3] == 255).unwrap();
    assert_eq!(sheet.get_pixel(opaque.0, opaque.1), opaque.2);
    assert!(message(contact_sheet(some(0), 2)).contains("contact sheet"));
}

#[test]
fn what_many_objects_cost_is_measured() {
    let mut config = BuildConfig { depths: vec![3], object: tiny_config(), ..Default::default() };
    config.shard.min_psnr = 99.0;
    let cost = estimate(&config, &Items::generated(1000, 0), 3, |_| ()).unwrap();
    assert_eq!((cost.sampled, cost.failed, cost.flagged), (3, 0, 3));
    assert!(cost.seconds.render > 0.0 && cost.bytes > 1000.0);
    assert!((cost.core_hours(7200) - 2.0 * cost.seconds.total()).abs() < 1e-9);
    assert!((cost.gigabytes(1_000_000) - cost.bytes / 1000.0).abs() < 1e-9);
}

#[test]
fn samples_come_over_and_over_each_time_in_another_order() {
    let folder = tempfile::tempdir().unwrap();
    build_toys(folder.path(), &BuildOptions::default(), |_| Ok(30.0)).unwrap();
    let shards = open(folder.path(), &[2]).unwrap();
    assert_eq!(shards.len(), 10);
    let id = |i: u64| shards.object(i).unwrap().id;
    let all: BTreeSet<String> = (7..17).map(|s| format!("generated-{s:08}")).collect();
    let last = (u64::MAX / 10 - 1) * 10;
    let epochs = [0, 10, 20, last].map(|first| (first..first + 10).map(id).collect::<Vec<_>>());
    for (i, epoch) in epochs.iter().enumerate() {
        assert_eq!(epoch.iter().cloned().collect::<BTreeSet<_>>(), all, "all objects, each once");
        assert!(!epoch.is_sorted(), "{epoch:?}");
        assert!(epochs[..i].iter().all(|other| other != epoch), "{epochs:?}");
    }
    // The same from any number on, and in any order of asking.
    let again = open(folder.path(), &[2]).unwrap();
    let id = |i: u64| again.object(i).unwrap().id;
    assert_eq!(
        (id(23), id(last), id(5), id(14)),
        (epochs[2][3].clone(), epochs[3][0].clone(), epochs[0][5].clone(), epochs[1][4].clone())
    );
    let other = open(folder.path(), &[2]).unwrap().shuffled_by(1234);
    assert_ne!((0..10).map(|i| other.object(i).unwrap().id).collect::<Vec<_>>(), epochs[0]);
}

#[test]
fn parts_of_the_data_and_bad_fits_are_kept_apart() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::local(folder.path());
    let mut config = toy_config();
    (config.shard.validation, config.shard.test) = (0.3, 0.3);
    let make = |item: &crate::build::Item| {
        let seed = item.seed.unwrap();
        Ok(super::made(seed, if seed == 9 { 19.9 } else { 20.0 }))
    };
    let summary = build_with(&config, &toy_items(), &store, &BuildOptions::default(), |_| (), make).unwrap();
    assert_eq!(summary.flagged, ["generated-00000009"]);
    let count = |split| Shards::open(&store, &[2], split).map_or(0, |s| s.len());
    let parts = [Split::Train, Split::Validation, Split::Test].map(|s| count(Some(s)));
    assert_eq!(parts.iter().sum::<usize>(), 9, "{parts:?}");
    assert_eq!(count(None), 9);
    assert!(parts.iter().all(|&n| n > 0), "{parts:?}");
    let report = inspect(&store, true).unwrap();
    assert_eq!((report.objects, report.flagged), (10, summary.flagged));
    assert_eq!(report.splits.values().sum::<u64>(), 10);
    assert_eq!(report.psnr, Some([19.9, 20.0, 20.0]));
    let statistics = Manifest::load(&store).unwrap().statistics(2).unwrap();
    assert_eq!(statistics.count(), 4 * parts[0] as u64);
}

#[test]
fn interruptions_shares_and_threads_leave_no_trace() {
    let [whole, cut, shared, one] = [(); 4].map(|()| tempfile::tempdir().unwrap());
    let run = |folder: &Path, options: &BuildOptions| build_toys(folder, options, |_| Ok(30.0)).unwrap();
    assert_eq!(run(whole.path(), &BuildOptions::default()).made, 10);
    let expected = contents(whole.path());
    assert_eq!(expected.len(), 8, "three shards with their records, the plan and the manifest: {:?}", expected.keys());

    // The disk fills up in the second shard, and a kill leaves torn files.
    let dying = |seed| {
        if seed == 13 {
            std::fs::create_dir_all(cut.path().join("parts/shard-00001/0000000006.tar")).unwrap();
        }
        Ok(30.0)
    };
    let workers = BuildOptions { workers: 1, ..BuildOptions::default() };
    assert!(message(build_toys(cut.path(), &workers, dying)).contains("0000000006.tar"));
    std::fs::remove_dir(cut.path().join("parts/shard-00001/0000000006.tar")).unwrap();
    for torn in ["parts/shard-00001/0000000006.tar", "shard-00001.tar", "manifest.json"] {
        std::fs::write(cut.path().join(format!("{torn}.partial-0-of-1")), b"half").unwrap();
    }
    assert!(message(open(cut.path(), &[2])).contains("expected 3 shards, found 1"));
    assert!(!inspect(&Store::local(cut.path()), true).unwrap().complete);
    assert_eq!(Shards::open_finished(&Store::local(cut.path()), &[2], None).unwrap().len(), 4, "one shard of four");
    let summary = run(cut.path(), &workers);
    assert_eq!((summary.made, summary.skipped), (4, 6), "objects of unfinished shards are kept");
    assert_eq!(contents(cut.path()), expected);

    // Nothing left to do; a shard that shrank; a shard without its record.
    assert_eq!((run(cut.path(), &workers).made, contents(cut.path()) == expected), (0, true));
    std::fs::write(cut.path().join("shard-00000.tar"), b"short").unwrap();
    assert_eq!((run(cut.path(), &workers).made, contents(cut.path()) == expected), (4, true));
    std::fs::remove_file(cut.path().join("shard-00002.json")).unwrap();
    std::fs::remove_file(cut.path().join("manifest.json")).unwrap();
    assert_eq!((run(cut.path(), &workers).made, contents(cut.path()) == expected), (2, true));

    // Three processes, in any order; the last one writes the manifest.
    assert_eq!(run(shared.path(), &one_of(7, 9)).shards, 0, "more processes than shards");
    for (index, complete) in [(2, false), (0, false), (1, true)] {
        assert_eq!(run(shared.path(), &one_of(index, 3)).complete, complete);
    }
    assert_eq!(contents(shared.path()), expected);
    rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(|| run(one.path(), &one_of(0, 1)));
    assert_eq!(contents(one.path()), expected);
}

#[test]
fn folders_are_merged_exactly() {
    let [whole, a, b] = [(); 3].map(|()| tempfile::tempdir().unwrap());
    build_toys(whole.path(), &BuildOptions::default(), |_| Ok(30.0)).unwrap();
    build_toys(a.path(), &one_of(0, 2), |_| Ok(30.0)).unwrap();
    build_toys(b.path(), &one_of(1, 2), |_| Ok(30.0)).unwrap();
    let [a_store, b_store] = [a.path(), b.path()].map(Store::local);
    assert!(!merge(&a_store).unwrap().is_complete());
    assert!(!a.path().join("manifest.json").exists());
    assert_eq!(collect(&a_store, &b_store).unwrap(), 1);
    assert!(merge(&a_store).unwrap().is_complete());
    assert_eq!(contents(a.path()), contents(whole.path()));
    assert_eq!(collect(&a_store, &b_store).unwrap(), 0);

    // A shard that is not what its record says is not taken over.
    let c = tempfile::tempdir().unwrap();
    let path = b.path().join("shard-00001.tar");
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[600] ^= 1;
    std::fs::write(&path, bytes).unwrap();
    assert!(message(collect(&Store::local(c.path()), &b_store)).contains("SHA-256"));
    assert_eq!(contents(c.path()).into_keys().collect::<Vec<_>>(), ["plan.json"]);

    let other = tempfile::tempdir().unwrap();
    let mut config = toy_config();
    config.seed = 1;
    build_with(
        &config,
        &toy_items(),
        &Store::local(other.path()),
        &one_of(0, 1),
        |_| (),
        |item| Ok(super::made(item.seed.unwrap(), 30.0)),
    )
    .unwrap();
    assert!(message(collect(&a_store, &Store::local(other.path()))).contains("another configuration"));
    let empty = tempfile::tempdir().unwrap();
    assert!(message(merge(&Store::local(empty.path()))).contains("expected a folder of shards"));
}

#[test]
fn failing_objects_are_recorded_and_the_rest_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let broken = |what: &str| BuildError::from(Invalid::new(what, "a whole one", "none"));
    let make = |seed| match seed % 4 {
        0 => Err(broken("mesh")),
        1 if seed == 13 => panic!("a bug"),
        _ => Ok(30.0),
    };
    let summary = build_toys(folder.path(), &BuildOptions::default(), make).unwrap();
    assert_eq!(summary.made, 6);
    let failed: Vec<(u64, &str)> = summary.failures.iter().map(|f| (f.index, f.id.as_str())).collect();
    let expected = [(1, "generated-00000008"), (5, "generated-00000012"), (6, "generated-00000013")];
    assert_eq!(failed, [&expected[..], &[(9, "generated-00000016")]].concat());
    assert!(summary.failures[0].reason.contains("mesh: expected a whole one"));
    assert!(summary.failures[2].reason.contains("a bug"), "a panic is a reason, too");
    let store = Store::local(folder.path());
    assert_eq!(Manifest::load(&store).unwrap().shards[1].failures[0].index, 5);
    assert_eq!(open(folder.path(), &[3]).unwrap().len(), 6);
    assert_eq!(inspect(&store, true).unwrap().failures, summary.failures);
    // Not tried again, unless that is asked for.
    let summary = build_toys(folder.path(), &BuildOptions::default(), |_| panic!("nothing to do")).unwrap();
    assert_eq!((summary.made, summary.skipped, summary.failures.len()), (0, 10, 4));
    let again = BuildOptions { retry_failed: true, ..BuildOptions::default() };
    let summary = build_toys(folder.path(), &again, |seed| match [8, 12, 13, 16].contains(&seed) {
        true => Ok(30.0),
        false => panic!("{seed} is there"),
    });
    let summary = summary.unwrap();
    assert_eq!((summary.made, summary.skipped, summary.failures), (4, 6, Vec::new()));
    let whole = tempfile::tempdir().unwrap();
    build_toys(whole.path(), &BuildOptions::default(), |_| Ok(30.0)).unwrap();
    assert_eq!(contents(folder.path()), contents(whole.path()));
}

#[test]
fn another_plan_or_process_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let options = BuildOptions::default();
    build_toys(folder.path(), &options, |_| {
        assert!(message(build_toys(folder.path(), &options, |_| Ok(30.0))).contains("another process"));
        Ok(30.0)
    })
    .unwrap();
    let before = contents(folder.path());
    let store = Store::local(folder.path());
    let refused = |config: &BuildConfig, items: &Items, text: &str| {
        let found = message(build(config, items, &store, &options, |_| ()));
        assert!(found.contains(text), "{found}");
    };
    let mut other = toy_config();
    other.object.surface.spread += 0.01;
    refused(&other, &toy_items(), "is made with another configuration");
    refused(&toy_config(), &Items::generated(11, 7), "is made of other objects");
    assert_eq!(contents(folder.path()), before);
}

#[test]
fn impossible_configurations_are_named() {
    let refused = |change: &dyn Fn(&mut BuildConfig), field: &str| {
        let mut config = toy_config();
        change(&mut config);
        let found = message(config.validate());
        assert!(found.starts_with(field), "{found}");
    };
    refused(&|c| c.shard.objects_per_shard = u64::MAX, "objects_per_shard");
    refused(&|c| c.depths = vec![3, 2], "depths");
    refused(&|c| c.depths.clear(), "depths");
    refused(&|c| c.depths = vec![40], "depths");
    refused(&|c| c.object.views = 0, "object.views");
    refused(&|c| c.shard.held_out = 1000, "held_out");
    refused(&|c| c.shard.min_psnr = f64::NAN, "min_psnr");
    refused(&|c| c.shard.test = 1.5, "validation, test");
    refused(&|c| c.shard.selection.inputs = 1, "selection");
    refused(
        &|c| {
            c.object.gaussians = GaussianSource::Fit;
            c.object.fit.iterations = 0;
        },
        "iterations",
    );
    toy_config().validate().unwrap();
    let none = build(&toy_config(), &Items::generated(0, 0), &Store::local(Path::new("x")), &one_of(0, 1), |_| ());
    assert!(message(none).starts_with("objects"));
}
