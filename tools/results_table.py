"""One Markdown table of several evaluations: objects in rows, methods in columns.

usage: results_table.py full|partial NAME=OUT [NAME=OUT ...]
OUT is a folder of `freerange eval -o OUT`. Cells are PSNR in dB / SSIM; a dash where an object has no numbers.
"""
import json
import pathlib
import sys


def scores(folder, views):
    records = json.loads((pathlib.Path(folder) / "report.json").read_text())["records"]
    own = [r for r in records if r["case"]["views"] == views and r["outcome"]["kind"] == "measured"]
    return {r["case"]["object"]: r["outcome"]["metrics"] for r in own}


def main():
    views = sys.argv[1]
    columns = [(name, scores(folder, views)) for name, _, folder in (a.partition("=") for a in sys.argv[2:])]
    names = sorted(set().union(*(c for _, c in columns)))
    print(f"| object, {views} | " + " | ".join(n for n, _ in columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    cell = lambda s: f"{s['psnr']:.2f} / {s['ssim']:.3f}" if s else "-"
    for name in names:
        print(f"| {name} | " + " | ".join(cell(c.get(name)) for _, c in columns) + " |")
    # Means over the objects that every column has.
    common = [n for n in names if all(n in c for _, c in columns)]
    mean = lambda c, k: sum(c[n][k] for n in common) / len(common)
    if common:
        means = " | ".join(f"**{mean(c, 'psnr'):.2f} / {mean(c, 'ssim'):.3f}**" for _, c in columns)
        print(f"| **mean of {len(common)}** | {means} |")


main()
