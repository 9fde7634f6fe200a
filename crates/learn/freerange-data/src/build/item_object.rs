//! What is made of one item: its mesh, its views, its object; and which part of the data it belongs to.

use std::time::Instant;

use crate::Split;
use freerange_assets::generate::generate;
use freerange_assets::mesh::{Mesh, load_mesh};
use freerange_scene::camera::{SelectionConfig, View, ViewSets, select_views};
use freerange_util::{IoError, sha256};
use glam::DVec3;

use crate::build::items::{Item, draw};
use crate::build::object::{MadeObject, make};
use crate::build::photographed::{Photographed, Seconds, add_elapsed};
use crate::build::{BuildConfig, BuildError};

/// What is known of the file that an object was made of.
#[derive(Default)]
pub(crate) struct FileFacts {
    pub sha256: Option<String>,
    pub notes: Vec<String>,
}

/// Seed of what is drawn for an item.
pub(crate) fn seed_of(item: &Item, config: &BuildConfig) -> u64 {
    item.seed.unwrap_or_else(|| draw(&item.id, config.seed, "object"))
}

/// The part of the data that an item belongs to.
pub(crate) fn split_of(item: &Item, config: &BuildConfig) -> Split {
    item.split.unwrap_or_else(|| {
        let share = draw(&item.id, config.seed, "split") as f64 / 2f64.powi(64);
        let [validation, test] = [config.shard.validation, config.shard.test];
        match share {
            s if s < test => Split::Test,
            s if s < test + validation => Split::Validation,
            _ => Split::Train,
        }
    })
}

/// The mesh of an item in the canonical frame.
pub(crate) fn mesh_of(item: &Item, config: &BuildConfig) -> Result<(Mesh, FileFacts), BuildError> {
    match &item.file {
        None => Ok((generate(seed_of(item, config), &config.object.generator)?, FileFacts::default())),
        Some(path) => {
            let loaded = load_mesh(path, &config.mesh)?;
            let bytes = std::fs::read(path).map_err(IoError::at(path))?; // the loader has checked its size
            Ok((loaded.mesh, FileFacts { sha256: Some(sha256(&bytes)), notes: loaded.notes }))
        }
    }
}

/// The object of an item.
pub(crate) fn make_item(item: &Item, config: &BuildConfig) -> Result<(MadeObject, FileFacts), BuildError> {
    let start = Instant::now();
    let (mesh, facts) = mesh_of(item, config)?;
    let mut read = 0.0;
    add_elapsed(&mut read, start);
    let seed = seed_of(item, config);
    let mut made = make(item.id.clone(), mesh, seed, &config.object, &config.depths, config.shard.held_out)?;
    made.seconds.read = read;
    Ok((made, facts))
}

/// The views of an item in the canonical frame, as an object of it would have them, and which of them evaluation uses.
///
/// # Errors
/// As [`BuildConfig::validate`]; [`BuildError::Mesh`] for a mesh that cannot be loaded.
pub fn render_views(item: &Item, config: &BuildConfig) -> Result<(Vec<View>, Option<ViewSets>), BuildError> {
    config.validate()?;
    let (mesh, _) = mesh_of(item, config)?;
    let seed = seed_of(item, config);
    let views = Photographed::new(mesh, seed, &config.object, 0, &mut Seconds::default())?.views;
    let sets = evaluation(&views, config, seed)?;
    Ok((views, sets))
}

/// The mesh of an item, in the frame of its views.
///
/// # Errors
/// [`BuildError::Mesh`] for a mesh that cannot be made or loaded.
pub fn true_mesh(item: &Item, config: &BuildConfig) -> Result<Mesh, BuildError> {
    Ok(mesh_of(item, config)?.0)
}

/// The views that evaluation uses; `None` where there are too few.
pub(crate) fn evaluation(views: &[View], config: &BuildConfig, seed: u64) -> Result<Option<ViewSets>, BuildError> {
    let selection = SelectionConfig { seed, ..config.shard.selection.clone() };
    if views.len() < 2 * selection.inputs + selection.validation {
        return Ok(None);
    }
    let centers: Vec<DVec3> = views.iter().map(|v| v.camera.center()).collect();
    Ok(Some(select_views(&centers, DVec3::ZERO, &selection)?))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::build::items::Items;

    #[test]
    fn splits_have_their_shares_and_do_not_change_with_the_rest() {
        let mut config = BuildConfig::default();
        (config.shard.validation, config.shard.test) = (0.1, 0.2);
        let items = Items::generated(4000, 0);
        let mut counts = BTreeMap::new();
        for i in 0..4000 {
            *counts.entry(split_of(&items.get(i).unwrap(), &config)).or_insert(0) += 1;
        }
        // Three standard deviations are 57 and 76.
        assert!((343..457).contains(&counts[&Split::Validation]), "{counts:?}");
        assert!((724..876).contains(&counts[&Split::Test]), "{counts:?}");
        let chosen = Item { split: Some(Split::Test), ..items.get(0).unwrap() };
        assert_eq!(split_of(&chosen, &config), Split::Test);
    }
}
