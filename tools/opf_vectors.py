"""A small project of Pix4D's OPF, written by pyopf, and where its cameras stand and look: reference for the reader.

usage: opf_vectors.py OUT        (needs pyopf 1.4.1; OUT is tests/golden/opf)
"""
import json
import pathlib
import sys
import uuid

import numpy as np
from pyopf.cameras import CameraData, CameraList, PerspectiveInternals
from pyopf.cameras.calibrated_cameras import CalibratedCameras, CalibratedSensor, CalibratedCamera
from pyopf.io import save
from pyopf.project import Calibration, CoreProjectItemType, Project, ProjectItem, ProjectResource
from pyopf.formats import CoreFormat
from pyopf.uid64 import Uid64

ANGLES = [(0.0, 0.0, 0.0), (35.0, -20.0, 110.0), (-60.0, 15.0, -75.0)]  # omega, phi, kappa


def rotation(omega, phi, kappa):
    """Camera to world by the specification: R_x(omega) R_y(phi) R_z(kappa), camera axes right, up, back."""
    o, p, k = np.radians([omega, phi, kappa])
    x = np.array([[1, 0, 0], [0, np.cos(o), -np.sin(o)], [0, np.sin(o), np.cos(o)]])
    y = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    z = np.array([[np.cos(k), -np.sin(k), 0], [np.sin(k), np.cos(k), 0], [0, 0, 1]])
    return x @ y @ z


def main():
    out = pathlib.Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    internals = PerspectiveInternals(np.array([321.5, 238.0]), 500.0, np.array([-0.08, 0.02, 0.001]), np.array([0.003, -0.004]))
    sensor = CalibratedSensor(Uid64(int=7), internals)
    positions = [(1.0, -2.0, 3.0), (-4.0, 0.5, 2.5), (0.25, 3.0, -1.0)]
    cameras = [CalibratedCamera(Uid64(int=10 + i), Uid64(int=7), np.array(a), np.array(p)) for i, (a, p) in enumerate(zip(ANGLES, positions))]
    save(CalibratedCameras(cameras, [sensor]), str(out / "calibrated_cameras.json"))
    save(CameraList([CameraData(Uid64(int=10 + i), f"images/{i}.jpg") for i in range(3)]), str(out / "camera_list.json"))
    def item(kind, uri, form):
        return ProjectItem(uuid.UUID(int=len(uri)), kind, [ProjectResource(uri=uri, format=form)], [])
    items = [
        item(CoreProjectItemType.CALIBRATION, "calibrated_cameras.json", CoreFormat.CALIBRATED_CAMERAS),
        item(CoreProjectItemType.CAMERA_LIST, "camera_list.json", CoreFormat.CAMERA_LIST),
    ]
    save(Project(uuid.UUID(int=1), "three photos", "", items), str(out / "project.opf"))
    truth = [{"center": list(p), "axes": (rotation(*a) @ np.diag([1.0, -1.0, -1.0])).T.tolist()} for a, p in zip(ANGLES, positions)]
    (out / "expected.json").write_text(json.dumps(truth, indent=1) + "\n")


main()
