//! Self-attention in pieces: a few heads at a time, or some queries of one head, so that scores never take more than a
//! fixed amount of memory. Products run on the device's matrix units; the backward pass computes scores again from the
//! logs of the softmax's denominators (the FlashAttention-2 scheme).

use burn::tensor::DType;
use burn_cubecl::{
    kernel::{into_contiguous, slice},
    tensor::CubeTensor,
};

use super::{
    super::AttentionGrads,
    dims, empty, flash,
    heads::{Sizes, split, split_backward},
    linear::{cast, matmul, transposed},
    merge::{merge, merge_backward, put},
    shaped,
    softmax::{softmax, softmax_backward},
};
use burn_cubecl::CubeBackend;

/// Bytes of one piece's scores, at most.
const SCORES: usize = 256 << 20;

/// A piece of the work: some pairs of image and head, and some of their queries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Piece {
    first_pair: usize,
    pairs: usize,
    first_query: usize,
    queries: usize,
}

/// Pieces of at most `limit` scores: whole pairs where they fit.
fn pieces(sizes: Sizes, limit: usize) -> Vec<Piece> {
    let Sizes { tokens, queries, .. } = sizes;
    let pairs = sizes.pairs();
    let of_pair = (queries * tokens).max(1);
    let at_once = (limit / of_pair).clamp(1, pairs.max(1));
    // Products like multiples of their tiles.
    let rows = if of_pair <= limit { queries } else { (limit / tokens / 64 * 64).max(1) };
    let mut out = Vec::new();
    for first_pair in (0..pairs).step_by(at_once) {
        for first_query in (0..queries).step_by(rows.max(1)) {
            out.push(Piece {
                first_pair,
                pairs: at_once.min(pairs - first_pair),
                first_query,
                queries: rows.min(queries - first_query),
            });
        }
    }
    out
}

/// Scores of one piece, at most, on this device.
fn limit(like: &CubeTensor) -> usize {
    let page = usize::try_from(like.client.properties().memory.max_page_size).unwrap_or(usize::MAX);
    SCORES.min(page) / DType::F32.size()
}

impl Piece {
    /// These pairs' queries of `[pairs, queries, width]`.
    fn queries_of(self, t: &CubeTensor) -> CubeTensor {
        let [_, _, width] = dims(t);
        let pairs = self.first_pair..self.first_pair + self.pairs;
        slice(t.clone(), &[pairs, self.first_query..self.first_query + self.queries, 0..width])
    }

    /// These pairs' tokens of `[pairs, tokens, width]`.
    fn tokens_of(self, t: &CubeTensor) -> CubeTensor {
        let [_, tokens, width] = dims(t);
        slice(t.clone(), &[self.first_pair..self.first_pair + self.pairs, 0..tokens, 0..width])
    }
}

fn sizes(qkv: &CubeTensor, heads: usize, queries: usize) -> Sizes {
    let [batch, tokens, d3] = dims(qkv);
    assert!(d3 % (3 * heads) == 0 && queries <= tokens, "attention: heads and queries fit the tokens");
    Sizes { batch, tokens, queries, heads, width: d3 / 3 / heads }
}

/// Queries, times `factor`, keys and values, as heads.
fn split_all(
    qkv: &(CubeTensor, Option<CubeTensor>),
    norms: &Option<[CubeTensor; 2]>,
    sizes: Sizes,
    factor: f32,
) -> [CubeTensor; 3] {
    std::array::from_fn(|part| {
        let weights = norms.as_ref().and_then(|norms| norms.get(part)).cloned();
        let (kept, factor) = if part == 0 { (sizes.queries, factor) } else { (sizes.tokens, 1.0) };
        split(qkv.clone(), weights, sizes, part, kept, factor)
    })
}

/// See [`crate::kernels::Kernels::attention_forward`].
pub fn forward(
    (qkv, bias): (CubeTensor, Option<CubeTensor>),
    norms: Option<[CubeTensor; 2]>,
    heads: usize,
    queries: usize,
    keep: bool,
) -> (CubeTensor, Option<CubeTensor>) {
    let limit = limit(&qkv);
    if !keep
        && flash::possible(&qkv)
        && let Some(out) = forward_at_once((qkv.clone(), bias.clone()), norms.clone(), heads, queries)
    {
        return (out, None);
    }
    forward_within((qkv, bias), norms, heads, queries, keep, limit)
}

/// By one kernel, where there is one.
fn forward_at_once(
    (qkv, bias): (CubeTensor, Option<CubeTensor>),
    norms: Option<[CubeTensor; 2]>,
    heads: usize,
    queries: usize,
) -> Option<CubeTensor> {
    let qkv = (into_contiguous(qkv), bias.map(into_contiguous));
    let norms = norms.map(|norms| norms.map(into_contiguous));
    let sizes = sizes(&qkv.0, heads, queries);
    if sizes.pairs() * queries == 0 {
        return None;
    }
    let [q, k, v] = split_all(&qkv, &norms, sizes, 1.0);
    let mixed = flash::attention(&q, &k, &v)?;
    let out = empty(&qkv.0, &[sizes.batch, queries, heads * sizes.width], qkv.0.dtype);
    merge(into_contiguous(mixed), None, &out, sizes, 0, 0);
    Some(out)
}

pub fn forward_within(
    (qkv, bias): (CubeTensor, Option<CubeTensor>),
    norms: Option<[CubeTensor; 2]>,
    heads: usize,
    queries: usize,
    keep: bool,
    limit: usize,
) -> (CubeTensor, Option<CubeTensor>) {
    let qkv = (into_contiguous(qkv), bias.map(into_contiguous));
    let norms = norms.map(|norms| norms.map(into_contiguous));
    let sizes = sizes(&qkv.0, heads, queries);
    let dtype = qkv.0.dtype;
    let out = empty(&qkv.0, &[sizes.batch, queries, heads * sizes.width], dtype);
    let log_sum = empty(&qkv.0, &[sizes.pairs(), queries], DType::F32);
    let [q, k, v] = split_all(&qkv, &norms, sizes, (sizes.width as f32).sqrt().recip());
    for piece in pieces(sizes, limit) {
        let Piece { first_pair, first_query, .. } = piece;
        let scores = matmul(piece.queries_of(&q), transposed(piece.tokens_of(&k)), DType::F32);
        let (p, inverse) = softmax(scores, &log_sum, first_pair, first_query, dtype);
        let mixed = matmul(p, piece.tokens_of(&v), DType::F32);
        merge(mixed, Some(inverse), &out, sizes, first_pair, first_query);
    }
    (out, keep.then(|| shaped(log_sum, &[sizes.batch, heads, queries])))
}

/// See [`crate::kernels::Kernels::attention_backward`].
pub fn backward(
    (qkv, bias): (CubeTensor, Option<CubeTensor>),
    norms: Option<[CubeTensor; 2]>,
    out: CubeTensor,
    log_sum: CubeTensor,
    grad: CubeTensor,
    heads: usize,
) -> AttentionGrads<CubeBackend> {
    let limit = limit(&qkv);
    backward_within((qkv, bias), norms, out, log_sum, grad, heads, limit)
}

pub fn backward_within(
    (qkv, bias): (CubeTensor, Option<CubeTensor>),
    norms: Option<[CubeTensor; 2]>,
    out: CubeTensor,
    log_sum: CubeTensor,
    grad: CubeTensor,
    heads: usize,
    limit: usize,
) -> AttentionGrads<CubeBackend> {
    let qkv = (into_contiguous(qkv), bias.map(into_contiguous));
    let norms = norms.map(|norms| norms.map(into_contiguous));
    let [_, queries, _] = dims(&out);
    let sizes = sizes(&qkv.0, heads, queries);
    let factor = (sizes.width as f32).sqrt().recip();
    let dtype = qkv.0.dtype;
    let log_sum = shaped(into_contiguous(log_sum), &[sizes.pairs(), queries]);
    let grad = into_contiguous(cast(grad, dtype));
    let (grad, delta) = merge_backward(into_contiguous(out), grad, sizes);
    let [q, k, v] = split_all(&qkv, &norms, sizes, factor);
    let all = |rows: usize| empty(&q, &[sizes.pairs(), rows, sizes.width], DType::F32);
    let (dq, dk, dv) = (all(queries), all(sizes.tokens), all(sizes.tokens));
    for piece in pieces(sizes, limit) {
        let Piece { first_pair, first_query, .. } = piece;
        let (q, grad) = (piece.queries_of(&q), piece.queries_of(&grad));
        let (k, v) = (piece.tokens_of(&k), piece.tokens_of(&v));
        let scores = matmul(q.clone(), transposed(k.clone()), DType::F32);
        let dp = matmul(grad.clone(), transposed(v), DType::F32);
        let (p, ds) = softmax_backward(scores, dp, &log_sum, &delta, first_pair, first_query, dtype);
        let add = first_query > 0;
        put(matmul(transposed(p), grad, DType::F32), &dv, first_pair, 0, add);
        put(matmul(transposed(ds.clone()), q, DType::F32), &dk, first_pair, 0, add);
        put(matmul(ds, k, DType::F32), &dq, first_pair, first_query, false);
    }
    let (qkv, bias, norms) = split_backward(qkv, norms, [dq, dk, dv], sizes, factor);
    AttentionGrads { qkv, bias, norms }
}

#[cfg(test)]
mod tests {
    use burn::{
        backend::{BackendTensor, DispatchAutodiffContext, DispatchTensor, DispatchTensorKind},
        tensor::Tensor,
    };
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn pieces_cover_everything_once() {
        for [batch, heads, tokens, queries, limit] in
            [[1, 1, 1, 1, 1], [2, 3, 10, 7, 5], [2, 3, 10, 7, 140], [1, 4, 100, 100, 7000], [1, 2, 64, 64, 1 << 20]]
        {
            let sizes = Sizes { batch, tokens, queries, heads, width: 4 };
            let mut seen = vec![0; batch * heads * queries];
            for p in pieces(sizes, limit) {
                assert!(p.pairs * p.queries * tokens <= limit.max(tokens), "{p:?}");
                for pair in p.first_pair..p.first_pair + p.pairs {
                    for query in p.first_query..p.first_query + p.queries {
                        seen[pair * queries + query] += 1;
                    }
                }
            }
            assert!(seen.iter().all(|&n| n == 1));
        }
    }

    /// Numbers from -1 to 1.
    fn random(rng: &mut ChaCha8Rng, shape: &[usize]) -> CubeTensor {
        let n = shape.iter().product::<usize>();
        let values: Vec<f32> = (0..n).map(|_| rng.random_range(-1.0..1.0)).collect();
        let tensor = Tensor::<1>::from_floats(values.as_slice(), &crate::tests::gpu());
        match tensor.into_dispatch().kind {
            DispatchTensorKind::Cube(tensor) => shaped(tensor.float(), shape),
            _ => panic!("not on the GPU"),
        }
    }

    fn values(t: CubeTensor) -> Vec<f32> {
        let n = t.meta.shape().iter().product::<usize>();
        let kind = DispatchTensorKind::Cube(BackendTensor::Float(shaped(t, &[n])));
        let autodiff = DispatchAutodiffContext::Disabled;
        crate::tests::numbers(Tensor::<1>::from_dispatch(DispatchTensor { kind, autodiff }))
    }

    /// Pieces of any size make the same result: of several heads, of one, of some queries of one.
    #[test]
    fn the_limit_of_memory_changes_nothing() {
        let (batch, tokens, queries, heads, width) = (2, 150, 141, 3, 8);
        let d = heads * width;
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let [qkv, bias] = [vec![batch, tokens, 3 * d], vec![3 * d]].map(|shape| random(&mut rng, &shape));
        let norms = [(); 2].map(|()| random(&mut rng, &[width]));
        let grad = random(&mut rng, &[batch, queries, d]);
        let run = |limit: usize| {
            let (qkv, norms) = ((qkv.clone(), Some(bias.clone())), Some(norms.clone()));
            let (out, log_sum) = forward_within(qkv.clone(), norms.clone(), heads, queries, true, limit);
            let log_sum = log_sum.expect("asked to keep it");
            let d = backward_within(qkv, norms, out.clone(), log_sum, grad.clone(), heads, limit);
            let [dq, dk] = d.norms.expect("there were norms");
            [out, d.qkv, d.bias.expect("there was one"), dq, dk].map(values)
        };
        let whole = run(usize::MAX);
        for limit in [4 * queries * tokens, queries * tokens, 70 * tokens, 9 * tokens] {
            for (found, whole) in run(limit).iter().zip(&whole) {
                crate::tests::assert_close(&format!("at most {limit}"), found, whole, 1e-5);
            }
        }
    }
}
