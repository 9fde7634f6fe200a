"""Gaussians of a file as JSON, read by gaussforge; names as in object.mjs. It hands out files alone: a .ply, read by plyfile.

python tools/formats/read_gaussforge.py FILE
"""

import io
import json
import pathlib
import sys

import gaussforge
import numpy as np
from plyfile import PlyData

path = pathlib.Path(sys.argv[1])
made = gaussforge.GaussForge().convert(path.read_bytes(), path.suffix[1:], "ply")
if made.get("error"):
    raise SystemExit(made["error"])
rows = PlyData.read(io.BytesIO(made["data"]))["vertex"]
columns = {
    "mean": ["x", "y", "z"],
    "scale": ["scale_0", "scale_1", "scale_2"],
    "rotation": ["rot_0", "rot_1", "rot_2", "rot_3"],
    "opacity": ["opacity"],
    "color": ["f_dc_0", "f_dc_1", "f_dc_2"],
}
table = {key: np.stack([np.asarray(rows[n], np.float64) for n in names], 1) for key, names in columns.items()}
found = [{key: values[i].tolist() for key, values in table.items()} for i in range(len(rows))]
for one in found:
    one["opacity"] = one["opacity"][0]
# The library prints to standard output, too: the object is its last line.
print(json.dumps(found))
