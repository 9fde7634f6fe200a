//! What other devices' compilers would be given for each kernel that runs: see run.sh, which adds this module to a copy of cubecl-wgpu.

use cubecl_core::{Compiler, VulkanCompilationOptions, WgpuCompilationOptions, prelude::CubeKernel};
use cubecl_cpp::{
    shared::{CompilationOptions, CppCompiler, CppSupportedFeatures},
    target::Cuda,
};
use std::{
    collections::hash_map::DefaultHasher,
    hash::{Hash, Hasher},
    panic::{AssertUnwindSafe, catch_unwind},
    path::Path,
};

/// Writes CUDA C++ and SPIR-V of `kernel` into the folder that FREERANGE_KERNELS names. What cannot be written down is a file `.failed`.
pub fn record(kernel: &dyn CubeKernel) {
    let Some(folder) = std::env::var_os("FREERANGE_KERNELS") else { return };
    let folder = Path::new(&folder);
    let attempt = |what: &str, make: &dyn Fn() -> Result<Vec<u8>, String>| {
        let made = catch_unwind(AssertUnwindSafe(make)).unwrap_or_else(|_| Err("panicked".into()));
        let (extension, bytes) = match made {
            Ok(bytes) => (what.to_owned(), bytes),
            Err(reason) => (format!("{what}.failed"), format!("{}\n{reason}", kernel.name()).into_bytes()),
        };
        let mut hasher = DefaultHasher::new();
        (kernel.name(), &bytes).hash(&mut hasher);
        let name: String = kernel.name().chars().filter(|c| c.is_alphanumeric() || *c == '_').take(80).collect();
        std::fs::write(folder.join(format!("{name}-{:016x}.{extension}", hasher.finish())), bytes).expect("a folder to write to");
    };
    // As cubecl-cuda's runtime sets them for these architectures.
    for (arch, hopper) in [("sm_80", false), ("sm_90a", true)] {
        let options = CompilationOptions {
            supports_features: CppSupportedFeatures {
                grid_constants: true,
                clusters: hopper,
                fast_math: true,
                fast_tanh: true,
                elect_sync: hopper,
                dp4a: true,
            },
            ..Default::default()
        };
        attempt(&format!("{arch}.cu"), &|| {
            let compiled = CppCompiler::<Cuda>::default().compile(kernel.define(), &options);
            compiled.map(|k| k.to_string().into_bytes()).map_err(|e| format!("{e:?}"))
        });
    }
    // As a card with a current driver answers.
    let vulkan = VulkanCompilationOptions {
        supports_explicit_smem: true,
        supports_uniform_standard_layout: true,
        max_spirv_version: (1, 6),
        max_vector_size: 4,
        push_constant_size: 128,
        ..Default::default()
    };
    let options = WgpuCompilationOptions { supports_u64: true, supports_vulkan_compiler: true, supports_msl_compiler: false, vulkan };
    attempt("spv", &|| {
        let compiled = cubecl_spirv::SpirvCompiler.compile(kernel.define(), &options);
        let words = compiled.map_err(|e| format!("{e:?}"))?.assembled_module;
        Ok(words.iter().flat_map(|w| w.to_le_bytes()).collect())
    });
}
