//! Products and attention on tiles against the same in f64 or f32.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{
    super::{head::Sizes, matrix::Matrix},
    *,
};

fn random(n: usize, seed: u64) -> Vec<f32> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    (0..n).map(|_| rng.random_range(-1.0..1.0)).collect()
}

/// To the nearest of the numbers with 8 significant bits, ties to even, by arithmetic alone.
fn rounded(x: f32) -> f64 {
    if x == 0.0 {
        return 0.0;
    }
    let unit = 2f64.powi(f64::from(x.abs()).log2().floor() as i32 - 7);
    (f64::from(x) / unit).round_ties_even() * unit
}

/// Sum by sum.
fn naive([m, k, n]: [usize; 3], a: Matrix, b: Matrix, bias: Option<&[f32]>) -> Vec<f64> {
    let values = |x: Matrix<'_>| x.data.iter().map(|&x| rounded(x)).collect::<Vec<f64>>();
    let (left, right) = (values(a), values(b));
    let mut out = Vec::with_capacity(m * n);
    for i in 0..m {
        for j in 0..n {
            let start = bias.map_or(0.0, |bias| f64::from(bias[j]));
            let term =
                |l: usize| left[i * a.row_stride + l * a.column_stride] * right[l * b.row_stride + j * b.column_stride];
            out.push(start + (0..k).map(term).sum::<f64>());
        }
    }
    out
}

/// Shapes at and around the sizes of tiles, strips, pieces and blocks.
const SHAPES: [[usize; 3]; 14] = [
    [1, 1, 1],
    [0, 5, 3],
    [3, 0, 5],
    [5, 3, 0],
    [16, 32, 16],
    [17, 33, 15],
    [32, 64, 32],
    [31, 31, 31],
    [33, 65, 47],
    [128, 256, 96],
    [129, 640, 40],
    [260, 641, 33],
    [70, 1300, 129],
    [7, 2000, 56],
];

fn turned(m: Matrix<'_>, across: bool) -> Matrix<'_> {
    if across { m.transposed() } else { m }
}

#[test]
fn products_are_those_of_rounded_numbers() {
    if !available() {
        return;
    }
    for (seed, shape @ [m, k, n]) in SHAPES.into_iter().enumerate() {
        // Rows with gaps, and transposes of such.
        for (left_across, right_across) in [(false, false), (true, false), (false, true), (true, true)] {
            let [(a_rows, a_columns), (b_rows, b_columns)] = [(left_across, m, k), (right_across, k, n)]
                .map(|(across, rows, columns)| if across { (columns, rows) } else { (rows, columns) });
            let (a, b) = (random(a_rows * (a_columns + 3), seed as u64), random(b_rows * (b_columns + 1), 77));
            let a = turned(Matrix { data: &a, row_stride: a_columns + 3, column_stride: 1 }, left_across);
            let b = turned(Matrix { data: &b, row_stride: b_columns + 1, column_stride: 1 }, right_across);
            let bias = random(n, 5);
            for bias in [None, Some(bias.as_slice())] {
                let (found, truth) = (product(shape, a, b, bias), naive(shape, a, b, bias));
                assert_eq!(found.len(), truth.len());
                let error = found.iter().zip(&truth).map(|(x, y)| (f64::from(*x) - y).abs()).fold(0.0, f64::max);
                let scale = (1.0 + k as f64).sqrt();
                assert!(error < 1e-6 * scale, "{shape:?} {left_across} {right_across}: off by {error}");
            }
        }
    }
}

/// Where the processor has a tile unit, nothing else tries the vectors.
#[test]
fn vectors_multiply_as_well() {
    if !available() {
        return;
    }
    let [m, n] = [29, 31];
    for k in [1, 31, 64, 300] {
        let (a, b, row) = (random(m * k, 3), random(k * n, 4), random(n, 5));
        let (a, b) = (Matrix::rows(&a, k), Matrix::rows(&b, n));
        let (left, right) = (pack::Lines::left(a, m, k), pack::Lines::right(b, k, n));
        let mut tiles = vec![Tile::ZERO; pack::tiles(m, k) + pack::tiles(n, k)];
        let (left_tiles, right_tiles) = tiles.split_at_mut(pack::tiles(m, k));
        left.pack(left_tiles);
        right.pack(right_tiles);
        let unit = Unit::of(Engine::Vectors);
        let mut out = vec![0f32; m * n];
        let mut check = |start: Start, expected: &dyn Fn(usize, f64) -> f64| {
            let place = Destination { out: out.as_mut_ptr(), stride: n, rows: m, columns: n };
            // SAFETY: all of `out`, which is ours.
            unsafe { unit.multiply(left_tiles, right_tiles, start, place) };
            for (i, (found, truth)) in out.iter().zip(naive([m, k, n], a, b, None)).enumerate() {
                let error = (f64::from(*found) - expected(i % n, truth)).abs();
                assert!(error < 1e-6 * (1.0 + k as f64), "depth {k}, element {i}: off by {error}");
            }
        };
        check(Start::Row(&row), &|column, x| x + f64::from(row[column]));
        check(Start::Zeros, &|_, x| x);
        check(Start::Result, &|_, x| 2.0 * x);
    }
}

#[test]
fn products_do_not_depend_on_the_number_of_threads() {
    if !available() {
        return;
    }
    let (a, b) = (random(700 * 700, 1), random(700 * 300, 2));
    let (a, b) = (Matrix::rows(&a, 700), Matrix::rows(&b, 300));
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| [a, a.transposed()].map(|a| product([700, 700, 300], a, b, None)))
    };
    let one = run(1);
    for threads in [2, 7] {
        assert_eq!(run(threads), one);
    }
}

#[test]
fn rounding_is_to_nearest_even() {
    for (x, expected) in [(1.0f32, 1.0), (1.0 + 1.0 / 256.0, 1.0), (1.0 + 3.0 / 256.0, 1.0 + 4.0 / 256.0), (-2.0, -2.0)]
    {
        assert_eq!(rounded(x), expected);
        if available() {
            let found = product([1, 1, 1], Matrix::rows(&[x], 1), Matrix::rows(&[1.0], 1), None);
            assert_eq!(f64::from(found[0]), expected);
        }
    }
}

/// Without norms, so that what is rounded is known to the bit but for the probabilities.
#[test]
fn attention_rounds_nothing_but_operands() {
    if !available() {
        return;
    }
    for [tokens, queries, heads, width] in [[1, 1, 1, 3], [50, 50, 2, 32], [77, 33, 1, 20], [130, 130, 3, 64]] {
        let d = heads * width;
        let qkv: Vec<f32> = random(tokens * 3 * d, 3).into_iter().map(|x| 3.0 * x).collect();
        let sizes = Sizes { tokens, queries, heads, width };
        let (mut out, mut log_sum) = (vec![0f32; queries * d], vec![0f32; queries]);
        for head in 0..heads {
            // SAFETY: this head's columns of `out`.
            unsafe { head_forward(&qkv, None, sizes, head, out.as_mut_ptr().add(head * width), &mut log_sum) };
            let at = |token: usize, part: usize, j: usize| qkv[token * 3 * d + (part * heads + head) * width + j];
            let factor = (width as f32).sqrt().recip();
            for i in 0..queries {
                let q: Vec<f64> = (0..width).map(|j| rounded(factor * at(tokens - queries + i, 0, j))).collect();
                let score = |key: usize| (0..width).map(|j| q[j] * rounded(at(key, 1, j))).sum::<f64>();
                let scores: Vec<f64> = (0..tokens).map(score).collect();
                let largest = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let p: Vec<f64> = scores.iter().map(|s| (s - largest).exp()).collect();
                let sum: f64 = p.iter().sum();
                assert!((f64::from(log_sum[i]) - largest - sum.ln()).abs() < 1e-5);
                for j in 0..width {
                    let truth = (0..tokens).map(|k| rounded(p[k] as f32) * rounded(at(k, 2, j))).sum::<f64>() / sum;
                    let found = f64::from(out[i * d + head * width + j]);
                    assert!((found - truth).abs() < 1e-3, "{tokens} tokens, {width} wide: {found} {truth}");
                }
            }
        }
    }
}
