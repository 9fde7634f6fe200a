"""Sizes and errors of every format for one .ply, ours beside splat-transform's, as rows of a table.

    pip install numpy scipy plyfile; npm install @playcanvas/splat-transform@3.7.0
    python tools/formats/compare.py target/release/freerange node_modules/.bin/splat-transform gaussians.ply

Gaussians are matched by position, color, size and opacity, since writers sort. Colors are those of Gaussians with an
opacity above 0.02, in 255ths.
"""
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from plyfile import PlyData
from scipy.spatial import cKDTree

freerange, transform, source = sys.argv[1:4]


def read(path):
    rows = PlyData.read(str(path))["vertex"]
    column = lambda *names: np.stack([np.asarray(rows[n], np.float64) for n in names], 1)
    turn = column("rot_0", "rot_1", "rot_2", "rot_3")
    return {
        "position": column("x", "y", "z"),
        "scale": column("scale_0", "scale_1", "scale_2"),
        "rotation": turn / np.linalg.norm(turn, axis=1, keepdims=True),
        "opacity": 1 / (1 + np.exp(-column("opacity"))),
        "color": 127.5 + 255 * 0.28209479177387814 * column("f_dc_0", "f_dc_1", "f_dc_2"),
    }


def features(g):
    size = np.ptp(g["position"], axis=0).max()
    return np.concatenate([g["position"] * 300 / size, g["color"] / 12, g["scale"] * 2, g["opacity"] * 5], 1)


def run(*command):
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(f"{command}: {done.stderr[-300:]}")


def row(name, path, back):
    found = read(back)
    order = cKDTree(features(found)).query(features(wanted))[1]
    found = {k: v[order] for k, v in found.items()}
    rms = lambda v: float(np.sqrt((v**2).mean()))
    angle = 2 * np.degrees(np.arccos(np.clip(np.abs((found["rotation"] * wanted["rotation"]).sum(1)), 0, 1)))
    color = (found["color"] - wanted["color"])[wanted["opacity"][:, 0] > 0.02]
    print(
        f"| {name} | {Path(path).stat().st_size:,} | {np.abs(found['position'] - wanted['position']).max():.1e} "
        f"| {rms(found['scale'] - wanted['scale']):.4f} | {rms(angle):.2f} | {np.abs(found['opacity'] - wanted['opacity']).max():.4f} "
        f"| {rms(color):.3f} | {np.abs(color).max():.2f} |"
    )


wanted = read(source)
with tempfile.TemporaryDirectory() as folder:
    folder = Path(folder)
    print("| | bytes | position, most | log-scale, rms | rotation, rms | opacity, most | color, rms | color, most |\n|---|---|---|---|---|---|---|---|")
    for ext, version in [("ply", 3), ("splat", 3), ("spz", 2), ("spz", 3), ("spz", 4), ("sog", 3), ("glb", 3), ("usdz", 3), ("html", 3)]:
        path, back = folder / f"ours{version}.{ext}", folder / "back.ply"
        run(freerange, "convert", source, path, "--spz-version", version)
        run(freerange, "convert", path, back, "--frame", "z-up")
        row(f"`.{ext}`" + (f" version {version}" if ext == "spz" else ""), path, back)
    for ext in ["spz", "sog", "compressed.ply"]:
        path, back = folder / f"theirs.{ext}", folder / "back.ply"
        run(transform, source, path, "-w")
        run(freerange, "convert", path, back, "--frame", "z-up:z-up")
        row(f"splat-transform's `.{ext}`", path, back)
