//! What is evaluated: scene folders, objects in shards, generated objects.

use std::{
    collections::HashSet,
    path::{Path, PathBuf},
};

use freerange::{Scene, Up, View};
use freerange_assets::mesh::{LoadLimits, load_mesh};
use freerange_data::build::{BuildConfig, Item, Items, render_views, true_mesh};
use freerange_data::{ObjectSource, Shards, Split, Store};
use freerange_eval::{EvalObject, MeshSurface, runner::Objects};
use freerange_scene::{
    SceneConfig,
    read::{ReadConfig, cameras_with},
    views_to_compare,
};
use freerange_util::{Note, NoteKind};
use glam::DVec3;
use serde_json::{Value, json};

use crate::{
    error::CliError,
    runtime::{TrainConfig, build_config},
};

/// Where the objects come from: one of `--scenes`, `--data`, `--generated`.
#[derive(clap::Args)]
pub struct SourceArgs {
    /// Folder of scene folders, or one scene folder, as `freerange data views` writes them.
    #[arg(long, value_name = "DIR", group = "source")]
    scenes: Option<PathBuf>,
    /// Folder or URL of shards.
    #[arg(long, value_name = "LOCATION", group = "source")]
    data: Option<String>,
    /// Number of generated objects, which no training has seen.
    #[arg(long, value_name = "N", group = "source")]
    generated: Option<u64>,
    /// File of a scene with the input views from all around.
    #[arg(long, value_name = "FILE", default_value = "transforms_full.json", conflicts_with_all = ["data", "generated"])]
    full_file: String,
    /// File of a scene with the input views from one side.
    #[arg(long, value_name = "FILE", default_value = "transforms_partial.json", conflicts_with_all = ["data", "generated"])]
    partial_file: String,
    /// File of a scene with the validation views.
    #[arg(long, value_name = "FILE", default_value = "transforms_val.json", conflicts_with_all = ["data", "generated"])]
    validation_file: String,
    /// Folder with the true mesh of each scene, NAME.glb: adds metrics of geometry.
    #[arg(long, value_name = "DIR", requires = "scenes")]
    meshes: Option<PathBuf>,
    /// Split of the shards.
    #[arg(long, value_enum, default_value = "test", conflicts_with_all = ["scenes", "generated"])]
    split: SplitName,
    /// Seed of the first generated object; the default is beyond the seeds of training data.
    #[arg(long, default_value_t = 7_000_000_000_000, conflicts_with_all = ["scenes", "data"])]
    first_seed: u64,
    /// Configuration of generated objects (generator, cameras, views): tiny, base, paper, or a file.
    #[arg(long, default_value = "tiny", conflicts_with_all = ["scenes", "data"])]
    config: PathBuf,
    /// Width and height of the views of generated objects in pixels [default: the configuration's].
    #[arg(long, value_name = "PIXELS", conflicts_with_all = ["scenes", "data"], value_parser = clap::value_parser!(u32).range(16..=2048))]
    generated_size: Option<u32>,
    /// Measure the first N objects only.
    #[arg(long, value_name = "N")]
    limit: Option<usize>,
}

/// A part of the data.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum SplitName {
    Train,
    Validation,
    Test,
}

/// The objects, by number.
pub struct Source {
    kind: Kind,
    names: Vec<String>,
    settings: Value,
}

enum Kind {
    Scenes { folders: Vec<PathBuf>, files: [String; 3], meshes: Option<PathBuf> },
    Shards(Box<Shards>),
    Generated { items: Vec<Item>, config: Box<BuildConfig> },
}

impl SourceArgs {
    /// Whether any is named.
    pub fn given(&self) -> bool {
        self.scenes.is_some() || self.data.is_some() || self.generated.is_some()
    }

    /// Finds the objects; none is loaded yet.
    pub fn open(&self) -> Result<Source, CliError> {
        let limit = self.limit.unwrap_or(usize::MAX);
        let (kind, mut names, mut settings) = match (&self.scenes, &self.data, self.generated) {
            (Some(folder), None, None) => self.scenes(folder)?,
            (None, Some(location), None) => {
                let split = match self.split {
                    SplitName::Train => Split::Train,
                    SplitName::Validation => Split::Validation,
                    SplitName::Test => Split::Test,
                };
                let shards = Shards::open(&Store::open(location)?, &[], Some(split))?;
                let names: Vec<String> = (0..shards.len()).map(|i| shards.id(i as u64).to_owned()).collect();
                let plan = shards.manifest().plan_sha256.clone();
                (Kind::Shards(Box::new(shards)), names, json!({ "kind": "data", "plan_sha256": plan, "split": split }))
            }
            (None, None, Some(count)) => {
                let mut config = build_config(&TrainConfig::load(&self.config)?);
                if let Some(size) = self.generated_size {
                    config.object.cameras.resolution = size;
                }
                let all = Items::generated(count.min(limit as u64), self.first_seed);
                let items: Vec<Item> = (0..all.len()).map_while(|i| all.get(i)).collect();
                let names = items.iter().map(|i| i.id.clone()).collect();
                let object = &config.object;
                let settings = json!({
                    "kind": "generated", "first_seed": self.first_seed, "views": object.views, "cameras": object.cameras,
                    "samples_per_axis": object.samples_per_axis, "generator": object.generator,
                    "lighting": object.lighting, "selection": config.shard.selection,
                });
                (Kind::Generated { items, config: Box::new(config) }, names, settings)
            }
            _ => return Err(CliError::input("expected one of --scenes DIR, --data LOCATION, --generated N")),
        };
        names.truncate(limit);
        if names.is_empty() {
            return Err(CliError::input("nothing to evaluate: no objects"));
        }
        let mut seen = HashSet::new();
        if let Some(twice) = names.iter().find(|n| !seen.insert(*n)) {
            return Err(CliError::input(format!("expected objects with different names, found `{twice}` twice")));
        }
        settings["objects"] = json!(names);
        Ok(Source { kind, names, settings })
    }

    fn scenes(&self, folder: &Path) -> Result<(Kind, Vec<String>, Value), CliError> {
        let files = [&self.full_file, &self.partial_file, &self.validation_file].map(Clone::clone);
        let is_scene = |path: &Path| files.iter().any(|f| path.join(f).is_file());
        let mut folders = Vec::new();
        if is_scene(folder) {
            folders.push(folder.to_path_buf());
        } else {
            for entry in std::fs::read_dir(folder).map_err(|e| CliError::file(folder, e))? {
                let path = entry.map_err(|e| CliError::file(folder, e))?.path();
                if is_scene(&path) {
                    folders.push(path);
                }
            }
        }
        if folders.is_empty() {
            let expected = format!("nothing to evaluate: expected folders with {}, found none", files.join(" or "));
            return Err(CliError::file(folder, expected));
        }
        folders.sort();
        let name = |p: &PathBuf| {
            // `.` and `..` have no name of their own.
            let whole = p.canonicalize().unwrap_or_else(|_| p.clone());
            p.file_name().or(whole.file_name()).map_or_else(|| "scene".into(), |n| n.to_string_lossy().into_owned())
        };
        let names = folders.iter().map(name).collect();
        let mut settings = json!({ "kind": "scenes", "folder": folder, "full": files[0], "partial": files[1], "validation": files[2] });
        if let Some(meshes) = &self.meshes {
            settings["meshes"] = json!(meshes);
        }
        Ok((Kind::Scenes { folders, files, meshes: self.meshes.clone() }, names, settings))
    }
}

impl Objects for Source {
    fn names(&self) -> &[String] {
        &self.names
    }

    fn load(&self, index: usize) -> Result<EvalObject, String> {
        self.object(index).map_err(|e| e.to_string())
    }
}

impl Source {
    /// What the numbers depend on.
    pub fn settings(&self) -> &Value {
        &self.settings
    }

    fn object(&self, index: usize) -> Result<EvalObject, CliError> {
        let name = &self.names[index];
        match &self.kind {
            Kind::Scenes { folders, files, meshes } => {
                let object = load_scene(name, &folders[index], files)?;
                let Some(meshes) = meshes else { return Ok(object) };
                let mesh = load_mesh(&meshes.join(format!("{name}.glb")), &LoadLimits::default())?.mesh;
                Ok(object.with_surface(MeshSurface::new(&mesh)))
            }
            Kind::Shards(shards) => {
                let metadata = shards.metadata(index as u64)?;
                let views = shards.object(index as u64)?.views;
                let sets = metadata.evaluation.ok_or_else(|| no_sets(name, views.len()))?;
                Ok(EvalObject::from_sets(name, views, &sets, metadata.seed)?)
            }
            Kind::Generated { items, config } => {
                let (views, sets) = render_views(&items[index], config)?;
                let sets = sets.ok_or_else(|| no_sets(name, views.len()))?;
                let object = EvalObject::from_sets(name, views, &sets, items[index].seed.unwrap_or(0))?;
                Ok(object.with_surface(MeshSurface::new(&true_mesh(&items[index], config)?)))
            }
        }
    }
}

fn no_sets(name: &str, views: usize) -> CliError {
    CliError::input(format!("{name}: expected view sets for evaluation, found none: {views} views are too few"))
}

/// The views of a scene folder by role: inputs as `reconstruct` reads them, all others as it reads those to compare with.
fn load_scene(name: &str, folder: &Path, [full, partial, validation]: &[String; 3]) -> Result<EvalObject, CliError> {
    let mut origin = None; // of all roles, the first one's
    let mut inputs = |file: &str| -> Result<Vec<View>, CliError> {
        let path = folder.join(file);
        if !path.is_file() {
            return Ok(Vec::new());
        }
        let mut cameras = cameras_with(&path, &ReadConfig::default())?;
        cameras.subtract(*origin.get_or_insert(cameras.origin));
        // Up is for the method to say.
        let scene = Scene::load(cameras, &SceneConfig { up: Some(Up::Z), ..SceneConfig::default() })?;
        whole(&path, &scene.notes)?;
        Ok(scene.loaded.views.into_iter().chain(scene.loaded.further).collect())
    };
    let (around, beside) = (inputs(full)?, inputs(partial)?);
    let compared = |file: &str| -> Result<Vec<View>, CliError> {
        let path = folder.join(file);
        let (views, notes) = views_to_compare(&path, origin.unwrap_or(DVec3::ZERO))?;
        whole(&path, &notes)?;
        Ok(views)
    };
    let all = "transforms.json";
    let is_role = [full, partial, validation].iter().any(|file| *file == all);
    let further = if !is_role && folder.join(all).is_file() { compared(all)? } else { Vec::new() };
    Ok(EvalObject::from_views(name, around, beside, compared(validation)?, further)?)
}

/// Refuses scenes of which something is left out: numbers of fewer views, or of other masks, would be of another scene.
fn whole(file: &Path, notes: &[Note]) -> Result<(), CliError> {
    match notes.iter().find(|note| matches!(note.kind, NoteKind::Dropped | NoteKind::Warning)) {
        Some(note) => {
            Err(CliError::file(file, format!("expected all views, each with its mask; found: {}", note.text)))
        }
        None => Ok(()),
    }
}
