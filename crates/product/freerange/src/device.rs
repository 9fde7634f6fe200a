//! Where to compute: devices by name.

use std::{
    fmt, fs,
    panic::{AssertUnwindSafe, catch_unwind},
    path::Path,
    str::FromStr,
};

use burn::tensor::Device as TensorDevice;
use freerange_model::Compute;
use serde::Serialize;

use crate::Error;

/// A device that is ready to compute. Prints as reports say it: `cpu`, or `cuda:0` with the maker's name.
///
/// ```
/// use freerange::Device;
/// let device = Device::open("auto")?; // the first GPU that can be used, else the CPU
/// println!("{device}, of {} devices", Device::list().len());
/// # Ok::<(), freerange::Error>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Device(pub(crate) TensorDevice);

impl Device {
    /// All cores, SIMD; needs nothing installed.
    pub fn cpu() -> Self {
        Self(TensorDevice::flex())
    }

    /// The device of this name: `auto`, `cpu`, `cuda`, `cuda:1`, `vulkan:0` ... See [`DeviceName::open`].
    ///
    /// # Errors
    /// [`Error::NoDevice`] if this program was built without it, or there is none; [`Error::DeviceFailed`] if it cannot be
    /// opened.
    pub fn open(name: &str) -> Result<Self, Error> {
        let parsed: DeviceName = name.parse().map_err(|e| Error::NoDevice(format!("device `{name}`: {e}")))?;
        parsed.open()
    }

    /// Every device that this program can use, the best first; the CPU last. Opens all of them.
    pub fn list() -> Vec<DeviceInfo> {
        let of = |api: GpuApi| {
            let gpu = move |(index, device): (usize, TensorDevice)| DeviceInfo::gpu(api, index, &device);
            api.devices().into_iter().enumerate().map(gpu)
        };
        GpuApi::ALL.into_iter().flat_map(of).chain([DeviceInfo::cpu()]).collect()
    }

    /// Its name, and what it can do. No other one is opened.
    pub fn info(&self) -> DeviceInfo {
        if *self == Self::cpu() {
            return DeviceInfo::cpu(); // without a search for GPUs
        }
        let gpu = |api: GpuApi| {
            let index = api.devices().iter().position(|found| *found == self.0)?;
            Some(DeviceInfo::gpu(api, index, &self.0))
        };
        GpuApi::ALL.into_iter().find_map(gpu).unwrap_or_else(DeviceInfo::cpu)
    }

    /// Refuses arithmetic that it does not have.
    ///
    /// # Errors
    /// [`Error::NoDevice`]
    pub fn require(&self, precision: Compute) -> Result<(), Error> {
        match precision.supported(&self.0) {
            true => Ok(()),
            false => Err(Error::NoDevice(format!(
                "{} cannot compute in {precision:?}: choose another precision (see `freerange devices`)",
                self.info().name
            ))),
        }
    }
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.info().fmt(f)
    }
}

/// How a GPU is reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GpuApi {
    /// NVIDIA's own; the fastest on its cards.
    Cuda,
    /// Metal's shading language, on Apple's GPUs.
    Metal,
    /// SPIR-V, on any GPU with a Vulkan driver.
    Vulkan,
    /// WGSL over Vulkan, Metal or DirectX 12.
    WebGpu,
}

impl GpuApi {
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

    /// Whether a search can find a card. On Linux, Vulkan reaches cards by files in `dev`; where there are none, its loader only finds
    /// processors that play a GPU, and Mesa's layers print errors of their own while they look for a display.
    fn may_find_card(self, dev: &Path) -> bool {
        let by_files = cfg!(target_os = "linux") && matches!(self, Self::Vulkan | Self::WebGpu);
        !by_files || may_have_card(dev)
    }

    /// The devices found, in the system's order; none where the driver is missing.
    fn devices(self) -> Vec<TensorDevice> {
        #[cfg(feature = "gpu")]
        use burn::tensor::DeviceType;
        let found: Vec<TensorDevice> = match self {
            #[cfg(feature = "cuda")]
            Self::Cuda => TensorDevice::enumerate(DeviceType::Cuda).into_iter().collect(),
            #[cfg(feature = "metal")]
            Self::Metal => TensorDevice::enumerate(DeviceType::Metal).into_iter().collect(),
            #[cfg(feature = "vulkan")]
            Self::Vulkan => TensorDevice::enumerate(DeviceType::Vulkan).into_iter().collect(),
            #[cfg(feature = "webgpu")]
            Self::WebGpu => TensorDevice::enumerate(DeviceType::Wgpu).into_iter().collect(),
            #[allow(unreachable_patterns)] // reachable in builds with fewer features
            _ => Vec::new(),
        };
        found
    }
}

/// How files of `/dev` begin that drivers of GPUs bring with them, beside those of `/dev/dri`: NVIDIA's and those of its boards, Windows'
/// for WSL, AMD's, Arm's, Qualcomm's, Imagination's and Vivante's.
const CARDS: [&str; 10] = ["nvidia", "nvgpu", "nvhost", "nvmap", "dxg", "kfd", "mali", "kgsl", "pvr", "galcore"];

/// Whether the folder of device files has one of a GPU that computes, or cannot be read.
fn may_have_card(dev: &Path) -> bool {
    let some = |folder: &Path, begins: &[&str]| {
        let is_one = |name: &str| begins.iter().any(|begin| name.starts_with(begin));
        fs::read_dir(folder).map(|all| all.flatten().any(|file| is_one(&file.file_name().to_string_lossy())))
    };
    // A folder `dri` without `renderD*` is that of a card which only shows a picture, as in many servers.
    some(dev, &CARDS).unwrap_or(true) || some(&dev.join("dri"), &["renderD"]).unwrap_or(false)
}

/// A device as the user names it: `auto`, `cpu`, `cuda`, `cuda:1`, `vulkan:0` ...
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceName {
    /// The first GPU that this program can use, else the CPU.
    Auto,
    /// All cores, SIMD; needs nothing installed.
    Cpu,
    /// The GPU of this number.
    Gpu(GpuApi, usize),
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
            _ => match GpuApi::ALL.into_iter().find(|api| api.name() == name) {
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
    /// The device, ready to compute; of [`Auto`](Self::Auto) the first GPU that can be used, else the CPU.
    ///
    /// # Errors
    /// If this program was built without it, or no such device is found or can be opened.
    pub fn open(self) -> Result<Device, Error> {
        self.open_telling(0, &mut |_| {})
    }

    /// The device, ready to compute. [`Auto`](Self::Auto) is the GPU of this `number` among those
    /// of its kind, from the first on again where there are fewer, or the next one that can be used; without any, the CPU.
    /// `tell` hears of GPUs that are there and cannot be opened. No other one is opened: each would give memory to it.
    ///
    /// # Errors
    /// If this program was built without it, or no such device is found or can be opened.
    pub fn open_telling(self, number: usize, tell: &mut dyn FnMut(&str)) -> Result<Device, Error> {
        match self {
            Self::Cpu => Ok(Device::cpu()),
            Self::Auto => {
                let asked = GpuApi::ALL.into_iter().filter(|api| api.may_find_card(Path::new("/dev")));
                let found = asked.map(|api| (api, api.devices()));
                Ok(first_gpu(found, number, properties, tell).map_or_else(Device::cpu, Device))
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
                    Ok(_) => Ok(Device(device)),
                    Err(problem) => Err(Error::DeviceFailed(format!("device {self} could not be opened: {problem}"))),
                }
            }
        }
    }
}

/// The first device, from `number` on, that opens and is real hardware: a software rasterizer pretends to be a GPU, and is
/// slower than the CPU used directly.
fn first_gpu<T>(
    found: impl IntoIterator<Item = (GpuApi, Vec<T>)>,
    number: usize,
    open: impl Fn(&T) -> Result<(DeviceProperties, bool), String>,
    tell: &mut dyn FnMut(&str),
) -> Option<T> {
    let mut broken = false;
    for (api, mut devices) in found {
        let count = devices.len();
        for index in (0..count).map(|i| (number + i) % count) {
            match open(&devices[index]) {
                Ok((_, true)) => return Some(devices.swap_remove(index)),
                Ok((_, false)) => {}
                Err(problem) => {
                    broken = true;
                    tell(&format!("device {} could not be opened: {problem}", DeviceName::Gpu(api, index)));
                }
            }
        }
    }
    if broken {
        tell("no GPU could be opened: the CPU computes");
    }
    None
}

/// What a device can do.
#[derive(Clone, Debug, Default, Serialize)]
pub struct DeviceProperties {
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

/// What a device can do, or why it cannot be used.
#[derive(Clone, Debug, Serialize)]
pub struct DeviceInfo {
    /// As [`DeviceName`] writes it.
    pub name: String,
    /// Whether it is real hardware, not a processor that plays one.
    pub gpu: bool,
    /// What it can do, if it could be opened.
    pub properties: DeviceProperties,
    /// Why it cannot be used.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
}

impl DeviceInfo {
    fn gpu(api: GpuApi, index: usize, device: &TensorDevice) -> Self {
        let name = DeviceName::Gpu(api, index).to_string();
        match properties(device) {
            Ok((properties, gpu)) => Self { name, gpu, properties, problem: None },
            Err(problem) => Self { name, gpu: false, properties: DeviceProperties::default(), problem: Some(problem) },
        }
    }

    fn cpu() -> Self {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let hardware = format!("{}, {cores} threads", crate::machine::processor());
        let properties =
            DeviceProperties { hardware, memory_bytes: crate::machine::memory(), ..DeviceProperties::default() };
        Self { name: "cpu".into(), gpu: false, properties, problem: None }
    }
}

/// As reports say it: `cpu`, or the name of a GPU with its maker's.
impl fmt::Display for DeviceInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.gpu {
            true => write!(f, "{} ({})", self.name, self.properties.hardware),
            false => f.write_str(&self.name),
        }
    }
}

/// DeviceProperties, and whether the device is real hardware. Opens it.
fn properties(device: &TensorDevice) -> Result<(DeviceProperties, bool), String> {
    // The driver's bindings panic where it turns out to be broken.
    catch_unwind(AssertUnwindSafe(|| ask(device))).map_err(|cause| {
        let text = cause.downcast_ref::<String>().cloned();
        text.or_else(|| cause.downcast_ref::<&str>().map(|s| s.to_string())).unwrap_or_else(|| "unknown reason".into())
    })
}

#[cfg(not(feature = "gpu"))]
fn ask(_: &TensorDevice) -> (DeviceProperties, bool) {
    (DeviceProperties::default(), false)
}

#[cfg(feature = "gpu")]
fn ask(device: &TensorDevice) -> (DeviceProperties, bool) {
    use burn::backend::DispatchDevice;
    use burn::tensor::FloatDType;
    use cubecl::ir::{ElemType, FloatKind, Type, features::AtomicUsage};
    let DispatchDevice::Cube(cube) = device.as_dispatch() else { return (DeviceProperties::default(), false) };
    let client = cube.client();
    let p = client.properties();
    let f32_atomic = Type::atomic(Type::Scalar(ElemType::Float(FloatKind::F32)));
    let mut matrix_units: Vec<String> =
        p.features.matmul.cmma.iter().map(|m| format!("{:?}", m.a_type).to_lowercase()).collect();
    matrix_units.sort();
    matrix_units.dedup();
    let properties = DeviceProperties {
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
        assert_eq!("cuda".parse(), Ok(DeviceName::Gpu(GpuApi::Cuda, 0)));
        for bad in ["", "gpu", "CPU", "cpu:0", "auto:1", "cuda:", "cuda:-1", "cuda:x", "cuda:0:1"] {
            assert!(bad.parse::<DeviceName>().is_err(), "{bad}");
        }
    }

    #[test]
    fn only_the_gpu_that_is_used_is_opened_and_broken_ones_are_told() {
        let choose = |number: usize, states: [&[char]; 2]| {
            let opened = std::cell::RefCell::new(String::new());
            let mut told = Vec::new();
            let open = |state: &char| {
                opened.borrow_mut().push(*state);
                match state.to_ascii_lowercase() {
                    'x' => Err("driver".to_owned()),
                    // A letter of hardware, or `-` for a processor that plays it.
                    state => Ok((DeviceProperties::default(), state != '-')),
                }
            };
            let found = [GpuApi::Cuda, GpuApi::Vulkan].into_iter().zip(states.map(<[char]>::to_vec));
            let chosen = first_gpu(found, number, open, &mut |note| told.push(note.to_owned()));
            (chosen, opened.into_inner(), told)
        };
        assert_eq!(choose(0, [&['a', 'b'], &['c']]), (Some('a'), "a".into(), vec![]));
        assert_eq!(choose(3, [&['a', 'b'], &['c']]), (Some('b'), "b".into(), vec![]));
        assert_eq!(choose(1, [&[], &['-', 'c']]), (Some('c'), "c".into(), vec![]));
        assert_eq!(choose(0, [&[], &['-']]), (None, "-".into(), vec![]));
        let (chosen, opened, told) = choose(0, [&['x'], &['c']]);
        assert_eq!((chosen, opened.as_str(), told.len()), (Some('c'), "xc", 1));
        assert!(told[0].contains("cuda:0 could not be opened: driver"), "{told:?}");
        let (chosen, _, told) = choose(0, [&['x'], &['-', 'x']]);
        assert_eq!((chosen, told.len()), (None, 3));
        assert!(told[1].contains("vulkan:1") && told[2].contains("the CPU computes"), "{told:?}");
        let cpu = Device::cpu().info();
        assert_eq!((cpu.name.as_str(), cpu.to_string().as_str(), cpu.problem), ("cpu", "cpu", None));
    }

    #[test]
    fn vulkan_is_asked_only_where_a_card_can_be() {
        let dev = std::env::temp_dir().join(format!("freerange-dev-{}", std::process::id()));
        fs::create_dir_all(dev.join("dri")).unwrap();
        let asked = |file: &str| {
            fs::write(dev.join(file), "").unwrap();
            let asked = GpuApi::ALL.map(|api| api.may_find_card(&dev));
            fs::remove_file(dev.join(file)).unwrap();
            asked
        };
        let elsewhere = cfg!(not(target_os = "linux"));
        for none in ["null", "nvram", "dri/card0"] {
            assert_eq!(asked(none), [true, true, elsewhere, elsewhere], "{none}");
        }
        for card in ["dri/renderD128", "nvidia0", "dxg", "kgsl-3d0", "mali0"] {
            assert_eq!(asked(card), [true; 4], "{card}");
        }
        fs::remove_dir_all(&dev).unwrap();
        // What cannot be read may have anything.
        assert!(may_have_card(&dev));
    }

    #[test]
    fn the_cpu_is_always_there_and_what_is_not_built_in_is_named() {
        assert_eq!(Device::list().last().map(|d| d.name.clone()), Some("cpu".into()));
        assert!(DeviceName::Auto.open().is_ok());
        for api in GpuApi::ALL.into_iter().filter(|api| !api.compiled()) {
            let error = DeviceName::Gpu(api, 0).open().unwrap_err();
            assert!(matches!(error, Error::NoDevice(_)));
            assert!(error.to_string().contains(&format!("--features {}", api.name())), "{error}");
        }
    }
}
