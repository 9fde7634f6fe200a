//! Options that say how photos are read.

use std::{
    path::{Path, PathBuf},
    str::FromStr,
};

use freerange::{Scene, SceneConfig, Up};
use freerange_scene::{
    KeepWhole, LoadConfig, MaskModel, MaskSource, PixelRange,
    estimate::Hints,
    files,
    read::{Cameras, Format, ReadConfig, Turntable, cameras_with},
};
use glam::DVec3;

use crate::error::CliError;

/// How photos are read.
#[derive(clap::Args)]
#[command(next_help_heading = "Photos and cameras")]
pub struct Photos {
    /// Format of the cameras, if a folder has several: transforms, colmap, polycam, metashape, realitycapture or opf.
    #[arg(long, value_name = "FORMAT", value_parser = parse_format, hide_short_help = true)]
    cameras: Option<Format>,
    /// Photos without cameras, of one full turn of a turntable: elevation and field of view in degrees.
    ///
    /// The photos are at even steps, in the order of their names. The field of view is across the longer side. The object turns
    /// counterclockwise as seen from above; add `,cw` for clockwise.
    #[arg(
        long,
        value_name = "ELEVATION,FOV",
        conflicts_with = "cameras",
        allow_hyphen_values = true,
        hide_short_help = true
    )]
    turntable: Option<Turntable>,
    /// Up axis of the scene: auto, z, y, cameras (tops of the photos), or a direction X,Y,Z.
    ///
    /// With auto: +z where the cameras' format defines it, else from the table below the object or the cameras.
    #[arg(long, default_value = "auto", allow_hyphen_values = true)]
    up: UpChoice,
    /// Folder of the photos, if they are not beside the cameras.
    #[arg(long, value_name = "FOLDER", hide_short_help = true)]
    images: Option<PathBuf>,
    /// Source of masks: a folder, alpha, plain (one background color) or estimate [default: auto].
    ///
    /// A folder has NAME.png, the object in white. With auto: the first of mask files, alpha, a plain background, and an
    /// estimate from poses and colors.
    #[arg(long, value_name = "WHERE", value_parser = parse_masks)]
    masks: Option<MaskSource>,
    /// Masks from a segmentation network, an ONNX file such as u2netp.onnx.
    ///
    /// It has one input (1 x 3 x height x width); its first output is the mask. Needs a build with --features mask-model.
    #[arg(long, value_name = "FILE", conflicts_with = "masks", hide_short_help = true, hide = !cfg!(feature = "mask-model"))]
    mask_model: Option<PathBuf>,
    /// Pixel values of the mask network: imagenet (normalized), unit (0 to 1), centered (-0.5 to 0.5), signed (-1 to 1).
    #[arg(long, value_name = "RANGE", default_value = "imagenet", requires = "mask_model", value_parser = parse_range, hide_short_help = true, hide = !cfg!(feature = "mask-model"))]
    mask_model_pixels: PixelRange,
    /// The object is black in mask files.
    #[arg(long, hide_short_help = true)]
    invert_masks: bool,
    /// Longest side of the photos; larger ones are shrunk.
    #[arg(long, value_name = "PIXELS", default_value_t = 1024, value_parser = clap::value_parser!(u32).range(64..=16384), hide_short_help = true)]
    max_resolution: u32,
    /// Center of the object in the scene's frame [default: from masks and cameras].
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_point, allow_hyphen_values = true, hide_short_help = true)]
    center: Option<DVec3>,
    /// Radius of a sphere about the center that holds the object [default: from masks and cameras].
    #[arg(long, value_name = "R", hide_short_help = true)]
    radius: Option<f64>,
}

/// Which way is up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum UpChoice {
    /// By the cameras' format: z where that is its rule, else what the object stands on, or the cameras.
    Auto,
    /// As told.
    Told(Up),
}

impl FromStr for UpChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Ok(match text {
            "auto" => Self::Auto,
            "z" => Self::Told(Up::Z),
            "y" => Self::Told(Up::Y),
            "cameras" => Self::Told(Up::Cameras),
            _ => {
                let direction = parse_point(text).ok().filter(|d| d.length() > 0.0);
                let direction = direction.ok_or("expected auto, z, y, cameras, or a direction X,Y,Z")?;
                Self::Told(Up::Direction(direction))
            }
        })
    }
}

impl UpChoice {
    /// What it means where nothing else is known.
    pub fn or_z(self) -> Up {
        match self {
            Self::Auto => Up::Z,
            Self::Told(up) => up,
        }
    }
}

fn parse_format(text: &str) -> Result<Format, String> {
    let known = Format::ALL.into_iter().find(|f| f.name() == text);
    known.ok_or_else(|| "expected transforms, colmap, polycam, metashape, realitycapture or opf".into())
}

fn parse_masks(text: &str) -> Result<MaskSource, String> {
    Ok(match text {
        "auto" => MaskSource::Auto,
        "alpha" => MaskSource::Alpha,
        "plain" => MaskSource::Plain,
        "estimate" => MaskSource::Estimate,
        folder => MaskSource::Files(folder.into()),
    })
}

fn parse_range(text: &str) -> Result<PixelRange, String> {
    let known = PixelRange::ALL.into_iter().find(|(name, _)| *name == text);
    known.map(|(_, range)| range).ok_or_else(|| "expected imagenet, unit, centered or signed".into())
}

fn parse_point(text: &str) -> Result<DVec3, String> {
    let numbers: Vec<f64> =
        text.split(',').filter_map(|p| p.trim().parse().ok()).filter(|v: &f64| v.is_finite()).collect();
    match (numbers.as_slice(), text.split(',').count()) {
        (&[x, y, z], 3) => Ok(DVec3::new(x, y, z)),
        _ => Err("expected three numbers, as in 0.1,0,-2".into()),
    }
}

impl Photos {
    /// Reads the cameras of a scene.
    pub fn cameras(&self, scene: &Path) -> Result<Cameras, CliError> {
        let Self { cameras: format, turntable, images, .. } = self;
        Ok(cameras_with(scene, &ReadConfig { format: *format, turntable: *turntable, images: images.clone() })?)
    }

    fn config(&self) -> LoadConfig {
        let masks = match &self.mask_model {
            Some(file) => MaskSource::Model(MaskModel { file: file.clone(), pixels: self.mask_model_pixels }),
            None => self.masks.clone().unwrap_or_default(),
        };
        LoadConfig {
            masks,
            invert_masks: self.invert_masks,
            max_side: self.max_resolution,
            hints: Hints { center: self.center, radius: self.radius, others: None },
            ..LoadConfig::default()
        }
    }

    /// The files that a scene is read from.
    pub fn files(&self, cameras: &Cameras) -> Result<Vec<PathBuf>, CliError> {
        Ok(files(cameras, &self.config())?)
    }

    /// Name and value of every option.
    pub fn told(&self) -> Vec<(String, String)> {
        let Self {
            cameras,
            turntable,
            up,
            images,
            masks,
            mask_model,
            mask_model_pixels,
            invert_masks,
            max_resolution,
            center,
            radius,
        } = self;
        vec![
            ("mask-model".into(), format!("{mask_model:?}, {mask_model_pixels:?}")),
            ("cameras".into(), format!("{:?}", cameras.map(Format::name))),
            ("turntable".into(), format!("{turntable:?}")),
            ("up".into(), format!("{up:?}")),
            ("images".into(), format!("{images:?}")),
            ("masks".into(), format!("{masks:?}")),
            ("invert-masks".into(), invert_masks.to_string()),
            ("max-resolution".into(), max_resolution.to_string()),
            ("center".into(), format!("{center:?}")),
            ("radius".into(), format!("{radius:?}")),
        ]
    }

    /// Reads a scene; `whole`: what is kept of whole photos.
    pub fn load(&self, cameras: Cameras, whole: KeepWhole) -> Result<Scene, CliError> {
        let up = match self.up {
            UpChoice::Told(up) => Some(up),
            UpChoice::Auto => None,
        };
        let photos = LoadConfig { whole, ..self.config() };
        Ok(Scene::load(cameras, &SceneConfig { photos, up, ..SceneConfig::default() })?)
    }
}
