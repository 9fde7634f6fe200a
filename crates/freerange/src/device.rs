//! Where to compute: devices by name.

use std::{
    fmt,
    panic::{AssertUnwindSafe, catch_unwind},
    str::FromStr,
};

use burn::tensor::Device;
use freerange_model::Compute;
use serde::Serialize;

use crate::Error;

/// How a GPU is reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Api {
    /// NVIDIA's own; the fastest on its cards.
    Cuda,
    /// Metal's shading language, on Apple's GPUs.
    Metal,
    /// SPIR-V, on any GPU with a Vulkan driver.
    Vulkan,
    /// WGSL over Vulkan, Metal or DirectX 12.
    WebGpu,
}

impl Api {
    /// From the most to the least specialised.
    pub const ALL: [Self; 4] = [Self::Cuda, Self::Metal, Self::Vulkan, Self::WebGpu];

    /// The name on the command line, which is also that of the Cargo feature.
    pub fn name(self) -> &'static str {
        match self {
            Self::Cuda => "cuda",
            Self::Metal => "metal",
            Self::Vulkan => "vulkan",
            Self::WebGpu => "webgpu",
        }
    }

    /// Whether this program was built with it.
    pub fn compiled(self) -> bool {
        match self {
            Self::Cuda => cfg!(feature = "cuda"),
            Self::Metal => cfg!(feature = "metal"),
            Self::Vulkan => cfg!(feature = "vulkan"),
            Self::WebGpu => cfg!(feature = "webgpu"),
        }
    }

    /// The devices found, in the system's order; none where the driver is missing.
    pub fn devices(self) -> Vec<Device> {
        #[cfg(feature = "gpu")]
        use burn::tensor::DeviceType;
        let found: Vec<Device> = match self {
            #[cfg(feature = "cuda")]
            Self::Cuda => Device::enumerate(DeviceType::Cuda).into_iter().collect(),
            #[cfg(feature = "metal")]
            Self::Metal => Device::enumerate(DeviceType::Metal).into_iter().collect(),
            #[cfg(feature = "vulkan")]
            Self::Vulkan => Device::enumerate(DeviceType::Vulkan).into_iter().collect(),
            #[cfg(feature = "webgpu")]
            Self::WebGpu => Device::enumerate(DeviceType::Wgpu).into_iter().collect(),
            #[allow(unreachable_patterns)] // reachable in builds with fewer features
            _ => Vec::new(),
        };
        found
    }
}

/// A device as the user names it: `auto`, `cpu`, `cuda`, `cuda:1`, `vulkan:0` ...
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceName {
    /// The first GPU that this program can use, else the CPU.
    Auto,
    /// All cores, SIMD; needs nothing installed.
    Cpu,
    /// The GPU of this number.
    Gpu(Api, usize),
}

impl FromStr for DeviceName {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (name, index) = match text.split_once(':') {
            Some((name, index)) => {
                let index = index.parse().map_err(|_| format!("`{index}` after the colon is no device number"))?;
                (name, Some(index))
            }
            None => (text, None),
        };
        match (name, index) {
            ("auto", None) => Ok(Self::Auto),
            ("cpu", None) => Ok(Self::Cpu),
            ("auto" | "cpu", Some(_)) => Err(format!("`{name}` takes no number")),
            _ => match Api::ALL.into_iter().find(|api| api.name() == name) {
                Some(api) => Ok(Self::Gpu(api, index.unwrap_or(0))),
                None => Err("expected auto, cpu, cuda, metal, vulkan or webgpu, as in `cuda` or `cuda:1`".into()),
            },
        }
    }
}

impl fmt::Display for DeviceName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Cpu => f.write_str("cpu"),
            Self::Gpu(api, index) => write!(f, "{}:{index}", api.name()),
        }
    }
}

impl DeviceName {
    /// [`Auto`](Self::Auto) for the process of this number on its machine: of the GPUs that this program can use, the one of
    /// that number, from the first on again where there are fewer; without any, the CPU.
    pub fn auto_of(number: usize) -> Device {
        let nth = |api: Api| {
            let mut found = api.devices();
            // No other one is opened: each would give memory to it.
            let device = if found.is_empty() { return None } else { found.swap_remove(number % found.len()) };
            matches!(properties(&device), Ok((_, true))).then_some(device)
        };
        Api::ALL.into_iter().find_map(nth).unwrap_or_else(Device::flex)
    }

    /// The device, without differentiation, and ready to use.
    ///
    /// # Errors
    /// If this program was built without it, or no such device is found or can be opened.
    pub fn open(self) -> Result<Device, Error> {
        match self {
            Self::Cpu => Ok(Device::flex()),
            // A software rasteriser pretends to be a GPU, and is slower than the CPU used directly.
            Self::Auto => {
                Ok(devices().into_iter().find(|d| d.gpu && d.problem.is_none()).map_or_else(Device::flex, |d| d.device))
            }
            Self::Gpu(api, _) if !api.compiled() => Err(Error::NoDevice(format!(
                "device {self}: this program was built without it; build it with `cargo build --release --features {}`",
                api.name()
            ))),
            Self::Gpu(api, index) => {
                let found = api.devices();
                let count = found.len();
                let device = found.into_iter().nth(index).ok_or_else(|| {
                    Error::NoDevice(match count {
                        0 => format!("device {self}: no device found; is its driver installed?"),
                        n => format!("device {self}: only {n} found, numbered from 0 (see `freerange devices`)"),
                    })
                })?;
                match properties(&device) {
                    Ok(_) => Ok(device),
                    Err(problem) => Err(Error::BrokenDevice(format!("device {self} could not be opened: {problem}"))),
                }
            }
        }
    }
}

/// Refuses arithmetic that a device does not have.
///
/// # Errors
/// Names the device.
pub fn require(compute: Compute, device: &Device) -> Result<(), Error> {
    match compute.supported(device) {
        true => Ok(()),
        false => {
            let name = devices().into_iter().find(|d| d.is(device)).map_or_else(|| "the device".into(), |d| d.name);
            Err(Error::NoDevice(format!(
                "{name} cannot compute in {compute:?}: choose another `compute` (see `freerange devices`)"
            )))
        }
    }
}

/// What a device can do.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Properties {
    /// As the maker calls it.
    pub hardware: String,
    /// Bytes of memory; none where the driver does not tell.
    pub memory_bytes: Option<u64>,
    /// Threads that run in lockstep and can exchange values.
    pub plane: Option<u32>,
    /// Bytes of memory that the threads of a group share.
    pub shared_memory_bytes: usize,
    /// Element types of the matrix units, such as `bf16`.
    pub matrix_units: Vec<String>,
    /// Whether values of these types can be computed with.
    pub f16: bool,
    /// As `f16`.
    pub bf16: bool,
    /// Whether threads can add to one number in memory at once, without a loop.
    pub float_atomics: bool,
}

/// A device that this program can use, or why it cannot.
#[derive(Clone, Debug, Serialize)]
pub struct Listed {
    /// As [`DeviceName`] writes it.
    pub name: String,
    /// Whether it is real hardware, not a processor that plays one.
    pub gpu: bool,
    /// What it can do, if it could be opened.
    pub properties: Properties,
    /// Why it cannot be used.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
    #[serde(skip)]
    device: Device,
}

impl Listed {
    /// Whether this line is about `device`.
    pub fn is(&self, device: &Device) -> bool {
        &self.device == device
    }
}

/// Every device that this program can use, the best first; the CPU last.
pub fn devices() -> Vec<Listed> {
    let mut listed = Vec::new();
    for api in Api::ALL {
        for (index, device) in api.devices().into_iter().enumerate() {
            let name = DeviceName::Gpu(api, index).to_string();
            listed.push(match properties(&device) {
                Ok((properties, gpu)) => Listed { name, gpu, properties, problem: None, device },
                Err(problem) => {
                    Listed { name, gpu: false, properties: Properties::default(), problem: Some(problem), device }
                }
            });
        }
    }
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let hardware = format!("{}, {cores} threads", crate::machine::processor());
    let properties = Properties { hardware, memory_bytes: crate::machine::memory(), ..Properties::default() };
    listed.push(Listed { name: "cpu".into(), gpu: false, properties, problem: None, device: Device::flex() });
    listed
}

/// Properties, and whether the device is real hardware. Opens it.
fn properties(device: &Device) -> Result<(Properties, bool), String> {
    // The driver's bindings panic where it turns out to be broken.
    catch_unwind(AssertUnwindSafe(|| ask(device))).map_err(|cause| {
        let text = cause.downcast_ref::<String>().cloned();
        text.or_else(|| cause.downcast_ref::<&str>().map(|s| s.to_string())).unwrap_or_else(|| "unknown reason".into())
    })
}

#[cfg(not(feature = "gpu"))]
fn ask(_: &Device) -> (Properties, bool) {
    (Properties::default(), false)
}

#[cfg(feature = "gpu")]
fn ask(device: &Device) -> (Properties, bool) {
    use burn::backend::DispatchDevice;
    use burn::tensor::FloatDType;
    use cubecl::ir::{ElemType, FloatKind, Type, features::AtomicUsage};
    let DispatchDevice::Cube(cube) = device.as_dispatch() else { return (Properties::default(), false) };
    let client = cube.client();
    let p = client.properties();
    let f32_atomic = Type::atomic(Type::Scalar(ElemType::Float(FloatKind::F32)));
    let mut matrix_units: Vec<String> =
        p.features.matmul.cmma.iter().map(|m| format!("{:?}", m.a_type).to_lowercase()).collect();
    matrix_units.sort();
    matrix_units.dedup();
    let properties = Properties {
        hardware: p.identity.name.clone(),
        memory_bytes: p.memory.max_memory(),
        plane: (!p.features.plane.is_empty()).then_some(p.hardware.plane_size_max),
        shared_memory_bytes: p.hardware.max_shared_memory_size,
        matrix_units,
        f16: device.supports_dtype(FloatDType::F16),
        bf16: device.supports_dtype(FloatDType::BF16),
        float_atomics: p.atomic_type_usage(f32_atomic).contains(AtomicUsage::Add),
    };
    (properties, p.identity.physical.is_some())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_and_written_alike() {
        for text in ["auto", "cpu", "cuda:0", "metal:3", "vulkan:1", "webgpu:12"] {
            assert_eq!(text.parse::<DeviceName>().unwrap().to_string(), text);
        }
        assert_eq!("cuda".parse(), Ok(DeviceName::Gpu(Api::Cuda, 0)));
        for bad in ["", "gpu", "CPU", "cpu:0", "auto:1", "cuda:", "cuda:-1", "cuda:x", "cuda:0:1"] {
            assert!(bad.parse::<DeviceName>().is_err(), "{bad}");
        }
    }

    #[test]
    fn the_cpu_is_always_there_and_what_is_not_built_in_is_named() {
        assert_eq!(devices().last().map(|d| d.name.clone()), Some("cpu".into()));
        assert!(DeviceName::Auto.open().is_ok());
        for api in Api::ALL.into_iter().filter(|api| !api.compiled()) {
            let error = DeviceName::Gpu(api, 0).open().unwrap_err();
            assert!(matches!(error, Error::NoDevice(_)));
            assert!(error.to_string().contains(&format!("--features {}", api.name())), "{error}");
        }
    }
}
