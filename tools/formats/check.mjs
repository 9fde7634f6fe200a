#!/usr/bin/env node
// One object in every format, read by readers that are not ours, and shown by them and by our page beside `freerange render`.
//
//     tools/formats/run.sh target/release/freerange
//     node --experimental-websocket check.mjs ../../target/release/freerange [FOLDER]
//
// Needs Chromium ($CHROMIUM, or `chromium` on the path), and what run.sh installs. $PYTHON is the Python that has gsply, gaussforge,
// usd-core, pycolmap and nerfstudio; without it they are left out, and said so.
// Node 22 and later needs no option.
import { execFileSync } from "node:child_process";
import { existsSync, mkdirSync, mkdtempSync, readFileSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join, resolve } from "node:path";
import validator from "gltf-validator";
import { browser, serve } from "./browser.mjs";
import { covariance, difference, fromCsv, object, toPly, turned } from "./object.mjs";
import { niantic, spzJs } from "./read_spz.mjs";

const [, , command, given] = process.argv;
const here = new URL(".", import.meta.url).pathname, folder = resolve(given ?? mkdtempSync(join(tmpdir(), "formats-")));
mkdirSync(folder, { recursive: true });
let failed = 0;
const check = (name, ok, found) => {
  console.log(`${ok ? "ok    " : "FAILED"} ${name}: ${found}`);
  failed += ok ? 0 : 1;
};
const run = (program, ...args) => execFileSync(program, args, { encoding: "utf8", maxBuffer: 1 << 28 });
const file = (name) => join(folder, name);

// The object, and its files.
const gaussians = object(900), yUp = turned(gaussians, "x z -y");
writeFileSync(file("object.ply"), toPly(gaussians));
for (const name of ["written.ply", "object.splat", "object.spz", "object.sog", "object.glb", "object.usda", "object.usdz", "view.html"])
  run(command, "convert", file("object.ply"), file(name));
for (const version of ["2", "4"]) run(command, "convert", file("object.ply"), file(`version${version}.spz`), "--spz-version", version);

// What formats may lose: centres, log-scales, radians, opacity, colour. Half a step each, and a little for others' arithmetic.
const LOSS = {
  "written.ply": [1e-6, 1e-5, 1e-3, 1e-5, 1e-5],
  "object.splat": [1e-6, 1e-5, 0.03, 0.0025, 0.0025],
  "object.spz": [2e-6, 0.032, 0.006, 0.0025, 0.004],
  // Of rotations w is left out, whatever its size: ten degrees.
  "version2.spz": [2e-6, 0.032, 0.19, 0.0025, 0.004],
  "version4.spz": [2e-6, 0.032, 0.006, 0.0025, 0.004],
  "object.sog": [6e-6, 0.01, 0.017, 0.0025, 0.004],
};
const compare = (reader, name, expected, found, loss = LOSS[name]) => {
  const d = difference(expected, found), ok = Object.values(d).every((v, i) => v <= loss[i]);
  check(`${reader} reads ${name}`, ok, Object.entries(d).map(([k, v]) => `${k} ${v.toExponential(1)}`).join(", "));
};

// Of readers that show nothing else: each center with the nearest.
const centers = (reader, name, positions) => {
  const all = Array.from({ length: positions.length / 3 }, (_, i) => positions.slice(3 * i, 3 * i + 3));
  const far = (a, b) => Math.max(...a.map((v, k) => Math.abs(v - b[k])));
  const apart = Math.max(...asWritten(name).map((g) => Math.min(...all.map((p) => far(p, g.mean)))));
  check(`${reader} reads ${name}`, all.length === gaussians.length && apart <= LOSS[name][0], `centers ${apart.toExponential(1)}`);
};

// Readers take the numbers of .spz as they are, +y up.
const asWritten = (name) => (name.endsWith(".spz") ? yUp : gaussians);
const transform = join(here, "node_modules/@playcanvas/splat-transform/bin/cli.mjs");
for (const name of Object.keys(LOSS)) {
  run("node", transform, "-q", "-w", file(name), file(`${name}.csv`));
  compare("splat-transform", name, asWritten(name), fromCsv(file(`${name}.csv`)));
}
for (const name of ["version2.spz", "object.spz", "version4.spz"]) compare("Niantic's library", name, yUp, await niantic(file(name)));
compare("spz-js", "version2.spz", yUp, await spzJs(file("version2.spz")));

const python = process.env.PYTHON ?? join(here, "venv/bin/python");
if (existsSync(python)) {
  const read = (script, name) => JSON.parse(run(python, join(here, script), file(name)).trim().split("\n").at(-1));
  for (const name of Object.keys(LOSS)) {
    if (name !== "object.splat") compare("gsply", name, asWritten(name), read("read_gsply.py", name));
    compare("gaussforge", name, asWritten(name), read("read_gaussforge.py", name));
  }
  for (const name of ["object.usda", "object.usdz"]) usd(name, read("read_usd.py", name));
} else if (process.env.CI === "true") check("Python's readers", false, `no ${python}`);
else console.log(`left out: gsply, gaussforge, usd-core (no ${python})`);

// The COLMAP model of a result, by pycolmap and by nerfstudio's own reader, against the cameras of the scene.
const imports = () => {
  try {
    run(python, "-c", "import pycolmap, nerfstudio");
    return true;
  } catch {
    return false;
  }
};
if (existsSync(python) && imports()) {
  const bowl = join(here, "../../examples/bowl"), quick = ["--iterations", "0", "--set", "refine.passes=1", "--symmetry", "off"];
  run(command, "reconstruct", bowl, "-o", file("bowl"), "--format", "colmap", ...quick);
  const said = run(python, join(here, "read_colmap.py"), file("bowl/colmap"), join(bowl, "transforms_train.json"));
  const found = JSON.parse(said.trim().split("\n").at(-1)), [points, theirs] = found.points;
  const same = found.photos.every((n) => n === 4) && points === theirs && points > 1000 && found.apart < 1e-9;
  check("pycolmap and nerfstudio read a COLMAP model", same && found.pose < 1e-5 && found.intrinsics < 1e-6, JSON.stringify(found));
} else if (process.env.CI === "true") check("readers of COLMAP models", false, `no pycolmap and nerfstudio for ${python}`);
else console.log(`left out: pycolmap, nerfstudio (none for ${python})`);

// OpenUSD: values of the stage, in its frame (+z up here), and the box that frames it, three deviations around.
function usd(name, found) {
  const most = (a, b) => Math.max(...a.flat().map((v, k) => Math.abs(v - b.flat()[k])));
  const logistic = (v) => 1 / (1 + Math.exp(-v));
  const apart = {
    mean: most(gaussians.map((g) => g.mean), found.positions),
    covariance: most(gaussians.map((g) => covariance(g)), found.covariances),
    opacity: most(gaussians.map((g) => logistic(g.opacity)), found.opacities),
    color: most(gaussians.map((g) => g.color), found.coefficients),
  };
  const same = found.up === "Z" && found.degree === 0 && found.elementSize === 1 && found.positions.length === gaussians.length;
  const around = gaussians.every((g) => g.mean.every((v, k) => {
    const reach = 3 * Math.sqrt(covariance(g)[4 * k]) - 1e-6;
    return v - reach >= found.box[0][k] && v + reach <= found.box[1][k];
  }));
  const ok = same && around && apart.mean < 1e-6 && apart.covariance < 1e-8 && apart.opacity < 1e-6 && apart.color < 2e-6;
  check(`usd-core reads ${name}`, ok, Object.entries(apart).map(([k, v]) => `${k} ${v.toExponential(1)}`).join(", "));
}

// The validator does not know the extension: one message per attribute of it, and no other.
const report = await validator.validateBytes(new Uint8Array(readFileSync(file("object.glb"))));
const known = (m) => m.code === "MESH_PRIMITIVE_INVALID_ATTRIBUTE" && m.pointer.includes("/KHR_gaussian_splatting:")
  || m.code === "UNSUPPORTED_EXTENSION" && m.message.includes("KHR_gaussian_splatting");
const others = report.issues.messages.filter((m) => !known(m));
const attributes = report.issues.messages.filter((m) => m.code === "MESH_PRIMITIVE_INVALID_ATTRIBUTE").length;
check("gltf-validator", others.length === 0 && attributes === 4 && !report.issues.truncated,
  others.map((m) => `${m.code} ${m.pointer}: ${m.message}`).join("; ") || "nothing but the four attributes of the extension");

// Pictures: ours first.
const WIDTH = 480, HEIGHT = 560;
const eye = [0.75, -0.6, 0.5], target = [0.12, 0.08, 0.05], fov = 40, toYUp = ([x, y, z]) => [x, z, -y];
const psnr = (a, b) => {
  let sum = 0, n = 0;
  a.forEach((v, i) => { if (i % 4 < 3) { sum += (v - b[i]) ** 2; n += 1; } });
  return 10 * Math.log10(255 ** 2 * n / sum);
};
const bytes = (base64) => new Uint8Array(Buffer.from(base64, "base64"));
const server = await serve({ modules: join(here, "node_modules"), files: folder, page: here });
const chromium = await browser(WIDTH, HEIGHT);
try {
  const address = `file://${file("view.html")}#eye=${eye}&target=${target}&fov=${fov}`;
  await chromium.send("Emulation.setEmulatedMedia", { features: [{ name: "prefers-color-scheme", value: "light" }] });
  await chromium.send("Network.enable");
  await chromium.send("Network.emulateNetworkConditions", { offline: true, latency: 0, downloadThroughput: 0, uploadThroughput: 0 });
  await chromium.open(address);
  await chromium.until("window.viewer?.frames > 0");
  const size = await chromium.evaluate("[viewer.canvas.clientWidth, viewer.canvas.clientHeight]");
  const view = { width: size[0], height: size[1], fov };
  const shot = async () => {
    await chromium.evaluate("viewer.draw()");
    const clip = { x: 0, y: 0, ...view, scale: 1 };
    const { data } = await chromium.send("Page.captureScreenshot", { format: "png", clip });
    return data;
  };
  const picture = await shot();
  writeFileSync(file("view.png"), Buffer.from(picture, "base64"));
  check("view.html offline", chromium.errors.length === 0, chromium.errors.join("; ") || "no errors");
  // Keys, buttons, dark.
  const state = "JSON.stringify([viewer.orbit.azimuth, viewer.orbit.elevation, viewer.orbit.distance].map((v) => v.toFixed(4)))";
  const before = await chromium.evaluate(state);
  await chromium.evaluate("viewer.canvas.focus()");
  for (const key of ["ArrowLeft", "ArrowUp", "+"]) {
    const code = { ArrowLeft: 37, ArrowUp: 38, "+": 187 }[key];
    await chromium.send("Input.dispatchKeyEvent", { type: "keyDown", key, windowsVirtualKeyCode: code, text: key === "+" ? "+" : undefined });
    await chromium.send("Input.dispatchKeyEvent", { type: "keyUp", key, windowsVirtualKeyCode: code });
  }
  const keyed = JSON.parse(await chromium.evaluate(state)), at = JSON.parse(before);
  check("view.html, keys", keyed.every((v, i) => v !== at[i]), `${at} to ${keyed}`);
  const mouse = (type, x, y) => chromium.send("Input.dispatchMouseEvent", { type, x, y, button: "left", buttons: type === "mouseReleased" ? 0 : 1, clickCount: 1 });
  await mouse("mousePressed", 100, 100);
  await mouse("mouseMoved", 150, 120);
  await mouse("mouseReleased", 150, 120);
  const dragged = JSON.parse(await chromium.evaluate(state));
  check("view.html, mouse", dragged[0] !== keyed[0] && dragged[1] !== keyed[1] && dragged[2] === keyed[2], `${keyed} to ${dragged}`);
  await chromium.send("Emulation.setTouchEmulationEnabled", { enabled: true, maxTouchPoints: 2 });
  const touch = (type, ...points) => chromium.send("Input.dispatchTouchEvent", { type, touchPoints: points.map(([x, y], id) => ({ x, y, id })) });
  await touch("touchStart", [200, 200], [260, 200]);
  await touch("touchMove", [180, 200], [300, 200]);
  await touch("touchEnd");
  const pinched = JSON.parse(await chromium.evaluate(state));
  check("view.html, two fingers", Number(pinched[2]) < Number(dragged[2]), `distance ${dragged[2]} to ${pinched[2]}`);
  await chromium.evaluate("document.querySelector('[data-do=reset]').click(); document.querySelector('[data-do=background]').click()");
  const dark = await chromium.evaluate("[viewer.background[0] < 0.2, JSON.stringify(viewer.orbit) === JSON.stringify(viewer.home)].join()");
  check("view.html, reset and dark", dark === "true,true", dark);
  const tree = await chromium.send("Accessibility.getFullAXTree");
  const named = tree.nodes.filter((n) => n.role?.value === "button").map((n) => n.name?.value);
  check("view.html, names", named.length === 8 && named.every((n) => n?.length > 1), named.join(", "));
  await chromium.send("Network.emulateNetworkConditions", { offline: false, latency: 0, downloadThroughput: -1, uploadThroughput: -1 });

  // The same camera for `freerange render`: columns are right, up, back, eye.
  const minus = (a, b) => a.map((v, i) => v - b[i]), norm = (a) => a.map((v) => v / Math.hypot(...a));
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const back = norm(minus(eye, target)), right = norm(cross([0, 0, 1], back)), up = cross(back, right);
  const focal = view.height / 2 / Math.tan(fov * Math.PI / 360);
  const matrix = [0, 1, 2].map((k) => [right[k], up[k], back[k], eye[k]]).concat([[0, 0, 0, 1]]);
  const camera = { w: view.width, h: view.height, fl_x: focal, fl_y: focal, cx: view.width / 2, cy: view.height / 2 };
  writeFileSync(file("cameras.json"), JSON.stringify({ ...camera, frames: [{ file_path: "ours", transform_matrix: matrix }] }));
  run(command, "render", file("object.ply"), "--cameras", file("cameras.json"), "-o", file("renders"));

  await chromium.open(`${server.url}/page/readers.html`);
  await chromium.until("window.ready");
  const decode = async (name) => bytes((await chromium.evaluate(`decode("/files/${name}")`)).data);
  const ours = await decode("renders/ours.png");
  const shown = (name, data, least, other = ours, what = "freerange render") => {
    const db = psnr(other, data);
    check(`${name} beside ${what}`, db >= least, `${db.toFixed(1)} dB`);
  };
  shown("view.html", await decode("view.png"), 30);
  const upright = { ...view, eye: toYUp(eye), target: toYUp(target), up: [0, 1, 0] }, zUp = { ...view, eye, target, up: [0, 0, 1] };
  // three.js ends Gaussians at two standard deviations and lets thin ones fade: its own files agree with each other far better.
  let first;
  for (const [reader, name] of [
    ["three", "object.glb"], ["three", "object.spz"], ["three", "version4.spz"],
    ["spark", "object.spz"], ["spark", "object.splat"], ["spark", "object.sog"], ["spark", "written.ply"],
  ]) {
    const inYUp = /\.(glb|spz)$/.test(name);
    const call = { ...(inYUp ? upright : zUp), url: `/files/${name}` };
    const { data, positions, gaussians: found } = await chromium.evaluate(`${reader}(${JSON.stringify(call)})`);
    writeFileSync(file(`${reader}-${name}.rgba`), bytes(data));
    shown(`${reader}, ${name}`, bytes(data), reader === "three" ? 25 : 30);
    if (reader === "three" && first) shown(`${reader}, ${name}`, bytes(data), 38, first, "its object.glb");
    first ??= bytes(data);
    if (positions) centers(reader, name, positions);
    // Spark itself keeps 16-bit floats, 8 bits of log-scale, opacity and colour, and of rotations two of an octahedron and one of the angle.
    const kept = [2e-4, 0.045, 0.035, 0.0025, 0.003];
    if (found) compare(reader, name, asWritten(name), found, LOSS[name].map((v, k) => v + kept[k]));
  }
  // Without pictures, which take minutes.
  for (const name of ["written.ply", "object.splat", "version2.spz"]) {
    const positions = await chromium.evaluate(`threePositions("/files/${name}")`);
    centers("three", name, positions);
  }
  for (const name of ["version2.spz", "object.spz"]) {
    const found = await chromium.evaluate(`spzLoader("/files/${name}")`);
    compare("spz-loader", name, yUp, found);
  }
  // It keeps 8 bits of opacity and color, cut instead of rounded.
  for (const name of ["written.ply", "object.splat", "version2.spz"]) {
    const found = await chromium.evaluate(`splats3d("/files/${name}")`), kept = [1e-6, 1e-5, 1e-3, 0.004, 0.004];
    compare("gaussian-splats-3d", name, asWritten(name), found, LOSS[name].map((v, k) => v + kept[k]));
  }
} finally {
  await chromium.close();
  server.close();
}
console.log(failed ? `${failed} checks failed; files are in ${folder}` : "all agree");
process.exit(failed ? 1 : 0);
