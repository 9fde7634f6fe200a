//! What the views show at the tokens of a volume, for a voxel-aligned model.

use burn::{
    module::Module,
    tensor::{Int, Tensor, TensorData, activation::silu},
};

use crate::{
    ModelError,
    layers::{Builder, Init, Linear, Source},
};

/// What each view shows where the tokens of a volume lie.
#[derive(Clone, Debug)]
pub struct CellViews {
    /// Which of an object's image tokens (view by view, row by row) shows the token's center; as many as there are image
    /// tokens: none. `[b, views * tokens]`
    pub patches: Tensor<2, Int>,
    /// The pixel at the center of each of its cells, zeros outside of the image. `[b, views, tokens, cells * channels]`
    pub pixels: Tensor<4>,
}

/// An MLP of the image token and the pixels at each token of a volume, whose mean over views is added to the token.
#[derive(Module, Debug)]
pub(crate) struct Lift {
    first: Linear,
    second: Linear,
}

impl Lift {
    pub fn build<S: Source>(
        d: usize,
        pixels: usize,
        name: &str,
        builder: &mut Builder<'_, S>,
    ) -> Result<Self, ModelError> {
        Ok(Self {
            first: builder.linear(&format!("{name}.0"), d + pixels, d, Init::Xavier)?,
            second: builder.linear(&format!("{name}.2"), d, d, Init::Xavier)?,
        })
    }

    /// `images`, the image tokens as the first block takes them, `[b, m, d]`, to `[b, tokens, d]`.
    pub fn forward(&self, images: Tensor<3>, cells: CellViews) -> Tensor<3> {
        let ([b, m, d], [_, views, tokens, _]) = (images.dims(), cells.pixels.dims());
        let device = images.device();
        let nothing = Tensor::zeros([b, 1, d], &device);
        let features = Tensor::cat(vec![images, nothing], 1).reshape([b * (m + 1), d]);
        let starts: Vec<i64> = (0..b).map(|i| (i * (m + 1)) as i64).collect();
        let starts = Tensor::<1, Int>::from_data(TensorData::new(starts, [b]), &device).reshape([b, 1]);
        let at = (cells.patches + starts).reshape([b * views * tokens]);
        let features = features.select(0, at).reshape([b, views, tokens, d]);
        let seen = silu(self.first.forward(Tensor::cat(vec![features, cells.pixels], 3)));
        self.second.forward(seen.mean_dim(1).reshape([b, tokens, d]))
    }
}
