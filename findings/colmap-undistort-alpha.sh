#!/bin/sh
# undistort_images drops the alpha of cut-out photos: what was transparent becomes its hidden color.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" -q install pycolmap==4.2.1 numpy==2.3.5
cd "$work"
"$work/venv/bin/python" - <<'PYTHON'
import pathlib
import struct
import zlib
import numpy as np
import pycolmap

pycolmap.logging.minloglevel = 2

def png(path, rgba):
    """Written by hand: another image library in this process may not get along with pycolmap's."""
    h, w = rgba.shape[:2]
    chunk = lambda t, b: struct.pack(">I", len(b)) + t + b + struct.pack(">I", zlib.crc32(t + b))
    raw = b"".join(b"\0" + row.tobytes() for row in rgba)
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", w, h, 8, 6, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b""))

options = pycolmap.SyntheticDatasetOptions()
options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 2, 20
options.camera_width, options.camera_height = 64, 48
made = pycolmap.synthesize_dataset(options)
images, model = pathlib.Path("images"), pathlib.Path("model")
images.mkdir(), model.mkdir()
made.write(model)
rgba = np.zeros((48, 64, 4), np.uint8)
rgba[12:36, 16:48] = [200, 30, 20, 255]
names = [image.name for image in made.images.values()]
for name in names:
    png(images / name, rgba)
pycolmap.undistort_images("out", model, images)
data = (pathlib.Path("out/images") / names[0]).read_bytes()
kind = data[25]
print("pycolmap", pycolmap.__version__)
print("PNG color type in: 6 (RGBA); out:", kind, "(2 is RGB, 6 is RGBA)")
print("Cut photos out after undistorting them, or let the reconstruction remove the lens.")
raise SystemExit(0 if kind == 2 else "the behavior has changed")
PYTHON
