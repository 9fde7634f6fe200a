// Gaussians as they come: estimates while a job computes, its results, and where samples differ.
/**
 * @typedef {import("./state.js").Pane} Pane
 * @typedef {import("./state.js").Job} Job
 */
import { box, get } from "./dom.js";
import { showCameras } from "./panes.js";
import { app, viewed } from "./state.js";

let fetching = false;
/** @type {ReturnType<typeof setTimeout> | undefined} */
let heatTimer;

/** @param {string} path */
const rows = async (path) => {
  const response = await fetch(path);
  return response.ok ? new Float32Array(await response.arrayBuffer()) : null;
};

/** Draws the latest estimate, and then the one that came meanwhile. */
export const estimates = async () => {
  if (fetching) return;
  fetching = true;
  try {
    while (app.job?.state === "running" && app.job.estimate && app.job.estimate.number > app.drawn) {
      const { id, estimate } = app.job;
      if (!app.drawn && app.looking === null) showCameras(false);
      for (const part of estimate.parts) {
        const gaussians = await rows(`/jobs/${id}/estimates/${estimate.number}/${part.sample}`);
        if (!gaussians || app.job?.id !== id) break;
        const shown = app.panes.slice(part.sample, part.sample + 1);
        shown.forEach((pane) => pane.viewer.setGaussians(gaussians));
        shown.forEach((pane) => caption(pane, part.sample, part.gaussians));
      }
      if (app.job?.id !== id) break;
      app.drawn = estimate.number;
      document.body.dataset.estimates = String(Number(document.body.dataset.estimates ?? 0) + 1);
    }
  } finally {
    fetching = false;
  }
};

/**
 * The seed of a sample, before other words; a file of Gaussians has none.
 * @param {Job} job
 * @param {number} i
 * @param {string} end
 */
export const seedOf = (job, i, end) => {
  const isFile = job.understood?.views.length === 0, done = job.state === "done" ? job.samples[i]?.seed : undefined;
  return isFile ? "" : `seed ${done ?? (job.options.seed ?? 0) + i}${end}`;
};

/**
 * @param {Pane} pane
 * @param {number} i
 * @param {number} count
 */
export const caption = (pane, i, count) => {
  pane.caption.textContent = `${app.job ? seedOf(app.job, i, ", ") : ""}${count.toLocaleString("en")} Gaussians`;
  pane.viewer.canvas.setAttribute("aria-label", `3D view: ${pane.caption.textContent}`);
};

/** @param {Job} of */
export const results = async (of) => {
  for (let i = 0; i < Math.min(of.samples.length, app.panes.length); i++) {
    const gaussians = await rows(`/jobs/${of.id}/samples/${i}`);
    if (!gaussians || app.job?.id !== of.id || app.job.state !== of.state) return;
    app.panes[i].viewer.setGaussians(gaussians);
    caption(app.panes[i], i, of.samples[i].gaussians);
  }
  document.body.dataset.result = of.id;
  soonHeat();
};

const soonHeat = () => {
  clearTimeout(heatTimer);
  heatTimer = setTimeout(heat, 250);
};

/** What was seen is alike in all samples; what was made up differs: the deviation of their colors, pixel by pixel. */
const heat = () => {
  const n = app.panes.length, shown = app.job?.state === "done" && n > 1;
  box("spread").hidden = !shown;
  if (!shown) return;
  const canvas = get("heat", HTMLCanvasElement), context = canvas.getContext("2d", { willReadFrequently: true });
  const from = app.panes[0].viewer.canvas, width = 320, height = Math.max(1, Math.round(width * from.height / Math.max(1, from.width)));
  if (!context) return;
  Object.assign(canvas, { width, height });
  const pictures = app.panes.map((pane) => {
    pane.viewer.draw(); // a picture lasts until its task ends
    context.drawImage(pane.viewer.canvas, 0, 0, width, height);
    return context.getImageData(0, 0, width, height).data;
  });
  const result = context.createImageData(width, height), stops = [[0, 0, 4], [87, 16, 110], [188, 55, 84], [249, 142, 9], [252, 255, 164]];
  let sum = 0, most = 0;
  for (let i = 0; i < result.data.length; i += 4) {
    let variance = 0;
    for (let c = 0; c < 3; c++) {
      const mean = pictures.reduce((total, p) => total + p[i + c], 0) / n;
      variance += pictures.reduce((total, p) => total + (p[i + c] - mean) ** 2, 0) / n / 3;
    }
    const deviation = Math.sqrt(variance) / 255, t = Math.min(3.999, 16 * deviation), k = Math.floor(t);
    sum += deviation;
    most = Math.max(most, deviation);
    for (let c = 0; c < 3; c++) result.data[i + c] = stops[k][c] + (t - k) * (stops[k + 1][c] - stops[k][c]);
    result.data[i + 3] = 255;
  }
  context.putImageData(result, 0, 0);
  const percent = (/** @type {number} */ v) => `${(100 * v).toFixed(1)} %`;
  box("spread-text").textContent = `Standard deviation of the colors of ${n} samples from this side: ${percent(sum / (width * height))} on average, `
    + `${percent(most)} at most. Black: all samples agree, yellow: 25 % or more.`;
  canvas.dataset.mean = String(sum / (width * height));
};

viewed.addEventListener("viewed", soonHeat);
