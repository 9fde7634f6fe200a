//! Photos that are held out for validation.

use std::{collections::BTreeSet, convert::Infallible, str::FromStr};

use freerange::View;

use crate::error::CliError;

/// Which photos.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Holdout {
    /// So many, at even steps through the photos.
    Count(usize),
    /// Those of these names.
    Names(Vec<String>),
}

impl FromStr for Holdout {
    type Err = Infallible;

    /// A whole number is a count; a comma makes a name of it.
    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(match text.parse() {
            Ok(count) => Self::Count(count),
            Err(_) => Self::Names(text.split(',').map(str::trim).filter(|n| !n.is_empty()).map(Into::into).collect()),
        })
    }
}

impl Holdout {
    /// Takes the photos out of `views`. At least two stay.
    pub fn take(&self, views: &mut Vec<View>) -> Result<Vec<View>, CliError> {
        let most = views.len().saturating_sub(2);
        let few = |count: usize| match count <= most {
            true => Ok(()),
            false => {
                let all = views.len();
                Err(CliError::input(format!("--holdout: expected at most {most} of {all} photos, found {count}")))
            }
        };
        let out: BTreeSet<usize> = match self {
            Self::Count(count) => {
                few(*count)?;
                (0..*count).map(|i| (2 * i + 1) * views.len() / (2 * count)).collect()
            }
            Self::Names(names) => names.iter().map(|name| place(name, views)).collect::<Result<_, _>>()?,
        };
        few(out.len())?;
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

    fn held(text: &str, count: usize) -> Result<(Vec<String>, usize), String> {
        let mut left = views(count);
        let out = text.parse::<Holdout>().unwrap().take(&mut left).map_err(|e| e.to_string())?;
        Ok((out.into_iter().map(|v| v.name).collect(), left.len()))
    }

    #[test]
    fn photos_are_taken_by_number_or_name() {
        assert_eq!(held("2", 8), Ok((vec!["002".into(), "006".into()], 6)));
        assert_eq!(held("3", 5), Ok((vec!["000".into(), "002".into(), "004".into()], 2)));
        assert_eq!(held("003.jpg, 001", 5), Ok((vec!["001".into(), "003".into()], 3)));
        // A comma makes a name of a number, and a name given twice is one photo.
        assert_eq!(held("004,", 5), Ok((vec!["004".into()], 4)));
        assert_eq!(held("004,004", 5).unwrap().1, 4);
    }

    #[test]
    fn what_cannot_be_held_out_is_refused() {
        assert!(held("4", 5).unwrap_err().contains("at most 3 of 5 photos, found 4"));
        assert!(held("1000000", 5).unwrap_err().contains("found 1000000"));
        let text = held("002,door", 5).unwrap_err();
        assert!(text.contains("001, 002") && text.contains("\"door\""), "{text}");
    }
}
