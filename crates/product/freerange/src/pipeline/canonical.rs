//! Step 1, canonicalize. In: views in the user's frame. Out: the same in the canonical frame (the object within radius 0.5
//! about the origin, +z up), cropped to squares about the object, and the choice of those that the network sees. Pixels stay
//! with the user: whoever compares with them copies what it needs, at the size that it needs.
//!
//! Masks and cameras give a first frame; where the scene does not already lie in the canonical one, a short fit corrects it
//! (docs/research/experiments/initial-fits.md). Cost: a third of a second for that fit.

use freerange_gaussians::Gaussians;
use freerange_optim::{PosedImage, frame_of, initial_fit};
use freerange_scene::camera::{Camera, Similarity, View, Window};
use freerange_util::Note;

use super::watch::Watch;
use crate::{Detect, Error, Options, Stage, choose_views, error::Lift, frame};

/// One of the user's photos in the canonical frame, cropped.
#[derive(Clone, Copy)]
pub(crate) struct Photo<'v> {
    view: &'v View,
    /// The part of it that is used; none: all of it.
    window: Option<Window>,
    /// The camera of that part.
    camera: Camera,
}

impl<'v> Photo<'v> {
    /// `view`, whose camera in the canonical frame is `camera`.
    fn new(view: &'v View, camera: Camera) -> Self {
        let window = Window::framed_in(&camera, &view.image);
        Self { view, window, camera: window.map_or(camera, |window| window.camera(&camera)) }
    }

    /// Without a copy of its pixels.
    pub fn posed(&self) -> PosedImage<'v> {
        PosedImage { camera: self.camera, window: self.window, ..self.view.into() }
    }

    /// As a view of its own.
    pub fn view(&self) -> View {
        let image = self.window.map_or_else(|| self.view.image.clone(), |window| window.image(&self.view.image));
        View { name: self.view.name.clone(), camera: self.camera, image }
    }
}

/// The views of an object in the canonical frame.
pub(crate) struct CanonicalScene<'v> {
    /// All of them.
    pub photos: Vec<Photo<'v>>,
    /// Which of them the network sees, ascending.
    pub network_views: Vec<usize>,
    /// From the frame of the views to the canonical one.
    pub canonical_from_user: Similarity,
    /// What the user should know.
    pub notes: Vec<Note>,
    /// An initial fit of the network's views, of seed 0, if there was reason to make one.
    pub fit: Option<Gaussians>,
}

impl<'v> CanonicalScene<'v> {
    /// Checks the views and takes them to the canonical frame.
    pub fn new(views: &'v [View], options: &Options, watch: &mut Watch<'_>) -> Result<Self, Error> {
        check_views(views)?;
        let config = &options.pipeline;
        watch.report(Stage::Canonicalize, [0, 1], None, None)?;
        let frame = frame::place(views, &options.frame)?;
        let place = &frame.canonical_from_user;
        let photos: Vec<Photo<'_>> =
            views.iter().map(|view| Photo::new(view, view.camera.transformed(place))).collect();
        let mut notes: Vec<Note> = frame.notes.into_iter().map(Note::understood).collect();
        let cropped = photos.iter().filter(|photo| photo.window.is_some()).count();
        let all = views.len();
        if cropped > 0 {
            notes.push(Note::changed(format!("{cropped} of {all} views are cropped to squares about the object")));
        }
        let network_views = choose_views(views, config.network_views)?;
        let seen = network_views.len();
        if seen < all {
            let names: Vec<&str> = network_views.iter().map(|&i| views[i].name.as_str()).collect();
            notes.push(Note::understood(format!("the network sees {seen} of {all} views: {}", names.join(", "))));
        }
        let uneven = network_views.iter().map(|&i| &photos[i].camera).filter(|c| c.width != c.height).count();
        if uneven > 0 {
            notes.push(Note::changed(format!(
                "{uneven} of {seen} views of the network are not square: it sees squares, cropped or padded"
            )));
        }
        let canonical_from_user = frame.canonical_from_user;
        let mut scene = Self { photos, network_views, canonical_from_user, notes, fit: None };
        // Models that begin with fits know objects where fits put them.
        let fitted = config.refine.is_some() || options.init.is_some();
        if fitted && (!frame.kept || config.symmetry.detect == Detect::Auto) {
            let fit = &config.propose.fit;
            let shown = scene.network_views();
            let place = &scene.canonical_from_user;
            let found = watch
                .fit(Stage::Canonicalize, fit.iterations, place, |progress| initial_fit(&shown, fit, 0, progress))?;
            scene.fit = Some(found);
            if !frame.kept {
                scene.recenter(&shown)?;
            }
        }
        Ok(scene)
    }

    /// The views that the network sees.
    pub fn network_views(&self) -> Vec<View> {
        self.network_views.iter().map(|&i| self.photos[i].view()).collect()
    }

    /// Moves the frame to where the fit says that the object is.
    fn recenter(&mut self, shown: &[View]) -> Result<(), Error> {
        let Some(fit) = &mut self.fit else { return Ok(()) };
        let correction = frame_of(fit, shown).lift()?;
        fit.transform(correction.scale, correction.rotation, correction.translation);
        self.photos.iter_mut().for_each(|photo| photo.camera = photo.camera.transformed(&correction));
        self.canonical_from_user = correction.after(&self.canonical_from_user);
        let (shift, scale) = (correction.translation.length(), correction.scale);
        let text = format!("the initial fit moved the frame by {shift:.3} and scaled it by {scale:.3}");
        self.notes.push(Note::understood(text));
        Ok(())
    }

    /// The user's Gaussians in the canonical frame. Those outside of the object's sphere, with a margin of a fifth, are left
    /// out.
    pub fn user_proposal(&mut self, init: &Gaussians) -> Result<Gaussians, Error> {
        const RADIUS: f64 = 0.6;
        let Similarity { scale, rotation, translation } = self.canonical_from_user;
        let mut cloud = init.clone();
        cloud.transform(scale, rotation, translation);
        let kept: Vec<usize> = (0..cloud.len()).filter(|i| cloud.mean(*i).length() <= RADIUS).collect();
        let (all, left) = (cloud.len(), cloud.len() - kept.len());
        if kept.is_empty() {
            return Err(Error::input("init", "Gaussians where the cameras look", format!("none of {all} there")));
        }
        if left > 0 {
            let text = format!("{left} of {all} Gaussians to begin with lie beside the object, and are left out");
            self.notes.push(Note::dropped(text));
        }
        Ok(cloud.select(kept))
    }
}

/// Refuses views whose parts do not fit each other.
fn check_views(views: &[View]) -> Result<(), Error> {
    for view in views {
        let field = |what: &str| format!("view `{}`: {what}", view.name);
        let (c, (w, h)) = (&view.camera, view.image.dimensions());
        if (c.width, c.height) != (w, h) || w == 0 || h == 0 {
            let expected = format!("{} x {} pixels, as its camera has, and some", c.width, c.height);
            return Err(Error::input(field("image"), expected, format!("{w} x {h}")));
        }
        let finite = [c.fx, c.fy, c.cx, c.cy].iter().all(|x| x.is_finite()) && c.world_to_camera.is_finite();
        if !finite || c.fx <= 0.0 || c.fy <= 0.0 {
            return Err(Error::input(field("camera"), "finite numbers and focal lengths above 0", format!("{c:?}")));
        }
    }
    Ok(())
}
