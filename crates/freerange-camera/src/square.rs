//! Squares of photos. Networks take square images; a photo is cut or padded to be one, so that its pixels stay square.

use std::borrow::Cow;

use image::RgbaImage;

use crate::{Camera, View};

/// Alpha from which a pixel belongs to the object.
const SOLID: u8 = 128;

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

    fn of(view: &View, whole: bool) -> Self {
        let (w, h) = view.image.dimensions();
        let short = w.min(h);
        if w == h {
            return Self { left: 0, top: 0, side: short };
        }
        let (across, down) = extents(&view.image).unwrap_or(((0, w), (0, h)));
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
        let mut image = RgbaImage::new(self.side, self.side);
        // Copies what both have; whatever the image lacks stays transparent.
        image::imageops::replace(&mut image, &view.image, -self.left, -self.top);
        let c = view.camera;
        let camera = Camera {
            width: self.side,
            height: self.side,
            cx: c.cx - self.left as f64,
            cy: c.cy - self.top as f64,
            ..c
        };
        Cow::Owned(View { name: view.name.clone(), camera, image })
    }
}

/// Where the object is, across and down; none where nothing is solid.
fn extents(image: &RgbaImage) -> Option<(Extent, Extent)> {
    let (mut across, mut down) = ((u32::MAX, 0), (u32::MAX, 0));
    for (x, y, _) in image.enumerate_pixels().filter(|(_, _, p)| p[3] >= SOLID) {
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
