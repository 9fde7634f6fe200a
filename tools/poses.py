"""How right poses are that `freerange poses` finds: captures with true cameras, and what comes of
their photos alone.

usage: poses.py CAPTURES OUT [--every 2] [--masks] [--freerange PROGRAM] [--python PYTHON]
                [--scenes NAME ...]

CAPTURES holds folders with images/ and transforms.json, as the example `captures` of freerange-scene
writes them. `--every 2` takes every second photo, `--masks` gives the true masks to the engine. Each
scene becomes OUT/NAME, and a line of OUT/results.jsonl; lines that are there are not computed again.
OUT/NAME/aligned.json has the found cameras in the frame of the true ones. At the end the table:
exit code, photos with a pose, those off by more than 5 degrees, median and largest error in degrees,
seconds. The rotation between both frames is the mean of the photos that agree with one another.
Needs numpy and pycolmap (to read models).
"""
import argparse
import json
import pathlib
import shutil
import subprocess
import tempfile
import time

import numpy as np
import pycolmap

WRONG = 5.0


def angle(r):
    return np.degrees(np.arccos(np.clip((np.trace(r) - 1) / 2, -1, 1)))


def common(truth, found):
    """The rotation from the true world to the found one that most photos agree with, and those."""
    best = None
    for name in sorted(found):
        turn = found[name].T @ truth[name]
        near = [n for n in found if angle(found[n] @ turn @ truth[n].T) < WRONG]
        if best is None or len(near) > len(best):
            best = near
    u, _, v = np.linalg.svd(sum(found[n].T @ truth[n] for n in best))
    return u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v, best


def aligned(frames, model, turn, agreed, out):
    """Writes the found cameras in the true frame: turned, then moved and scaled by centers."""
    true = {pathlib.Path(f["file_path"]).name: np.array(f["transform_matrix"])[:3, 3] for f in frames}
    images = {i.name: i for i in model.images.values()}
    centers = {n: turn.T @ i.projection_center() for n, i in images.items()}
    a, b = (np.array([c[n] for n in agreed]) for c in (centers, true))
    ma, mb = a.mean(0), b.mean(0)
    scale = ((a - ma) * (b - mb)).sum() / ((a - ma) ** 2).sum()
    listed = []
    for name in sorted(images):
        camera, m = images[name].camera, np.eye(4)
        rotation = images[name].cam_from_world().rotation.matrix()
        m[:3, :3] = (rotation @ turn).T @ np.diag([1, -1, -1])
        m[:3, 3] = scale * (centers[name] - ma) + mb
        focal, cx, cy, k = camera.params
        listed.append({
            "file_path": f"images/{name}", "transform_matrix": m.tolist(), "fl_x": focal, "fl_y": focal,
            "cx": cx, "cy": cy, "k1": k, "w": camera.width, "h": camera.height})
    head = {"camera_model": "OPENCV", "orientation_override": "none"}
    out.write_text(json.dumps(head | {"frames": listed}))


def measure(args, capture, out):
    frames = json.loads((capture / "transforms.json").read_text())["frames"][:: args.every]
    names = [pathlib.Path(f["file_path"]).name for f in frames]
    # Camera to world with OpenGL's axes there; world to camera with OpenCV's here.
    truth = {
        n: (np.array(f["transform_matrix"])[:3, :3] @ np.diag([1, -1, -1])).T
        for n, f in zip(names, frames)}
    shutil.rmtree(out, ignore_errors=True)
    command = [args.freerange, "poses", "PHOTOS", "-o", out]
    command += ["--python", args.python] if args.python else []
    command += ["--masks", capture / "masks"] if args.masks else []
    with tempfile.TemporaryDirectory() as photos:
        for name in names:
            shutil.copy(capture / "images" / name, photos)
        command[2] = photos
        begin = time.time()
        run = subprocess.run([str(c) for c in command], capture_output=True, text=True)
        seconds = time.time() - begin
        said = [l.replace(photos, "PHOTOS") for l in run.stderr.splitlines()]
    found, off, placed = {}, {}, 0
    if (out / "poses.json").is_file():
        # Poses that are refused are not written, but counted.
        models = json.loads((out / "poses.json").read_text())["engine"]["models"]
        placed = models[0] if models else 0
    if (out / "sparse/0/images.bin").is_file():
        model = pycolmap.Reconstruction(str(out / "sparse/0"))
        found = {i.name: i.cam_from_world().rotation.matrix() for i in model.images.values()}
        turn, agreed = common(truth, found)
        off = {n: angle(found[n] @ turn @ truth[n].T) for n in found}
        if run.returncode == 0:
            aligned(frames, model, turn, agreed, out / "aligned.json")
    return {
        "capture": capture.name, "exit": run.returncode, "photos": len(names), "placed": placed,
        "off": off, "seconds": seconds, "said": [l for l in said if l.startswith(("err", "warn", "note"))]}


def line(r):
    off = list(r["off"].values())
    median, most = (f"{np.median(off):.2f}", f"{max(off):.2f}") if off else ("", "")
    said = "; ".join(r["said"])[:200].replace("|", "/")
    wrong = sum(o > WRONG for o in off) if off else ""
    return (
        f"| {r['capture']} | {r['exit']} | {r['placed']} of {r['photos']} | {wrong} | {median} | {most} "
        f"| {r['seconds']:.0f} | {said} |")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("captures", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--masks", action="store_true")
    parser.add_argument("--freerange", default="target/release/freerange")
    parser.add_argument("--python", default=None)
    parser.add_argument("--scenes", nargs="*")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    results = args.out / "results.jsonl"
    done = [json.loads(l) for l in results.read_text().splitlines()] if results.is_file() else []
    for capture in sorted(p for p in args.captures.iterdir() if (p / "transforms.json").is_file()):
        known = any(r["capture"] == capture.name for r in done)
        if known or (args.scenes and capture.name not in args.scenes):
            continue
        done.append(measure(args, capture, args.out / capture.name))
        with results.open("a") as file:
            file.write(json.dumps(done[-1]) + "\n")
        print(line(done[-1]), flush=True)
    print("\n| capture | exit code | placed | wrong | median, degrees | largest | seconds | says |")
    print("|---|---|---|---|---|---|---|---|")
    for r in sorted(done, key=lambda r: r["capture"]):
        print(line(r))


main()
