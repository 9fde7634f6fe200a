//! Squares of photos. Networks take square images; a photo is cut or padded to be one, so that its pixels stay square.

use std::borrow::Cow;

use glam::DVec3;
use image::RgbaImage;

use crate::camera::{CANONICAL_RADIUS, Camera, View};

/// Alpha from which a pixel belongs to the object.
const SOLID: u8 = 128;
/// How much of a [framed](Window::framed) picture the canonical sphere spans: about as much as in training's.
const FILL: f64 = 0.75;
/// Square pictures on which it spans less are framed anew; training's cameras have it on a half at least.
const LEAST_FILL: f64 = 0.45;

/// A square of a view's image; it may reach beyond two opposite borders, and is transparent there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    left: i64,
    top: i64,
    side: u32,
}

/// Columns or rows of the object along an axis, first and behind the last.
type Extent = (u32, u32);

impl Window {
    /// The square that holds the whole object as it is seen: as wide as the image's shorter side, or as the object where
    /// that is longer. Along the longer side the object is in its middle, as far as the image goes; an image without a mask
    /// is cut about its own middle. A square image is its own window.
    pub fn around(view: &View) -> Self {
        Self::of(view, true)
    }

    /// The same for what is compared with renders: where the object is cut off by a border, nothing is known of what lies
    /// beyond, and padding there would say that nothing does. Such an image is cut instead.
    pub fn compared(view: &View) -> Self {
        Self::of(view, false)
    }

    /// The square about the canonical sphere in which it is as large as training's views have it, and with it all of the
    /// object. For a view in the canonical frame that is not square, or shows the sphere small; none for others, and where
    /// such a square is not within the image.
    pub fn framed(view: &View) -> Option<Self> {
        Self::framed_in(&view.camera, &view.image)
    }

    /// [`framed`](Self::framed) for an image whose camera is moved to the canonical frame, without a copy of it.
    pub fn framed_in(c: &Camera, image: &RgbaImage) -> Option<Self> {
        let short = i64::from(c.width.min(c.height));
        let middle = c.world_to_camera.transform_point3(DVec3::ZERO);
        // Phrased so that NaN fails it.
        let ahead = middle.z > CANONICAL_RADIUS && middle.is_finite();
        if !ahead {
            return None;
        }
        let across = 2.0 * (CANONICAL_RADIUS / middle.length()).asin().tan() * c.fx.max(c.fy);
        if c.width == c.height && across >= LEAST_FILL * short as f64 {
            return None;
        }
        // No wider than the image: what it does not show is not known to be empty.
        let half = (0.5 * across / FILL).min(0.5 * short as f64);
        let along = |focal: f64, center: f64, at: f64, size: u32| {
            let middle = (focal * at / middle.z + center).clamp(half, f64::from(size) - half);
            let low = (middle - half).floor() as i64;
            (low, low + (2.0 * half).ceil() as i64)
        };
        let (mut x, mut y) = (along(c.fx, c.cx, middle.x, c.width), along(c.fy, c.cy, middle.y, c.height));
        // Faint edges are the object's, too.
        if let Some((seen_x, seen_y)) = extents(image, 1) {
            let both = |a: (i64, i64), b: Extent| (a.0.min(b.0.into()), a.1.max(b.1.into()));
            (x, y) = (both(x, seen_x), both(y, seen_y));
        }
        let side = (x.1 - x.0).max(y.1 - y.0);
        let start = |(low, high): (i64, i64), size: u32| ((low + high - side) / 2).clamp(0, i64::from(size) - side);
        let smaller = side <= short && (c.width, c.height) != (side as u32, side as u32);
        smaller.then(|| Self { left: start(x, c.width), top: start(y, c.height), side: side as u32 })
    }

    fn of(view: &View, whole: bool) -> Self {
        let (w, h) = view.image.dimensions();
        let short = w.min(h);
        if w == h {
            return Self { left: 0, top: 0, side: short };
        }
        let (across, down) = extents(&view.image, SOLID).unwrap_or(((0, w), (0, h)));
        let masked = (across, down) != ((0, w), (0, h));
        let (long, along, beside) = if w > h { (w, across, down) } else { (h, down, across) };
        let cut = beside.0 == 0 || beside.1 == short;
        let side = match masked && (whole || !cut) {
            true => short.max(along.1 - along.0),
            false => short,
        };
        let middle = i64::from((along.0 + along.1) / 2);
        let start = (middle - i64::from(side / 2)).clamp(0, i64::from(long - side));
        let margin = (i64::from(short) - i64::from(side)) / 2;
        let (left, top) = if w > h { (start, margin) } else { (margin, start) };
        Self { left, top, side }
    }

    /// What it shows of a view, whose camera moves along.
    pub fn cut(self, view: &View) -> Cow<'_, View> {
        if view.image.dimensions() == (self.side, self.side) && (self.left, self.top) == (0, 0) {
            return Cow::Borrowed(view);
        }
        let (camera, image) = (self.camera(&view.camera), self.image(&view.image));
        Cow::Owned(View { name: view.name.clone(), camera, image })
    }

    /// What it shows of an image.
    pub fn image(self, image: &RgbaImage) -> RgbaImage {
        let mut out = RgbaImage::new(self.side, self.side);
        // Copies what both have; whatever the image lacks stays transparent.
        image::imageops::replace(&mut out, image, -self.left, -self.top);
        out
    }

    /// The camera of what it shows of this one's image.
    pub fn camera(self, c: &Camera) -> Camera {
        Camera { width: self.side, height: self.side, cx: c.cx - self.left as f64, cy: c.cy - self.top as f64, ..*c }
    }

    /// Its width and height in pixels.
    pub fn side(self) -> u32 {
        self.side
    }
}

/// Where the object is, across and down; none where nothing has as much alpha.
fn extents(image: &RgbaImage, least: u8) -> Option<(Extent, Extent)> {
    let (mut across, mut down) = ((u32::MAX, 0), (u32::MAX, 0));
    for (x, y, _) in image.enumerate_pixels().filter(|(_, _, p)| p[3] >= least) {
        across = (across.0.min(x), across.1.max(x + 1));
        down = (down.0.min(y), down.1.max(y + 1));
    }
    (across.1 > 0).then_some((across, down))
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use image::Rgba;

    use super::*;

    /// An image with a solid box, its pixels numbered.
    fn view(w: u32, h: u32, across: Extent, down: Extent) -> View {
        let image = RgbaImage::from_fn(w, h, |x, y| {
            let solid = (across.0..across.1).contains(&x) && (down.0..down.1).contains(&y);
            Rgba([x as u8, y as u8, 7, if solid { 255 } else { 0 }])
        });
        View { name: "v".into(), camera: Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, 0.8, w, h), image }
    }

    #[test]
    fn a_window_holds_the_object_and_moves_the_camera_along() {
        for (w, h, across, down, side) in [
            (60, 40, (10, 30), (5, 35), 40), // cut
            (60, 40, (55, 60), (5, 35), 40), // at a border
            (60, 40, (3, 58), (12, 20), 55), // longer than the image is high
            (60, 41, (0, 60), (12, 20), 60), // as long as the image
            (31, 64, (4, 9), (2, 61), 59),
            (31, 64, (4, 9), (20, 23), 31),
            (50, 50, (4, 9), (2, 50), 50),
        ] {
            let view = view(w, h, across, down);
            for window in [Window::around(&view), Window::compared(&view)] {
                let cut = window.cut(&view);
                assert_eq!(cut.image.dimensions(), (side, side));
                assert_eq!((cut.camera.width, cut.camera.height), (side, side));
                let solid = |v: &View| v.image.pixels().filter(|p| p[3] > 0).count();
                assert_eq!(solid(&cut), solid(&view), "{w} x {h}: all of the object is in it");
                for (x, y, p) in cut.image.enumerate_pixels().filter(|(_, _, p)| p[3] > 0) {
                    let (ox, oy) = (f64::from(p[0]) + 0.5, f64::from(p[1]) + 0.5);
                    let moved = cut.camera.ray_direction(f64::from(x) + 0.5, f64::from(y) + 0.5);
                    assert!(moved.abs_diff_eq(view.camera.ray_direction(ox, oy), 1e-12));
                }
            }
        }
    }

    /// A picture of the canonical sphere, solid, from 2 away; `fov` in radians across, the optical axis `off` pixels right of
    /// the middle.
    fn sphere(w: u32, h: u32, fov: f64, off: f64) -> View {
        let mut camera = Camera::look_at(2.0 * DVec3::X, DVec3::ZERO, DVec3::Z, fov, w, h);
        camera.cx += off;
        let radius = CANONICAL_RADIUS / 2.0;
        let image = RgbaImage::from_fn(w, h, |x, y| {
            let ray = camera.ray_direction(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let solid = ray.cross(DVec3::X).length() < radius;
            Rgba([x as u8, y as u8, 7, if solid { 255 } else { 0 }])
        });
        View { name: "v".into(), camera, image }
    }

    #[test]
    fn photos_are_framed_about_the_sphere() {
        // By hand: from twice its diameter away it spans 2 tan(asin(1 / 4)) focal lengths.
        let across = |view: &View| 2.0 * (1.0 / 15f64.sqrt()) * view.camera.fx;
        for (w, h, fov, off) in
            [(200, 150, 0.9, 0.0), (150, 200, 0.9, 10.0), (200, 150, 0.9, -40.0), (160, 160, 1.5, 5.0)]
        {
            let view = sphere(w, h, fov, off);
            let cut = Window::framed(&view).expect("a window").cut(&view).into_owned();
            let fill = across(&view) / f64::from(cut.camera.width);
            assert!((0.72..=0.75).contains(&fill), "{w} x {h}: {fill}");
            let solid = |v: &View| v.image.pixels().filter(|p| p[3] > 0).count();
            assert_eq!(solid(&cut), solid(&view));
            for (x, y, p) in cut.image.enumerate_pixels().filter(|(_, _, p)| p[2] > 0) {
                let (ox, oy) = (f64::from(p[0]) + 0.5, f64::from(p[1]) + 0.5);
                let moved = cut.camera.ray_direction(f64::from(x) + 0.5, f64::from(y) + 0.5);
                assert!(moved.abs_diff_eq(view.camera.ray_direction(ox, oy), 1e-12));
            }
            assert_eq!(cut.image.pixels().filter(|p| p[2] == 0).count(), 0, "nothing is padded");
            assert_eq!(Window::framed(&cut), None, "once is enough");
        }
    }

    #[test]
    fn framing_loses_nothing_of_the_object() {
        // Larger than the frame believes: the window follows the mask.
        let mut view = sphere(200, 150, 0.9, 0.0);
        view.image.put_pixel(40, 75, Rgba([40, 75, 7, 1]));
        let cut = Window::framed(&view).expect("a window").cut(&view).into_owned();
        assert!(cut.image.pixels().any(|p| p.0 == [40, 75, 7, 1]));
        // Wider than the photo is high, or behind the camera: left alone.
        view.image.put_pixel(1, 75, Rgba([1, 75, 7, 1]));
        view.image.put_pixel(198, 75, Rgba([198, 75, 7, 1]));
        assert_eq!(Window::framed(&view), None);
        let mut behind = sphere(200, 150, 0.9, 0.0);
        behind.camera.world_to_camera =
            Camera::look_at(2.0 * DVec3::X, 3.0 * DVec3::X, DVec3::Z, 0.9, 4, 4).world_to_camera;
        assert_eq!(Window::framed(&behind), None);
        // Square, and as large as training has it.
        assert_eq!(Window::framed(&sphere(160, 160, 0.9, 0.0)), None);
    }

    #[test]
    fn what_is_unknown_is_not_padded_for_comparisons() {
        let cut_off = view(60, 40, (3, 58), (0, 20));
        assert_eq!(Window::around(&cut_off).side, 55);
        assert_eq!(Window::compared(&cut_off), Window { left: 10, top: 0, side: 40 });
    }

    #[test]
    fn squares_stay_and_images_without_a_mask_are_cut_about_their_middle() {
        let square = view(50, 50, (4, 9), (2, 50));
        assert!(matches!(Window::around(&square).cut(&square), Cow::Borrowed(_)));
        let whole = view(60, 40, (0, 60), (0, 40));
        let empty = view(60, 40, (0, 0), (0, 0));
        for view in [whole, empty] {
            assert_eq!(Window::around(&view), Window { left: 10, top: 0, side: 40 });
        }
        let tall = view(3, 8, (0, 0), (0, 0));
        assert_eq!(Window::around(&tall), Window { left: 0, top: 3, side: 3 });
    }
}
