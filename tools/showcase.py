"""Objects in rows: input photos, the baseline fit, the result, the ground truth (docs/images/comparison.jpg, print.jpg).

usage: showcase.py --compare | --print OUT SCENE=RESULT [SCENE=RESULT ...]
SCENE is a scene folder with transforms_full.json and transforms_val.json; RESULT holds what `freerange reconstruct
SCENE/transforms_full.json -o RESULT/out --eval-scene SCENE/transforms_val.json` and `freerange render RESULT/out/gaussians.ply
--cameras SCENE/transforms_val.json -o RESULT/renders` wrote. RESULT/fit holds what `freerange render RESULT/fit.ply --cameras
SCENE/transforms_val.json -o RESULT/fit` wrote of the baseline: `cargo run --release -p freerange-cli --example baseline --
SCENE/transforms_full.json RESULT/fit.ply`. Needs Pillow. Writes OUT.jpg.

--compare: one line per object.
--print: two lines per object, the whole view and its middle enlarged. A column "before" shows RESULT/before, the renders of an
earlier result, where there is one.
"""
import json
import pathlib
import sys

from PIL import Image, ImageDraw, ImageFont

INPUT, GAP = 112, 4


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


def median_view(result):
    """The held-out view of median PSNR, so that nobody chooses."""
    views = json.loads((result / "out" / "report.json").read_text())["samples"][0]["further_views"]["views"]
    return sorted(range(len(views)), key=lambda i: views[i]["psnr"])[len(views) // 2]


def compare(out, pairs):
    """Rows of: four input photos, the baseline fit, the result, the ground truth; the held-out view of median PSNR, labeled."""
    size, label = 2 * INPUT + GAP, 22
    titles = ("4 input photos", "3DGS-MCMC fit (128 px)", "free-range", "ground truth")
    sheet = Image.new("RGB", (4 * (size + 3 * GAP) - 3 * GAP, label + len(pairs) * (size + GAP)), (255, 255, 255))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=15)
    for column, title in enumerate(titles):
        draw.text((column * (size + 3 * GAP) + size // 2, 2), title, fill=(0, 0, 0), font=font, anchor="ma")
    for row, (scene, result) in enumerate(pairs):
        top = label + row * (size + GAP)
        for i, file in enumerate(photos(scene, "transforms_full.json")[:4]):
            sheet.paste(over_white(file, INPUT), ((i % 2) * (INPUT + GAP), top + i // 2 * (INPUT + GAP)))
        view = median_view(result)
        renders = (sorted((result / folder).glob("*.png"))[view] for folder in ("fit", "renders"))
        for column, file in enumerate((*renders, photos(scene, "transforms_val.json")[view]), 1):
            sheet.paste(over_white(file, size), (column * (size + 3 * GAP), top))
    sheet.save(out + ".jpg", quality=88, optimize=True)


def middle(path, size):
    """A third of each side about the middle of the object, enlarged; never smoothed by shrinking."""
    image = Image.open(path).convert("RGBA")
    white = Image.new("RGBA", image.size, (255, 255, 255, 255))
    image = Image.alpha_composite(white, image).convert("RGB")
    part = image.width // 3
    left, top = (image.width - part) // 2, (image.height - part) // 2
    return image.crop((left, top, left + part, top + part)).resize((size, size), Image.LANCZOS)


def prints(out, pairs):
    """Rows of: four input photos, the baseline fit, the result before, the result, the ground truth; the median view."""
    size, label = 2 * INPUT + GAP, 22
    columns = [("fit", "3DGS-MCMC fit"), ("before", "before"), ("renders", "now")]
    columns = [(folder, title) for folder, title in columns if all((result / folder).is_dir() for _, result in pairs)]
    titles = ["4 input photos", *(title for _, title in columns), "ground truth"]
    sheet = Image.new("RGB", (len(titles) * (size + 3 * GAP) - 3 * GAP, label + len(pairs) * 2 * (size + GAP)), (255, 255, 255))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=15)
    for column, title in enumerate(titles):
        draw.text((column * (size + 3 * GAP) + size // 2, 2), title, fill=(0, 0, 0), font=font, anchor="ma")
    for row, (scene, result) in enumerate(pairs):
        top = label + row * 2 * (size + GAP)
        for i, file in enumerate(photos(scene, "transforms_full.json")[:4]):
            sheet.paste(over_white(file, INPUT), ((i % 2) * (INPUT + GAP), top + i // 2 * (INPUT + GAP)))
        view = median_view(result)
        files = [sorted((result / folder).glob("*.png"))[view] for folder, _ in columns]
        for column, file in enumerate((*files, photos(scene, "transforms_val.json")[view]), 1):
            sheet.paste(over_white(file, size), (column * (size + 3 * GAP), top))
            sheet.paste(middle(file, size), (column * (size + 3 * GAP), top + size + GAP))
    sheet.save(out + ".jpg", quality=85, optimize=True)


def main():
    how, out, *rest = sys.argv[1:]
    draw = {"--compare": compare, "--print": prints}[how]
    draw(out, [tuple(map(pathlib.Path, a.split("="))) for a in rest])


main()
