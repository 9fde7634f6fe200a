#!/bin/sh
# nerfstudio turns every camera around when OpenDroneMap's opensfm/reconstruction.json is missing (as in WebODM's downloads): it then
# reads shots.geojson, whose axes it leaves as they are. Expected: the same cameras from both files. Found with nerfstudio 1.1.5.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" -q install numpy==2.3.5
"$work/venv/bin/pip" -q install --no-deps nerfstudio==1.1.5
cd "$work"
"$work/venv/bin/python" - <<'PYTHON'
import json
import math
import pathlib
import sys
import unittest.mock

# Imported for images, videos and point clouds, and not called here.
for name in ("cv2", "imageio", "rawpy", "nerfstudio.utils.rich_utils", "nerfstudio.utils.scripts"):
    sys.modules[name] = unittest.mock.MagicMock()
from nerfstudio.process_data.odm_utils import cameras2nerfds

# A drone 50 m above the ground looks straight down: a half turn about x takes the world to the camera.
# reconstruction.json has that turn and the shift after it; ODM copies the same turn into shots.geojson, beside the camera's place.
turn, place = [math.pi, 0.0, 0.0], [3.0, 4.0, 50.0]
lens = {"projection_type": "perspective", "width": 400, "height": 300, "focal": 0.85, "c_x": 0.0, "c_y": 0.0, "k1": 0.0, "k2": 0.0}
shot = {"camera": "lens", "rotation": turn, "translation": [-place[0], place[1], place[2]]}
seen = {"type": "Feature", "properties": {"filename": "a.jpg", "focal": 0.85, "width": 400, "height": 300, "rotation": turn, "translation": place}}
write = lambda name, value: pathlib.Path(name).write_text(json.dumps(value))
write("cameras.json", {"lens": lens})
write("reconstruction.json", [{"cameras": {"lens": lens}, "shots": {"a.jpg": shot}, "points": {}}])
write("shots.geojson", {"type": "FeatureCollection", "features": [seen]})

def camera(reconstruction):
    cameras2nerfds({"a": pathlib.Path("a.jpg")}, pathlib.Path("cameras.json"), pathlib.Path("shots.geojson"),
                   pathlib.Path(reconstruction), pathlib.Path("."))
    pose = json.loads(pathlib.Path("transforms.json").read_text())["frames"][0]["transform_matrix"]
    # In transforms.json a camera looks along its own -z.
    return [round(row[3], 6) for row in pose[:3]], [round(-row[2], 6) + 0.0 for row in pose[:3]]

print("nerfstudio 1.1.5: one drone that looks down, read from both files of OpenDroneMap")
both, alone = camera("reconstruction.json"), camera("missing.json")
print("with reconstruction.json: place", both[0], "looks along", both[1])
print("from shots.geojson alone: place", alone[0], "looks along", alone[1])
print("Negate the second and third columns of each transform_matrix.")
wrong = both == (place, [0, 0, -1]) and alone == (place, [0, 0, 1])
raise SystemExit(0 if wrong else "the behavior has changed")
PYTHON
