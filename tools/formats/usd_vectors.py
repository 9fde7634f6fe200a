"""Golden files of OpenUSD's ParticleField3DGaussianSplat, by usd-core's own writer, from source.ply.

    pip install usd-core==26.11 numpy plyfile
    python tools/formats/usd_vectors.py tests/golden/formats

placed.usdz has 32-bit attributes on a prim that two transforms place; half.usda 16-bit ones, +z up, degree 0.
"""
import sys
from pathlib import Path

import numpy as np
from plyfile import PlyData
from pxr import Gf, Usd, UsdGeom, UsdUtils, Vt

folder = Path(sys.argv[1])
rows = PlyData.read(str(folder / "source.ply"))["vertex"]
column = lambda *names: np.stack([np.asarray(rows[n], np.float64) for n in names], 1)
positions = column("x", "y", "z")
scales = np.exp(column("scale_0", "scale_1", "scale_2"))
opacities = 1 / (1 + np.exp(-np.asarray(rows["opacity"], np.float64)))
quaternions = column("rot_0", "rot_1", "rot_2", "rot_3")
quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
constant = column("f_dc_0", "f_dc_1", "f_dc_2")
each = sum(p.name.startswith("f_rest_") for p in rows.properties) // 3
rest = column(*(f"f_rest_{i}" for i in range(3 * each))).reshape(-1, 3, each).transpose(0, 2, 1)


def prim(stage, path):
    return stage.DefinePrim(path, "ParticleField3DGaussianSplat")


def write(prim, half, coefficients, degree):
    end = "h" if half else ""
    vec3 = (lambda v: Vt.Vec3hArray([Gf.Vec3h(*map(float, x)) for x in v])) if half else (lambda v: Vt.Vec3fArray([Gf.Vec3f(*map(float, x)) for x in v]))
    quat = (lambda v: Vt.QuathArray([Gf.Quath(*map(float, x)) for x in v])) if half else (lambda v: Vt.QuatfArray([Gf.Quatf(*map(float, x)) for x in v]))
    real = (lambda v: Vt.HalfArray([float(x) for x in v])) if half else (lambda v: Vt.FloatArray([float(x) for x in v]))
    prim.GetAttribute("positions" + end).Set(vec3(positions))
    prim.GetAttribute("orientations" + end).Set(quat(quaternions))
    prim.GetAttribute("scales" + end).Set(vec3(scales))
    prim.GetAttribute("opacities" + end).Set(real(opacities))
    prim.GetAttribute("radiance:sphericalHarmonicsCoefficients" + end).Set(vec3(coefficients.reshape(-1, 3)))
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(degree)


stage = Usd.Stage.CreateNew(str(folder / "placed.usda"))
UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
UsdGeom.SetStageMetersPerUnit(stage, 1.0)
root = UsdGeom.Xform.Define(stage, "/World")
root.AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
root.AddRotateXYZOp().Set(Gf.Vec3f(90, 0, 0))
splats = prim(stage, "/World/Splats")
UsdGeom.Xformable(splats).AddScaleOp().Set(Gf.Vec3f(2, 2, 2))
degree = int(round((each + 1) ** 0.5)) - 1
write(splats, False, np.concatenate([constant[:, None], rest], 1), degree)
stage.SetDefaultPrim(root.GetPrim())
stage.GetRootLayer().Save()
UsdUtils.CreateNewUsdzPackage(str(folder / "placed.usda"), str(folder / "placed.usdz"))
(folder / "placed.usda").unlink()

stage = Usd.Stage.CreateNew(str(folder / "half.usda"))
UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
UsdGeom.SetStageMetersPerUnit(stage, 1.0)
write(prim(stage, "/Splats"), True, constant[:, None], 0)
stage.GetRootLayer().Save()
