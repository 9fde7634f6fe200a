//! From a client's files to what is computed with: read once, kept as pictures and one JSON file, and edited there.

use std::{
    fs,
    path::{Path, PathBuf},
    str::FromStr,
};

use freerange_scene::camera::{CameraError, FrameConfig, Similarity, Up, View, canonical_from_user};
use freerange_scene::{
    KeepWhole, LoadConfig, MaskSource, SceneConfig, SceneError,
    estimate::Hints,
    inspect::{inspect, sheet},
    read::{Format, ReadConfig, Turntable, cameras_with},
};
use freerange_util::{Stop, Stopped, write_atomically};
use image::{GrayImage, ImageFormat, ImageReader, Luma, Rgba, RgbaImage};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::{
    Engine, Limits, Refusal, Scene,
    disk::{is_full, size_of},
    error::chain,
    plain,
    upload::all_inside,
};

/// How photos are read, as a client says it; everything may be left out.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SceneOptions {
    /// `auto`, `alpha`, `plain` or `estimate`.
    pub masks: Option<String>,
    /// In mask files black is the object.
    pub invert_masks: bool,
    /// `auto`, `z`, `y` or `cameras`.
    pub up: Option<String>,
    /// Name of the cameras' format, where a folder has several.
    pub cameras: Option<String>,
    /// `ELEVATION,FOV` of photos of one even turn, which have no cameras.
    pub turntable: Option<String>,
    /// The photos have no cameras: the engine finds them.
    pub find_cameras: bool,
    /// Photos whose cameras are to be found are not at even steps of one turn.
    pub uneven: bool,
}

impl SceneOptions {
    fn masks(&self) -> Result<MaskSource, Refusal> {
        Ok(match self.masks.as_deref() {
            None | Some("auto") => MaskSource::Auto,
            Some("alpha") => MaskSource::Alpha,
            Some("plain") => MaskSource::Plain,
            Some("estimate") => MaskSource::Estimate,
            Some(_) => return Err(Refusal::new(422, "masks: expected auto, alpha, plain or estimate")),
        })
    }

    pub fn up(&self) -> Result<Option<Up>, Refusal> {
        Ok(match self.up.as_deref() {
            None | Some("auto") => None,
            Some("z") => Some(Up::Z),
            Some("y") => Some(Up::Y),
            Some("cameras") => Some(Up::Cameras),
            Some(_) => return Err(Refusal::new(422, "up: expected auto, z, y or cameras")),
        })
    }

    fn cameras(&self) -> Result<Option<Format>, Refusal> {
        let Some(name) = self.cameras.as_deref().filter(|name| !["", "auto"].contains(name)) else { return Ok(None) };
        let found = Format::ALL.into_iter().find(|f| f.name() == name);
        let names = || Format::ALL.map(Format::name).join(", ");
        found.map(Some).ok_or_else(|| Refusal::new(422, format!("cameras: expected auto, {}", names())))
    }

    fn turntable(&self) -> Result<Option<Turntable>, Refusal> {
        let given = self.turntable.as_deref().filter(|t| !t.is_empty());
        given.map(|t| Turntable::from_str(t).map_err(|e| Refusal::new(422, format!("turntable: {e}")))).transpose()
    }

    /// Refuses what cannot be used.
    pub fn check(&self) -> Result<(), Refusal> {
        let turntable = self.masks().and(self.up()).and(self.cameras()).and(self.turntable())?;
        match turntable.is_some() && self.find_cameras {
            true => Err(Refusal::new(422, "find_cameras: expected photos without a turntable, found one")),
            false => Ok(()),
        }
    }
}

/// What is on disk beside the pictures.
#[derive(Serialize, Deserialize)]
struct Kept {
    views: Vec<KeptView>,
    frame: FrameConfig,
}

#[derive(Serialize, Deserialize)]
struct KeptView {
    name: String,
    camera: freerange_scene::camera::Camera,
}

/// The cut-out photo number `k`: RGBA.
pub fn view_file(folder: &Path, k: usize) -> PathBuf {
    folder.join(format!("view-{k:04}.png"))
}

/// The whole photo number `k`.
pub fn whole_file(folder: &Path, k: usize) -> PathBuf {
    folder.join(format!("photo-{k:04}.png"))
}

/// The sheet of what was understood.
pub fn sheet_file(folder: &Path) -> PathBuf {
    folder.join("sheet.png")
}

fn scene_file(folder: &Path) -> PathBuf {
    folder.join("scene.json")
}

/// Whether `folder` holds all that [`open`] needs; it is written last.
pub fn is_whole(folder: &Path) -> bool {
    scene_file(folder).is_file()
}

fn save(picture: &RgbaImage, path: &Path) -> Result<(), Refusal> {
    let mut bytes = Vec::new();
    // Fast rather than small: these files are read on the same machine.
    let fast = image::codecs::png::PngEncoder::new_with_quality(
        &mut bytes,
        image::codecs::png::CompressionType::Fast,
        image::codecs::png::FilterType::Adaptive,
    );
    picture.write_with_encoder(fast).map_err(Refusal::own)?;
    // At once: a buffer that is dropped does not report a full disk.
    fs::write(path, bytes).map_err(Refusal::file(path))
}

/// Photos of a client, and what is made of them.
pub struct Preparation<'a> {
    /// Where the client's files are, or the scene that was made of them.
    pub upload: &'a Path,
    /// Where what is needed of them goes.
    pub folder: &'a Path,
    pub options: &'a SceneOptions,
    pub limits: &'a Limits,
    pub engine: &'a dyn Engine,
    /// When to end early.
    pub stop: &'a Stop,
    /// Bytes that `folder` may have.
    pub room: u64,
}

impl Preparation<'_> {
    /// A reader's error in the page's words.
    fn refused(&self, error: &SceneError) -> Refusal {
        match error {
            SceneError::Stopped(Stopped::Cancelled) => Refusal::new(409, "cancelled"),
            SceneError::Stopped(Stopped::Late) => {
                let most = self.limits.read_time.as_secs_f64();
                Refusal::new(
                    422,
                    format!(
                        "reading these photos took longer than {most} seconds, which is all it may: give fewer, or masks with them"
                    ),
                )
            }
            error => {
                let text = chain(error);
                if is_full(&text) { Refusal::own(text) } else { Refusal::new(422, plain::sentence(&text, self.upload)) }
            }
        }
    }

    fn check_stop(&self) -> Result<(), Refusal> {
        self.stop.check().map_err(|e| self.refused(&e.into()))
    }

    /// Refuses what takes more room than there is.
    fn check_room(&self) -> Result<(), Refusal> {
        let [found, most] = [size_of(self.folder), self.room].map(|bytes| bytes.div_ceil(1 << 20));
        match found <= most {
            true => Ok(()),
            false => Err(Refusal::new(
                507,
                format!(
                    "photos and masks: expected at most {most} MB on disk, which is the limit, found {found} MB; remove some jobs"
                ),
            )),
        }
    }

    fn read(&self) -> Result<freerange_scene::Scene, Refusal> {
        let refused = |e: SceneError| self.refused(&e);
        let root = root(self.upload).map_err(Refusal::own)?;
        let options = self.options;
        let cameras =
            ReadConfig { turntable: options.turntable()?, format: options.cameras()?, ..ReadConfig::default() };
        let found = cameras_with(&root, &cameras).map_err(refused)?;
        all_inside(
            self.upload,
            found.photos.iter().flat_map(|p| [Some(&p.image), p.mask.as_ref()]).flatten().chain(&found.files),
        )?;
        let photos = LoadConfig {
            masks: options.masks()?,
            invert_masks: options.invert_masks,
            max_side: self.limits.side,
            hints: Hints { others: self.engine.leave_one_out(), ..Hints::default() },
            memory: self.limits.memory,
            whole: KeepWhole::Folder(self.folder.to_path_buf()),
            stop: self.stop.clone(),
        };
        let config = SceneConfig { cameras, photos, up: options.up()? };
        let mut scene = freerange_scene::Scene::load(found, &config).map_err(refused)?;
        // What is only compared with has no use here.
        scene.loaded.further.clear();
        Ok(scene)
    }
}

/// Reads the photos of a client, and writes what is needed of them. Returns what was understood: the report of `inspect`, with the camera of
/// each view.
pub fn prepare(job: &Preparation<'_>) -> Result<Value, Refusal> {
    let folder = job.folder;
    let freerange_scene::Scene { cameras, loaded, frame, notes } = job.read()?;
    job.check_room()?;
    let canonical =
        canonical_from_user(&loaded.views, &frame).map_err(|e: CameraError| job.refused(&SceneError::from(e)))?;
    let shown = job.engine.choose(&loaded.views).map_err(|e| Refusal::new(422, plain::sentence(&e, job.upload)))?;
    job.check_stop()?;
    let mut report = inspect(&cameras, &loaded, &notes, &canonical, &shown);
    report.files.clear();
    job.check_stop()?;
    let mut kept = Kept { views: Vec::new(), frame };
    for (k, view) in loaded.views.iter().enumerate() {
        job.check_stop()?;
        save(&view.image, &view_file(folder, k))?;
        kept.views.push(KeptView { name: view.name.clone(), camera: view.camera });
    }
    save(&sheet(&loaded, &report).map_err(|e| job.refused(&e))?, &sheet_file(folder))?;
    job.check_room()?;
    let text = serde_json::to_vec(&kept).map_err(Refusal::own)?;
    write_atomically(&scene_file(folder), |w| std::io::Write::write_all(w, &text)).map_err(Refusal::own)?;

    let mut understood = serde_json::to_value(&report).map_err(Refusal::own)?;
    let plain = |text: &str| plain::sentence(text, job.upload);
    understood["notes"] = report.notes.iter().map(|note| plain(note)).collect();
    understood["warnings"] = report.warnings.iter().map(|warning| plain(warning)).collect();
    understood["canonical_from_user"] =
        serde_json::to_value::<Similarity>(canonical.canonical_from_user).map_err(Refusal::own)?;
    for (view, told) in loaded.views.iter().zip(understood["views"].as_array_mut().into_iter().flatten()) {
        let c = &view.camera;
        told["camera"] = serde_json::json!({
            "width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy,
            "world_to_camera": c.world_to_camera.to_cols_array(),
        });
        told["edited"] = false.into();
    }
    Ok(understood)
}

/// The folder in `upload` that holds the scene or the photos: folders that hold one folder and nothing else are passed through.
pub fn root(upload: &Path) -> std::io::Result<PathBuf> {
    let mut at = upload.to_path_buf();
    loop {
        let inside: Vec<_> = fs::read_dir(&at)?.collect::<Result<_, _>>()?;
        match inside.as_slice() {
            // Names that formats know are part of a scene.
            [one]
                if one.file_type()?.is_dir()
                    && !["images", "sparse", "keyframes"].iter().any(|n| one.file_name() == *n) =>
            {
                at = one.path();
            }
            _ => return Ok(at),
        }
    }
}

fn kept(folder: &Path) -> Result<Kept, Refusal> {
    let bytes = fs::read(scene_file(folder)).map_err(Refusal::file(&scene_file(folder)))?;
    serde_json::from_slice(&bytes).map_err(Refusal::own)
}

fn picture(path: &Path) -> Result<RgbaImage, Refusal> {
    Ok(image::open(path).map_err(Refusal::file(path))?.into_rgba8())
}

/// What [`prepare`] wrote, to the bit.
pub fn open(folder: &Path) -> Result<Scene, Refusal> {
    let kept = kept(folder)?;
    let view =
        |(k, v): (usize, KeptView)| Ok(View { name: v.name, camera: v.camera, image: picture(&view_file(folder, k))? });
    Ok(Scene {
        views: kept.views.into_iter().enumerate().map(view).collect::<Result<_, Refusal>>()?,
        frame: kept.frame,
    })
}

/// Gives photo number `k` the mask that a client painted: a PNG of the photo's size, whose brightness is the object's share. Returns the share
/// of the photo that is object.
pub fn edit_mask(folder: &Path, k: usize, png: &[u8]) -> Result<f64, Refusal> {
    let path = view_file(folder, k);
    let mut view = picture(&path)?;
    let mask = mask(png, view.dimensions())?;
    let whole = picture(&whole_file(folder, k))?;
    let mut covered = 0u64;
    for ((pixel, photo), Luma([alpha])) in view.pixels_mut().zip(whole.pixels()).zip(mask.pixels()) {
        // Where nothing was edited, the colors stay as they were cut out.
        if pixel[3] != *alpha {
            *pixel = match *alpha {
                0 => Rgba([0; 4]),
                _ if pixel[3] > 0 => Rgba([pixel[0], pixel[1], pixel[2], *alpha]),
                _ => Rgba([photo[0], photo[1], photo[2], *alpha]),
            };
        }
        covered += u64::from(pixel[3] >= 128);
    }
    if covered == 0 {
        return Err(Refusal::new(422, "mask: expected some of the object, found none"));
    }
    let beside = folder.join("edited.png");
    save(&view, &beside)?;
    fs::rename(&beside, &path).map_err(Refusal::file(&path))?;
    Ok(covered as f64 / mask.pixels().len() as f64)
}

fn mask(png: &[u8], size: (u32, u32)) -> Result<GrayImage, Refusal> {
    let refuse = |found: String| {
        Refusal::new(422, format!("mask: expected a PNG of {} x {} pixels, found {found}", size.0, size.1))
    };
    let reader = || ImageReader::with_format(std::io::Cursor::new(png), ImageFormat::Png);
    let mut head = reader();
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(16 << 20);
    head.limits(limits);
    let found = head.into_dimensions().map_err(|e| refuse(e.to_string()))?;
    if found != size {
        return Err(refuse(format!("{} x {}", found.0, found.1)));
    }
    let picture = reader().decode().map_err(|e| refuse(e.to_string()))?.into_rgba8();
    Ok(GrayImage::from_fn(size.0, size.1, |x, y| {
        let [r, g, b, a] = picture.get_pixel(x, y).0.map(u32::from);
        Luma([((r + g + b) / 3 * a / 255) as u8])
    }))
}
