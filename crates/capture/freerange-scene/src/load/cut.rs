//! Views without what is around the object: by mask files, alpha, a plain backdrop, a network, or poses and colors.

use super::{LoadConfig, MaskKind, MaskSource, memory};
use crate::camera::{
    View,
    scene::{Backdrop, find_backdrop},
};
use crate::{
    SceneError,
    estimate::{self, Estimate, Hints},
    mask_model::MaskModel,
};
use freerange_util::{Invalid, Note, Stop};
use image::{GrayImage, Rgba, RgbaImage};
use rayon::prelude::*;

fn opaque(image: &RgbaImage) -> bool {
    image.pixels().all(|p| p[3] == 255)
}

/// The plain backdrop of a view.
pub(super) fn plain(view: &View) -> Result<Backdrop, SceneError> {
    find_backdrop(&view.image).map_err(|found| SceneError::Mask {
        name: view.name.clone(),
        expected: "an alpha channel, or one plain color behind the object".into(),
        found,
    })
}

/// Cuts the object out of views that are in memory, as [`load`](super::load) does by default: those with transparency keep it, a plain background is
/// cut away; where neither is there, poses and colors tell. Returns what was done, for the user to read. `stop` ends it early.
pub fn cut(views: &mut [View], hints: &Hints, stop: &Stop) -> Result<Vec<Note>, SceneError> {
    let told: Vec<Told> = views.iter().map(|v| Told { mask: None, alpha: !opaque(&v.image) }).collect();
    let mut notes = Vec::new();
    let config = LoadConfig { hints: *hints, stop: stop.clone(), ..LoadConfig::default() };
    cut_all(views, &told, &config, &mut notes)?;
    Ok(notes)
}

/// What a picture itself says of the object.
pub(super) struct Told {
    pub mask: Option<GrayImage>,
    /// As `Picture::alpha`.
    pub alpha: bool,
}

/// Gives the views their masks.
pub(super) fn cut_all(
    views: &mut [View],
    told: &[Told],
    config: &LoadConfig,
    notes: &mut Vec<Note>,
) -> Result<(MaskKind, Option<Estimate>), SceneError> {
    let found = mask_all(views, told, config, notes)?;
    match views.iter().find(|view| view.image.pixels().all(|p| p[3] < 128)) {
        None => Ok(found),
        Some(view) => {
            let expected = "a mask that shows the object".into();
            Err(SceneError::Mask { name: view.name.clone(), expected, found: "one that is empty".into() })
        }
    }
}

/// [`cut_all`], whatever the masks show.
fn mask_all(
    views: &mut [View],
    told: &[Told],
    config: &LoadConfig,
    notes: &mut Vec<Note>,
) -> Result<(MaskKind, Option<Estimate>), SceneError> {
    if told.iter().all(|p| p.mask.is_some()) {
        for (view, picture) in views.iter_mut().zip(told) {
            if let Some(mask) = &picture.mask {
                set_alpha(&mut view.image, mask.as_raw());
            }
        }
        return Ok((MaskKind::Files, None));
    }
    if let MaskSource::Model(model) = &config.masks {
        by_network(views, model, config, notes)?;
        return Ok((MaskKind::Model, None));
    }
    if config.masks != MaskSource::Estimate
        && let Some(kind) = by_alpha_or_backdrop(views, told, config, notes)?
    {
        return Ok((kind, None));
    }
    memory::check_estimate(views, config)?;
    let mut estimate = estimate::masks_until(views, &config.hints, &config.stop)?;
    // From here on they are the views' own.
    for (view, alpha) in views.iter_mut().zip(std::mem::take(&mut estimate.alpha)) {
        set_alpha(&mut view.image, &alpha);
    }
    notes.push(Note::understood(format!(
        "the object was cut out from poses and colors, {:.0} % sure (views agree to {:.0} % at least)",
        100.0 * estimate.sureness(),
        100.0 * estimate.agreement.iter().copied().fold(1.0, f64::min)
    )));
    notes.extend(estimate.notes.iter().map(Note::understood));
    Ok((MaskKind::Estimate, Some(estimate)))
}

fn by_network(
    views: &mut [View],
    model: &MaskModel,
    config: &LoadConfig,
    notes: &mut Vec<Note>,
) -> Result<(), SceneError> {
    let found = network(model, views)?;
    for (view, alpha) in views.iter_mut().zip(found) {
        set_alpha(&mut view.image, &alpha);
    }
    notes.push(Note::understood(format!("the object was cut out by {}", model.file.display())));
    let mut names = Vec::new();
    let confirmed = estimate::confirmed(views, &config.hints).unwrap_or_default();
    for (view, keep) in views.iter_mut().zip(confirmed) {
        if let Some(keep) = keep {
            set_alpha(&mut view.image, &keep);
            names.push(view.name.clone());
        }
    }
    if !names.is_empty() {
        notes.push(Note::changed(format!("what only {} marked beside the object was taken away", names.join(", "))));
    }
    Ok(())
}

/// Alpha where there is one, else a plain background; none where neither is there and nobody asked for it.
fn by_alpha_or_backdrop(
    views: &mut [View],
    told: &[Told],
    config: &LoadConfig,
    notes: &mut Vec<Note>,
) -> Result<Option<MaskKind>, SceneError> {
    let with_alpha = told.iter().filter(|p| p.alpha).count();
    // Where the backdrops are: a quarter of the memory that cut out photos would take, as long as some may have none.
    let tried: Result<Vec<Option<Backdrop>>, SceneError> = views
        .par_iter()
        .zip(told)
        .map(|(view, picture)| match (picture.alpha, &config.masks) {
            _ if config.stop.check().is_err() => config.stop.check().map(|()| None).map_err(SceneError::from),
            (true, MaskSource::Auto | MaskSource::Alpha) => Ok(None),
            (false, MaskSource::Alpha) => Err(SceneError::Mask {
                name: view.name.clone(),
                expected: "an alpha channel".into(),
                found: "an opaque image".into(),
            }),
            _ => plain(view).map(Some),
        })
        .collect();
    match tried {
        Ok(backdrops) => {
            let cut = backdrops.iter().flatten().count();
            if cut < backdrops.len() {
                let own = backdrops.len() - cut;
                notes.push(Note::understood(format!("masks are the alpha of {own} photos")));
            }
            views.par_iter_mut().zip(backdrops).for_each(|(view, backdrop)| {
                if let Some(backdrop) = backdrop {
                    view.image = backdrop.separate(&view.image);
                }
            });
            if cut > 0 {
                notes.push(Note::understood(format!("the plain background of {cut} photos was cut away")));
            }
            Ok(Some(if cut == views.len() { MaskKind::Plain } else { MaskKind::Alpha }))
        }
        Err(error @ SceneError::Stopped(_)) => Err(error),
        Err(error) if config.masks != MaskSource::Auto || with_alpha > 0 => Err(error),
        Err(_) => Ok(None),
    }
}

#[cfg(feature = "mask-model")]
fn network(model: &MaskModel, views: &[View]) -> Result<Vec<Vec<u8>>, SceneError> {
    crate::network::masks(model, views)
}

#[cfg(not(feature = "mask-model"))]
fn network(model: &MaskModel, _: &[View]) -> Result<Vec<Vec<u8>>, SceneError> {
    let expected = format!("a program built with --features mask-model, to run {}", model.file.display());
    Err(Invalid::new("--mask-model", expected, "one without").into())
}

pub(super) fn set_alpha(image: &mut RgbaImage, alpha: &[u8]) {
    for (pixel, alpha) in image.pixels_mut().zip(alpha) {
        // What the lens did not show stays empty.
        pixel[3] = (u16::from(pixel[3]) * u16::from(*alpha) / 255) as u8;
        if pixel[3] == 0 {
            *pixel = Rgba([0; 4]);
        }
    }
}
