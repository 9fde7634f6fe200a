#!/bin/sh
# scikit-image's PSNR rises by 6 dB when one value of the true photo is -0.000001: the range of floats is then 2 instead of 1.
# Expected: about the same PSNR. Cubic interpolation makes such values. Its page says only "estimated from the data-type". Found with 0.26.0.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" -q install scikit-image==0.26.0 scipy==1.16.3 numpy==2.3.5
"$work/venv/bin/python" - <<'PYTHON'
import warnings
import numpy as np
import skimage
from scipy.ndimage import zoom
from skimage.metrics import peak_signal_noise_ratio

warnings.simplefilter("error")
noise = np.random.default_rng(0)

# A photo from 0 to 1 with one black value, a picture of it with noise, and the photo again with that value a little below 0.
photo = noise.uniform(0.0, 1.0, (128, 128, 3))
photo[0, 0, 0] = 0.0
picture = np.clip(photo + noise.normal(0, 0.02, photo.shape), 0, 1)
below = photo.copy()
below[0, 0, 0] = -1e-6
before, after = peak_signal_noise_ratio(photo, picture), peak_signal_noise_ratio(below, picture)
said = peak_signal_noise_ratio(below, picture, data_range=1)
print("scikit-image", skimage.__version__)
print(f"photo from 0 to 1: {before:.2f} dB; one of {photo.size} values is -0.000001: {after:.2f} dB; the same with data_range=1: {said:.2f} dB")

# Where such a value comes from: a bright square on black, made half as large by cubic interpolation.
square = np.zeros((128, 128))
square[32:96, 32:96] = 0.9
small = zoom(square, 0.5)
print(f"darkest value of a bright square on black after scipy.ndimage.zoom: {small.min():.6f}")
print("Always give data_range.")
jumps = abs(after - before - 20 * np.log10(2)) < 0.01 and abs(said - before) < 0.01 and small.min() < 0
raise SystemExit(0 if jumps else "the behavior has changed")
PYTHON
