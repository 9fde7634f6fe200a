//! The operation on Burn tensors.

#[cfg(feature = "gpu")]
use crate::gpu;
#[cfg(feature = "gpu")]
use crate::job::Tuning;
use crate::{CHANNELS, RasterConfig, RasterError, cpu, job::Job};
use burn::backend::{
    Autodiff, Backend, Dispatch, Flex,
    autodiff::{
        checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
        grads::Gradients,
        ops::{Backward, Ops, OpsKind},
    },
    backend_extension,
    flex::FlexTensor,
    tensor::FloatTensor,
};
use burn::tensor::{DType, Tensor, TensorData};
#[cfg(feature = "gpu")]
use burn_cubecl::{CubeBackend, tensor::CubeTensor};
use freerange_scene::camera::Camera;
use std::{
    any::Any,
    sync::{Arc, OnceLock},
};

/// Renders `gaussians` `[objects, n, 14]` (channels as in [`crate`]) with `cameras[object][view]`, in front of
/// `backgrounds[object][view]`. Returns `[objects, views, height, width, 4]`: color over the background, and alpha.
///
/// Differentiable once in `gaussians`. All objects have the same number of views, and all views the same size in pixels.
/// What [`crate::render`] says about values that are not finite holds here as well; [`RasterConfig::depth`] is ignored.
///
/// # Devices
/// On a CPU, the same input gives the same bytes. With the feature `gpu`, tensors may also be on a GPU; the call returns
/// before the image is there. Images are then the same every time, but gradients only up to rounding: they are sums over
/// tiles, which finish in any order. Both equal those of the CPU up to rounding, with rare exceptions at pixels where the
/// opacity of a splat, or the transmittance, is within rounding of a limit.
///
/// Apart from images and gradients, a GPU needs 96 bytes per Gaussian and image, one bit per Gaussian, image and tile of
/// 16 x 16 pixels, and 8 bytes per pixel. Beyond 512 MiB, images are drawn in groups, and prepared again for the gradient.
///
/// # Panics
/// If the device's memory does not suffice for one image, or if it does not run 256 units per cube.
///
/// # Errors
/// As [`crate::render`], and if the shape or data type of `gaussians` is not as above. Views are counted through all objects.
pub fn rasterize(
    gaussians: Tensor<3>,
    cameras: &[Vec<Camera>],
    backgrounds: &[Vec<[f32; 3]>],
    config: &RasterConfig,
) -> Result<Tensor<5>, RasterError> {
    run(
        gaussians,
        cameras,
        backgrounds,
        config,
        #[cfg(feature = "gpu")]
        Tuning::default(),
    )
}

/// [`rasterize`], with a choice of how the GPU does it.
pub(crate) fn run(
    gaussians: Tensor<3>,
    cameras: &[Vec<Camera>],
    backgrounds: &[Vec<[f32; 3]>],
    config: &RasterConfig,
    #[cfg(feature = "gpu")] tuning: Tuning,
) -> Result<Tensor<5>, RasterError> {
    let found = gaussians.dims();
    let [objects, _, channels] = found;
    if channels != CHANNELS || objects != cameras.len() {
        return Err(RasterError::Shape { objects: cameras.len(), found });
    }
    if gaussians.dtype() != DType::F32 {
        return Err(RasterError::DataType { found: format!("{:?}", gaussians.dtype()) });
    }
    let views = cameras.first().map_or(0, Vec::len);
    let lengths = |field, found: usize, expected: usize| {
        if found == expected { Ok(()) } else { Err(RasterError::Length { field, expected, found }) }
    };
    lengths("backgrounds", backgrounds.len(), objects)?;
    for (cameras, backgrounds) in cameras.iter().zip(backgrounds) {
        lengths("cameras[object]", cameras.len(), views)?;
        lengths("backgrounds[object]", backgrounds.len(), views)?;
    }
    let (cameras, backgrounds) = (cameras.concat(), backgrounds.concat());
    let [width, height] = cpu::check(&[], &cameras, &backgrounds, config)?;
    let config = RasterConfig { depth: false, ..*config };
    let job = Arc::new(Job {
        objects,
        views,
        width,
        height,
        cameras,
        backgrounds,
        config,
        #[cfg(feature = "gpu")]
        tuning,
    });
    Ok(Tensor::from_dispatch(Dispatch::rasterize(gaussians.into_dispatch(), job, None)))
}

/// Where the forward pass puts what the backward pass needs, if somebody will want it: the state of whichever backend.
pub type Saved = Arc<OnceLock<Box<dyn Any + Send + Sync>>>;

/// Notes the `state` of a forward pass.
fn save(saved: Option<Saved>, state: impl Any + Send + Sync) {
    if let Some(saved) = saved {
        saved.set(Box::new(state)).expect("one forward pass per operation");
    }
}

/// What the forward pass left, or, if it was not asked to, what it does now.
fn saved_or<S: Any + Send + Sync>(saved: &Saved, forward: impl FnOnce() -> S) -> &S {
    let state = saved.get_or_init(|| Box::new(forward()));
    state.downcast_ref().expect("forward and backward pass on the same backend")
}

/// The backends that can rasterize.
#[backend_extension(Flex, Cube: cfg(feature = "gpu"), Autodiff)]
pub trait RasterOps: Backend {
    /// `[objects, n, 14]` to `[objects, views, height, width, 4]`.
    fn rasterize(gaussians: FloatTensor<Self>, job: Arc<Job>, saved: Option<Saved>) -> FloatTensor<Self>;
    /// `[objects, n, 14]` and d loss / d image to d loss / d Gaussians.
    fn rasterize_backward(
        gaussians: FloatTensor<Self>,
        d_image: FloatTensor<Self>,
        job: Arc<Job>,
        saved: Saved,
    ) -> FloatTensor<Self>;
}

/// Runs `f` on the tensor's elements in row-major order.
fn with_slice<T>(tensor: &FlexTensor, f: impl FnOnce(&[f32]) -> T) -> T {
    match tensor.as_slice::<f32>() {
        Some(slice) => f(slice),
        None => f(tensor.to_contiguous().as_slice::<f32>().expect("a contiguous f32 tensor")),
    }
}

impl Job {
    /// Renders into a new image, `[objects, views, height, width, 4]`.
    fn run(&self, gaussians: &FlexTensor) -> (Vec<f32>, cpu::State) {
        let mut image = vec![0f32; self.cameras.len() * self.height * self.width * 4];
        let state = with_slice(gaussians, |rows| {
            let Self { objects, cameras, backgrounds, config, .. } = self;
            cpu::forward(rows, *objects, cameras, backgrounds, config, &mut image, 4, &mut [], &mut [])
        });
        (image, state)
    }
}

impl RasterOps for Flex {
    fn rasterize(gaussians: FlexTensor, job: Arc<Job>, saved: Option<Saved>) -> FlexTensor {
        let (image, state) = job.run(&gaussians);
        save(saved, state);
        FlexTensor::from_data(TensorData::new(image, [job.objects, job.views, job.height, job.width, 4]))
    }

    fn rasterize_backward(gaussians: FlexTensor, d_image: FlexTensor, job: Arc<Job>, saved: Saved) -> FlexTensor {
        let shape = [job.objects, gaussians.layout().shape()[1], CHANNELS];
        let state = saved_or(&saved, || job.run(&gaussians).1);
        let out = with_slice(&gaussians, |rows| {
            with_slice(&d_image, |d_image| cpu::backward(rows, state, d_image, 4, &[], &[]))
        });
        FlexTensor::from_data(TensorData::new(out.gaussians, shape))
    }
}

#[cfg(feature = "gpu")]
impl RasterOps for CubeBackend {
    fn rasterize(gaussians: CubeTensor, job: Arc<Job>, saved: Option<Saved>) -> CubeTensor {
        let (image, state) = gpu::forward(gaussians, &job, saved.is_some());
        if let Some(state) = state {
            save(saved, state);
        }
        image
    }

    fn rasterize_backward(gaussians: CubeTensor, d_image: CubeTensor, job: Arc<Job>, saved: Saved) -> CubeTensor {
        let again = || gpu::forward(gaussians.clone(), &job, true).1.expect("it was asked to keep it");
        gpu::backward(gaussians.clone(), d_image, &job, saved_or(&saved, again))
    }
}

impl<B: RasterOps, C: CheckpointStrategy> RasterOps for Autodiff<B, C> {
    fn rasterize(gaussians: FloatTensor<Self>, job: Arc<Job>, saved: Option<Saved>) -> FloatTensor<Self> {
        #[derive(Debug)]
        struct Pullback;
        impl<B: RasterOps> Backward<B, 1> for Pullback {
            type State = (FloatTensor<B>, Arc<Job>, Saved);
            fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
                let d_image = grads.consume::<B>(&ops.node);
                let (gaussians, job, saved) = ops.state;
                let [parent] = ops.parents;
                if let Some(node) = parent {
                    grads.register::<B>(node.id, B::rasterize_backward(gaussians, d_image, job, saved));
                }
            }
        }
        let (gaussians, node) = gaussians.into_parts();
        match Pullback.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let saved = saved.unwrap_or_default();
                let image = B::rasterize(gaussians.clone(), job.clone(), Some(saved.clone()));
                prep.finish((gaussians, job, saved), image)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::rasterize(gaussians, job, saved)),
        }
    }

    fn rasterize_backward(_: FloatTensor<Self>, _: FloatTensor<Self>, _: Arc<Job>, _: Saved) -> FloatTensor<Self> {
        panic!("the rasterizer can be differentiated once only")
    }
}
