#!/bin/sh
# nerfstudio divides the place of each Metashape component by the component's own scale: two components of different scale
# that lie right in Metashape come apart. Found with 1.1.5.
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

# A component's transform is scale * rotation * x + translation. Both cameras stand at (4, 2, 0) of the chunk.
moved = lambda id, scale, shift: (
    f'<component id="{id}"><transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>{shift}</translation>'
    f"<scale>{scale}</scale></transform></component>")
camera = lambda id, place: (
    f'<camera id="{id}" sensor_id="0" component_id="{id}" label="{id}"><transform>1 0 0 {place[0]} 0 1 0 {place[1]} 0 0 1 {place[2]} 0 0 0 1'
    "</transform></camera>")
size = '<resolution width="64" height="48"/>'
pathlib.Path("cameras.xml").write_text(
    f'<document><chunk><sensors><sensor id="0" type="frame">{size}<calibration type="frame">{size}<f>60</f></calibration></sensor></sensors>'
    f'<components>{moved(0, 1, "0 0 0")}{moved(1, 2, "2 0 0")}</components>'
    f"<cameras>{camera(0, (4, 2, 0))}{camera(1, (1, 1, 0))}</cameras></chunk></document>")
metashape_to_json({"0": pathlib.Path("0.png"), "1": pathlib.Path("1.png")}, pathlib.Path("cameras.xml"), pathlib.Path("."))
frames = json.loads(pathlib.Path("transforms.json").read_text())["frames"]
# Its world has the axes z, x, y of Metashape's.
places = [[round(f["transform_matrix"][row][3], 6) for row in (1, 2, 0)] for f in frames]
print("nerfstudio 1.1.5: two cameras at (4, 2, 0) of the chunk, in components of scale 1 and 2")
print("places in its transforms.json:", places)
print("Our reader moves each component by its whole transform.")
raise SystemExit(0 if places == [[4, 2, 0], [2, 1, 0]] else "the behavior has changed")
PYTHON
