//! Gaussians on disk, in the format that a file's extension names.

use std::path::Path;

use freerange_gaussians::{
    Gaussians, Splats,
    formats::{Frame, Frames, WriteOptions, read, write},
};
use freerange_util::Note;
use glam::DVec3;

use crate::{Error, error::Lift};

/// Reads Gaussians (`.ply`, `.splat`, `.spz`, `.sog`, `.glb`, `.gltf`, `.usda`, `.usdz`) with all that the file has of
/// them, and which way is up in their frame. That is `up`, to which formats that fix theirs are turned; where there is
/// none, what the file says (a comment of a `.ply`), else +z.
///
/// # Errors
/// Names the file, the place in it, what was expected and what was found.
pub fn read_splats(path: &Path, up: Option<DVec3>) -> Result<(Splats, DVec3, Vec<Note>), Error> {
    let to = up.map(frame).transpose()?;
    let loaded = read(path, Frames { from: None, to }).lift()?;
    // Without what rounding leaves of zeros.
    let clean = loaded.frame.up().map(|v| (v * 1e12).round() / 1e12 + 0.0);
    Ok((loaded.splats, up.unwrap_or(clean), loaded.notes))
}

/// The same in the frame in which `up` is up, without what depends on the viewing direction; a note says what is left
/// out.
///
/// # Errors
/// As [`read_splats`].
pub fn read_gaussians(path: &Path, up: DVec3) -> Result<(Gaussians, Vec<Note>), Error> {
    let (splats, _, mut notes) = read_splats(path, Some(up))?;
    let degree = splats.harmonics.degree();
    if degree > 0 {
        let text = format!("color that depends on the viewing direction (degree {degree}) is left out");
        notes.push(Note::dropped(text));
    }
    Ok((splats.into_cloud(), notes))
}

/// Writes Gaussians in whose frame `up` is up; the notes say what the format could not hold. `.ply` keeps the Gaussians' own
/// frame, and says in a comment which way is up.
///
/// # Errors
/// Names the file, or the extension that no format has.
pub fn write_splats(splats: &Splats, path: &Path, up: DVec3) -> Result<Vec<Note>, Error> {
    let options = WriteOptions { frame: frame(up)?, ..WriteOptions::default() };
    let lost = write(splats, path, &options).lift()?;
    Ok(lost.into_iter().map(Note::dropped).collect())
}

/// [`write_splats`] of Gaussians whose color is the same from all sides.
///
/// # Errors
/// As there.
pub fn write_gaussians(gaussians: &Gaussians, path: &Path, up: DVec3) -> Result<Vec<Note>, Error> {
    write_splats(&gaussians.clone().into(), path, up)
}

fn frame(up: DVec3) -> Result<Frame, Error> {
    Frame::with_up(up).ok_or_else(|| Error::input("up", "a direction", format!("{:?}", up.to_array())))
}

#[cfg(test)]
mod tests {
    use freerange_gaussians::channel;

    use super::*;

    #[test]
    fn what_is_written_is_read_again_and_up_is_kept() {
        let folder = std::env::temp_dir().join(format!("freerange-files-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let rows = (0..4 * channel::COUNT).map(|v| (v as f32 * 0.7).sin()).collect();
        let cloud = Gaussians::from_rows(rows);
        for name in ["a.ply", "a.splat", "a.glb"] {
            let path = folder.join(name);
            write_gaussians(&cloud, &path, DVec3::Z).unwrap();
            let (same, _) = read_gaussians(&path, DVec3::Z).unwrap();
            let apart = |i: usize| same.mean(i).distance(cloud.mean(i));
            // Some formats sort.
            let near = |i: usize| (0..4).any(|j| same.mean(i).distance(cloud.mean(j)) < 1e-3);
            assert!(same.len() == 4 && (0..4).all(near), "{name}: {:?}", (0..4).map(apart).collect::<Vec<_>>());
        }
        // Whoever reads a `.ply` without knowing learns which way is up, however the scene lies.
        let up = DVec3::new(0.3, -0.9, 0.2).normalize();
        write_gaussians(&cloud, &folder.join("b.ply"), up).unwrap();
        let loaded = read(&folder.join("b.ply"), Frames::default()).unwrap();
        let same = &loaded.splats.cloud;
        assert!(loaded.frame.up().distance(up) < 1e-8, "{:?}", loaded.frame.up());
        assert!((0..4).all(|i| same.mean(i) == cloud.mean(i)), "not turned");
        // What the file says, unless the caller does; +z where nobody does.
        let read_up = |name: &str, up| read_splats(&folder.join(name), up).unwrap().1;
        assert!(read_up("b.ply", None).distance(up) < 1e-8 && read_up("b.ply", Some(DVec3::Y)) == DVec3::Y);
        assert_eq!([read_up("a.glb", None), read_up("a.splat", None)], [DVec3::Z; 2]);
        let of = |name: &str, up| write_gaussians(&cloud, &folder.join(name), up).unwrap_err();
        assert!(matches!(of("a.ply", DVec3::ZERO), Error::Input { field, .. } if field == "up"));
        assert!(matches!(of("a.txt", DVec3::Z), Error::Gaussians(_)));
        let missing = read_gaussians(&folder.join("none.ply"), DVec3::Z).unwrap_err();
        assert!(matches!(missing, Error::Io { path, .. } if path.ends_with("none.ply")));
        std::fs::remove_dir_all(folder).unwrap();
    }
}
