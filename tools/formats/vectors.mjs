#!/usr/bin/env node
// Files by other programs' writers, for our readers: tests/golden/formats.
//
//     cd tools/formats && npm ci && node vectors.mjs ../../tests/golden/formats
//
// From one .ply with first-degree spherical harmonics, written here: compressed .ply, .sog, .spz and .glb by splat-transform, .spz 2 by
// @adobe/spz (the format's own C++ code). Those by splat-transform 2.7.1, which turned .spz to +y up, are kept: source.compressed.ply,
// source.sog, source.glb, v3.spz, v4.spz. Python's writers: other_vectors.py and usd_vectors.py.
import { execFileSync } from "node:child_process";
import { mkdirSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import createSpz from "@adobe/spz";
import { object, toPly } from "./object.mjs";

const [, , folder] = process.argv;
mkdirSync(folder, { recursive: true });
const gaussians = object(270, 9), source = join(folder, "source.ply");
writeFileSync(source, toPly(gaussians));
const command = new URL("node_modules/@playcanvas/splat-transform/bin/cli.mjs", import.meta.url).pathname;
const convert = (name, ...options) => execFileSync("node", [command, "-q", "-w", ...options, source, join(folder, name)], { stdio: "inherit" });
for (const kind of ["compressed.ply", "sog", "glb"]) convert(`transform.${kind}`, "-g", "cpu");
for (const version of ["3", "4"]) convert(`transform-v${version}.spz`, "--spz-version", version);

const spz = await createSpz();
const all = (f) => Float32Array.from(gaussians.flatMap(f));
const cloud = {
  numPoints: gaussians.length, shDegree: 1, antialiased: false, extensions: [],
  positions: all((g) => g.mean), scales: all((g) => g.scale), alphas: all((g) => [g.opacity]), colors: all((g) => g.color),
  rotations: all((g) => [...g.rotation.slice(1), g.rotation[0]]),
  sh: all((g) => [0, 1, 2].flatMap((c) => [0, 1, 2].map((rgb) => g.rest[3 * rgb + c]))),
};
const options = { version: 2, from: spz.CoordinateSystem.RDF, sh1Bits: 5, shRestBits: 4 };
writeFileSync(join(folder, "v2.spz"), spz.saveSpzToBuffer(cloud, options));
