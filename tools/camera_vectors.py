"""Reference vectors for the readers of cameras: COLMAP models of every kind and lenses, made by pycolmap and OpenCV.

usage: camera_vectors.py OUT        (needs pycolmap 4.2 and opencv-python-headless; OUT is tests/golden/cameras)
OUT/NAME/ holds a COLMAP model, binary and text; OUT/expected.json where points of the world appear in its images, where rays on a grid
appear, and where OpenCV puts points of the ideal image plane for some lenses.
"""
import json
import pathlib
import shutil
import sys

import cv2
import numpy as np
import pycolmap

READ = {
    "SIMPLE_PINHOLE": [500.0, 321.5, 238.0],
    "PINHOLE": [500.0, 510.0, 321.5, 238.0],
    "SIMPLE_RADIAL": [500.0, 321.5, 238.0, -0.08],
    "RADIAL": [500.0, 321.5, 238.0, -0.08, 0.02],
    "OPENCV": [500.0, 510.0, 321.5, 238.0, -0.08, 0.02, 0.003, -0.004],
    "OPENCV_FISHEYE": [300.0, 305.0, 321.5, 238.0, 0.05, -0.02, 0.01, -0.003],
    "FULL_OPENCV": [500.0, 510.0, 321.5, 238.0, 0.3, -0.05, 0.003, -0.004, 0.01, 0.35, -0.02, 0.005],
    "FOV": [400.0, 405.0, 321.5, 238.0, 0.9],
    "SIMPLE_RADIAL_FISHEYE": [300.0, 321.5, 238.0, -0.03],
    "RADIAL_FISHEYE": [300.0, 321.5, 238.0, -0.03, 0.005],
    "THIN_PRISM_FISHEYE": [300.0, 305.0, 321.5, 238.0, 0.05, -0.02, 0.003, -0.004, 0.01, -0.003, 0.002, -0.001],
    "RAD_TAN_THIN_PRISM_FISHEYE": [300.0, 305.0, 321.5, 238.0, 0.05, -0.02, 0.01, -0.003, 0.001, -0.0002, 0.003, -0.004,
                                   0.002, -0.001, 0.0015, 0.0005],
    "SIMPLE_DIVISION": [500.0, 321.5, 238.0, -0.12],
    "DIVISION": [500.0, 510.0, 321.5, 238.0, 0.1],
    "SIMPLE_FISHEYE": [300.0, 321.5, 238.0],
    "FISHEYE": [300.0, 305.0, 321.5, 238.0],
    "EUCM": [350.0, 355.0, 321.5, 238.0, 0.6, 1.1],
    "EQUIRECTANGULAR": [640.0, 480.0],
}


def grid(name):
    """Rays on a grid of angles from the axis and around it, and where they appear; none for those behind that a model cannot show."""
    camera = pycolmap.Camera(model=name, width=640, height=480, params=READ[name])
    wide = "FISHEYE" in name or name in ("EUCM", "EQUIRECTANGULAR")
    angles = [0.0, 10.0, 25.0, 40.0] + ([60.0, 80.0, 95.0, 110.0] if wide else [])
    rays = []
    for angle in np.radians(angles):
        for turn in np.radians([7.0, 97.0, 187.0, 277.0, 322.0]):
            ray = [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)]
            pixel = camera.img_from_cam(np.array(ray))
            rays.append([ray, None if pixel is None else pixel.tolist()])
    return rays


def model(out, name, params):
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 3
    options.num_points3D, options.num_points2D_without_point3D = 4, 1
    options.camera_width, options.camera_height = 640, 480
    made = pycolmap.synthesize_dataset(options)
    # Poses are made with a lens of the default kind; the camera is exchanged afterwards, as only the files matter.
    camera = made.cameras[1]
    camera.model = getattr(pycolmap.CameraModelId, name)
    camera.params = params
    folder = out / name
    folder.mkdir(parents=True)
    made.write_binary(folder)
    made.write_text(folder)
    for file in folder.iterdir():
        if file.stem not in ("cameras", "images"):
            file.unlink()
    points = [[0.0, 0.0, 0.0], [0.5, -0.3, 0.2], [-0.7, 0.4, 0.6]]
    images = {}
    for image in made.images.values():
        in_camera = [image.cam_from_world() * np.array(p) for p in points]
        images[image.name] = [camera.img_from_cam(p).tolist() for p in in_camera]
    return {"points": points, "images": images}


def rig(out):
    """A model of a rig with two cameras that stand apart, and where points appear in its images."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 2, 2
    options.num_points3D, options.num_points2D_without_point3D = 3, 0
    options.camera_width, options.camera_height = 640, 480
    options.sensor_from_rig_translation_stddev, options.sensor_from_rig_rotation_stddev = 0.3, 10.0
    made = pycolmap.synthesize_dataset(options)
    folder = out / "rig"
    folder.mkdir(parents=True)
    made.write_binary(folder)
    made.write_text(folder)
    for file in folder.iterdir():
        if file.stem == "points3D":
            file.unlink()
    return {image.name: image.projection_center().tolist() for image in made.images.values()}


def lenses():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.7, 0.7, (12, 2))
    eye, zero = np.eye(3), np.zeros(3)
    three = np.concatenate([points, np.ones((12, 1))], 1).reshape(-1, 1, 3)
    brown = np.array([-0.2, 0.05, 0.003, -0.004, 0.01, 0.1, 0.02, -0.01])  # k1 k2 p1 p2 k3 k4 k5 k6
    fish = np.array([0.05, -0.02, 0.01, -0.003])
    shown = cv2.projectPoints(three, zero, zero, eye, brown)[0].reshape(-1, 2)
    fished = cv2.fisheye.distortPoints(points.reshape(-1, 1, 2), eye, fish).reshape(-1, 2)
    return {"points": points.tolist(), "brown": brown.tolist(), "brown_shown": shown.tolist(),
            "fisheye": fish.tolist(), "fisheye_shown": fished.tolist()}


def main():
    out = pathlib.Path(sys.argv[1])
    shutil.rmtree(out, ignore_errors=True)
    names = sorted(n for n in pycolmap.CameraModelId.__members__ if n != "INVALID")
    assert names == sorted(READ), names
    models = {name: model(out, name, READ[name]) for name in READ}
    expected = {"pycolmap": pycolmap.__version__, "models": models, "rays": {name: grid(name) for name in READ}, "rig": rig(out),
                "lenses": lenses()}
    (out / "expected.json").write_text(json.dumps(expected, separators=(",", ":")) + "\n")


main()
