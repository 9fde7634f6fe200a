#!/usr/bin/env python3
"""What share of a reconstruction's processor time its parts take, by perf's samples of the running program.

    cargo build --release
    python tools/profile.py target/release/freerange examples/bowl [OPTION...]

Needs Linux and perf (Debian: linux-perf). Options go to `freerange reconstruct`. A sample belongs to the first part whose
pattern its symbol has; the stages' seconds are those of report.json. What is inlined counts for its caller.
"""
import json
import pathlib
import re
import subprocess
import sys
import tempfile
from collections import Counter

PARTS = [
    ("rasterizing, backward", r"raster.*(backward|pull)"),
    ("SSIM and photometric loss", r"raster.*(ssim|metrics)|Targets.*composite|objective"),
    ("rasterizing, forward", r"freerange_raster"),
    ("optimizer", r"adam|mcmc|relocat"),
    ("products of matrices", r"gemm|tiles|freerange_model.*linear"),
    ("attention", r"freerange_model.*attention"),
    ("the rest of the network", r"freerange_model|freerange_diffusion|burn|dinov2"),
    ("symmetry", r"freerange_optim.*(search|mirror|axis)"),
    ("photos", r"freerange_scene|image::|png|jpeg|fdeflate|zune"),
    ("files, turntable", r"gif|color_quant|flate|weezl|freerange_gaussians"),
    ("allocating and copying memory", r"mem(cpy|set|move)|alloc|page|clear_|free|\[k\]"),
    ("threads that look for work", r"rayon|crossbeam|sched|futex"),
]


def main():
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    binary, scene, options = pathlib.Path(sys.argv[1]).resolve(), sys.argv[2], sys.argv[3:]
    with tempfile.TemporaryDirectory() as folder:
        data, out = f"{folder}/perf.data", f"{folder}/out"
        run = [str(binary), "reconstruct", scene, "-o", out, *options]
        record = ["perf", "record", "-q", "-e", "cpu-clock", "-F", "199", "-o", data, "--", *run]
        subprocess.run(record, check=True, stdout=subprocess.DEVNULL)
        script = ["perf", "script", "-i", data, "-F", "ip,sym"]
        lines = subprocess.run(script, check=True, capture_output=True, text=True, errors="replace").stdout
        report = json.loads(pathlib.Path(out, "report.json").read_text())
    symbols = Counter(line.split(maxsplit=1)[1] for line in lines.splitlines() if len(line.split(maxsplit=1)) == 2)
    parts, rest, total = Counter(), Counter(), sum(symbols.values())
    if total == 0:
        sys.exit("perf took no samples")
    for symbol, count in symbols.items():
        part = next((name for name, pattern in PARTS if re.search(pattern, symbol)), None)
        parts[part or "other"] += count
        if part is None:
            rest[symbol] += count
    print("| stage | seconds |\n|---|---|")
    for stage, seconds in report["seconds"]:
        print(f"| {stage} | {seconds:.1f} |")
    print("\n| part | share of processor time |\n|---|---|")
    for part, count in parts.most_common():
        print(f"| {part} | {100 * count / total:.1f} % |")
    if rest:
        print("\nMost of the other: " + ", ".join(f"{s} ({100 * c / total:.1f} %)" for s, c in rest.most_common(5)))


main()
