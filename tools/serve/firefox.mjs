#!/usr/bin/env node
// The page of `freerange serve` in headless Firefox: what check.mjs does in Chromium, in short.
//
//     node --experimental-websocket firefox.mjs ../../target/release/freerange
//
// Needs Firefox ($FIREFOX, or `firefox-esr` on the path). With $PICTURES, a picture of the result is written there.
import { spawn } from "node:child_process";
import { mkdirSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";

const [, , command] = process.argv, here = new URL(".", import.meta.url).pathname, pictures = process.env.PICTURES;
const wait = (ms) => new Promise((done) => setTimeout(done, ms));

/** What a program prints until `pattern` is found in it. */
const told = (program, stream, pattern) => new Promise((done, fail) => {
  let text = "";
  program.on("error", fail);
  program.on("exit", (code) => fail(new Error(`it ended with ${code}:\n${text}`)));
  stream.on("data", (chunk) => {
    text += chunk;
    const found = pattern.exec(text);
    if (found) done(found);
  });
});

/** One page of Firefox over WebDriver BiDi. */
const browser = async () => {
  const profile = mkdtempSync(join(tmpdir(), "firefox-"));
  const program = spawn(process.env.FIREFOX ?? "firefox-esr", ["--headless", "--remote-debugging-port", "0", "--profile", profile, "--no-remote", "about:blank"], { stdio: ["ignore", "ignore", "pipe"] });
  const [, address] = await told(program, program.stderr, /WebDriver BiDi listening on (ws:\S+)/);
  const socket = new WebSocket(`${address}/session`), waiting = new Map(), errors = [];
  await new Promise((done, fail) => Object.assign(socket, { onopen: done, onerror: () => fail(new Error(`no answer from ${address}`)) }));
  let last = 0;
  socket.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.method === "log.entryAdded" && message.params.level === "error") errors.push(message.params.text);
    const answer = waiting.get(message.id);
    waiting.delete(message.id);
    if (message.type === "error") answer?.fail(new Error(`${message.error}: ${message.message}`));
    else answer?.done(message.result);
  };
  const send = (method, params = {}) => new Promise((done, fail) => {
    waiting.set(++last, { done, fail });
    socket.send(JSON.stringify({ id: last, method, params }));
  });
  await send("session.new", { capabilities: {} });
  await send("session.subscribe", { events: ["log.entryAdded"] });
  const { contexts: [{ context }] } = await send("browsingContext.getTree");
  const evaluate = async (expression) => {
    const answer = await send("script.evaluate", { expression: `Promise.resolve(${expression}).then((v) => JSON.stringify(v) ?? "null")`, target: { context }, awaitPromise: true });
    if (answer.type !== "success") throw new Error(answer.exceptionDetails.text);
    return JSON.parse(answer.result.value);
  };
  const until = async (expression, seconds = 60) => {
    for (let i = 0; i < 20 * seconds; i++) {
      if (await evaluate(expression).catch(() => false)) return;
      await wait(50);
    }
    throw new Error(`not within ${seconds} s: ${expression}\n${errors.join("\n")}`);
  };
  const key = (value) => send("input.performActions", { context, actions: [{ type: "key", id: "keys", actions: [{ type: "keyDown", value }, { type: "keyUp", value }] }] });
  const open = (url) => send("browsingContext.navigate", { context, url, wait: "complete" });
  const picture = async () => Buffer.from((await send("browsingContext.captureScreenshot", { context, format: { type: "image/jpeg", quality: 0.5 } })).data, "base64");
  const close = async () => {
    socket.close();
    const ended = new Promise((done) => program.on("exit", done));
    program.removeAllListeners("exit");
    program.kill("SIGKILL");
    await Promise.race([ended, wait(1000)]);
    rmSync(profile, { recursive: true, force: true, maxRetries: 5 });
  };
  await send("browsingContext.setViewport", { context, viewport: { width: 1100, height: 850 } });
  return { evaluate, until, key, open, picture, close, errors };
};

let failed = 0;
const check = (name, ok, found) => {
  console.log(`${ok ? "ok    " : "FAILED"} Firefox, ${name}: ${found}`);
  failed += ok ? 0 : 1;
};
const server = spawn(command, ["serve", "--port", "0", "--device", "cpu", "--set", "propose.flow.steps=8"], { stdio: ["ignore", "pipe", "inherit"] });
let page;
try {
  const [, link] = await told(server, server.stdout, /^(http:\/\/\S+\?token=\S+)\n/);
  page = await browser();
  const { evaluate, until } = page;
  const click = (selector) => evaluate(`document.querySelector(${JSON.stringify(selector)}).click()`);
  const axe = readFileSync(join(here, "node_modules/axe-core/axe.min.js"), "utf8");
  const accessible = async (what) => {
    await evaluate(`(() => { ${axe}; return true; })()`);
    const found = await evaluate("window.axe.run(document, { resultTypes: ['violations'] }).then((r) => r.violations.filter((v) => ['serious', 'critical'].includes(v.impact)).map((v) => v.id))");
    check(`axe, ${what}`, found.length === 0, found.join(", ") || "nothing serious");
  };
  await page.open(link);
  await until("document.getElementById('engine')?.textContent");
  check("the link with the token", await evaluate("location.pathname + location.search") === "/", await evaluate("location.pathname"));
  await accessible("at the start");
  await click("#example");
  await until("document.body.dataset.state === 'ready'", 120);
  await accessible("with photos");
  await evaluate("document.querySelector('#tools button').focus()");
  await page.key("\uE014");
  check("a toolbar by keys", await evaluate("document.activeElement.dataset.do") === "right", "an arrow key moves");
  // A mask is edited, enlarged and by keys.
  await click("#photos li:nth-child(2) button:not(.look)");
  await until("document.getElementById('brush').open");
  await click("#paint-closer");
  await evaluate("document.getElementById('paint').focus()");
  await page.key(" ");
  await until("!document.getElementById('paint-undo').disabled");
  await click("#paint-save");
  await until("document.querySelector('#photos li:nth-child(2)').textContent.includes('edited')");
  check("an edited mask", true, await evaluate("document.querySelector('#photos li:nth-child(2) .small').textContent"));
  // Few steps: the page is checked, not the result.
  await evaluate("Object.assign(document.getElementById('iterations'), { value: 60 }) && (document.getElementById('quality').value = 'draft')");
  await click("#go");
  await until("Number(document.body.dataset.estimates) > 0 && window.viewers[0].count > 0", 300);
  await until("document.body.dataset.state === 'done'", 600);
  await until("document.body.dataset.result && document.querySelectorAll('#downloads a').length > 5");
  check("a result", await evaluate("window.viewers[0].count") > 0, `${await evaluate("window.viewers[0].count")} Gaussians`);
  await accessible("with a result");
  if (pictures) {
    mkdirSync(pictures, { recursive: true });
    await evaluate("(window.viewers.forEach((v) => v.draw()), true)");
    writeFileSync(join(pictures, "firefox.jpg"), await page.picture());
  }
  // A turntable as a GIF.
  await evaluate("(() => { const make = URL.createObjectURL; window.blobs = []; URL.createObjectURL = (blob) => (window.blobs.push(blob), make.call(URL, blob)); HTMLAnchorElement.prototype.click = function () {}; return true; })()");
  await click("#gif");
  await until("window.blobs.length === 1", 120);
  const [width, height] = await evaluate("createImageBitmap(window.blobs[0]).then((i) => [i.width, i.height])");
  check("turntable as a GIF", width === 360 && height === 270, `${width} x ${height}, ${await evaluate("window.blobs[0].size")} bytes`);
  await click("#remove");
  await click("#remove-yes");
  await until("document.activeElement.id === 'undo'");
  await click("#undo");
  await until("document.body.dataset.state === 'done' && !document.getElementById('job').hidden");
  check("remove and undo", true, await evaluate("document.getElementById('job-title').textContent"));
  const errors = page.errors.filter((e) => !/40[14]|410/.test(e));
  check("errors of the page", errors.length === 0, errors.join("; ") || "none");
} finally {
  await page?.close();
  server.kill("SIGKILL");
}
process.exit(failed ? 1 : 0);
