//! Checked reading of glTF buffers and accessors.
//!
//! The `gltf` crate's own readers trust offsets and lengths; these check them once, when an accessor is opened.

use std::borrow::Cow;

use gltf::json::accessor::{ComponentType, Type};
use gltf::json::validation::Checked;
use gltf::json::{self, Index};

use super::job::Job;
use crate::mesh::error::MeshError;

/// A parsed glTF file and the bytes of its buffers.
pub struct Document<'a> {
    pub root: json::Root,
    pub buffers: Vec<Cow<'a, [u8]>>,
}

/// Equally spaced values in a buffer. All of them are within `bytes`.
struct Strided<'a> {
    bytes: &'a [u8],
    stride: usize,
    size: usize,
}

impl<'a> Strided<'a> {
    fn at(&self, i: usize) -> Option<&'a [u8]> {
        let start = i.checked_mul(self.stride)?;
        self.bytes.get(start..start.checked_add(self.size)?)
    }
}

/// Values that replace some of an accessor's.
struct Sparse<'a> {
    count: usize,
    index_type: ComponentType,
    indices: Strided<'a>,
    values: Strided<'a>,
}

/// An accessor whose bounds have been checked.
pub struct Accessor<'a> {
    pub count: usize,
    pub component: ComponentType,
    /// Components per value, 1 to 4 (16 for a matrix).
    pub width: usize,
    normalized: bool,
    /// `None` without a buffer view: all zeros.
    dense: Option<Strided<'a>>,
    sparse: Option<Sparse<'a>>,
}

fn component_size(component: ComponentType) -> usize {
    match component {
        ComponentType::I8 | ComponentType::U8 => 1,
        ComponentType::I16 | ComponentType::U16 => 2,
        ComponentType::U32 | ComponentType::F32 => 4,
    }
}

impl Document<'_> {
    /// The bytes of a buffer view and its stride.
    pub fn view(
        &self,
        job: &Job,
        name: &str,
        index: Index<json::buffer::View>,
    ) -> Result<(&[u8], Option<usize>), MeshError> {
        let index = index.value();
        let Some(view) = self.root.buffer_views.get(index) else {
            let views = self.root.buffer_views.len();
            return Err(job.error(format!("{name}.bufferView"), format!("an index below {views}"), index));
        };
        let Some(buffer) = self.buffers.get(view.buffer.value()) else {
            let buffers = self.buffers.len();
            let field = format!("bufferViews[{index}].buffer");
            return Err(job.error(field, format!("an index below {buffers}"), view.buffer.value()));
        };
        let start = view.byte_offset.map_or(0, |o| o.0);
        let bytes = start
            .checked_add(view.byte_length.0)
            .and_then(|end| buffer.get(usize::try_from(start).ok()?..usize::try_from(end).ok()?))
            .ok_or_else(|| {
                let field = format!("bufferViews[{index}]");
                let found = format!("{} bytes from {start}", view.byte_length.0);
                job.error(field, format!("a range within the buffer of {} bytes", buffer.len()), found)
            })?;
        Ok((bytes, view.byte_stride.map(|s| s.0)))
    }

    /// `count` values of `size` bytes from `offset` in a view, spaced by the view's stride if `use_stride`.
    fn strided(
        &self,
        job: &Job,
        name: &str,
        view: Index<json::buffer::View>,
        offset: u64,
        count: usize,
        size: usize,
    ) -> Result<Strided<'_>, MeshError> {
        let (bytes, stride) = self.view(job, name, view)?;
        let stride = stride.unwrap_or(size);
        if stride < size || stride > 252 {
            let field = format!("bufferViews[{}].byteStride", view.value());
            return Err(job.error(field, format!("{size} (the size of an element) to 252"), stride));
        }
        let needed = match count {
            0 => Some(0),
            _ => (count as u64 - 1).checked_mul(stride as u64).and_then(|n| n.checked_add(size as u64)),
        };
        usize::try_from(offset)
            .ok()
            .and_then(|start| bytes.get(start..))
            .filter(|rest| needed.is_some_and(|n| n <= rest.len() as u64))
            .map(|bytes| Strided { bytes, stride, size })
            .ok_or_else(|| {
                let found = format!("{count} elements of {size} bytes, {stride} apart, from byte {offset}");
                job.error(name, format!("elements within the {} bytes of its buffer view", bytes.len()), found)
            })
    }

    /// Opens an accessor: after this, values below `count` can be read.
    pub fn accessor(&self, job: &Job, name: &str, index: Index<json::Accessor>) -> Result<Accessor<'_>, MeshError> {
        let Some(accessor) = self.root.accessors.get(index.value()) else {
            let n = self.root.accessors.len();
            return Err(job.error(name, format!("an accessor index below {n}"), index.value()));
        };
        let name = format!("{name} (accessors[{}])", index.value());
        let Checked::Valid(json::accessor::GenericComponentType(component)) = accessor.component_type else {
            return Err(job.error(format!("{name}.componentType"), "a component type of glTF 2.0", "another"));
        };
        let width = match accessor.type_ {
            Checked::Valid(Type::Scalar) => 1,
            Checked::Valid(Type::Vec2) => 2,
            Checked::Valid(Type::Vec3) => 3,
            Checked::Valid(Type::Vec4) => 4,
            Checked::Valid(Type::Mat4) => 16,
            _ => return Err(job.error(format!("{name}.type"), "SCALAR, VEC2, VEC3, VEC4 or MAT4", "another")),
        };
        let to_usize =
            |n: u64| usize::try_from(n).map_err(|_| job.error(format!("{name}.count"), "a smaller count", n));
        let count = to_usize(accessor.count.0)?;
        let size = width * component_size(component);
        let offset = accessor.byte_offset.map_or(0, |o| o.0);
        let dense = match accessor.buffer_view {
            Some(view) => Some(self.strided(job, &name, view, offset, count, size)?),
            None => None,
        };
        let sparse = match &accessor.sparse {
            None => None,
            Some(sparse) => {
                let Checked::Valid(json::accessor::IndexComponentType(index_type)) = sparse.indices.component_type
                else {
                    return Err(job.error(
                        format!("{name}.sparse.indices.componentType"),
                        "an unsigned type",
                        "another",
                    ));
                };
                let n = to_usize(sparse.count.0)?;
                let (indices, values) = (&sparse.indices, &sparse.values);
                let index_name = format!("{name}.sparse.indices");
                let index_size = component_size(index_type);
                Some(Sparse {
                    count: n,
                    index_type,
                    indices: self.strided(
                        job,
                        &index_name,
                        indices.buffer_view,
                        indices.byte_offset.0,
                        n,
                        index_size,
                    )?,
                    values: self.strided(
                        job,
                        &format!("{name}.sparse.values"),
                        values.buffer_view,
                        values.byte_offset.0,
                        n,
                        size,
                    )?,
                })
            }
        };
        Ok(Accessor { count, component, width, normalized: accessor.normalized, dense, sparse })
    }
}

fn unsigned(component: ComponentType, bytes: &[u8]) -> u32 {
    match (component, bytes) {
        (ComponentType::U8, &[a, ..]) => a.into(),
        (ComponentType::U16, &[a, b, ..]) => u16::from_le_bytes([a, b]).into(),
        (ComponentType::U32, &[a, b, c, d, ..]) => u32::from_le_bytes([a, b, c, d]),
        _ => 0,
    }
}

impl Accessor<'_> {
    /// The bytes of value `i`; `None` for a zero.
    fn bytes(&self, i: usize) -> Option<&[u8]> {
        if let Some(sparse) = &self.sparse {
            // The format wants these indices sorted.
            let index = |k: usize| sparse.indices.at(k).map_or(u32::MAX, |b| unsigned(sparse.index_type, b)) as usize;
            let (mut lo, mut hi) = (0, sparse.count);
            while lo < hi {
                let mid = lo + (hi - lo) / 2;
                if index(mid) < i { lo = mid + 1 } else { hi = mid }
            }
            if lo < sparse.count && index(lo) == i {
                return sparse.values.at(lo);
            }
        }
        self.dense.as_ref()?.at(i)
    }

    /// Value `i` of an unsigned scalar accessor.
    pub fn index(&self, i: usize) -> u32 {
        self.bytes(i).map_or(0, |b| unsigned(self.component, b))
    }

    /// Value `i` as numbers, normalized if the accessor says so; components that it lacks are zero.
    pub fn numbers<const N: usize>(&self, i: usize) -> [f32; N] {
        let mut out = [0.0; N];
        let Some(bytes) = self.bytes(i) else { return out };
        let chunks = bytes.chunks_exact(component_size(self.component)).take(self.width);
        for (value, b) in out.iter_mut().zip(chunks) {
            let (number, most) = match (self.component, b) {
                (ComponentType::I8, &[a]) => (f32::from(a as i8), 127.0),
                (ComponentType::U8, &[a]) => (f32::from(a), 255.0),
                (ComponentType::I16, &[a, b]) => (f32::from(i16::from_le_bytes([a, b])), 32767.0),
                (ComponentType::U16, &[a, b]) => (f32::from(u16::from_le_bytes([a, b])), 65535.0),
                (ComponentType::F32, &[a, b, c, d]) => {
                    *value = f32::from_le_bytes([a, b, c, d]);
                    continue;
                }
                // Kept apart by `expect_kind`.
                _ => (0.0, 1.0),
            };
            *value = if self.normalized { (number / most).max(-1.0) } else { number };
        }
        out
    }

    /// Fails unless the accessor has one of the widths and is not of 32-bit integers.
    pub fn expect_kind(&self, job: &Job, name: &str, widths: &[usize]) -> Result<(), MeshError> {
        if !widths.contains(&self.width) || self.component == ComponentType::U32 {
            let found = format!("{} of {:?}", self.width, self.component);
            return Err(job.error(name, format!("{widths:?} components of 8, 16 bits or floats"), found));
        }
        Ok(())
    }
}
