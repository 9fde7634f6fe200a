"""The event files of `freerange train` in TensorBoard's own reader, beside `log.jsonl`."""

import io
import json
import subprocess
import time

import numpy as np
import pytest
from PIL import Image

event_accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")

CONFIG = """
seed = 5
model = { image_size = 16, hidden = 16, blocks = 1, heads = 2, registers = 2, gaussians_per_token = 4, time_features = 8, encoder = { kind = "patch", patch_size = 8, channels = 4 } }
loss = { held_views = 1, input_views = [2, 2], render_size = 16, gradient_size = 16 }
validation = { every = 20, objects = 2 }
stage = [{ depth = 3, image_size = 16, batch = 2, steps = 60 }]

[sample]
steps = 1
cfg_scale = 1.0
gradient_size = 16

[data]
window = 5
fresh = 2
workers = 2
statistics_objects = 2

[data.object]
views = 4
samples_per_axis = 1

[data.object.cameras]
resolution = 16

[data.object.surface]
points = 64
"""


def test_a_killed_and_resumed_run(program, tmp_path):
    (tmp_path / "config.toml").write_text(CONFIG)
    run = tmp_path / "run"
    command = [program, "train", tmp_path / "config.toml", "-o", run, "--save-every", "7", "--device", "cpu"]
    for least in (7, 28):
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while not any(int(state.name.removeprefix("state-")) >= least for state in run.glob("state-*[0-9]")):
            assert child.poll() is None, "it ended before it was killed"
            time.sleep(0.001)
        time.sleep(0.01)
        child.kill()
        assert child.wait() != 0
    subprocess.run(command, check=True, capture_output=True)

    files = sorted(run.glob("events.out.tfevents.*"))
    assert len(files) == 3
    # Nothing is left for the reader to sort out.
    read = event_accumulator.EventAccumulator(
        str(run), size_guidance={"images": 0, "tensors": 0, "scalars": 0}, purge_orphaned_data=False
    )
    read.Reload()
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    steps = [line for line in lines if "loss" in line]
    validations = [line for line in lines if "validation" in line]
    assert [line["step"] for line in steps] == list(range(1, 61)) and len(validations) == 3

    tags = read.Tags()
    assert {f"train/{f}" for f in steps[0] if f != "step"} | {
        f"validation/{f}" for f in validations[0]["validation"]
    } == set(tags["scalars"])
    for field in ("loss", "flow", "gradient_norm", "learning_rate", "seconds"):
        found = [(event.step, event.value) for event in read.Scalars(f"train/{field}")]
        assert found == [(line["step"], float(np.float32(line[field]))) for line in steps]
    found = [(event.step, event.value) for event in read.Scalars("validation/psnr")]
    assert found == [(line["step"], float(np.float32(line["validation"]["psnr"]))) for line in validations]

    assert tags["images"] == ["validation/sample 0", "validation/sample 1"]
    for tag in tags["images"]:
        pictures = read.Images(tag)
        assert [p.step for p in pictures] == [20, 40, 60]
        for picture in pictures:
            image = np.asarray(Image.open(io.BytesIO(picture.encoded_image_string)))
            # Two views of 16 pixels beside each other, the object's above the sample's.
            assert image.shape == (32, 32, 4) and (picture.height, picture.width) == image.shape[:2]
            assert not np.array_equal(image[:16], image[16:])
