#!/usr/bin/env bash
# The Python wheel for Linux distributions with an old glibc: built with maturin and zig, its platform tag checked, installed into an environment of its own,
# and tried with the README's lines. Only a wheel that passes comes into OUT.
#
#     tools/python/wheels.sh OUT
#
# MANYLINUX names another policy than manylinux_2_17 (CentOS 7 and later), such as manylinux_2_28. PYTHON names another Python than python3, 3.10 or later.
set -euo pipefail
refuse() {
  echo "tools/python/wheels.sh: $*" >&2
  exit 2
}
[ $# = 1 ] || refuse "expected one argument, the folder for the wheel, found $#"
[ "$(uname -s)" = Linux ] || refuse "expected Linux, found $(uname -s): wheels of other systems need no zig (tools/release.sh --wheel)"
policy=${MANYLINUX:-manylinux_2_17}
[[ $policy =~ ^manylinux_2_[0-9]+$ ]] || refuse "MANYLINUX: expected a policy such as manylinux_2_17, found $policy"
python=${PYTHON:-python3}
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' || refuse "expected Python 3.10 or later, found $("$python" --version 2>&1)"
mkdir -p "$1"
out=$(realpath "$1")
cd "$(dirname "$0")/../.."
root=$PWD
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

# zig 0.13 is the last without a runtime of its own for undefined behavior, which build scripts in C would be linked with.
"$python" -m venv "$folder/build"
"$folder/build/bin/pip" --disable-pip-version-check install -q maturin==1.16.0 ziglang==0.13.0.post1 auditwheel==6.8.2
# For any processor: vector instructions are chosen when the package runs. An empty RUSTFLAGS overrides those of configuration files, such as target-cpu=native.
export RUSTFLAGS=
unset CARGO_ENCODED_RUSTFLAGS
begin=$SECONDS
# maturin finds zig as a module of the first Python on the PATH, and refuses a library that needs more than the policy has.
PATH=$folder/build/bin:$PATH ZIG_GLOBAL_CACHE_DIR=$folder/zig CARGO_ZIGBUILD_CACHE_DIR=$folder/zigbuild \
  "$folder/build/bin/maturin" build --release --locked --zig --compatibility "$policy" --auditwheel check \
  --manifest-path python/Cargo.toml --out "$folder/wheels"
wheels=("$folder"/wheels/*.whl)
[ ${#wheels[@]} = 1 ] || refuse "expected one wheel, found ${#wheels[@]}"
wheel=${wheels[0]}
name=$(basename "$wheel")
echo "built in $((SECONDS - begin)) s: $name, $(stat -c %s "$wheel") bytes"

# The name says the policy, and an independent look at the symbols agrees.
[[ $name == *"-abi3-"*"${policy}_"* ]] || refuse "$name: expected a wheel for abi3 and $policy"
seen=$("$folder/build/bin/auditwheel" show "$wheel" | tr '\n' ' ')
needs=$(grep -o 'consistent with the following platform tag: *"manylinux_2_[0-9]*' <<<"$seen" | grep -o '[0-9]*$') ||
  refuse "$name: expected a manylinux wheel, found by auditwheel: $seen"
[ "$needs" -le "${policy##*_}" ] || refuse "$name: expected glibc 2.${policy##*_} or older, found 2.$needs by auditwheel"
echo "auditwheel: manylinux_2_$needs"

# The README's lines, with few iterations.
"$python" -m venv "$folder/try"
"$folder/try/bin/pip" --disable-pip-version-check install -q "$wheel"
mkdir "$folder/work"
ln -s "$root/examples" "$folder/work/examples"
(cd "$folder/work" && "$folder/try/bin/python" - "$root/README.md") <<'PYTHON'
import pathlib
import sys

code = pathlib.Path(sys.argv[1]).read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]
call = "reconstruct_scene(scene)"
if code.count(call) != 1:
    sys.exit(f"README.md: expected {call} once in its Python lines, found it {code.count(call)} times")
found = {}
exec(code.replace(call, 'reconstruct_scene(scene, quality="draft", iterations=20)'), found)
size = pathlib.Path("bowl.glb").stat().st_size
assert size > 100_000 and found["image"].shape == (512, 512, 3), (size, found["image"].shape)
print(f"freerange {found['freerange'].__version__}: {len(found['gaussians'])} Gaussians, bowl.glb has {size} bytes")
PYTHON
cp "$wheel" "$out/"
echo "$out/$name"
