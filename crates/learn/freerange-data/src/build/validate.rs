//! Checks of a configuration before anything is made with it.

use crate::build::input_fit::MIN_VIEWS;
use crate::build::{BuildError, GaussianSource, ObjectConfig};
use crate::layout::{MAX_DEPTH, MAX_FITS, MAX_SIDE, MAX_VIEWS};
use freerange_util::check;

impl ObjectConfig {
    /// Checks every field.
    ///
    /// # Errors
    /// [`BuildError::Config`], [`BuildError::Mesh`] or [`BuildError::Fit`] with the field's name.
    pub fn validate(&self) -> Result<(), BuildError> {
        let views = 1..=MAX_VIEWS;
        check(views.contains(&self.views), "object.views", &format!("1 to {MAX_VIEWS}"), self.views)?;
        let rays = self.samples_per_axis;
        check((1..=16).contains(&rays), "object.samples_per_axis", "1 to 16", rays)?;
        let side = self.cameras.resolution;
        let sides = format!("1 to {MAX_SIDE}");
        check((1..=MAX_SIDE).contains(&side), "object.cameras.resolution", &sides, side)?;
        check(self.input_fits <= MAX_FITS, "object.input_fits", &format!("0 to {MAX_FITS}"), self.input_fits)?;
        if self.input_fits > 0 {
            let expected = format!("at least {MIN_VIEWS} with object.input_fits");
            check(self.views >= MIN_VIEWS, "object.views", &expected, self.views)?;
            let count = self.initial_fit.gaussians;
            check(count.is_power_of_two(), "object.initial_fit.gaussians", "a power of two", count)?;
            self.initial_fit.check()?;
        }
        let s = &self.surface;
        let points = 1..=1usize << MAX_DEPTH;
        check(points.contains(&s.points), "object.surface.points", &format!("1 to 2^{MAX_DEPTH}"), s.points)?;
        for (field, v) in [("object.surface.spread", s.spread), ("object.surface.thickness", s.thickness)] {
            check((1e-6..=1e3).contains(&v), field, "1e-6 to 1000", v)?;
        }
        let opacity = s.opacity > 0.0 && s.opacity < 1.0;
        check(opacity, "object.surface.opacity", "between 0 and 1", s.opacity)?;
        self.generator.validate()?;
        self.cameras.validate()?;
        self.lighting.validate()?;
        if self.gaussians == GaussianSource::Fit {
            self.fit.check()?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::build::tests::tiny_config;

    #[test]
    fn impossible_values_are_named() {
        let refused = |change: &dyn Fn(&mut ObjectConfig), field: &str| {
            let mut config = tiny_config();
            change(&mut config);
            let found = config.validate().unwrap_err().to_string();
            assert!(found.contains(field), "{found}");
        };
        refused(&|c| c.views = 0, "object.views");
        refused(&|c| c.samples_per_axis = 0, "samples_per_axis");
        refused(&|c| c.cameras.resolution = 1 << 20, "resolution");
        refused(&|c| c.cameras.distance = [2.0, 1.0], "distance");
        refused(&|c| c.surface.points = 0, "points");
        refused(&|c| c.surface.spread = f32::NAN, "spread");
        refused(&|c| c.surface.opacity = 1.0, "opacity");
        refused(&|c| c.lighting.rays = 0, "rays");
        refused(&|c| c.generator.upright_share = 2.0, "upright_share");
        let fit = |c: &mut ObjectConfig| {
            c.gaussians = GaussianSource::Fit;
            c.fit.iterations = 0;
        };
        refused(&fit, "iterations");
        tiny_config().validate().unwrap();
        ObjectConfig::default().validate().unwrap();
    }
}
