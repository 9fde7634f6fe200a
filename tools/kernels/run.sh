#!/usr/bin/env bash
# Are the GPU kernels ready for cards that are not here? The GPU tests run on what there is (Mesa's software Vulkan), and every kernel that they
# launch is also written as CUDA C++ and SPIR-V by CubeCL's own compilers; NVRTC (from PyPI, no card needed) then compiles the first for sm_80 and
# sm_90, spirv-val (Debian's spirv-tools) reads the second. Proves that they compile, not that they compute what they should.
#
#     tools/kernels/run.sh FOLDER
#
# FOLDER: where kernels and report.json go. Wants Rust, Python, pip; builds what uses cubecl-wgpu again, into target/kernels.
set -euo pipefail
cd "$(dirname "$0")/../.."
rm -rf "$1/kernels"
mkdir -p "$1/kernels"
folder=$(realpath "$1")
here=$PWD/tools/kernels
command -v spirv-val >/dev/null || { apt-get update -q && apt-get install -q -y --no-install-recommends spirv-tools; }
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q 'nvidia-cuda-nvrtc>=13,<14' 'nvidia-cuda-runtime>=13,<14' 'nvidia-cuda-cccl>=13,<14'

# A copy of cubecl-wgpu that records; the lock file is as before afterwards.
source=$(cargo metadata --format-version 1 --features freerange-cli/webgpu |
  python3 -c 'import json, sys; print(next(p["manifest_path"] for p in json.load(sys.stdin)["packages"] if p["name"] == "cubecl-wgpu"))')
rm -rf "$folder/cubecl-wgpu"
cp -r "$(dirname "$source")" "$folder/cubecl-wgpu"
cp "$here/record.rs" "$folder/cubecl-wgpu/src/record.rs"
python3 "$here/patch.py" "$folder/cubecl-wgpu"
cp Cargo.lock "$folder/Cargo.lock"
trap 'cp "$folder/Cargo.lock" Cargo.lock' EXIT
features=freerange-cli/webgpu,freerange-cli/fetch,freerange-cli/cloud
export FREERANGE_KERNELS=$folder/kernels CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-target/kernels}
# The whole workspace, as all tests are (a selection would compile dependencies with other features), and then only what launches kernels.
# shellcheck disable=SC2086
cargo test --workspace --release ${CARGO_OPTIONS:-} --features "$features" --config "patch.crates-io.cubecl-wgpu.path=\"$folder/cubecl-wgpu\"" \
  --lib --test gpu --no-run --message-format=json-render-diagnostics >"$folder/build.json"
python3 "$here/run_tests.py" "$folder/build.json"
"$folder/venv/bin/python" "$here/check.py" "$folder/kernels" "$folder/report.json"
