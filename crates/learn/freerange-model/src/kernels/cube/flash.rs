//! CubeCL's flash attention. It does not tell the softmax's denominators, so it serves where nothing needs a gradient.

use burn::{
    backend::{cubecl::dtype_to_storage_type, ops::AttentionModuleOptions},
    tensor::DType,
};
use burn_cubecl::{kernel::attention::flash_attention, tensor::CubeTensor};
use cubek::attention::forward::{
    launch::{BlueprintStrategy, Strategy},
    routines::blackbox_accelerated::BlackboxAcceleratedStrategy,
};

use super::{dims, shaped};

/// Kernels to try in turn. On matrix units operands are f16, which half precision may be rounded to and f32 may not;
/// without them, the kernel for single units computes in the given type.
fn strategies(like: &CubeTensor) -> Vec<Strategy> {
    let f16 = dtype_to_storage_type(DType::F16);
    let features = &like.client.properties().features.matmul;
    let matrix_units = features.cmma.iter().any(|config| config.a_type == f16 && config.b_type == f16);
    match (matrix_units, like.dtype) {
        (true, DType::F32) => Vec::new(),
        (true, _) => [4, 2, 1]
            .map(|num_planes| BlackboxAcceleratedStrategy { num_planes, seq_q: 1, seq_kv: 1 })
            .map(|strategy| Strategy::BlackboxAccelerated(BlueprintStrategy::Inferred(strategy)))
            .into(),
        (false, _) => vec![Strategy::Unit(BlueprintStrategy::Inferred(()))],
    }
}

/// Whether there may be a kernel for this device and type.
pub fn possible(like: &CubeTensor) -> bool {
    !strategies(like).is_empty()
}

/// The mixed values `[b heads, queries, width]` of heads `[b heads, ·, width]`, scores divided by the root of `width`;
/// nothing where no kernel takes these sizes on this device.
pub fn attention(q: &CubeTensor, k: &CubeTensor, v: &CubeTensor) -> Option<CubeTensor> {
    let heads = |t: &CubeTensor| {
        let [pairs, n, width] = dims(t);
        shaped(t.clone(), &[1, pairs, n, width])
    };
    let out = strategies(q).into_iter().find_map(|strategy| {
        let options = AttentionModuleOptions::default();
        flash_attention(heads(q), heads(k), heads(v), None, None, options, strategy).ok()
    })?;
    let [_, pairs, n, width] = dims(&out);
    Some(shaped(out, &[pairs, n, width]))
}
