// Pictures and films of the result: a screenshot, a turntable, the whole screen, turning by itself.
import { box, button, complain, on, save, toolbar } from "./dom.js";
import { gif } from "./gif.js";
import { app } from "./state.js";

/** Seconds of a whole turn, by itself and as a film. */
const TURN = 12, FILM = 6;
/** Frames of a GIF, and the longer side of it in pixels. */
const FRAMES = 48, SIDE = 360;
const KINDS = ["video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm"];

const title = () => (app.job?.title ?? "").replace(/[^\w-]+/g, "-").replace(/^-+|-+$/g, "") || "gaussians";

/** @type {number | undefined} */
let turning;
/** @param {boolean} on */
const turn = (on) => {
  if (turning !== undefined) cancelAnimationFrame(turning);
  turning = undefined;
  button("auto").setAttribute("aria-pressed", String(on));
  let last = performance.now();
  const step = () => {
    const now = performance.now(), viewer = app.panes[0]?.viewer;
    if (!viewer) return turn(false);
    viewer.turn(2 * Math.PI * (now - last) / 1000 / TURN, 0);
    last = now;
    turning = requestAnimationFrame(step);
  };
  if (on) turning = requestAnimationFrame(step);
};
button("auto").addEventListener("click", () => turn(turning === undefined));

on("full", async () => {
  if (document.fullscreenElement) await document.exitFullscreen();
  else await box("views").requestFullscreen();
});
document.addEventListener("fullscreenchange", () => app.panes.forEach((pane) => pane.viewer.redraw()));

on("shot", async () => {
  for (const [i, { viewer }] of app.panes.entries()) {
    viewer.draw(); // a picture lasts until its task ends
    const blob = await new Promise((/** @type {(b: ?Blob) => void} */ done) => viewer.canvas.toBlob(done));
    if (blob) save(blob, `${title()}-${i}.png`);
  }
});

/**
 * Has a button say how far its work is.
 * @param {HTMLButtonElement} by
 * @param {(told: (share: number) => void) => Promise<void>} work
 */
const recording = async (by, work) => {
  const before = by.textContent;
  turn(false);
  by.disabled = true;
  try {
    await work((share) => { by.textContent = `Recording: ${Math.round(100 * share)} %`; });
  } finally {
    Object.assign(by, { disabled: false, textContent: before });
    by.focus();
  }
};

/** One turn of the first view, as the browser records it. */
const film = async () => {
  const viewer = app.panes[0]?.viewer, mimeType = KINDS.find((kind) => MediaRecorder.isTypeSupported(kind));
  if (!viewer || !mimeType) throw new Error("this browser records no WebM");
  await recording(button("film"), async (told) => {
    const recorder = new MediaRecorder(viewer.canvas.captureStream(30), { mimeType, videoBitsPerSecond: 8e6 });
    /** @type {Blob[]} */
    const parts = [];
    recorder.addEventListener("dataavailable", (e) => parts.push(e.data));
    const ended = new Promise((done) => recorder.addEventListener("stop", done));
    recorder.start();
    const begin = performance.now();
    let at = 0;
    while (at < 1) {
      await new Promise(requestAnimationFrame);
      const now = Math.min(1, (performance.now() - begin) / 1000 / FILM);
      viewer.turn(2 * Math.PI * (now - at), 0);
      at = now;
      told(at);
    }
    recorder.stop();
    await ended;
    save(new Blob(parts, { type: "video/webm" }), `${title()}.webm`);
    document.body.dataset.film = String(parts.reduce((sum, part) => sum + part.size, 0));
  });
};
button("film").hidden = !("MediaRecorder" in window) || !("captureStream" in HTMLCanvasElement.prototype);
on("film", film);

/** The same as a GIF: smaller, of 256 colors, and every frame whole. */
const animation = async () => {
  const viewer = app.panes[0]?.viewer;
  if (!viewer) return;
  const [w, h] = viewer.size(), scale = Math.min(1, SIDE / Math.max(w, h)), width = Math.max(1, Math.round(scale * w)), height = Math.max(1, Math.round(scale * h));
  const context = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  if (!context) throw new Error("this browser draws no images");
  await recording(button("gif"), async (told) => {
    /** @type {Uint8ClampedArray[]} */
    const frames = [];
    for (let i = 0; i < FRAMES; i++) {
      viewer.turn(2 * Math.PI / FRAMES, 0);
      viewer.draw(); // a picture lasts until its task ends
      context.drawImage(viewer.canvas, 0, 0, width, height);
      frames.push(context.getImageData(0, 0, width, height).data);
      told((i + 1) / FRAMES);
      await new Promise(requestAnimationFrame);
    }
    save(gif(frames, width, height, Math.round(100 * FILM / FRAMES)), `${title()}.gif`);
  });
};
on("gif", animation);

on("link", async () => {
  // Pages without encryption have no clipboard.
  const copied = await navigator.clipboard?.writeText(location.href).then(() => true, () => false);
  complain(`The address of this object${copied ? " is copied" : `: ${location.href}`}. Whoever opens it needs the token of this server.`);
});
toolbar(box("film-tools"));
