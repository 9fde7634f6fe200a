//! An object under test: its validation views, and which of the others a method is shown.

use std::sync::Arc;

use freerange_scene::camera::{View, ViewSets, inputs_around, inputs_beside};
use freerange_util::hex;
use glam::DVec3;
use sha2::{Digest, Sha256};

use crate::{EvalError, MeshSurface, record::ViewSet};

/// Restarts of k-means.
const RESTARTS: usize = 10;

/// The views of one object and their roles.
#[derive(Clone)]
pub struct EvalObject {
    name: String,
    views: Vec<View>,
    full: Vec<usize>,
    partial: Vec<usize>,
    validation: Vec<usize>,
    /// What inputs are chosen from where a set of that size is not given: no validation view, no place twice.
    candidates: Vec<usize>,
    seed: u64,
    surface: Option<Arc<MeshSurface>>,
}

/// Inputs, or why there are none.
pub type Inputs = Result<Vec<View>, String>;

impl EvalObject {
    /// An object with the view sets that its data names. `seed` is that of k-means, where it is needed.
    ///
    /// # Errors
    /// [`EvalError::Object`] where the sets name views that are not there, an input is a validation view or taken from the
    /// place of one, or there is no validation view.
    pub fn from_sets(name: &str, views: Vec<View>, sets: &ViewSets, seed: u64) -> Result<Self, EvalError> {
        let (full, partial, validation) = (sets.full.clone(), sets.partial.clone(), sets.validation.clone());
        let wrong = |expected: &str, found: String| {
            Err(EvalError::Object { object: name.into(), expected: expected.into(), found })
        };
        let inputs = || full.iter().chain(&partial);
        if let Some(i) = inputs().chain(&validation).find(|&&i| i >= views.len()) {
            return wrong("numbers of views in its view sets", format!("{i} of {} views", views.len()));
        }
        if let Some(i) = inputs().find(|i| validation.contains(i)) {
            return wrong("validation views that are no inputs", format!("view `{}` as both", views[*i].name));
        }
        if validation.is_empty() {
            return wrong("validation views", "none".into());
        }
        let centers: Vec<DVec3> = views.iter().map(|v| v.camera.center()).collect();
        let size = centers.iter().map(|c| c.distance(centers[validation[0]])).fold(0.0, f64::max);
        let same = |a: usize, b: usize| centers[a].distance(centers[b]) <= 1e-6 * size;
        let clash = inputs().find_map(|&i| Some((i, *validation.iter().find(|&&v| same(i, v))?)));
        if let Some((i, v)) = clash {
            let found = format!("input `{}` taken from the place of `{}`", views[i].name, views[v].name);
            return wrong("validation views that are no inputs", found);
        }
        let mut candidates: Vec<usize> = Vec::new();
        // Given inputs first: of two views from one place, theirs stays.
        for i in inputs().copied().chain(0..views.len()) {
            if !validation.iter().chain(&candidates).any(|&j| same(i, j)) {
                candidates.push(i);
            }
        }
        candidates.sort_unstable();
        Ok(Self { name: name.into(), views, full, partial, validation, candidates, seed, surface: None })
    }

    /// An object from posed-image files: the views of each role, and further ones that may become inputs.
    ///
    /// # Errors
    /// As [`from_sets`](Self::from_sets).
    pub fn from_views(
        name: &str,
        full: Vec<View>,
        partial: Vec<View>,
        validation: Vec<View>,
        further: Vec<View>,
    ) -> Result<Self, EvalError> {
        let mut views = Vec::new();
        let mut add = |more: Vec<View>| {
            let first = views.len();
            views.extend(more);
            (first..views.len()).collect::<Vec<usize>>()
        };
        let (full, partial, validation) = (add(full), add(partial), add(validation));
        add(further);
        Self::from_sets(name, views, &ViewSets { labels: Vec::new(), full, partial, validation }, 0)
    }

    /// The same object with its true surface, in the frame of its cameras.
    #[must_use]
    pub fn with_surface(self, surface: MeshSurface) -> Self {
        Self { surface: Some(Arc::new(surface)), ..self }
    }

    /// Its true surface, where that is known.
    pub fn surface(&self) -> Option<&MeshSurface> {
        self.surface.as_deref()
    }

    /// What it is called.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The views that score.
    pub fn validation(&self) -> Vec<View> {
        self.take(&self.validation)
    }

    /// `count` input views: the set that the data names where it has that size; else chosen among all views that do not
    /// score, by k-means (`Full`) or by nearness to the named set (`Partial`). An error says what is lacking.
    pub fn inputs(&self, views: ViewSet, count: usize) -> Inputs {
        let named = match views {
            ViewSet::Full => &self.full,
            ViewSet::Partial => &self.partial,
        };
        let centers: Vec<DVec3> = self.views.iter().map(|v| v.camera.center()).collect();
        let chosen = if named.len() == count {
            named.clone()
        } else if named.is_empty() && views == ViewSet::Partial {
            return Err("its data names no partial set".into());
        } else {
            let chosen = match views {
                ViewSet::Full => inputs_around(&centers, &self.candidates, count, RESTARTS, self.seed),
                ViewSet::Partial => inputs_beside(&centers, &self.candidates, named, count),
            };
            chosen.map_err(|e| e.to_string())?
        };
        Ok(self.take(&chosen))
    }

    /// SHA-256, hexadecimal, over the validation images and their cameras.
    pub fn validation_sha256(&self) -> String {
        let mut hash = Sha256::new();
        for &i in &self.validation {
            let (camera, image) = (&self.views[i].camera, &self.views[i].image);
            hash.update(camera.width.to_le_bytes());
            hash.update(camera.height.to_le_bytes());
            for value in [camera.fx, camera.fy, camera.cx, camera.cy] {
                hash.update(value.to_le_bytes());
            }
            for value in camera.world_to_camera.to_cols_array() {
                hash.update(value.to_le_bytes());
            }
            hash.update(image.as_raw());
        }
        hex(&hash.finalize())
    }

    fn take(&self, indices: &[usize]) -> Vec<View> {
        indices.iter().map(|&i| self.views[i].clone()).collect()
    }
}

#[cfg(test)]
mod tests {
    use freerange_scene::camera::Camera;
    use image::RgbaImage;

    use super::*;

    fn view(degrees: f64, width: u32) -> View {
        let eye = DVec3::new(degrees.to_radians().cos(), degrees.to_radians().sin(), 0.2) * 2.0;
        let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.8, width, 8);
        View { name: format!("{degrees}"), camera, image: RgbaImage::new(width, 8) }
    }

    fn views(degrees: &[f64]) -> Vec<View> {
        degrees.iter().map(|&d| view(d, 8)).collect()
    }

    fn names(inputs: Inputs) -> Vec<String> {
        inputs.unwrap().into_iter().map(|v| v.name).collect()
    }

    fn object() -> EvalObject {
        let (full, partial) = (views(&[0.0, 90.0, 180.0, 270.0]), views(&[0.0, 10.0, 20.0, 30.0]));
        let further = views(&[0.0, 45.0, 5.0, 135.0, 225.0]); // the first and the second are there already
        EvalObject::from_views("o", full, partial, views(&[45.0, 200.0]), further).unwrap()
    }

    #[test]
    fn named_sets_are_kept_and_others_avoid_validation_views_and_doubles() {
        let o = object();
        assert_eq!(names(o.inputs(ViewSet::Full, 4)), ["0", "90", "180", "270"]);
        assert_eq!(names(o.inputs(ViewSet::Partial, 4)), ["0", "10", "20", "30"]);
        // Ten places: 0 90 180 270, 10 20 30, 5 135 225; 45 scores.
        let all = names(o.inputs(ViewSet::Full, 10));
        assert_eq!(all.len(), 10);
        assert!(!all.contains(&"45".into()) && all.iter().filter(|n| *n == "0").count() == 1);
        assert!(o.inputs(ViewSet::Full, 11).is_err());
        assert_eq!(names(o.inputs(ViewSet::Partial, 5)).len(), 5);
        let lacking = o.inputs(ViewSet::Partial, 6).unwrap_err();
        assert!(lacking.contains('6') && lacking.contains('5'), "{lacking}");
        assert_eq!(names(o.inputs(ViewSet::Partial, 2)), ["10", "20"]);
    }

    #[test]
    fn what_validates_has_one_hash_and_every_change_another() {
        let o = object();
        assert_eq!(o.validation_sha256(), object().validation_sha256());
        let mut other = object();
        other.views[o.validation[1]].image.put_pixel(3, 3, image::Rgba([1, 0, 0, 0]));
        assert_ne!(o.validation_sha256(), other.validation_sha256());
        let mut other = object();
        other.views[o.validation[0]].camera.fx += 1e-9;
        assert_ne!(o.validation_sha256(), other.validation_sha256());
    }

    #[test]
    fn impossible_sets_are_refused_with_the_views_name() {
        let sets = |full: &[usize], validation: &[usize]| ViewSets {
            labels: Vec::new(),
            full: full.to_vec(),
            partial: Vec::new(),
            validation: validation.to_vec(),
        };
        let make = |sets: &ViewSets| EvalObject::from_sets("o", views(&[0.0, 90.0, 180.0]), sets, 0);
        for bad in [sets(&[0, 3], &[1]), sets(&[0, 1], &[1]), sets(&[0], &[])] {
            assert!(matches!(make(&bad), Err(EvalError::Object { .. })), "{bad:?}");
        }
        assert!(make(&sets(&[0, 1], &[2])).unwrap().inputs(ViewSet::Partial, 2).is_err());
        let o = EvalObject::from_views("o", vec![view(0.0, 8), view(9.0, 9)], vec![], views(&[50.0]), vec![]).unwrap();
        assert_eq!(names(o.inputs(ViewSet::Full, 2)), ["0", "9"], "inputs may be of any size");
        let uneven = EvalObject::from_views("o", vec![], vec![], vec![view(0.0, 8), view(90.0, 9)], vec![]).unwrap();
        assert_eq!(uneven.validation().iter().map(|v| v.image.width()).collect::<Vec<_>>(), [8, 9]);
    }
}
