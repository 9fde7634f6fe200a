//! The level-of-detail tree: depth l is a complete, coarser object of exactly 2^l Gaussians.
//!
//! Built from the top by median splits and merged from the bottom, as Kerbl et al. (2024) do. Nodes lie in pre-order:
//! a parent comes before its children, so that merging is one loop backwards, and aligning one loop forwards.

use crate::align::relabel;
use crate::merge::{gaussians, merge, split_largest};
use crate::{Alignment, Gaussian, Gaussians, SplatError};
use glam::DMat3;

/// Leaves a tree can have: ids of all nodes fit 31 bits.
const MAX_LEAVES: usize = 1 << 30;

/// One node of a [`LodTree`].
#[derive(Clone, Debug)]
pub struct Node {
    /// The leaf, or the merge of the children. Opacity is not clamped here.
    pub gaussian: Gaussian,
    /// Id of the parent; `None` at the root.
    pub parent: Option<usize>,
    /// Ids of the children, the first with the smaller coordinates; `None` at leaves.
    pub children: Option<[usize; 2]>,
    /// Distance from the root.
    pub level: u32,
    /// Distance from the farthest leaf below.
    pub height: u32,
    /// Leaves below; 1 at leaves.
    pub leaf_count: usize,
    /// At leaves, which Gaussian of the input this is; halves that were split off are numbered after all of these.
    pub leaf: Option<usize>,
}

/// A binary tree over the Gaussians of an object; every parent is the weighted merge of its two children.
#[derive(Clone, Debug)]
pub struct LodTree {
    nodes: Vec<Node>,
}

impl LodTree {
    /// The tree over all Gaussians of `cloud`.
    ///
    /// # Errors
    /// [`SplatError::Empty`], [`SplatError::TooMany`]; [`SplatError::Value`] where a channel is not finite or a
    /// log-scale beyond -40..40.
    pub fn build(cloud: &Gaussians, alignment: Alignment) -> Result<Self, SplatError> {
        Self::from_gaussians(gaussians(cloud)?, alignment)
    }

    /// As [`build`](Self::build), but so that slices down to `depth` exist: where the cloud has fewer than 2^depth
    /// Gaussians, that of the largest weight (opacity times surface) is split in two until it has.
    /// The halves' moments and weights are those of the whole ([`Gaussian::halves`]).
    ///
    /// # Errors
    /// As [`build`](Self::build).
    pub fn build_to_depth(cloud: &Gaussians, depth: u32, alignment: Alignment) -> Result<Self, SplatError> {
        let mut leaves = gaussians(cloud)?;
        let count = 1usize.checked_shl(depth).filter(|n| *n <= MAX_LEAVES);
        let count = count.ok_or(SplatError::TooMany { limit: MAX_LEAVES, found: usize::MAX })?;
        split_largest(&mut leaves, count);
        Self::from_gaussians(leaves, alignment)
    }

    /// The tree over `leaves`.
    ///
    /// # Errors
    /// As [`build`](Self::build).
    pub fn from_gaussians(leaves: Vec<Gaussian>, alignment: Alignment) -> Result<Self, SplatError> {
        if leaves.is_empty() {
            return Err(SplatError::Empty);
        }
        if leaves.len() > MAX_LEAVES {
            return Err(SplatError::TooMany { limit: MAX_LEAVES, found: leaves.len() });
        }
        leaves.iter().enumerate().try_for_each(|(i, g)| g.check(i))?;

        let cubes: Vec<Cube> = leaves.iter().map(Cube::of).collect();
        let mut order: Vec<u32> = (0..leaves.len() as u32).collect();
        let mut nodes = Vec::with_capacity(2 * leaves.len() - 1);
        split(&mut nodes, &leaves, &cubes, &mut order, None);
        for id in (0..nodes.len()).rev() {
            if let Some([left, right]) = nodes[id].children {
                nodes[id].gaussian = merge(&[&nodes[left].gaussian, &nodes[right].gaussian]);
                nodes[id].height = 1 + nodes[left].height.max(nodes[right].height);
            }
        }
        if alignment != Alignment::None {
            for id in 0..nodes.len() {
                let parent = nodes[id].parent.filter(|_| alignment == Alignment::Parent);
                let reference = parent.map_or(DMat3::IDENTITY, |p| nodes[p].gaussian.axes);
                let g = &mut nodes[id].gaussian;
                (g.axes, g.scale) = relabel(g.axes, g.scale, reference);
            }
        }
        Ok(Self { nodes })
    }

    /// All nodes in pre-order: node, first subtree, second subtree. The root comes first.
    pub fn nodes(&self) -> &[Node] {
        &self.nodes
    }

    /// Number of leaves; at least 1.
    #[expect(clippy::len_without_is_empty, reason = "a tree is never empty")]
    pub fn len(&self) -> usize {
        self.nodes.len().div_ceil(2)
    }

    /// The deepest complete level: the largest l with 2^l <= leaves.
    pub fn depth_max(&self) -> u32 {
        self.len().ilog2()
    }

    /// Ids of the 2^depth nodes of a slice in tree order: 2k and 2k + 1 are siblings, 4k .. 4k + 3 share a grandparent,
    /// and so on.
    ///
    /// # Errors
    /// [`SplatError::Depth`] below [`depth_max`](Self::depth_max).
    pub fn slice_ids(&self, depth: u32) -> Result<Vec<usize>, SplatError> {
        if depth > self.depth_max() {
            return Err(SplatError::Depth { depth, leaves: self.len() });
        }
        Ok((0..self.nodes.len()).filter(|&id| self.nodes[id].level == depth).collect())
    }

    /// The object at `depth`: exactly 2^depth Gaussians in the order of [`slice_ids`](Self::slice_ids). Quaternions have
    /// unit length and w >= 0, opacities are clamped to [`OPACITY_RANGE`](crate::OPACITY_RANGE).
    ///
    /// # Errors
    /// [`SplatError::Depth`] below [`depth_max`](Self::depth_max).
    pub fn slice(&self, depth: u32) -> Result<Gaussians, SplatError> {
        let rows = self.slice_ids(depth)?.into_iter().flat_map(|id| self.nodes[id].gaussian.to_row());
        Ok(Gaussians::from_rows(rows.collect()))
    }
}

/// What a split needs of a leaf: its center, and 3 times its largest scale.
///
/// In f32 on purpose. Where one cube holds all others, the sides of their common box are equal but for rounding, and
/// f32 is the rounding of the published method.
struct Cube {
    mean: [f32; 3],
    radius: f32,
}

impl Cube {
    fn of(g: &Gaussian) -> Self {
        // Adding zero turns -0 into 0, which would be ordered before it.
        Self { mean: g.mean.to_array().map(|v| v as f32 + 0.0), radius: 3.0 * g.scale.max_element() as f32 }
    }
}

/// Appends the subtree over the leaves `order` to `nodes`, without merging, and returns its id.
fn split(
    nodes: &mut Vec<Node>,
    leaves: &[Gaussian],
    cubes: &[Cube],
    order: &mut [u32],
    parent: Option<usize>,
) -> usize {
    let (id, first) = (nodes.len(), order[0] as usize);
    nodes.push(Node {
        gaussian: leaves[first].clone(), // of inner nodes replaced by the merge
        parent,
        children: None,
        level: parent.map_or(0, |p| nodes[p].level + 1),
        height: 0,
        leaf_count: order.len(),
        leaf: (order.len() == 1).then_some(first),
    });
    if order.len() > 1 {
        let axis = longest_side(cubes, order);
        let half = order.len() / 2;
        // Ties go by the number of the leaf, so that the tree does not depend on how the selection works.
        let key = |i: u32| cubes[i as usize].mean[axis];
        order.select_nth_unstable_by(half, |&i, &j| key(i).total_cmp(&key(j)).then(i.cmp(&j)));
        let (left, right) = order.split_at_mut(half);
        let left = split(nodes, leaves, cubes, left, Some(id));
        let right = split(nodes, leaves, cubes, right, Some(id));
        nodes[id].children = Some([left, right]);
    }
    id
}

/// The longest side of the box around the cubes; of equals the first.
fn longest_side(cubes: &[Cube], order: &[u32]) -> usize {
    let (mut lo, mut hi) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for &i in order {
        let Cube { mean, radius } = &cubes[i as usize];
        for k in 0..3 {
            lo[k] = lo[k].min(mean[k] - radius);
            hi[k] = hi[k].max(mean[k] + radius);
        }
    }
    let side = [0, 1, 2].map(|k| hi[k] - lo[k]);
    (1..3).fold(0, |best, k| if side[k] > side[best] { k } else { best })
}
