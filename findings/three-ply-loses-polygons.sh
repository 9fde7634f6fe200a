#!/bin/sh
# three.js leaves out each face of a .ply that has more than four corners, without a word: there are holes in the mesh.
# Expected: they are cut into triangles, as its OBJLoader does, or a warning. Found with three 0.187.0.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-audit --no-fund --ignore-scripts three@0.187.0 >/dev/null 2>&1
cat > prism.mjs <<'JS'
import { REVISION, Vector3 } from 'three';
import { OBJLoader } from 'three/addons/loaders/OBJLoader.js';
import { PLYLoader } from 'three/addons/loaders/PLYLoader.js';

// A closed prism with six sides: two hexagons and six quads.
const six = [...Array(6).keys()];
const places = [0, 1].flatMap(z => six.map(i => [Math.cos(i * Math.PI / 3), Math.sin(i * Math.PI / 3), z]));
const faces = [[5, 4, 3, 2, 1, 0], [6, 7, 8, 9, 10, 11], ...six.map(i => [i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6])];
const ply = [
  'ply', 'format ascii 1.0', `element vertex ${places.length}`, ...['x', 'y', 'z'].map(a => `property float ${a}`),
  `element face ${faces.length}`, 'property list uchar int vertex_indices', 'end_header',
  ...places.map(p => p.join(' ')), ...faces.map(f => [f.length, ...f].join(' ')), ''].join('\n');
const obj = [...places.map(p => ['v', ...p]), ...faces.map(f => ['f', ...f.map(i => i + 1)]), []].map(w => w.join(' ')).join('\n');

function area(geometry) {
  const flat = geometry.index ? geometry.toNonIndexed() : geometry;
  const at = flat.getAttribute('position');
  const corner = i => new Vector3().fromBufferAttribute(at, i);
  let sum = 0;
  for (let i = 0; i < at.count; i += 3) {
    const a = corner(i);
    sum += corner(i + 1).sub(a).cross(corner(i + 2).sub(a)).length() / 2;
  }
  return sum;
}
let said = 0;
for (const how of ['log', 'warn', 'error']) { const old = console[how]; console[how] = (...w) => { said += 1; old(...w); }; }
const found = { ply: area(new PLYLoader().parse(ply)), obj: area(new OBJLoader().parse(obj).children[0].geometry) };
const [quietly, whole] = [said === 0, 6 + 3 * Math.sqrt(3)];
console.log(`three r${REVISION}: a prism with six sides, area ${whole.toFixed(3)}`);
console.log(`area read from .obj ${found.obj.toFixed(3)}, from .ply ${found.ply.toFixed(3)}: no top and bottom`);
console.log(`nothing said: ${quietly}`);
console.log('Our meshes are made of triangles.');
const same = quietly && Math.abs(found.obj - whole) < 1e-5 && Math.abs(found.ply - 6) < 1e-5;
if (!same) { console.error('the behavior has changed'); process.exitCode = 1; }
JS
node prism.mjs
