//! Photos that are held out for comparison.

use std::collections::BTreeSet;

use freerange::View;

use crate::error::CliError;

/// Which photos.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Holdout {
    /// The first of each so many.
    Every(usize),
    /// Those of these names.
    Names(Vec<String>),
}

impl Holdout {
    /// Photos by their names; no names are no photos.
    pub fn of(names: &[String]) -> Result<Self, CliError> {
        let names: Vec<String> = names.iter().map(|n| n.trim().to_owned()).collect();
        match names.iter().any(String::is_empty) {
            true => Err(CliError::input("--holdout: expected names of photos, found an empty one")),
            false => Ok(Self::Names(names)),
        }
    }

    /// Takes the photos out of `views`. At least two stay.
    pub fn take(&self, views: &mut Vec<View>) -> Result<Vec<View>, CliError> {
        let all = views.len();
        let (option, out): (&str, BTreeSet<usize>) = match self {
            Self::Every(n) => ("--holdout-every", (0..all).step_by(*n).collect()),
            Self::Names(names) => ("--holdout", names.iter().map(|name| place(name, views)).collect::<Result<_, _>>()?),
        };
        if out.is_empty() {
            return Ok(Vec::new());
        }
        let (most, found) = (all.saturating_sub(2), out.len());
        if found > most {
            let problem = format!("{option}: expected at most {most} of {all} photos held out, found {found}");
            return Err(CliError::input(problem));
        }
        let (mut held, mut kept) = (Vec::new(), Vec::new());
        for (i, view) in std::mem::take(views).into_iter().enumerate() {
            if out.contains(&i) { held.push(view) } else { kept.push(view) }
        }
        *views = kept;
        Ok(held)
    }
}

/// The view of this name, with or without its extension.
fn place(name: &str, views: &[View]) -> Result<usize, CliError> {
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    let found = [name, stem].into_iter().find_map(|n| views.iter().position(|v| v.name == n));
    found.ok_or_else(|| {
        let names: Vec<&str> = views.iter().take(12).map(|v| v.name.as_str()).collect();
        let more = if views.len() > 12 { ", ..." } else { "" };
        CliError::input(format!("--holdout: expected names of photos ({}{more}), found {name:?}", names.join(", ")))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use freerange::Camera;
    use glam::DVec3;

    fn views(count: usize) -> Vec<View> {
        let camera = Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, 1.0, 4, 4);
        let image = image::RgbaImage::new(4, 4);
        (0..count).map(|i| View { name: format!("{i:03}"), camera, image: image.clone() }).collect()
    }

    fn held(holdout: Result<Holdout, CliError>, count: usize) -> Result<(Vec<String>, usize), String> {
        let mut left = views(count);
        let out = holdout.and_then(|h| h.take(&mut left)).map_err(|e| e.to_string())?;
        Ok((out.into_iter().map(|v| v.name).collect(), left.len()))
    }

    fn named(names: &[&str]) -> Result<Holdout, CliError> {
        Holdout::of(&names.iter().map(|n| (*n).to_owned()).collect::<Vec<_>>())
    }

    #[test]
    fn photos_are_taken_by_number_or_name() {
        assert_eq!(held(Ok(Holdout::Every(4)), 9), Ok((vec!["000".into(), "004".into(), "008".into()], 6)));
        assert_eq!(held(Ok(Holdout::Every(8)), 5), Ok((vec!["000".into()], 4)));
        assert_eq!(held(named(&["003.jpg", " 001"]), 5), Ok((vec!["001".into(), "003".into()], 3)));
        // A name given twice is one photo, and none are none.
        assert_eq!(held(named(&["004", "004"]), 5).unwrap().1, 4);
        assert_eq!(held(named(&[]), 5), Ok((vec![], 5)));
    }

    #[test]
    fn what_cannot_be_held_out_is_refused() {
        assert!(held(Ok(Holdout::Every(2)), 3).unwrap_err().contains("--holdout-every: expected at most 1 of 3"));
        assert!(held(named(&["000", "001"]), 3).unwrap_err().contains("--holdout: expected at most 1 of 3"));
        let text = held(named(&["002", "door"]), 5).unwrap_err();
        assert!(text.contains("001, 002") && text.contains("\"door\""), "{text}");
        assert!(held(named(&["002", ""]), 5).unwrap_err().contains("empty"));
    }
}
