"""What usd-core reads of a .usda, .usdc or .usdz, as JSON: up axis, and for every Gaussian its place, covariance, opacity,
and coefficients; the bounding box that a stage computes.

    python tools/formats/read_usd.py FILE
"""
import json
import sys

import numpy as np
from pxr import Usd, UsdGeom

stage = Usd.Stage.Open(sys.argv[1])
prims = [p for p in stage.Traverse() if p.GetTypeName() == "ParticleField3DGaussianSplat"]
assert len(prims) == 1, prims
prim = prims[0]
get = lambda name: prim.GetAttribute(name).Get()
matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
positions = np.array(get("positions"), np.float64) @ matrix[:3, :3] + matrix[3, :3]
covariances = []
for q, s in zip(get("orientations"), get("scales")):
    r, (x, y, z) = q.GetReal(), q.GetImaginary()
    assert abs(r * r + x * x + y * y + z * z - 1) < 1e-5
    turn = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * r), 2 * (x * z + y * r)], [2 * (x * y + z * r), 1 - 2 * (x * x + z * z), 2 * (y * z - x * r)], [2 * (x * z - y * r), 2 * (y * z + x * r), 1 - 2 * (x * x + y * y)]])
    m = turn * np.array(s)
    covariances.append((m @ m.T).reshape(-1).tolist())
cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])
box = cache.ComputeWorldBound(prim).ComputeAlignedRange()
coefficients = prim.GetAttribute("radiance:sphericalHarmonicsCoefficients")
print(json.dumps({
    "up": str(UsdGeom.GetStageUpAxis(stage)),
    "metersPerUnit": UsdGeom.GetStageMetersPerUnit(stage),
    "degree": get("radiance:sphericalHarmonicsDegree"),
    "elementSize": coefficients.GetMetadata("elementSize"),
    "positions": positions.tolist(),
    "covariances": covariances,
    "opacities": list(get("opacities")),
    "coefficients": np.array(coefficients.Get(), np.float64).tolist(),
    "box": [list(box.GetMin()), list(box.GetMax())],
}))
