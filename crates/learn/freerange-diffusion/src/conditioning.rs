//! Posed images as the encoder takes them.

use burn::tensor::{Device, Int, Tensor, TensorData};
use freerange_model::{Alignment, CellViews, FreeRange, ModelConfig, ModelKind, PLUCKER, VolumeConfig};
use freerange_scene::camera::{
    Camera, View, Window,
    image_ops::{resize_area, shrunk_size, to_f32_rgba},
    pixel_of, plucker,
};
use glam::DVec3;
use rayon::prelude::*;

use crate::FlowError;

/// The same view at most `size` pixels wide and high, aspect kept.
pub fn shrink(view: &View, size: u32) -> View {
    let (w, h) = shrunk_size(view.image.dimensions(), size);
    resized(view, w, h)
}

/// The views of all objects as squares of one size, at most `size` pixels and at most those of the smallest, to compare
/// renders with. Pixels stay square.
pub fn squares(objects: &[&[View]], size: u32) -> Vec<Vec<View>> {
    let windows = |o: &&[View]| o.iter().map(|v| Window::compared(v).cut(v).into_owned()).collect::<Vec<_>>();
    let cut: Vec<Vec<View>> = objects.iter().map(windows).collect();
    let side = cut.iter().flatten().map(|v| v.image.width()).min().map_or(size, |smallest| smallest.min(size));
    cut.iter().map(|o| o.iter().map(|v| resized(v, side, side)).collect()).collect()
}

fn resized(view: &View, w: u32, h: u32) -> View {
    if view.image.dimensions() == (w, h) {
        return view.clone();
    }
    View { name: view.name.clone(), camera: view.camera.resized(w, h), image: resize_area(&view.image, w, h) }
}

/// The posed images as the image encoder takes them.
#[derive(Clone, Debug)]
pub struct Conditioning {
    /// `[b, views, h, w, channels]`: color composited on white, then alpha where the encoder has four channels.
    pub images: Tensor<5>,
    /// `[b, views, rows, columns, 6]`, one ray per patch center.
    pub plucker: Tensor<5>,
    /// What binds Gaussians to pixels or cells, for models of these kinds.
    pub alignment: Option<Alignment>,
}

impl Conditioning {
    /// From the input views of each object; all objects have the same number of views. Images are cut or padded to
    /// [squares](Window::around) and resized to the encoder's side, intrinsics with them.
    pub fn new(objects: &[Vec<&View>], config: &ModelConfig, device: &Device) -> Result<Self, FlowError> {
        let (b, v) = (objects.len(), objects.first().map_or(0, Vec::len));
        if v == 0 {
            return Err(FlowError::NoViews);
        }
        let size = config.image_size;
        let (channels, grid) = (config.image_channels(), config.patches_per_side());
        let views: Vec<&View> = objects.iter().flatten().copied().collect();
        let side = if config.kind == ModelKind::PixelAligned { size as usize } else { 0 };
        type Parts = (((Vec<Vec<f32>>, Vec<Camera>), Vec<Vec<f32>>), Vec<Vec<f32>>);
        let (((pixels, cameras), plucker_rays), rays): Parts = views
            .into_par_iter()
            .map(|view| {
                let view = resized(&Window::around(view).cut(view), size, size);
                let on_white = |p: &[f32; 4], c: usize| if c < 3 { p[c] * p[3] + 1.0 - p[3] } else { p[3] };
                let all = to_f32_rgba(&view.image);
                let pixels = all.as_chunks::<4>().0.iter().flat_map(|p| (0..channels).map(move |c| on_white(p, c)));
                let rays = |side| plucker(&view.camera, side, side);
                (((pixels.collect::<Vec<f32>>(), view.camera), rays(grid)), rays(side))
            })
            .unzip();
        let size = size as usize;
        let alignment = match (&config.volume, side) {
            (Some(volume), _) => {
                let (patches, shown) = at_cells(volume, (&pixels, &cameras), [v, grid, channels]);
                let tokens = volume.tokens();
                Some(Alignment::Cells(CellViews {
                    patches: Tensor::<2, Int>::from_data(TensorData::new(patches, [b, v * tokens]), device),
                    pixels: Tensor::from_data(TensorData::new(shown, [b, v, tokens, config.cell_channels()]), device),
                }))
            }
            (None, 0) => None,
            (None, side) => {
                let rays = TensorData::new(rays.concat(), [b, v, side, side, PLUCKER]);
                Some(Alignment::Rays(Tensor::from_data(rays, device)))
            }
        };
        let tensor = |values: Vec<Vec<f32>>, side: usize, channels: usize| {
            Tensor::<5>::from_data(TensorData::new(values.concat(), [b, v, side, side, channels]), device)
        };
        Ok(Self { images: tensor(pixels, size, channels), plucker: tensor(plucker_rays, grid, PLUCKER), alignment })
    }

    /// The Gaussians of a model that predicts in one pass: see [`FreeRange::predict`]. `[b, n, 14]`
    pub fn predict(self, model: &FreeRange) -> Tensor<3> {
        model.predict(model.encode(self.images, self.plucker), self.alignment)
    }

    /// The image tokens. `[b, views * rows * columns, features]`
    pub fn encode(self, model: &FreeRange) -> Tensor<3> {
        model.encode(self.images, self.plucker)
    }
}

/// What views show at the tokens and cells of a volume: the two parts of [`CellViews`], of `views` views an object.
/// `pixels` and `cameras` are of the encoder's inputs, `grid` patches wide, with so many channels.
fn at_cells(
    volume: &VolumeConfig,
    (pixels, cameras): (&[Vec<f32>], &[Camera]),
    [views, grid, channels]: [usize; 3],
) -> (Vec<i64>, Vec<f32>) {
    let point = |p: &[f32; 3]| DVec3::from(p.map(f64::from));
    let (tokens, cells) = (volume.token_centers(), volume.cell_centers());
    let none = (views * grid * grid) as i64;
    let (mut patches, mut shown) = (Vec::new(), Vec::new());
    for (i, (image, camera)) in pixels.iter().zip(cameras).enumerate() {
        let coarse = camera.resized(grid as u32, grid as u32);
        let first = (i % views * grid * grid) as i64;
        patches.extend(tokens.iter().map(|p| pixel_of(&coarse, point(p)).map_or(none, |(at, _)| first + at as i64)));
        for cell in &cells {
            match pixel_of(camera, point(cell)) {
                Some((at, _)) => shown.extend_from_slice(&image[at * channels..][..channels]),
                None => shown.extend(std::iter::repeat_n(0.0, channels)),
            }
        }
    }
    (patches, shown)
}

#[cfg(test)]
mod tests {
    use freerange_model::{EncoderConfig, PatchConfig};

    use super::*;

    #[test]
    fn cells_see_what_lies_in_front_of_and_behind_them() {
        // One column of each image per cell: from the front x grows to the right, from behind to the left.
        let volume = VolumeConfig { tokens_per_side: 2, cells_per_token_side: 2, gaussians_per_cell: 1 };
        let config = ModelConfig {
            kind: ModelKind::VoxelAligned,
            volume: Some(volume),
            image_size: 8,
            encoder: EncoderConfig::Patch(PatchConfig { patch_size: 4, channels: 4 }),
            gradient_channels: false,
            ..ModelConfig::default()
        };
        let view = |y: f64, fov: f64| {
            let camera = Camera::look_at(DVec3::new(0.0, y, 0.0), DVec3::ZERO, DVec3::Z, fov, 8, 8);
            let image = image::RgbaImage::from_fn(8, 8, |x, _| image::Rgba([x as u8 * 10, 0, 0, 255]));
            View { name: String::new(), camera, image }
        };
        // Wide enough for the whole volume; so narrow that most of it lies outside.
        let views =
            [view(-40.0, 2.0 * (0.55f64 / 40.0).atan()), view(40.0, 2.0 * (0.55f64 / 40.0).atan()), view(-40.0, 0.001)];
        let seen = Conditioning::new(&[views.iter().collect()], &config, &Device::flex()).unwrap();
        let Some(Alignment::Cells(CellViews { patches, pixels })) = seen.alignment else { panic!("no cells") };
        assert_eq!((patches.dims(), pixels.dims()), ([1, 3 * 8], [1, 3, 8, 8 * 4]));
        let patches = patches.into_data().convert::<i64>().try_into_vec::<i64>().unwrap();
        let pixels = pixels.into_data().try_into_vec::<f32>().unwrap();
        for (token, center) in volume.token_centers().iter().enumerate() {
            let [right, low] = [center[0] > 0.0, center[2] < 0.0].map(i64::from);
            assert_eq!(patches[token], 2 * low + right, "front, token {token}");
            assert_eq!(patches[8 + token], 4 + 2 * low + 1 - right, "behind, token {token}");
            assert_eq!(patches[16 + token], 12, "a token out of sight has no patch");
        }
        let cells = volume.cell_centers();
        for (cell, center) in cells.iter().enumerate() {
            // Cells are two pixels wide, their centers on the border of both.
            let column = ((center[0] + 0.55) / 1.1 * 8.0).round();
            let red = |view: usize| pixels[(view * cells.len() + cell) * 4] * 25.5;
            assert!((red(0) - column).abs() < 1.01, "front, cell {cell}: {} {column}", red(0));
            assert!((red(1) - (8.0 - column)).abs() < 1.01, "behind, cell {cell}: {} {column}", red(1));
            assert_eq!(pixels[(2 * cells.len() + cell) * 4 + 3], 0.0, "out of sight");
        }
    }
}
