#!/usr/bin/env node
// The page of `freerange serve` in headless Chromium, from a dropped folder to a downloaded .glb in another program's reader.
//
//     node --experimental-websocket check.mjs ../../target/release/freerange
//
// Needs Chromium ($CHROMIUM, or `chromium` on the path). With $PICTURES, pictures of every state are written there.
import { execFileSync, spawn } from "node:child_process";
import { cpSync, mkdirSync, mkdtempSync, readFileSync, rmSync, truncateSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join, resolve } from "node:path";
import { browser, serve } from "../formats/browser.mjs";

const [, , command] = process.argv;
const here = new URL(".", import.meta.url).pathname, root = resolve(here, "../.."), bowl = join(root, "examples/bowl");
const folder = mkdtempSync(join(tmpdir(), "serve-")), keep = join(folder, "keep"), pictures = process.env.PICTURES;
if (pictures) mkdirSync(pictures, { recursive: true });
let failed = 0;
const check = (name, ok, found) => {
  console.log(`${ok ? "ok    " : "FAILED"} ${name}: ${found}`);
  failed += ok ? 0 : 1;
};
const told = (name, found) => console.log(`        ${name}: ${found}`);
const wait = (ms) => new Promise((done) => setTimeout(done, ms));

/** Stands for a Python with pycolmap: places no photo. */
const engine = join(folder, "python");
writeFileSync(engine, `#!/bin/sh
if [ "$1" = -c ]; then echo 0.0-test; exit 0; fi
echo '{"step": "features", "done": 0}'
sleep 6
echo '{"engine": "test", "models": [], "pairs": null, "points": 0}' > "$(dirname "$2")/result.json"
`, { mode: 0o755 });
/** Starts the program; resolves when it has told its address, with the token that it has drawn. Few steps from noise: the page is checked, not the samples. */
const start = () => new Promise((done, fail) => {
  const program = spawn(command, ["serve", "--port", "0", "--keep", keep, "--device", "cpu", "--python", engine, "--set", "propose.flow.steps=8"], { stdio: ["ignore", "pipe", "inherit"] });
  let text = "";
  program.on("error", fail);
  program.on("exit", (code, signal) => fail(new Error(`freerange serve ended: ${code ?? signal}`)));
  program.stdout.on("data", (chunk) => {
    text += chunk;
    const found = /^(http:\/\/\S+)\/\?token=(\S+)\n/.exec(text);
    if (found) done({ program, url: found[1], token: found[2] });
  });
});
const ended = (program) => new Promise((done) => {
  program.removeAllListeners("exit");
  program.once("exit", (code, signal) => done(code ?? signal));
});

let { program, url, token } = await start();
const get = async (path) => {
  const response = await fetch(url + path, { headers: { Authorization: `Bearer ${token}` } });
  if (!response.ok) throw new Error(`${path}: ${response.status}`);
  return Buffer.from(await response.arrayBuffer());
};
const chromium = await browser(1100, 850);
const { send, evaluate, until } = chromium;
const click = (selector) => evaluate(`document.querySelector(${JSON.stringify(selector)}).click()`);
const state = (name, seconds = 300) => until(`document.body.dataset.state === ${JSON.stringify(name)}`, seconds);
const picture = async (name) => {
  if (!pictures) return;
  await evaluate("window.viewers?.forEach((v) => v.draw())");
  const { data } = await send("Page.captureScreenshot", { format: "jpeg", quality: 50 });
  writeFileSync(join(pictures, `${name}.jpg`), Buffer.from(data, "base64"));
};
const mouse = (type, x, y, buttons = 1) => send("Input.dispatchMouseEvent", { type, x, y, button: "left", buttons: type === "mouseReleased" ? 0 : buttons, clickCount: 1 });
const middle = (selector) => evaluate(`(() => { const r = document.querySelector(${JSON.stringify(selector)}).getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; })()`);
const drag = async (selector, dx, dy) => {
  const [x, y] = await middle(selector);
  await mouse("mousePressed", x, y);
  for (const t of [0.25, 0.5, 0.75, 1]) await mouse("mouseMoved", x + t * dx, y + t * dy);
  await mouse("mouseReleased", x + dx, y + dy);
};
const key = async (name, code) => {
  await send("Input.dispatchKeyEvent", { type: "keyDown", key: name, code: name, windowsVirtualKeyCode: code });
  await send("Input.dispatchKeyEvent", { type: "keyUp", key: name, code: name, windowsVirtualKeyCode: code });
};
const axe = readFileSync(join(here, "node_modules/axe-core/axe.min.js"), "utf8");
const accessible = async (what) => {
  await send("Runtime.evaluate", { expression: axe });
  const found = await evaluate("axe.run(document, { resultTypes: ['violations'] }).then((r) => r.violations.filter((v) => ['serious', 'critical'].includes(v.impact)).map((v) => v.id + ': ' + v.nodes.map((n) => n.target.join(' ')).slice(0, 3).join(', ')))");
  check(`axe, ${what}`, found.length === 0, found.join("; ") || "nothing serious");
};
/** A number that differs where Gaussians differ. */
const SUM = "window.viewers[0].rows.reduce((sum, v, i) => sum + v * ((i % 97) + 1), 0)";

try {
  await send("Emulation.setEmulatedMedia", { features: [{ name: "prefers-color-scheme", value: "light" }] });
  let bytes = 0;
  const modules = ["main", "jobs", "job", "gaussians", "panes", "brush", "zoom", "edit", "send", "record", "remove", "gif", "dom", "state"].map((name) => `/${name}.js`);
  for (const path of ["/", "/style.css", "/viewer.js", ...modules]) bytes += (await get(path)).length;
  check("size of the page", bytes < 120_000, `${bytes} bytes`);

  // Who does not know the token is asked for it; a wrong one is told; a link of another site with the right one leads to the page.
  await chromium.open(url);
  await until("document.querySelector('form')?.action.startsWith('http')");
  await accessible("login");
  await picture("login");
  await evaluate("document.getElementById('token').value = 'wrong-wrong-wrong-wrong'; document.querySelector('form').submit()");
  await until("document.getElementById('alert')?.textContent.includes('not the token')");
  await accessible("login, wrong token");
  check("a wrong token", true, await evaluate("document.getElementById('alert').textContent"));
  const linked = join(folder, "link");
  mkdirSync(linked);
  writeFileSync(join(linked, "index.html"), `<a id="link" href="${url}/?token=${token}">free-range</a>`);
  const other = await serve({ link: linked });
  await chromium.open(`${other.url.replace("127.0.0.1", "localhost")}/link/index.html`);
  await evaluate("document.getElementById('link').click()");
  await until("document.getElementById('engine')?.textContent");
  check("a link of another site", await evaluate("location.pathname + location.search") === "/", await evaluate("location.href"));
  // Followed again without the token: the cookie is there, though the browser holds it back at first.
  writeFileSync(join(linked, "index.html"), `<a id="link" href="${url}/">free-range</a>`);
  await chromium.open(`${other.url.replace("127.0.0.1", "localhost")}/link/index.html`);
  await evaluate("document.getElementById('link').click()");
  await until("document.getElementById('engine')?.textContent");
  check("a link of another site without the token", true, await evaluate("location.href"));
  other.close();

  check("limits before anything is sent", await evaluate("document.getElementById('limits').textContent.includes('512 MB')"), await evaluate("document.getElementById('limits').textContent"));
  await accessible("at the start");
  await picture("start");

  // What the server would not take is said before anything is sent. The files are large in name only.
  const [x, y] = await middle("#drop");
  const dropped = async (file) => {
    for (const type of ["dragEnter", "dragOver", "drop"]) await send("Input.dispatchDragEvent", { type, x, y, data: { items: [], files: [file], dragOperationsMask: 1 } });
  };
  for (const [name, size, words, named = "a.png"] of [["large", 513 * 2 ** 20, "takes at most 512 MB"], ["one", 65 * 2 ** 20, "takes at most 64 MB a file"], ["phone", 1, "HEIC files", "a.heic"], ["notes", 1, "no photo and no file of Gaussians", "a.txt"]]) {
    const place = join(folder, name), file = join(place, named);
    mkdirSync(place);
    writeFileSync(file, "");
    truncateSync(file, size);
    await dropped(place);
    await until(`document.getElementById('alert').textContent.includes(${JSON.stringify(words)})`);
    check(`refused before it is sent, ${name}`, await evaluate("location.hash") === "", await evaluate("document.getElementById('alert').textContent"));
    rmSync(place, { recursive: true });
  }

  // A folder is dropped, over a slow line: how far it is.
  await send("Network.enable");
  const line = (uploadThroughput) => send("Network.emulateNetworkConditions", { offline: false, latency: 0, downloadThroughput: -1, uploadThroughput });
  await line(30_000);
  await dropped(bowl);
  await until("!document.getElementById('sending').hidden && document.getElementById('sent').value > 0 && document.getElementById('sent').value < 1", 30);
  check("how far an upload is", await evaluate("document.getElementById('sent-text').textContent.startsWith('Sent ')"), await evaluate("document.getElementById('sent-text').textContent"));
  await accessible("while it is sent");
  await picture("sending");
  await click("#stop-sending");
  await until("document.getElementById('alert').textContent === 'nothing was sent' && document.getElementById('sending').hidden");
  check("an upload is stopped", await evaluate("location.hash") === "", await evaluate("document.getElementById('alert').textContent"));
  await line(-1);
  await dropped(bowl);
  await state("ready", 120);
  await until("document.querySelectorAll('#photos img.cut').length === 4 && [...document.querySelectorAll('#photos img')].every((i) => i.complete)");
  const title = await evaluate("document.getElementById('job-title').textContent");
  check("a dropped folder", title === "bowl", title);
  await accessible("with photos");
  await picture("understood");
  // The first view has all cameras; without them the object is larger.
  const eyes = JSON.parse(await get(`/jobs/${await evaluate("location.hash.slice(5)")}`)).understood.views
    .map(({ camera: { world_to_camera: m } }) => [0, 1, 2].map((i) => -(m[4 * i] * m[12] + m[4 * i + 1] * m[13] + m[4 * i + 2] * m[14])));
  const distance = () => evaluate("window.viewers[0].orbit.distance"), far = await distance();
  const inSight = await evaluate(`(() => {
    const [viewer] = window.viewers, { right, down, forward, eye } = viewer.pose(), { focal, middle } = viewer.lens(viewer.size());
    return ${JSON.stringify(eyes)}.filter((e) => {
      const along = (axis) => axis.reduce((sum, v, i) => sum + v * (e[i] - eye[i]), 0);
      return along(forward) > 0 && [right, down].every((axis, i) => Math.abs(focal[i] * along(axis) / along(forward)) < middle[i]);
    }).length;
  })()`);
  check("cameras in sight", inSight === 4, `${inSight} of 4`);
  await click("#show-cameras");
  check("the object without cameras", await distance() < 0.7 * far, `${await distance()} after ${far}`);
  await click("#show-cameras");

  // Photos without cameras, where nothing finds them: what to do is said, and its field is shown.
  const shared = await evaluate("location.hash"), bare = join(folder, "bare");
  cpSync(join(bowl, "train"), bare, { recursive: true });
  const finder = (found) => evaluate(`import("/send.js").then(({ tellServer }) => import("/state.js").then(({ app }) => { Object.assign(app, { finder: ${JSON.stringify(found)}, defaults: {} }); tellServer(); }))`);
  await finder({ missing: "nobody here finds cameras" });
  await dropped(bare);
  await until("document.getElementById('alert').textContent.includes('nobody here finds cameras')");
  check("nothing finds cameras", await evaluate("document.getElementById('reading').open && document.getElementById('bare').hidden"), await evaluate("document.getElementById('alert').textContent"));
  await accessible("where nothing finds cameras");
  await evaluate("document.getElementById('reading').open = false");
  await finder({ name: "pycolmap 0.0-test" });
  // They are looked for, and the engine's refusal is told.
  check("what finds cameras is said", await evaluate("document.getElementById('finder').textContent.includes('pycolmap 0.0-test')"), await evaluate("document.getElementById('finder').textContent"));
  await dropped(bare);
  await until("document.getElementById('cameras-dialog').open");
  await accessible("photos without cameras");
  await picture("cameras");
  await click("#cameras-close");
  await until("!document.getElementById('cameras-dialog').open");
  check("nothing is sent without a yes", await evaluate("location.hash") === shared, shared);
  await dropped(bare);
  await until("document.getElementById('cameras-dialog').open");
  await click("#cameras-form button.main");
  await until("document.getElementById('status').textContent.startsWith('Finding the cameras')", 30);
  const searching = await evaluate("document.getElementById('status').textContent");
  check("progress of the search", !await evaluate("document.getElementById('progress').hidden || document.getElementById('cancel').hidden"), searching);
  await picture("searching");
  await state("failed", 60);
  const refusal = await evaluate("document.getElementById('status').textContent");
  check("a refusal of the engine", refusal.includes("only 0 of 4 photos could be placed") && !refusal.includes("--"), refusal);
  await until("document.querySelector('#jobs a[aria-current]')?.title.includes('only 0 of 4 photos')");
  check("a failed job's card", await evaluate("!document.querySelector('#jobs a[aria-current] img')"), "the reason, and no picture");
  await accessible("failed");
  await picture("failed");
  await evaluate(`location.hash = ${JSON.stringify(shared)}`);
  await state("ready", 30);

  // A mask is edited: by pointer, by keys.
  await click("#photos li:nth-child(2) button:not(.look)");
  await until("document.getElementById('brush').open");
  await wait(200);
  await click("#paint-erase");
  await drag("#paint", 40, 10);
  await evaluate("document.getElementById('paint').focus()");
  await key("ArrowRight", 39);
  await send("Input.dispatchKeyEvent", { type: "keyDown", key: " ", code: "Space", windowsVirtualKeyCode: 32 });
  await picture("brush");
  await accessible("brush");
  for (let i = 0; i < 2; i++) await click("#paint-undo");
  check("undo of the brush", await evaluate("document.getElementById('paint-undo').disabled"), "two strokes taken back");
  // Larger by the wheel; painted there; moved with Shift; and whole again.
  const [px, py] = await middle("#paint");
  await send("Input.dispatchMouseEvent", { type: "mouseWheel", x: px, y: py, deltaX: 0, deltaY: -800 });
  await until("document.getElementById('paint-text').textContent.startsWith('Zoom 3')");
  await click("#paint-closer");
  await drag("#paint", 20, 10);
  await picture("zoom");
  check("zoom of the brush", await evaluate("!document.getElementById('paint-undo').disabled"), await evaluate("document.getElementById('paint-text').textContent"));
  await click("#paint-undo");
  for (const [type, far] of [["mousePressed", 0], ["mouseMoved", 30], ["mouseReleased", 30]]) await send("Input.dispatchMouseEvent", { type, x: px + far, y: py, button: "left", buttons: 1, modifiers: 8, clickCount: 1 });
  check("Shift moves the photo", await evaluate("document.getElementById('paint-undo').disabled"), "nothing is painted");
  await click("#paint-fit");
  await until("!document.getElementById('paint-text').textContent.startsWith('Zoom')");
  check("no view is similar", await evaluate("document.getElementById('paint-copy').disabled"), await evaluate("document.getElementById('paint-text').textContent"));
  await click("#paint-add");
  await drag("#paint", 12, 6);
  await click("#paint-save");
  await until("document.querySelector('#photos li:nth-child(2)').textContent.includes('edited')");
  check("an edited mask", true, await evaluate("document.querySelector('#photos li:nth-child(2) .small').textContent"));

  // What is painted goes to similar views: here a copy of the first photo, whose camera is five degrees farther around.
  const transforms = JSON.parse(readFileSync(join(bowl, "transforms_train.json"), "utf8")), [frame] = transforms.frames, [c, s] = [Math.cos(Math.PI / 36), Math.sin(Math.PI / 36)];
  const [m0, m1, ...rest] = frame.transform_matrix;
  transforms.frames.push({ ...frame, file_path: "train/004", transform_matrix: [m0.map((v, i) => c * v - s * m1[i]), m0.map((v, i) => s * v + c * m1[i]), ...rest] });
  const form = new FormData();
  form.append("f", new Blob([JSON.stringify(transforms)]), "near/transforms_train.json");
  for (const i of [0, 1, 2, 3, 4]) form.append("f", new Blob([readFileSync(join(bowl, `train/00${i % 4}.png`))]), `near/train/00${i}.png`);
  const { id: near } = await (await fetch(`${url}/jobs`, { method: "POST", body: form, headers: { Authorization: `Bearer ${token}` } })).json();
  await evaluate(`location.hash = "job=${near}"`);
  await until("document.querySelectorAll('#photos li').length === 5 && document.body.dataset.state === 'ready'", 120);
  await click("#photos li:nth-child(1) button:not(.look)");
  await until("document.getElementById('brush').open && !document.getElementById('paint-copy').disabled");
  const copied = "document.getElementById('paint-copy').getAttribute('aria-pressed')";
  await click("#paint-copy");
  check("copy to similar views", await evaluate(copied) === "true", await evaluate("document.getElementById('paint-text').textContent"));
  await click("#paint-undo");
  check("undo of the copy", await evaluate(copied) === "false", await evaluate("document.getElementById('paint-text').textContent"));
  for (const name of ["copy", "erase"]) await click(`#paint-${name}`);
  await drag("#paint", 40, 10);
  await click("#paint-save");
  await until("['1', '5'].every((n) => document.querySelector(`#photos li:nth-child(${n})`).textContent.includes('edited'))");
  const views = JSON.parse(await get(`/jobs/${near}`)).understood.views;
  check("painted in both", views[0].covers === views[4].covers && [1, 2, 3].every((i) => !views[i].edited), `${(100 * views[4].covers).toFixed(2)} %`);
  await evaluate(`location.hash = ${JSON.stringify(shared)}`);
  await until(`document.querySelectorAll('#photos li').length === 4 && document.body.dataset.state === 'ready'`, 30);

  // A row of buttons is one stop of the Tab key.
  await evaluate("document.querySelector('#tools button').focus()");
  await key("ArrowRight", 39);
  await key("End", 35);
  check("a toolbar by keys", await evaluate("document.activeElement.id") === "background", await evaluate("[...document.querySelectorAll('#tools button')].map((b) => b.tabIndex).join(' ')"));
  await click("#background");
  check("background has a state", await evaluate("document.getElementById('background').getAttribute('aria-pressed')") === "true", "pressed");
  await click("#background");

  // A title of one's own; removed, and had back.
  const idOf = () => evaluate("location.hash.slice(5)");
  await click("#rename");
  await accessible("rename");
  await evaluate("document.getElementById('new-title').value = 'a <b>bowl</b>'; document.querySelector('#rename-form button').click()");
  await until("document.getElementById('job-title').textContent === 'a <b>bowl</b>'");
  const mine = await idOf();
  await click("#remove");
  await until("document.getElementById('remove-dialog').open");
  check("remove asks", await evaluate("document.activeElement.id") === "remove-no", await evaluate("document.getElementById('remove-title').textContent"));
  await accessible("remove");
  await picture("remove");
  await click("#remove-yes");
  await until("document.activeElement.id === 'undo' && document.getElementById('job').hidden");
  check("focus after removal", true, "on Undo");
  await accessible("after removal");
  await picture("removed");
  await click("#undo");
  await until(`location.hash === '#job=${mine}' && document.getElementById('job-title').textContent === 'a <b>bowl</b>' && document.body.dataset.state === 'ready'`);
  check("undo", true, await evaluate("document.getElementById('status').textContent"));

  // Go; orbit while it computes; cancel.
  const go = async () => {
    await evaluate(`(() => {
      document.body.dataset.estimates = "0";
      window.first = new Promise((done) => new MutationObserver((_, watcher) => {
        if (!(Number(document.body.dataset.estimates) > 0)) return;
        watcher.disconnect();
        requestAnimationFrame(() => done(performance.now() - window.pressed));
      }).observe(document.body, { attributeFilter: ["data-estimates"] }));
      window.pressed = performance.now();
      document.getElementById("go").click();
    })()`);
    await until("Number(document.body.dataset.estimates) > 0 && window.viewers[0].count > 0", 120);
    return evaluate("window.first");
  };
  const first = await go();
  told("first estimate on the page after pressing go", `${(first / 1000).toFixed(2)} s`);
  const orbit = "JSON.stringify(window.viewers[0].orbit)", before = await evaluate(orbit);
  await drag(".stage canvas", 80, 30);
  const running = await evaluate("document.body.dataset.state");
  check("orbit while it computes", running === "running" && before !== await evaluate(orbit), running);
  const pressed = Date.now();
  await click("#cancel");
  await state("cancelled", 10);
  check("cancel", true, `${Date.now() - pressed} ms`);
  await accessible("cancelled");
  await picture("cancelled");

  // Another one to the end.
  await go();
  const seen = new Set();
  let shot = false, more = "";
  while (await evaluate("document.body.dataset.state !== 'done' && document.body.dataset.state !== 'failed'")) {
    more ||= await evaluate("/about \\d+ (s|min) left in this step/.exec(document.getElementById('status').textContent)?.[0] ?? ''");
    seen.add(`${await evaluate("document.body.dataset.state === 'running' ? document.getElementById('status').textContent.split(',')[0] : ''")} ${await evaluate(SUM)}`);
    if (!shot && seen.size > 6) {
      await picture("running");
      shot = true;
    }
    await wait(30);
  }
  const stages = [...new Set([...seen].map((s) => s.slice(0, s.lastIndexOf(" "))))].filter(Boolean);
  check("steps are counted", stages.every((stage) => stage === "Starting." || /^Step [1-5] of 5: /.test(stage)), stages[0]);
  check("different estimates", seen.size >= 5, `${seen.size}, in ${stages.join(", ")}`);
  check("time left", more !== "", more || "never told");
  await state("done", 1);
  const id = await evaluate("location.hash.slice(5)");
  await until(`document.body.dataset.result === ${JSON.stringify(id)}`);
  await picture("done");
  await accessible("with a result");

  // A turntable as the browser records it; and the object turns by itself.
  await evaluate("window.saved = []; HTMLAnchorElement.prototype.click = function () { window.saved.push(this.download); }");
  await click("#film");
  await until("Number(document.body.dataset.film) > 1000 && window.saved.length === 1", 60);
  check("turntable", true, `${await evaluate("window.saved[0]")}, ${await evaluate("document.body.dataset.film")} bytes`);
  // The same as a GIF, decoded by the browser.
  await evaluate("window.blobs = []; window.make = URL.createObjectURL; URL.createObjectURL = (blob) => (window.blobs.push(blob), window.make.call(URL, blob)); true");
  await click("#gif");
  await until("window.saved.length === 2", 120);
  await evaluate("URL.createObjectURL = window.make");
  const animation = await evaluate(`(async () => {
    const data = await window.blobs[0].arrayBuffer(), decoder = new ImageDecoder({ type: "image/gif", data });
    await decoder.tracks.ready;
    const pixels = async (frameIndex) => {
      const { image } = await decoder.decode({ frameIndex }), context = new OffscreenCanvas(image.displayWidth, image.displayHeight).getContext("2d");
      context.drawImage(image, 0, 0);
      return context.getImageData(0, 0, image.displayWidth, image.displayHeight);
    };
    const track = decoder.tracks.selectedTrack, [one, half] = [await pixels(0), await pixels(track.frameCount / 2)];
    const moved = one.data.reduce((sum, v, i) => sum + Number(Math.abs(v - half.data[i]) > 20), 0) / one.data.length;
    return { head: new TextDecoder().decode(data.slice(0, 6)), frames: track.frameCount, again: String(track.repetitionCount), width: one.width, height: one.height, moved, bytes: data.byteLength };
  })()`);
  const gif = `${animation.frames} frames of ${animation.width} x ${animation.height}, ${animation.bytes} bytes, ${(100 * animation.moved).toFixed(0)} % of it moves`;
  check("turntable as a GIF", animation.head === "GIF89a" && animation.frames === 48 && animation.again === "Infinity" && animation.width === 360 && animation.height === 270 && animation.moved > 0.01, gif);
  await click("#shot");
  await until("window.saved.length === 3");
  check("a picture", (await evaluate("window.saved[2]")).endsWith("-0.png"), await evaluate("window.saved[2]"));
  await evaluate("delete HTMLAnchorElement.prototype.click");
  await click("#auto");
  const turned = await evaluate("window.viewers[0].orbit.azimuth");
  await until(`window.viewers[0].orbit.azimuth > ${turned} + 0.02`);
  await click("#auto");
  check("turns by itself", await evaluate("document.getElementById('auto').getAttribute('aria-pressed')") === "false", "and stops");
  // The whole screen, which a browser gives to a user's own click only.
  await send("Runtime.evaluate", { expression: "document.getElementById('full').click()", userGesture: true });
  await until("document.fullscreenElement?.id === 'views'", 10);
  await picture("full-screen");
  await evaluate("document.exitFullscreen()");
  await until("!document.fullscreenElement", 10);
  check("full screen", true, "and back");

  // Cropped, tidied, and had back.
  await evaluate("document.getElementById('edit').open = true");
  await until("document.getElementById('edit-text').textContent.includes(' of ')");
  const all = await evaluate("window.viewers[0].count");
  await evaluate("(() => { const to = document.getElementById('to-2'); to.value = 50; to.dispatchEvent(new Event('input')); })()");
  const half = await evaluate("window.viewers[0].count");
  const places = await evaluate("[...document.querySelectorAll('#crop label')].map((l) => l.textContent)");
  check("where the box is", places.length === 6 && places.every((text) => /^[xyz] (from|to) -?[\d.]+/.test(text)), places.join(", "));
  await send("Emulation.setDeviceMetricsOverride", { width: 1280, height: 900, deviceScaleFactor: 1, mobile: false });
  const needed = await evaluate("document.querySelector('.stage').getBoundingClientRect().bottom - document.getElementById('edit').getBoundingClientRect().top");
  check("sliders and view on one screen", needed < 900, `${needed} of 900 px`);
  await send("Emulation.setDeviceMetricsOverride", { width: 1100, height: 850, deviceScaleFactor: 1, mobile: false });
  await accessible("with a box");
  await picture("crop");
  await click("#edit-crop");
  await until("!document.getElementById('edit-undo').disabled");
  const [header] = (await get(`/jobs/${id}/samples/0.ply`)).toString("latin1").split("end_header");
  check("crop", half < all && header.includes(`element vertex ${half}\n`), `${half} of ${all}, in the file as well`);
  await click("#edit-undo");
  await until(`window.viewers[0].count === ${all} && document.getElementById('edit-undo').disabled`);
  await click("#edit-tidy");
  await until("!document.getElementById('edit-undo').disabled");
  const loose = all - await evaluate("window.viewers[0].count");
  told("floaters", `${loose} Gaussians`);
  await click("#edit-undo");
  await until(`window.viewers[0].count === ${all} && document.getElementById('edit-undo').disabled`);
  check("undo of an edit", true, await evaluate("document.getElementById('edit-text').textContent"));
  await evaluate("document.getElementById('edit').open = false");

  // Through a photo's camera, and the slider between the two.
  await click("#photos li:nth-child(1) .look");
  await until("!document.getElementById('compare').hidden && document.querySelector('.stage img').complete");
  await evaluate("document.getElementById('slider').focus()");
  const clip = "document.querySelector('.stage img').style.clipPath", at50 = await evaluate(clip);
  for (let i = 0; i < 10; i++) await key("ArrowRight", 39);
  check("slider by keys", at50 !== await evaluate(clip), `${at50} to ${await evaluate(clip)}`);
  await evaluate("document.getElementById('slider').value = 50; document.getElementById('slider').dispatchEvent(new Event('input'))");
  await evaluate("window.scrollTo(0, 0)");
  await picture("slider");

  // The page's pixels beside those of `freerange render`, from the same camera.
  const ply = join(folder, "gaussians.ply");
  writeFileSync(ply, await get(`/jobs/${id}/samples/0.ply`));
  execFileSync(command, ["render", ply, "--cameras", join(bowl, "transforms_train.json"), "-o", join(folder, "renders")]);
  await evaluate("Object.assign(document.querySelector('.stage').style, { width: '514px', height: '514px', aspectRatio: 'auto', boxSizing: 'border-box' })");
  await until("window.viewers[0].canvas.clientWidth === 512 && window.viewers[0].canvas.clientHeight === 512");
  // There is no graphics card here: the page draws with the processor. A second viewer draws with WebGL all the same.
  await evaluate(`(() => {
    const [viewer] = window.viewers, canvas = document.createElement("canvas");
    canvas.style.cssText = "display: block; width: 512px; height: 512px";
    document.body.append(canvas);
    window.painters = { processor: viewer, card: new Viewer(canvas, { by: "card", background: viewer.background }) };
    window.painters.card.setGaussians(viewer.rows);
    window.painters.card.setCamera(viewer.camera);
  })()`);
  const painters = ["processor", "card"];
  for (const name of painters) {
    const shown = await evaluate(`(window.painters.${name}.draw(), window.painters.${name}.canvas.toDataURL())`);
    writeFileSync(join(folder, `${name}.png`), Buffer.from(shown.split(",")[1], "base64"));
  }
  check("what draws the page", await evaluate("window.viewers[0].painter instanceof Processor"), "the processor, without a graphics card");
  const glb = await get(`/jobs/${id}/samples/0.glb`);
  writeFileSync(join(folder, "object.glb"), glb);
  const job = JSON.parse(await get(`/jobs/${id}`));

  // Frames per second: every frame whole, as at rest; and as the page shows them in motion. Told, not checked: machines differ.
  for (const name of painters) {
    const before = await chromium.processorTime();
    const whole = await evaluate(`(() => {
      const viewer = window.painters.${name};
      viewer.leaveCamera();
      const begin = performance.now();
      let frames = 0;
      while (performance.now() - begin < 3000) {
        viewer.turn(0.02, 0);
        viewer.draw();
        viewer.painter.finish();
        frames += 1;
      }
      return { frames, seconds: (performance.now() - begin) / 1000, gaussians: viewer.count };
    })()`);
    const used = await chromium.processorTime() - before;
    const moving = await evaluate(`new Promise((done) => {
      const viewer = window.painters.${name}, begin = performance.now();
      let frames = null;
      const turn = () => {
        const seconds = (performance.now() - begin) / 1000;
        // The first two seconds are for finding the resolution.
        if (seconds > 2) frames ??= { at: seconds, count: viewer.frames };
        if (seconds > 6) return done({ fps: (viewer.frames - frames.count) / (seconds - frames.at), width: viewer.canvas.width });
        viewer.turn(0.02, 0);
        requestAnimationFrame(turn);
      };
      turn();
    })`);
    const title = `frames per second by the ${name}, ${whole.gaussians} Gaussians`;
    told(`${title}, 512 x 512`, `${(whole.frames / whole.seconds).toFixed(1)}; ${(1000 * used / whole.frames).toFixed(0)} ms of processors per frame`);
    told(`${title}, in motion`, `${moving.fps.toFixed(1)}, ${moving.width} pixels wide`);
    await until(`window.painters.${name}.canvas.width === 512`);
  }
  check("full resolution after motion", true, "512 pixels");

  // A reload finds the job again.
  await chromium.open(`${url}/#job=${id}`);
  await until(`document.body.dataset.result === ${JSON.stringify(id)}`);
  check("reload", (await evaluate("document.getElementById('status').textContent")).startsWith("Done in "), await evaluate("document.getElementById('status').textContent"));

  // Its address in another browser, which does not know the token: after the login it leads to the same object.
  await click("#link");
  await until("document.getElementById('alert').textContent.includes('address')");
  const address = await evaluate("location.href");
  await send("Network.clearBrowserCookies");
  await chromium.open(address);
  await until("document.querySelector('form')?.action.includes('#job=')");
  await evaluate(`document.getElementById('token').value = ${JSON.stringify(token)}; document.querySelector('form').submit()`);
  await until(`document.body.dataset.result === ${JSON.stringify(id)}`);
  check("the address in another browser", await evaluate("location.hash") === new URL(address).hash, address);

  // Cancelled, a job has its earlier result.
  await go();
  await click("#cancel");
  await state("cancelled", 10);
  await until("document.getElementById('status').textContent.includes('earlier result is kept') && !document.getElementById('result').hidden");
  check("a second run is cancelled", true, await evaluate("document.getElementById('status').textContent"));

  // Several samples, and where they differ.
  await evaluate("Object.assign(document.getElementById('samples'), { value: 2 }); Object.assign(document.getElementById('iterations'), { value: 60 }); document.getElementById('init').value = 'flow'");
  await go();
  await state("done", 600);
  await until("Number(document.getElementById('heat').dataset.mean) > 0", 30);
  check("where samples differ", await evaluate("window.viewers.length === 2"), await evaluate("document.getElementById('spread-text').textContent"));
  await evaluate("document.getElementById('job-title').scrollIntoView()");
  await picture("samples");

  // A phone, in the dark.
  await send("Emulation.setDeviceMetricsOverride", { width: 390, height: 844, deviceScaleFactor: 1, mobile: true });
  await send("Emulation.setEmulatedMedia", { features: [{ name: "prefers-color-scheme", value: "dark" }] });
  await wait(300);
  const wide = await evaluate("document.documentElement.scrollWidth");
  check("a phone's width", wide <= 390, `${wide} px of 390`);
  await accessible("on a phone, dark");
  await picture("phone");
  await send("Emulation.setDeviceMetricsOverride", { width: 1100, height: 850, deviceScaleFactor: 1, mobile: false });
  const errors = chromium.errors.filter((e) => !/status of 4(01|04|10)/.test(e));
  check("errors of the page", errors.length === 0, errors.join("; ") || "none");

  // Killed in the middle of a job, and started again.
  await evaluate("document.getElementById('init').value = ''");
  await go();
  const gone = ended(program);
  program.kill("SIGKILL");
  await gone;
  ({ program, url, token } = await start());
  await chromium.open(`${url}/?token=${token}#job=${id}`);
  await state("interrupted", 30);
  check("kill -9 and start again", true, await evaluate("document.getElementById('status').textContent"));
  const settings = await evaluate("['samples', 'seed', 'iterations'].map((id) => document.getElementById(id).value).join()");
  check("the form has the job's settings", settings === "2,0,60", settings);
  await picture("interrupted");

  // A tab that nobody sees leaves its connection to others.
  const streams = async () => Number(/^freerange_streams (\d+)/m.exec((await get("/metrics")).toString())[1]);
  const hide = (hidden) => evaluate(`Object.defineProperty(document, "hidden", { value: ${hidden}, configurable: true }); document.dispatchEvent(new Event("visibilitychange"))`);
  const soon = async (count) => {
    for (let i = 0; i < 300 && await streams() !== count; i++) await wait(100);
    return streams();
  };
  const open = await soon(1);
  await hide(true);
  const hidden = await soon(0);
  await hide(false);
  check("streams of a hidden tab", open === 1 && hidden === 0 && await soon(1) === 1, `${open}, hidden ${hidden}, ${await streams()}`);

  // A file of Gaussians is shown, and offered in every format.
  // Anywhere on the page.
  const one = { items: [], files: [ply], dragOperationsMask: 1 };
  for (const type of ["dragEnter", "dragOver", "drop"]) await send("Input.dispatchDragEvent", { type, x, y, data: one });
  await until(`location.hash.slice(5) !== ${JSON.stringify(id)} && document.body.dataset.result === location.hash.slice(5) && window.viewers[0]?.count === ${all}`, 60);
  check("a file has its name, and no photos", await evaluate("document.getElementById('job-title').textContent === 'gaussians.ply' && document.getElementById('photos-title').hidden"), await evaluate("document.getElementById('job-title').textContent"));
  check("no seed of a file", !(await evaluate("document.getElementById('result').textContent + document.querySelector('#views').textContent")).match(/seed/i), await evaluate("document.querySelector('figcaption').textContent"));
  check("a dropped file of Gaussians", await evaluate("document.querySelectorAll('#downloads a').length") === job.formats.length, await evaluate("document.getElementById('notes').textContent"));
  await accessible("with a file of Gaussians");
  await picture("splats");

  // Three Gaussians far from all others are floaters, and nothing else of it is.
  const whole = readFileSync(ply), top = whole.indexOf("end_header\n") + 11, row = (whole.length - top) / all;
  const away = [5, 6, 7].map((place) => {
    const one = Buffer.from(whole.subarray(top, top + row));
    [0, 1, 2].forEach((axis) => one.writeFloatLE(place, 4 * axis));
    return one;
  });
  const floating = join(folder, "floating.ply"), last = await evaluate("location.hash.slice(5)");
  writeFileSync(floating, Buffer.concat([Buffer.from(whole.subarray(0, top).toString("latin1").replace(`element vertex ${all}\n`, `element vertex ${all + 3}\n`), "latin1"), whole.subarray(top), ...away]));
  for (const type of ["dragEnter", "dragOver", "drop"]) await send("Input.dispatchDragEvent", { type, x, y, data: { ...one, files: [floating] } });
  await until(`location.hash.slice(5) !== ${JSON.stringify(last)} && document.body.dataset.result === location.hash.slice(5) && window.viewers[0]?.count === ${all + 3}`, 60);
  await evaluate("document.getElementById('edit').open = true");
  await until(`document.getElementById('edit-text').textContent.includes(' of ')`);
  // The first step of a slider leaves them out, however far away they are.
  await evaluate("(() => { const to = document.getElementById('to-0'); to.value = 99; to.dispatchEvent(new Event('input')); })()");
  const within = await evaluate("window.viewers[0].count");
  check("sliders span the object", within > 0.9 * all && within <= all, `${within} of ${all} and three far away`);
  await click("#edit-tidy");
  await until("!document.getElementById('edit-undo').disabled");
  const tidied = await evaluate("window.viewers[0].count"), file = await get(`/jobs/${await evaluate("location.hash.slice(5)")}/samples/0.ply`), start0 = file.indexOf("end_header\n") + 11;
  const farthest = Math.max(...Array.from({ length: tidied }, (_, k) => file.readFloatLE(start0 + k * row)));
  // What hangs together is judged by voxels, whose size depends a little on where all Gaussians are.
  check("floaters", farthest < 4 && Math.abs(tidied - (all - loose)) < 0.01 * all, `${tidied} of ${all + 3}, ${loose} of them loose before, x up to ${farthest}`);
  const left = ended(program);
  program.kill("SIGTERM");
  check("asked to end", await Promise.race([left, wait(20_000).then(() => "still there")]) === 0, "exit code 0");

  // The .glb in three.js; and the pictures, decoded without anyone's colour management.
  const files = await serve({ modules: join(here, "../formats/node_modules"), files: folder, page: join(here, "../formats") });
  try {
    await chromium.open(`${files.url}/page/readers.html`);
    await until("window.ready");
    const decode = async (name) => Buffer.from((await evaluate(`decode("/files/${name}")`)).data, "base64");
    const psnr = (a, b) => {
      let sum = 0, n = 0;
      a.forEach((v, i) => { if (i % 4 < 3) { sum += (v - b[i]) ** 2; n += 1; } });
      return 10 * Math.log10(255 ** 2 * n / sum);
    };
    const ours = await decode("renders/000.png");
    for (const name of painters) {
      const db = psnr(ours, await decode(`${name}.png`));
      check(`the page by the ${name} beside freerange render`, db >= 45, `${db.toFixed(1)} dB`);
    }
    // The first photo's camera as three.js wants it; files of glTF have +y up.
    const { camera } = job.understood.views[0], m = camera.world_to_camera, rows = [0, 1, 2].map((i) => [m[i], m[i + 4], m[i + 8]]);
    const eye = [0, 1, 2].map((k) => -(rows[0][k] * m[12] + rows[1][k] * m[13] + rows[2][k] * m[14]));
    const toYUp = ([a, b, c]) => [a, c, -b], target = eye.map((v, k) => v + rows[2][k]);
    const fov = 2 * Math.atan(camera.height / 2 / camera.fy) * 180 / Math.PI;
    const view = { url: "/files/object.glb", width: 512, height: 512, fov, eye: toYUp(eye), target: toYUp(target), up: toYUp(rows[1].map((v) => -v)) };
    const { data: pixels } = await evaluate(`three(${JSON.stringify(view)})`);
    const other = psnr(ours, Buffer.from(pixels, "base64"));
    check("the .glb in three.js beside freerange render", other >= 25, `${other.toFixed(1)} dB, ${glb.length} bytes`);
  } finally {
    files.close();
  }
} finally {
  await chromium.close();
  program.kill("SIGKILL");
}
console.log(failed ? `${failed} checks failed; files are in ${folder}` : "all is well");
if (!failed) rmSync(folder, { recursive: true, force: true });
process.exit(failed ? 1 : 0);
