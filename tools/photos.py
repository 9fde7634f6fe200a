"""What photos of a table are worth: PSNR over validation views with true masks, with automatic masks, and of the plain fit; and the masks.

usage: photos.py PHOTOS OUT [--freerange PROGRAM] [--scenes NAME ...]
PHOTOS holds scenes with truth/masks (NAME.jpg.png) and transforms_val.json. Everything goes into OUT, and what is there is not made again;
OUT/table.md is the table. Needs nothing but Python and the program.
"""
import argparse
import json
import pathlib
import shutil
import struct
import subprocess
import sys
import zlib


def gray(path):
    """First channel of an 8-bit PNG: (width, height, bytes)."""
    data = path.read_bytes()
    at, packed = 8, b""
    while at < len(data):
        (size,), kind = struct.unpack(">I", data[at : at + 4]), data[at + 4 : at + 8]
        chunk = data[at + 8 : at + 8 + size]
        if kind == b"IHDR":
            w, h, depth, colour = struct.unpack(">IIBB", chunk[:10])
            assert depth == 8 and chunk[12] == 0, f"{path}: expected 8 bits, not interlaced"
            step = {0: 1, 2: 3, 4: 2, 6: 4}[colour]
        elif kind == b"IDAT":
            packed += chunk
        at += 12 + size
    raw, wide = zlib.decompress(packed), w * step
    before, out = bytearray(wide), bytearray()
    for y in range(h):
        how, row = raw[y * (wide + 1)], bytearray(raw[y * (wide + 1) + 1 : (y + 1) * (wide + 1)])
        if how:
            for i in range(wide):
                left = row[i - step] if i >= step else 0
                corner = before[i - step] if i >= step else 0
                up = before[i]
                if how == 4:
                    p = left + up - corner
                    a, b, c = abs(p - left), abs(p - up), abs(p - corner)
                    guess = left if a <= b and a <= c else up if b <= c else corner
                else:
                    guess = (0, left, up, (left + up) // 2)[how]
                row[i] = (row[i] + guess) & 255
        out += row[::step]
        before = row
    return w, h, bytes(out)


def overlap(a, b):
    (w, h, a), (w2, h2, b) = gray(a), gray(b)
    assert (w, h) == (w2, h2)
    both = sum(1 for x, y in zip(a, b) if x >= 128 and y >= 128)
    either = sum(1 for x, y in zip(a, b) if x >= 128 or y >= 128)
    return both / max(either, 1)


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("photos", type=pathlib.Path)
    p.add_argument("out", type=pathlib.Path)
    p.add_argument("--freerange", default="freerange")
    p.add_argument("--scenes", nargs="*")
    a = p.parse_args()

    def run(*arguments):
        done = subprocess.run([a.freerange, *map(str, arguments)], stdout=subprocess.PIPE)
        if done.returncode:
            sys.exit(f"{' '.join(map(str, arguments))}: exit code {done.returncode}")

    def further(folder):
        return json.loads((folder / "report.json").read_text())["samples"][0]["further_views"]["psnr"]

    rows = []
    for scene in sorted(s for s in a.photos.iterdir() if (s / "truth/masks").is_dir()):
        if a.scenes and scene.name not in a.scenes:
            continue
        out = a.out / scene.name
        truth, val = scene / "truth/masks", scene / "transforms_val.json"
        for name, more in (("true", ["--masks", truth]), ("automatic", [])):
            if not (out / name / "report.json").exists():
                run("reconstruct", scene, "-o", out / name, "--eval-scene", val, *more)
        if not (out / "inspect/inspect.json").exists():
            run("inspect", scene, "-o", out / "inspect")
        # The fit takes transforms.json: the photos without their lens, cut out by the true masks.
        plain = out / "scenes" / scene.name
        if not (out / "fit/report.json").exists():
            run("inspect", scene, "-o", out / "cut", "--masks", truth, "--cut")
            shutil.copytree(out / "cut/cut", plain, dirs_exist_ok=True)
            (plain / "transforms.json").rename(plain / "transforms_full.json")
            shutil.copytree(scene / "val", plain / "val", dirs_exist_ok=True)
            shutil.copy(val, plain / "transforms_val.json")
            views = len(json.loads((plain / "transforms_full.json").read_text())["frames"])
            run("eval", "--scenes", out / "scenes", "-o", out / "fit", "--method", "fit", "--views", "full",
                "--inputs", views, "--metrics", "psnr,ssim", "--pictures", "none")
        fit = json.loads((out / "fit/report.json").read_text())["groups"][0]["metrics"]["psnr"]["mean"]
        shares = [overlap(m, truth / m.name) for m in sorted((out / "inspect/masks").glob("*.png"))]
        rows.append((scene.name, further(out / "true"), further(out / "automatic"), fit, sum(shares) / len(shares), min(shares)))
    mean = ["mean"] + [sum(r[i] for r in rows) / len(rows) for i in range(1, 6)]
    table = "| scene | true masks | automatic masks | fit, true masks | IoU, mean | IoU, least |\n|---|---|---|---|---|---|\n"
    for name, *v in rows + [tuple(mean)]:
        table += f"| {name} | {v[0]:.2f} | {v[1]:.2f} | {v[2]:.2f} | {v[3]:.3f} | {v[4]:.3f} |\n"
    (a.out / "table.md").write_text(table)
    print(table, end="")


main()
