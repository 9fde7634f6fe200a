"""Compiles recorded CUDA C++ with NVRTC, validates recorded SPIR-V, and says what did not pass. usage: check.py KERNELS REPORT"""
import collections
import ctypes
import json
import pathlib
import subprocess
import sys
import sysconfig

kernels, report = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2])
nvidia = pathlib.Path(sysconfig.get_path("purelib")) / "nvidia"
library = sorted(nvidia.rglob("libnvrtc.so.*"))
assert library, f"{nvidia}: expected libnvrtc.so (pip install nvidia-cuda-nvrtc)"
for other in sorted(nvidia.rglob("libnvrtc-builtins*")):
    ctypes.CDLL(str(other), mode=ctypes.RTLD_GLOBAL)
nvrtc = ctypes.CDLL(str(library[0]))
includes = sorted({p.parent for p in nvidia.rglob("cuda_runtime.h")} | {p.parent.parent for p in nvidia.rglob("cuda/std/version")} | {p.parent.parent for p in nvidia.rglob("cuda/barrier")})
version = [ctypes.c_int(), ctypes.c_int()]
nvrtc.nvrtcVersion(*map(ctypes.byref, version))


def compile_cuda(source, arch):
    """None, or what the compiler says."""
    program = ctypes.c_void_p()
    assert nvrtc.nvrtcCreateProgram(ctypes.byref(program), source, b"kernel.cu", 0, None, None) == 0
    options = [f"--gpu-architecture={arch}".encode(), *(f"--include-path={i}".encode() for i in includes), b"-lineinfo"]
    failed = nvrtc.nvrtcCompileProgram(program, len(options), (ctypes.c_char_p * len(options))(*options))
    said = None
    if failed:
        size = ctypes.c_size_t()
        nvrtc.nvrtcGetProgramLogSize(program, ctypes.byref(size))
        log = ctypes.create_string_buffer(size.value)
        nvrtc.nvrtcGetProgramLog(program, log)
        said = log.value.decode(errors="replace")
    nvrtc.nvrtcDestroyProgram(ctypes.byref(program))
    return said


results = collections.defaultdict(lambda: {"passed": 0, "failed": {}})
for file in sorted(kernels.iterdir()):
    name = file.name
    if name.endswith(".failed"):
        target, said = name.split(".")[1], file.read_text()
    elif name.endswith(".cu"):
        target = name.split(".")[-2]
        said = compile_cuda(file.read_bytes(), target)
    elif name.endswith(".spv"):
        target = "spv"
        run = subprocess.run(["spirv-val", "--target-env", "vulkan1.3", str(file)], capture_output=True, text=True)
        said = (run.stdout + run.stderr) if run.returncode else None
    else:
        continue
    if said is None:
        results[target]["passed"] += 1
    else:
        results[target]["failed"][name] = said[:2000]
report.write_text(json.dumps({"nvrtc": [v.value for v in version], "results": results}, indent=1))
print(f"NVRTC {version[0].value}.{version[1].value}")
for target, result in sorted(results.items()):
    print(f"{target}: {result['passed']} kernels pass, {len(result['failed'])} do not")
    for name, said in list(result["failed"].items())[:5]:
        print(f"  {name}: {' '.join(said.split())[:300]}")
assert results, f"{kernels}: expected kernels, found none"
sys.exit(any(r["failed"] for r in results.values()))
