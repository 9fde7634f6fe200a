//! The rasterizer as kernels for GPUs, through CubeCL. All images of all objects are drawn by one launch of each kernel:
//!
//! 1. `project`: splats and their depth, one thread per Gaussian and image.
//! 2. `sort_blocks`, `rank_and_mark`: the depth order of each image, and for each tile of 16 x 16 pixels one bit per
//!    Gaussian, in that order.
//! 3. `forward`: one cube per tile, one unit per pixel.
//! 4. `backward`: the same tiles, from far to near; sums for each splat by atomic addition.
//! 5. `project_backward`: from these to the 14 channels, one thread per Gaussian, over its views in order.
//!
//! Nothing is read back, and no buffer's size depends on where the Gaussians are. Units of a cube talk through shared memory
//! alone (less than 32 KiB), so that devices with planes of any width, or none, do the same.

mod backward;
mod draw;
mod math;
mod order;
mod project;
#[cfg(all(test, any(feature = "cuda", feature = "metal", feature = "vulkan", feature = "webgpu")))]
mod tests;

use crate::{CHANNELS, job::Job};
use burn::backend::ops::FloatTensorOps;
use burn::tensor::{DType, FloatDType, Shape};
use burn_cubecl::{CubeBackend, kernel::into_contiguous, tensor::CubeTensor};
use cubecl::ir::{ElemType, FloatKind, Type, features::AtomicUsage};
use cubecl::{prelude::*, server::Handle};
use math::FrameLaunch;
use project::{CAMERA, RECORD, SUMS, camera_floats};

/// Width and height of a tile in pixels.
const TILE: usize = 16;
/// Units of a cube: the pixels of a tile.
const THREADS: usize = TILE * TILE;
/// Bytes of a mask word, a float, an index.
const WORD: usize = 4;

/// What the forward pass leaves for the backward pass.
pub struct State {
    cameras: Handle,
    /// See [`draw::forward()`].
    pixels: Handle,
    /// If all images are one group.
    prepared: Option<Prepared>,
}

/// What drawing needs of a group of images.
struct Prepared {
    records: Handle,
    order: Handle,
    mask: Handle,
}

/// Sizes, and how to launch.
struct Plan<'a> {
    job: &'a Job,
    client: Client,
    n: usize,
    images: usize,
    tiles_across: usize,
    tiles: usize,
    words: usize,
    /// Most images per group.
    group: usize,
}

/// Some of the images.
#[derive(Clone, Copy)]
struct Group {
    first: usize,
    images: usize,
}

/// A buffer's handle as an argument of a kernel, for which it has `len` elements.
fn arg(handle: &Handle, len: usize) -> BufferArg {
    // SAFETY: every kernel checks its indices against the sizes that the buffers were made with.
    unsafe { BufferArg::from_raw_parts(handle.clone(), len) }
}

impl<'a> Plan<'a> {
    fn new(gaussians: &CubeTensor, job: &'a Job) -> Self {
        let client = gaussians.client.clone();
        let properties = client.properties();
        let most = properties.hardware.max_units_per_cube as usize;
        assert!(most >= THREADS, "the device runs {most} units per cube, the rasterizer needs {THREADS}");
        let n = gaussians.meta.shape()[1];
        let tiles_across = job.width.div_ceil(TILE);
        let (tiles, words) = (tiles_across * job.height.div_ceil(TILE), n.div_ceil(32));
        // Splats with keys, indices and order; their sums; the mask.
        let image_bytes = WORD * (n * (4 * RECORD + 3 + SUMS) + tiles * words);
        let bound = job.tuning.group_bytes.min(properties.memory.max_page_size);
        let group = ((bound / image_bytes.max(1) as u64) as usize).max(1);
        Self { job, client, n, images: job.cameras.len(), tiles_across, tiles, words, group }
    }

    fn groups(&self) -> impl Iterator<Item = Group> {
        let (images, group) = (self.images, self.group);
        (0..images).step_by(group).map(move |first| Group { first, images: group.min(images - first) })
    }

    fn frame(&self, group: Group) -> FrameLaunch {
        let config = &self.job.config;
        FrameLaunch::new(
            group.images as u32,
            group.first as u32,
            self.job.views as u32,
            self.n as u32,
            self.job.width as u32,
            self.job.height as u32,
            self.tiles_across as u32,
            self.tiles as u32,
            self.words as u32,
            config.near,
            config.far,
            config.blur,
        )
    }

    /// At least `cubes` cubes, within the device's limits for each dimension.
    fn grid(&self, cubes: usize) -> CubeCount {
        let (x_limit, y_limit, _) = self.client.properties().hardware.max_cube_count;
        let limit = |device: u32| device.min(self.job.tuning.grid_limit) as usize;
        let x = cubes.min(limit(x_limit));
        let y = cubes.div_ceil(x.max(1)).min(limit(y_limit));
        let z = cubes.div_ceil((x * y).max(1));
        CubeCount::Static(x as u32, y as u32, z as u32)
    }

    fn grid_of_threads(&self, threads: usize) -> CubeCount {
        self.grid(threads.div_ceil(THREADS))
    }

    fn dim(&self) -> CubeDim {
        CubeDim::new_1d(THREADS as u32)
    }

    /// A new buffer of `len` words. Kernels cannot have empty arguments.
    fn words(&self, len: usize) -> Handle {
        self.client.empty(len.max(4) * WORD)
    }

    fn upload_cameras(&self) -> Handle {
        let pairs = self.job.cameras.iter().zip(&self.job.backgrounds);
        let floats: Vec<f32> = pairs.flat_map(|(camera, background)| camera_floats(camera, *background)).collect();
        self.client.create_from_slice(f32::as_bytes(&floats))
    }

    fn all_pixels(&self) -> usize {
        self.images * self.job.height * self.job.width
    }

    /// Projects the Gaussians, puts them in order, and marks the tiles that they reach.
    fn prepare(&self, gaussians: &CubeTensor, cameras: &Handle, group: Group) -> Prepared {
        let Self { ref client, n, .. } = *self;
        let splats = group.images * n;
        let bits = group.images * self.tiles * self.words;
        let records = self.words(splats * RECORD * 4);
        let (order, mask) = (self.words(splats), self.words(bits));
        if splats > 0 {
            let (keys, indices) = (self.words(splats), self.words(splats));
            let block = n.next_power_of_two().clamp(2, self.job.tuning.sort_block);
            // SAFETY, here and below: kernels check their indices against the sizes that the buffers were made with.
            unsafe {
                project::project::launch_unchecked(
                    client,
                    self.grid_of_threads(splats),
                    self.dim(),
                    arg(&gaussians.handle, self.job.objects * n * CHANNELS),
                    arg(cameras, self.images * CAMERA),
                    arg(&records, splats * RECORD),
                    arg(&keys, splats),
                    arg(&mask, bits),
                    self.frame(group),
                );
                order::sort_blocks::launch_unchecked(
                    client,
                    self.grid(group.images * n.div_ceil(block)),
                    self.dim(),
                    arg(&keys, splats),
                    arg(&indices, splats),
                    self.frame(group),
                    block,
                );
                order::rank_and_mark::launch_unchecked(
                    client,
                    self.grid_of_threads(splats),
                    self.dim(),
                    arg(&keys, splats),
                    arg(&indices, splats),
                    arg(&records, splats * RECORD),
                    arg(&order, splats),
                    arg(&mask, bits),
                    self.frame(group),
                    block,
                );
            }
        }
        Prepared { records, order, mask }
    }
}

/// Draws `gaussians` `[objects, n, 14]`, and with `save` keeps what [`backward()`] needs. Returns
/// `[objects, views, height, width, 4]`.
pub fn forward(gaussians: CubeTensor, job: &Job, save: bool) -> (CubeTensor, Option<State>) {
    let gaussians = into_contiguous(gaussians);
    let plan = Plan::new(&gaussians, job);
    let (client, pixels) = (&plan.client, plan.all_pixels());
    let shape = Shape::from([job.objects, job.views, job.height, job.width, 4]);
    let image = client.empty(pixels.max(1) * 4 * WORD);
    let out = CubeTensor::new_contiguous(client.clone(), gaussians.device.clone(), shape, image.clone(), DType::F32);
    let saved = plan.words(if save { 2 * pixels } else { 0 });
    if pixels == 0 {
        let state = save.then(|| State { cameras: plan.words(0), pixels: saved, prepared: None });
        return (out, state);
    }
    let cameras = plan.upload_cameras();
    let mut kept = None;
    for group in plan.groups() {
        let prepared = plan.prepare(&gaussians, &cameras, group);
        let splats = group.images * plan.n;
        unsafe {
            draw::forward::launch_unchecked(
                client,
                plan.grid(group.images * plan.tiles),
                plan.dim(),
                arg(&prepared.records, splats * RECORD),
                arg(&prepared.order, splats),
                arg(&prepared.mask, group.images * plan.tiles * plan.words),
                arg(&cameras, plan.images * CAMERA),
                arg(&image, pixels),
                arg(&saved, 2 * pixels),
                plan.frame(group),
                pixels as u32,
                save,
            );
        }
        kept = (save && group.images == plan.images).then_some(prepared);
    }
    (out, save.then_some(State { cameras, pixels: saved, prepared: kept }))
}

/// d loss / d Gaussians, given `d_image` = d loss / d image.
pub fn backward(gaussians: CubeTensor, d_image: CubeTensor, job: &Job, state: &State) -> CubeTensor {
    let (gaussians, d_image) = (into_contiguous(gaussians), into_contiguous(d_image));
    let plan = Plan::new(&gaussians, job);
    let (client, n, pixels) = (&plan.client, plan.n, plan.all_pixels());
    let zeros = |shape: Shape| CubeBackend::float_zeros(shape, &gaussians.device, FloatDType::F32);
    let shape = Shape::from([job.objects, n, CHANNELS]);
    if n == 0 || pixels == 0 {
        return zeros(shape);
    }
    let one_group = plan.group >= plan.images;
    let out = if one_group {
        let bytes = job.objects * n * CHANNELS * WORD;
        CubeTensor::new_contiguous(client.clone(), gaussians.device.clone(), shape, client.empty(bytes), DType::F32)
    } else {
        zeros(shape)
    };
    let float_atomics = job.tuning.float_atomics
        && client
            .properties()
            .atomic_type_usage(Type::atomic(ElemType::Float(FloatKind::F32)))
            .contains(AtomicUsage::Add);
    let launch = if float_atomics {
        backward::backward::launch_unchecked::<f32>
    } else {
        backward::backward::launch_unchecked::<u32>
    };
    for group in plan.groups() {
        let again;
        let prepared = match &state.prepared {
            Some(prepared) => prepared,
            None => {
                again = plan.prepare(&gaussians, &state.cameras, group);
                &again
            }
        };
        let splats = group.images * n;
        let sums = zeros(Shape::from([splats * SUMS])).handle;
        let objects = group.first / job.views..(group.first + group.images).div_ceil(job.views);
        unsafe {
            launch(
                client,
                plan.grid(group.images * plan.tiles),
                plan.dim(),
                arg(&prepared.records, splats * RECORD),
                arg(&prepared.order, splats),
                arg(&prepared.mask, group.images * plan.tiles * plan.words),
                arg(&state.cameras, plan.images * CAMERA),
                arg(&d_image.handle, pixels),
                arg(&state.pixels, 2 * pixels),
                arg(&sums, splats * SUMS),
                plan.frame(group),
                pixels as u32,
            );
            project::project_backward::launch_unchecked(
                client,
                plan.grid_of_threads(objects.len() * n),
                plan.dim(),
                arg(&gaussians.handle, job.objects * n * CHANNELS),
                arg(&state.cameras, plan.images * CAMERA),
                arg(&sums, splats * SUMS),
                arg(&out.handle, job.objects * n * CHANNELS),
                plan.frame(group),
                objects.start as u32,
                objects.len() as u32,
                u32::from(!one_group),
            );
        }
    }
    out
}
