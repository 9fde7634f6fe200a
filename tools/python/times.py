"""Seconds of a reconstruction from Python beside the command line's, in turns: times.py PROGRAM SCENE [ROUNDS]"""

import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import freerange

STAGES = ("frame", "mirror", "fit", "sample", "refine")


def main() -> None:
    program, scene = sys.argv[1:3]
    rounds = int(sys.argv[3]) if len(sys.argv) > 3 else 3
    model = freerange.load(device="cpu")
    read = freerange.Scene.read(scene)
    found: dict[str, list[float]] = {"command line": [], "Python": [], "Python, on_step": []}
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            command = [program, "reconstruct", scene, "-o", folder, "--device", "cpu"]
            subprocess.run(command, check=True, capture_output=True)
            seconds = dict(json.loads(Path(folder, "report.json").read_text())["seconds"])
        found["command line"].append(sum(seconds[stage] for stage in STAGES))
        found["Python"].append(sum(model.reconstruct_scene(read).seconds.values()))
        found["Python, on_step"].append(sum(model.reconstruct_scene(read, on_step=lambda step: None).seconds.values()))
    for what, seconds in found.items():
        print(f"{what}: median {statistics.median(seconds):.2f} s of {', '.join(f'{s:.2f}' for s in seconds)}")


if __name__ == "__main__":
    main()
