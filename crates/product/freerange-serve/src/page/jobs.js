// All jobs: which one is shown, hearing of it, starting and cancelling it.
/** @typedef {import("./state.js").Status} Status */
import { attempt, box, call, get, input, make, on, select } from "./dom.js";
import { estimates } from "./gaussians.js";
import { hooks, showJob, showStatus } from "./job.js";
import { look, showCameras, showPanes } from "./panes.js";
import { app } from "./state.js";

/** Time between two tries for a stream of events, where all of the server's are taken. */
const AGAIN = 3000;
/** @type {?EventSource} */
let source = null;

/** @param {string} id */
export const reload = async (id) => {
  const found = await call("GET", `/jobs/${id}`);
  if (location.hash !== `#job=${id}`) return;
  const wasHere = app.job?.id === id;
  app.job = found;
  if (!wasHere) {
    showPanes(0, found.understood);
    look(null);
    // Until there is something else to see.
    showCameras(!found.samples.length && !found.estimate);
  }
  showJob();
  void estimates();
  await listJobs();
};

hooks.edited = async () => {
  if (app.job) await reload(app.job.id);
  if (app.looking !== null) look(app.looking);
};

/** @param {string} id */
const listen = (id) => {
  const stream = new EventSource(`/jobs/${id}/events`);
  source = stream;
  stream.addEventListener("job", (e) => {
    /** @type {Status} */
    const status = JSON.parse(e.data);
    if (!app.job || app.job.id !== id || source !== stream) return;
    const changed = status.state !== app.job.state;
    if (changed && status.state === "queued") app.drawn = 0;
    Object.assign(app.job, status);
    showStatus(app.job);
    void estimates();
    if (changed) void attempt(() => reload(id));
  });
  stream.addEventListener("gone", () => stream.close());
  // A stream that ends is opened again by the browser; one that is refused is not.
  stream.addEventListener("error", () => {
    if (stream.readyState !== EventSource.CLOSED || source !== stream) return;
    setTimeout(() => {
      if (source !== stream) return;
      void attempt(() => reload(id));
      listen(id);
    }, AGAIN);
  });
};

/** Hears no more of a job. */
export const leave = () => {
  source?.close();
  source = null;
};

/** Shows the job that the address names, and hears of it from now on. */
export const open = async () => {
  const id = /^#job=([0-9a-f]{16})$/.exec(location.hash)?.[1];
  leave();
  app.drawn = 0;
  if (!id) {
    app.job = null;
    showJob();
    return listJobs();
  }
  try {
    await reload(id);
  } catch (error) {
    app.job = null;
    showJob();
    await listJobs();
    throw error;
  }
  listen(id);
};
window.addEventListener("hashchange", () => void attempt(open));
// A browser has six connections for a server: tabs that nobody sees leave them to others.
document.addEventListener("visibilitychange", () => document.hidden ? leave() : void attempt(open));

const listJobs = async () => {
  /** @type {Status[]} */
  const all = await call("GET", "/jobs");
  box("no-jobs").hidden = all.length > 0;
  box("jobs").replaceChildren(...all.map((s) => {
    const picture = s.thumbnail ? [make("img", { alt: "", loading: "lazy", width: "64", height: "64", src: `/jobs/${s.id}/thumbnail.png?v=${s.state}` })] : [];
    const link = make("a", { href: `#job=${s.id}`, title: s.error ?? "", ...(s.id === app.job?.id ? { "aria-current": "true" } : {}) }, ...picture,
      make("span", {}, make("b", {}, s.title || s.id), make("span", { class: "small" }, `${s.state}, ${new Date(1000 * s.created).toLocaleString()}`)));
    return make("li", {}, link);
  }));
};

get("go-form", HTMLFormElement).addEventListener("submit", (e) => {
  e.preventDefault();
  void attempt(async () => {
    if (!app.job) return;
    const steps = input("iterations").value;
    const options = { ...app.job.options, samples: Number(input("samples").value), seed: Number(input("seed").value), quality: select("quality").value || null, init: select("init").value || null, iterations: steps === "" ? null : Number(steps) };
    app.drawn = 0;
    document.body.dataset.estimates = "0";
    delete document.body.dataset.result;
    await call("POST", `/jobs/${app.job.id}/go`, JSON.stringify(options));
  });
});
on("cancel", async () => {
  if (!app.job) return;
  await call("POST", `/jobs/${app.job.id}/cancel`);
  // This button is gone now.
  box("job-title").focus();
});
