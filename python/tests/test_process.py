"""Processes and signals, in programs of their own."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from PIL import Image

from conftest import BOWL

FORK = """
import multiprocessing, sys
import numpy as np
import freerange

gaussians = freerange.Gaussians([[0, 0, 0]], [[0.1, 0.1, 0.1]], [[1, 0, 0, 0]], [0.9], [[1, 0, 0]])
model = freerange.load(device="cpu")
camera = (np.eye(4)[:3] + [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, -2]], np.diag([9.0, 9.0, 1.0]), 8, 8)
work = {
    "render": lambda: gaussians.render(*camera),
    "read": lambda: freerange.Scene.read(sys.argv[1]),
    "reconstruct": lambda: model.reconstruct_scene(sys.argv[1], iterations=0, symmetry="off", set={"refine.passes": 1}),
}

def child(name, queue):
    try:
        work[name]()
        queue.put("done")
    except Exception as error:
        queue.put(f"{type(error).__name__}: {error}")

def forked(name):
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    process = context.Process(target=child, args=(name, queue))
    process.start()
    try:
        return queue.get(timeout=60)
    finally:
        process.kill()

before = [forked(name) for name in work]
work["render"]()
after = [forked(name) for name in work]
work["render"]()
print(before)
print(after)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
def test_a_fork_after_use_is_refused_and_before_it_works():
    """The threads are gone in it: it would wait for good."""
    run = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", FORK, str(BOWL)], capture_output=True, text=True, timeout=500
    )
    assert run.returncode == 0, run.stderr
    before, after = (eval(line) for line in run.stdout.splitlines())
    assert before == ["done"] * 3
    assert all(a.startswith("RuntimeError: ") and "'spawn'" in a and "fork of process" in a for a in after), after


def on_a_table(folder):
    """The example before noise, without masks: it takes a while to find that there is no object."""
    random = np.random.default_rng(0)
    frames = []
    for name in ("train", "test"):
        root = json.loads((BOWL / f"transforms_{name}.json").read_text())
        for frame in root["frames"]:
            file = BOWL / frame["file_path"]
            image = np.asarray(Image.open(file if file.suffix else file.with_suffix(".png"))).astype(np.float64)
            share = image[..., 3:] / 255
            noise = Image.fromarray(random.integers(0, 255, (24, 24, 3), dtype=np.uint8)).resize(image.shape[1::-1])
            made = np.rint(image[..., :3] * share + np.asarray(noise) * (1 - share)).astype(np.uint8)
            Image.fromarray(made).save(folder / f"{len(frames)}.png")
            frames.append({"file_path": f"{len(frames)}.png", "transform_matrix": frame["transform_matrix"]})
    told = {"camera_angle_x": root["camera_angle_x"], "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(told))


SEARCH = """
import json, signal, sys, time
import numpy as np
from PIL import Image
import freerange

# What is started in the background inherits that interrupts are ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
folder = sys.argv[1]
root = json.load(open(folder + "/transforms.json"))
images = np.stack([np.asarray(Image.open(f"{folder}/{frame['file_path']}")) for frame in root["frames"]])
c2w = np.array([frame["transform_matrix"] for frame in root["frames"]])
focal = 256 / np.tan(0.5 * root["camera_angle_x"])
k = np.array([[[focal, 0, 256], [0, focal, 256], [0, 0, 1]]]).repeat(len(images), axis=0)
model = freerange.load(device="cpu")
work = {
    "read": lambda: freerange.Scene.read(folder),
    "arrays": lambda: model.reconstruct(images, k, c2w, convention="opengl"),
}[sys.argv[2]]
print("begin", flush=True)
try:
    work()
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@pytest.mark.parametrize("what", ["read", "arrays"])
def test_ctrl_c_ends_the_search_for_masks(tmp_path, what):
    on_a_table(tmp_path)
    child = subprocess.Popen([sys.executable, "-c", SEARCH, str(tmp_path), what], stdout=subprocess.PIPE, text=True)
    assert child.stdout.readline() == "begin\n"
    time.sleep(1.5)
    begin = time.monotonic()
    child.send_signal(signal.SIGINT)
    assert child.stdout.readline() == "interrupted\n"
    assert time.monotonic() - begin < 1.0
    assert child.wait() == 0 and time.monotonic() - begin < 5.0
