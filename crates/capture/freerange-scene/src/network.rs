//! Masks from a user's own segmentation network, an ONNX file.

use crate::camera::{View, image_ops::resize_area};
use crate::{
    SceneError,
    error::In,
    mask_model::{MaskModel, PixelRange},
    read::bytes_of,
};
use image::{Rgba, RgbaImage};
use rten::{Dimension, Model, Value};
use std::path::Path;

/// Height and width for networks that take any size: that of U2-Net and its kin.
const SIDE: usize = 320;
/// No network for masks takes larger pictures.
const LARGEST: usize = 4096;

/// The object's share of each pixel, for every view at its image's own size, `[h, w]`.
pub fn masks(model: &MaskModel, views: &[View]) -> Result<Vec<Vec<u8>>, SceneError> {
    let file = model.file.as_path();
    let network = Network::open(file)?;
    views.iter().map(|view| network.mask(file, view, model.pixels)).collect()
}

struct Network {
    model: Model,
    /// Height and width that it takes.
    size: [usize; 2],
}

impl Network {
    fn open(file: &Path) -> Result<Self, SceneError> {
        let refused = |what: String| In(file).malformed("", format!("expected an ONNX network for masks: {what}"));
        let model = Model::load(bytes_of(file)?).map_err(|e| refused(e.to_string()))?;
        let inputs = model.input_ids().len();
        if inputs != 1 {
            return Err(In(file).field("", "inputs", "one", inputs));
        }
        if model.output_ids().is_empty() {
            return Err(In(file).field("", "outputs", "at least one", 0));
        }
        let shape = model.input_shape(0).unwrap_or_default();
        let told: Vec<String> = shape
            .iter()
            .map(|d| match d {
                Dimension::Fixed(n) => n.to_string(),
                Dimension::Symbolic(name) => name.clone(),
            })
            .collect();
        let is = |d: &Dimension, wanted: usize| match d {
            Dimension::Fixed(n) => *n == wanted,
            Dimension::Symbolic(_) => true,
        };
        let side = |d: &Dimension| match d {
            Dimension::Fixed(n) => Some(*n).filter(|n| (1..=LARGEST).contains(n)),
            Dimension::Symbolic(_) => Some(SIDE),
        };
        match shape.as_slice() {
            [batch, channels, h, w] if is(batch, 1) && is(channels, 3) => match (side(h), side(w)) {
                (Some(h), Some(w)) => Ok(Self { model, size: [h, w] }),
                _ => {
                    let expected = format!("height and width from 1 to {LARGEST}");
                    Err(In(file).field("", "input shape", &expected, told.join(" x ")))
                }
            },
            _ => Err(In(file).field("", "input shape", "1 x 3 x height x width", told.join(" x "))),
        }
    }

    fn mask(&self, file: &Path, view: &View, pixels: PixelRange) -> Result<Vec<u8>, SceneError> {
        let [h, w] = self.size;
        let small = resize_area(&view.image, w as u32, h as u32);
        let (mean, deviation) = pixels.mean_and_deviation();
        let channel = |c: usize| small.pixels().map(move |p| (f32::from(p[c]) / 255.0 - mean[c]) / deviation[c]);
        let input: Vec<f32> = (0..3).flat_map(channel).collect();
        let failed = |what: String| In(file).malformed("", format!("the network failed on {}: {what}", view.name));
        let input = Value::from_shape([1, 3, h, w], input).map_err(|e| failed(e.to_string()))?;
        let (from, to) = (self.model.input_ids()[0], self.model.output_ids()[0]);
        let outputs = self.model.run(vec![(from, input.into())], &[to], None).map_err(|e| failed(e.to_string()))?;
        let Some(output) = outputs.into_iter().next() else {
            return Err(failed("no output".into()));
        };
        let (oh, ow, mut values) = plane(output)
            .map_err(|found| In(file).field("", "output", "numbers of 32 bits, 1 x 1 x height x width", found))?;
        if let Some(v) = values.iter().find(|v| !v.is_finite()) {
            return Err(failed(format!("expected finite numbers, found {v}")));
        }
        // Beyond 0 to 1 they are log odds.
        if values.iter().any(|v| !(-1e-3..=1.001).contains(v)) {
            values.iter_mut().for_each(|v| *v = 1.0 / (1.0 + (-*v).exp()));
        }
        let gray = RgbaImage::from_fn(ow as u32, oh as u32, |x, y| {
            let v = (values[y as usize * ow + x as usize].clamp(0.0, 1.0) * 255.0).round() as u8;
            Rgba([v, v, v, 255])
        });
        let (width, height) = view.image.dimensions();
        let full = image::imageops::resize(&gray, width, height, image::imageops::FilterType::Triangle);
        Ok(full.pixels().map(|p| p[0]).collect())
    }
}

/// Height, width and values of a mask, with or without its batch and channel; else what it is instead.
fn plane(output: Value) -> Result<(usize, usize, Vec<f32>), String> {
    let told = |shape: &[usize]| shape.iter().map(ToString::to_string).collect::<Vec<_>>().join(" x ");
    let (shape, values): (Vec<usize>, Vec<f32>) = if let Ok((shape, values)) = output.clone().into_shape_vec::<f32, 4>()
    {
        (shape.to_vec(), values)
    } else if let Ok((shape, values)) = output.clone().into_shape_vec::<f32, 3>() {
        (shape.to_vec(), values)
    } else {
        let (shape, values) = output.into_shape_vec::<f32, 2>().map_err(|e| e.to_string())?;
        (shape.to_vec(), values)
    };
    match shape.as_slice() {
        [1, 1, h, w] | [1, h, w] | [h, w] if *h > 0 && *w > 0 => Ok((*h, *w, values)),
        _ => Err(told(&shape)),
    }
}
