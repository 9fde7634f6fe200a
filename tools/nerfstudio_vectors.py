"""Scenes by nerfstudio's own converters: references for the readers of transforms.json, Polycam, RealityCapture and Metashape.

usage: nerfstudio_vectors.py OUT    (needs numpy, pillow, and `pip install --no-deps nerfstudio==1.1.5`; OUT is tests/golden/nerfstudio)
OUT/colmap/MODEL.json is what becomes of tests/golden/cameras/MODEL. In the other folders lie a tool's file, written here after its
documentation, and transforms.json, which nerfstudio makes of it. What nerfstudio imports besides, PyTorch among it, is not called.
"""
import json
import pathlib
import shutil
import sys
import unittest.mock

import numpy as np
from PIL import Image

# Imported by the converters for depth maps, videos and point clouds.
for name in ("appdirs", "cv2", "imageio", "open3d", "packaging", "packaging.version", "rawpy", "requests", "rich", "rich.progress", "torch",
             "nerfstudio.utils.colormaps", "nerfstudio.utils.rich_utils", "nerfstudio.utils.scripts"):
    sys.modules[name] = unittest.mock.MagicMock()

from nerfstudio.process_data import colmap_utils, metashape_utils, polycam_utils, realitycapture_utils

# Those of COLMAP's models that nerfstudio converts; the rig has two cameras.
MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "rig")
# Heading, pitch and roll in degrees, and places.
ANGLES = [(0.0, 0.0, 0.0), (35.0, 70.0, -10.0), (-110.0, 40.0, 25.0)]
PLACES = [(1.0, -2.0, 3.0), (-4.0, 0.5, 2.5), (0.25, 3.0, -1.0)]
SIZES = [(640, 480), (640, 480), (480, 640)]


def rotation(heading, pitch, roll):
    """A rotation in no special position."""
    h, p, r = np.radians([heading, pitch, roll])
    z = np.array([[np.cos(h), -np.sin(h), 0], [np.sin(h), np.cos(h), 0], [0, 0, 1]])
    x = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
    y = np.array([[np.cos(r), 0, np.sin(r)], [0, 1, 0], [-np.sin(r), 0, np.cos(r)]])
    return z @ x @ y


def photos(folder, sizes):
    """Black images 1.png, 2.png, ..."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for i, size in enumerate(sizes):
        Image.new("RGB", size).save(folder / f"images/{i + 1}.png")
    return {str(i + 1): pathlib.Path(f"images/{i + 1}.png") for i in range(len(sizes))}


def of_colmap(out):
    # Points are of no use here, and their file is not there.
    colmap_utils.create_ply_from_colmap = lambda *_: None
    cameras = pathlib.Path(__file__).parent.parent / "tests/golden/cameras"
    out.mkdir(parents=True)
    for model in MODELS:
        colmap_utils.colmap_to_json(cameras / model, out)
        (out / "transforms.json").rename(out / f"{model}.json")


def of_realitycapture(out):
    named = photos(out, SIZES)
    rows = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for i, ((x, y, z), (h, p, r)) in enumerate(zip(PLACES, ANGLES)):
        rows.append(f"{i + 1}.png,{x},{y},{z},{h},{p},{r},{27.5 + i},{0.01 * i},-0.02,-0.08,0.02,0.001,0.0005,0.003,-0.004")
    (out / "cameras.csv").write_text("\n".join(rows) + "\n")
    realitycapture_utils.realitycapture_to_json(named, out / "cameras.csv", None, out)


def of_polycam(out):
    photos(out, SIZES)
    (out / "cameras").mkdir()
    for i, (place, angles, (w, h)) in enumerate(zip(PLACES, ANGLES, SIZES)):
        m = np.concatenate([rotation(*angles), np.array(place)[:, None]], 1)
        camera = {f"t_{row}{column}": m[row, column] for row in range(3) for column in range(4)}
        camera |= {"fx": 500.0 + i, "fy": 501.0, "cx": 0.5 * w + 1.5, "cy": 0.5 * h - 2.0, "width": w, "height": h, "blur_score": 90.0}
        (out / f"cameras/{i + 1}.json").write_text(json.dumps(camera, indent=1) + "\n")
    files = [out / f"images/{i + 1}.png" for i in range(len(SIZES))]
    polycam_utils.polycam_to_json(files, [], None, out / "cameras", out)


def of_metashape(out):
    named = photos(out, [(640, 480)] * 3)
    # Tangential distortion is left out: nerfstudio hands Metashape's p1 and p2 on as OpenCV's, which are p2 and p1.
    calibration = "<f>500</f><cx>1.5</cx><cy>-2</cy><k1>-0.1</k1><k2>0.02</k2><k3>0.003</k3>"
    size = '<resolution width="640" height="480"/>'
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<document version="2.0.0"><chunk label="Chunk 1" enabled="true">',
             f'<sensors><sensor id="0" type="frame">{size}<calibration type="frame" class="adjusted">{size}{calibration}</calibration></sensor>',
             "</sensors><components/><cameras>"]
    for i, (place, angles) in enumerate(zip(PLACES, ANGLES)):
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = rotation(*angles), place
        text = " ".join(repr(float(v)) for v in m.flatten())
        lines.append(f'<camera id="{i}" sensor_id="0" label="{i + 1}"><transform>{text}</transform></camera>')
    lines.append("</cameras></chunk></document>")
    (out / "cameras.xml").write_text("\n".join(lines) + "\n")
    metashape_utils.metashape_to_json(named, out / "cameras.xml", out)


def main():
    out = pathlib.Path(sys.argv[1])
    shutil.rmtree(out, ignore_errors=True)
    of_colmap(out / "colmap")
    of_realitycapture(out / "realitycapture")
    of_polycam(out / "polycam")
    of_metashape(out / "metashape")
    # Tests make the images: only their sizes count.
    for tool in ("realitycapture", "polycam", "metashape"):
        shutil.rmtree(out / tool / "images")


main()
