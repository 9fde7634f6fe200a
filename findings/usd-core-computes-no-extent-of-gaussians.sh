#!/bin/sh
# OpenUSD computes no extent of a ParticleField3DGaussianSplat: without an authored one its bounding box is empty, and
# viewers cannot frame it. Expected: a box around the positions, as UsdGeom.Points has. Found with usd-core 26.11.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q usd-core==26.11
venv/bin/python - <<'PY'
from pxr import Gf, Usd, UsdGeom, Vt

stage = Usd.Stage.CreateInMemory()
places = Vt.Vec3fArray([Gf.Vec3f(0, 0, 0), Gf.Vec3f(1, 2, 3)])
splats = stage.DefinePrim("/Splats", "ParticleField3DGaussianSplat")
splats.GetAttribute("positions").Set(places)
splats.GetAttribute("orientations").Set(Vt.QuatfArray([Gf.Quatf(1)] * 2))
splats.GetAttribute("scales").Set(Vt.Vec3fArray([Gf.Vec3f(0.1)] * 2))
splats.GetAttribute("opacities").Set(Vt.FloatArray([1, 1]))
points = UsdGeom.Points.Define(stage, "/Points")
points.GetPointsAttr().Set(places)
points.GetWidthsAttr().Set(Vt.FloatArray([0.1, 0.1]))
cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])
box = lambda prim: cache.ComputeWorldBound(prim).ComputeAlignedRange()
print("usd-core", ".".join(map(str, Usd.GetVersion())), "two positions, no extent")
print("box of ParticleField3DGaussianSplat empty:", box(splats).IsEmpty())
print("box of Points:", box(points.GetPrim()))
raise SystemExit(0 if box(splats).IsEmpty() and not box(points.GetPrim()).IsEmpty() else 1)
PY
