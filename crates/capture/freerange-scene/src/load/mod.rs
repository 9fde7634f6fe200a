//! From cameras and files to views: pictures decoded, turned, freed from distortion, cut out.

mod aim;
mod cut;
mod mask_image;
mod masks;
mod memory;
mod picture;
mod rims;
mod tell;
mod whole;

pub use cut::cut;
pub use mask_image::mask_file;
pub use whole::{KeepWhole, Whole};

use crate::camera::{
    Lens, Up, View,
    image_ops::{resize_area, shrunk_size},
};
use crate::{
    SceneError,
    decode::size_of,
    error::In,
    estimate::{self, Estimate, Hints},
    mask_model::MaskModel,
    read::{Cameras, IMAGES, Photo, inside, listed},
};
use aim::Aim;
use cut::{Told, cut_all, plain, set_alpha};
use freerange_util::{IoError, Note, NoteKind, Stop, beside, persist};
use image::{GrayImage, Luma};
use mask_image::{colored, gray};
use masks::{MaskFiles, Meaning, mask_files, meaning};
use picture::{Picture, picture};
use rayon::prelude::*;
use rims::Rims;
use std::{
    borrow::Cow,
    collections::{BTreeSet, HashSet},
    path::{Path, PathBuf},
};
use tell::{tell, tell_files};

/// What notes call photos that are not reconstructed from.
const COMPARED: &str = "photos to compare with";

/// Where masks come from.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum MaskSource {
    /// Mask files that the cameras' file names or that lie in `masks` beside the images; else the images' alpha; else one plain color
    /// behind the object; else [`MaskSource::Estimate`].
    #[default]
    Auto,
    /// The images' alpha.
    Alpha,
    /// What is not the plain color of the image's border.
    Plain,
    /// Files in this folder: white is the object.
    Files(PathBuf),
    /// Poses and colors alone ([`estimate`]).
    Estimate,
    /// A network of the user's own.
    Model(MaskModel),
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
    /// Poses and colors.
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
    /// Most bytes that photos, masks and what masks are estimated with take at a time. Checked from the files' heads before anything is
    /// decoded, and again before masks are estimated.
    pub memory: u64,
    /// What is kept of whole photos.
    pub whole: KeepWhole,
    /// When reading has to end early.
    pub stop: Stop,
}

impl Default for LoadConfig {
    fn default() -> Self {
        Self {
            masks: MaskSource::Auto,
            invert_masks: false,
            max_side: 1024,
            hints: Hints::default(),
            memory: 16 << 30,
            whole: KeepWhole::Small,
            stop: Stop::default(),
        }
    }
}

/// Photos as views: undistorted, with pinhole cameras, alpha the object's mask.
#[derive(Clone, Debug)]
pub struct Loaded {
    /// The views to reconstruct from.
    pub views: Vec<View>,
    /// Which of [`Cameras::photos`] each view is.
    pub photos: Vec<usize>,
    /// The whole photo of each view, undistorted: as [`LoadConfig::whole`] says.
    pub whole: Whole,
    /// Further views, only compared with.
    pub further: Vec<View>,
    /// How the object was told from the rest.
    pub masks: MaskKind,
    /// What came with masks that were estimated, without them: they are the views' alpha.
    pub estimate: Option<Estimate>,
    /// What was understood, assumed, changed or left out, for the user to read.
    pub notes: Vec<Note>,
}

/// Loads the images of `cameras`, and cuts the object out.
///
/// An image keeps the orientation in which it is stored, as the programs that write cameras read it; only where its camera has the turned
/// size, or is that of no file, it is turned as its EXIF data says.
pub fn load(cameras: &Cameras, config: &LoadConfig) -> Result<Loaded, SceneError> {
    let config = &LoadConfig { hints: cameras.local(config.hints), ..config.clone() };
    let (loaded, aim) = load_aimed(cameras, config, None)?;
    let Some(aim) = aim.and_then(|aim| aim.again(cameras, &loaded)) else { return Ok(loaded) };
    // Once it is known where the object is, wide lenses are seen by pinholes that look there.
    drop(loaded);
    let loaded = match load_aimed(cameras, config, Some(aim)) {
        Err(SceneError::NotCutOut { .. } | SceneError::Mask { .. }) => load_aimed(cameras, config, None),
        result => result,
    };
    Ok(loaded?.0)
}

/// [`load`] with what pinholes of wide lenses look at, where that is known, and what they looked at.
fn load_aimed(cameras: &Cameras, config: &LoadConfig, aim: Option<Aim>) -> Result<(Loaded, Option<Aim>), SceneError> {
    let file = cameras.files.first().cloned().unwrap_or_default();
    let (inputs, further): (Vec<usize>, Vec<usize>) =
        (0..cameras.photos.len()).partition(|i| !cameras.photos[*i].further);
    if inputs.len() < 2 {
        return Err(SceneError::TooFew { file, expected: 2, found: inputs.len() });
    }
    let mut notes = Vec::new();
    let masks = mask_files(cameras, config, &mut notes)?;
    let aim = if aim.is_some() { aim } else { Aim::of(cameras, &masks.of, config)? };
    memory::check_photos(cameras, config)?;
    let mut pictures = pictures_of(cameras, &inputs, &masks, aim.as_ref(), config)?;
    tell(&pictures, cameras, &inputs, aim.as_ref(), &mut notes);
    let named = |which: &[usize]| which.iter().map(|i| cameras.photos[*i].name.as_str()).collect::<Vec<&str>>();
    tell_files(&pictures, cameras, &inputs, "photos", &mut notes);
    let usable = look_at_masks(cameras, &mut pictures, &masks, config, &mut notes)?;
    let mut rims = Rims::default();
    rims.take_away(&mut pictures, &named(&inputs), "photos", config, &mut notes);
    let mut names = vec![String::new(); cameras.photos.len()];
    for group in [&inputs, &further] {
        for (i, name) in group.iter().zip(short_names(&cameras.photos, group)) {
            names[*i] = name;
        }
    }
    let told: Vec<Told> = pictures.iter_mut().map(|p| Told { mask: p.mask.take(), alpha: p.alpha }).collect();
    let mut views: Vec<View> = inputs
        .iter()
        .zip(pictures)
        .map(|(i, p)| View { name: names[*i].clone(), camera: p.camera, image: p.image })
        .collect();
    let whole = Whole::of(&views, config)?;
    let first = views[0].camera.center();
    if views.iter().all(|v| v.camera.center().distance(first) <= 1e-6 * (1e-6 + first.length())) {
        let found = format!("all {} cameras stand at one point; expected views from different places", views.len());
        return Err(In(&file).malformed("", found));
    }
    let (kind, estimate) =
        cut_all(&mut views, &told, config, &mut notes).map_err(|error| with_warnings(error, &notes))?;
    drop(told);
    let mut compared = pictures_of(cameras, &further, &masks, aim.as_ref(), config)?;
    if usable {
        compared.iter_mut().for_each(Picture::only_usable);
    }
    tell_files(&compared, cameras, &further, COMPARED, &mut notes);
    rims.take_away(&mut compared, &named(&further), COMPARED, config, &mut notes);
    let further = further_views(compared, &further, &names, &mut notes);
    Ok((Loaded { views, photos: inputs, whole, further, masks: kind, estimate, notes }, aim))
}

/// Where the object was not found, what was warned of before may be why.
fn with_warnings(error: SceneError, notes: &[Note]) -> SceneError {
    let warnings = notes.iter().filter(|note| note.kind == NoteKind::Warning).map(|note| note.text.clone());
    match error {
        SceneError::NotCutOut { reason } => {
            let all: Vec<String> = std::iter::once(reason).chain(warnings).collect();
            SceneError::NotCutOut { reason: all.join("; ") }
        }
        other => other,
    }
}

/// The photos of `which`: as many at once as [`memory::at_once`] allows.
fn pictures_of(
    cameras: &Cameras,
    which: &[usize],
    masks: &MaskFiles,
    aim: Option<&Aim>,
    config: &LoadConfig,
) -> Result<Vec<Picture>, SceneError> {
    let mut all = Vec::with_capacity(which.len());
    let mut rest = which;
    while !rest.is_empty() {
        let (mut count, mut pixels) = (0, 0);
        while count < rest.len() {
            let (w, h) = size_of(&cameras.photos[rest[count]].image)?;
            pixels += u64::from(w) * u64::from(h);
            if count > 0 && pixels > memory::at_once(config) {
                break;
            }
            count += 1;
        }
        let (now, later) = rest.split_at(count);
        let one = |i: &usize| {
            config.stop.check()?;
            picture(&cameras.photos[*i], masks.of[*i].as_deref(), aim, config)
        };
        all.extend(first_error(now.par_iter().map(one).collect())?);
        rest = later;
    }
    Ok(all)
}

/// What is wrong with the first photo that has anything: Rayon would tell of the one that was looked at first.
fn first_error<T>(results: Vec<Result<T, SceneError>>) -> Result<Vec<T>, SceneError> {
    results.into_iter().collect()
}

/// Refuses mask files that look inverted, and takes those that say what may be looked at for just that; whether they do.
fn look_at_masks(
    cameras: &Cameras,
    pictures: &mut [Picture],
    masks: &MaskFiles,
    config: &LoadConfig,
    notes: &mut Vec<Note>,
) -> Result<bool, SceneError> {
    if pictures.iter().any(|p| p.mask.is_none()) {
        return Ok(false);
    }
    let folders: Vec<String> = masks.folders.iter().map(|f| cameras.short(f)).collect();
    let whence = match folders.is_empty() {
        true => "the cameras' file".to_owned(),
        false => format!("the folder {}", folders.join(", ")),
    };
    let given = matches!(config.masks, MaskSource::Files(_));
    let meaning = meaning(pictures);
    let mean = pictures.iter().map(|p| p.mask_covers.1).sum::<f64>() / pictures.len() as f64;
    if meaning == Meaning::Inverted {
        return Err(SceneError::Mask {
            name: format!("the masks of {whence}"),
            expected: "masks in which the object is white".into(),
            found: "masks that look inverted: white all along the border, and what is black is one thing in space; --invert-masks if black \
                    is the object"
                .into(),
        });
    }
    if meaning == Meaning::Usable && !given {
        notes.push(Note::warning(format!(
            "the masks of {whence} cover {:.0} % of the photos and most of their border: they are taken to say which pixels may be used, not \
             which are the object (--masks FOLDER if they do)",
            100.0 * mean
        )));
        pictures.iter_mut().for_each(Picture::only_usable);
        return Ok(true);
    }
    if meaning == Meaning::Usable {
        notes.push(Note::warning(format!(
            "the masks of {whence} cover {:.0} % of the photos and most of their border: are they outlines of the object?",
            100.0 * mean
        )));
    }
    notes.push(Note::understood(format!("masks are read from files, those of {whence}")));
    Ok(false)
}

/// Views to compare with; those that nothing cuts out are left out.
fn further_views(pictures: Vec<Picture>, which: &[usize], names: &[String], notes: &mut Vec<Note>) -> Vec<View> {
    let cut: Vec<Result<View, String>> = pictures
        .into_par_iter()
        .zip(which)
        .map(|(p, i)| {
            let mut view = View { name: names[*i].clone(), camera: p.camera, image: p.image };
            if let Some(mask) = &p.mask {
                set_alpha(&mut view.image, mask.as_raw());
            } else if !p.alpha {
                let backdrop = plain(&view).map_err(|_| view.name.clone())?;
                view.image = backdrop.separate(&view.image);
            }
            Ok(view)
        })
        .collect();
    let lost: Vec<String> = cut.iter().filter_map(|c| c.as_ref().err().cloned()).collect();
    if !lost.is_empty() {
        notes.push(Note::dropped(format!(
            "{} photos to compare with have no mask and are left out: {}",
            lost.len(),
            listed(&lost)
        )));
    }
    cut.into_iter().flatten().collect()
}

/// The files that [`load`] reads: of cameras, photos and masks; each once, sorted. None of them is opened.
pub fn files(cameras: &Cameras, config: &LoadConfig) -> Result<Vec<PathBuf>, SceneError> {
    let masks = mask_files(cameras, config, &mut Vec::new())?.of.into_iter().flatten();
    let photos = cameras.photos.iter().map(|p| p.image.clone());
    let network = match &config.masks {
        MaskSource::Model(model) => Some(model.file.clone()),
        _ => None,
    };
    let files = cameras.files.iter().cloned().chain(photos).chain(masks).chain(network);
    let all: BTreeSet<PathBuf> = files.collect();
    Ok(all.into_iter().collect())
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

/// Writes masks as files, `NAME.png` for each photo with its whole name, as COLMAP has them and [`MaskSource::Files`] reads them: white is
/// the object, in the photo's own pixels with its lens. Returns their paths.
pub fn write_masks(folder: &Path, cameras: &Cameras, loaded: &Loaded) -> Result<Vec<PathBuf>, SceneError> {
    let names = mask_names(cameras, &loaded.photos);
    let mut written = Vec::new();
    for ((view, i), name) in loaded.views.iter().zip(&loaded.photos).zip(names) {
        let mask = mask_as_taken(&cameras.photos[*i], view)?;
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

/// `NAME.png`: a photo's own name where it has an extension, else its file's; with the file's folder where files have one name.
fn mask_names(cameras: &Cameras, which: &[usize]) -> Vec<String> {
    let file = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let name = |i: &usize| {
        let photo = &cameras.photos[*i];
        match Path::new(&photo.name).extension() {
            Some(_) => photo.name.clone(),
            None => file(&photo.image),
        }
    };
    let mut names: Vec<String> = which.iter().map(name).collect();
    let different: HashSet<&String> = names.iter().collect();
    if different.len() < names.len() {
        names = which
            .iter()
            .map(|i| {
                let image = &cameras.photos[*i].image;
                format!("{}/{}", file(image.parent().unwrap_or(Path::new(""))), file(image))
            })
            .collect();
    }
    names.into_iter().map(|name| format!("{name}.png")).collect()
}

/// A view's mask in its photo's own pixels.
fn mask_as_taken(photo: &Photo, view: &View) -> Result<GrayImage, SceneError> {
    let (w, h) = view.image.dimensions();
    let alpha = GrayImage::from_fn(w, h, |x, y| Luma([view.image.get_pixel(x, y)[3]]));
    let mut mask = colored(&alpha);
    let (mut full_w, mut full_h) = size_of(&photo.image)?;
    // A photo that was turned, as its camera knows no other.
    if photo.camera((full_w, full_h)).is_err() || photo.is_upright() && (full_w > full_h) != (w > h) && full_w != full_h
    {
        (full_w, full_h) = (full_h, full_w);
    }
    if photo.lens != Lens::Ideal {
        // In the view's own detail.
        let (small_w, small_h) = shrunk_size((full_w, full_h), w.max(h).max(if w == h { 1024 } else { 0 }));
        let taken = photo.camera((small_w, small_h)).or_else(|_| photo.camera((full_w, full_h)))?;
        mask = photo.lens.taken_of(&mask, &view.camera, &taken);
    }
    Ok(gray(&resize_area(&mask, full_w, full_h)))
}

/// Which way is up where nobody says so, and what the user should know of it: +z where that is the format's rule, else where the table faces,
/// else the cameras' own.
pub fn up_of(cameras: &Cameras, loaded: &Loaded) -> (Up, Option<Note>) {
    if !cameras.any_up {
        return (Up::Z, None);
    }
    let table = match &loaded.estimate {
        Some(estimate) => estimate.up,
        None => estimate::table_faces(&loaded.views, |k| loaded.whole.get(k).ok().map(Cow::into_owned)),
    };
    let whence = if table.is_some() { "what the object stands on" } else { "the cameras" };
    let note = Note::assumed(format!("up is taken from {whence}; --up says otherwise"));
    (table.map_or(Up::Cameras, Up::Direction), Some(note))
}
