//! Against vectors of independent references: `tests/golden/lod` and `tests/golden/flow`.

use freerange_gaussians::{Alignment, Gaussian, Gaussians, LodTree, Normalization, merge};
use freerange_vectors::Vectors;
use glam::{DMat3, DQuat, DVec3};

struct Golden(Vectors);

impl Golden {
    fn open(name: &str) -> Self {
        Self(Vectors::read(&format!("{name}.safetensors")))
    }

    fn f32(&self, name: &str) -> &[f32] {
        self.0.floats(name)
    }

    fn rows<const N: usize>(&self, name: &str) -> Vec<[f64; N]> {
        self.f32(name).as_chunks::<N>().0.iter().map(|row| row.map(f64::from)).collect()
    }

    fn gaussians(&self, prefix: &str) -> Vec<Gaussian> {
        let [means, scales, colors] = ["means", "scales", "colors"].map(|n| self.rows::<3>(&format!("{prefix}{n}")));
        let (quats, opacities) = (self.rows::<4>(&format!("{prefix}quats")), self.f32(&format!("{prefix}opacities")));
        let one = |i: usize| {
            let [w, x, y, z] = quats[i];
            let [mean, scale, color] = [means[i], scales[i], colors[i]].map(DVec3::from_array);
            Gaussian::new(mean, scale, DQuat::from_xyzw(x, y, z, w), opacities[i].into(), color)
        };
        (0..means.len()).map(one).collect()
    }
}

fn close(what: &str, found: &[f64], expected: &[f64], relative: f64, absolute: f64) {
    for (k, (f, e)) in found.iter().zip(expected).enumerate() {
        assert!((f - e).abs() <= absolute + relative * e.abs(), "{what}[{k}]: expected {e}, found {f}");
    }
}

struct Expected {
    mean: Vec<[f64; 3]>,
    color: Vec<[f64; 3]>,
    cov: Vec<[f64; 6]>,
    scales: Vec<[f64; 3]>,
    opacity: Vec<f32>,
}

impl Expected {
    fn of(golden: &Golden, prefix: &str, scales: &str) -> Self {
        let name = |n| format!("{prefix}{n}");
        Self {
            mean: golden.rows(&name("mean")),
            color: golden.rows(&name("color")),
            cov: golden.rows(&name("cov")),
            scales: golden.rows(&name(scales)),
            opacity: golden.f32(&name("opacity")).to_vec(),
        }
    }

    /// The tolerances stated with the vectors.
    fn check(&self, i: usize, g: &Gaussian) {
        close("mean", &g.mean.to_array(), &self.mean[i], 0.0, 2e-5);
        close("color", &g.color.to_array(), &self.color[i], 0.0, 2e-5);
        let c = g.covariance.to_cols_array();
        let largest = self.cov[i].iter().fold(0.0, |m: f64, v| m.max(v.abs()));
        close("cov", &[c[0], c[1], c[2], c[4], c[5], c[8]], &self.cov[i], 0.0, 1e-4 * largest + 1e-9);
        let mut scales = g.scale.to_array();
        scales.sort_by(f64::total_cmp);
        close("scales", &scales, &self.scales[i], 2e-3, 1e-7);
        close("opacity", &[g.opacity], &[self.opacity[i].into()], 2e-3, 1e-7);
    }
}

#[test]
fn pairs_merge_as_published() {
    let golden = Golden::open("lod/pairs");
    let (a, b) = (golden.gaussians("in/a_"), golden.gaussians("in/b_"));
    let expected = Expected::of(&golden, "out/", "scales_ascending");
    assert_eq!(a.len(), 24);
    for i in 0..a.len() {
        expected.check(i, &merge(&[&a[i], &b[i]]));
    }
}

#[test]
fn trees_have_the_published_structure_and_nodes() {
    for name in ["tree2", "tree37", "tree64", "tree256"] {
        let golden = Golden::open(&format!("lod/{name}"));
        let leaves = golden.gaussians("in/");
        let expected = Expected::of(&golden, "node/", "scales_sorted");
        let [parent, children, level, height, leaf_index, leaf_count] =
            ["parent", "children", "level", "height", "leaf_index", "leaf_count"]
                .map(|n| golden.0.ints(&format!("tree/{n}")));
        for alignment in [Alignment::Parent, Alignment::Identity, Alignment::None] {
            let tree = LodTree::from_gaussians(leaves.clone(), alignment).unwrap();
            assert_eq!(tree.len(), leaves.len());
            assert_eq!(tree.nodes().len(), parent.len());
            let id = |v: Option<usize>| v.map_or(-1, |v| v as i32);
            for (i, node) in tree.nodes().iter().enumerate() {
                assert_eq!(id(node.parent), parent[i], "{name} parent of {i}");
                assert_eq!([0, 1].map(|k| id(node.children.map(|c| c[k]))), children[2 * i..2 * i + 2]);
                assert_eq!(id(node.leaf), leaf_index[i], "{name} leaf of {i}");
                assert_eq!((node.level as i32, node.height as i32), (level[i], height[i]));
                assert_eq!(node.leaf_count as i32, leaf_count[i]);
                expected.check(i, &node.gaussian);
            }
            for depth in 0..=tree.depth_max() {
                let ids: Vec<i32> = tree.slice_ids(depth).unwrap().into_iter().map(|i| i as i32).collect();
                assert_eq!(ids, golden.0.ints(&format!("slice/level{depth}_node_ids")));
            }
        }
    }
}

/// The vectors' frames hang on the arbitrary one of the root. What holds whatever the root's frame is: every frame is a
/// proper rotation of its Gaussian, and no other of the 24 agrees better with the parent's.
#[test]
fn frames_are_aligned_with_the_parents() {
    for name in ["tree2", "tree37", "tree64", "tree256"] {
        let golden = Golden::open(&format!("lod/{name}"));
        let tree = LodTree::from_gaussians(golden.gaussians("in/"), Alignment::Parent).unwrap();
        for node in tree.nodes() {
            let g = &node.gaussian;
            assert!((g.axes.determinant() - 1.0).abs() < 1e-9);
            let scaled = g.axes * DMat3::from_diagonal(g.scale);
            let largest = g.scale.max_element().powi(2);
            assert!((scaled * scaled.transpose()).abs_diff_eq(g.covariance, 1e-9 * largest));
            let Some(parent) = node.parent else { continue };
            let reference = tree.nodes()[parent].gaussian.axes;
            let score = |m: DMat3| (0..3).map(|j| m.col(j).dot(reference.col(j))).sum::<f64>();
            for p in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
                for signs in 0..8 {
                    let column = |j: usize| g.axes.col(p[j]) * if (signs >> j) & 1 == 1 { -1.0 } else { 1.0 };
                    let other = DMat3::from_cols(column(0), column(1), column(2));
                    assert!(other.determinant() < 0.0 || score(other) <= score(g.axes) + 1e-9);
                }
            }
        }
    }
}

/// Given the root frame of the vectors, all frames below come out the same (where the choice is not a near tie).
#[test]
fn frames_below_a_shared_root_are_the_published_ones() {
    for name in ["tree2", "tree37", "tree64", "tree256"] {
        let golden = Golden::open(&format!("lod/{name}"));
        let tree = LodTree::from_gaussians(golden.gaussians("in/"), Alignment::Parent).unwrap();
        // numpy writes rows, glam columns.
        let frames: Vec<DMat3> =
            golden.rows::<9>("align/rotation").iter().map(|r| DMat3::from_cols_array(r).transpose()).collect();
        let (scales, gap) = (golden.rows::<3>("align/scales"), golden.f32("align/score_gap"));
        // Relabeling the root relabels every node below in the same way.
        let change = tree.nodes()[0].gaussian.axes.transpose() * frames[0];
        let mut near_tie = vec![false; tree.nodes().len()];
        let mut compared = 0;
        for (i, node) in tree.nodes().iter().enumerate().skip(1) {
            near_tie[i] = near_tie[node.parent.unwrap()] || gap[i] < 1e-3;
            if !near_tie[i] {
                compared += 1;
                assert!((node.gaussian.axes * change).abs_diff_eq(frames[i], 2e-3), "{name}, node {i}");
                let permuted = (change.transpose() * DMat3::from_diagonal(node.gaussian.scale) * change).diagonal();
                close("aligned scales", &permuted.to_array(), &scales[i], 2e-3, 1e-7);
            }
        }
        assert!(compared > tree.nodes().len() / 2, "{name}: only {compared} nodes compared");
    }
}

#[test]
fn normalization() {
    let golden = Golden::open("flow/fm");
    let array = |name: &str| <[f32; 14]>::try_from(golden.f32(name)).unwrap();
    let normalization = Normalization::new(array("in/mean"), array("in/std")).unwrap();
    let z1 = golden.f32("in/z1").to_vec(); // [7, 6, 14]
    let limit = |expected: &[f32]| 1e-6 + 1e-5 * expected.iter().fold(0.0, |m: f32, v| m.max(v.abs()));
    let near = |found: &[f32], expected: &[f32]| {
        assert_eq!(found.len(), expected.len());
        let limit = limit(expected);
        found.iter().zip(expected).all(|(f, e)| (f - e).abs() <= limit)
    };
    assert!(near(normalization.denormalize(&z1).rows(), golden.f32("out/z1_denormalised")));
    assert!(near(&normalization.normalize(&Gaussians::from_rows(z1.clone())), golden.f32("out/z1_normalised")));
}
