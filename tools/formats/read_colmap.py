"""Reads what `reconstruct SCENE --format colmap` wrote by pycolmap and by nerfstudio's own reader, and compares it with the scene.

usage: read_colmap.py OUT/colmap SCENE/transforms_train.json    (needs pycolmap, and `pip install --no-deps nerfstudio`)
Prints a line of JSON: versions, numbers of photos and points, and the largest differences: of poses, of intrinsics in pixels, between the
two readers' points.
"""

import importlib.metadata
import json
import pathlib
import struct
import sys

import numpy as np
import pycolmap
from nerfstudio.data.utils.colmap_parsing_utils import qvec2rotmat, read_model

folder, scene = pathlib.Path(sys.argv[1]), json.loads(pathlib.Path(sys.argv[2]).read_text())
pycolmap.logging.minloglevel = 2
model = pycolmap.Reconstruction(str(folder / "sparse/0"))
cameras, images, points = read_model(folder / "sparse/0", ext=".bin")


def size(png):
    """Width and height of a PNG file, from its head."""
    return struct.unpack(">II", png.read_bytes()[16:24])


# The scene's poses are camera to world with OpenGL's axes, its field of view is that of the width.
frames = {pathlib.PurePosixPath(f["file_path"]).name: np.array(f["transform_matrix"]) for f in scene["frames"]}
pose = intrinsics = 0.0
for image in images.values():
    theirs = model.images[image.id]
    assert theirs.name == image.name, (theirs.name, image.name)
    camera, other = cameras[image.camera_id], model.cameras[theirs.camera_id]
    assert camera.model == other.model_name == "PINHOLE", (camera.model, other.model_name)
    width, height = size(folder / "images" / image.name)
    assert (width, height) == (camera.width, camera.height) == (other.width, other.height), image.name
    c2w = frames[pathlib.Path(image.name).stem] @ np.diag([1.0, -1.0, -1.0, 1.0])
    truth = np.linalg.inv(c2w)[:3]
    found = np.concatenate([qvec2rotmat(image.qvec), image.tvec[:, None]], 1)
    pose = max(pose, np.abs(found - truth).max(), np.abs(theirs.cam_from_world().matrix() - truth).max())
    focal = 0.5 * width / np.tan(0.5 * scene["camera_angle_x"])
    expected = np.array([focal, focal, 0.5 * width, 0.5 * height])
    intrinsics = max(intrinsics, np.abs(camera.params - expected).max(), np.abs(np.array(other.params) - expected).max())
apart = max(np.abs(points[i].xyz - p.xyz).max() + np.abs(points[i].rgb.astype(int) - p.color).max() for i, p in model.points3D.items())
versions = [importlib.metadata.version(name) for name in ("pycolmap", "nerfstudio")]
print(json.dumps({"versions": versions, "photos": [len(images), model.num_reg_images()], "points": [len(points), model.num_points3D()],
                  "pose": float(pose), "intrinsics": float(intrinsics), "apart": float(apart)}))
