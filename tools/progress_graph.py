"""Draws docs/images/progress.svg from docs/evaluation/progress.json: what training was worth, over the samples it has seen.

usage: progress_graph.py [JSON [SVG]]   No packages are needed.
"""
import json
import pathlib
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 720, 400, 60, 150, 30, 50
COLOURS = {"full": "#1f77b4", "partial": "#d9601a"}


def main():
    source = pathlib.Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs/evaluation/progress.json"
    target = pathlib.Path(sys.argv[2]) if len(sys.argv) > 2 else ROOT / "docs/images/progress.svg"
    data = json.loads(source.read_text())
    values = [p[k] for p in [*data["points"], data["fit"], data["before"]] for k in COLOURS]
    low, high = int(min(values)), int(max(values)) + 1
    last = max(p["samples"] for p in data["points"])

    def x(samples):
        return LEFT + (WIDTH - LEFT - RIGHT) * samples / last

    def y(psnr):
        return TOP + (HEIGHT - TOP - BOTTOM) * (high - psnr) / (high - low)

    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="12">',
        f"<title>{data['title']}</title>",
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>',
    ]
    for psnr in range(low, high + 1):
        out.append(f'<path d="M{LEFT} {y(psnr):.1f}H{WIDTH - RIGHT}" stroke="#ddd"/><text x="{LEFT - 8}" y="{y(psnr) + 4:.1f}" text-anchor="end">{psnr}</text>')
    for samples in range(0, last + 1, 40_000):
        out.append(f'<text x="{x(samples):.1f}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{samples // 1000}k</text>')
    out.append(f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 10}" text-anchor="middle">samples seen in training</text>')
    out.append(f'<text x="{LEFT}" y="18">PSNR in dB, {data["protocol"]}</text>')
    labels = []  # at the right, moved apart where they would touch
    for key, colour in COLOURS.items():
        points = sorted(data["points"], key=lambda p: p["samples"])
        # A line per run. What was tried and led nowhere (`aside`) has a point, and no line.
        for run in sorted({p.get("run", "") for p in points}):
            kept = [p for p in points if p.get("run", "") == run and not p.get("aside")]
            line = " ".join(f"{x(p['samples']):.1f},{y(p[key]):.1f}" for p in kept)
            out.append(f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="2"/>')
        out += [f'<circle cx="{x(p["samples"]):.1f}" cy="{y(p[key]):.1f}" r="{5 if p.get("shipped") else 3}" fill="{colour}"/>' for p in points]
        out.append(f'<path d="M{LEFT} {y(data["fit"][key]):.1f}H{WIDTH - RIGHT}" stroke="{colour}" stroke-dasharray="5 4"/>')
        before = y(data["before"][key])
        out.append(f'<path d="M{LEFT - 5} {before:.1f}l5 -5l5 5l-5 5z" fill="{colour}"/>')
        labels += [(y(points[-1][key]), f"model, {key}", colour), (y(data["fit"][key]), f"quick fit, {key}", colour)]
    bottom = 0.0
    for place, text, colour in sorted(labels):
        bottom = max(place, bottom + 14)
        out.append(f'<text x="{WIDTH - RIGHT + 8}" y="{bottom + 4:.1f}" fill="{colour}">{text}</text>')
    out.append("</svg>")
    target.write_text("\n".join(out) + "\n")


main()
