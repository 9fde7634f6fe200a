"""Objects in rows: input photos, further photos, and renders of the result beneath them (docs/images/showcase.png).

usage: showcase.py OUT SCENE=RESULT [SCENE=RESULT ...]
SCENE is a scene folder with transforms_full.json and transforms_val.json; RESULT holds what `freerange reconstruct
SCENE/transforms_full.json -o RESULT/out` and `freerange render RESULT/out/gaussians.ply --cameras SCENE/transforms_val.json
-o RESULT/renders` wrote. Needs Pillow. Writes OUT.png.
"""
import json
import pathlib
import sys

from PIL import Image

INPUT, LARGE, GAP, FURTHER = 112, 168, 4, (0, 4, 8)


def over_white(path, size):
    image = Image.open(path).convert("RGBA")
    white = Image.new("RGBA", image.size, (255, 255, 255, 255))
    # The middle, which is where the objects are.
    cut = image.width // 7
    middle = (cut, cut, image.width - cut, image.height - cut)
    return Image.alpha_composite(white, image).convert("RGB").crop(middle).resize((size, size), Image.LANCZOS)


def photos(scene, name):
    frames = json.loads((scene / name).read_text())["frames"]
    files = [scene / f["file_path"] for f in frames]
    return [f if f.suffix else f.with_suffix(".png") for f in files]


def row(scene, result):
    height = 2 * LARGE + GAP
    width = 2 * INPUT + 2 * GAP + len(FURTHER) * (LARGE + GAP)
    picture = Image.new("RGB", (width, height), (255, 255, 255))
    top = (height - 2 * INPUT - GAP) // 2
    for i, file in enumerate(photos(scene, "transforms_full.json")[:4]):
        picture.paste(over_white(file, INPUT), ((i % 2) * (INPUT + GAP), top + (i // 2) * (INPUT + GAP)))
    renders = sorted((result / "renders").glob("*.png"))
    truth = photos(scene, "transforms_val.json")
    for column, view in enumerate(FURTHER):
        left = 2 * INPUT + 2 * GAP + GAP + column * (LARGE + GAP)
        picture.paste(over_white(truth[view], LARGE), (left, 0))
        picture.paste(over_white(renders[view], LARGE), (left, LARGE + GAP))
    return picture


def main():
    out = sys.argv[1]
    pairs = [tuple(map(pathlib.Path, a.split("="))) for a in sys.argv[2:]]
    rows = [row(*pair) for pair in pairs]
    sheet = Image.new("RGB", (rows[0].width, sum(r.height for r in rows) + 4 * GAP * (len(rows) - 1)), (255, 255, 255))
    top = 0
    for picture in rows:
        sheet.paste(picture, (0, top))
        top += picture.height + 4 * GAP
    sheet.save(out + ".png", optimize=True)


main()
