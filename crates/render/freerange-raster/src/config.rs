//! Settings of the image model.

/// Settings of the rasterizer; the defaults are gsplat's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterConfig {
    /// Gaussians with a smaller camera z are culled. World units.
    pub near: f32,
    /// Gaussians with a larger camera z are culled. World units.
    pub far: f32,
    /// Added to both variances of a projected Gaussian, in square pixels: nothing is thinner than about a pixel.
    pub blur: f32,
    /// Whether to render depth as well.
    pub depth: bool,
}

impl Default for RasterConfig {
    fn default() -> Self {
        Self { near: 0.01, far: 1e10, blur: 0.3, depth: false }
    }
}

impl RasterConfig {
    /// For images that stand for larger ones, `ratio` (0..1) being the small longest side over the large: the blur, a constant
    /// number of pixels, shrinks with them. Else Gaussians that look right on small images are too thin on large ones.
    pub fn shrunk(self, ratio: f32) -> Self {
        Self { blur: self.blur * ratio.min(1.0).powi(2), ..self }
    }
}
