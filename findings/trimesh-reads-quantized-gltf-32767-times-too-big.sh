#!/bin/sh
# trimesh takes normalized integers of KHR_mesh_quantization as they are: a mesh 4 across is read as 131,068 across, with
# no warning, though the file says that the extension is required. Expected: right, or refused. Found with trimesh 5.2.0.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
npm install --silent --no-audit --no-fund --ignore-scripts @gltf-transform/core@4.5.1 @gltf-transform/extensions@4.5.1 \
  @gltf-transform/functions@4.5.1 >/dev/null 2>&1
python3 -m venv venv
venv/bin/pip -q install trimesh==5.2.0 numpy==2.3.5
cat > make.mjs <<'JS'
import { Document, getBounds, NodeIO } from '@gltf-transform/core';
import { KHRMeshQuantization } from '@gltf-transform/extensions';
import { quantize } from '@gltf-transform/functions';

const made = new Document();
const buffer = made.createBuffer();
const add = (type, array) => made.createAccessor().setType(type).setArray(array).setBuffer(buffer);
const triangle = made.createPrimitive()
  .setAttribute('POSITION', add('VEC3', new Float32Array([0, 0, 0, 4, 0, 0, 0, 2, 0])))
  .setIndices(add('SCALAR', new Uint16Array([0, 1, 2])));
made.createScene().addChild(made.createNode().setMesh(made.createMesh().addPrimitive(triangle)));
const io = new NodeIO().registerExtensions([KHRMeshQuantization]);
await io.write('plain.glb', made);
await made.transform(quantize());
await io.write('quantized.glb', made);
const again = (await io.read('quantized.glb')).getRoot().listScenes()[0];
console.log('glTF Transform reads its quantized file: largest corner', getBounds(again).max.join(', '));
JS
node make.mjs
venv/bin/python -W error - <<'PY'
import json
import logging
import pathlib
import struct
import trimesh

said = []
handler = logging.Handler()
handler.emit = lambda record: said.append(record.getMessage())
logging.getLogger("trimesh").addHandler(handler)
data = pathlib.Path("quantized.glb").read_bytes()
required = json.loads(data[20:20 + struct.unpack_from("<I", data, 12)[0]])["extensionsRequired"]
sizes = {name: trimesh.load_scene(f"{name}.glb").extents.tolist() for name in ("plain", "quantized")}
print(f"trimesh {trimesh.__version__}: extents of plain.glb {sizes['plain']}, of quantized.glb {sizes['quantized']}")
print("the file requires", required, "and trimesh says:", said or "nothing")
print("Our meshes and Gaussians are floats, and our reader heeds `normalized`.")
wrong = abs(sizes["quantized"][0] - 4 * 32767) < 1 and abs(sizes["plain"][0] - 4) < 1e-6 and not said
raise SystemExit(0 if wrong else "the behavior has changed")
PY
