"use strict";
// The page of `freerange serve`. Text of users and of their files only ever becomes text nodes.
/**
 * @typedef {{width: number, height: number, fx: number, fy: number, cx: number, cy: number, world_to_camera: number[]}} Camera
 * @typedef {{name: string, camera: Camera, shown: boolean, covers: number, agreement: number, cut_off: boolean, edited: boolean}} Photo
 * @typedef {{center: number[], radius: number, up: number[], views: Photo[], notes: string[], warnings: string[], format: string, masks: string}} Understood
 * @typedef {{number: number, stage: string, parts: {sample: number, gaussians: number}[]}} Estimate
 * @typedef {{id: string, title: string, created: number, state: string, error: ?string, position: ?number, stage: ?string, sample: number, done: number,
 *   total: number, loss: ?number, estimate: ?Estimate, version: number}} Status
 * @typedef {Status & {understood: ?Understood, options: {samples: ?number, seed: ?number}, passed_over: string[], notes: string[],
 *   seconds: [string, number][], samples: {seed: number, gaussians: number}[], up: number[], may_go: boolean, formats: string[]}} Job
 * @typedef {{path: string, file: File}} Picked
 * @typedef {{viewer: Viewer, figure: HTMLElement, stage: HTMLElement, photo: HTMLImageElement, over: HTMLCanvasElement, caption: HTMLElement}} Pane
 */
{
  const OF_USE = /\.(png|jpe?g|webp|json|bin|txt|xml|csv)$/i;

  /**
   * @template {HTMLElement} T
   * @param {string} id
   * @param {new () => T} kind
   * @returns {T}
   */
  const get = (id, kind) => {
    const found = document.getElementById(id);
    if (!(found instanceof kind)) throw new Error(`the page has no ${id}`);
    return found;
  };
  /** @param {string} id */
  const box = (id) => get(id, HTMLElement);
  /** @param {string} id */
  const button = (id) => get(id, HTMLButtonElement);
  /** @param {string} id */
  const input = (id) => get(id, HTMLInputElement);
  /** @param {string} id */
  const select = (id) => get(id, HTMLSelectElement);

  /**
   * @template {keyof HTMLElementTagNameMap} K
   * @param {K} tag
   * @param {Record<string, string>} attributes
   * @param {...(Node | string)} children
   * @returns {HTMLElementTagNameMap[K]}
   */
  const make = (tag, attributes, ...children) => {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.append(...children);
    return element;
  };

  /** @param {unknown} problem */
  const complain = (problem) => { box("alert").textContent = problem instanceof Error ? problem.message : String(problem ?? ""); };

  /**
   * @param {string} method
   * @param {string} path
   * @param {BodyInit} [body]
   */
  const call = async (method, path, body) => {
    const response = await fetch(path, { method, body, credentials: "same-origin" });
    const answer = await response.json().catch(() => ({}));
    if (!response.ok) throw new Error(answer.error ?? `${method} ${path}: ${response.status}`);
    return answer;
  };

  /**
   * What a button or a key begins; what goes wrong is said.
   * @param {() => Promise<void>} work
   */
  const attempt = async (work) => {
    complain("");
    try {
      await work();
    } catch (error) {
      complain(error);
    }
  };

  // --- What is shown -------------------------------------------------------------------------------------------------

  /** @type {?Job} */
  let job = null;
  /** @type {?EventSource} */
  let source = null;
  /** @type {Pane[]} */
  const panes = [];
  /** @type {?number} */
  let looking = null; // the photo whose camera is looked through
  let drawn = 0; // number of the last estimate that was drawn
  let fetching = false;
  let camerasShown = true;
  /** @type {?boolean} */
  let darkBack = null;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  let heatTimer;

  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const back = () => ((darkBack ?? dark.matches) ? [0.08, 0.08, 0.08] : [1, 1, 1]);
  const repaint = () => {
    for (const pane of panes) {
      pane.viewer.background = back();
      pane.photo.style.backgroundColor = `rgb(${back().map((v) => Math.round(255 * v)).join(" ")})`;
      pane.viewer.redraw();
    }
  };
  dark.addEventListener("change", repaint);

  /**
   * One picture per sample; they turn together.
   * @param {number} count
   * @param {Understood} understood
   */
  const showPanes = (count, understood) => {
    while (panes.length > count) panes.pop()?.figure.remove();
    while (panes.length < count) {
      const canvas = make("canvas", { tabindex: "0", role: "application", "aria-label": `3D view ${panes.length + 1}`, "aria-describedby": "help" });
      const photo = make("img", { class: "over", alt: "", hidden: "" }), over = make("canvas", { class: "over", "aria-hidden": "true" });
      const stage = make("div", { class: "stage" }, canvas, photo, over), caption = make("figcaption", {});
      const figure = make("figure", {}, stage, caption);
      box("views").append(figure);
      const viewer = new Viewer(canvas, { up: understood.up, background: back() });
      viewer.setGaussians(new Float32Array(0));
      viewer.frameSphere(understood.center, understood.radius);
      const pane = { viewer, figure, stage, photo, over, caption };
      viewer.onmove = () => follow(pane);
      viewer.ondraw = () => sketch(pane);
      panes.push(pane);
      if (panes.length > 1) Object.assign(viewer, { orbit: { ...panes[0].viewer.orbit }, camera: panes[0].viewer.camera });
    }
    // They share the time of one picture.
    for (const { viewer } of panes) viewer.budget = BUDGET / panes.length;
    repaint();
    window.viewers = panes.map((p) => p.viewer);
  };

  /** @param {Pane} leader */
  const follow = (leader) => {
    for (const pane of panes) {
      if (pane === leader) continue;
      Object.assign(pane.viewer, { orbit: { ...leader.viewer.orbit }, camera: null });
      pane.viewer.redraw();
    }
    look(null);
    soonHeat();
  };

  /**
   * The cameras around the object, and the object's sphere, as lines over the picture.
   * @param {Pane} pane
   */
  const sketch = (pane) => {
    const { over, viewer } = pane, understood = job?.understood, context = over.getContext("2d");
    if (!context) return;
    const [width, height] = viewer.size();
    if (over.width !== width || over.height !== height) Object.assign(over, { width, height });
    context.clearRect(0, 0, width, height);
    if (!understood || !camerasShown || viewer.camera) return;
    const { right, down, forward, eye } = viewer.pose(), { focal, middle } = viewer.lens([width, height]);
    /** @param {number[]} p */
    const project = (p) => {
      const d = p.map((v, k) => v - eye[k]), along = (/** @type {number[]} */ axis) => axis.reduce((sum, v, k) => sum + v * d[k], 0);
      const z = along(forward);
      return z > viewer.near ? [focal[0] * along(right) / z + middle[0], focal[1] * along(down) / z + middle[1]] : null;
    };
    /** @param {number[][]} points */
    const line = (points) => {
      context.beginPath();
      let pen = false;
      for (const point of points.map(project)) {
        if (point && pen) context.lineTo(point[0], point[1]);
        else if (point) context.moveTo(point[0], point[1]);
        pen = point !== null;
      }
      context.stroke();
    };
    context.lineWidth = Math.max(1, width / 500);
    context.font = `${Math.round(Math.max(11, width / 45))}px system-ui`;
    understood.views.forEach((photo, k) => {
      const m = photo.camera.world_to_camera, c = photo.camera;
      const rows = [0, 1, 2].map((i) => [m[i], m[i + 4], m[i + 8]]), shift = [m[12], m[13], m[14]];
      /** @param {number[]} q */
      const world = (q) => [0, 1, 2].map((i) => rows[0][i] * (q[0] - shift[0]) + rows[1][i] * (q[1] - shift[1]) + rows[2][i] * (q[2] - shift[2]));
      const depth = 0.35 * understood.radius, x = [-c.cx / c.fx * depth, (c.width - c.cx) / c.fx * depth], y = [-c.cy / c.fy * depth, (c.height - c.cy) / c.fy * depth];
      const corners = [[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]].map(([a, b]) => world([a, b, depth])), at = world([0, 0, 0]);
      context.strokeStyle = context.fillStyle = photo.shown ? "#1a9c46" : "#808080";
      line([...corners, corners[0]]);
      corners.forEach((corner) => line([at, corner]));
      const label = project(at);
      if (label) context.fillText(String(k + 1), label[0] + 4, label[1] - 4);
    });
    if (drawn === 0 && job?.samples.length === 0) {
      // Nothing is there yet: where it will be.
      context.strokeStyle = "#d97a00";
      for (const [a, b] of [[0, 1], [0, 2], [1, 2]]) {
        line(Array.from({ length: 65 }, (_, i) => {
          const p = [...understood.center], t = 2 * Math.PI * i / 64;
          p[a] += understood.radius * Math.cos(t);
          p[b] += understood.radius * Math.sin(t);
          return p;
        }));
      }
    }
  };

  /**
   * Looks through the camera of a photo, or leaves it.
   * @param {?number} k
   */
  const look = (k) => {
    const before = looking, photo = k === null ? undefined : job?.understood?.views[k];
    looking = photo ? k : null;
    for (const pane of panes) {
      const ratio = photo ? photo.camera.width / photo.camera.height : 4 / 3;
      pane.stage.style.setProperty("--ratio", String(ratio));
      pane.photo.hidden = !photo;
      if (photo && job) {
        pane.photo.src = `/jobs/${job.id}/views/${k}.png?v=${photo.covers}`;
        pane.viewer.setCamera(photo.camera);
      } else if (pane.viewer.camera) {
        pane.viewer.leaveCamera();
      }
    }
    box("compare").hidden = !photo;
    slide();
    if (before !== looking) document.querySelectorAll("#photos .look").forEach((b, i) => b.setAttribute("aria-pressed", String(i === looking)));
    if (photo) soonHeat();
  };

  const slide = () => {
    const share = input("slider").value;
    for (const pane of panes) pane.photo.style.clipPath = `inset(0 ${100 - Number(share)}% 0 0)`;
    input("slider").setAttribute("aria-valuetext", `${share} % photo`);
  };
  input("slider").addEventListener("input", slide);

  box("tools").addEventListener("click", (e) => {
    const name = e.target instanceof HTMLElement ? e.target.dataset.do : undefined;
    if (name && panes[0]) panes[0].viewer.do(name);
  });
  button("show-cameras").addEventListener("click", () => {
    camerasShown = !camerasShown;
    button("show-cameras").setAttribute("aria-pressed", String(camerasShown));
    panes.forEach((pane) => pane.viewer.redraw());
  });
  button("background").addEventListener("click", () => {
    darkBack = !(darkBack ?? dark.matches);
    repaint();
  });

  // --- Gaussians -------------------------------------------------------------------------------------------------------

  /** @param {string} path */
  const rows = async (path) => {
    const response = await fetch(path, { credentials: "same-origin" });
    return response.ok ? new Float32Array(await response.arrayBuffer()) : null;
  };

  /** Draws the latest estimate, and then the one that came meanwhile. */
  const estimates = async () => {
    if (fetching) return;
    fetching = true;
    try {
      while (job?.state === "running" && job.estimate && job.estimate.number > drawn) {
        const { id, estimate } = job;
        for (const part of estimate.parts) {
          const gaussians = await rows(`/jobs/${id}/estimates/${estimate.number}/${part.sample}`);
          if (!gaussians || job?.id !== id) break;
          const shown = panes.slice(part.sample, part.sample + 1);
          shown.forEach((pane) => pane.viewer.setGaussians(gaussians));
          shown.forEach((pane) => caption(pane, part.sample, part.gaussians));
        }
        if (job?.id !== id) break;
        drawn = estimate.number;
        document.body.dataset.estimates = String(Number(document.body.dataset.estimates ?? 0) + 1);
      }
    } finally {
      fetching = false;
    }
  };

  /**
   * @param {Pane} pane
   * @param {number} i
   * @param {number} count
   */
  const caption = (pane, i, count) => {
    pane.caption.textContent = `seed ${(job?.options.seed ?? 0) + i}, ${count.toLocaleString("en")} Gaussians`;
    pane.viewer.canvas.setAttribute("aria-label", `3D view: ${pane.caption.textContent}`);
  };

  /** @param {Job} of */
  const results = async (of) => {
    for (let i = 0; i < Math.min(of.samples.length, panes.length); i++) {
      const gaussians = await rows(`/jobs/${of.id}/samples/${i}`);
      if (!gaussians || job?.id !== of.id || job.state !== of.state) return;
      panes[i].viewer.setGaussians(gaussians);
      caption(panes[i], i, of.samples[i].gaussians);
      panes[i].caption.textContent = `seed ${of.samples[i].seed}, ${of.samples[i].gaussians.toLocaleString("en")} Gaussians`;
    }
    document.body.dataset.result = of.id;
    soonHeat();
  };

  const soonHeat = () => {
    clearTimeout(heatTimer);
    heatTimer = setTimeout(heat, 250);
  };

  /** What was seen is alike in all samples; what was made up differs: the deviation of their colours, pixel by pixel. */
  const heat = () => {
    const n = panes.length, shown = job?.state === "done" && n > 1;
    box("spread").hidden = !shown;
    if (!shown) return;
    const canvas = get("heat", HTMLCanvasElement), context = canvas.getContext("2d", { willReadFrequently: true });
    const from = panes[0].viewer.canvas, width = 320, height = Math.max(1, Math.round(width * from.height / Math.max(1, from.width)));
    if (!context) return;
    Object.assign(canvas, { width, height });
    const pictures = panes.map((pane) => {
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
    box("spread-text").textContent = `Standard deviation of the colours of ${n} samples from this side: ${percent(sum / (width * height))} on average, `
      + `${percent(most)} at most. Black: all samples agree, yellow: 25 % or more.`;
    canvas.dataset.mean = String(sum / (width * height));
  };

  // --- One job ---------------------------------------------------------------------------------------------------------

  const WORDS = { canonicalize: "finding the object", symmetry: "looking for symmetry", propose: "proposing", refine: "refining with the network", optimize: "optimizing on the photos" };

  /** @param {Status} s */
  const sentence = (s) => {
    switch (s.state) {
      case "reading": return "The photos are read.";
      case "ready": return "Ready. Look at the masks, then press Go.";
      case "queued": return s.position ? `Waiting: ${s.position} before this one.` : "Waiting.";
      case "running": return s.stage ? `${WORDS[/** @type {keyof typeof WORDS} */ (s.stage)] ?? s.stage}: step ${s.done} of ${s.total}` : "Starting.";
      case "done": return "Done.";
      case "cancelled": return "Cancelled.";
      case "failed": return `Failed: ${s.error ?? ""}`;
      default: return s.error ?? s.state;
    }
  };

  let said = "";
  /** @param {Status} s */
  const showStatus = (s) => {
    const text = sentence(s);
    // A screen reader hears of stages, not of every step.
    const key = s.state + (s.stage ?? "") + (s.error ?? "");
    box("status").setAttribute("aria-live", key === said ? "off" : "polite");
    said = key;
    box("status").textContent = text;
    const bar = get("progress", HTMLProgressElement);
    bar.hidden = s.state !== "running";
    bar.value = s.total ? s.done / s.total : 0;
    button("cancel").hidden = !["reading", "queued", "running"].includes(s.state);
    button("remove").hidden = ["reading", "running"].includes(s.state);
    document.body.dataset.state = s.state;
  };

  const showJob = () => {
    const now = job;
    box("job").hidden = !now;
    if (!now) return;
    const understood = now.understood;
    box("job-title").textContent = now.title;
    showStatus(now);
    get("go-form", HTMLFormElement).hidden = !now.may_go;
    button("go").textContent = now.state === "ready" ? "Go" : "Go again";
    box("understood").hidden = box("tools").hidden = box("help").hidden = !understood;
    const busy = ["queued", "running"].includes(now.state);
    if (understood) {
      showPanes(Math.max(1, busy ? now.options.samples ?? 1 : now.samples.length), understood);
      panes.forEach((pane, i) => { if (!pane.caption.textContent && pane.viewer.count) caption(pane, i, pane.viewer.count); });
      photos(now, understood);
      box("warnings").replaceChildren(...understood.warnings.map((text) => make("li", {}, text)));
      const passed = now.passed_over.length ? [`of no use here: ${now.passed_over.join(", ")}`] : [];
      const took = now.seconds.map(([stage, s]) => `${stage} ${s.toFixed(1)} s`).join(", ");
      const notes = [`cameras: ${understood.format}, masks: ${understood.masks}`, ...understood.notes, ...passed, ...now.notes, ...(took ? [`it took ${took}`] : [])];
      box("notes").replaceChildren(...notes.map((text) => make("li", {}, text)));
      get("sheet", HTMLAnchorElement).href = `/jobs/${now.id}/sheet.png`;
    } else {
      showPanes(0, { center: [0, 0, 0], radius: 1, up: [0, 0, 1], views: [], notes: [], warnings: [], format: "", masks: "" });
    }
    box("result").hidden = busy || now.samples.length === 0;
    box("downloads").replaceChildren(...now.samples.map((sample, i) => make("li", {}, `Seed ${sample.seed}: `,
      ...now.formats.map((format) => make("a", { href: `/jobs/${now.id}/samples/${i}.${format}`, download: "", "aria-label": `Seed ${sample.seed} as .${format}` }, `.${format}`)))));
    if (!busy && now.samples.length) void results(now);
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
      const about = `mask ${(100 * photo.covers).toFixed(0)} %, agrees ${(100 * photo.agreement).toFixed(0)} %${photo.cut_off ? ", cut off" : ""}${photo.edited ? ", edited" : ""}${photo.shown ? "" : ", only for refinement"}`;
      const see = make("button", { type: "button", class: "look", "aria-pressed": String(looking === k), "aria-label": `Photo ${k + 1}, ${photo.name}: look through its camera` },
        make("img", { class: "whole", alt: "", src: `/jobs/${now.id}/photos/${k}.png`, loading: "lazy" }),
        make("img", { class: "cut", alt: "", src: `/jobs/${now.id}/views/${k}.png?v=${photo.covers}`, loading: "lazy" }));
      see.addEventListener("click", () => {
        look(looking === k ? null : k);
        if (looking !== null) box("views").scrollIntoView({ block: "nearest" });
      });
      const edit = make("button", { type: "button", "aria-label": `Edit the mask of photo ${k + 1}` }, "Edit mask");
      edit.hidden = !now.may_go;
      edit.addEventListener("click", () => void attempt(() => openBrush(k)));
      return make("li", {}, see, make("span", { class: "small" }, `${k + 1} ${photo.name}: ${about}`), edit);
    }));
  };

  /** @param {string} id */
  const reload = async (id) => {
    const found = await call("GET", `/jobs/${id}`);
    if (location.hash !== `#job=${id}`) return;
    const wasHere = job?.id === id;
    job = found;
    if (!wasHere) {
      showPanes(0, found.understood);
      look(null);
    }
    showJob();
    void estimates();
    await listJobs();
  };

  /** Shows the job that the address names, and hears of it from now on. */
  const open = async () => {
    const id = /^#job=([0-9a-f]{16})$/.exec(location.hash)?.[1];
    source?.close();
    source = null;
    drawn = 0;
    if (!id) {
      job = null;
      showJob();
      return listJobs();
    }
    try {
      await reload(id);
    } catch (error) {
      job = null;
      showJob();
      await listJobs();
      throw error;
    }
    const stream = new EventSource(`/jobs/${id}/events`);
    source = stream;
    stream.addEventListener("job", (e) => {
      /** @type {Status} */
      const status = JSON.parse(e.data);
      if (!job || job.id !== id || source !== stream) return;
      const changed = status.state !== job.state;
      if (changed && status.state === "queued") drawn = 0;
      Object.assign(job, status);
      showStatus(job);
      void estimates();
      if (changed) void attempt(() => reload(id));
    });
    stream.addEventListener("gone", () => stream.close());
  };
  window.addEventListener("hashchange", () => void attempt(open));

  const listJobs = async () => {
    /** @type {Status[]} */
    const all = await call("GET", "/jobs");
    box("no-jobs").hidden = all.length > 0;
    box("jobs").replaceChildren(...all.map((s) => {
      const seen = !["reading", "failed", "interrupted"].includes(s.state) || s.id === job?.id;
      const picture = make("img", { alt: "", loading: "lazy", width: "64", height: "64" });
      if (seen) picture.src = `/jobs/${s.id}/thumbnail.png?v=${s.state}`;
      const link = make("a", { href: `#job=${s.id}`, ...(s.id === job?.id ? { "aria-current": "true" } : {}) }, picture,
        make("span", {}, make("b", {}, s.title || s.id), make("span", { class: "small" }, `${s.state}, ${new Date(1000 * s.created).toLocaleString()}`)));
      return make("li", {}, link);
    }));
  };

  get("go-form", HTMLFormElement).addEventListener("submit", (e) => {
    e.preventDefault();
    void attempt(async () => {
      if (!job) return;
      const quality = select("quality").value, init = select("init").value, iterations = input("iterations").value;
      const options = { samples: Number(input("samples").value), seed: Number(input("seed").value), ...(quality ? { quality } : {}), ...(init ? { init } : {}), ...(iterations === "" ? {} : { iterations: Number(iterations) }) };
      drawn = 0;
      document.body.dataset.estimates = "0";
      delete document.body.dataset.result;
      await call("POST", `/jobs/${job.id}/go`, JSON.stringify(options));
    });
  });
  button("cancel").addEventListener("click", () => void attempt(async () => { if (job) await call("POST", `/jobs/${job.id}/cancel`); }));
  button("remove").addEventListener("click", () => void attempt(async () => {
    if (!job) return;
    source?.close();
    await call("DELETE", `/jobs/${job.id}`);
    location.hash = "";
  }));

  // --- New jobs --------------------------------------------------------------------------------------------------------

  /** @param {FormData} form */
  const post = async (form) => {
    const turntable = input("scene-turntable").value.trim();
    const scene = { masks: select("scene-masks").value, up: select("scene-up").value, invert_masks: input("scene-invert").checked, ...(turntable ? { turntable } : {}) };
    // What is small comes first: the server need not take the rest to refuse it.
    const whole = new FormData();
    whole.append("scene", JSON.stringify(scene));
    for (const [name, value] of form) {
      if (value instanceof File) whole.append(name, value, value.name);
      else whole.append(name, value);
    }
    box("alert").textContent = "";
    const created = await call("POST", "/jobs", whole);
    location.hash = `job=${created.id}`;
    box("main").focus();
  };

  /** @param {Picked[]} picked */
  const send = async (picked) => {
    const fine = picked.filter(({ path }) => OF_USE.test(path) && !path.split("/").some((part) => part.startsWith(".")));
    if (!fine.length) throw new Error("no photos and no cameras are among these files");
    const form = new FormData();
    for (const { path, file } of fine) form.append("files", file, path);
    await post(form);
  };

  /** @param {HTMLInputElement} element */
  const chosen = (element) => void attempt(async () => {
    const picked = [...(element.files ?? [])].map((file) => ({ path: file.webkitRelativePath || file.name, file }));
    element.value = "";
    if (picked.length) await send(picked);
  });
  for (const [which, field] of [["choose-folder", "folder"], ["choose-files", "files"]]) {
    button(which).addEventListener("click", () => input(field).click());
    input(field).addEventListener("change", () => chosen(input(field)));
  }

  /**
   * Files of a dropped folder, with their paths.
   * @param {FileSystemEntry} entry
   * @returns {Promise<Picked[]>}
   */
  const walk = async (entry) => {
    // Not every browser names the kinds of entries.
    if (entry.isFile) {
      const one = /** @type {FileSystemFileEntry} */ (entry);
      const file = await new Promise((/** @type {(f: File) => void} */ done, fail) => one.file(done, fail));
      return [{ path: entry.fullPath.replace(/^\//, ""), file }];
    }
    if (!entry.isDirectory) return [];
    const reader = /** @type {FileSystemDirectoryEntry} */ (entry).createReader();
    /** @type {Picked[]} */
    const found = [];
    for (;;) {
      const some = await new Promise((/** @type {(e: FileSystemEntry[]) => void} */ done, fail) => reader.readEntries(done, fail));
      if (!some.length) return found;
      for (const inner of some) found.push(...await walk(inner));
    }
  };

  const drop = box("drop");
  for (const name of ["dragenter", "dragover"]) {
    document.addEventListener(name, (e) => {
      e.preventDefault();
      drop.classList.add("over");
    });
  }
  document.addEventListener("dragleave", (e) => { if (!e.relatedTarget) drop.classList.remove("over"); });
  document.addEventListener("drop", (e) => {
    e.preventDefault();
    drop.classList.remove("over");
    // The entries are gone once this function returns.
    const entries = [...(e.dataTransfer?.items ?? [])].map((item) => item.webkitGetAsEntry()).filter((entry) => entry !== null);
    void attempt(async () => {
      const picked = (await Promise.all(entries.map(walk))).flat();
      if (picked.length) await send(picked);
    });
  });

  // --- Mask brush ------------------------------------------------------------------------------------------------------

  /**
   * @typedef {{k: number, whole: ImageBitmap, mask: Uint8ClampedArray, width: number, height: number, undo: Uint8ClampedArray[], at: number[]}} Brush
   * @type {?Brush}
   */
  let brush = null;
  let adding = true;
  const paint = get("paint", HTMLCanvasElement), dialog = get("brush", HTMLDialogElement);

  /** @param {string} path */
  const bitmap = async (path) => createImageBitmap(await (await fetch(path)).blob(), { premultiplyAlpha: "none" });

  /** @param {number} k */
  const openBrush = async (k) => {
    if (!job) return;
    const [whole, view] = await Promise.all([bitmap(`/jobs/${job.id}/photos/${k}.png`), bitmap(`/jobs/${job.id}/views/${k}.png`)]);
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
    if (!brush || !job) return;
    const { k, mask, width, height } = brush, canvas = new OffscreenCanvas(width, height), context = canvas.getContext("2d");
    if (!context) return;
    const picture = context.createImageData(width, height);
    mask.forEach((v, i) => picture.data.set([v, v, v, 255], 4 * i));
    context.putImageData(picture, 0, 0);
    dialog.close();
    await call("PUT", `/jobs/${job.id}/masks/${k}`, await canvas.convertToBlob({ type: "image/png" }));
    await reload(job.id);
    if (looking !== null) look(looking);
  }));

  // --- Begin -----------------------------------------------------------------------------------------------------------

  void attempt(async () => {
    const about = await call("GET", "/server");
    box("engine").textContent = about.engine;
    button("example").hidden = !about.example;
    button("example").textContent = `Take the example (${about.example})`;
    button("example").addEventListener("click", () => void attempt(async () => {
      const form = new FormData();
      form.append("example", about.example);
      await post(form);
    }));
    await open();
  });
}
