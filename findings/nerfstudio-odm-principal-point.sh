#!/bin/sh
# nerfstudio takes OpenDroneMap's c_x and c_y for pixels: they are in units of the longer side, so the principal point stays in the middle.
# Expected: cx = w / 2 + c_x * max(w, h), as focal_x is scaled two lines above. Found with nerfstudio 1.1.5.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" -q install numpy==2.3.5
"$work/venv/bin/pip" -q install --no-deps nerfstudio==1.1.5
cd "$work"
"$work/venv/bin/python" - <<'PYTHON'
import json
import pathlib
import sys
import unittest.mock

# Imported for images, videos and point clouds, and not called here.
for name in ("cv2", "imageio", "rawpy", "nerfstudio.utils.rich_utils", "nerfstudio.utils.scripts"):
    sys.modules[name] = unittest.mock.MagicMock()
from nerfstudio.process_data.odm_utils import cameras2nerfds

# A lens as OpenSfM writes it: a focal length of 0.85 and a principal point off by 0.02 of the longer side.
w, h, focal, c_x, c_y = 4000, 3000, 0.85, 0.02, -0.01
lens = {"projection_type": "brown", "width": w, "height": h, "focal_x": focal, "focal_y": focal, "c_x": c_x, "c_y": c_y,
        "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0}
shot = {"camera": "lens", "rotation": [0.0, 0.0, 0.0], "translation": [0.0, 0.0, 0.0]}
pathlib.Path("cameras.json").write_text(json.dumps({"lens": lens}))
pathlib.Path("reconstruction.json").write_text(json.dumps([{"cameras": {"lens": lens}, "shots": {"a.jpg": shot}, "points": {}}]))
cameras2nerfds({"a": pathlib.Path("a.jpg")}, pathlib.Path("cameras.json"), pathlib.Path("shots.geojson"),
               pathlib.Path("reconstruction.json"), pathlib.Path("."))
frame = json.loads(pathlib.Path("transforms.json").read_text())["frames"][0]
cx, cy = w / 2 + c_x * max(w, h), h / 2 + c_y * max(w, h)
off = (frame["cx"] - cx, frame["cy"] - cy)
print("nerfstudio 1.1.5: focal_x = 0.85, c_x = 0.02, c_y = -0.01 in the cameras.json of a photo of 4000 x 3000 pixels")
print(f"fl_x = {frame['fl_x']:.1f}; principal point ({frame['cx']:.2f}, {frame['cy']:.2f}), meant is ({cx:.0f}, {cy:.0f})")
print(f"every pixel is off by ({off[0]:.1f}, {off[1]:.1f}) pixels: put cx and cy right before you use the file.")
wrong = abs(off[0] + 80.48) < 0.01 and abs(off[1] - 39.49) < 0.01 and frame["fl_x"] == focal * w
raise SystemExit(0 if wrong else "the behavior has changed")
PYTHON
