//! Configurations that say only what differs from another one: `parent = "tiny"`.

use std::path::{Path, PathBuf};

use freerange_util::IoError;
use toml::{Table, Value};

use crate::TrainError;

/// Longest chain of parents.
const DEEPEST: usize = 32;

/// The configurations of the repository, which can be named without their path.
pub(crate) const PRESETS: [(&str, &str); 3] = [
    ("tiny", include_str!("../../../../configs/tiny.toml")),
    ("base", include_str!("../../../../configs/base.toml")),
    ("paper", include_str!("../../../../configs/paper.toml")),
];

/// Reads a configuration and those that it descends from, and merges them: tables key by key, everything else (lists
/// among it) as the descendant has it. A parent is the name of a preset, or a path relative to the file that names it; so
/// are the shards and the weights of the encoder.
pub(crate) fn load(path: &Path) -> Result<Table, TrainError> {
    let mut chain: Vec<(PathBuf, Table)> = Vec::new();
    let mut next = Some(path.to_path_buf());
    while let Some(path) = next {
        let state = |problem: String| TrainError::State { path: path.clone(), problem };
        let preset = PRESETS.iter().find(|(name, _)| path.as_os_str() == *name);
        let (identity, text) = match preset {
            Some((_, text)) => (path.clone(), text.to_string()),
            None => {
                let identity = path.canonicalize().map_err(IoError::at(&path))?;
                (identity, std::fs::read_to_string(&path).map_err(IoError::at(&path))?)
            }
        };
        if chain.iter().any(|(seen, _)| *seen == identity) {
            let names: Vec<String> = chain.iter().map(|(seen, _)| seen.display().to_string()).collect();
            return Err(state(format!("expected parents that end, found a circle: {}", names.join(" -> "))));
        }
        if chain.len() == DEEPEST {
            return Err(state(format!("expected at most {DEEPEST} parents in a row")));
        }
        let mut table: Table = text.parse().map_err(|e: toml::de::Error| state(e.to_string()))?;
        next = match table.remove("parent") {
            None => None,
            Some(Value::String(name)) if PRESETS.iter().any(|(preset, _)| *preset == name) => Some(name.into()),
            Some(Value::String(name)) if preset.is_none() => Some(path.parent().unwrap_or(Path::new("")).join(name)),
            Some(other) => {
                let expected = "the name of a preset or a path relative to this file";
                return Err(state(format!("field `parent`: expected {expected}, found {other}")));
            }
        };
        if preset.is_none() {
            locate(&mut table, path.parent().unwrap_or(Path::new("")));
        }
        chain.push((identity, table));
    }
    let oldest_first = chain.into_iter().rev().map(|(_, table)| table);
    Ok(oldest_first.reduce(merged).unwrap_or_default())
}

/// Makes paths, which are relative to the file that names them, ones that can be opened from here.
fn locate(table: &mut Table, folder: &Path) {
    let mut path = |keys: &[&str]| {
        let (last, tables) = keys.split_last()?;
        let table = tables.iter().try_fold(&mut *table, |t, key| t.get_mut(*key)?.as_table_mut())?;
        if let Some(Value::String(place)) = table.get_mut(*last)
            && is_path(place)
            && let Some(found) = folder.join(&*place).to_str()
        {
            *place = found.to_owned();
        }
        Some(())
    };
    path(&["data", "shards"]);
    path(&["model", "encoder", "weights"]);
}

/// Whether a place is in the file system, not a URL or a repository of the Hugging Face hub.
pub(crate) fn is_path(place: &str) -> bool {
    !place.contains("://") && !place.starts_with("hf:")
}

/// `over` laid over `under`.
fn merged(mut under: Table, over: Table) -> Table {
    for (key, value) in over {
        let value = match (under.remove(&key), value) {
            // Encoders of two kinds have no fields in common.
            (Some(Value::Table(a)), Value::Table(b))
                if key == "encoder" && b.get("kind") != a.get("kind") && b.contains_key("kind") =>
            {
                Value::Table(b)
            }
            (Some(Value::Table(a)), Value::Table(b)) => Value::Table(merged(a, b)),
            (_, value) => value,
        };
        under.insert(key, value);
    }
    under
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    type TrainConfig = crate::config::TrainConfig<freerange_data::build::MakingConfig>;

    fn place(files: &[(&str, &str)]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        folder
    }

    #[test]
    fn a_descendant_changes_what_it_says_and_nothing_else() {
        let files = [
            ("a/child.toml", "parent = \"../b/middle.toml\"\nloss.held_views = 1\n"),
            ("b/middle.toml", "parent = \"tiny\"\nseed = 7\n[loss]\nseen = false\n"),
        ];
        let folder = place(&files);
        let found = TrainConfig::load(&folder.path().join("a/child.toml")).unwrap();
        let mut expected = TrainConfig::load(Path::new("tiny")).unwrap();
        expected.seed = 7;
        expected.loss.seen = false;
        expected.loss.held_views = 1;
        assert_eq!(found, expected);
    }

    #[test]
    fn shards_lie_beside_the_file_that_names_them() {
        let files = [
            ("a/child.toml", "parent = \"../b/middle.toml\"\n"),
            ("b/middle.toml", "parent = \"tiny\"\ndata.shards = \"far/shards\"\n"),
            ("b/cloud.toml", "parent = \"tiny\"\ndata.shards = \"s3://bucket/shards\"\n"),
            ("b/whole.toml", "parent = \"tiny\"\ndata.shards = \"/shards\"\n"),
        ];
        let folder = place(&files);
        let shards = |name: &str| TrainConfig::load(&folder.path().join(name)).unwrap().data.shards.unwrap();
        fs::create_dir_all(folder.path().join("b/far/shards")).unwrap();
        assert_eq!(
            fs::canonicalize(shards("a/child.toml")).unwrap(),
            folder.path().join("b/far/shards").canonicalize().unwrap()
        );
        assert_eq!(shards("b/cloud.toml"), "s3://bucket/shards");
        assert_eq!(shards("b/whole.toml"), "/shards");
    }

    #[test]
    fn an_encoder_of_another_kind_takes_nothing_of_its_parents() {
        let text = "parent = \"paper\"\nmodel.image_size = 512\n";
        let files = [
            (
                "patch.toml",
                format!(
                    "{text}model.encoder = {{ kind = \"patch\", channels = 3 }}\n[[stage]]\ndepth = 11\nimage_size = 512\nbatch = 1\nsteps = 1\n"
                ),
            ),
            ("same.toml", "parent = \"tiny\"\nmodel.encoder = { kind = \"patch\", channels = 3 }\n".to_owned()),
        ];
        let files: Vec<(&str, &str)> = files.iter().map(|(a, b)| (*a, b.as_str())).collect();
        let folder = place(&files);
        let encoder = |name: &str| TrainConfig::load(&folder.path().join(name)).unwrap().model.encoder;
        let patch = freerange_model::PatchConfig { channels: 3, ..Default::default() };
        assert_eq!(encoder("patch.toml"), freerange_model::EncoderConfig::Patch(patch));
        assert_eq!((encoder("same.toml").patch_size(), encoder("same.toml").channels()), (32, 3));
    }

    /// The rows of the paper's tables: one source of objects, as many samples, parameters within 5 % of Full's.
    #[test]
    fn rows_of_the_tables_differ_in_what_they_are_about_alone() {
        let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../configs/tables"));
        let load = |name: &str| TrainConfig::load(&folder.join(name)).unwrap();
        let parameters =
            |c: &TrainConfig| -> f64 { freerange_model::tensors(&c.model).iter().map(|t| t.count() as f64).sum() };
        let samples = |c: &TrainConfig| c.stages.iter().map(|s| s.steps * s.batch as u64).sum::<u64>();
        let full = load("full.toml");
        assert_eq!(samples(&full), 40_000);
        let mut rows = 0;
        for entry in fs::read_dir(folder).unwrap() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            let row = load(&name);
            assert_eq!(samples(&row), samples(&full), "{name}");
            assert_eq!((&row.data, &row.optimizer), (&full.data, &full.optimizer), "{name}");
            let ratio = parameters(&row) / parameters(&full);
            assert!((0.95..1.05).contains(&ratio), "{name}: {ratio} times the parameters of Full");
            rows += 1;
        }
        assert!(rows >= 12, "{rows}");
        for (name, few) in [
            ("full_seed2.toml", &[".seed"] as &[&str]),
            ("no_rendering.toml", &[".loss.held", ".loss.seen"]),
            ("no_curriculum.toml", &[".stage"]),
            ("no_patching.toml", &[".model.gaussians_per_token"]),
            ("no_patching_half.toml", &[".model.gaussians_per_token", ".stage"]),
            ("random_patches.toml", &[".loss.random_patches"]),
            ("no_gradient_channels.toml", &[".model.gradient_channels"]),
            ("tree_coupling.toml", &[".loss.coupling", ".sample.coupling"]),
        ] {
            let json = |c: &TrainConfig| serde_json::to_value(c).unwrap();
            assert_eq!(differences(&json(&full), &json(&load(name)), ""), few, "{name}");
        }
    }

    #[test]
    fn baselines_of_other_sizes_can_be_built() {
        let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../configs"));
        let load = |name: &str| TrainConfig::load(&folder.join(name)).unwrap().model;
        let millions = |model: &freerange_model::ModelConfig| {
            freerange_model::tensors(model).iter().map(|t| t.count() as f64).sum::<f64>() / 1e6
        };
        let (base, paper) = (millions(&load("base.toml")), millions(&load("paper.toml")));
        for (name, expected) in [
            ("baselines/no_flow_base.toml", base),
            ("baselines/pixel_aligned_base.toml", base),
            ("baselines/voxel_aligned_base.toml", base),
            ("baselines/no_flow_paper.toml", paper),
            ("gs_lrm.toml", 300.0), // as that paper says
        ] {
            let found = millions(&load(name));
            assert!((found / expected - 1.0).abs() < 0.05, "{name}: {found} M, expected {expected} M");
        }
        assert_eq!(load("lara.toml").gaussians(0, 4), 2 * 64usize.pow(3));
    }

    #[test]
    fn lists_are_replaced_whole() {
        let stage = "stage = [{ depth = 8, image_size = 96, batch = 2, steps = 3 }]";
        let folder = place(&[("c.toml", &format!("parent = \"tiny\"\n{stage}\n"))]);
        let found = TrainConfig::load(&folder.path().join("c.toml")).unwrap();
        assert_eq!(found.stages.len(), 1);
        assert_eq!((found.stages[0].steps, found.total_steps()), (3, 3));
    }

    #[test]
    fn bad_parents_are_refused_with_their_file() {
        let files = [
            ("self.toml", "parent = \"self.toml\""),
            ("x.toml", "parent = \"y.toml\""),
            ("y.toml", "parent = \"./x.toml\""),
            ("orphan.toml", "parent = \"nowhere.toml\""),
            ("number.toml", "parent = 3"),
            ("broken.toml", "parent = \"half.toml\""),
            ("half.toml", "seed = "),
            ("typo.toml", "parent = \"tiny\"\nloss.hold = false"),
            ("scalar.toml", "parent = \"tiny\"\nloss = 3"),
            ("stray.toml", "parent = \"tiny\"\ndata.windw = 3"),
            ("making.toml", "parent = \"tiny\"\ndata.object.veiws = 3"),
            ("value.toml", "parent = \"tiny\"\ndata.object.samples_per_axis = 99"),
        ];
        let folder = place(&files);
        let error = |name: &str| TrainConfig::load(&folder.path().join(name)).unwrap_err().to_string();
        for name in ["self.toml", "x.toml", "y.toml"] {
            assert!(error(name).contains("circle"), "{}", error(name));
        }
        for (name, words) in [
            ("orphan.toml", "nowhere.toml"),
            ("number.toml", "`parent`"),
            ("broken.toml", "half.toml"),
            ("typo.toml", "hold"),
            ("scalar.toml", "loss"),
            ("stray.toml", "windw"),
            ("making.toml", "veiws"),
            ("value.toml", "object.samples_per_axis"),
        ] {
            assert!(error(name).contains(words), "{name}: {}", error(name));
        }
        let long: Vec<(String, String)> =
            (0..40).map(|i| (format!("{i}.toml"), format!("parent = \"{}.toml\"", i + 1))).collect();
        let long: Vec<(&str, &str)> = long.iter().map(|(a, b)| (a.as_str(), b.as_str())).collect();
        let folder = place(&long);
        let error = TrainConfig::load(&folder.path().join("0.toml")).unwrap_err().to_string();
        assert!(error.contains("at most 32"), "{error}");
    }

    /// Fields of `a` and `b` that differ, by path. The steps of a curriculum are one field, and so are all symmetries.
    fn differences(a: &serde_json::Value, b: &serde_json::Value, path: &str) -> Vec<String> {
        let (x, y) = match (a, b) {
            (serde_json::Value::Object(x), serde_json::Value::Object(y)) if path != ".loss.symmetries" => (x, y),
            _ => return if a == b { Vec::new() } else { vec![path.to_owned()] },
        };
        let keys: std::collections::BTreeSet<&String> = x.keys().chain(y.keys()).collect();
        let (null, place) = (serde_json::Value::Null, |key: &String| format!("{path}.{key}"));
        let of = |key: &String| differences(x.get(key).unwrap_or(&null), y.get(key).unwrap_or(&null), &place(key));
        keys.into_iter().flat_map(of).collect()
    }

    /// `tiny.toml` says how the shipped checkpoint is made: it has its architecture, and means the same in use.
    #[test]
    fn tiny_is_what_ships() {
        let root = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../.."));
        let path = root.join("checkpoints/tiny.safetensors");
        let shipped = freerange_model::Checkpoint::header(&fs::read(&path).unwrap(), &path).unwrap();
        let tiny = TrainConfig::load(Path::new("tiny")).unwrap();
        let [stage] = tiny.stages.as_slice() else { panic!("one stage") };
        assert_eq!(freerange_model::ModelConfig { image_size: stage.image_size, ..tiny.model }, shipped.config);
        let settings = freerange_diffusion::settings::Settings::of(&shipped.provenance).unwrap();
        assert_eq!((Some(settings.network_views), stage.depth), (Some(tiny.loss.input_views.1), shipped.depth));
        assert_eq!((settings.sample.steps, settings.refiner), (tiny.sample.steps, tiny.refiner));
        let virtual_ranks = TrainConfig::load(&root.join("examples/launch/two-ranks.toml")).unwrap();
        assert!(virtual_ranks.data.virtual_ranks == 2 && virtual_ranks.data.shards.is_none());
    }

    #[test]
    fn every_ablation_differs_from_its_parent_in_one_field() {
        let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../configs/ablations"));
        let mut count = 0;
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let text: Table = fs::read_to_string(&path).unwrap().parse().unwrap();
            let parent = text["parent"].as_str().unwrap();
            let parent = match PRESETS.iter().any(|(name, _)| *name == parent) {
                true => PathBuf::from(parent),
                false => folder.join(parent),
            };
            let json = |path: &Path| serde_json::to_value(TrainConfig::load(path).unwrap()).unwrap();
            let found = differences(&json(&parent), &json(&path), "");
            assert_eq!(found.len(), 1, "{}: {found:?}", path.display());
            count += 1;
        }
        assert!(count >= 2, "{count}");
    }
}
