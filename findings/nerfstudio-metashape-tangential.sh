#!/bin/sh
# nerfstudio hands Metashape's p1 and p2 on under the same names: OpenCV's p1 is Metashape's p2, and the other way around.
# Found with 1.1.5. Metashape's manual, appendix on camera models: x' = .. + p1 (r2 + 2 x2) + 2 p2 x y.
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
for name in ("cv2", "imageio", "open3d", "rawpy", "nerfstudio.utils.rich_utils", "nerfstudio.utils.scripts"):
    sys.modules[name] = unittest.mock.MagicMock()
from nerfstudio.process_data.metashape_utils import metashape_to_json

p1, p2, f = 0.004, 0.0, 3000.0
size = '<resolution width="4000" height="3000"/>'
pathlib.Path("cameras.xml").write_text(
    f'<document><chunk><sensors><sensor id="0" type="frame">{size}<calibration type="frame">{size}<f>{f}</f><p1>{p1}</p1><p2>{p2}</p2>'
    '</calibration></sensor></sensors><cameras><camera id="0" sensor_id="0" label="0"><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform>'
    "</camera></cameras></chunk></document>")
metashape_to_json({"0": pathlib.Path("0.png")}, pathlib.Path("cameras.xml"), pathlib.Path("."))
frame = json.loads(pathlib.Path("transforms.json").read_text())["frames"][0]
x, y = 0.6, -0.45
r2 = x * x + y * y
metashape = (x + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y, y + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y)
q1, q2 = frame["p1"], frame["p2"]
opencv = (x + 2 * q1 * x * y + q2 * (r2 + 2 * x * x), y + q1 * (r2 + 2 * y * y) + 2 * q2 * x * y)
apart = [f * (a - b) for a, b in zip(metashape, opencv)]
print("nerfstudio 1.1.5: Metashape's p1 = 0.004, p2 = 0; in its transforms.json, whose model is OPENCV:", f"p1 = {q1}, p2 = {q2}")
print(f"near a corner of a photo of 4000 x 3000 pixels a point is off by ({apart[0]:.1f}, {apart[1]:.1f}) pixels")
print("Our reader exchanges the two.")
raise SystemExit(0 if (q1, q2) == (p1, p2) else "the behavior has changed")
PYTHON
