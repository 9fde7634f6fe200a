#!/bin/sh
# COLMAP 4 takes poses from frames and passes over those of images: scripts that move only images.txt change nothing.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" -q install pycolmap==4.2.1
cd "$work"
"$work/venv/bin/python" - <<'PYTHON'
import pathlib
import pycolmap

pycolmap.logging.minloglevel = 2
options = pycolmap.SyntheticDatasetOptions()
options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 2, 3
made = pycolmap.synthesize_dataset(options)
folder = pathlib.Path("text")
folder.mkdir()
made.write_text(folder)

def distance():
    return next(iter(pycolmap.Reconstruction(folder).images.values())).cam_from_world().translation[2]

before = distance()
lines = (folder / "images.txt").read_text().splitlines()
moved = []
for line in lines:
    words = line.split()
    if len(words) == 10 and not line.startswith("#"):
        words[5:8] = [str(10 * float(w)) for w in words[5:8]]
    moved.append(" ".join(words))
(folder / "images.txt").write_text("\n".join(moved) + "\n")
after = distance()
for name in ("rigs.txt", "frames.txt"):
    (folder / name).unlink()
without = distance()
print("pycolmap", pycolmap.__version__)
print(f"depth as written {before:.3f}; images.txt ten times as far {after:.3f}; the same without rigs.txt and frames.txt {without:.3f}")
print("Our reader takes images.txt and warns where the two differ.")
raise SystemExit(0 if abs(after - before) < 1e-6 and abs(without - 10 * before) < 1e-6 else "the behavior has changed")
PYTHON
