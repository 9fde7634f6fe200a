"""What tests share. `FREERANGE` names the command line's program where it is to be compared with."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import freerange

ROOT = Path(__file__).resolve().parents[2]
BOWL = ROOT / "examples" / "bowl"


@pytest.fixture(scope="session")
def model():
    return freerange.load(device="cpu")


@pytest.fixture(scope="session")
def bowl():
    """The example, read without this package: images [4, h, w, 4], K [4, 3, 3], c2w [4, 4, 4] in OpenGL's axes."""
    told = json.loads((BOWL / "transforms_train.json").read_text())
    images, intrinsics, poses = [], [], []
    for frame in told["frames"]:
        file = BOWL / frame["file_path"]
        image = np.asarray(Image.open(file if file.suffix else file.with_suffix(".png")))
        h, w = image.shape[:2]
        focal = 0.5 * w / np.tan(0.5 * told["camera_angle_x"])
        images.append(image)
        intrinsics.append([[focal, 0, 0.5 * w], [0, focal, 0.5 * h], [0, 0, 1]])
        poses.append(frame["transform_matrix"])
    return np.stack(images), np.array(intrinsics), np.array(poses)


@pytest.fixture(scope="session")
def program():
    """The command line's program."""
    if "FREERANGE" not in os.environ:
        pytest.skip("FREERANGE does not name the command line's program")
    return os.environ["FREERANGE"]


@pytest.fixture
def scattered():
    """A few Gaussians that every pixel of a small picture shows, and their camera: nothing is cut off anywhere, so that pictures are smooth
    in all numbers."""
    random = np.random.default_rng(7)
    n = 5
    gaussians = {
        "means": random.uniform(-0.15, 0.15, (n, 3)) + [[0.0, 0.0, 0.1 * i] for i in range(n)],
        "scales": random.uniform(0.35, 0.6, (n, 3)),
        "quats": random.normal(size=(n, 4)),
        "opacities": random.uniform(0.3, 0.7, n),
        "colors": random.uniform(0.0, 1.0, (n, 3)),
    }
    c2w = np.eye(4)
    c2w[:3, 3] = [0.05, -0.1, -2.0]
    k = np.array([[9.0, 0.0, 4.0], [0.0, 8.5, 3.2], [0.0, 0.0, 1.0]])
    return gaussians, c2w, k, 8, 6
