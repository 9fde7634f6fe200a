#!/bin/sh
# kornia-rs reads a palette PNG as a gray picture of the palette's indices: a red and green photo becomes nearly black, without a word.
# Expected: the colors, or a refusal as for gray of four bits. Found with 0.2.0.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" -q install kornia_rs==0.2.0 pillow==13.0.0 numpy==2.3.5
cd "$work"
"$work/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version
import kornia_rs
import numpy as np
from PIL import Image

# Twenty colors, as pngquant leaves them; the left half is red, the right half green.
colors = [[200, 30, 20], [10, 200, 30]] + [[12 * i, 255 - 12 * i, 128] for i in range(18)]
picture = Image.new("P", (64, 48), 0)
picture.paste(1, (32, 0, 64, 48))
for i in range(20):
    picture.putpixel((i, 0), i)
picture.putpalette([v for c in colors for v in c])
picture.save("palette.png")
true = np.array(Image.open("palette.png").convert("RGB"))
read = np.array(kornia_rs.io.read_image("palette.png"))
kind = kornia_rs.image.Image.load("palette.png")
print("kornia_rs", version("kornia_rs"), "a PNG with a palette of 20 colors")
print("by Pillow:", true.shape, "left", true[24, 8].tolist(), "right", true[24, 56].tolist())
print("by kornia_rs.io.read_image:", read.shape, "left", read[24, 8].tolist(), "right", read[24, 56].tolist(), "largest", read.max())
print("by kornia_rs.image.Image.load:", kind)
print("Write such photos with all their channels first.")
wrong = read.shape == (48, 64, 1) and read[24, 8, 0] == 0 and read[24, 56, 0] == 1 and read.max() == 19 and kind.mode == "L"
raise SystemExit(0 if wrong else "the behavior has changed")
PYTHON
