// One job: how far it is, its photos, its results.
/**
 * @typedef {import("./state.js").Job} Job
 * @typedef {import("./state.js").Understood} Understood
 */
import { openBrush } from "./brush.js";
import { attempt, box, button, get, make } from "./dom.js";
import { offerEdit } from "./edit.js";
import { caption, results, seedOf } from "./gaussians.js";
import { look, showPanes } from "./panes.js";
import { app } from "./state.js";

/** What is done after a mask was edited. */
export const hooks = { edited: async () => {} };

/** The steps of the pipeline, in order. @type {Record<string, string>} */
const STEPS = { canonicalize: "placing the object", symmetry: "looking for symmetry", propose: "making proposals", refine: "refining with the network", optimize: "optimizing on the photos" };
/** What each format is good for. @type {Record<string, string>} */
const USES = {
  ply: "Nearly every viewer and editor of Gaussians", splat: "Viewers on the web", spz: "Small; most viewers", sog: "Small; PlayCanvas, SuperSplat, Spark",
  glb: "three.js, Babylon.js, PlayCanvas, Cesium; Gaussians, not a mesh", usda: "OpenUSD, Omniverse; text", usdz: "OpenUSD, Omniverse", html: "A viewer with the object in it, for any browser",
};

/** Steps of the search for cameras. @type {Record<string, string>} */
const SEARCH = { features: "features of the photos", matches: "matches between photos", model: "poses", checks: "checks of the poses" };

/** @param {Job} s */
const sentence = (s) => {
  const { samples, quality } = s.options, spent = s.seconds.reduce((sum, [, v]) => sum + v, 0), step = s.stage;
  switch (s.state) {
    case "reading": return s.stage ? `Finding the cameras, step ${s.done + 1} of ${s.total}: ${SEARCH[s.stage] ?? s.stage}. This takes minutes.` : "Reading the files…";
    case "ready": return "Ready. Look at the cameras and the masks, then press Go.";
    case "queued": return s.position ? `Waiting: ${s.position} before this one.` : "Waiting.";
    case "running": return step ? `${(samples ?? 1) > 1 ? `Sample ${s.sample + 1} of ${samples}, step` : "Step"} ${Object.keys(STEPS).indexOf(step) + 1} of 5: ${STEPS[step] ?? step}, ${s.done} of ${s.total}${left(s)}` : "Starting.";
    case "done": return spent ? `Done in ${spent.toFixed(1)} s${quality ? `, quality ${quality}` : ""}.` : "Done.";
    case "cancelled": return s.samples.length ? "Cancelled; the earlier result is kept." : "Cancelled.";
    case "failed": return `Failed: ${s.error ?? ""}`;
    default: return s.error ?? s.state;
  }
};

/** When the stage began that is computed now, and at which of its steps. */
const since = { stage: "", time: 0, done: 0 };

/** How long this step will take still, going by how long it took so far. @param {Job} s */
const left = (s) => {
  const stage = `${s.id} ${s.stage} ${s.sample}`, now = performance.now();
  if (stage !== since.stage || s.done < since.done) Object.assign(since, { stage, time: now, done: s.done });
  const steps = s.done - since.done, seconds = (now - since.time) / 1000;
  if (steps < 1 || seconds < 1 || s.done >= s.total) return "";
  const more = seconds / steps * (s.total - s.done);
  return `, about ${more > 90 ? `${Math.round(more / 60)} min` : `${Math.max(1, Math.round(more))} s`} left in this step`;
};

let said = "";
/** @param {Job} s */
export const showStatus = (s) => {
  const text = sentence(s);
  // A screen reader hears of stages, not of every step.
  const key = s.state + (s.stage ?? "") + (s.error ?? "");
  box("status").setAttribute("aria-live", key === said ? "off" : "polite");
  said = key;
  box("status").textContent = text;
  const bar = get("progress", HTMLProgressElement);
  bar.hidden = s.state !== "running" && !(s.state === "reading" && s.stage);
  bar.value = s.total ? s.done / s.total : 0;
  button("cancel").hidden = !["reading", "queued", "running"].includes(s.state);
  button("remove").hidden = button("rename").hidden = ["reading", "running"].includes(s.state);
  document.body.dataset.state = s.state;
};

let filled = "";
/** The form has what the job was computed with. @param {Job} now */
const fill = ({ id, options }) => {
  const key = JSON.stringify([id, options]), values = { samples: 1, seed: 0, quality: "", init: "", iterations: "" };
  if (key === filled) return;
  filled = key;
  for (const [name, otherwise] of Object.entries(values)) Object.assign(box(name), { value: options[/** @type {keyof typeof values} */ (name)] ?? otherwise });
};

export const showJob = () => {
  const now = app.job;
  box("job").hidden = !now;
  if (!now) return;
  const understood = now.understood;
  box("job-title").textContent = now.title;
  showStatus(now);
  fill(now);
  get("go-form", HTMLFormElement).hidden = !now.may_go;
  button("go").textContent = now.state === "ready" ? "Go" : "Go again";
  box("understood").hidden = box("tools").hidden = box("help").hidden = !understood;
  const busy = ["queued", "running"].includes(now.state);
  if (understood) {
    showPanes(Math.max(1, busy ? now.options.samples ?? 1 : now.samples.length), understood);
    app.panes.forEach((pane, i) => { if (!pane.caption.textContent && pane.viewer.count) caption(pane, i, pane.viewer.count); });
    photos(now, understood);
    box("warnings").replaceChildren(...understood.warnings.map((text) => make("li", {}, text)));
    const passed = now.passed_over.length ? [`of no use here: ${now.passed_over.join(", ")}`] : [];
    const took = now.seconds.map(([stage, s]) => `${stage} ${s.toFixed(1)} s`).join(", ");
    const what = understood.views.length ? `cameras: ${understood.format}, masks: ${understood.masks}` : `Gaussians of a file ${understood.format}`;
    const notes = [what, ...understood.notes, ...passed, ...now.notes, ...(took ? [`it took ${took}`] : [])];
    box("notes").replaceChildren(...notes.map((text) => make("li", {}, text)));
    const sheet = get("sheet", HTMLAnchorElement);
    sheet.href = `/jobs/${now.id}/sheet.png`;
    sheet.hidden = box("photos-title").hidden = button("show-cameras").hidden = !understood.views.length;
  } else {
    showPanes(0, { center: [0, 0, 0], radius: 1, up: [0, 0, 1], views: [], notes: [], warnings: [], format: "", masks: "" });
  }
  box("result").hidden = box("film-tools").hidden = busy || now.samples.length === 0;
  box("downloads").replaceChildren(...now.samples.map((_, i) => make("li", {}, seedOf(now, i, ": ").replace("s", "S"),
    ...now.formats.map((format) => make("a", { href: `/jobs/${now.id}/samples/${i}.${format}`, download: "", title: USES[format] ?? "", "aria-label": `${seedOf(now, i, "") || "Gaussians"} as .${format}` }, `.${format}`)))));
  if (!busy && now.samples.length) void results(now);
  offerEdit();
};

/**
 * @param {Job} now
 * @param {Understood} understood
 */
const photos = (now, understood) => {
  const key = JSON.stringify([now.id, now.may_go, understood.views.map((v) => [v.covers, v.edited])]), list = box("photos");
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  list.replaceChildren(...understood.views.map((photo, k) => {
    const about = `mask ${(100 * photo.covers).toFixed(0)} %, agrees ${(100 * photo.agreement).toFixed(0)} %${photo.cut_off ? ", cut off" : ""}${photo.edited ? ", edited" : ""}${photo.shown ? "" : ", only for the optimization"}`;
    const see = make("button", { class: "look", "aria-pressed": String(app.looking === k), "aria-label": `Photo ${k + 1}, ${photo.name}: look through its camera` },
      make("img", { class: "whole", alt: "", src: `/jobs/${now.id}/photos/${k}.png`, loading: "lazy" }),
      make("img", { class: "cut", alt: "", src: `/jobs/${now.id}/views/${k}.png?v=${photo.covers}`, loading: "lazy" }));
    see.addEventListener("click", () => {
      look(app.looking === k ? null : k);
      if (app.looking !== null) box("views").scrollIntoView({ block: "nearest" });
    });
    const edit = make("button", { "aria-label": `Edit the mask of photo ${k + 1}` }, "Edit mask");
    edit.hidden = !now.may_go;
    edit.addEventListener("click", () => void attempt(() => openBrush(k, () => hooks.edited())));
    return make("li", {}, see, make("span", { class: "small" }, `${k + 1} ${photo.name}: ${about}`), edit);
  }));
};
