// The brush that corrects a mask.
import { box, button, call, get, input, on } from "./dom.js";
import { app } from "./state.js";
import { Zoom } from "./zoom.js";

/** Angle between cameras up to which views are similar, in degrees. */
const SIMILAR = 20;
/** Steps that can be undone. */
const UNDO = 10;

/**
 * `like`: photos that are similar; `copy`: what is painted goes to them, too; `first`: the mask as it was.
 * @typedef {{mask: Uint8ClampedArray, copy: boolean}} Step
 * @typedef {{k: number, whole: ImageBitmap, first: Uint8ClampedArray, width: number, height: number, undo: Step[], at: number[], zoom: Zoom, shown: OffscreenCanvas, like: number[]} & Step} Brush
 * @type {?Brush}
 */
let brush = null;
let adding = true;
/** @type {() => Promise<void>} */
let after = async () => {};
const paint = get("paint", HTMLCanvasElement), dialog = get("brush", HTMLDialogElement);

/** @param {string} path */
const bitmap = async (path) => createImageBitmap(await (await fetch(path)).blob(), { premultiplyAlpha: "none" });

/**
 * The mask of a photo as the server has it.
 * @param {string} job
 * @param {number} k
 */
const maskOf = async (job, k) => {
  const view = await bitmap(`/jobs/${job}/views/${k}.png`), { width, height } = view;
  const context = new OffscreenCanvas(width, height).getContext("2d");
  if (!context) throw new Error("this browser draws no images");
  context.drawImage(view, 0, 0);
  return context.getImageData(0, 0, width, height).data.filter((_, i) => i % 4 === 3);
};

/** Photos of the same size whose cameras are turned by a few degrees only. @param {number} k */
const similar = (k) => {
  const views = app.job?.understood?.views ?? [], { camera } = views[k];
  return views.flatMap(({ camera: other }, j) => {
    const [m, n] = [camera.world_to_camera, other.world_to_camera];
    // The trace of one rotation and the other's inverse is that of all products.
    const trace = [0, 1, 2, 4, 5, 6, 8, 9, 10].reduce((sum, i) => sum + m[i] * n[i], 0), angle = 180 / Math.PI * Math.acos(Math.max(-1, Math.min(1, (trace - 1) / 2)));
    return j !== k && other.width === camera.width && other.height === camera.height && angle <= SIMILAR ? [j] : [];
  });
};

/**
 * @param {number} k
 * @param {() => Promise<void>} then what is done after the mask has changed
 */
export const openBrush = async (k, then) => {
  if (!app.job) return;
  after = then;
  const [whole, first] = await Promise.all([bitmap(`/jobs/${app.job.id}/photos/${k}.png`), maskOf(app.job.id, k)]), { width, height } = whole;
  brush = { k, whole, first, mask: first.slice(), copy: false, width, height, undo: [], at: [width / 2, height / 2], zoom: new Zoom([width, height]), shown: new OffscreenCanvas(width, height), like: similar(k) };
  Object.assign(paint, { width, height });
  box("brush-title").textContent = `Edit the mask of photo ${k + 1}`;
  dialog.showModal();
  paint.focus();
  compose();
};

/** Draws the photo under its mask again. */
const compose = () => {
  const context = brush?.shown.getContext("2d", { willReadFrequently: true });
  if (!brush || !context) return;
  context.clearRect(0, 0, brush.width, brush.height);
  context.drawImage(brush.whole, 0, 0);
  const picture = context.getImageData(0, 0, brush.width, brush.height), p = picture.data;
  for (let i = 0; i < brush.mask.length; i++) {
    const a = brush.mask[i] / 255, seen = p[4 * i + 3] / 255;
    // Over white; outside of the mask darker, and bluish so that dark photos show it too.
    for (let c = 0; c < 3; c++) {
      const v = p[4 * i + c] * seen + 255 * (1 - seen);
      p[4 * i + c] = a * v + (1 - a) * (0.35 * v + [10, 20, 60][c]);
    }
    p[4 * i + 3] = 255;
  }
  context.putImageData(picture, 0, 0);
  showMask();
};

/** Shows what of it is in sight, and the brush. */
const showMask = () => {
  const context = paint.getContext("2d");
  if (!brush || !context) return;
  const { zoom, at, like, copy } = brush, n = like.length;
  zoom.draw(context, brush.shown);
  context.strokeStyle = adding ? "#00d060" : "#ff5030";
  context.lineWidth = Math.max(1, brush.width / 300);
  context.setLineDash(adding ? [] : [4, 4].map((v) => v * context.lineWidth));
  context.beginPath();
  context.arc(...zoom.outside(at), size() * zoom.scale, 0, 2 * Math.PI);
  context.stroke();
  button("paint-copy").disabled = !n;
  button("paint-copy").setAttribute("aria-pressed", String(copy));
  const text = `${zoom.scale > 1 ? `Zoom ${zoom.scale.toFixed(1)}. ` : ""}${!n ? "No other photo is similar: of the same size, with a camera turned by 20 degrees at most."
    : `What you paint is ${copy ? "" : "not "}copied to ${n === 1 ? "photo" : "photos"} ${like.map((k) => k + 1).join(", ")}.`}`;
  // Told once, and not with every move of the brush.
  if (box("paint-text").textContent !== text) box("paint-text").textContent = text;
  button("paint-undo").disabled = !brush.undo.length;
};

/** Radius of the brush in pixels of the photo: on the screen it stays the same. */
const size = () => Number(input("paint-size").value) * (brush?.width ?? 512) / 1000 / (brush?.zoom.scale ?? 1);

const dab = () => {
  if (!brush) return;
  const [x, y] = brush.at, r = size(), value = adding ? 255 : 0;
  for (let j = Math.max(0, Math.floor(y - r)); j < Math.min(brush.height, y + r); j++) {
    for (let i = Math.max(0, Math.floor(x - r)); i < Math.min(brush.width, x + r); i++) {
      if ((i + 0.5 - x) ** 2 + (j + 0.5 - y) ** 2 <= r * r) brush.mask[j * brush.width + i] = value;
    }
  }
};
const remember = () => {
  if (!brush) return;
  brush.undo.push({ mask: brush.mask.slice(), copy: brush.copy });
  if (brush.undo.length > UNDO) brush.undo.shift();
};
/** Where the pointer is in the photo. @param {MouseEvent} e */
const place = (e) => {
  if (!brush) return [0, 0];
  // The canvas may be letterboxed in its box.
  const area = paint.getBoundingClientRect(), scale = Math.min(area.width / brush.width, area.height / brush.height);
  return brush.zoom.inside([(e.clientX - area.left - (area.width - scale * brush.width) / 2) / scale, (e.clientY - area.top - (area.height - scale * brush.height) / 2) / scale]);
};
/** @param {number} factor */
const zoomBy = (factor, at = brush?.at) => {
  if (!brush || !at) return;
  brush.zoom.by(factor, at);
  showMask();
};
/** Pointers that are down, and where they were last on the screen. @type {Map<number, number[]>} */
const down = new Map();
const painting = () => down.size === 1 && !panning;
let panning = false;
paint.addEventListener("pointerdown", (e) => {
  if (!brush) return;
  paint.setPointerCapture(e.pointerId);
  // A second finger zooms and moves: what the first one painted is taken back.
  if (painting()) undo();
  down.set(e.pointerId, [e.clientX, e.clientY]);
  panning = down.size > 1 || e.button === 1 || e.shiftKey;
  brush.at = place(e);
  if (!painting()) return e.preventDefault();
  remember();
  dab();
  compose();
});
paint.addEventListener("pointermove", (e) => {
  if (!brush) return;
  const last = down.get(e.pointerId), before = brush.at, to = place(e);
  if (last && panning) {
    const other = [...down].find(([id]) => id !== e.pointerId)?.[1], here = [e.clientX, e.clientY];
    const from = place(new MouseEvent("", { clientX: last[0], clientY: last[1] }));
    down.set(e.pointerId, here);
    // Two fingers move half as far each.
    brush.zoom.pan(to.map((v, i) => (from[i] - v) / down.size));
    if (other) brush.zoom.by(Math.hypot(here[0] - other[0], here[1] - other[1]) / Math.max(1, Math.hypot(last[0] - other[0], last[1] - other[1])), place(e));
    return showMask();
  }
  brush.at = to;
  if (!last) return showMask();
  const steps = Math.max(1, Math.ceil(Math.hypot(to[0] - before[0], to[1] - before[1]) / Math.max(0.5, size() / 2)));
  for (let i = 1; i <= steps; i++) {
    brush.at = before.map((v, c) => v + (to[c] - v) * i / steps);
    dab();
  }
  compose();
});
for (const name of ["pointerup", "pointercancel"]) {
  paint.addEventListener(name, (e) => {
    if (e instanceof PointerEvent) down.delete(e.pointerId);
    // The finger that is left over does not paint.
    if (!down.size) panning = false;
  });
}
paint.addEventListener("wheel", (e) => {
  e.preventDefault();
  zoomBy(Math.exp(-e.deltaY * (e.deltaMode ? 30 : 1) * (e.ctrlKey ? 0.01 : 0.0015)), place(e));
}, { passive: false });
paint.addEventListener("keydown", (e) => {
  const step = Math.max(1, size() / 2), moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
  const move = moves[/** @type {keyof typeof moves} */ (e.key)], zoom = { "+": 1.5, "-": 1 / 1.5, 0: 1e-3 }[e.key];
  if (!brush || !(move || zoom || e.key === " ")) return;
  e.preventDefault();
  if (zoom) return zoomBy(zoom);
  if (move) {
    const far = [brush.width, brush.height];
    brush.at = brush.at.map((v, c) => Math.max(0, Math.min(far[c], v + move[c])));
    brush.zoom.follow(brush.at);
    return showMask();
  }
  remember();
  dab();
  compose();
});
for (const [id, factor] of /** @type {[string, number][]} */ ([["paint-closer", 1.5], ["paint-farther", 1 / 1.5], ["paint-fit", 1e-3]])) {
  button(id).addEventListener("click", () => zoomBy(factor));
}
for (const [id, value] of /** @type {[string, boolean][]} */ ([["paint-add", true], ["paint-erase", false]])) {
  button(id).addEventListener("click", () => {
    adding = value;
    button("paint-add").setAttribute("aria-pressed", String(adding));
    button("paint-erase").setAttribute("aria-pressed", String(!adding));
    showMask();
  });
}
input("paint-size").addEventListener("input", showMask);
const undo = () => {
  const last = brush?.undo.pop();
  if (brush && last) Object.assign(brush, last);
  compose();
};
button("paint-undo").addEventListener("click", undo);
button("paint-copy").addEventListener("click", () => {
  if (!brush) return;
  remember();
  brush.copy = !brush.copy;
  showMask();
});
button("paint-close").addEventListener("click", () => dialog.close());
/**
 * @param {Uint8ClampedArray} mask
 * @param {number} width
 * @param {number} height
 */
const png = (mask, width, height) => {
  const canvas = new OffscreenCanvas(width, height), context = canvas.getContext("2d"), picture = new ImageData(width, height);
  mask.forEach((v, i) => picture.data.set([v, v, v, 255], 4 * i));
  context?.putImageData(picture, 0, 0);
  return canvas.convertToBlob({ type: "image/png" });
};
on("paint-save", async () => {
  if (!brush || !app.job) return;
  const { k, first, mask, width, height, copy, like } = brush, { id } = app.job;
  dialog.close();
  await call("PUT", `/jobs/${id}/masks/${k}`, await png(mask, width, height));
  for (const other of copy ? like : []) {
    const there = await maskOf(id, other);
    // What was painted, and no more of the mask: similar views are not the same.
    mask.forEach((v, i) => { if (v !== first[i]) there[i] = v; });
    await call("PUT", `/jobs/${id}/masks/${other}`, await png(there, width, height));
  }
  await after();
});
