"""Markdown tables from the JSON files of `freerange eval ... -o FILE`.

usage: results_table.py TITLE NAME=FILE.json [NAME=FILE.json ...]
A file of a refined run gives two columns: before and after refinement. Cells are PSNR in dB / SSIM.
"""
import json
import sys


def main():
    title, columns = sys.argv[1], []
    for argument in sys.argv[2:]:
        name, _, path = argument.partition("=")
        report = json.load(open(path))
        objects = report["objects"]
        if report["refine"] > 0:
            plain = {o["object"]: o["validation_before_refinement"] for o in objects}
            columns.append((name, plain))
            name += f", refined {report['refine']}"
        columns.append((name, {o["object"]: o["validation"] for o in objects}))
    names = list(columns[0][1])
    print(f"### {title}\n")
    print("| object | " + " | ".join(n for n, _ in columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    cell = lambda s: f"{s['psnr']:.2f} / {s['ssim']:.3f}"
    for n in names:
        print(f"| {n} | " + " | ".join(cell(c[n]) for _, c in columns) + " |")
    mean = lambda c, k: sum(c[n][k] for n in names) / len(names)
    print("| **mean** | " + " | ".join(f"**{mean(c, 'psnr'):.2f} / {mean(c, 'ssim'):.3f}**" for _, c in columns) + " |")


main()
