//! glTF's accessors: numbers in buffers, of several types, and sparse ones.

use std::borrow::Cow;

use freerange_util::Invalid;
use serde::Deserialize;

use crate::formats::{
    bytes::check_expansion,
    glb::{FLOAT, UNSIGNED_BYTE},
};

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    #[serde(default)]
    normalized: bool,
    count: usize,
    r#type: String,
    sparse: Option<Sparse>,
}

/// Elements that differ from those of the view, or from zero where there is none.
#[derive(Deserialize)]
struct Sparse {
    count: usize,
    indices: Numbers,
    values: Numbers,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Numbers {
    buffer_view: usize,
    #[serde(default)]
    byte_offset: usize,
    /// Of indices; values have the accessor's.
    #[serde(default)]
    component_type: u32,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct View {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
    #[serde(default)]
    extensions: std::collections::HashMap<String, serde_json::Value>,
}

/// What is wrong with an attribute: what was expected, what was found.
type Wrong<'a> = &'a dyn Fn(&str, &dyn std::fmt::Display) -> Invalid;

/// Signed integers, of which an accessor's components may be.
const BYTE: u32 = 5120;
const SHORT: u32 = 5122;
const UNSIGNED_SHORT: u32 = 5123;
const UNSIGNED_INT: u32 = 5125;

/// Where a run of elements lies.
struct Run {
    view: usize,
    offset: usize,
    count: usize,
    /// Bytes of an element.
    element: usize,
}

impl Accessor {
    /// All numbers, one element after the other; `kind` is the type of elements, `size` the bytes of the file.
    pub fn numbers(
        &self,
        kind: &str,
        views: &[View],
        buffers: &[Cow<'_, [u8]>],
        size: usize,
        wrong: Wrong,
    ) -> Result<Vec<f32>, Invalid> {
        if self.r#type != kind {
            return Err(wrong(kind, &self.r#type));
        }
        // Of the component: bytes, and what to divide by where it stands for 0..1 or -1..1.
        let (bytes, whole) = match self.component_type {
            BYTE => (1, 127.0),
            UNSIGNED_BYTE => (1, 255.0),
            SHORT => (2, 32767.0),
            UNSIGNED_SHORT => (2, 65535.0),
            FLOAT => (4, 1.0),
            other => return Err(wrong("a component type of 5120 to 5123 or 5126", &other)),
        };
        let components = match kind {
            "VEC4" => 4,
            "VEC3" => 3,
            _ => 1,
        };
        let divisor = if self.normalized { whole } else { 1.0 };
        let least = if self.normalized { -1.0 } else { f32::NEG_INFINITY };
        let component = |b: &[u8]| match self.component_type {
            BYTE => (f32::from(b[0] as i8) / divisor).max(least),
            UNSIGNED_BYTE => f32::from(b[0]) / divisor,
            SHORT => (f32::from(i16::from_le_bytes([b[0], b[1]])) / divisor).max(least),
            UNSIGNED_SHORT => f32::from(u16::from_le_bytes([b[0], b[1]])) / divisor,
            _ => f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
        };
        let read = |run: Run| -> Result<Vec<f32>, Invalid> {
            let elements = elements(&run, views, buffers, wrong)?;
            Ok(elements.flat_map(|e| e.chunks_exact(bytes).map(component)).collect())
        };
        let element = bytes * components;
        let mut numbers = match self.buffer_view {
            Some(view) => read(Run { view, offset: self.byte_offset, count: self.count, element })?,
            None if self.sparse.is_some() => {
                let count = check_expansion("sparse accessor, count", self.count as u64, 4 * components, size)?;
                vec![0.0; components * count]
            }
            None => return Err(wrong("a buffer view", &"none")),
        };
        if let Some(sparse) = &self.sparse {
            let values = &sparse.values;
            let values = Run { view: values.buffer_view, offset: values.byte_offset, count: sparse.count, element };
            let values = read(values)?;
            for (index, value) in
                sparse.indices(views, buffers, wrong)?.into_iter().zip(values.chunks_exact(components))
            {
                let Some(target) = numbers.chunks_exact_mut(components).nth(index) else {
                    return Err(wrong(&format!("sparse indices below {}", self.count), &index));
                };
                target.copy_from_slice(value);
            }
        }
        Ok(numbers)
    }
}

impl Sparse {
    fn indices(&self, views: &[View], buffers: &[Cow<'_, [u8]>], wrong: Wrong) -> Result<Vec<usize>, Invalid> {
        let element = match self.indices.component_type {
            UNSIGNED_BYTE => 1,
            UNSIGNED_SHORT => 2,
            UNSIGNED_INT => 4,
            other => return Err(wrong("sparse indices of component type 5121, 5123 or 5125", &other)),
        };
        let run = Run { view: self.indices.buffer_view, offset: self.indices.byte_offset, count: self.count, element };
        let index = |bytes: &[u8]| bytes.iter().rev().fold(0, |sum, b| sum << 8 | usize::from(*b));
        Ok(elements(&run, views, buffers, wrong)?.map(index).collect())
    }
}

/// The bytes of each element, all within their buffer.
fn elements<'a>(
    run: &Run,
    views: &[View],
    buffers: &'a [Cow<'_, [u8]>],
    wrong: Wrong,
) -> Result<impl Iterator<Item = &'a [u8]> + use<'a>, Invalid> {
    let &Run { view, offset, count, element } = run;
    let Some(view) = views.get(view) else { return Err(wrong("the number of a buffer view", &view)) };
    if let Some(other) = view.extensions.keys().next() {
        return Err(wrong("a buffer view without extensions", other));
    }
    let Some(buffer) = buffers.get(view.buffer) else { return Err(wrong("the number of a buffer", &view.buffer)) };
    let stride = view.byte_stride.unwrap_or(element);
    if stride < element {
        return Err(wrong("a byteStride of at least one element", &stride));
    }
    // Everything below is checked against the bytes that are there.
    let slice = view.byte_offset.checked_add(view.byte_length).and_then(|end| buffer.get(view.byte_offset..end));
    let length = match count.checked_sub(1) {
        None => Some(0),
        Some(before) => before.checked_mul(stride).and_then(|b| b.checked_add(element)),
    };
    let end = length.and_then(|length| offset.checked_add(length));
    let slice = slice.zip(end).and_then(|(slice, end)| slice.get(offset..end));
    let Some(slice) = slice else {
        return Err(wrong("bytes within the buffer", &format!("{count} elements beyond its end")));
    };
    Ok(slice.chunks(stride).take(count).map(move |e| &e[..element]))
}
