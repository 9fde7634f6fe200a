#!/bin/sh
# evo scales the rotations too when a transformation has a scale: evo_traj writes 3 x 3 blocks of determinant 8 for a scale of 2, and
# evo_rpe finds meters of error between equal paths, exit code 0. Expected: rotations stay rotations, error 0. Found with 1.38.1.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" -q install evo==1.38.1 numpy==2.3.5 scipy==1.16.3
cd "$work"
export HOME="$work" MPLBACKEND=agg
cat > make.py <<'PY'
import numpy as np
from scipy.spatial.transform import Rotation

# A walk of 30 cameras, and the same walk twice as large: places doubled, rotations kept.
noise = np.random.default_rng(0)
places = np.cumsum(noise.normal(size=(30, 3)), 0)
turns = Rotation.from_quat(noise.normal(size=(30, 4))).as_matrix()
for name, scale in (("walk.txt", 1), ("twice.txt", 2)):
    np.savetxt(name, np.concatenate([turns, scale * places[..., None]], 2).reshape(30, 12))
PY
venv/bin/python make.py
echo '{"x": 0, "y": 0, "z": 0, "qx": 0, "qy": 0, "qz": 0, "qw": 1, "scale": 2}' > double.json
venv/bin/evo_traj kitti walk.txt --transform_left double.json --save_as_kitti > traj.log
venv/bin/evo_ape kitti twice.txt walk.kitti > ape.log
venv/bin/evo_rpe kitti twice.txt walk.kitti > rpe.log
venv/bin/evo_rpe kitti twice.txt twice.txt > same.log
venv/bin/python - <<'PY'
from importlib.metadata import version
import numpy as np

read = lambda name: next(float(line.split()[1]) for line in open(name) if line.split()[:1] == ["rmse"])
made, right = (np.loadtxt(name).reshape(30, 3, 4) for name in ("walk.kitti", "twice.txt"))
determinant = np.linalg.det(made[0, :, :3])
ape, rpe, same = read("ape.log"), read("rpe.log"), read("same.log")
print("evo", version("evo"), "evo_traj kitti --transform_left with scale 2 --save_as_kitti")
print(f"places right to {np.abs(made - right)[..., 3].max():.1e}; determinant of the first rotation {determinant:.3f}")
print(f"against the true path: evo_ape {ape:.3f} m, evo_rpe {rpe:.3f} m; the true path against itself: evo_rpe {same:.3f} m")
print("Divide each 3 x 3 block by the cube root of its determinant.")
wrong = abs(determinant - 8) < 1e-6 and ape < 1e-6 and rpe > 1 and same < 1e-6
raise SystemExit(0 if wrong else "the behavior has changed")
PY
