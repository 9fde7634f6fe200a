//! What was understood of a scene: numbers, warnings in plain words, and one sheet of pictures.

use crate::camera::{CANONICAL_RADIUS, Camera, CanonicalFrame, View, image_ops::resize_area};
use crate::{Loaded, MaskKind, SceneError, estimate, read::Cameras};
use freerange_util::{Note, NoteKind};
use glam::{DQuat, DVec3};
use image::{Rgba, RgbaImage};
use std::path::PathBuf;

/// Agreement of a mask with the common hull below which it is pointed out.
const DOUBTFUL: f64 = 0.8;
/// Contradiction of a mask and the others above which it is pointed out: true masks of generated objects have less than 0.001, one in
/// another's place mostly 0.04 to 0.7.
const CONTRADICTS: f64 = 0.03;
/// Gap between cameras around the object that is pointed out, in degrees.
const WIDE_GAP: f64 = 140.0;

/// What was understood of a scene.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Inspection {
    /// Whose cameras they are.
    pub format: crate::read::Format,
    /// The files that were read.
    pub files: Vec<PathBuf>,
    /// How the object was told from the rest.
    pub masks: MaskKind,
    /// How sure estimated masks are, 0 to 1.
    pub sureness: Option<f64>,
    /// The object's middle, in the scene's frame.
    pub center: [f64; 3],
    /// The radius of its sphere.
    pub radius: f64,
    /// Which way is up.
    pub up: [f64; 3],
    /// The input views.
    pub views: Vec<ViewReport>,
    /// Number of further views.
    pub further: usize,
    /// What was understood, assumed, changed or left out.
    pub notes: Vec<Note>,
    /// What may go wrong.
    pub warnings: Vec<String>,
}

/// What was understood of a view.
#[derive(Clone, Debug, serde::Serialize)]
pub struct ViewReport {
    /// Its name.
    pub name: String,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Horizontal field of view, degrees.
    pub fov: f64,
    /// From the camera to the object's middle, in radii of the object.
    pub distance: f64,
    /// Where the camera stands around the object, degrees about up.
    pub azimuth: f64,
    /// And above it.
    pub elevation: f64,
    /// The mask's share of the image.
    pub covers: f64,
    /// How far the mask agrees with the hull of all masks, 0 to 1.
    pub agreement: f64,
    /// How far the mask and those of the others contradict each other, 0 to 1 ([`estimate::contradictions`]); 0 for two views.
    pub contradicts: f64,
    /// Whether the mask reaches the image's border.
    pub cut_off: bool,
    /// Whether the model is shown this view.
    pub shown: bool,
    /// Why, or why not.
    pub reason: String,
}

impl ViewReport {
    fn doubtful(&self) -> bool {
        self.agreement < DOUBTFUL || self.contradicts > CONTRADICTS
    }
}

/// What may go wrong with the views of a scene. `frame`: where the object was found; `shown`: which views the model is shown.
pub fn view_warnings(loaded: &Loaded, frame: &CanonicalFrame, shown: &[usize]) -> Vec<String> {
    warnings(&view_reports(loaded, frame, shown), loaded.estimate.as_ref().map(estimate::Estimate::sureness))
}

/// The object's middle, its radius and its up.
fn place(frame: &CanonicalFrame) -> (DVec3, f64, DVec3) {
    let back = frame.canonical_from_user.inverse();
    (back.apply(DVec3::ZERO), CANONICAL_RADIUS * back.scale, back.rotation * DVec3::Z)
}

fn view_reports(loaded: &Loaded, frame: &CanonicalFrame, shown: &[usize]) -> Vec<ViewReport> {
    let (center, radius, up) = place(frame);
    let agreement = estimate::agreement(&loaded.views, center, 1.5 * radius);
    let contradicts = match loaded.views.len() {
        0..3 => vec![0.0; loaded.views.len()],
        _ => estimate::contradictions(&loaded.views, center, 1.5 * radius),
    };
    let to_up = DQuat::from_rotation_arc(up, DVec3::Z);
    loaded
        .views
        .iter()
        .enumerate()
        .map(|(i, view)| {
            let c = &view.camera;
            let from = to_up * (c.center() - center);
            let alpha: Vec<u8> = view.image.pixels().map(|p| p[3]).collect();
            let covered = alpha.iter().filter(|a| **a >= 128).count();
            let is_shown = shown.contains(&i);
            ViewReport {
                name: view.name.clone(),
                width: c.width,
                height: c.height,
                fov: (2.0 * (0.5 * f64::from(c.width) / c.fx).atan()).to_degrees(),
                distance: from.length() / radius,
                azimuth: from.y.atan2(from.x).to_degrees(),
                elevation: (from.z / from.length()).asin().to_degrees(),
                covers: covered as f64 / alpha.len().max(1) as f64,
                agreement: agreement[i],
                contradicts: contradicts[i],
                cut_off: estimate::cut_off(&alpha, c.width, c.height),
                shown: is_shown,
                reason: match (is_shown, shown.len() == loaded.views.len()) {
                    (true, true) => "the network sees all views".into(),
                    (true, false) => "stands for its side of the object (k-means of the cameras)".into(),
                    (false, _) => "another view stands for its side; the optimization uses it".into(),
                },
            }
        })
        .collect()
}

/// Looks at a scene, of whose reading `notes` tell. `frame`: where the object was found; `shown`: which views the model is
/// shown.
pub fn inspect(
    cameras: &Cameras,
    loaded: &Loaded,
    notes: &[Note],
    frame: &CanonicalFrame,
    shown: &[usize],
) -> Inspection {
    let (center, radius, up) = place(frame);
    let views = view_reports(loaded, frame, shown);
    let sureness = loaded.estimate.as_ref().map(estimate::Estimate::sureness);
    let found = frame.notes.iter().map(Note::understood);
    let (told, notes): (Vec<Note>, Vec<Note>) =
        notes.iter().cloned().chain(found).partition(|n| n.kind == NoteKind::Warning);
    let warnings = told.into_iter().map(|n| n.text).chain(warnings(&views, sureness)).collect();
    Inspection {
        format: cameras.format,
        files: cameras.files.clone(),
        masks: loaded.masks,
        sureness,
        center: center.to_array(),
        radius,
        up: up.to_array(),
        further: loaded.further.len(),
        views,
        notes,
        warnings,
    }
}

fn listed(views: &[ViewReport], which: impl Fn(&ViewReport) -> bool) -> Option<String> {
    let names: Vec<&str> = views.iter().filter(|v| which(v)).map(|v| v.name.as_str()).collect();
    match names.len() {
        0 => None,
        1..=6 => Some(names.join(", ")),
        n => Some(format!("{} and {} more", names[..5].join(", "), n - 5)),
    }
}

fn warnings(views: &[ViewReport], sureness: Option<f64>) -> Vec<String> {
    let mut warnings = Vec::new();
    if views.len() < 4 {
        warnings.push(format!("only {} photos: four or more, from all around, are better", views.len()));
    }
    // The widest gap around the object. Cameras right above it stand nowhere around it.
    let mut around: Vec<f64> = views.iter().filter(|v| v.elevation.abs() < 75.0).map(|v| v.azimuth).collect();
    around.sort_by(f64::total_cmp);
    if let (Some(first), Some(last)) = (around.first(), around.last()) {
        let mut gap = (first + 360.0 - last, *last);
        for pair in around.windows(2) {
            if pair[1] - pair[0] > gap.0 {
                gap = (pair[1] - pair[0], pair[0]);
            }
        }
        if gap.0 > 220.0 {
            warnings.push(format!(
                "all photos are taken from one side: nothing shows {:.0} degrees of the way around, what is there will be a smooth guess",
                gap.0
            ));
        } else if gap.0 > WIDE_GAP {
            let middle = (gap.1 + 0.5 * gap.0 + 180.0).rem_euclid(360.0) - 180.0;
            warnings.push(format!("no photo from {:.0} degrees of the way around (azimuth {middle:.0})", gap.0));
        }
    }
    if let Some(names) = listed(views, |v| v.cut_off) {
        warnings.push(format!("the object is cut off by the photo's border in {names}"));
    }
    // A wrong mask takes from all others: those that contradict the rest most are named.
    let most = views.iter().map(|v| v.contradicts).fold(CONTRADICTS, f64::max);
    let worst = |v: &ViewReport| v.contradicts > CONTRADICTS && v.contradicts >= 0.6 * most;
    if let Some(names) = listed(views, |v| worst(v) || (most <= CONTRADICTS && v.doubtful())) {
        warnings.push(format!(
            "the masks of the other views disagree with {names}: a mask or a pose is wrong there, or in one of them"
        ));
    }
    if let Some(names) = listed(views, |v| v.covers < 0.01) {
        warnings
            .push(format!("the object is small (less than a hundredth of the photo) in {names}: go nearer, or crop"));
    }
    if sureness.is_some_and(|s| s < 0.85) {
        warnings.push("the masks are not sure: look at them, correct them and give them with --masks".into());
    }
    warnings
}

/// Width and height of a picture on the sheet.
const TILE: u32 = 360;
const LINE: u32 = 12;
/// Between a label and the photo below it.
const GAP: u32 = 4;
const GREEN: Rgba<u8> = Rgba([40, 200, 60, 255]);
const GRAY: Rgba<u8> = Rgba([120, 120, 120, 255]);
const ORANGE: Rgba<u8> = Rgba([255, 150, 0, 255]);
const INK: Rgba<u8> = Rgba([30, 30, 30, 255]);
const RED: Rgba<u8> = Rgba([200, 20, 20, 255]);
const WHITE: Rgba<u8> = Rgba([255, 255, 255, 255]);

/// One picture of it all: the cameras from above, and every photo with its mask's outline (green where the model is shown the view, gray
/// elsewhere; what is not the object is darkened) and the object's sphere (orange); warnings in red.
///
/// # Errors
/// Where a whole photo lies in a file that cannot be read.
pub fn sheet(loaded: &Loaded, inspection: &Inspection) -> Result<RgbaImage, SceneError> {
    let columns = match loaded.views.len() + 1 {
        n @ 0..=3 => n as u32,
        4..=12 => 4,
        _ => 6,
    };
    let rows = (loaded.views.len() as u32 + 1).div_ceil(columns);
    let head = LINE * (2 + inspection.warnings.len() as u32);
    let mut sheet = RgbaImage::from_pixel(columns * TILE, head + rows * (TILE + 2 * LINE), WHITE);
    let sure = inspection.sureness.map_or(String::new(), |s| format!(", {:.0} % SURE", 100.0 * s));
    let title = format!(
        "{}: {} PHOTOS, {} SEEN BY THE NETWORK, MASKS: {}{sure}",
        inspection.format.name(),
        inspection.views.len(),
        inspection.views.iter().filter(|v| v.shown).count(),
        serde_json::to_string(&inspection.masks).unwrap_or_default().replace('"', "")
    );
    text(&mut sheet, 4, 3, &title, INK);
    for (i, warning) in inspection.warnings.iter().enumerate() {
        text(&mut sheet, 4, 3 + LINE * (1 + i as u32), warning, RED);
    }
    map(&mut sheet, 0, head, inspection);
    let (center, radius) = (DVec3::from_array(inspection.center), inspection.radius);
    for (i, (view, report)) in loaded.views.iter().zip(&inspection.views).enumerate() {
        let place = i as u32 + 1;
        let (x, y) = (place % columns * TILE, head + place / columns * (TILE + 2 * LINE));
        let picture = tile(view, loaded.whole.get(i)?.as_ref(), report, center, radius);
        image::imageops::overlay(&mut sheet, &picture, i64::from(x), i64::from(y + LINE + GAP));
        let ink = if report.doubtful() || report.cut_off { RED } else { INK };
        let line = format!(
            "{place} {}: {} AGREES {:.0} %{}",
            report.name,
            if report.shown { "SEEN BY THE NETWORK" } else { "FOR THE OPTIMIZATION" },
            100.0 * report.agreement,
            if report.cut_off { ", CUT OFF" } else { "" }
        );
        text(&mut sheet, x + 4, y + 2, &line, ink);
    }
    Ok(sheet)
}

fn tile(view: &View, whole: &RgbaImage, report: &ViewReport, center: DVec3, radius: f64) -> RgbaImage {
    let (w, h) = whole.dimensions();
    let side = f64::from(TILE - 4) / f64::from(w.max(h));
    let (nw, nh) = ((f64::from(w) * side).max(1.0) as u32, (f64::from(h) * side).max(1.0) as u32);
    let (mut picture, cut) = (resize_area(whole, nw, nh), resize_area(&view.image, nw, nh));
    let inside = |x: i64, y: i64| {
        x >= 0 && y >= 0 && x < i64::from(nw) && y < i64::from(nh) && cut.get_pixel(x as u32, y as u32)[3] >= 128
    };
    let outline = if report.shown { GREEN } else { GRAY };
    for (x, y, p) in picture.enumerate_pixels_mut() {
        let (i, j) = (i64::from(x), i64::from(y));
        let own = inside(i, j);
        if own && [(1, 0), (-1, 0), (0, 1), (0, -1)].iter().any(|(dx, dy)| !inside(i + dx, j + dy)) {
            *p = outline;
        } else if !own {
            (0..3).for_each(|c| p[c] = (u16::from(p[c]) * 3 / 5) as u8);
        }
        p[3] = 255;
    }
    let camera = view.camera.resized(nw, nh);
    for (x, y) in sphere_outline(&camera, center, radius) {
        if x >= 0.0 && y >= 0.0 && x < f64::from(nw) && y < f64::from(nh) {
            picture.put_pixel(x as u32, y as u32, ORANGE);
        }
    }
    picture
}

/// Points of the outline of a sphere, in pixels: where its tangent rays pass.
fn sphere_outline(camera: &Camera, center: DVec3, radius: f64) -> Vec<(f64, f64)> {
    let towards = center - camera.center();
    let distance = towards.length();
    if distance <= radius {
        return Vec::new();
    }
    let axis = towards / distance;
    let (a, b) = axis.any_orthonormal_pair();
    let sine = radius / distance;
    let cosine = (1.0 - sine * sine).sqrt();
    (0..2000)
        .filter_map(|i| {
            let (s, c) = (std::f64::consts::TAU * f64::from(i) / 2000.0).sin_cos();
            let ray = cosine * axis + sine * (c * a + s * b);
            let p = camera.world_to_camera.transform_vector3(ray);
            (p.z > 1e-6).then(|| (camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy))
        })
        .collect()
}

/// The cameras from above.
fn map(sheet: &mut RgbaImage, left: u32, top: u32, inspection: &Inspection) {
    let half = 0.5 * f64::from(TILE);
    let farthest = inspection.views.iter().map(|v| v.distance).fold(1.0, f64::max);
    let scale = 0.85 * half / farthest;
    let mut dot = |x: f64, y: f64, r: i64, color: Rgba<u8>| {
        for dy in -r..=r {
            for dx in -r..=r {
                let (px, py) = ((half + x) as i64 + dx, (half - y) as i64 + dy);
                if dx * dx + dy * dy <= r * r && px >= 0 && py >= 0 && px < i64::from(TILE) && py < i64::from(TILE) {
                    sheet.put_pixel(left + px as u32, top + LINE + py as u32, color);
                }
            }
        }
    };
    for i in 0..720 {
        let (s, c) = f64::from(i).to_radians().sin_cos();
        dot(scale * c, scale * s, 0, ORANGE);
    }
    let mut labels = Vec::new();
    for (i, view) in inspection.views.iter().enumerate() {
        let (s, c) = view.azimuth.to_radians().sin_cos();
        let reach = scale * view.distance * view.elevation.to_radians().cos();
        let color = if view.shown { GREEN } else { GRAY };
        dot(reach * c, reach * s, 4, color);
        labels.push((half + reach * c + 6.0, half - reach * s - 4.0, format!("{}", i + 1)));
    }
    for (x, y, label) in labels {
        text(sheet, left + x.max(0.0) as u32, top + LINE + y.max(0.0) as u32, &label, INK);
    }
    text(sheet, left + 4, top + 2, "CAMERAS FROM ABOVE", INK);
}

/// Letters of three by five dots, row by row, each row an octal digit; for A to Z, 0 to 9 and some signs.
const LETTERS: [&str; 26] = [
    "25755", "65656", "34443", "65556", "74647", "74644", "34553", "55755", "72227", "11152", "55655", "44447",
    "57755", "65555", "25552", "65644", "25563", "65655", "34216", "72222", "55557", "55552", "55775", "55255",
    "55222", "71247",
];
const DIGITS: [&str; 10] = ["75557", "26227", "71747", "71717", "55711", "74717", "74757", "71111", "75757", "75717"];

/// Writes a line, each dot two pixels wide, as far as there is room.
fn text(sheet: &mut RgbaImage, x: u32, y: u32, line: &str, ink: Rgba<u8>) {
    for (i, c) in line.chars().enumerate() {
        let glyph = match c.to_ascii_uppercase() {
            c @ 'A'..='Z' => LETTERS[c as usize - 'A' as usize],
            c @ '0'..='9' => DIGITS[c as usize - '0' as usize],
            '.' => "00002",
            ',' => "00024",
            '-' => "00700",
            '_' => "00007",
            '%' => "41241",
            ':' => "02020",
            '(' => "12221",
            ')' => "42224",
            '/' => "11244",
            _ => "00000",
        };
        for (row, digit) in glyph.bytes().enumerate() {
            for column in (0..3).filter(|column| (digit - b'0') >> (2 - column) & 1 == 1) {
                for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                    let (px, py) = (x + 8 * i as u32 + 2 * column + dx, y + 2 * row as u32 + dy);
                    if px < sheet.width() && py < sheet.height() {
                        sheet.put_pixel(px, py, ink);
                    }
                }
            }
        }
    }
}
