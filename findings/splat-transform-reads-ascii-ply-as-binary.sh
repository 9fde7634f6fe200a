#!/bin/sh
# splat-transform takes an ascii .ply for a binary one: valid Gaussians become noise, with exit code 0 and no warning.
# Expected: it reads them, or refuses the file. Found with 3.7.0.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-audit --no-fund --ignore-scripts @playcanvas/splat-transform@3.7.0 >/dev/null 2>&1
cat > make.py <<'PY'
columns = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
row = " ".join(f"{float(v):.6f}" for v in "1 2 3 0 0 0 0.5 0.5 0.5 1 -3 -3 -3 1 0 0 0".split())
text = "ply\nformat ascii 1.0\nelement vertex 20\n" + "".join(f"property float {c}\n" for c in columns) + "end_header\n"
open("in.ply", "w").write(text + (row + "\n") * 20)
PY
python3 make.py
node_modules/.bin/splat-transform in.ply out.ply >log 2>&1 || { echo "changed: it refuses the file now"; tail -2 log; exit 1; }
python3 - <<'PY'
import struct
data = open("out.ply", "rb").read()
start = data.index(b"end_header\n") + 11
x, y, z = struct.unpack("<3f", data[start:start + 12])
print("splat-transform 3.7.0: twenty Gaussians at (1, 2, 3) in an ascii .ply, converted to .ply, exit code 0")
print(f"first position in the result: ({x:g}, {y:g}, {z:g})")
if abs(x - 1) + abs(y - 2) + abs(z - 3) < 1e-3:
    print("changed: ascii files are read now")
    raise SystemExit(1)
PY
