"""Golden files by gsply's and gaussforge's writers, from source.ply: tests/golden/formats.

pip install 'gsply[sogs,spz]==0.4.6' gaussforge==0.6.0
python tools/formats/other_vectors.py tests/golden/formats
"""

import sys
from pathlib import Path

import gaussforge
import gsply

folder = Path(sys.argv[1])
source = folder / "source.ply"
for version in (3, 4):
    gsply.write_spz(folder / f"gsply-v{version}.spz", gsply.plyread(source), version=version)
for kind in ("compressed.ply", "splat", "spz", "sog"):
    made = gaussforge.GaussForge().convert(source.read_bytes(), "ply", kind)
    if made.get("error"):
        raise SystemExit(made["error"])
    (folder / f"gaussforge.{kind}").write_bytes(made["data"])
