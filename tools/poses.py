"""How right poses are that `freerange poses` finds: captures with true cameras, and what comes of their photos alone.

usage: poses.py CAPTURES OUT [--freerange PROGRAM] [--python PYTHON] [--scenes NAME ...]
CAPTURES holds folders with images/ and transforms.json, as the example `tabletops` of freerange-scene writes them. Each gets OUT/NAME and a line:
exit code, photos with a pose, those of them that are off by more than 5 degrees, the median error in degrees, seconds. The rotation between
both frames is the mean of those photos that agree with one another. Needs numpy and pycolmap (to read models).
"""
import argparse
import json
import pathlib
import shutil
import subprocess
import time

import numpy as np
import pycolmap

WRONG = 5.0


def angle(r):
    return np.degrees(np.arccos(np.clip((np.trace(r) - 1) / 2, -1, 1)))


def errors(truth, found):
    """Degrees by which each rotation is off, under the common rotation of the world that most photos agree with."""
    names = sorted(found)
    best = None
    for name in names:
        turn = found[name].T @ truth[name]
        near = [n for n in names if angle(found[n] @ turn @ truth[n].T) < WRONG]
        if best is None or len(near) > len(best):
            best = near
    u, _, v = np.linalg.svd(sum(found[n].T @ truth[n] for n in best))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    return [angle(found[n] @ turn @ truth[n].T) for n in names]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("captures", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--freerange", default="target/release/freerange")
    parser.add_argument("--python", default=None)
    parser.add_argument("--scenes", nargs="*")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    print("| capture | exit code | placed | wrong | median, degrees | seconds | says |\n|---|---|---|---|---|---|---|")
    for capture in sorted(p for p in args.captures.iterdir() if (p / "transforms.json").is_file()):
        if args.scenes and capture.name not in args.scenes:
            continue
        frames = json.loads((capture / "transforms.json").read_text())["frames"]
        # Camera to world with OpenGL's axes there; world to camera with OpenCV's here.
        truth = {pathlib.Path(f["file_path"]).name: (np.array(f["transform_matrix"])[:3, :3] @ np.diag([1, -1, -1])).T for f in frames}
        out = args.out / capture.name
        shutil.rmtree(out, ignore_errors=True)
        command = [args.freerange, "poses", capture / "images", "-o", out] + (["--python", args.python] if args.python else [])
        begin = time.time()
        run = subprocess.run([str(c) for c in command], capture_output=True, text=True)
        seconds = time.time() - begin
        placed, off = 0, []
        if (out / "sparse/0/images.bin").is_file():
            model = pycolmap.Reconstruction(str(out / "sparse/0"))
            found = {i.name: i.cam_from_world().rotation.matrix() for i in model.images.values()}
            placed, off = len(found), errors(truth, found)
        wrong = sum(o > WRONG for o in off)
        median = f"{np.median(off):.2f}" if off else "-"
        said = "; ".join(l for l in run.stderr.splitlines() if l.startswith(("error", "warning")))[:300].replace("|", "/")
        print(f"| {capture.name} | {run.returncode} | {placed} of {len(frames)} | {wrong} | {median} | {seconds:.0f} | {said} |", flush=True)


main()
