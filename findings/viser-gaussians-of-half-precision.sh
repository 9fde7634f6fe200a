#!/bin/sh
# viser keeps covariances of Gaussians as 16-bit floats: below 0.17 thousandths in size they become zero, and up to a
# thousandth they jump, without a word. Expected: 32 bits, as for the centers, or a warning. Found with 1.1.1.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" -q install --only-binary :all: viser==1.1.1 numpy==2.3.5
cd "$work"
"$work/venv/bin/python" -W error - <<'PYTHON'
import numpy as np
import viser

# Standard deviations in meters, as in the scene of an object some centimeters across.
sizes = np.array([10e-3, 1e-3, 0.4e-3, 0.3e-3, 0.2e-3, 0.15e-3, 0.1e-3])
n = len(sizes)
server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)

def kept(name, unit):
    """The same Gaussians in other units: `scale` of viser brings them back."""
    handle = server.scene.add_gaussian_splats(
        name, centers=np.zeros((n, 3)), covariances=np.eye(3) * ((sizes / unit) ** 2)[:, None, None],
        rgbs=np.ones((n, 3)), opacities=np.ones((n, 1)), scale=unit)
    return unit * np.sqrt(handle.covariances[:, 0, 0].astype(float))

meters, millimeters = kept("/meters", 1.0), kept("/millimeters", 1e-3)
server.stop()
print("viser", viser.__version__, "standard deviations in millimeters")
rows = {"given": sizes, "kept, scene in meters": meters, "kept, millimeters and scale=0.001": millimeters}
for name, values in rows.items():
    print(f"{name:34}", " ".join(f"{1e3 * v:7.3f}" for v in values))
print("Round Gaussians of 0.15 mm become points without size. Give viser small scenes in small units, and its scale.")
lost = (meters[-2:] == 0).all() and abs(meters[4] / sizes[4] - 1) > 0.15
raise SystemExit(0 if lost and np.abs(millimeters / sizes - 1).max() < 1e-3 else "the behavior has changed")
PYTHON
