//! Properties of merging and of the level-of-detail tree.

use freerange_gaussians::{Alignment, Gaussian, Gaussians, LodTree, OPACITY_RANGE, SplatError, channel, merge};
use glam::{DMat3, DQuat, DVec3};
use proptest::prelude::*;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn example(n: usize, seed: u64) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut data = Vec::new();
    for _ in 0..n {
        data.extend((0..3).map(|_| rng.random_range(-0.5f32..0.5)));
        data.extend((0..3).map(|_| rng.random_range(-7.0f32..-2.0)));
        data.extend((0..4).map(|_| rng.random_range(-1.0f32..1.0)));
        data.push(rng.random_range(-4.0f32..5.0));
        data.extend((0..3).map(|_| rng.random_range(0.0f32..1.0)));
    }
    Gaussians::from_rows(data)
}

fn gaussians(cloud: &Gaussians) -> Vec<Gaussian> {
    cloud.iter().map(Gaussian::from_row).collect()
}

/// Total weight, weighted center and weighted second moment about the origin.
fn moments<'a>(parts: impl IntoIterator<Item = &'a Gaussian>) -> (f64, DVec3, DMat3) {
    let mut sum = (0.0, DVec3::ZERO, DMat3::ZERO);
    for g in parts {
        let (w, m) = (g.weight(), g.mean);
        sum.0 += w;
        sum.1 += w * m;
        sum.2 += (g.covariance + DMat3::from_cols(m * m.x, m * m.y, m * m.z)) * w;
    }
    (sum.0, sum.1 / sum.0, sum.2 * (1.0 / sum.0))
}

fn assert_same_moments<'a>(a: impl IntoIterator<Item = &'a Gaussian>, b: impl IntoIterator<Item = &'a Gaussian>) {
    let ((wa, ma, ca), (wb, mb, cb)) = (moments(a), moments(b));
    assert!((wa - wb).abs() <= 1e-9 * wa, "weight {wa} {wb}");
    assert!((ma - mb).length() < 1e-9, "mean {ma} {mb}");
    assert!(ca.abs_diff_eq(cb, 1e-9), "second moment {ca} {cb}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn every_level_conserves_weight_and_moments(n in 1usize..200, seed: u64) {
        let cloud = example(n, seed);
        let leaves = gaussians(&cloud);
        for alignment in [Alignment::Parent, Alignment::Identity, Alignment::None] {
            let tree = LodTree::build(&cloud, alignment).unwrap();
            prop_assert_eq!(tree.len(), n);
            let root = &tree.nodes()[0].gaussian;
            assert_same_moments([root], &leaves);
            for node in tree.nodes() {
                if let Some(children) = node.children {
                    assert_same_moments([&node.gaussian], children.map(|c| &tree.nodes()[c].gaussian));
                }
                let g = &node.gaussian;
                let scaled = g.axes * DMat3::from_diagonal(g.scale);
                prop_assert!((scaled * scaled.transpose()).abs_diff_eq(g.covariance, 1e-10));
            }
            // Every leaf is there once.
            let mut found: Vec<usize> = tree.nodes().iter().filter_map(|node| node.leaf).collect();
            found.sort_unstable();
            prop_assert_eq!(found, (0..n).collect::<Vec<_>>());
        }
    }

    #[test]
    fn slices_have_two_to_the_depth_canonical_rows(n in 1usize..300, seed: u64) {
        let tree = LodTree::build(&example(n, seed), Alignment::Identity).unwrap();
        for depth in 0..=tree.depth_max() {
            let slice = tree.slice(depth).unwrap();
            prop_assert_eq!(slice.len(), 1 << depth);
            prop_assert!(slice.check_finite().is_ok());
            for (i, id) in tree.slice_ids(depth).unwrap().into_iter().enumerate() {
                let row = slice.row(i);
                let q = &row[channel::ROTATION];
                prop_assert!(q[0] >= 0.0 && (q.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-5);
                prop_assert!((OPACITY_RANGE[0] - 1e-6..OPACITY_RANGE[1] + 1e-6).contains(&slice.opacity(i)));
                let g = &tree.nodes()[id].gaussian;
                prop_assert!(slice.covariance(i).abs_diff_eq(g.covariance, 1e-5 * g.scale.max_element().powi(2)));
                // No turn by a half or third about the axes brings the frame closer to the world's.
                prop_assert!(q[0] >= q[1..].iter().fold(0.0, |m: f32, v| m.max(v.abs())) - 1e-6);
            }
        }
        let too_deep = tree.depth_max() + 1;
        let refused = matches!(tree.slice(too_deep), Err(SplatError::Depth { .. }));
        prop_assert!(refused);
    }

    #[test]
    fn patches_of_a_slice_have_one_ancestor(n in 16usize..300, seed: u64) {
        let tree = LodTree::build(&example(n, seed), Alignment::Parent).unwrap();
        let depth = tree.depth_max();
        let ids = tree.slice_ids(depth).unwrap();
        for levels in 1..=3u32 {
            let ancestor = |id: usize| (0..levels).fold(id, |id, _| tree.nodes()[id].parent.unwrap());
            for (k, patch) in ids.chunks(1 << levels).enumerate() {
                let above = tree.slice_ids(depth - levels).unwrap()[k];
                prop_assert!(patch.iter().all(|&id| ancestor(id) == above));
            }
        }
    }

    #[test]
    fn halves_merge_into_the_whole(seed: u64) {
        for g in gaussians(&example(20, seed)) {
            let [a, b] = g.halves();
            let whole = merge(&[&a, &b]);
            assert_same_moments([&g], [&a, &b]);
            prop_assert!((whole.opacity / g.opacity - 1.0).abs() < 1e-9);
            prop_assert!(a.opacity < g.opacity);
            prop_assert!((whole.mean - g.mean).length() < 1e-12);
            prop_assert!(whole.covariance.abs_diff_eq(g.covariance, 1e-12));
            prop_assert!((whole.color - g.color).length() < 1e-12);
        }
    }

    #[test]
    fn small_objects_are_split_until_the_depth_is_full(n in 1usize..40, seed: u64) {
        let cloud = example(n, seed);
        let tree = LodTree::build_to_depth(&cloud, 5, Alignment::Identity).unwrap();
        prop_assert_eq!(tree.len(), n.max(32));
        prop_assert_eq!(tree.slice(5).unwrap().len(), 32);
        assert_same_moments([&tree.nodes()[0].gaussian], &gaussians(&cloud));
        prop_assert_eq!(tree.nodes().iter().filter(|node| node.leaf.is_some_and(|i| i < n)).count(), n);
    }
}

/// The slow, obvious twin of the build: sort everything at every split.
fn slow_leaves(gaussians: &[Gaussian], order: &mut [usize], out: &mut Vec<usize>) {
    if order.len() == 1 {
        return out.push(order[0]);
    }
    let side = |k: usize| {
        let radius = |i: &usize| 3.0 * gaussians[*i].scale.max_element() as f32;
        let hi = order.iter().map(|i| gaussians[*i].mean[k] as f32 + radius(i)).fold(f32::MIN, f32::max);
        let lo = order.iter().map(|i| gaussians[*i].mean[k] as f32 - radius(i)).fold(f32::MAX, f32::min);
        hi - lo
    };
    let mut axis = 0;
    for k in 1..3 {
        if side(k) > side(axis) {
            axis = k;
        }
    }
    order.sort_by(|&i, &j| gaussians[i].mean[axis].total_cmp(&gaussians[j].mean[axis]).then(i.cmp(&j)));
    let (left, right) = order.split_at_mut(order.len() / 2);
    slow_leaves(gaussians, left, out);
    slow_leaves(gaussians, right, out);
}

#[test]
fn the_build_equals_its_slow_twin_even_with_ties() {
    for (seed, grid) in [(1, 1e6), (2, 3.0), (3, 0.1)] {
        let mut cloud = example(777, seed);
        for row in cloud.iter_mut() {
            row[channel::MEAN].iter_mut().for_each(|v| *v = (*v * grid).round() / grid);
        }
        let tree = LodTree::build(&cloud, Alignment::None).unwrap();
        let found: Vec<usize> = tree.nodes().iter().filter_map(|node| node.leaf).collect();
        let mut expected = Vec::new();
        // A rounded coordinate may be -0, which the tree takes for 0.
        cloud.rows_mut().iter_mut().for_each(|v| *v += 0.0);
        slow_leaves(&gaussians(&cloud), &mut (0..cloud.len()).collect::<Vec<_>>(), &mut expected);
        assert_eq!(found, expected);
    }
}

#[test]
fn leaves_come_back_unchanged() {
    let cloud = example(256, 9);
    let tree = LodTree::build(&cloud, Alignment::None).unwrap();
    let slice = tree.slice(8).unwrap();
    let ids = tree.slice_ids(8).unwrap();
    for (i, id) in ids.into_iter().enumerate() {
        let leaf = tree.nodes()[id].leaf.unwrap();
        let (found, expected) = (slice.row(i), cloud.row(leaf));
        assert_eq!(found[..6], expected[..6], "means and log-scales survive exactly");
        assert_eq!(found[11..], expected[11..]);
        assert!((found[10] - expected[10]).abs() < 1e-5);
        assert!(slice.rotation(i).dot(cloud.rotation(leaf)).abs() > 1.0 - 1e-9);
    }
}

#[test]
fn degenerate_objects() {
    // All alike, and on one spot.
    let same = Gaussians::from_rows(example(1, 4).into_rows().repeat(64));
    let tree = LodTree::build(&same, Alignment::Identity).unwrap();
    let root = &tree.nodes()[0].gaussian;
    assert!((root.opacity / (64.0 * same.opacity(0)) - 1.0).abs() < 1e-9, "64 layers weigh as much as 64 Gaussians");
    assert!((tree.slice(0).unwrap().opacity(0) - OPACITY_RANGE[1].min(64.0 * same.opacity(0))).abs() < 1e-5);

    // Flat as paper: the thin side survives in merged Gaussians.
    let mut flat = example(64, 5);
    for row in flat.iter_mut() {
        row[2] = 0.1;
        row[channel::LOG_SCALE].copy_from_slice(&[-3.0, -4.0, -30.0]);
        row[channel::ROTATION].copy_from_slice(&[1.0, 0.0, 0.0, 0.0]);
    }
    let tree = LodTree::build(&flat, Alignment::Identity).unwrap();
    assert!((tree.slice(0).unwrap().row(0)[5] + 30.0).abs() < 1e-3);

    // Invisible.
    let mut faint = example(8, 6);
    faint.iter_mut().for_each(|row| row[channel::LOGIT_OPACITY] = -1000.0);
    let slice = LodTree::build(&faint, Alignment::Parent).unwrap().slice(1).unwrap();
    assert!(slice.check_finite().is_ok());
    let middle = (0..8).map(|i| faint.mean(i)).sum::<DVec3>() / 8.0;
    assert!(((slice.mean(0) + slice.mean(1)) * 0.5 - middle).length() < 1e-6);
}

#[test]
fn impossible_input_is_refused() {
    assert!(matches!(LodTree::build(&Gaussians::default(), Alignment::Parent), Err(SplatError::Empty)));
    assert!(matches!(LodTree::build_to_depth(&Gaussians::default(), 3, Alignment::Parent), Err(SplatError::Empty)));
    for depth in [31, 63, 64, 1000] {
        assert!(matches!(
            LodTree::build_to_depth(&example(3, 1), depth, Alignment::Parent),
            Err(SplatError::TooMany { .. })
        ));
    }
    for (at, value) in [(0, f32::NAN), (4, 50.0), (5, -41.0), (10, f32::INFINITY), (12, f32::NEG_INFINITY)] {
        let mut cloud = example(4, 2);
        cloud.rows_mut()[2 * channel::COUNT + at] = value;
        match LodTree::build(&cloud, Alignment::Parent) {
            Err(SplatError::Value { row: 2, channel, .. }) => assert_eq!(channel, at),
            other => panic!("channel {at}: {other:?}"),
        }
    }
    let tree = LodTree::build(&example(5, 1), Alignment::Parent).unwrap();
    let message = tree.slice(3).unwrap_err().to_string();
    assert!(message.contains("depth 3 needs 8") && message.contains("has 5"), "{message}");
    assert!(tree.slice(200).is_err());
    // A rotation of length zero is the identity.
    let g = Gaussian::new(DVec3::ZERO, DVec3::ONE, DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), 0.5, DVec3::ZERO);
    assert_eq!(g.axes, DMat3::IDENTITY);
}
