#!/bin/sh
# COLMAP lays a mask of another size on its photo pixel for pixel, and says nothing: a white mask of
# half the size keeps the features of a quarter of the photo.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" -q install pycolmap==4.2.1 numpy==2.3.5
cd "$work"
"$work/venv/bin/python" - 2> log <<'PYTHON'
import pathlib
import struct
import zlib
import numpy as np
import pycolmap

def png(path, gray):
    """Written by hand: another image library in this process may not get along with pycolmap's."""
    h, w = gray.shape
    chunk = lambda t, b: struct.pack(">I", len(b)) + t + b + struct.pack(">I", zlib.crc32(t + b))
    raw = b"".join(b"\0" + row.tobytes() for row in gray)
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", w, h, 8, 0, 0, 0, 0))
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b""))

# A photo of 320 x 240 pixels with much to see everywhere; masks that keep all of it.
W, H = 320, 240
grain = np.random.default_rng(0).integers(0, 256, (H // 8, W // 8), dtype=np.uint8)
png(pathlib.Path("images/a.png"), np.kron(grain, np.ones((8, 8), np.uint8)))
found = {}
for name, scale in (("same", 1), ("half", 2)):
    png(pathlib.Path(f"{name}/a.png.png"), np.full((H // scale, W // scale), 255, np.uint8))
    pycolmap.extract_features(
        f"{name}.db", "images", device=pycolmap.Device.cpu,
        extraction_options=pycolmap.FeatureExtractionOptions(num_threads=1),
        reader_options=pycolmap.ImageReaderOptions(mask_path=name))
    with pycolmap.Database.open(f"{name}.db") as database:
        image = database.read_all_images()[0]
        found[name] = np.array(database.read_keypoints(image.image_id))[:, :2]
print("pycolmap", pycolmap.__version__)
for name, points in found.items():
    x, y = points.max(0)
    print(f"white mask of {name} size: {len(points)} features, up to x = {x:.0f}, y = {y:.0f}")
said = [l for l in pathlib.Path("log").read_text().splitlines() if "mask" in l.lower()]
print("what the log says of masks:", {l.split("] ")[-1] for l in said} or "nothing")
print("Scale masks to their photos before COLMAP sees them.")
same, half = found["same"], found["half"]
quarter = (half[:, 0] < W / 2 + 1).all() and (half[:, 1] < H / 2 + 1).all()
cut = len(half) < 0.5 * len(same) and quarter and (same.max(0) > (0.9 * W, 0.9 * H)).all()
raise SystemExit(0 if cut and all(l.split()[-2:] == ["Mask:", "Yes"] for l in said) else "the behavior has changed")
PYTHON
