"""Scenes as another user would have made them: tilted, turned about the vertical, scaled and shifted. Images are linked to.

usage: moved_scenes.py SCENES OUT [--tilt DEGREES] [--turn DEGREES] [--scale FACTOR] [--shift X Y Z]
Every camera moves with its object, so that the images stay what they were; `freerange eval --scenes OUT` then measures what
is lost where the canonical frame has to be estimated. Prints which way is up after it all, for `--up`. The tilt, about x, comes before the
turn.
"""
import argparse
import json
import math
import pathlib


def rotation_of(tilt, turn):
    """First about x, then about z."""
    (c, s), (d, t) = ((math.cos(v), math.sin(v)) for v in (turn, tilt))
    return [[c, -s * d, s * t], [s, c * d, -c * t], [0.0, t, d]]


def moved(matrix, rotation, scale, shift):
    """Camera to world after x -> scale * R x + shift; a camera itself has no size."""
    product = [[sum(r[k] * matrix[k][j] for k in range(3)) for j in range(4)] for r in rotation]
    return [row[:3] + [scale * row[3] + d] for row, d in zip(product, shift)] + [[0.0, 0.0, 0.0, 1.0]]


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("scenes", type=pathlib.Path)
    p.add_argument("out", type=pathlib.Path)
    p.add_argument("--tilt", type=float, default=0.0)
    p.add_argument("--turn", type=float, default=0.0)
    p.add_argument("--scale", type=float, default=1.0)
    p.add_argument("--shift", type=float, nargs=3, default=[0.0, 0.0, 0.0])
    a = p.parse_args()
    rotation = rotation_of(math.radians(a.tilt), math.radians(a.turn))
    print("up:", ",".join(f"{row[2]:.6f}" for row in rotation))
    for scene in sorted(s for s in a.scenes.iterdir() if s.is_dir()):
        target = a.out / scene.name
        target.mkdir(parents=True)
        for file in scene.iterdir():
            if not file.name.startswith("transforms"):
                (target / file.name).symlink_to(file.resolve())
                continue
            data = json.loads(file.read_text())
            for frame in data["frames"]:
                frame["transform_matrix"] = moved(frame["transform_matrix"], rotation, a.scale, a.shift)
            (target / file.name).write_text(json.dumps(data))


main()
