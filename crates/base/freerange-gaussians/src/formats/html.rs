//! `view.html`: a page that shows the Gaussians. Everything is in it: no network, no other file, no library.
//!
//! The Gaussians are the 14 channels as little-endian floats in base64, in the user's frame; the page turns them about
//! `up`.

use crate::{Gaussians, channel};
use base64::{Engine, engine::general_purpose::STANDARD};
use freerange_util::Invalid;
use glam::DVec3;
use sha2::{Digest, Sha256};

use crate::formats::{
    Decoded, Encoded, Frame,
    error::{CUT_OFF, problem},
    quantize::Row,
};

const PAGE: &str = include_str!("viewer/page.html");
const STYLE: &str = include_str!("viewer/style.css");
const SCRIPT: &str = crate::formats::viewer::SCRIPT;

/// What stands before and after the Gaussians; the page is ours alone, so that this need not be parsed as HTML.
const BEFORE: &str = "<script type=\"application/octet-stream\" id=\"gaussians\" data-up=\"";
const AFTER: &str = "</script>";

pub fn encode(cloud: &Gaussians, frame: Frame) -> Encoded {
    let bytes: Vec<u8> = cloud.rows().iter().flat_map(|v| v.to_le_bytes()).collect();
    let up = frame.up().to_array().map(|v| (v * 1e9).round() / 1e9 + 0.0).map(|v| v.to_string()).join(" ");
    let data = format!("{BEFORE}{up}\">{}{AFTER}", STANDARD.encode(bytes));
    let count = cloud.len().to_string();
    // Nothing runs or loads that is not in this file.
    let hash = |text: &str| format!("'sha256-{}'", STANDARD.encode(Sha256::digest(text)));
    let policy = format!(
        "default-src 'none'; script-src {}; style-src {}; img-src data:; base-uri 'none'; form-action 'none'",
        hash(SCRIPT),
        hash(STYLE)
    );
    let mut page = String::with_capacity(PAGE.len() + STYLE.len() + SCRIPT.len() + data.len());
    let mut rest = PAGE;
    let slots = [
        ("{{policy}}", &policy[..]),
        ("{{style}}", STYLE),
        ("{{count}}", &count),
        ("{{gaussians}}", &data),
        ("{{script}}", SCRIPT),
    ];
    for (slot, text) in slots {
        let (before, after) = rest.split_once(slot).expect("the page has all slots, in this order");
        page += before;
        page += text;
        rest = after;
    }
    page += rest;
    Encoded { bytes: page.into_bytes(), notes: Vec::new() }
}

/// The Gaussians of a page, and the direction that it shows as up.
pub fn decode(bytes: &[u8]) -> Result<(Decoded, Option<DVec3>), Invalid> {
    let wrong = |expected: &'static str, found: &dyn std::fmt::Display| problem("Gaussians", expected, found);
    let page = std::str::from_utf8(bytes).map_err(|e| problem("page", "UTF-8", e))?;
    let start = page.split_once(BEFORE).map(|(_, rest)| rest);
    let found = start.and_then(|rest| rest.split_once("\">"));
    let Some((up, data)) = found.and_then(|(up, rest)| Some((up, rest.split_once(AFTER)?.0))) else {
        let found = match start {
            Some(_) => format!("one that is {CUT_OFF}"),
            None => {
                "another one, or the file is cut off: give the file of Gaussians that it shows, such as a .ply".into()
            }
        };
        return Err(wrong("a page that this program wrote, such as view.html", &found));
    };
    let up: Option<Vec<f64>> = up.split(' ').map(|v| v.parse().ok()).collect();
    let up = up.and_then(|up| <[f64; 3]>::try_from(up).ok()).map(DVec3::from_array);
    let data = STANDARD.decode(data.trim()).map_err(|e| wrong("base64", &e))?;
    if !data.len().is_multiple_of(size_of::<Row>()) {
        return Err(wrong("a multiple of 56 bytes", &data.len()));
    }
    let values = data.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect::<Vec<_>>();
    debug_assert!(values.len().is_multiple_of(channel::COUNT));
    Ok((Decoded { splats: Gaussians::from_rows(values).into(), ..Decoded::default() }, up))
}
