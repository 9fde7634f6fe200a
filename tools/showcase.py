"""Objects in rows: input photos, further photos, and renders of the result beneath them (docs/images/showcase.png).

usage: showcase.py [--turning] OUT SCENE=RESULT [SCENE=RESULT ...]
SCENE is a scene folder with transforms_full.json and transforms_val.json; RESULT holds what `freerange reconstruct
SCENE/transforms_full.json -o RESULT/out` and `freerange render RESULT/out/gaussians.ply --cameras SCENE/transforms_val.json
-o RESULT/renders` wrote. Needs Pillow. Writes OUT.png.

--turning: objects in columns instead, input photos above RESULT/out/turntable.gif (docs/images/turning.gif); writes OUT.gif.
"""
import json
import pathlib
import sys

from PIL import Image, ImageSequence

INPUT, LARGE, GAP, FURTHER = 112, 168, 4, (0, 4, 8)
SKIP, COLOURS = 2, 96  # every second frame of a turntable; colours of the GIF


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


def inputs(scene):
    picture = Image.new("RGB", (2 * INPUT + GAP, 2 * INPUT + GAP), (255, 255, 255))
    for i, file in enumerate(photos(scene, "transforms_full.json")[:4]):
        picture.paste(over_white(file, INPUT), ((i % 2) * (INPUT + GAP), i // 2 * (INPUT + GAP)))
    return picture


def turning(out, pairs):
    size = 2 * INPUT + GAP
    still = [inputs(scene) for scene, _ in pairs]
    turns = []
    for _, result in pairs:
        frames = ImageSequence.Iterator(Image.open(result / "out" / "turntable.gif"))
        turns.append([f.convert("RGB").resize((size, size), Image.LANCZOS) for f in frames][::SKIP])
    sheets = []
    for now in zip(*turns, strict=True):
        sheet = Image.new("RGB", (len(pairs) * (size + 4 * GAP) - 4 * GAP, 2 * size + GAP), (255, 255, 255))
        for column, (photos_of_it, frame) in enumerate(zip(still, now, strict=True)):
            left = column * (size + 4 * GAP)
            sheet.paste(photos_of_it, (left, 0))
            sheet.paste(frame, (left, size + GAP))
        sheets.append(sheet)
    # One palette for all frames, lest what stands still flickers.
    palette = sheets[0].quantize(COLOURS)
    frames = [sheet.quantize(palette=palette, dither=Image.Dither.NONE) for sheet in sheets]
    frames[0].save(out + ".gif", save_all=True, append_images=frames[1:], loop=0, duration=40 * SKIP, optimize=True)


def main():
    arguments = sys.argv[1:]
    turn = arguments[0] == "--turning"
    out, *rest = arguments[1:] if turn else arguments
    pairs = [tuple(map(pathlib.Path, a.split("="))) for a in rest]
    if turn:
        turning(out, pairs)
        return
    rows = [row(*pair) for pair in pairs]
    sheet = Image.new("RGB", (rows[0].width, sum(r.height for r in rows) + 4 * GAP * (len(rows) - 1)), (255, 255, 255))
    top = 0
    for picture in rows:
        sheet.paste(picture, (0, top))
        top += picture.height + 4 * GAP
    sheet.save(out + ".png", optimize=True)


main()
