//! From cameras and files to views: pictures decoded, turned, freed from distortion, cut out.

use crate::{
    SceneError,
    error::In,
    estimate::{self, Estimate, Hints},
    read::{Cameras, Format, IMAGES, LARGEST_SIDE, Photo, inside},
};
use freerange_camera::{Camera, Lens, Up, View, image_ops::resize_area, scene::cut_out};
use freerange_core::{Invalid, IoError, beside, persist};
use image::{DynamicImage, GrayImage, ImageDecoder, ImageReader, Luma, Rgba, RgbaImage, metadata::Orientation};
use rayon::prelude::*;
use std::{
    collections::{BTreeSet, HashSet},
    path::{Path, PathBuf},
};

/// What one decoder may allocate, in bytes.
const LARGEST_DECODE: u64 = 2 << 30;
/// All views of a scene together, in pixels (4 bytes each).
const LARGEST_SCENE: u64 = 1 << 30;

/// Where masks come from.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum MaskSource {
    /// Mask files that the cameras' file names or that lie in `masks` beside the images; else the images' alpha; else one plain colour
    /// behind the object; else [`MaskSource::Estimate`].
    #[default]
    Auto,
    /// The images' alpha.
    Alpha,
    /// What is not the plain colour of the image's border.
    Plain,
    /// Files in this folder: white is the object.
    Files(PathBuf),
    /// Poses and colours alone ([`estimate`]).
    Estimate,
    /// A network of the user's own.
    Model(MaskModel),
}

/// A segmentation network: an ONNX file with one input, `[1, 3, height, width]`, whose first output is the object's share of each pixel,
/// `[1, 1, height, width]`: from 0 to 1, or log odds if any number is beyond that. Photos are scaled to its size, whatever their shape; to
/// 320 x 320 where it takes any.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MaskModel {
    /// The file.
    pub file: PathBuf,
    /// What it takes for pixels.
    pub pixels: PixelRange,
}

/// What networks take for the red, green and blue of a pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PixelRange {
    /// 0 to 1, minus ImageNet's mean, divided by its standard deviation: U2-Net, BiRefNet and most others.
    #[default]
    Imagenet,
    /// 0 to 1.
    Unit,
    /// -0.5 to 0.5: IS-Net.
    Centered,
    /// -1 to 1.
    Signed,
}

impl PixelRange {
    /// All, by their names in options.
    pub const ALL: [(&'static str, Self); 4] =
        [("imagenet", Self::Imagenet), ("unit", Self::Unit), ("centered", Self::Centered), ("signed", Self::Signed)];

    /// What is subtracted from values of 0 to 1, and what they are divided by then; red, green, blue.
    pub fn mean_and_deviation(self) -> ([f32; 3], [f32; 3]) {
        match self {
            Self::Imagenet => ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]),
            Self::Unit => ([0.0; 3], [1.0; 3]),
            Self::Centered => ([0.5; 3], [1.0; 3]),
            Self::Signed => ([0.5; 3], [0.5; 3]),
        }
    }
}

/// How the object was told from the rest.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskKind {
    /// Alpha, or in some images a plain background.
    Alpha,
    /// Plain backgrounds.
    Plain,
    /// Mask files.
    Files,
    /// Poses and colours.
    Estimate,
    /// A network.
    Model,
}

/// How photos become views.
#[derive(Clone, Debug)]
pub struct LoadConfig {
    /// Where masks come from.
    pub masks: MaskSource,
    /// In mask files, black is the object.
    pub invert_masks: bool,
    /// Larger photos are made smaller: the longer side in pixels, at most.
    pub max_side: u32,
    /// What is known of the object's place, for [`MaskSource::Estimate`].
    pub hints: Hints,
}

impl Default for LoadConfig {
    fn default() -> Self {
        Self { masks: MaskSource::Auto, invert_masks: false, max_side: 1024, hints: Hints::default() }
    }
}

/// Photos as views: undistorted, with pinhole cameras, alpha the object's mask.
#[derive(Clone, Debug)]
pub struct Loaded {
    /// The views to reconstruct from.
    pub views: Vec<View>,
    /// Which of [`Cameras::photos`] each view is.
    pub photos: Vec<usize>,
    /// The whole photo of each view, undistorted.
    pub whole: Vec<RgbaImage>,
    /// Further views, only compared with.
    pub further: Vec<View>,
    /// How the object was told from the rest.
    pub masks: MaskKind,
    /// What came with masks that were estimated.
    pub estimate: Option<Estimate>,
    /// What was understood or changed, for the user to read.
    pub notes: Vec<String>,
}

/// A photo without its lens, not cut out yet.
struct Picture {
    image: RgbaImage,
    camera: Camera,
    mask: Option<GrayImage>,
    /// Whether the image itself told the object: transparency that no lens made.
    alpha: bool,
    /// Its size as stored, or turned where its camera wants that.
    size: (u32, u32),
    turned: bool,
}

/// Loads the images of `cameras`, and cuts the object out.
///
/// An image keeps the orientation in which it is stored, as the programs that write cameras read it; only where its camera has the turned
/// size, or knows no size at all, it is turned as its EXIF data says.
pub fn load(cameras: &Cameras, config: &LoadConfig) -> Result<Loaded, SceneError> {
    let file = cameras.files.first().cloned().unwrap_or_default();
    let (inputs, further): (Vec<usize>, Vec<usize>) =
        (0..cameras.photos.len()).partition(|i| !cameras.photos[*i].further);
    if inputs.len() < 2 {
        return Err(SceneError::TooFew { file, expected: 2, found: inputs.len() });
    }
    let masks = mask_files(&cameras.photos, &inputs, config)?;
    let pictures: Vec<Picture> = first_error(
        inputs.par_iter().zip(&masks).map(|(i, mask)| picture(&cameras.photos[*i], mask.as_deref(), config)).collect(),
    )?;
    let mut notes = Vec::new();
    tell(&pictures, cameras, &inputs, &mut notes);
    let pixels: u64 = pictures.iter().map(|p| u64::from(p.image.width()) * u64::from(p.image.height())).sum();
    if pixels > LARGEST_SCENE {
        let expected =
            format!("photos of at most {LARGEST_SCENE} pixels together; fewer of them, or a smaller --max-side");
        return Err(Invalid::new("--max-side", expected, pixels).into());
    }
    let mut names = vec![String::new(); cameras.photos.len()];
    for group in [&inputs, &further] {
        for (i, name) in group.iter().zip(short_names(&cameras.photos, group)) {
            names[*i] = name;
        }
    }
    let mut views: Vec<View> = inputs
        .iter()
        .zip(&pictures)
        .map(|(i, p)| View { name: names[*i].clone(), camera: p.camera, image: p.image.clone() })
        .collect();
    let whole: Vec<RgbaImage> = pictures.iter().map(|p| p.image.clone()).collect();
    let first = views[0].camera.center();
    if views.iter().all(|v| v.camera.center().distance(first) <= 1e-6 * (1e-6 + first.length())) {
        let found = format!("all {} cameras stand at one point; expected views from different places", views.len());
        return Err(In(&file).malformed("", found));
    }
    let told: Vec<Told<'_>> = pictures.iter().map(|p| Told { mask: p.mask.as_ref(), alpha: p.alpha }).collect();
    let (kind, estimate) = cut_all(&mut views, &told, config, &mut notes)?;
    let further = further.par_iter().map(|i| {
        let photo = &cameras.photos[*i];
        let mask = photo.mask.as_deref();
        let p = picture(photo, mask, config)?;
        let mut view = View { name: names[*i].clone(), camera: p.camera, image: p.image };
        if let Some(mask) = &p.mask {
            set_alpha(&mut view.image, mask.as_raw());
        } else if opaque(&view.image) {
            view.image = plain(&view)?;
        }
        Ok(view)
    });
    let further = first_error(further.collect())?;
    Ok(Loaded { views, photos: inputs, whole, further, masks: kind, estimate, notes })
}

/// What is wrong with the first photo that has anything: Rayon would tell of the one that was looked at first.
fn first_error<T>(results: Vec<Result<T, SceneError>>) -> Result<Vec<T>, SceneError> {
    results.into_iter().collect()
}

/// The files that [`load`] reads: of cameras, photos and masks; each once, sorted. None of them is opened.
pub fn files(cameras: &Cameras, config: &LoadConfig) -> Result<Vec<PathBuf>, SceneError> {
    let inputs: Vec<usize> = (0..cameras.photos.len()).filter(|i| !cameras.photos[*i].further).collect();
    let masks = mask_files(&cameras.photos, &inputs, config)?.into_iter().flatten();
    let further = cameras.photos.iter().filter(|p| p.further).filter_map(|p| p.mask.clone());
    let photos = cameras.photos.iter().map(|p| p.image.clone());
    let network = match &config.masks {
        MaskSource::Model(model) => Some(model.file.clone()),
        _ => None,
    };
    let files = cameras.files.iter().cloned().chain(photos).chain(masks).chain(further).chain(network);
    let all: BTreeSet<PathBuf> = files.collect();
    Ok(all.into_iter().collect())
}

fn opaque(image: &RgbaImage) -> bool {
    image.pixels().all(|p| p[3] == 255)
}

fn plain(view: &View) -> Result<RgbaImage, SceneError> {
    cut_out(&view.image).map(|(image, _)| image).map_err(|found| SceneError::Mask {
        name: view.name.clone(),
        expected: "an alpha channel, or one plain colour behind the object".into(),
        found,
    })
}

/// Cuts the object out of views that are in memory, as [`load`] does by default: those with transparency keep it, a plain background is
/// cut away; where neither is there, poses and colours tell. Returns what was done, for the user to read.
pub fn cut(views: &mut [View], hints: &Hints) -> Result<Vec<String>, SceneError> {
    let alpha: Vec<bool> = views.iter().map(|v| !opaque(&v.image)).collect();
    let told: Vec<Told<'_>> = alpha.into_iter().map(|alpha| Told { mask: None, alpha }).collect();
    let mut notes = Vec::new();
    cut_all(views, &told, &LoadConfig { hints: *hints, ..LoadConfig::default() }, &mut notes)?;
    Ok(notes)
}

/// What a picture itself says of the object.
struct Told<'a> {
    mask: Option<&'a GrayImage>,
    /// As [`Picture::alpha`].
    alpha: bool,
}

/// Gives the views their masks.
fn cut_all(
    views: &mut [View],
    told: &[Told<'_>],
    config: &LoadConfig,
    notes: &mut Vec<String>,
) -> Result<(MaskKind, Option<Estimate>), SceneError> {
    let found = mask_all(views, told, config, notes)?;
    match views.iter().find(|view| view.image.pixels().all(|p| p[3] < 128)) {
        None => Ok(found),
        Some(view) => {
            let expected = "a mask that shows the object".into();
            Err(SceneError::Mask { name: view.name.clone(), expected, found: "one that is empty".into() })
        }
    }
}

/// [`cut_all`], whatever the masks show.
fn mask_all(
    views: &mut [View],
    told: &[Told<'_>],
    config: &LoadConfig,
    notes: &mut Vec<String>,
) -> Result<(MaskKind, Option<Estimate>), SceneError> {
    if told.iter().all(|p| p.mask.is_some()) {
        for (view, picture) in views.iter_mut().zip(told) {
            if let Some(mask) = picture.mask {
                set_alpha(&mut view.image, mask.as_raw());
            }
        }
        notes.push("masks are read from files".into());
        return Ok((MaskKind::Files, None));
    }
    if let MaskSource::Model(model) = &config.masks {
        let found = network(model, views)?;
        for (view, alpha) in views.iter_mut().zip(found) {
            set_alpha(&mut view.image, &alpha);
        }
        notes.push(format!("the object was cut out by {}", model.file.display()));
        if let Some(confirmed) = estimate::confirmed(views, &config.hints) {
            let mut names = Vec::new();
            for (view, keep) in views.iter_mut().zip(confirmed) {
                if let Some(keep) = keep {
                    set_alpha(&mut view.image, &keep);
                    names.push(view.name.clone());
                }
            }
            if !names.is_empty() {
                notes.push(format!("what only {} marked beside the object was taken away", names.join(", ")));
            }
        }
        return Ok((MaskKind::Model, None));
    }
    let auto = config.masks == MaskSource::Auto;
    if config.masks != MaskSource::Estimate {
        // Alpha where there is one, else a plain background.
        let with_alpha = told.iter().filter(|p| p.alpha).count();
        let tried: Result<Vec<Option<RgbaImage>>, SceneError> = views
            .par_iter()
            .zip(told)
            .map(|(view, picture)| match (picture.alpha, &config.masks) {
                (true, MaskSource::Auto | MaskSource::Alpha) => Ok(None),
                (false, MaskSource::Alpha) => Err(SceneError::Mask {
                    name: view.name.clone(),
                    expected: "an alpha channel".into(),
                    found: "an opaque image".into(),
                }),
                _ => plain(view).map(Some),
            })
            .collect();
        match tried {
            Ok(images) => {
                let cut = images.iter().flatten().count();
                for (view, image) in views.iter_mut().zip(images) {
                    if let Some(image) = image {
                        view.image = image;
                    }
                }
                if cut > 0 {
                    notes.push(format!("the plain background of {cut} photos was cut away"));
                }
                return Ok((if cut == views.len() { MaskKind::Plain } else { MaskKind::Alpha }, None));
            }
            Err(error) if !auto || with_alpha > 0 => return Err(error),
            Err(_) => {}
        }
    }
    let estimate = estimate::masks(views, &config.hints)?;
    for (view, alpha) in views.iter_mut().zip(&estimate.alpha) {
        set_alpha(&mut view.image, alpha);
    }
    notes.push(format!(
        "the object was cut out from poses and colours, {:.0} % sure (views agree to {:.0} % at least)",
        100.0 * estimate.sureness(),
        100.0 * estimate.agreement.iter().copied().fold(1.0, f64::min)
    ));
    notes.extend(estimate.notes.clone());
    Ok((MaskKind::Estimate, Some(estimate)))
}

#[cfg(feature = "mask-model")]
fn network(model: &MaskModel, views: &[View]) -> Result<Vec<Vec<u8>>, SceneError> {
    crate::network::masks(model, views)
}

#[cfg(not(feature = "mask-model"))]
fn network(model: &MaskModel, _: &[View]) -> Result<Vec<Vec<u8>>, SceneError> {
    let expected = format!("a program built with --features mask-model, to run {}", model.file.display());
    Err(Invalid::new("--mask-model", expected, "one without").into())
}

fn set_alpha(image: &mut RgbaImage, alpha: &[u8]) {
    for (pixel, alpha) in image.pixels_mut().zip(alpha) {
        // What the lens did not show stays empty.
        pixel[3] = (u16::from(pixel[3]) * u16::from(*alpha) / 255) as u8;
        if pixel[3] == 0 {
            *pixel = Rgba([0; 4]);
        }
    }
}

/// The image of a photo: turned, freed from its lens, at most `max_side` large.
fn picture(photo: &Photo, mask: Option<&Path>, config: &LoadConfig) -> Result<Picture, SceneError> {
    let (image, orientation) = decode(&photo.image)?;
    let mut image = image.into_rgba8();
    let mut turned = false;
    let mut camera = photo.camera(image.dimensions());
    if orientation != Orientation::NoTransforms {
        let mut upright = DynamicImage::ImageRgba8(image.clone());
        upright.apply_orientation(orientation);
        // Relative cameras take any size: what a viewer shows is meant. Others were made for the stored pixels, if those fit.
        let any_size = matches!(photo.intrinsics, crate::read::Intrinsics::Relative { .. });
        if any_size || camera.is_err() {
            image = upright.into_rgba8();
            camera = photo.camera(image.dimensions());
            turned = true;
        }
    }
    let mut camera = camera?;
    let size = image.dimensions();
    let keeps_alpha = matches!(config.masks, MaskSource::Auto | MaskSource::Alpha) && mask.is_none();
    let alpha = keeps_alpha && !opaque(&image);
    if !alpha {
        image.pixels_mut().for_each(|p| p[3] = 255);
    }
    let mut mask = mask.map(|path| read_mask(path, size, config.invert_masks)).transpose()?;
    if photo.lens != Lens::Ideal {
        if !photo.lens.is_one_to_one(&camera) {
            let expected = "a lens that shows the image one to one";
            return Err(In(&photo.image).field(
                "",
                "distortion",
                expected,
                format!("{:?}, which folds it", photo.lens),
            ));
        }
        image = photo.lens.undistort(&image, &camera);
        mask = mask.map(|mask| gray(&photo.lens.undistort(&coloured(&mask), &camera)));
    }
    let longer = size.0.max(size.1);
    if longer > config.max_side {
        let side = |s: u32| ((f64::from(s) * f64::from(config.max_side) / f64::from(longer)).round() as u32).max(1);
        let (w, h) = (side(size.0), side(size.1));
        image = resize_area(&image, w, h);
        mask = mask.map(|mask| gray(&resize_area(&coloured(&mask), w, h)));
        camera = camera.resized(w, h);
    }
    Ok(Picture { image, camera, mask, alpha, size, turned })
}

/// An image as it is stored, and how its EXIF data says to turn it.
fn decode(path: &Path) -> Result<(DynamicImage, Orientation), SceneError> {
    let failed = |e| SceneError::Image { file: path.into(), source: Box::new(e) };
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(LARGEST_SIDE);
    limits.max_image_height = Some(LARGEST_SIDE);
    limits.max_alloc = Some(LARGEST_DECODE);
    let mut reader =
        ImageReader::open(path).and_then(ImageReader::with_guessed_format).map_err(|e| In(path).read(e))?;
    reader.limits(limits);
    let mut decoder = reader.into_decoder().map_err(failed)?;
    let orientation = decoder.orientation().map_err(failed)?;
    Ok((DynamicImage::from_decoder(decoder).map_err(failed)?, orientation))
}

/// A mask file for an image of `size`: brightness (times alpha, where it has any) is the object's share.
fn read_mask(path: &Path, size: (u32, u32), invert: bool) -> Result<GrayImage, SceneError> {
    let (image, _) = decode(path)?;
    let found = (image.width(), image.height());
    let (a, b) = (u64::from(found.0) * u64::from(size.1), u64::from(found.1) * u64::from(size.0));
    if a.abs_diff(b) > u64::from(size.0.max(size.1)) {
        return Err(SceneError::Size { file: path.into(), of: "its photo's", expected: size, found });
    }
    let image = resize_area(&image.into_rgba8(), size.0, size.1);
    Ok(GrayImage::from_fn(size.0, size.1, |x, y| {
        let p = image.get_pixel(x, y).0;
        let bright = (u32::from(p[0]) + u32::from(p[1]) + u32::from(p[2])) / 3;
        let share = (bright * u32::from(p[3]) / 255) as u8;
        Luma([if invert { 255 - share } else { share }])
    }))
}

fn coloured(mask: &GrayImage) -> RgbaImage {
    RgbaImage::from_fn(mask.width(), mask.height(), |x, y| {
        let v = mask.get_pixel(x, y)[0];
        Rgba([v, v, v, 255])
    })
}

fn gray(image: &RgbaImage) -> GrayImage {
    GrayImage::from_fn(image.width(), image.height(), |x, y| Luma([image.get_pixel(x, y)[0]]))
}

/// The mask file of each input; none where masks come from elsewhere. A folder that has some and lacks others is an error.
fn mask_files(photos: &[Photo], inputs: &[usize], config: &LoadConfig) -> Result<Vec<Option<PathBuf>>, SceneError> {
    let folder = match &config.masks {
        MaskSource::Files(folder) => {
            std::fs::read_dir(folder).map_err(|e| In(folder).read(e))?;
            Some(folder.clone())
        }
        MaskSource::Auto => None,
        _ => return Ok(vec![None; inputs.len()]),
    };
    let found: Vec<Option<PathBuf>> = inputs
        .iter()
        .map(|i| match (&folder, &photos[*i].mask) {
            (Some(folder), _) => mask_in(folder, &photos[*i]),
            (None, Some(named)) => Some(named.clone()),
            // A folder `masks` beside the images' own folder, or beside one that this is in.
            (None, None) => {
                let above = photos[*i].image.ancestors().skip(2).take(3);
                above.map(|a| a.join("masks")).filter(|f| f.is_dir()).find_map(|f| mask_in(&f, &photos[*i]))
            }
        })
        .collect();
    let there = found.iter().flatten().count();
    if there < found.len() && (there > 0 || folder.is_some()) {
        let at = found.iter().position(Option::is_none).unwrap_or(0);
        let photo = &photos[inputs[at]];
        return Err(SceneError::Mask {
            name: photo.name.clone(),
            expected: format!("a mask for every photo, such as {}.png", photo.name),
            found: format!("{there} masks for {} photos, none for this one", found.len()),
        });
    }
    Ok(found)
}

/// The mask of a photo: `NAME.png` with the image's whole name, as COLMAP has it, or the same name with any extension.
fn mask_in(folder: &Path, photo: &Photo) -> Option<PathBuf> {
    let alone = photo.image.file_name()?.to_string_lossy().into_owned();
    [photo.name.as_str(), &alone]
        .into_iter()
        .flat_map(|name| {
            let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem).to_owned();
            let with = |base: &str| IMAGES.map(|e| format!("{base}.{e}"));
            [format!("{name}.png"), name.to_owned()].into_iter().chain(with(&stem)).chain(with(name))
        })
        .filter_map(|name| inside(folder, &name))
        .find(|path| path.is_file())
}

/// Names without folders and extensions where these differ, else with both.
fn short_names(photos: &[Photo], group: &[usize]) -> Vec<String> {
    let short = |i: &usize| {
        let name = &photos[*i].name;
        let name = name.rsplit(['/', '\\']).next().unwrap_or(name);
        match name.rsplit_once('.') {
            Some((stem, end)) if IMAGES.iter().any(|e| end.eq_ignore_ascii_case(e)) => stem.to_owned(),
            _ => name.to_owned(),
        }
    };
    let names: Vec<String> = group.iter().map(short).collect();
    let different: HashSet<&String> = names.iter().collect();
    if different.len() == names.len() {
        return names;
    }
    group.iter().map(|i| format!("{i:03}-{}", photos[*i].name.replace(['/', '\\'], "_"))).collect()
}

fn tell(pictures: &[Picture], cameras: &Cameras, inputs: &[usize], notes: &mut Vec<String>) {
    let lenses = inputs.iter().filter(|i| cameras.photos[**i].lens != Lens::Ideal).count();
    if lenses > 0 {
        notes.push(format!("lens distortion was removed from {lenses} photos"));
    }
    let turned = pictures.iter().filter(|p| p.turned).count();
    if turned > 0 {
        notes.push(format!("{turned} photos were turned as their EXIF data says"));
    }
    if let Some(p) = pictures.iter().find(|p| p.image.dimensions() != p.size) {
        let (w, h) = p.image.dimensions();
        notes.push(format!("photos are used at {w} x {h} pixels and alike, smaller than they are"));
    }
    let wide = pictures.iter().filter(|p| p.size.0 > p.size.1).count();
    let high = pictures.iter().filter(|p| p.size.0 < p.size.1).count();
    if wide > 0 && high > 0 {
        notes.push(format!("{wide} photos are wide, {high} are high"));
    }
}

/// Writes masks as files, `NAME.png` for each photo with its whole name, as COLMAP has them and [`MaskSource::Files`] reads them: white is
/// the object, in the photo's own pixels with its lens. Returns their paths.
pub fn write_masks(folder: &Path, cameras: &Cameras, loaded: &Loaded) -> Result<Vec<PathBuf>, SceneError> {
    let mut written = Vec::new();
    for (view, i) in loaded.views.iter().zip(&loaded.photos) {
        let photo = &cameras.photos[*i];
        let (w, h) = view.image.dimensions();
        let alpha = GrayImage::from_fn(w, h, |x, y| Luma([view.image.get_pixel(x, y)[3]]));
        let mut mask = coloured(&alpha);
        if photo.lens != Lens::Ideal {
            mask = photo.lens.distort(&mask, &view.camera);
        }
        let (mut full_w, mut full_h) = size_of(&photo.image)?;
        if (full_w > full_h) != (w > h) && full_w != full_h {
            (full_w, full_h) = (full_h, full_w);
        }
        let mask = gray(&resize_area(&mask, full_w, full_h));
        let name = match Path::new(&photo.name).extension() {
            Some(_) => format!("{}.png", photo.name),
            None => format!("{}.png", photo.image.file_name().unwrap_or_default().to_string_lossy()),
        };
        let path = inside(folder, &name).unwrap_or_else(|| folder.join(format!("{}.png", view.name)));
        let done = std::fs::create_dir_all(path.parent().unwrap_or(folder)).and_then(|()| {
            let temporary = beside(&path)?;
            mask.write_to(&mut std::io::BufWriter::new(&temporary), image::ImageFormat::Png)
                .map_err(std::io::Error::other)?;
            persist(temporary, &path)
        });
        done.map_err(|e| SceneError::Write(IoError::at(&path)(e)))?;
        written.push(path);
    }
    Ok(written)
}

fn size_of(path: &Path) -> Result<(u32, u32), SceneError> {
    let failed = |e| SceneError::Image { file: path.into(), source: Box::new(e) };
    let reader = ImageReader::open(path).and_then(ImageReader::with_guessed_format).map_err(|e| In(path).read(e))?;
    reader.into_dimensions().map_err(failed)
}

/// Which way is up where nobody says so, and what the user should know of it: +z where that is the format's rule, else where the table faces,
/// else the cameras' own.
pub fn up_of(cameras: &Cameras, loaded: &Loaded) -> (Up, Option<String>) {
    if !matches!(cameras.format, Format::Colmap | Format::Metashape) {
        return (Up::Z, None);
    }
    let table = match &loaded.estimate {
        Some(estimate) => estimate.up,
        None => estimate::table_faces(&loaded.views, &loaded.whole),
    };
    let whence = if table.is_some() { "what the object stands on" } else { "the cameras" };
    (table.map_or(Up::Cameras, Up::Direction), Some(format!("up is taken from {whence}; --up says otherwise")))
}
