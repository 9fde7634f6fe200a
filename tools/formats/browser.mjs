// A headless Chromium over its debugging protocol, and a server of local files for it.
import { spawn } from "node:child_process";
import { createReadStream, existsSync, mkdtempSync, rmSync, statSync } from "node:fs";
import { createServer } from "node:http";
import { tmpdir } from "node:os";
import { extname, join, normalize } from "node:path";

const TYPES = { ".html": "text/html", ".js": "text/javascript", ".mjs": "text/javascript", ".wasm": "application/wasm", ".json": "application/json" };

// Serves `folders`, by the first part of the path.
export function serve(folders) {
  const server = createServer((request, response) => {
    const [, name, ...rest] = decodeURIComponent(new URL(request.url, "http://localhost").pathname).split("/");
    const path = folders[name] && join(folders[name], normalize(`/${rest.join("/")}`));
    if (!path || !existsSync(path) || !statSync(path).isFile()) return response.writeHead(404).end();
    response.writeHead(200, { "Content-Type": TYPES[extname(path)] ?? "application/octet-stream" });
    createReadStream(path).pipe(response);
  });
  return new Promise((done) => server.listen(0, "127.0.0.1", () => done({ url: `http://127.0.0.1:${server.address().port}`, close: () => server.close() })));
}

// One page; `send` speaks the protocol, `evaluate` runs an expression and returns its value, `errors` is what the page complained of.
export async function browser(width, height) {
  const profile = mkdtempSync(join(tmpdir(), "chromium-"));
  const command = process.env.CHROMIUM ?? "chromium";
  const flags = [
    "--headless", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars",
    "--remote-debugging-port=0", `--user-data-dir=${profile}`, "--no-first-run", "--disable-background-networking", "about:blank",
  ];
  const chromium = spawn(command, flags, { stdio: ["ignore", "ignore", "pipe"] });
  const address = await new Promise((done, fail) => {
    let text = "";
    chromium.on("error", fail);
    chromium.on("exit", () => fail(new Error(`${command} ended:\n${text}`)));
    chromium.stderr.on("data", (chunk) => {
      text += chunk;
      const found = text.match(/DevTools listening on (ws:\S+)/);
      if (found) done(found[1]);
    });
  });
  const socket = new WebSocket(address), waiting = new Map(), errors = [];
  await new Promise((done, fail) => Object.assign(socket, { onopen: done, onerror: () => fail(new Error(`no answer from ${address}`)) }));
  let last = 0, session;
  socket.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.method === "Runtime.exceptionThrown") errors.push(message.params.exceptionDetails.exception?.description ?? message.params.exceptionDetails.text);
    if (message.method === "Log.entryAdded" && message.params.entry.level === "error") errors.push(message.params.entry.text);
    const answer = waiting.get(message.id);
    waiting.delete(message.id);
    if (message.error) answer?.fail(new Error(message.error.message));
    else answer?.done(message.result);
  };
  const ask = (method, params, sessionId) => new Promise((done, fail) => {
    waiting.set(++last, { done, fail });
    socket.send(JSON.stringify({ id: last, method, params, sessionId }));
  });
  const send = (method, params = {}) => ask(method, params, session);
  // Seconds of all processors, of all processes of the browser.
  const processorTime = async () => (await ask("SystemInfo.getProcessInfo", {})).processInfo.reduce((sum, p) => sum + p.cpuTime, 0);
  const { targetInfos } = await send("Target.getTargets");
  const page = targetInfos.find((t) => t.type === "page");
  ({ sessionId: session } = await send("Target.attachToTarget", { targetId: page.targetId, flatten: true }));
  for (const domain of ["Page", "Runtime", "Log"]) await send(`${domain}.enable`);
  await send("Emulation.setDeviceMetricsOverride", { width, height, deviceScaleFactor: 1, mobile: false });
  const evaluate = async (expression) => {
    const { result, exceptionDetails } = await send("Runtime.evaluate", { expression, awaitPromise: true, returnByValue: true });
    if (exceptionDetails) throw new Error(exceptionDetails.exception?.description ?? exceptionDetails.text);
    return result.value;
  };
  const until = async (expression, seconds = 60) => {
    for (let i = 0; i < 20 * seconds; i++) {
      if (await evaluate(expression).catch(() => false)) return;
      await new Promise((done) => setTimeout(done, 50));
    }
    throw new Error(`not within ${seconds} s: ${expression}\n${errors.join("\n")}`);
  };
  const open = async (url) => {
    errors.length = 0;
    // A page that differs in its fragment only would not be loaded anew.
    await send("Page.navigate", { url: "about:blank" });
    await send("Page.navigate", { url });
    await until("document.readyState === 'complete' && location.href !== 'about:blank'");
  };
  const close = async () => {
    const ended = new Promise((done) => chromium.once("exit", done));
    chromium.removeAllListeners("exit");
    // Chromium's own children may write there a little longer: what could not be removed then is removed at the end, or stays.
    const remove = () => {
      try {
        rmSync(profile, { recursive: true, force: true, maxRetries: 5, retryDelay: 100 });
        return true;
      } catch {
        return false;
      }
    };
    chromium.once("exit", () => remove() || process.once("exit", remove));
    chromium.kill();
    await Promise.race([ended, new Promise((done) => setTimeout(done, 3000))]);
  };
  return { send, processorTime, evaluate, until, open, close, errors };
}
