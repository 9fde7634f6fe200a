#!/bin/sh
# COLMAP writes names with spaces into images.txt, and reads them back up to the first space.
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
for image in made.images.values():
    image.name = f"map plan {image.image_id}.jpg"
pathlib.Path("text").mkdir()
made.write_text("text")
read = sorted(image.name for image in pycolmap.Reconstruction("text").images.values())
print("pycolmap", pycolmap.__version__)
print("written:", sorted(image.name for image in made.images.values()))
print("read back:", read)
print("Our reader takes the rest of the line as the name. Binary models keep names.")
raise SystemExit(0 if read == ["map", "map"] else "the behavior has changed")
PYTHON
