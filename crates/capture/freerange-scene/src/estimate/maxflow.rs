//! The least cut of a picture in two: a maximum flow on the grid of its pixels, each joined to its eight neighbors.
//!
//! Boykov and Kolmogorov 2004: two search trees grow from source and sink until they touch, the path between them is filled, and what
//! loses its parent by that looks for another one. Whole numbers, so that nothing depends on rounding.

use std::collections::VecDeque;

/// Right, left, down, up, and the diagonals; opposite directions are neighbors in this list.
const STEPS: [(i32, i32); 8] = [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (-1, 1), (1, -1)];
/// Parents beside the eight directions.
const TERMINAL: u8 = 8;
const ORPHAN: u8 = 9;
const NONE: u8 = 10;
/// Trees.
const FREE: u8 = 0;
const SOURCE: u8 = 1;
const SINK: u8 = 2;

/// The graph of one picture.
pub struct Grid {
    width: usize,
    /// Row length with one empty node at each end, so that every node has eight neighbors.
    stride: usize,
    height: usize,
    offsets: [isize; 8],
    /// Left to flow along each direction, `[node][8]`.
    residual: Vec<[i32; 8]>,
    /// Left to flow from the source (positive) or to the sink (negative).
    terminal: Vec<i32>,
    tree: Vec<u8>,
    parent: Vec<u8>,
    stamp: Vec<u32>,
    distance: Vec<u32>,
    active: VecDeque<u32>,
    is_active: Vec<bool>,
    orphans: VecDeque<u32>,
    time: u32,
}

impl Grid {
    /// A graph without edges.
    pub fn new(width: usize, height: usize) -> Self {
        let stride = width + 2;
        let nodes = stride * (height + 2);
        Self {
            width,
            stride,
            height,
            offsets: STEPS.map(|(x, y)| x as isize + y as isize * stride as isize),
            residual: vec![[0; 8]; nodes],
            terminal: vec![0; nodes],
            tree: vec![FREE; nodes],
            parent: vec![NONE; nodes],
            stamp: vec![0; nodes],
            distance: vec![0; nodes],
            active: VecDeque::new(),
            is_active: vec![false; nodes],
            orphans: VecDeque::new(),
            time: 0,
        }
    }

    fn node(&self, x: usize, y: usize) -> usize {
        (y + 1) * self.stride + x + 1
    }

    /// What it costs to have a pixel on the sink's side (positive) or on the source's (negative).
    pub fn set_terminal(&mut self, x: usize, y: usize, cost: i32) {
        let node = self.node(x, y);
        self.terminal[node] = cost;
    }

    /// What it costs to part a pixel from its right (0), lower (1), lower right (2) or lower left (3) neighbor. A neighbor outside
    /// of the picture is ignored.
    pub fn set_edge(&mut self, x: usize, y: usize, which: usize, cost: i32) {
        let direction = 2 * which;
        let (dx, dy) = STEPS[direction];
        let (nx, ny) = (x as i32 + dx, y as i32 + dy);
        if nx < 0 || nx >= self.width as i32 || ny >= self.height as i32 {
            return;
        }
        let (a, b) = (self.node(x, y), self.node(nx as usize, ny as usize));
        self.residual[a][direction] = cost;
        self.residual[b][direction + 1] = cost;
    }

    fn step(&self, node: usize, direction: usize) -> usize {
        node.wrapping_add_signed(self.offsets[direction])
    }

    fn activate(&mut self, node: usize) {
        if !self.is_active[node] {
            self.is_active[node] = true;
            self.active.push_back(node as u32);
        }
    }

    /// What can still flow between `node` and its neighbor `other` (in `direction`) in the sense of `node`'s tree: away from the
    /// source, towards the sink.
    fn outwards(&self, node: usize, other: usize, direction: usize) -> i32 {
        match self.tree[node] {
            SOURCE => self.residual[node][direction],
            _ => self.residual[other][direction ^ 1],
        }
    }

    /// Cuts: true for pixels on the source's side, `[height, width]`.
    pub fn cut(mut self) -> Vec<bool> {
        for y in 0..self.height {
            for x in 0..self.width {
                let node = self.node(x, y);
                if self.terminal[node] != 0 {
                    self.tree[node] = if self.terminal[node] > 0 { SOURCE } else { SINK };
                    self.parent[node] = TERMINAL;
                    self.distance[node] = 1;
                    self.activate(node);
                }
            }
        }
        while let Some(&node) = self.active.front() {
            let node = node as usize;
            match self.grow(node) {
                Some(direction) => {
                    self.time += 1;
                    self.augment(node, direction);
                    self.adopt_all();
                }
                None => {
                    self.active.pop_front();
                    self.is_active[node] = false;
                }
            }
        }
        let mut side = Vec::with_capacity(self.width * self.height);
        for y in 0..self.height {
            side.extend((0..self.width).map(|x| self.tree[self.node(x, y)] == SOURCE));
        }
        side
    }

    /// Lets a node take its free neighbors in; the direction in which it touches the other tree, if it does.
    fn grow(&mut self, node: usize) -> Option<usize> {
        let own = self.tree[node];
        if own == FREE {
            return None;
        }
        for direction in 0..8 {
            let other = self.step(node, direction);
            if self.outwards(node, other, direction) <= 0 {
                continue;
            }
            if self.tree[other] == FREE {
                self.tree[other] = own;
                self.parent[other] = (direction ^ 1) as u8;
                self.stamp[other] = self.stamp[node];
                self.distance[other] = self.distance[node] + 1;
                self.activate(other);
            } else if self.tree[other] != own {
                return Some(direction);
            } else if self.stamp[other] <= self.stamp[node] && self.distance[other] > self.distance[node] + 1 {
                // A shorter way to the terminal.
                self.parent[other] = (direction ^ 1) as u8;
                self.stamp[other] = self.stamp[node];
                self.distance[other] = self.distance[node] + 1;
            }
        }
        None
    }

    /// Fills the path through the edge from `node` in `direction`, which joins the trees.
    fn augment(&mut self, node: usize, direction: usize) {
        let other = self.step(node, direction);
        let (from, to, across) = match self.tree[node] {
            SOURCE => (node, other, direction),
            _ => (other, node, direction ^ 1),
        };
        let mut least = self.residual[from][across];
        for start in [from, to] {
            let mut at = start;
            while self.parent[at] != TERMINAL {
                let up = self.parent[at] as usize;
                let next = self.step(at, up);
                least = least.min(if start == from { self.residual[next][up ^ 1] } else { self.residual[at][up] });
                at = next;
            }
            least = least.min(self.terminal[at].abs());
        }
        self.residual[from][across] -= least;
        self.residual[to][across ^ 1] += least;
        for start in [from, to] {
            let mut at = start;
            while self.parent[at] != TERMINAL {
                let up = self.parent[at] as usize;
                let next = self.step(at, up);
                let ((a, da), (b, db)) =
                    if start == from { ((next, up ^ 1), (at, up)) } else { ((at, up), (next, up ^ 1)) };
                self.residual[a][da] -= least;
                self.residual[b][db] += least;
                if self.residual[a][da] == 0 {
                    self.parent[at] = ORPHAN;
                    self.orphans.push_back(at as u32);
                }
                at = next;
            }
            self.terminal[at] -= least * self.terminal[at].signum();
            if self.terminal[at] == 0 {
                self.parent[at] = ORPHAN;
                self.orphans.push_back(at as u32);
            }
        }
    }

    fn adopt_all(&mut self) {
        while let Some(orphan) = self.orphans.pop_front() {
            self.adopt(orphan as usize);
        }
    }

    /// How far a node is from its terminal by way of its parents; none if the way ends at an orphan. Remembered along the way.
    fn depth(&mut self, node: usize) -> Option<u32> {
        let (mut at, mut steps) = (node, 0);
        loop {
            if self.stamp[at] == self.time {
                steps += self.distance[at];
                break;
            }
            match self.parent[at] {
                TERMINAL => {
                    self.stamp[at] = self.time;
                    self.distance[at] = 1;
                    steps += 1;
                    break;
                }
                ORPHAN | NONE => return None,
                up => at = self.step(at, up as usize),
            }
            steps += 1;
        }
        let total = steps;
        at = node;
        while self.stamp[at] != self.time {
            self.stamp[at] = self.time;
            self.distance[at] = steps;
            steps -= 1;
            at = self.step(at, self.parent[at] as usize);
        }
        Some(total)
    }

    fn adopt(&mut self, node: usize) {
        let own = self.tree[node];
        let mut best: Option<(u32, usize)> = None;
        for direction in 0..8 {
            let other = self.step(node, direction);
            if self.tree[other] != own || self.outwards(other, node, direction ^ 1) <= 0 {
                continue;
            }
            if let Some(depth) = self.depth(other)
                && best.is_none_or(|(least, _)| depth < least)
            {
                best = Some((depth, direction));
            }
        }
        if let Some((depth, direction)) = best {
            self.parent[node] = direction as u8;
            self.stamp[node] = self.time;
            self.distance[node] = depth + 1;
            return;
        }
        for direction in 0..8 {
            let other = self.step(node, direction);
            if self.tree[other] != own {
                continue;
            }
            if self.outwards(other, node, direction ^ 1) > 0 {
                self.activate(other);
            }
            if self.parent[other] as usize == direction ^ 1 {
                self.parent[other] = ORPHAN;
                self.orphans.push_back(other as u32);
            }
        }
        self.tree[node] = FREE;
        self.parent[node] = NONE;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The least cost over all ways to cut a small picture.
    fn least_cost(w: usize, h: usize, terminals: &[i32], edges: &[[i32; 4]]) -> i64 {
        (0u32..1 << (w * h)).map(|sides| cost(w, h, terminals, edges, |i| sides >> i & 1 == 1)).min().unwrap_or(0)
    }

    fn cost(w: usize, h: usize, terminals: &[i32], edges: &[[i32; 4]], source: impl Fn(usize) -> bool) -> i64 {
        let mut sum = 0;
        for i in 0..w * h {
            let t = i64::from(terminals[i]);
            sum += if source(i) { (-t).max(0) } else { t.max(0) };
            for which in 0..4 {
                let (dx, dy) = STEPS[2 * which];
                let (x, y) = ((i % w) as i32 + dx, (i / w) as i32 + dy);
                if x >= 0 && x < w as i32 && y < h as i32 && source(i) != source(y as usize * w + x as usize) {
                    sum += i64::from(edges[i][which]);
                }
            }
        }
        sum
    }

    fn cut(w: usize, h: usize, terminals: &[i32], edges: &[[i32; 4]]) -> Vec<bool> {
        let mut grid = Grid::new(w, h);
        for i in 0..w * h {
            grid.set_terminal(i % w, i / w, terminals[i]);
            (0..4).for_each(|which| grid.set_edge(i % w, i / w, which, edges[i][which]));
        }
        grid.cut()
    }

    proptest! {
        #[test]
        fn no_cut_is_cheaper(
            (w, h) in (1usize..5, 1usize..4),
            terminals in proptest::collection::vec(-20i32..20, 16),
            edges in proptest::collection::vec(proptest::array::uniform4(0i32..15), 16),
        ) {
            let side = cut(w, h, &terminals, &edges);
            prop_assert_eq!(cost(w, h, &terminals, &edges, |i| side[i]), least_cost(w, h, &terminals, &edges));
        }
    }
}
