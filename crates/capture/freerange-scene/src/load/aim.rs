//! Where pinholes look that wide lenses are seen through: at the object, wherever it stands in the photo.

use super::{
    LoadConfig, Loaded, MaskSource,
    mask_image::{coverage, read_mask},
};
use crate::camera::{CANONICAL_RADIUS, Camera, FrameConfig, Lens, canonical_from_user, nearest_point};
use crate::{
    SceneError,
    decode::{decode, has_alpha, size_of},
    error::In,
    read::{Cameras, Photo},
};
use glam::{DMat3, DMat4, DQuat, DVec3};
use image::{GrayImage, Luma};
use std::path::{Path, PathBuf};

/// Half of the field of view where nothing says how large the object is, in radians.
const HALF_VIEW: f64 = 0.6;
/// How much more than the object is shown, and the most of half a field of view.
const MARGIN: f64 = 1.25;
const MOST: f64 = 1.15;
/// A mask is looked at in so many columns and rows.
const GRID: u32 = 96;

/// A sphere that holds the object, in the cameras' frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Aim {
    center: DVec3,
    radius: Option<f64>,
    /// Nothing says where the object is: this is where the cameras' axes meet.
    pub by_axes: bool,
}

impl Aim {
    /// From what is known, else from masks, else from where the cameras look. None where no lens is wide.
    pub fn of(cameras: &Cameras, masks: &[Option<PathBuf>], config: &LoadConfig) -> Result<Option<Self>, SceneError> {
        let photos = || cameras.photos.iter().zip(masks).filter(|(p, _)| !p.further);
        let Some((wide, _)) = photos().find(|(p, _)| p.lens.is_wide()) else { return Ok(None) };
        if let Some(center) = config.hints.center {
            return Ok(Some(Self { center, radius: config.hints.radius, by_axes: false }));
        }
        let mut lines = Vec::new();
        let mut angles = Vec::new();
        for (photo, mask) in photos() {
            let seen = outline(photo, mask.as_deref(), config)?;
            let Some(seen) = seen.or((photo.lens != Lens::Equirectangular).then_some((DVec3::Z, None))) else {
                continue;
            };
            let pose = photo.intrinsics.world_to_camera();
            let back = DMat3::from_mat4(pose).transpose();
            let origin = -(back * pose.w_axis.truncate());
            lines.push((origin, back * seen.0));
            angles.extend(seen.1.map(|angle| (origin, angle)));
        }
        let center = match lines.len() {
            0 | 1 => None,
            _ => nearest_point(&lines).ok(),
        };
        let Some(center) = center else {
            return match wide.lens {
                Lens::Equirectangular => {
                    let expected =
                        "masks that show where the object is, or --center X,Y,Z, as the camera sees all around";
                    Err(In(&wide.image).field("", "camera model", expected, "neither"))
                }
                _ => Ok(None),
            };
        };
        let radius = angles.iter().map(|(o, angle)| o.distance(center) * angle.min(1.2).sin()).reduce(f64::max);
        Ok(Some(Self { center, radius: config.hints.radius.or(radius), by_axes: radius.is_none() }))
    }

    /// The sphere about the masks that were found where axes alone said where to look; none where they were seen
    /// well: whole, and large.
    pub fn again(self, cameras: &Cameras, loaded: &Loaded) -> Option<Self> {
        if !self.by_axes {
            return None;
        }
        let back = canonical_from_user(&loaded.views, &FrameConfig::default()).ok()?.canonical_from_user.inverse();
        let (center, radius) = (back.apply(DVec3::ZERO), CANONICAL_RADIUS * back.scale);
        let badly_seen = loaded.views.iter().zip(&loaded.photos).any(|(view, i)| {
            let (c, photo) = (&view.camera, &cameras.photos[*i]);
            let towards = c.world_to_camera.transform_point3(center);
            let half = (radius / towards.length()).min(1.0).asin();
            let shown = (0.5 * f64::from(c.width) / c.fx).min(0.5 * f64::from(c.height) / c.fy).atan();
            let aimed = !c.world_to_camera.abs_diff_eq(photo.intrinsics.world_to_camera(), 1e-9);
            photo.lens.is_wide()
                && (towards.angle_between(DVec3::Z) + half > 0.95 * shown || aimed && half < 0.5 * shown)
        });
        badly_seen.then_some(Self { center, radius: Some(radius), by_axes: false })
    }

    /// The pinhole at the place of `taken` that sees the object as `lens` shows it there; none where the one that looks along the axis
    /// shows it whole. At most `most` pixels wide and high.
    pub fn camera(&self, lens: &Lens, taken: &Camera, most: u32) -> Option<Camera> {
        let towards = taken.world_to_camera.transform_point3(self.center);
        let distance = towards.length();
        let direction = towards.try_normalize()?;
        let half = match self.radius {
            Some(radius) if radius >= distance => MOST,
            Some(radius) => (MARGIN * (radius / distance).asin()).min(MOST),
            None => HALF_VIEW,
        };
        let (a, b) = direction.any_orthonormal_pair();
        if *lens != Lens::Equirectangular {
            let within = |i: u32| {
                let (s, c) = (f64::from(i) * std::f64::consts::TAU / 16.0).sin_cos();
                let ray = half.cos() * direction + half.sin() * (c * a + s * b);
                let (x, y) = (taken.fx * ray.x / ray.z + taken.cx, taken.fy * ray.y / ray.z + taken.cy);
                ray.z > 0.0 && x > 0.0 && y > 0.0 && x < taken.width.into() && y < taken.height.into()
            };
            if (0..16).all(within) {
                return None;
            }
        }
        // As many pixels as the photo has there.
        let at = lens.project(direction)?;
        let step = |side: DVec3| {
            let p = lens.project((direction + 1e-4 * side).normalize())? - at;
            Some((p.x * taken.fx).hypot(p.y * taken.fy) / 1e-4)
        };
        let per_radian = (step(a)? * step(b)?).sqrt();
        let side = (2.0 * half.tan() * per_radian).round().clamp(64.0, f64::from(most));
        let turn = DMat4::from_quat(DQuat::from_rotation_arc(direction, DVec3::Z));
        let focal = 0.5 * side / half.tan();
        let middle = 0.5 * side;
        let world_to_camera = turn * taken.world_to_camera;
        let side = side as u32;
        Some(Camera { width: side, height: side, fx: focal, fy: focal, cx: middle, cy: middle, world_to_camera })
    }
}

/// The middle of what a photo's own mask shows, as a ray of its camera, and the angle that holds all of it. None without a mask.
fn outline(
    photo: &Photo,
    mask: Option<&Path>,
    config: &LoadConfig,
) -> Result<Option<(DVec3, Option<f64>)>, SceneError> {
    let size = size_of(&photo.image)?;
    let share = match (mask, &config.masks) {
        (Some(mask), _) => read_mask(mask, size, config.invert_masks)?.share,
        // An opaque photo shows no outline, and is not decoded to hear of that.
        (None, MaskSource::Auto | MaskSource::Alpha) if has_alpha(&photo.image)? => {
            let image = decode(&photo.image)?.image;
            GrayImage::from_fn(image.width(), image.height(), |x, y| Luma([image.get_pixel(x, y)[3]]))
        }
        _ => return Ok(None),
    };
    // One that reaches all along the border is no outline.
    if coverage(&share).0 >= 0.5 {
        return Ok(None);
    }
    let Ok(camera) = photo.camera(share.dimensions()) else { return Ok(None) };
    let (w, h) = share.dimensions();
    let rays: Vec<DVec3> = (0..GRID * GRID)
        .filter_map(|i| {
            let (x, y) = (i % GRID * w / GRID, i / GRID * h / GRID);
            let (u, v) = ((f64::from(x) + 0.5 - camera.cx) / camera.fx, (f64::from(y) + 0.5 - camera.cy) / camera.fy);
            (share.get_pixel(x, y)[0] >= 128).then(|| photo.lens.ray(u, v))?
        })
        .collect();
    let Some(middle) = rays.iter().sum::<DVec3>().try_normalize() else { return Ok(None) };
    let angle = rays.iter().map(|r| r.angle_between(middle)).fold(0.0, f64::max);
    // Between two samples.
    let step = f64::from(w.max(h)) / f64::from(GRID) / camera.fx.min(camera.fy);
    Ok(Some((middle, Some(angle + step))))
}
