// The brush that corrects a mask.
import { attempt, box, button, call, get, input } from "./dom.js";
import { app } from "./state.js";

/**
 * @typedef {{k: number, whole: ImageBitmap, mask: Uint8ClampedArray, width: number, height: number, undo: Uint8ClampedArray[], at: number[]}} Brush
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
 * @param {number} k
 * @param {() => Promise<void>} then what is done after the mask has changed
 */
export const openBrush = async (k, then) => {
  if (!app.job) return;
  after = then;
  const [whole, view] = await Promise.all([bitmap(`/jobs/${app.job.id}/photos/${k}.png`), bitmap(`/jobs/${app.job.id}/views/${k}.png`)]);
  const { width, height } = whole, context = new OffscreenCanvas(width, height).getContext("2d");
  if (!context) return;
  context.drawImage(view, 0, 0);
  const mask = context.getImageData(0, 0, width, height).data.filter((_, i) => i % 4 === 3);
  brush = { k, whole, mask, width, height, undo: [], at: [width / 2, height / 2] };
  Object.assign(paint, { width, height });
  box("brush-title").textContent = `Edit the mask of photo ${k + 1}`;
  dialog.showModal();
  paint.focus();
  showMask();
};

const showMask = () => {
  const context = paint.getContext("2d");
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
  context.strokeStyle = adding ? "#00d060" : "#ff5030";
  context.lineWidth = Math.max(1, brush.width / 300);
  context.beginPath();
  context.arc(brush.at[0], brush.at[1], size(), 0, 2 * Math.PI);
  context.stroke();
};

const size = () => Number(input("paint-size").value) * (brush?.width ?? 512) / 1000;

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
  brush.undo.push(brush.mask.slice());
  if (brush.undo.length > 10) brush.undo.shift();
};
/** @param {PointerEvent} e */
const place = (e) => {
  if (!brush) return;
  // The canvas may be letterboxed in its box.
  const area = paint.getBoundingClientRect(), scale = Math.min(area.width / brush.width, area.height / brush.height);
  brush.at = [(e.clientX - area.left - (area.width - scale * brush.width) / 2) / scale, (e.clientY - area.top - (area.height - scale * brush.height) / 2) / scale];
};
paint.addEventListener("pointerdown", (e) => {
  paint.setPointerCapture(e.pointerId);
  remember();
  place(e);
  dab();
  showMask();
});
paint.addEventListener("pointermove", (e) => {
  const before = brush?.at;
  place(e);
  if (brush && before && e.buttons & 1) {
    const to = brush.at, steps = Math.max(1, Math.ceil(Math.hypot(to[0] - before[0], to[1] - before[1]) / Math.max(1, size() / 2)));
    for (let i = 1; i <= steps; i++) {
      brush.at = before.map((v, c) => v + (to[c] - v) * i / steps);
      dab();
    }
  }
  showMask();
});
paint.addEventListener("keydown", (e) => {
  const step = Math.max(1, size() / 2), moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
  const move = moves[/** @type {keyof typeof moves} */ (e.key)];
  if (!brush || !(move || e.key === " ")) return;
  e.preventDefault();
  if (move) brush.at = brush.at.map((v, c) => Math.max(0, Math.min([brush?.width ?? 0, brush?.height ?? 0][c], v + move[c])));
  else {
    remember();
    dab();
  }
  showMask();
});
for (const [id, value] of /** @type {[string, boolean][]} */ ([["paint-add", true], ["paint-erase", false]])) {
  button(id).addEventListener("click", () => {
    adding = value;
    button("paint-add").setAttribute("aria-pressed", String(adding));
    button("paint-erase").setAttribute("aria-pressed", String(!adding));
    showMask();
  });
}
input("paint-size").addEventListener("input", showMask);
button("paint-undo").addEventListener("click", () => {
  const last = brush?.undo.pop();
  if (brush && last) brush.mask = last;
  showMask();
});
button("paint-close").addEventListener("click", () => dialog.close());
button("paint-save").addEventListener("click", () => void attempt(async () => {
  if (!brush || !app.job) return;
  const { k, mask, width, height } = brush, canvas = new OffscreenCanvas(width, height), context = canvas.getContext("2d");
  if (!context) return;
  const picture = context.createImageData(width, height);
  mask.forEach((v, i) => picture.data.set([v, v, v, 255], 4 * i));
  context.putImageData(picture, 0, 0);
  dialog.close();
  await call("PUT", `/jobs/${app.job.id}/masks/${k}`, await canvas.convertToBlob({ type: "image/png" }));
  await after();
}));
