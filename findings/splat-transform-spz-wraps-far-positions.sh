#!/bin/sh
# splat-transform writes .spz positions modulo 4096: x = 3000 comes back as -1096, and a northing in meters as 0 for all,
# with exit code 0 and no warning. Expected: fewer bits behind the point, an error, or clamping. Found with 3.7.0.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-audit --no-fund --ignore-scripts @playcanvas/splat-transform@3.7.0 >/dev/null 2>&1
cat > far.py <<'PY'
import struct
import subprocess

columns = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()

def write(path, places):
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(places)}\n"
    head += "".join(f"property float {c}\n" for c in columns) + "end_header\n"
    rows = [struct.pack("<14f", *p, 0.5, 0.5, 0.5, 1, -3, -3, -3, 1, 0, 0, 0) for p in places]
    open(path, "wb").write(head.encode() + b"".join(rows))

def read(path):
    """Its .ply has the columns that went in, x y z first."""
    head, body = open(path, "rb").read().split(b"end_header\n", 1)
    width = 4 * head.count(b"property float ")
    return [tuple(round(v, 2) for v in struct.unpack_from("<3f", body, i)) for i in range(0, len(body), width)]

def convert(*files):
    run = subprocess.run(["node_modules/.bin/splat-transform", "-w", *files], capture_output=True, text=True)
    said = run.stdout + run.stderr
    assert run.returncode == 0, said
    return [l for l in said.splitlines() if any(w in l.lower() for w in ("warn", "range", "clamp", "overflow"))]

print("splat-transform 3.7.0, .ply to .spz and back")
wrong = True
scenes = {
    "a town, 6 km across": [(0, 0, 0), (2047, 0, 0), (3000, 0, 0), (-3000, 5, 0)],
    "a house in UTM meters": [(500000.25, 4600000.5, 120), (500010.25, 4600012.5, 120)],
}
for name, places in scenes.items():
    write("a.ply", places)
    said = convert("a.ply", "b.spz")
    convert("b.spz", "c.ply")
    back = read("c.ply")
    print(f"{name}: {places}\n    comes back as {back}; said: {said or 'nothing'}")
    # From 2^31 / 4096 on all that is left of the integer is -1, which is next to zero.
    wrap = lambda v: (v + 2048) % 4096 - 2048 if abs(v) < 2**19 else 0
    wrong = wrong and not said and all(abs(wrap(v) - w) < 0.01 for p, q in zip(places, back) for v, w in zip(p, q))
print("Move such scenes to the origin first. Our writer takes as many bits behind the point as the object allows.")
raise SystemExit(0 if wrong else "the behavior has changed")
PY
python3 far.py
