//! A scene of any of the formats as pinhole views, written as a COLMAP model with its photos: undistorted and cut out.
//!
//!     cargo run --release -p freerange-scene --example undistort -- SCENE FOLDER

use std::path::PathBuf;

use freerange_scene::{LoadConfig, load, read, write_colmap};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args_os().skip(1).map(PathBuf::from);
    let (Some(scene), Some(folder)) = (arguments.next(), arguments.next()) else {
        return Err("expected a scene and a folder to write to".into());
    };
    let cameras = read::cameras(&scene, None, None)?;
    let loaded = load(&cameras, &LoadConfig::default())?;
    loaded.notes.iter().for_each(|note| println!("{note}"));
    write_colmap(&folder, &loaded.views, cameras.origin, &[])?;
    println!("{}: {} views", folder.display(), loaded.views.len());
    Ok(())
}
