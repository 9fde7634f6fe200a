#!/bin/sh
# imageio drops the transparency of palette PNGs, what pngquant makes of cut-out photos: three channels, and the hidden color shows.
# Expected: four channels, as for the same photo before pngquant. Found with 2.38.1.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" -q install imageio==2.38.1 pillow==13.0.0 numpy==2.3.5
cd "$work"
"$work/venv/bin/python" - <<'PYTHON'
import warnings
import imageio
import imageio.v3
import numpy as np
import PIL
from PIL import Image

# An opaque red square; around it green of alpha 0. Saved with all channels, and with a palette of two colors.
cutout = np.zeros((48, 64, 4), np.uint8)
cutout[...] = [10, 200, 30, 0]
cutout[12:36, 16:48] = [200, 30, 20, 255]
Image.fromarray(cutout).save("full.png")
palette = Image.new("P", (64, 48), 0)
palette.paste(1, (16, 12, 48, 36))
palette.putpalette([10, 200, 30, 200, 30, 20])
palette.save("palette.png", transparency=bytes([0, 255]))
true = np.array(Image.open("palette.png").convert("RGBA"))
warnings.simplefilter("error")
full, read = imageio.v3.imread("full.png"), imageio.v3.imread("palette.png")
print("imageio", imageio.__version__, "Pillow", PIL.__version__)
print("with all channels:", full.shape, "corner", full[0, 0].tolist(), "middle", full[24, 32].tolist())
print("with a palette, by Pillow:", true.shape, "corner", true[0, 0].tolist(), "middle", true[24, 32].tolist())
print("with a palette, by imageio:", read.shape, "corner", read[0, 0].tolist(), "middle", read[24, 32].tolist())
print('Give mode="RGBA" to imread.')
wrong = full.shape == true.shape == (48, 64, 4) and (full == true).all() and read.shape == (48, 64, 3)
raise SystemExit(0 if wrong else "the behavior has changed")
PYTHON
