//! A red ball before something, photographed: files as programs leave them, and what must come of them.

#![allow(dead_code)] // tests take different parts

use freerange_scene::camera::{Camera, Lens, View};
use freerange_scene::{
    LoadConfig, Loaded, Note, NoteKind, SceneError, load,
    read::{Cameras, cameras},
};
use glam::{DMat3, DMat4, DVec3, DVec4};
use image::{GrayImage, Luma, Rgba, RgbaImage};
use serde_json::{Value, json};
use std::path::PathBuf;
use tempfile::TempDir;

pub const W: u32 = 96;
pub const H: u32 = 72;
/// The object is a ball about the origin.
pub const BALL: f64 = 0.35;

/// Camera number `i` of `n` around the ball.
pub fn camera(i: usize, n: usize) -> Camera {
    let a = std::f64::consts::TAU * i as f64 / n as f64;
    Camera::look_at(DVec3::new(2.0 * a.cos(), 2.0 * a.sin(), 0.7), DVec3::ZERO, DVec3::Z, 0.8, W, H)
}

/// Whether the ray through a pixel hits the ball.
pub fn hit(camera: &Camera, x: f64, y: f64) -> bool {
    camera.center().cross(camera.ray_direction(x, y)).length() < BALL
}

/// What a camera sees: the red ball before `behind`.
pub fn shot(camera: &Camera, behind: impl Fn(u32, u32) -> [u8; 4]) -> RgbaImage {
    RgbaImage::from_fn(camera.width, camera.height, |x, y| match hit(camera, f64::from(x) + 0.5, f64::from(y) + 0.5) {
        true => Rgba([200, 30, 20, 255]),
        false => Rgba(behind(x, y)),
    })
}

pub const WHITE: [u8; 4] = [252, 252, 252, 255];

/// A background of many colors, other in each photo.
pub fn busy(i: usize) -> impl Fn(u32, u32) -> [u8; 4] {
    move |x, y| [(x as usize * 37 * (i + 1) % 200) as u8, (y as usize * 91 % 200) as u8, (40 * i) as u8, 255]
}

pub fn outline(camera: &Camera) -> GrayImage {
    GrayImage::from_fn(camera.width, camera.height, |x, y| {
        Luma([if hit(camera, f64::from(x) + 0.5, f64::from(y) + 0.5) { 255 } else { 0 }])
    })
}

pub struct Capture(pub TempDir);

impl Capture {
    pub fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    pub fn at(&self, name: &str) -> PathBuf {
        let path = self.0.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        path
    }

    /// A `transforms.json` of these cameras and files.
    pub fn describe(&self, frames: &[(&str, Camera)], fields: Value) {
        let flip = DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0));
        let frames: Vec<Value> = frames
            .iter()
            .map(|(path, c)| {
                let m = c.world_to_camera.inverse() * flip;
                let rows: Vec<[f64; 4]> = (0..4).map(|i| m.row(i).to_array()).collect();
                json!({"file_path": path, "transform_matrix": rows, "w": c.width, "h": c.height,
                       "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy})
            })
            .collect();
        let mut root = json!({"frames": frames});
        root.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone());
        std::fs::write(self.at("transforms.json"), root.to_string()).unwrap();
    }

    /// A COLMAP model in text of these cameras and names, and what goes between images.
    pub fn colmap(&self, folder: &str, frames: &[(&str, Camera)], between: &str) {
        let (mut c, mut i) = (String::new(), String::new());
        for (k, (name, camera)) in frames.iter().enumerate() {
            let (q, t) = (
                glam::DQuat::from_mat3(&DMat3::from_mat4(camera.world_to_camera)),
                camera.world_to_camera.w_axis.truncate(),
            );
            let Camera { width, height, fx, fy, cx, cy, .. } = camera;
            c += &format!("{k} PINHOLE {width} {height} {fx} {fy} {cx} {cy}\n");
            i += &format!("{k} {} {} {} {} {} {} {} {k} {name}\n{between}", q.w, q.x, q.y, q.z, t.x, t.y, t.z);
        }
        std::fs::write(self.at(&format!("{folder}/cameras.txt")), c).unwrap();
        std::fs::write(self.at(&format!("{folder}/images.txt")), i).unwrap();
    }

    pub fn read(&self) -> Cameras {
        cameras(self.0.path(), None, None).unwrap()
    }

    pub fn load(&self) -> Result<Loaded, SceneError> {
        load(&self.read(), &LoadConfig::default())
    }
}

/// Share of a view's pixels that are on the wrong side.
pub fn wrong(view: &View) -> f64 {
    let c = &view.camera;
    let off = view
        .image
        .enumerate_pixels()
        .filter(|(x, y, p)| (p[3] >= 128) != hit(c, f64::from(*x) + 0.5, f64::from(*y) + 0.5));
    off.count() as f64 / (f64::from(c.width) * f64::from(c.height))
}

pub fn assert_right(loaded: &Loaded, least: usize) {
    assert!(loaded.views.len() >= least);
    for view in loaded.views.iter().chain(&loaded.further) {
        assert!(wrong(view) < 0.01, "{}: {:.3}", view.name, wrong(view));
    }
}

#[track_caller]
pub fn tells(notes: &[Note], kind: NoteKind, words: &[&str]) {
    let found = notes.iter().any(|n| n.kind == kind && words.iter().all(|w| n.contains(w)));
    assert!(found, "expected {kind:?} with {words:?} in {notes:?}");
}

#[track_caller]
pub fn says<T>(result: Result<T, SceneError>, words: &[&str]) {
    let text = result.err().expect("an error").to_string();
    words.iter().for_each(|w| assert!(text.contains(w), "expected {w:?} in: {text}"));
}

pub const NAMES: [&str; 4] = ["images/a.png", "images/b.png", "images/c.png", "images/d.png"];

pub fn ring() -> Vec<(&'static str, Camera)> {
    NAMES.into_iter().enumerate().map(|(i, name)| (name, camera(i, 4))).collect()
}

/// A model of wide lenses whose axes are turned away from the ball by so many degrees, and its photos.
pub fn wide(model: &str, params: &str, lens: Lens, away: f64, behind: [u8; 4]) -> Capture {
    wide_from(model, params, lens, DMat4::from_rotation_y(away.to_radians()), 1.0, behind)
}

/// The same with any turn, and with cameras at this share of the usual distance.
pub fn wide_from(model: &str, params: &str, lens: Lens, turn: DMat4, near: f64, behind: [u8; 4]) -> Capture {
    let capture = Capture::new();
    let (side, half) = (400.0, 200.0);
    let focal = if lens == Lens::Equirectangular { side / std::f64::consts::TAU } else { 105.0 };
    let down = if lens == Lens::Equirectangular { side / std::f64::consts::PI } else { focal };
    let (mut c, mut i) = (String::new(), String::new());
    for k in 0..4 {
        let mut pose = camera(k, 4).world_to_camera;
        pose.w_axis = (near * pose.w_axis.truncate()).extend(1.0);
        let pose = turn * pose;
        let pinhole = Camera { world_to_camera: pose, ..camera(k, 4) };
        let back = DMat3::from_mat4(pose).transpose();
        let image = RgbaImage::from_fn(400, 400, |x, y| {
            let (u, v) = ((f64::from(x) + 0.5 - half) / focal, (f64::from(y) + 0.5 - half) / down);
            let ray = lens.ray(u, v).map(|r| back * r);
            let hit = ray.is_some_and(|r| pinhole.center().cross(r).length() < BALL && r.dot(pinhole.center()) < 0.0);
            Rgba(if hit { [200, 30, 20, 255] } else { behind })
        });
        image.save(capture.at(&format!("images/{k}.png"))).unwrap();
        let (q, t) = (glam::DQuat::from_mat3(&DMat3::from_mat4(pose)), pose.w_axis.truncate());
        c += &format!("{k} {model} 400 400 {params}\n");
        i += &format!("{k} {} {} {} {} {} {} {} {k} {k}.png\n\n", q.w, q.x, q.y, q.z, t.x, t.y, t.z);
    }
    std::fs::write(capture.at("sparse/0/cameras.txt"), c).unwrap();
    std::fs::write(capture.at("sparse/0/images.txt"), i).unwrap();
    capture
}
