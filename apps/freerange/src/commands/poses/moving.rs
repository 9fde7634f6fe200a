//! What moves in photos of a camera that stands still: the object and its turntable. Features of the room beside it say nothing of how the
//! object turned, and pull its cameras aside.

use std::path::{Path, PathBuf};

use image::{GrayImage, Luma, imageops::FilterType};

use super::taken::{Taken, plain_name};
use crate::error::CliError;

/// Longest side of the pictures that are compared, and how many of them at most.
const SIDE: u32 = 240;
const MOST: usize = 48;
/// Mean difference between photos that follow one another, of 255, below which a pixel stands still.
const STILL: f64 = 3.0;
/// Share of such pixels from which on the camera stands still.
const LEAST_STILL: f64 = 0.5;
/// Pixels, of these pictures, by which what moves is grown: features have a surrounding.
const GROWN: usize = 4;

/// Masks for the engine, white where something moves, one for each photo; their folder `to`. None where the camera moves.
pub fn moving(photos: &[Taken], to: &Path) -> Result<Option<PathBuf>, CliError> {
    let size = photos[0].size;
    if photos.iter().any(|photo| photo.size != size) {
        return Ok(None);
    }
    let scale = f64::from(SIDE) / f64::from(size.0.max(size.1).max(SIDE));
    let [width, height] = [size.0, size.1].map(|side| ((f64::from(side) * scale).round() as u32).max(1));
    let every = photos.len().div_ceil(MOST);
    let mut sums = vec![0u64; (width * height) as usize];
    let (mut pairs, mut before) = (0u64, None::<GrayImage>);
    for photo in photos.iter().step_by(every) {
        let picture = image::open(&photo.path).map_err(|e| CliError::file(&photo.path, e))?.into_luma8();
        let picture = image::imageops::resize(&picture, width, height, FilterType::Triangle);
        if let Some(before) = before.replace(picture.clone()) {
            let both = before.as_raw().iter().zip(picture.as_raw());
            sums.iter_mut().zip(both).for_each(|(sum, (a, b))| *sum += u64::from(a.abs_diff(*b)));
            pairs += 1;
        }
    }
    let moves: Vec<bool> = sums.iter().map(|sum| *sum as f64 >= STILL * pairs as f64).collect();
    let still = moves.iter().filter(|moves| !**moves).count() as f64 / moves.len() as f64;
    if still < LEAST_STILL || still == 1.0 {
        return Ok(None);
    }
    let (columns, rows) = (width as usize, height as usize);
    let near = |x: usize, most: usize| x.saturating_sub(GROWN)..(x + GROWN + 1).min(most);
    let small = GrayImage::from_fn(width, height, |x, y| {
        let (x, y) = (x as usize, y as usize);
        let any = near(y, rows).any(|y| near(x, columns).any(|x| moves[y * columns + x]));
        Luma([if any { 255 } else { 0 }])
    });
    let mask = image::imageops::resize(&small, size.0, size.1, FilterType::Nearest);
    std::fs::create_dir_all(to).map_err(|e| CliError::file(to, e))?;
    for photo in photos {
        let path = to.join(format!("{}.png", plain_name(&photo.path)));
        mask.save(&path).map_err(|e| CliError::file(&path, e))?;
    }
    Ok(Some(to.into()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commands::poses::taken::taken;

    /// Photos of a bright square at some place on a textured background, which is shifted by so many pixels from photo to photo.
    fn photos(folder: &Path, shift: u32) -> Vec<Taken> {
        let files: Vec<PathBuf> = (0..5u32)
            .map(|i| {
                let path = folder.join(format!("{shift} {i}.png"));
                let picture = GrayImage::from_fn(480, 320, |x, y| {
                    let square = (180 + 20 * i..220 + 20 * i).contains(&x) && (140..180).contains(&y);
                    let background = (((x + shift * i) / 8 + y / 8) * 37 % 97) as u8;
                    Luma([if square { 255 } else { background }])
                });
                picture.save(&path).unwrap();
                path
            })
            .collect();
        taken(&files).unwrap().0
    }

    #[test]
    fn what_stands_still_is_black() {
        let folder = tempfile::tempdir().unwrap();
        let to = folder.path().join("masks");
        assert_eq!(moving(&photos(folder.path(), 0), &to).unwrap(), Some(to.clone()));
        let mask = image::open(to.join("0_3.png.png")).unwrap().into_luma8();
        assert_eq!(mask.dimensions(), (480, 320));
        // All places of the square, and what is close to them.
        for (x, y, white) in [(185, 145, true), (295, 175, true), (175, 160, true), (160, 160, false), (240, 60, false)]
        {
            assert_eq!(mask[(x, y)][0] == 255, white, "{x}, {y}");
        }
        // A camera that moves, and photos that are all the same.
        assert_eq!(moving(&photos(folder.path(), 5), &folder.path().join("none")).unwrap(), None);
        let same = vec![photos(folder.path(), 0)[0].clone(); 4];
        assert_eq!(moving(&same, &folder.path().join("none")).unwrap(), None);
    }
}
