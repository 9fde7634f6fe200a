#!/usr/bin/env bash
# The Python package in an environment of its own: it is built and installed by pip; types; stubs beside what is there; tests, the README's five lines, gradients through PyTorch,
# pycolmap, TensorBoard's reader and the notebooks among them; every step in a file of Rerun's; and the time of a reconstruction beside the command line's. Says what it leaves out
# where packages cannot be had.
#
#     tools/python/run.sh target/release/freerange [FEATURES]
#
# FEATURES of the build: `as-tests` lets it use what the workspace's tests have built, with the same CARGO_OPTIONS. TORCH=no leaves out PyTorch (3 GB) and what needs it; with TORCH=system
# the gradients are tested with Debian's PyTorch (python3-torch, 600 MB on disk, fetched by apt where it is missing), and ffgs, which needs a later one, is left out. PYCOLMAP=no leaves
# out pycolmap, RERUN=no Rerun, TIMES=no that time.
set -euo pipefail
FREERANGE=$(realpath "$1")
export FREERANGE
features=${2:-}
cd "$(dirname "$0")/../.."
# On a developer's machine what cannot be had is left out. CI=true makes it a failure.
leave() {
  echo "LEFT OUT: the Python package: $*"
  [ "${CI:-}" != true ] || exit 1
  exit 0
}
python=${PYTHON:-python3}
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null || leave "no Python of version 3.10 or later"
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
{ "$python" -m venv "$folder/venv" && "$folder/venv/bin/pip" install -q 'maturin>=1.9,<2'; } || leave "no packages from PyPI"
pip() { "$folder/venv/bin/pip" --disable-pip-version-check "$@"; }
# Mesa's software Vulkan and OpenGL and PyTorch's Triton bring an LLVM each and crash in one process: no driver is to be found here.
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent __EGL_VENDOR_LIBRARY_FILENAMES=/nonexistent
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$PWD/target}
begin=$SECONDS
pip wheel -q --no-deps --wheel-dir "$folder/wheels" ./python ${features:+--config-settings="build-args=${CARGO_OPTIONS:-} --features $features"}
wheels=("$folder"/wheels/*.whl)
pip install -q "${wheels[0]}[test]"
echo "installed in $((SECONDS - begin)) s: $(cd / && "$folder/venv/bin/python" -c 'import freerange; print(freerange.__version__, freerange.__file__)')"
without=()
# What is not asked for is left out; what is asked for and cannot be had fails under CI=true.
wanted() {
  local name=$1 package=$2 choice=$3
  [ "$choice" = no ] || pip install -q "$package" || [ "${CI:-}" != true ] || exit 1
  "$folder/venv/bin/pip" show -q "${package%%=*}" 2>/dev/null || { echo "LEFT OUT: $name"; return 1; }
}
# An environment that sees the system's packages, with Debian's PyTorch among them.
of_system() {
  local python=/usr/bin/python3
  "$python" -c 'import ensurepip, torch' 2>/dev/null ||
    { apt-get update -q && apt-get install -q -y --no-install-recommends python3-torch python3-venv; } >&2 || return 1
  "$python" -m venv --system-site-packages "$folder/system" &&
    "$folder/system/bin/pip" --disable-pip-version-check install -q "${wheels[0]}" pytest pillow &&
    "$folder/system/bin/python" -c 'import numpy, torch; print(f"PyTorch {torch.__version__}, NumPy {numpy.__version__}")'
}
wanted "a scene of pycolmap" pycolmap "${PYCOLMAP:-yes}" || true
if [ "${TORCH:-yes}" = system ]; then
  without+=(--ignore=tests/test_torch.py)
  if of_system; then
    (cd python && "$folder/system/bin/python" -m pytest -q -p no:cacheprovider tests/test_torch.py)
  else
    echo "LEFT OUT: gradients through Debian's PyTorch"
    [ "${CI:-}" != true ] || exit 1
  fi
else
  wanted "PyTorch, and gradients through it" torch "${TORCH:-yes}" || without+=(--ignore=tests/test_torch.py)
fi
if [ "${TORCH:-yes}" = yes ]; then
  wanted "the plug-in of ffgs" ffgs==0.1.0.dev1 yes || without+=(--ignore=tests/test_ffgs.py)
else
  echo "LEFT OUT: the plug-in of ffgs, which needs PyTorch 2.2 or later"
  without+=(--ignore=tests/test_ffgs.py)
fi
(cd python && "$folder/venv/bin/mypy" --python-executable "$folder/venv/bin/python")
(cd python && "$folder/venv/bin/stubtest" freerange._core)
(cd python && "$folder/venv/bin/python" -m pytest -q -p no:cacheprovider "${without[@]}")
(cd python && "$folder/venv/bin/python" -m pytest -q -p no:cacheprovider --nbmake --nbmake-timeout=600 examples)
"$folder/venv/bin/python" tools/python/notebook.py examples/notebook/compare.ipynb
if wanted "the example for Rerun" rerun-sdk "${RERUN:-yes}"; then
  "$folder/venv/bin/python" python/examples/rerun_steps.py examples/bowl "$folder/steps.rrd"
  # Without its analytics, and without a trace in the user's settings.
  for arguments in "analytics disable" "rrd verify $folder/steps.rrd"; do
    # shellcheck disable=SC2086
    XDG_CONFIG_HOME=$folder XDG_DATA_HOME=$folder "$folder/venv/bin/rerun" $arguments >"$folder/rerun.txt" 2>&1 || { cat "$folder/rerun.txt" && exit 1; }
  done
  echo "Rerun's file: $(stat -c %s "$folder/steps.rrd") bytes"
fi
[ "${TIMES:-yes}" = no ] || "$folder/venv/bin/python" tools/python/times.py "$FREERANGE" examples/bowl
