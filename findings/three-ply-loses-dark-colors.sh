#!/bin/sh
# three.js keeps the byte colors of a .ply as linear light in bytes: of 256 grays 183 are left, and 0 to 6 become black.
# Expected: finer numbers than bytes, as for float colors, or the bytes as they are. Found with three 0.187.0.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-audit --no-fund --ignore-scripts three@0.187.0 >/dev/null 2>&1
cat > grays.mjs <<'JS'
import { Color, REVISION } from 'three';
import { PLYLoader } from 'three/addons/loaders/PLYLoader.js';

// A row of 256 points, one of each gray.
function grays(type, value) {
  const names = ['float x', 'float y', 'float z', ...['red', 'green', 'blue'].map(c => `${type} ${c}`)];
  const rows = [...Array(256).keys()].map(i => [i, 0, 0, value(i), value(i), value(i)].join(' '));
  const head = ['ply', 'format ascii 1.0', 'element vertex 256', ...names.map(n => `property ${n}`), 'end_header'];
  const color = new PLYLoader().parse([...head, ...rows, ''].join('\n')).getAttribute('color');
  const encoded = i => new Color().setRGB(color.getX(i), 0, 0).convertLinearToSRGB().r;
  const shown = [...Array(256).keys()].map(i => Math.round(255 * encoded(i)));
  const off = Math.max(...shown.map((v, i) => Math.abs(v - i)));
  const kind = color.array.constructor.name;
  console.log(`${type}: ${kind}, ${new Set(shown).size} of 256 grays left, up to ${off} off`);
  console.log(`    0 to 25 become ${shown.slice(0, 26).join(' ')}`);
  return { left: new Set(shown).size, off, black: shown.filter(v => v === 0).length };
}
console.log(`three r${REVISION}, PLYLoader, colors turned back to sRGB`);
const bytes = grays('uchar', i => i);
const floats = grays('float', i => i / 255);
console.log('Dark objects get bands. Our .ply meshes have byte colors; our .glb has linear floats and loses nothing.');
const same = bytes.left === 183 && bytes.off === 6 && bytes.black === 7 && floats.left === 256 && floats.off === 0;
if (!same) { console.error('the behavior has changed'); process.exitCode = 1; }
JS
node grays.mjs
