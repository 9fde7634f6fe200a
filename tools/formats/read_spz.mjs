// .spz in Node: Niantic's library, as Adobe ships it, and spz-js; Gaussians with names as in object.mjs.
import { readFileSync } from "node:fs";
import createSpz from "@adobe/spz";
import { loadSpz } from "spz-js";

const rows = (cloud) => Array.from({ length: cloud.numPoints }, (_, i) => {
  const of = (values, width) => [...values.subarray(width * i, width * (i + 1))], [x, y, z, w] = of(cloud.rotations, 4);
  return { mean: of(cloud.positions, 3), scale: of(cloud.scales, 3), rotation: [w, x, y, z], opacity: cloud.alphas[i], color: of(cloud.colors, 3) };
});

const library = await createSpz();
// In the file's own frame.
export const niantic = async (path) =>
  rows(library.loadSpzFromBuffer(new Uint8Array(readFileSync(path)), { to: library.CoordinateSystem.RUB }));
export const spzJs = async (path) => rows(await loadSpz(new Uint8Array(readFileSync(path))));
