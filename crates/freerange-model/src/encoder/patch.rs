//! The encoder without outside weights: the pixels of each patch, optionally through a small network.

use burn::{
    module::Module,
    tensor::{Tensor, activation::gelu},
};

use crate::{
    ModelError, PatchConfig,
    layers::{Builder, Init, Linear, Source},
};

/// Linear, GELU, linear on the pixels of a patch.
#[derive(Module, Debug)]
pub struct PatchMlp {
    first: Linear,
    second: Linear,
}

impl PatchMlp {
    pub fn build<S: Source>(
        config: &PatchConfig,
        prefix: &str,
        builder: &mut Builder<'_, S>,
    ) -> Result<Self, ModelError> {
        let pixels = config.channels * (config.patch_size * config.patch_size) as usize;
        let width = config.patch_hidden;
        Ok(Self {
            first: builder.linear(&format!("{prefix}patch.0"), pixels, width, Init::Xavier)?,
            second: builder.linear(&format!("{prefix}patch.2"), width, width, Init::Xavier)?,
        })
    }

    /// `[b, tokens, pixels]` to `[b, tokens, width]`.
    pub fn forward(&self, pixels: Tensor<3>) -> Tensor<3> {
        self.second.forward(gelu(self.first.forward(pixels)))
    }
}

/// `[b, views, h, w, c]` to `[b, views * h/p * w/p, p * p * c]`: view by view, row by row; pixels of a patch row by row.
pub fn patches(images: Tensor<5>, p: usize) -> Tensor<3> {
    let [b, views, h, w, c] = images.dims();
    let (rows, columns) = (h / p, w / p);
    let x = images.reshape([b * views * rows, p, columns, p * c]).swap_dims(1, 2); // [b v rows, columns, p, p c]
    x.reshape([b, views * rows * columns, p * p * c])
}
