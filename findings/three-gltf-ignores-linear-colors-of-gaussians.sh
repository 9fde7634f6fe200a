#!/bin/sh
# three.js passes over the color space of KHR_gaussian_splatting: one gray becomes 128 from srgb_rec709_display, and 55 from
# lin_rec709_display, without a word. Expected: one color, or a warning as for its other fields. Found with three 0.187.0.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-audit --no-fund --ignore-scripts three@0.187.0 >/dev/null 2>&1
cat > gray.mjs <<'JS'
import { REVISION } from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
globalThis.self = globalThis; // its renderer wants a browser's name for this
globalThis.ProgressEvent = class extends Event {};
const { GLTFGaussianSplatLoaderExtension } = await import('three/addons/loaders/GLTFGaussianSplatLoaderExtension.js');

let said = 0;
for (const how of ['warn', 'error']) { const old = console[how]; console[how] = (...w) => { said += 1; old(...w); }; }

// One Gaussian of a gray, whose harmonics of degree 0 are those of the value in the color space named.
async function loaded(colorSpace, value) {
  const own = name => `KHR_gaussian_splatting:${name}`;
  const dc = (value - 0.5) / 0.28209479177387814;
  const parts = [
    ['POSITION', 'VEC3', [0, 0, 0]], [own('SCALE'), 'VEC3', [0.1, 0.1, 0.1]], [own('ROTATION'), 'VEC4', [0, 0, 0, 1]],
    [own('OPACITY'), 'SCALAR', [1]], [own('SH_DEGREE_0_COEF_0'), 'VEC3', [dc, dc, dc]]];
  const [numbers, accessors, bufferViews, attributes] = [[], [], [], {}];
  parts.forEach(([name, type, values], i) => {
    bufferViews.push({ buffer: 0, byteOffset: 4 * numbers.length, byteLength: 4 * values.length });
    accessors.push({ bufferView: i, componentType: 5126, count: 1, type, ...(i ? {} : { min: values, max: values }) });
    attributes[name] = i;
    numbers.push(...values);
  });
  const uri = 'data:application/octet-stream;base64,' + Buffer.from(new Float32Array(numbers).buffer).toString('base64');
  const extensions = { KHR_gaussian_splatting: { kernel: 'ellipse', colorSpace } };
  const gltf = {
    asset: { version: '2.0' }, extensionsUsed: ['KHR_gaussian_splatting'], scene: 0, scenes: [{ nodes: [0] }],
    nodes: [{ mesh: 0 }], meshes: [{ primitives: [{ mode: 0, attributes, extensions }] }], accessors, bufferViews,
    buffers: [{ byteLength: 4 * numbers.length, uri }] };
  const loader = new GLTFLoader().register(parser => new GLTFGaussianSplatLoaderExtension(parser));
  const { scene } = await loader.parseAsync(JSON.stringify(gltf), '');
  return scene.getObjectByProperty('isGaussianSplat', true).splatGeometry.getAttribute('color').array[0];
}
const encoded = await loaded('srgb_rec709_display', 0.5);
const linear = await loaded('lin_rec709_display', 0.214);
console.log(`three r${REVISION}: one gray is held as ${encoded} from srgb_rec709_display 0.5`);
console.log(`and as ${linear} from lin_rec709_display 0.214, for one shader to draw; said: ${said || 'nothing'}`);
console.log('We write srgb_rec709_display, and read both.');
if (encoded !== 128 || linear !== 55 || said) { console.error('the behavior has changed'); process.exitCode = 1; }
JS
node gray.mjs
