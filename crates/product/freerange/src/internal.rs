//! For the program and the Python package of this workspace alone: what they need of the crates beneath. Not part of the
//! API; it changes without notice.

pub use freerange_diffusion::settings::Settings;

use crate::{Device, EncoderPlaces, Error, Options, Reconstructor};
pub use crate::{
    checkpoint::{
        checkpoint_bytes, checkpoint_header, checkpoint_sha256, encoder_for_training, find_encoder, load_checkpoint,
    },
    leave_one_out::leave_one_out,
    pipeline::optimize_alone,
    reconstructor::network_gaussians,
};

/// The device as tensors know it.
pub fn tensor_device(device: &Device) -> &burn::tensor::Device {
    &device.0
}

/// The model that is part of the program.
///
/// # Errors
/// If the program was built without it (feature `embedded`), or the device fails.
pub fn shipped(device: &Device) -> Result<Reconstructor, Error> {
    let checkpoint = load_checkpoint(None, &EncoderPlaces::default(), device)?;
    Ok(Reconstructor::new(checkpoint, device))
}

/// The same options with the network left out: the control of comparisons.
pub fn without_network(options: Options, without: bool) -> Options {
    Options { without_network: without, ..options }
}

/// Whether the network is left out.
pub fn is_without_network(options: &Options) -> bool {
    options.without_network
}
