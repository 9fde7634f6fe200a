//! The pictures beside the paper's tables: what each method makes of what no input saw, and of which Gaussians.

use std::{
    ops::ControlFlow,
    path::{Path, PathBuf},
};

use freerange::{DeviceName, EncoderPlaces, Reconstructor, View, pictures::render_view};
use freerange_eval::{EvalObject, record::ViewSet, runner::Objects};
use freerange_gaussians::{Gaussians, channel};
use freerange_scene::camera::image_ops::{composite, resize_area, sheet, shrunk_size, to_picture};
use image::RgbaImage;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::sources::SourceArgs;
use crate::error::CliError;

/// The rows that pictures are made of, from left to right.
const ROWS: [&str; 4] = ["full", "no_flow_matching", "pixel_aligned", "voxel_aligned"];
/// Longest side of one picture, in pixels.
const SIDE: u32 = 256;
/// By what Gaussians are divided in size to be told apart, as in the paper's Figure 4.
const SHRUNK: f32 = 4.0;
/// Input views of each object.
const INPUTS: usize = 4;

/// Arguments for pictures.
#[derive(clap::Args)]
pub struct PictureArgs {
    /// Write an image of each object's inputs, true view and rows. Needs --runs and a source of objects.
    ///
    /// Below each row are its Gaussians, shrunk and in random colors.
    #[arg(long, value_name = "PNG", requires = "runs")]
    picture: Option<PathBuf>,
    /// Folder of the rows' training runs, for --picture.
    #[arg(long, value_name = "DIR", requires = "picture")]
    runs: Option<PathBuf>,
    /// Names of the objects in the picture [default: the first three].
    #[arg(long, value_name = "NAMES", value_delimiter = ',', requires = "picture")]
    objects: Vec<String>,
    #[command(flatten)]
    source: SourceArgs,
}

impl PictureArgs {
    /// Refuses objects that no picture shows.
    pub fn check(&self) -> Result<(), CliError> {
        match self.picture.is_none() && self.source.given() {
            true => Err(CliError::input("--scenes, --data and --generated go with --picture only")),
            false => Ok(()),
        }
    }

    /// Writes the picture, if one is asked for.
    pub fn run(&self) -> Result<(), CliError> {
        let (Some(output), Some(runs)) = (&self.picture, &self.runs) else { return Ok(()) };
        let source = self.source.open()?;
        let chosen: Vec<usize> = match self.objects.as_slice() {
            [] => (0..source.names().len().min(3)).collect(),
            names => names.iter().map(|name| number(source.names(), name)).collect::<Result<_, _>>()?,
        };
        let device = DeviceName::Auto.open()?;
        let mut models = Vec::new();
        for row in ROWS {
            let checkpoint = runs.join(row).join("checkpoint.safetensors");
            if checkpoint.is_file() {
                models.push(Reconstructor::load(&checkpoint, &EncoderPlaces::default(), &device)?);
            } else {
                eprintln!("{row}: not in the image, {} is not there", checkpoint.display());
            }
        }
        if models.is_empty() {
            return Err(CliError::file(runs, format!("expected ROW/checkpoint.safetensors for one of {ROWS:?}")));
        }
        let mut rows = Vec::new();
        for index in chosen {
            let object = source.load(index).map_err(CliError::input)?;
            rows.extend(pictures(&object, &models)?);
        }
        save(&sheet(&rows), output)
    }
}

fn number(names: &[String], name: &String) -> Result<usize, CliError> {
    names
        .iter()
        .position(|n| n == name)
        .ok_or_else(|| CliError::input(format!("--objects: expected names among {}, found {name}", names.join(", "))))
}

/// Two rows of pictures of an object.
fn pictures(object: &EvalObject, models: &[Reconstructor]) -> Result<[Vec<RgbaImage>; 2], CliError> {
    let inputs = object.inputs(ViewSet::Partial, INPUTS).map_err(CliError::input)?;
    let behind = farthest(&object.validation(), &inputs);
    let (w, h) = behind.image.dimensions();
    let mut first = vec![grid(&inputs, (w, h)), small(&to_picture(&composite(&behind.image, [1.0; 3]), w, h))];
    let blank = || small(&RgbaImage::from_pixel(w, h, image::Rgba([255; 4])));
    let mut second = vec![blank(), blank()];
    for model in models {
        let found = model.run(&inputs, &model.options()?, &mut |_| ControlFlow::Continue(()))?;
        let gaussians = &found.samples[0].gaussians;
        first.push(small(&to_picture(&render_view(gaussians, &behind.camera)?, w, h)));
        second.push(small(&to_picture(&render_view(&told_apart(gaussians), &behind.camera)?, w, h)));
    }
    Ok([first, second])
}

/// The view whose axis is farthest from every input's.
fn farthest(views: &[View], inputs: &[View]) -> View {
    let axis = |v: &View| v.camera.world_to_camera.row(2).truncate().normalize();
    let nearest = |v: &View| inputs.iter().map(|i| axis(i).dot(axis(v))).fold(f64::NEG_INFINITY, f64::max);
    let found = views.iter().min_by(|a, b| nearest(a).total_cmp(&nearest(b)));
    found.expect("an object has validation views").clone()
}

/// The inputs, two by two, in the size of one picture.
fn grid(inputs: &[View], (w, h): (u32, u32)) -> RgbaImage {
    let each = |v: &View| {
        let (iw, ih) = v.image.dimensions();
        resize_area(&to_picture(&composite(&v.image, [1.0; 3]), iw, ih), SIDE / 2, SIDE / 2)
    };
    let rows: Vec<Vec<RgbaImage>> = inputs.chunks(2).map(|pair| pair.iter().map(each).collect()).collect();
    let (width, height) = shrunk_size((w, h), SIDE);
    resize_area(&sheet(&rows), width, height)
}

fn small(image: &RgbaImage) -> RgbaImage {
    let (width, height) = shrunk_size(image.dimensions(), SIDE);
    resize_area(image, width, height)
}

/// The visible Gaussians, a quarter as large, opaque, each in a color of its own.
fn told_apart(cloud: &Gaussians) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut rows = Vec::new();
    for row in cloud.rows().as_chunks::<{ channel::COUNT }>().0 {
        let mut row = *row;
        if row[channel::LOGIT_OPACITY] < 0.0 {
            continue; // more transparent than not: no part of the surface
        }
        row[channel::LOG_SCALE].iter_mut().for_each(|s| *s -= SHRUNK.ln());
        row[channel::LOGIT_OPACITY] = 4.0;
        row[channel::COLOR].iter_mut().for_each(|c| *c = rng.random());
        rows.extend(row);
    }
    Gaussians::from_rows(rows)
}

fn save(picture: &RgbaImage, path: &Path) -> Result<(), CliError> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut bytes, image::ImageFormat::Png).map_err(|e| CliError::file(path, e))?;
    freerange_util::write_atomically(path, |file| std::io::Write::write_all(file, bytes.get_ref()))
        .map_err(|e| CliError::file(path, e))
}
