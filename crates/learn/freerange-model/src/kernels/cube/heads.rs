//! From tokens `[b, t, 3 d]` to heads `[b heads, t, width]`: norms of queries and keys, and their gradients.
//!
//! The numbers of one token's head are read by a group of neighboring units, as many as it has vectors if a cube can
//! have so many.

use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::{self, cube, prelude::*};

use super::{
    ROWS, address, elem, empty, lanes, line, max_units, pieces,
    reduce::{across, group_sum, total},
    shaped, spread,
};
use crate::kernels::EPS;

/// Sizes of an attention.
#[derive(Clone, Copy)]
pub struct Sizes {
    pub batch: usize,
    pub tokens: usize,
    pub queries: usize,
    pub heads: usize,
    /// Numbers of a head.
    pub width: usize,
}

impl Sizes {
    pub fn pairs(self) -> usize {
        self.batch * self.heads
    }
}

/// How the units of a cube are shared out.
#[derive(Clone, Copy)]
pub struct Plan {
    /// Numbers of a vector.
    pub lanes: usize,
    /// Vectors of a head.
    pub vectors: usize,
    /// Units of a head.
    pub group: usize,
    /// Heads of a cube.
    pub groups: usize,
}

impl Plan {
    pub fn new(like: &CubeTensor, width: usize) -> Self {
        let lanes = lanes(like, &[DType::F32, like.dtype], &[width]);
        let (vectors, limit) = (width / lanes, max_units(like));
        let group = vectors.min(limit);
        Self { lanes, vectors, group, groups: limit / group }
    }

    pub fn units(self) -> usize {
        self.group * self.groups
    }
}

/// Queries, keys or values: as heads, normed where there are weights, times `factor`.
#[cube(launch_unchecked, address_type = "dynamic")]
fn split_kernel<E: Float, N: Size>(
    qkv: &Tensor<Vector<E, N>>,                 // [b, tokens, 3 d]
    bias: ComptimeOption<&[Vector<f32, N>]>,    // [3 d]
    weights: ComptimeOption<&[Vector<f32, N>]>, // [width]
    out: &mut Tensor<Vector<E, N>>,             // [b heads, kept, width]
    items: usize,
    tokens: usize,
    kept: usize,
    heads: usize,
    part: usize,
    factor: f32,
    epsilon: f32,
    #[comptime] norm: bool,
    #[comptime] vectors: usize,
    #[comptime] group: usize,
    #[comptime] groups: usize,
    #[define(E)] _dtype: ElemType,
) {
    let mut scratch = Shared::<[f32]>::new_slice(comptime!(group * groups));
    let unit = UNIT_POS as usize;
    let lane = unit % group;
    let item = CUBE_POS * groups + unit / group;
    let (head, token, batch) = (item % heads, item / heads % kept, item / heads / kept);
    let column = (part * heads + head) * vectors;
    let at = (batch * tokens + tokens - kept + token) * 3 * heads * vectors + column;
    let mut x = Array::<Vector<f32, N>>::new(comptime!(vectors.div_ceil(group)));
    let mut squares = Vector::<f32, N>::new(0.0f32);
    #[unroll]
    for i in 0..comptime!(vectors.div_ceil(group)) {
        let j = lane + i * group;
        if item < items && j < vectors {
            let bias: ComptimeOption<Vector<f32, N>> = bias.map(|bias| bias[column + j]);
            let v = Vector::<f32, N>::cast_from(qkv[at + j]) + bias.unwrap_or_else(|| Vector::new(0.0f32));
            x[i] = v;
            squares += v * v;
        }
    }
    let mut scale = factor;
    if comptime!(norm) {
        let width = f32::cast_from(vectors as u32) * f32::cast_from(N::value() as u32);
        let mean = group_sum(across::<N>(squares), &mut scratch, group) / width;
        scale = factor / f32::sqrt(mean + epsilon);
    }
    #[unroll]
    for i in 0..comptime!(vectors.div_ceil(group)) {
        let j = lane + i * group;
        if item < items && j < vectors {
            let weight: ComptimeOption<Vector<f32, N>> = weights.map(|w| w[j]);
            let y = x[i] * Vector::new(scale) * weight.unwrap_or_else(|| Vector::new(1.0f32));
            out[((batch * heads + head) * kept + token) * vectors + j] = Vector::cast_from(y);
        }
    }
}

/// Part `part` (0 queries, 1 keys, 2 values) of `qkv` for the last `kept` tokens: `[b heads, kept, width]`.
pub fn split(
    (qkv, bias): (CubeTensor, Option<CubeTensor>),
    weights: Option<CubeTensor>,
    sizes: Sizes,
    part: usize,
    kept: usize,
    factor: f32,
) -> CubeTensor {
    let out = empty(&qkv, &[sizes.pairs(), kept, sizes.width], qkv.dtype);
    let items = sizes.pairs() * kept;
    if items == 0 {
        return out;
    }
    let plan = Plan::new(&qkv, sizes.width);
    // SAFETY: groups beyond the last item and units beyond the last vector neither read nor write.
    unsafe {
        split_kernel::launch_unchecked(
            &qkv.client.clone(),
            spread(&qkv, items.div_ceil(plan.groups)),
            line(plan.units()),
            address([&qkv, &out]),
            plan.lanes,
            qkv.clone().into_tensor_arg(),
            bias.map(CubeTensor::into_buffer_arg).into(),
            weights.clone().map(CubeTensor::into_buffer_arg).into(),
            out.clone().into_tensor_arg(),
            items,
            sizes.tokens,
            kept,
            sizes.heads,
            part,
            factor,
            EPS,
            weights.is_some(),
            plan.vectors,
            plan.group,
            plan.groups,
            elem(&qkv),
        );
    }
    out
}

/// The gradient of [`split_kernel`], for all tokens: a cube goes through `rows` tokens of `groups` heads, and sums the
/// gradients of bias and weights on the way. With r = 1 / rms(x) and h = weights grad: dx = r (h - x r^2 mean(h x)).
#[cube(launch_unchecked, address_type = "dynamic")]
fn split_backward_kernel<E: Float, N: Size>(
    qkv: &Tensor<Vector<E, N>>,
    bias: ComptimeOption<&[Vector<f32, N>]>,
    weights: ComptimeOption<&[Vector<f32, N>]>,
    grad: &Tensor<Vector<f32, N>>,          // [b heads, kept, width]
    dx: &mut Tensor<Vector<E, N>>,          // [b, tokens, 3 d]
    d_bias: &mut Tensor<Vector<f32, N>>,    // [b, pieces, 3 d]
    d_weights: &mut Tensor<Vector<f32, N>>, // [b, pieces, d]
    tokens: usize,
    kept: usize,
    heads: usize,
    part: usize,
    rows: usize,
    factor: f32,
    epsilon: f32,
    #[comptime] norm: bool,
    #[comptime] vectors: usize,
    #[comptime] group: usize,
    #[comptime] groups: usize,
    #[define(E)] _dtype: ElemType,
) {
    let mut scratch = Shared::<[f32]>::new_slice(comptime!(group * groups));
    let width = f32::cast_from(vectors as u32) * f32::cast_from(N::value() as u32);
    let unit = UNIT_POS as usize;
    let lane = unit % group;
    let head = CUBE_POS_X as usize * groups + unit / group;
    let (piece, batch) = (CUBE_POS_Y as usize, CUBE_POS_Z as usize);
    let column = (part * heads + head) * vectors;
    let mut bias_sums = Array::<Vector<f32, N>>::new(comptime!(vectors.div_ceil(group)));
    let mut weight_sums = Array::<Vector<f32, N>>::new(comptime!(vectors.div_ceil(group)));
    let first = piece * rows;
    for token in first..usize::min(first + rows, tokens) {
        let at = (batch * tokens + token) * 3 * heads * vectors + column;
        let mut x = Array::<Vector<f32, N>>::new(comptime!(vectors.div_ceil(group)));
        let mut h = Array::<Vector<f32, N>>::new(comptime!(vectors.div_ceil(group)));
        let mut squares = Vector::<f32, N>::new(0.0f32);
        let mut products = Vector::<f32, N>::new(0.0f32);
        #[unroll]
        for i in 0..comptime!(vectors.div_ceil(group)) {
            let j = lane + i * group;
            if head < heads && j < vectors && token + kept >= tokens {
                let from = ((batch * heads + head) * kept + token + kept - tokens) * vectors + j;
                let g = grad[from] * Vector::new(factor);
                h[i] = g;
                if comptime!(norm) {
                    let bias: ComptimeOption<Vector<f32, N>> = bias.map(|bias| bias[column + j]);
                    let v = Vector::<f32, N>::cast_from(qkv[at + j]) + bias.unwrap_or_else(|| Vector::new(0.0f32));
                    x[i] = v;
                    squares += v * v;
                    let weight: ComptimeOption<Vector<f32, N>> = weights.map(|w| w[j]);
                    products += g * v * weight.unwrap_or_else(|| Vector::new(1.0f32));
                }
            }
        }
        if comptime!(norm) {
            let mean_square = group_sum(across::<N>(squares), &mut scratch, group) / width;
            let mean_product = group_sum(across::<N>(products), &mut scratch, group) / width;
            let inverse = 1.0f32 / f32::sqrt(mean_square + epsilon);
            let pull = inverse * inverse * mean_product;
            #[unroll]
            for i in 0..comptime!(vectors.div_ceil(group)) {
                let j = lane + i * group;
                if head < heads && j < vectors {
                    weight_sums[i] += h[i] * x[i] * Vector::new(inverse);
                    let weight: ComptimeOption<Vector<f32, N>> = weights.map(|w| w[j]);
                    let scaled = h[i] * weight.unwrap_or_else(|| Vector::new(1.0f32));
                    h[i] = (scaled - x[i] * Vector::new(pull)) * Vector::new(inverse);
                }
            }
        }
        #[unroll]
        for i in 0..comptime!(vectors.div_ceil(group)) {
            let j = lane + i * group;
            if head < heads && j < vectors {
                bias_sums[i] += h[i];
                dx[at + j] = Vector::cast_from(h[i]);
            }
        }
    }
    let row = batch * CUBE_COUNT_Y as usize + piece;
    #[unroll]
    for i in 0..comptime!(vectors.div_ceil(group)) {
        let j = lane + i * group;
        if head < heads && j < vectors {
            d_bias[row * 3 * heads * vectors + column + j] = bias_sums[i];
            if comptime!(norm) {
                d_weights[(row * heads + head) * vectors + j] = weight_sums[i];
            }
        }
    }
}

/// From the gradients of queries (times their `factor`), keys and values, f32, those of `qkv`, of its bias, and of both
/// norms' weights.
pub fn split_backward(
    (qkv, bias): (CubeTensor, Option<CubeTensor>),
    norms: Option<[CubeTensor; 2]>,
    grads: [CubeTensor; 3],
    sizes: Sizes,
    factor: f32,
) -> (CubeTensor, Option<CubeTensor>, Option<[CubeTensor; 2]>) {
    let Sizes { batch, tokens, queries, heads, width } = sizes;
    let d = heads * width;
    let dx = empty(&qkv, &[batch, tokens, 3 * d], qkv.dtype);
    let (rows, count) = pieces(&qkv, tokens, ROWS);
    let d_bias = empty(&qkv, &[1, batch * count, 3 * d], DType::F32);
    let plan = Plan::new(&qkv, width);
    let mut d_norms = Vec::with_capacity(3);
    for (part, grad) in grads.into_iter().enumerate() {
        let weights = norms.as_ref().and_then(|norms| norms.get(part)).cloned();
        let d_weights = match weights {
            Some(_) => empty(&qkv, &[1, batch * count, d], DType::F32),
            None => empty(&qkv, &[1, 1, plan.lanes], DType::F32),
        };
        if batch * tokens * d > 0 {
            // SAFETY: units beyond the last head or vector neither read nor write, cubes stop at the last token;
            // `d_weights` is written only where there are weights.
            unsafe {
                split_backward_kernel::launch_unchecked(
                    &qkv.client.clone(),
                    CubeCount::Static(heads.div_ceil(plan.groups) as u32, count as u32, batch as u32),
                    line(plan.units()),
                    address([&qkv, &grad, &dx, &d_bias]),
                    plan.lanes,
                    qkv.clone().into_tensor_arg(),
                    bias.clone().map(CubeTensor::into_buffer_arg).into(),
                    weights.clone().map(CubeTensor::into_buffer_arg).into(),
                    grad.into_tensor_arg(),
                    dx.clone().into_tensor_arg(),
                    d_bias.clone().into_tensor_arg(),
                    d_weights.clone().into_tensor_arg(),
                    tokens,
                    if part == 0 { queries } else { tokens },
                    heads,
                    part,
                    rows,
                    if part == 0 { factor } else { 1.0 },
                    EPS,
                    weights.is_some(),
                    plan.vectors,
                    plan.group,
                    plan.groups,
                    elem(&qkv),
                );
            }
        }
        if weights.is_some() {
            d_norms.push(shaped(total(shaped(total(d_weights), &[1, heads, width])), &[width]));
        }
    }
    let d_bias = bias.map(|_| shaped(total(d_bias), &[3 * d]));
    (dx, d_bias, d_norms.try_into().ok())
}
