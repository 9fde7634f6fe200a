//! Whether poses that an engine found can be right. Reprojection errors do not tell: poses that are off by a third of a turn, on a mug whose
//! pattern repeats, have as small ones.

use freerange::{choose_views, internal::leave_one_out, to_canonical};
use freerange_scene::camera::{Camera, Lens, cameras_up, nearest_point};
use freerange_scene::{
    LoadConfig, Loaded, Scene, SceneConfig, SceneError,
    inspect::view_warnings,
    read::{Cameras, Intrinsics},
};
use glam::{DMat3, DVec3};
use serde::Serialize;

use super::{bounds::Bounds, job::Done};
use crate::error::CliError;

/// Share of the photos that must have a pose, and their least number.
const LEAST_SHARE: f64 = 0.8;
const LEAST_PHOTOS: usize = 4;
/// Largest turn between neighbors over the median turn: right models have 1.0 to 1.9. Of 24 photos of a pattern that repeats six
/// times a misplaced one has 2.5 and more. Other wrong models began at 1.9: from less on, it is said.
const MOST_UNEVEN: f64 = 2.1;
const UNEVEN: f64 = 1.8;
/// A turn of so many degrees or fewer misplaces no photo: a pattern that repeats twelve times is 30 degrees from its copy. By hand the
/// turns of 48 photos are from 4 to 25 degrees, 12 in the median.
const SMALL_TURN: f64 = 28.0;
/// Median turn between neighbors from which features do not hold, in degrees.
const FAR_APART: f64 = 40.0;
/// Focal length over the photo's longer side that lenses have, and the largest distortion.
const FOCAL: std::ops::RangeInclusive<f64> = 0.4..=6.0;
const MOST_DISTORTION: f64 = 0.5;
/// Largest factor between a found focal length and EXIF's: right models are within 1.14.
const MOST_ZOOM: f64 = 1.3;
/// How much worse than the median photo one may be predicted from the others, in dB.
const MOST_SURPRISE: f64 = 8.0;

/// What is known of found poses.
#[derive(Debug, Default, Serialize)]
pub struct Judgement {
    /// Why they are not to be used; empty where they are.
    pub refused: Vec<String>,
    /// Refused as photos may be mixed up that look alike.
    #[serde(skip)]
    pub in_doubt: bool,
    /// What may be wrong.
    pub warnings: Vec<String>,
    /// Photos without a pose.
    pub left_out: Vec<String>,
    /// Focal length over the photo's longer side, of each camera in order of photos, once.
    pub focal: Vec<f64>,
    /// Median and largest turn between photos that follow one another, in degrees, and between which the largest is.
    pub turns: Option<(f64, f64, [String; 2])>,
    /// Times that the cameras go around the object.
    pub rounds: Option<f64>,
    /// For each photo how well the others predict its picture, in dB.
    pub predicted: Vec<(String, f64)>,
}

impl Judgement {
    /// What the engine itself says: whether there is enough of a model to look at.
    pub fn of_engine(names: &[String], done: &Done) -> Self {
        let mut found = Self::default();
        let (count, all) = (done.models.first().copied().unwrap_or(0), names.len());
        if count < LEAST_PHOTOS || (count as f64) < LEAST_SHARE * all as f64 {
            found.refused.push(format!("only {count} of {all} photos could be placed"));
        } else if done.points == 0 {
            found.refused.push("no points of the object were found".into());
        } else if let Some(more) = done.models.get(1).filter(|_| count < all) {
            // Where the first model has all photos, another has some of them again.
            found.warnings.push(format!("{more} photos fit together by themselves, but not with the others"));
        }
        found
    }

    /// Looks at a model of the photos `names`, which are in the order in which they were taken; `uneven`: not at even steps once around.
    pub fn look(&mut self, cameras: &Cameras, names: &[String], uneven: bool) -> Result<(), CliError> {
        let placed: Vec<(usize, &str, Camera, Lens)> = names
            .iter()
            .enumerate()
            .filter_map(|(i, name)| {
                let photo = cameras.photos.iter().find(|p| p.name == *name)?;
                let Intrinsics::Pixels(camera) = photo.intrinsics else { return None };
                Some((i, name.as_str(), camera, photo.lens))
            })
            .collect();
        self.left_out = names.iter().filter(|n| placed.iter().all(|p| p.1 != **n)).cloned().collect();
        if !self.left_out.is_empty() {
            self.warnings.push(format!("no pose was found for {}", self.left_out.join(", ")));
        }
        self.lenses(placed.iter().map(|p| (p.2, p.3)));
        let axes: Vec<(DVec3, DVec3)> =
            placed.iter().map(|p| (p.2.center(), DMat3::from_mat4(p.2.world_to_camera).transpose().z_axis)).collect();
        match nearest_point(&axes) {
            Err(e) => self.refused.push(format!("the cameras do not look at one object ({e})")),
            Ok(middle) => self.ring(&placed, middle, names.len(), uneven),
        }
        Ok(())
    }

    fn lenses(&mut self, cameras: impl Iterator<Item = (Camera, Lens)>) {
        for (camera, lens) in cameras {
            let focal = camera.fx / f64::from(camera.width.max(camera.height));
            if self.focal.iter().any(|f| (f - focal).abs() < 1e-9) {
                continue;
            }
            self.focal.push(focal);
            let bent = match lens {
                Lens::Brown { k, .. } => k[0].abs() > MOST_DISTORTION,
                _ => false,
            };
            if !FOCAL.contains(&focal) || bent {
                self.refused.push(format!(
                    "the focal length that was found, {focal:.2} of the photo's longer side, or its distortion is that of no usual lens"
                ));
            }
        }
    }

    /// Compares focal lengths over the longer side, where EXIF data has one, with those found.
    pub fn compare_lenses(&mut self, cameras: &Cameras, told: impl Iterator<Item = (String, Option<f64>)>) {
        for (name, focal) in told.filter_map(|(name, focal)| Some((name, focal?))) {
            let Some(photo) = cameras.photos.iter().find(|p| p.name == name) else { continue };
            let Intrinsics::Pixels(camera) = photo.intrinsics else { continue };
            let found = camera.fx / f64::from(camera.width.max(camera.height));
            if !(1.0 / MOST_ZOOM..MOST_ZOOM).contains(&(found / focal)) {
                self.warnings.push(format!(
                    "the focal length that was found is {found:.2} of the longer side of {name}, \
                     its EXIF data has {focal:.2}: poses may be wrong"
                ));
                return;
            }
        }
    }

    /// Turns between photos that follow one another, and the way around.
    fn ring(&mut self, placed: &[(usize, &str, Camera, Lens)], middle: DVec3, all: usize, uneven: bool) {
        let doubt = |found: &mut Self, text: String| match uneven {
            true => found.warnings.push(text),
            false => {
                found.in_doubt = true;
                found.refused.push(text);
            }
        };
        let next = |i: usize| (i + 1) % placed.len();
        let rotation = |i: usize| DMat3::from_mat4(placed[i].2.world_to_camera);
        let turns: Vec<f64> = (0..placed.len())
            .map(|i| {
                let m = rotation(next(i)) * rotation(i).transpose();
                let angle = (0.5 * (m.x_axis.x + m.y_axis.y + m.z_axis.z - 1.0)).clamp(-1.0, 1.0).acos().to_degrees();
                // Photos in between that have no pose.
                let steps = (placed[next(i)].0 + all - placed[i].0) % all;
                angle / steps.max(1) as f64
            })
            .collect();
        let mut sorted = turns.clone();
        sorted.sort_by(f64::total_cmp);
        let median = sorted[sorted.len() / 2];
        let at = (0..turns.len()).max_by(|a, b| turns[*a].total_cmp(&turns[*b])).unwrap_or(0);
        let pair = [placed[at].1.to_owned(), placed[next(at)].1.to_owned()];
        if turns[at] > SMALL_TURN.max(MOST_UNEVEN * median) {
            let text = format!(
                "the camera turned by {:.0} degrees from {} to {}, and by {median:.0} from one photo to the next in the median: one of them may be \
                 misplaced, as happens where patterns repeat (--uneven if photos are missing there, or not in order)",
                turns[at], pair[0], pair[1]
            );
            doubt(self, text);
        } else if turns[at] >= UNEVEN * median && !uneven {
            self.warnings.push(format!(
                "the camera turned by {:.0} degrees from {} to {}, {:.1} times the median turn: one of them may be \
                 misplaced, unless a photo is missing between them",
                turns[at],
                pair[0],
                pair[1],
                turns[at] / median
            ));
        }
        if median > FAR_APART {
            self.refused.push(format!(
                "the photos are {median:.0} degrees apart, too far to be sure of what they have in common"
            ));
        }
        self.turns = Some((median, turns[at], pair));
        let views: Vec<freerange::View> = placed
            .iter()
            .map(|p| freerange::View { name: String::new(), camera: p.2, image: image::RgbaImage::new(1, 1) })
            .collect();
        let Some(up) = cameras_up(&views) else { return };
        let (east, north) = up.any_orthonormal_pair();
        let azimuth = |i: usize| {
            let d = placed[i].2.center() - middle;
            d.dot(north).atan2(d.dot(east))
        };
        let step = |i: usize| (azimuth(next(i)) - azimuth(i)).sin().atan2((azimuth(next(i)) - azimuth(i)).cos());
        let rounds = (0..placed.len()).map(step).sum::<f64>() / std::f64::consts::TAU;
        if (rounds.abs() - 1.0).abs() > 0.1 {
            let text =
                format!("the cameras go {:.0} times around the object, not once (--uneven if they did)", rounds.abs());
            doubt(self, text);
        }
        self.rounds = Some(rounds);
    }

    /// Looks at the photos themselves: whether masks and table are consistent, as `inspect` does, and how well the others predict each.
    pub fn look_at_photos(&mut self, cameras: &Cameras, bounds: &Bounds) -> Result<(), CliError> {
        // As `reconstruct` reads them, but small, and masks are not corrected by other views: that would hide wrong poses.
        let photos = LoadConfig { max_side: 640, stop: bounds.stop.clone(), ..LoadConfig::default() };
        let photos = LoadConfig { memory: bounds.photos_memory.unwrap_or(photos.memory), ..photos };
        let config = SceneConfig { photos, ..SceneConfig::default() };
        let Scene { loaded, frame, .. } = match Scene::load(cameras.clone(), &config) {
            Ok(scene) => scene,
            Err(e @ SceneError::NotCutOut { .. }) => {
                self.refused.push(e.to_string());
                return Ok(());
            }
            Err(e) => return Err(e.into()),
        };
        match to_canonical(&loaded.views, &frame) {
            Ok((frame, _)) => {
                let shown = choose_views(&loaded.views, loaded.views.len())?;
                self.warnings.extend(view_warnings(&loaded, &frame, &shown));
            }
            Err(e) => self.refused.push(e.to_string()),
        }
        self.predict(&loaded, bounds);
        Ok(())
    }

    fn predict(&mut self, loaded: &Loaded, bounds: &Bounds) {
        let shown = match leave_one_out(loaded.views.clone(), &bounds.stop) {
            Ok(shown) => shown,
            Err(e) => {
                self.refused.push(format!("these poses give no render of the object ({e})"));
                return;
            }
        };
        for (view, shown) in loaded.views.iter().zip(shown) {
            let (mut sum, mut count) = (0.0, 0.0f64);
            for (a, b) in view.image.pixels().zip(shown.pixels()).filter(|(a, _)| a[3] >= 128) {
                let over = |p: &image::Rgba<u8>, c: usize| f64::from(p[c]) * f64::from(p[3]) / 255.0;
                (0..3).for_each(|c| sum += (over(a, c) - over(b, c)).powi(2));
                count += 3.0;
            }
            let psnr = -10.0 * (sum / count.max(1.0) / 255f64.powi(2)).max(1e-9).log10();
            self.predicted.push((view.name.clone(), psnr));
        }
        let mut sorted: Vec<f64> = self.predicted.iter().map(|p| p.1).collect();
        sorted.sort_by(f64::total_cmp);
        let median = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
        let odd: Vec<&str> =
            self.predicted.iter().filter(|p| p.1 < median - MOST_SURPRISE).map(|p| p.0.as_str()).collect();
        if !odd.is_empty() {
            self.warnings.push(format!("the other photos do not predict {}: its pose may be wrong", odd.join(", ")));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use freerange::View;

    #[test]
    fn a_focal_length_far_from_exifs_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let image = image::RgbaImage::new(40, 30);
        std::fs::create_dir(folder.path().join("images")).unwrap();
        image.save(folder.path().join("images/a.png")).unwrap();
        let mut camera = Camera::look_at(DVec3::Y, DVec3::ZERO, DVec3::Z, 1.0, 40, 30);
        (camera.fx, camera.fy) = (40.0, 40.0);
        let view = View { name: "a".into(), camera, image };
        let points = [(DVec3::ZERO, [0; 3])];
        freerange_scene::write_colmap(folder.path(), &[view], DVec3::ZERO, &points).unwrap();
        let cameras = freerange_scene::read::cameras(folder.path(), None, None).unwrap();
        let warnings = |focal: Option<f64>| {
            let mut judgement = Judgement::default();
            judgement.compare_lenses(&cameras, [("a.png".into(), focal)].into_iter());
            judgement.warnings.concat()
        };
        assert_eq!([None, Some(0.88), Some(1.14)].map(warnings).concat(), "");
        assert!(warnings(Some(0.7)).contains("1.00 of the longer side of a.png"));
        assert!(warnings(Some(1.4)).contains("has 1.40"));
    }
}
