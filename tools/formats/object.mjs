// An object without any symmetry: arms of different lengths and colours along +x, +y and +z.
import { readFileSync } from "node:fs";

export const SH_C0 = 0.28209479177387814;

export function object(count, rest = 0) {
  let state = 12345;
  const random = () => {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    return state / 2 ** 31 - 1;
  };
  return Array.from({ length: count }, (_, i) => {
    const arm = i % 3, mean = [0, 0, 0].map(() => 0.02 * random());
    mean[arm] += [0.45, 0.3, 0.2][arm] * (random() + 1) / 2;
    const q = [0, 0, 0, 0].map(random), norm = Math.hypot(...q) * (q[0] < 0 ? -1 : 1);
    return {
      mean,
      scale: [0, 0, 0].map(() => -4.5 + random()),
      rotation: q.map((v) => v / norm),
      opacity: 2 + 3 * random(),
      color: [0, 1, 2].map((k) => ((k === arm ? 0.85 : 0.15) + 0.1 * random() - 0.5) / SH_C0),
      rest: Array.from({ length: rest }, () => 0.2 * random()),
    };
  });
}

const columns = (rest) => [
  "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", ...Array.from({ length: rest }, (_, i) => `f_rest_${i}`), "opacity",
  "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
];

export function toPly(gaussians) {
  const names = columns(gaussians[0].rest.length);
  const header = `ply\nformat binary_little_endian 1.0\nelement vertex ${gaussians.length}\n`
    + names.map((n) => `property float ${n}\n`).join("") + "end_header\n";
  const rows = gaussians.flatMap((g) => [...g.mean, ...g.color, ...g.rest, g.opacity, ...g.scale, ...g.rotation]);
  return Buffer.concat([Buffer.from(header), Buffer.from(Float32Array.from(rows).buffer)]);
}

const fromColumns = (get) => ({
  mean: ["x", "y", "z"].map(get),
  scale: [0, 1, 2].map((k) => get(`scale_${k}`)),
  rotation: [0, 1, 2, 3].map((k) => get(`rot_${k}`)),
  opacity: get("opacity"),
  color: [0, 1, 2].map((k) => get(`f_dc_${k}`)),
});

// A table with the columns of a .ply, as splat-transform writes it.
export function fromCsv(file) {
  const [head, ...lines] = readFileSync(file, "utf8").trim().split(/\r?\n/).map((l) => l.split(","));
  const at = Object.fromEntries(head.map((name, i) => [name.trim(), i]));
  return lines.map((line) => fromColumns((name) => {
    if (!(name in at)) throw new Error(`${file}: no column ${name}`);
    return Number(line[at[name]]);
  }));
}

// The largest differences, each Gaussian of `expected` with the nearest of `found`: writers may sort.
export function difference(expected, found) {
  if (expected.length !== found.length) throw new Error(`${found.length} Gaussians instead of ${expected.length}`);
  const most = { mean: 0, scale: 0, rotation: 0, opacity: 0, color: 0 };
  const apart = (a, b) => Math.max(...a.map((v, k) => Math.abs(v - b[k])));
  const shown = (logit) => 1 / (1 + Math.exp(-logit));
  for (const e of expected) {
    const f = found.reduce((best, g) => (apart(g.mean, e.mean) < apart(best.mean, e.mean) ? g : best));
    // Half turns about a Gaussian's own axes change nothing.
    const norm = Math.hypot(...f.rotation), between = product(e.rotation.map((v, k) => (k ? -v : v) / norm), f.rotation);
    const here = {
      mean: apart(e.mean, f.mean),
      scale: apart(e.scale, f.scale),
      rotation: 2 * Math.acos(Math.min(1, Math.max(...between.map(Math.abs)))),
      opacity: Math.abs(shown(e.opacity) - shown(f.opacity)),
      color: SH_C0 * apart(e.color, f.color),
    };
    for (const k in most) most[k] = Math.max(most[k], here[k]);
  }
  return most;
}

// The covariance, row by row.
export function covariance({ scale, rotation: [w, x, y, z] }) {
  const turn = [
    [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
  ];
  return turn.flatMap((a) => turn.map((b) => scale.reduce((sum, s, k) => sum + a[k] * b[k] * Math.exp(2 * s), 0)));
}

// `gaussians` turned by a quarter or half turn: `axes` says for each new axis which old one it is, and with which sign, as in "x z -y".
export function turned(gaussians, axes) {
  const rows = axes.split(" ").map((a) => [..."xyz"].map((name) => (a.at(-1) === name ? (a[0] === "-" ? -1 : 1) : 0)));
  const q = quaternion(rows);
  return gaussians.map((g) => ({
    ...g,
    mean: rows.map((r) => r.reduce((sum, v, k) => sum + v * g.mean[k], 0)),
    rotation: product(q, g.rotation),
  }));
}

const product = ([a, b, c, d], [w, x, y, z]) =>
  [a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y, a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w];

// Of a rotation matrix, the components by their squares and the signs of off-diagonals.
function quaternion(m) {
  const squares = [
    1 + m[0][0] + m[1][1] + m[2][2], 1 + m[0][0] - m[1][1] - m[2][2], 1 - m[0][0] + m[1][1] - m[2][2], 1 - m[0][0] - m[1][1] + m[2][2],
  ].map((v) => Math.max(0, v) / 4);
  const k = squares.indexOf(Math.max(...squares)), big = Math.sqrt(squares[k]);
  const off = [
    [0, m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]], [m[2][1] - m[1][2], 0, m[0][1] + m[1][0], m[0][2] + m[2][0]],
    [m[0][2] - m[2][0], m[0][1] + m[1][0], 0, m[1][2] + m[2][1]], [m[1][0] - m[0][1], m[0][2] + m[2][0], m[1][2] + m[2][1], 0],
  ][k];
  return off.map((v, i) => (i === k ? big : v / (4 * big)));
}
