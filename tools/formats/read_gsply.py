"""Gaussians of a file as JSON, read by gsply; names as in object.mjs."""

import json
import sys

import gsply

name = sys.argv[1]
read = gsply.read_spz if name.endswith(".spz") else gsply.sogread if name.endswith(".sog") else gsply.plyread
data = read(name)
rows = zip(data.means, data.scales, data.quats, data.opacities, data.sh0, strict=True)
print(
    json.dumps(
        [
            {
                "mean": mean.tolist(),
                "scale": scale.tolist(),
                "rotation": rotation.tolist(),
                "opacity": float(opacity),
                "color": color.tolist(),
            }
            for mean, scale, rotation, opacity, color in rows
        ]
    )
)
