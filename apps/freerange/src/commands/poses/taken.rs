//! When and with which lens photos were taken, as their EXIF data says.

use std::{
    cmp::Ordering,
    collections::BTreeMap,
    fs::File,
    io::BufReader,
    path::{Path, PathBuf},
};

use exif::{DateTime, Exif, In, Reader, Tag, Value};
use freerange_scene::read::in_order;

use crate::error::CliError;

/// A photo's name without spaces, at which COLMAP's lists end names.
pub fn plain_name(photo: &Path) -> String {
    photo.file_name().unwrap_or_default().to_string_lossy().replace(char::is_whitespace, "_")
}

/// What is known of a photo before its cameras are.
#[derive(Clone, Debug, PartialEq)]
pub struct Taken {
    /// The file.
    pub path: PathBuf,
    /// Width and height in stored pixels.
    pub size: (u32, u32),
    /// Year, month, day, hour, minute, second, nanosecond.
    time: Option<[u32; 7]>,
    /// Focal length of the lens in mm.
    lens: Option<f64>,
    /// Focal length in mm that shows as much on a film of 36 x 24 mm.
    film: Option<f64>,
}

impl Taken {
    fn read(path: &Path) -> Result<Self, CliError> {
        let failed = |e: image::ImageError| CliError::file(path, e);
        let size = image::image_dimensions(path).map_err(failed)?;
        let found = File::open(path).map_err(|e| CliError::file(path, e))?;
        // Photos without EXIF data, or with broken data, are photos like others.
        let exif = Reader::new().read_from_container(&mut BufReader::new(found)).ok();
        let number = |tag| exif.as_ref().and_then(|exif| number(exif, tag));
        Ok(Self {
            path: path.into(),
            size,
            time: exif.as_ref().and_then(time),
            lens: number(Tag::FocalLength),
            film: number(Tag::FocalLengthIn35mmFilm),
        })
    }

    /// Focal length over the photo's longer side.
    pub fn focal(&self) -> Option<f64> {
        self.film.map(|film| film / 36.0)
    }

    /// What photos of one camera have in common: the size, and the lens in tenths of a millimeter.
    fn camera(&self) -> (u32, u32, [Option<u64>; 2]) {
        let tenths = |focal: Option<f64>| focal.map(|f| (10.0 * f).round() as u64);
        (self.size.0, self.size.1, [tenths(self.lens), tenths(self.film)])
    }
}

/// A length of the file that lenses have.
fn number(exif: &Exif, tag: Tag) -> Option<f64> {
    let value = match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Rational(values) => values.first()?.to_f64(),
        value => f64::from(value.get_uint(0)?),
    };
    (0.1..1e4).contains(&value).then_some(value)
}

fn time(exif: &Exif) -> Option<[u32; 7]> {
    let text = |tag| match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Ascii(values) => values.first(),
        _ => None,
    };
    let mut at = DateTime::from_ascii(text(Tag::DateTimeOriginal)?).ok()?;
    if let Some(part) = text(Tag::SubSecTimeOriginal) {
        // Whole seconds are enough where the rest makes no sense.
        drop(at.parse_subsec(part));
    }
    let day = [u32::from(at.year), at.month.into(), at.day.into()];
    let part = [at.hour.into(), at.minute.into(), at.second.into(), at.nanosecond.unwrap_or(0)];
    // Cameras whose clock was never set write zeros.
    (day.iter().all(|v| *v > 0)).then_some([day[0], day[1], day[2], part[0], part[1], part[2], part[3]])
}

/// The photos in the order in which they were taken, and whether EXIF data says so: by time where
/// all have one, else by name, numbers in names by value. Those of one second follow their names.
pub fn taken(photos: &[PathBuf]) -> Result<(Vec<Taken>, bool), CliError> {
    let mut all = in_order(photos).iter().map(|path| Taken::read(path)).collect::<Result<Vec<_>, _>>()?;
    let timed = all.iter().all(|photo| photo.time.is_some())
        && all.windows(2).any(|pair| pair[0].time.cmp(&pair[1].time) != Ordering::Equal);
    if timed {
        all.sort_by_key(|photo| photo.time);
    }
    Ok((all, timed))
}

/// Photos that share a camera: those of one size and lens. Photos of which nothing is known but
/// the size are taken for some of the largest group of that size: a lens of their own would be
/// known from fewer photos.
pub fn cameras(photos: &[Taken]) -> Vec<Vec<&Taken>> {
    let mut groups: BTreeMap<_, Vec<&Taken>> = BTreeMap::new();
    photos.iter().for_each(|photo| groups.entry(photo.camera()).or_default().push(photo));
    let unknown: Vec<_> = groups.keys().filter(|key| key.2 == [None; 2]).copied().collect();
    for key in unknown {
        let known = groups.iter().filter(|(k, _)| (k.0, k.1) == (key.0, key.1) && **k != key);
        if let Some(largest) = known.max_by_key(|(_, group)| group.len()).map(|(k, _)| *k) {
            let more = groups.remove(&key).unwrap_or_default();
            groups.entry(largest).or_default().extend(more);
        }
    }
    groups.into_values().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A JPEG file with EXIF data: time, focal length in mm, that on film.
    fn photo(path: &Path, time: &str, focal: u32, film: u16) {
        image::RgbImage::new(8, 6).save(path).unwrap();
        let jpeg = std::fs::read(path).unwrap();
        // A directory of one entry leads to one of three: offsets count from "II".
        let entry = |tag: u16, kind: u16, count: u32, value: u32| {
            [&tag.to_le_bytes()[..], &kind.to_le_bytes(), &count.to_le_bytes(), &value.to_le_bytes()].concat()
        };
        let mut data = b"Exif\0\0II*\0\x08\0\0\0\x01\0".to_vec();
        data.extend(entry(0x8769, 4, 1, 26));
        data.extend([0; 4]);
        data.extend(3u16.to_le_bytes());
        data.extend(entry(0x9003, 2, 20, 68));
        data.extend(entry(0x920a, 5, 1, 88));
        data.extend(entry(0xa405, 3, 1, film.into()));
        data.extend([0; 4]);
        data.extend(format!("{time:19}\0").as_bytes());
        data.extend([focal.to_le_bytes(), 1u32.to_le_bytes()].concat());
        let length = (data.len() as u16 + 2).to_be_bytes();
        let out = [&jpeg[..2], &[0xff, 0xe1], &length, &data, &jpeg[2..]].concat();
        std::fs::write(path, out).unwrap();
    }

    #[test]
    fn photos_follow_their_times_where_all_have_one() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let names = ["a10.jpg", "a2.jpg", "a9.jpg"].map(at);
        let order = |photos: &[PathBuf]| {
            let (photos, timed) = taken(photos).unwrap();
            let name = |p: &Taken| p.path.file_stem().unwrap().to_string_lossy().into_owned();
            (photos.iter().map(name).collect::<Vec<_>>().join(" "), timed)
        };
        let times = ["2026:11:29 10:00:00", "2026:11:29 10:00:05", "2026:11:28 23:59:59"];
        names.iter().zip(times).for_each(|(name, time)| photo(name, time, 6, 26));
        assert_eq!(order(&names), ("a9 a10 a2".into(), true));
        // All of one second, a clock that was never set, no data, and no time at all: by name.
        names.iter().for_each(|name| photo(name, times[0], 6, 26));
        assert_eq!(order(&names), ("a2 a9 a10".into(), false));
        for time in ["0000:00:00 00:00:00", "long ago"] {
            names.iter().zip(times).for_each(|(name, time)| photo(name, time, 6, 26));
            photo(&names[2], time, 6, 26);
            assert_eq!(order(&names), ("a2 a9 a10".into(), false));
        }
        image::RgbImage::new(8, 6).save(&names[2]).unwrap();
        assert_eq!(order(&names), ("a2 a9 a10".into(), false));
    }

    #[test]
    fn photos_of_another_lens_have_another_camera() {
        let folder = tempfile::tempdir().unwrap();
        let names = ["0", "1", "2", "3", "4"].map(|name| folder.path().join(name.to_owned() + ".jpg"));
        for (i, name) in names.iter().enumerate() {
            photo(name, "", if i == 1 { 2 } else { 6 }, if i == 1 { 13 } else { 27 });
        }
        // Nothing is known of the lens of these; the last is as large as those before.
        image::RgbImage::new(6, 8).save(&names[3]).unwrap();
        image::RgbImage::new(8, 6).save(&names[4]).unwrap();
        let (photos, _) = taken(&names).unwrap();
        let name = |photo: &&Taken| photo.path.file_stem().unwrap().to_string_lossy().into_owned();
        let mut groups: Vec<String> = cameras(&photos).iter().map(|group| group.iter().map(name).collect()).collect();
        groups.sort();
        assert_eq!(groups, ["024", "1", "3"]);
        assert_eq!(photos[0].focal(), Some(0.75));
        assert_eq!(photos[3].focal(), None);
    }
}
