//! The pinhole camera and a posed image.

use glam::{DMat4, DVec3, DVec4};

/// A pinhole camera. Axes are OpenCV's: x right, y down, z forward; pixel centers lie at +0.5.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Camera {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Focal length along x, in pixels.
    pub fx: f64,
    /// Focal length along y, in pixels.
    pub fy: f64,
    /// Principal point, x, in pixels.
    pub cx: f64,
    /// Principal point, y, in pixels.
    pub cy: f64,
    /// Rigid transform from world to camera coordinates.
    pub world_to_camera: DMat4,
}

impl Camera {
    /// A camera at `eye` that looks at `target`, with `up` towards the top of the image and square pixels.
    /// `fov_x` is the horizontal field of view in radians. `up` must not be parallel to the line of sight.
    pub fn look_at(eye: DVec3, target: DVec3, up: DVec3, fov_x: f64, width: u32, height: u32) -> Self {
        let z = (target - eye).normalize();
        let x = z.cross(up).normalize();
        let y = z.cross(x);
        let camera_to_world = DMat4::from_cols(x.extend(0.0), y.extend(0.0), z.extend(0.0), eye.extend(1.0));
        let focal = 0.5 * f64::from(width) / (0.5 * fov_x).tan();
        Self {
            width,
            height,
            fx: focal,
            fy: focal,
            cx: 0.5 * f64::from(width),
            cy: 0.5 * f64::from(height),
            world_to_camera: camera_to_world.inverse(),
        }
    }

    /// The center of projection in world coordinates.
    pub fn center(&self) -> DVec3 {
        let r = glam::DMat3::from_mat4(self.world_to_camera);
        -(r.transpose() * self.world_to_camera.w_axis.truncate())
    }

    /// Unit direction, in world coordinates, of the ray through image point (`x`, `y`) in pixels.
    pub fn ray_direction(&self, x: f64, y: f64) -> DVec3 {
        let local = DVec4::new((x - self.cx) / self.fx, (y - self.cy) / self.fy, 1.0, 0.0);
        (self.world_to_camera.transpose() * local).truncate().normalize()
    }

    /// The same camera where positions are relative to `origin`.
    pub fn relative_to(&self, origin: DVec3) -> Self {
        let mut camera = *self;
        let shift = self.world_to_camera.transform_vector3(origin);
        camera.world_to_camera.w_axis += shift.extend(0.0);
        camera
    }

    /// The same view at another resolution: intrinsics scale with the image.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (sx, sy) = (f64::from(width) / f64::from(self.width), f64::from(height) / f64::from(self.height));
        Self { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy, ..*self }
    }
}

/// The pixel of `camera` that shows `point`, counted row by row, and the point's camera z. None outside of the image or
/// behind the camera.
#[inline]
pub fn pixel_of(camera: &Camera, point: DVec3) -> Option<(usize, f64)> {
    let p = camera.world_to_camera.transform_point3(point);
    let (x, y) = (camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy);
    // Phrased so that NaN fails it.
    let inside = p.z > 0.0 && x >= 0.0 && y >= 0.0 && x < f64::from(camera.width) && y < f64::from(camera.height);
    inside.then(|| (y as usize * camera.width as usize + x as usize, p.z))
}

/// A posed image: sRGB-encoded color with straight alpha, and the camera that took it.
#[derive(Clone, Debug)]
pub struct View {
    /// What the user knows it by: the file name without its extension.
    pub name: String,
    /// Its camera; `image` has the same size.
    pub camera: Camera,
    /// 8-bit RGBA, straight alpha, sRGB-encoded.
    pub image: image::RgbaImage,
}
