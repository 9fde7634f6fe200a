// Parts of a result left out: what lies outside of a box, and what floats apart from the object. Each step is saved, and can be undone.
import { attempt, box, button, call, get, input, make, on, select } from "./dom.js";
import { caption, seedOf } from "./gaussians.js";
import { app, viewed } from "./state.js";

const CHANNELS = 14;
/** Voxels along the longest side of the object, to see what hangs together: several Gaussians in each. */
const GRID = 20;
/** Parts with a smaller share of the Gaussians are floaters. */
const SHARE = 0.02;

/**
 * @typedef {{id: string, sample: number, rows: Float32Array, kept: Uint8Array, spans: number[][], before: Uint8Array[]}} Edit
 * `spans`: along each axis the least position, those with 5 % of all below and above, and the largest.
 * @type {?Edit}
 */
let edit = null;
const fold = get("edit", HTMLDetailsElement);

/** @param {string} path */
const bytes = async (path) => {
  const response = await fetch(path);
  if (!response.ok) throw new Error(`${path}: ${response.status}`);
  return response.arrayBuffer();
};

const ends = () => [0, 1, 2].map((axis) => [Number(input(`from-${axis}`).value) / 100, Number(input(`to-${axis}`).value) / 100]);

/** The box: where it begins and ends along each axis. Each slider says its place. Its ends are those of all; else floaters far away do not count. @param {Edit} of */
const limitsOf = ({ spans }) => ends().map((both, axis) => both.map((share, i) => {
  const [least, low, high, most] = spans[axis], middle = low + (1.6 * share - 0.3) * (high - low);
  const place = share === 0 ? least : share === 1 ? most : Math.min(most, Math.max(least, middle)), text = place.toPrecision(3), name = `${["from", "to"][i]}-${axis}`;
  box(`${name}-at`).textContent = text;
  input(name).setAttribute("aria-valuetext", text);
  return place;
}));

/** Which Gaussians are kept and lie in the box, which is shown. @param {Edit} of */
const inside = (of) => {
  const { rows, kept } = of, limits = limitsOf(of);
  app.crop = [0, 1].map((i) => limits.map((both) => both[i]));
  return kept.map((v, i) => (v && limits.every(([from, to], axis) => rows[i * CHANNELS + axis] >= from && rows[i * CHANNELS + axis] <= to) ? 1 : 0));
};

/** @param {Uint8Array} mask */
const show = (mask) => {
  const pane = edit && app.panes[edit.sample];
  if (!edit || !pane) return;
  const count = mask.reduce((sum, v) => sum + v, 0), chosen = new Float32Array(count * CHANNELS);
  let to = 0;
  mask.forEach((v, i) => {
    if (v && edit) chosen.set(edit.rows.subarray(i * CHANNELS, (i + 1) * CHANNELS), CHANNELS * to++);
  });
  pane.viewer.setGaussians(chosen);
  box("edit-text").textContent = `${count.toLocaleString("en")} of ${mask.length.toLocaleString("en")} Gaussians`;
  button("edit-undo").disabled = edit.before.length === 0;
};

/** The box has all of it again. */
const whole = () => {
  for (const axis of [0, 1, 2]) {
    input(`from-${axis}`).value = "0";
    input(`to-${axis}`).value = "100";
  }
  if (edit) inside(edit);
};

/** @param {number} sample */
const begin = async (sample) => {
  const { job } = app;
  edit = null;
  if (!job || job.state !== "done") return;
  const path = `/jobs/${job.id}/samples/${sample}`;
  const [rows, kept] = await Promise.all([bytes(`${path}/whole`), bytes(`${path}/kept`)]);
  if (app.job?.id !== job.id) return;
  const data = new Float32Array(rows), last = data.length / CHANNELS - 1;
  const spans = [0, 1, 2].map((axis) => {
    const sorted = Float32Array.from({ length: last + 1 }, (_, i) => data[i * CHANNELS + axis]).sort();
    return [0, 0.05, 0.95, 1].map((share) => sorted[Math.floor(share * last)]);
  });
  edit = { id: job.id, sample, rows: data, kept: new Uint8Array(kept), spans, before: [] };
  whole();
  show(edit.kept);
};

/**
 * Saves what is kept; files of all formats follow.
 * @param {Uint8Array} kept
 * @param {boolean} undoes
 */
const save = async (kept, undoes = false) => {
  if (!edit) return;
  const { gaussians } = await call("PUT", `/jobs/${edit.id}/samples/${edit.sample}/kept`, new Blob([new Uint8Array(kept)]));
  if (!undoes) edit.before.push(edit.kept);
  edit.kept = kept;
  whole();
  show(kept);
  const pane = app.panes[edit.sample];
  if (pane) caption(pane, edit.sample, gaussians);
  viewed.dispatchEvent(new Event("viewed"));
};

/** Gaussians of parts that hang together with few others, or none, are left out. @param {Edit} of */
const tidy = ({ rows, kept, spans }) => {
  // What floats far away makes the object no larger.
  const step = Math.max(...spans.map(([, low, high]) => high - low)) / GRID || 1, side = 100_000;
  /** @type {Map<number, number[]>} */
  const cells = new Map();
  kept.forEach((v, i) => {
    if (!v) return;
    const at = [0, 1, 2].reduce((sum, axis) => sum * side + 1 + Math.floor((rows[i * CHANNELS + axis] - spans[axis][0]) / step), 0), cell = cells.get(at);
    if (cell) cell.push(i);
    else cells.set(at, [i]);
  });
  const steps = [-1, 0, 1].flatMap((x) => [-1, 0, 1].flatMap((y) => [-1, 0, 1].map((z) => (x * side + y) * side + z)));
  /** @type {number[][]} */
  const parts = [], seen = new Set();
  for (const start of cells.keys()) {
    if (seen.has(start)) continue;
    seen.add(start);
    const open = [start];
    /** @type {number[]} */
    const part = [];
    for (let at = open.pop(); at !== undefined; at = open.pop()) {
      part.push(...cells.get(at) ?? []);
      for (const next of steps.map((d) => d + /** @type {number} */ (at))) {
        if (!cells.has(next) || seen.has(next)) continue;
        seen.add(next);
        open.push(next);
      }
    }
    parts.push(part);
  }
  const count = parts.reduce((sum, part) => sum + part.length, 0), most = Math.max(...parts.map((part) => part.length)), result = kept.slice();
  for (const part of parts) {
    if (part.length < most && part.length < SHARE * count) part.forEach((i) => { result[i] = 0; });
  }
  return result;
};

/** Offers to edit the job's samples. */
export const offerEdit = () => {
  const { job } = app;
  edit = app.crop = null;
  fold.open = false;
  fold.hidden = job?.state !== "done";
  select("edit-sample").replaceChildren(...(job ? job.samples.map((_, i) => make("option", { value: String(i) }, seedOf(job, i, ""))) : []));
  box("edit-which").hidden = select("edit-sample").options.length < 2;
};
const start = () => void attempt(() => begin(Number(select("edit-sample").value)));
fold.addEventListener("toggle", () => {
  app.crop = null;
  if (fold.open) start();
  else if (edit) show(edit.kept);
});
select("edit-sample").addEventListener("change", start);
for (const axis of [0, 1, 2]) {
  for (const [end, value] of [["from", "0"], ["to", "100"]]) {
    const id = `${end}-${axis}`, slider = make("input", { id, type: "range", value });
    slider.addEventListener("input", () => { if (edit) show(inside(edit)); });
    box("crop").append(make("label", {}, make("span", {}, `${"xyz"[axis]} ${end} `, make("b", { id: `${id}-at` })), slider));
  }
}
on("edit-crop", async () => { if (edit) await save(inside(edit)); });
on("edit-tidy", async () => { if (edit) await save(tidy(edit)); });
on("edit-all", async () => { if (edit) await save(edit.kept.map(() => 1)); });
on("edit-undo", async () => {
  const last = edit?.before.pop();
  if (last) await save(last, true);
});
