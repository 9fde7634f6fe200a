//! From heads `[b heads, t, width]` back to tokens `[b, t, d]`, and pieces into their places.

use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::{self, calculate_cube_count_elemwise, cube, prelude::*};

use super::{
    address, dims, elem, empty,
    heads::{Plan, Sizes},
    lanes, line, max_units,
    reduce::{across, group_sum},
    spread,
};

/// A piece `[pairs, n, width]` of the mixed values, from pair `first_pair` and query `first_query` on, to tokens.
#[cube(launch_unchecked, address_type = "dynamic")]
fn merge_kernel<M: Float, E: Float, N: Size>(
    mixed: &Tensor<Vector<M, N>>,
    factors: ComptimeOption<&[f32]>, // [pairs, rows]
    out: &mut Tensor<Vector<E, N>>,  // [b, queries, d]
    items: usize,
    rows: usize,
    queries: usize,
    heads: usize,
    first_pair: usize,
    first_query: usize,
    #[comptime] vectors: usize,
    #[define(M, E)] _dtypes: [ElemType; 2],
) {
    let i = ABSOLUTE_POS;
    if i < items {
        let row = i / vectors;
        let pair = first_pair + row / rows;
        let factor: ComptimeOption<f32> = factors.map(|f| f[row]);
        let v = Vector::<f32, N>::cast_from(mixed[i]) * Vector::new(factor.unwrap_or_else(|| 1.0f32));
        let token = pair / heads * queries + first_query + row % rows;
        out[(token * heads + pair % heads) * vectors + i % vectors] = Vector::cast_from(v);
    }
}

/// Writes a piece of the mixed values, each row times its factor, into `out`.
pub fn merge(
    mixed: CubeTensor,
    factors: Option<CubeTensor>,
    out: &CubeTensor,
    sizes: Sizes,
    first_pair: usize,
    first_query: usize,
) {
    let [pairs, n, width] = dims(&mixed);
    let lanes = lanes(out, &[mixed.dtype, out.dtype], &[width]);
    let items = pairs * n * width / lanes;
    let cube = line(max_units(out));
    // SAFETY: units stop at the last item, which `mixed` has; the caller's piece lies within `out`.
    unsafe {
        merge_kernel::launch_unchecked(
            &out.client,
            calculate_cube_count_elemwise(&out.client, items, cube),
            cube,
            address([&mixed, out]),
            lanes,
            mixed.clone().into_tensor_arg(),
            factors.map(CubeTensor::into_buffer_arg).into(),
            out.clone().into_tensor_arg(),
            items,
            n,
            sizes.queries,
            sizes.heads,
            first_pair,
            first_query,
            width / lanes,
            [elem(&mixed), elem(out)],
        );
    }
}

/// The gradient of the mixed values as heads, and its product with them summed over each head.
#[cube(launch_unchecked, address_type = "dynamic")]
fn merge_backward_kernel<E: Float, N: Size>(
    out: &Tensor<Vector<E, N>>,       // [b, queries, d]
    grad: &Tensor<Vector<E, N>>,      // [b, queries, d]
    split: &mut Tensor<Vector<E, N>>, // [b heads, queries, width]
    delta: &mut Tensor<f32>,          // [b heads, queries]
    items: usize,
    queries: usize,
    heads: usize,
    #[comptime] vectors: usize,
    #[comptime] group: usize,
    #[comptime] groups: usize,
    #[define(E)] _dtype: ElemType,
) {
    let mut scratch = Shared::<[f32]>::new_slice(comptime!(group * groups));
    let unit = UNIT_POS as usize;
    let lane = unit % group;
    let item = CUBE_POS * groups + unit / group;
    let (head, token, batch) = (item % heads, item / heads % queries, item / heads / queries);
    let row = (batch * heads + head) * queries + token;
    let mut products = Vector::<f32, N>::new(0.0f32);
    #[unroll]
    for i in 0..comptime!(vectors.div_ceil(group)) {
        let j = lane + i * group;
        if item < items && j < vectors {
            let g = grad[item * vectors + j];
            products += Vector::<f32, N>::cast_from(g) * Vector::cast_from(out[item * vectors + j]);
            split[row * vectors + j] = g;
        }
    }
    let sum = group_sum(across::<N>(products), &mut scratch, group);
    if item < items && lane == 0 {
        delta[row] = sum;
    }
}

/// See [`merge_backward_kernel`]; both inputs of one type.
pub fn merge_backward(out: CubeTensor, grad: CubeTensor, sizes: Sizes) -> (CubeTensor, CubeTensor) {
    let (pairs, queries) = (sizes.pairs(), sizes.queries);
    let split = empty(&out, &[pairs, queries, sizes.width], out.dtype);
    let delta = empty(&out, &[pairs, queries], DType::F32);
    let plan = Plan::new(&out, sizes.width);
    let items = pairs * queries;
    if items > 0 {
        // SAFETY: groups beyond the last item and units beyond the last vector neither read nor write.
        unsafe {
            merge_backward_kernel::launch_unchecked(
                &out.client.clone(),
                spread(&out, items.div_ceil(plan.groups)),
                line(plan.units()),
                address([&out, &grad, &split, &delta]),
                plan.lanes,
                out.clone().into_tensor_arg(),
                grad.into_tensor_arg(),
                split.clone().into_tensor_arg(),
                delta.clone().into_tensor_arg(),
                items,
                queries,
                sizes.heads,
                plan.vectors,
                plan.group,
                plan.groups,
                elem(&out),
            );
        }
    }
    (split, delta)
}

/// Writes or adds a piece `[pairs, n, width]` into `[b heads, rows, width]`.
#[cube(launch_unchecked, address_type = "dynamic")]
fn put_kernel<N: Size>(
    piece: &Tensor<Vector<f32, N>>,
    out: &mut Tensor<Vector<f32, N>>,
    items: usize,
    piece_rows: usize,
    rows: usize,
    first_pair: usize,
    first_row: usize,
    #[comptime] add: bool,
    #[comptime] vectors: usize,
) {
    let i = ABSOLUTE_POS;
    if i < items {
        let row = i / vectors;
        let at = ((first_pair + row / piece_rows) * rows + first_row + row % piece_rows) * vectors + i % vectors;
        if comptime!(add) {
            out[at] += piece[i];
        } else {
            out[at] = piece[i];
        }
    }
}

/// See [`put_kernel`].
pub fn put(piece: CubeTensor, out: &CubeTensor, first_pair: usize, first_row: usize, add: bool) {
    let [pairs, n, width] = dims(&piece);
    let [_, rows, _] = dims(out);
    let lanes = lanes(out, &[DType::F32], &[width]);
    let items = pairs * n * width / lanes;
    let cube = line(max_units(out));
    // SAFETY: units stop at the last item, which `piece` has; the caller's piece lies within `out`.
    unsafe {
        put_kernel::launch_unchecked(
            &out.client,
            calculate_cube_count_elemwise(&out.client, items, cube),
            cube,
            address([&piece, out]),
            lanes,
            piece.into_tensor_arg(),
            out.clone().into_tensor_arg(),
            items,
            n,
            rows,
            first_pair,
            first_row,
            add,
            width / lanes,
        );
    }
}
