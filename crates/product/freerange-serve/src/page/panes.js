// The 3D views: one per sample, which turn together; cameras drawn over them; looking through a photo's camera.
/**
 * @typedef {import("./state.js").Pane} Pane
 * @typedef {import("./state.js").Understood} Understood
 */
import { box, button, input, make, toolbar } from "./dom.js";
import { app, viewed } from "./state.js";

let camerasShown = true;
/** @type {?boolean} */
let darkBack = null;

const dark = window.matchMedia("(prefers-color-scheme: dark)");
const back = () => ((darkBack ?? dark.matches) ? [0.08, 0.08, 0.08] : [1, 1, 1]);
export const repaint = () => {
  for (const pane of app.panes) {
    pane.viewer.background = back();
    pane.photo.style.backgroundColor = `rgb(${back().map((v) => Math.round(255 * v)).join(" ")})`;
    pane.viewer.redraw();
  }
};
dark.addEventListener("change", repaint);

/** The sphere that the view shows: the object's, or one that the cameras stand on. @param {Understood} understood */
const sphere = ({ center, radius, views }) => {
  const far = views.map(({ camera: { world_to_camera: m } }) => Math.hypot(...center.map((v, i) => v + m[4 * i] * m[12] + m[4 * i + 1] * m[13] + m[4 * i + 2] * m[14])));
  return /** @type {const} */ ([center, camerasShown ? Math.max(radius, ...far) : radius]);
};

/** Draws the cameras, and has them in sight; or the object alone. @param {boolean} shown */
export const showCameras = (shown) => {
  const understood = app.job?.understood;
  if (shown === camerasShown) return;
  camerasShown = shown;
  button("show-cameras").setAttribute("aria-pressed", String(shown));
  if (!understood) return;
  look(null);
  for (const { viewer } of app.panes) {
    const { azimuth, elevation } = viewer.orbit;
    viewer.frameSphere(...sphere(understood));
    Object.assign(viewer.orbit, { azimuth, elevation });
  }
};

/**
 * One picture per sample; they turn together.
 * @param {number} count
 * @param {Understood} understood
 */
export const showPanes = (count, understood) => {
  while (app.panes.length > count) app.panes.pop()?.figure.remove();
  while (app.panes.length < count) {
    const canvas = make("canvas", { tabindex: "0", role: "application", "aria-label": `3D view ${app.panes.length + 1}`, "aria-describedby": "help" });
    const photo = make("img", { class: "over", alt: "", hidden: "" }), over = make("canvas", { class: "over", "aria-hidden": "true" });
    const stage = make("div", { class: "stage" }, canvas, photo, over), caption = make("figcaption", {});
    const figure = make("figure", {}, stage, caption);
    box("views").append(figure);
    const viewer = new Viewer(canvas, { up: understood.up, background: back() });
    viewer.setGaussians(new Float32Array(0));
    viewer.frameSphere(...sphere(understood));
    const pane = { viewer, figure, stage, photo, over, caption };
    viewer.onmove = () => follow(pane);
    viewer.ondraw = () => sketch(pane);
    app.panes.push(pane);
    if (app.panes.length > 1) Object.assign(viewer, { orbit: { ...app.panes[0].viewer.orbit }, camera: app.panes[0].viewer.camera });
  }
  // They share the time of one picture.
  for (const { viewer } of app.panes) viewer.budget = BUDGET / app.panes.length;
  repaint();
  window.viewers = app.panes.map((p) => p.viewer);
};

/** @param {Pane} leader */
const follow = (leader) => {
  for (const pane of app.panes) {
    if (pane === leader) continue;
    Object.assign(pane.viewer, { orbit: { ...leader.viewer.orbit }, camera: null });
    pane.viewer.redraw();
  }
  look(null);
  viewed.dispatchEvent(new Event("viewed"));
};

/** The cameras around the object, and the object's sphere, as lines over the picture. @param {Pane} pane */
const sketch = (pane) => {
  const { over, viewer } = pane, understood = app.job?.understood, context = over.getContext("2d");
  if (!context) return;
  const [width, height] = viewer.size();
  if (over.width !== width || over.height !== height) Object.assign(over, { width, height });
  context.clearRect(0, 0, width, height);
  if (!understood || viewer.camera) return;
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
  /**
   * @param {string} text
   * @param {number[]} at
   */
  const label = (text, at) => {
    const place = project(at);
    if (place) context.fillText(text, place[0] + 4, place[1] - 4);
  };
  if (app.crop) {
    const ends = app.crop, corner = (/** @type {number} */ k) => [0, 1, 2].map((i) => ends[k >> i & 1][i]);
    context.strokeStyle = context.fillStyle = "#d97a00";
    for (const i of [0, 1, 2]) {
      for (let k = 0; k < 8; k++) if (!(k >> i & 1)) line([corner(k), corner(k | 1 << i)]);
      label("xyz"[i], corner(1 << i));
    }
  }
  if (!camerasShown) return;
  understood.views.forEach((photo, k) => {
    const m = photo.camera.world_to_camera, c = photo.camera;
    const rows = [0, 1, 2].map((i) => [m[i], m[i + 4], m[i + 8]]), shift = [m[12], m[13], m[14]];
    /** @param {number[]} q */
    const world = (q) => [0, 1, 2].map((i) => rows[0][i] * (q[0] - shift[0]) + rows[1][i] * (q[1] - shift[1]) + rows[2][i] * (q[2] - shift[2]));
    const depth = 0.35 * understood.radius, x = [-c.cx / c.fx * depth, (c.width - c.cx) / c.fx * depth], y = [-c.cy / c.fy * depth, (c.height - c.cy) / c.fy * depth];
    const corners = [[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]].map(([a, b]) => world([a, b, depth])), at = world([0, 0, 0]);
    context.strokeStyle = context.fillStyle = photo.shown ? "#1a9c46" : "#808080";
    context.setLineDash(photo.shown ? [] : [width / 120, width / 120]);
    line([...corners, corners[0]]);
    corners.forEach((corner) => line([at, corner]));
    label(photo.shown ? String(k + 1) : `(${k + 1})`, at);
  });
  context.setLineDash([]);
  if (app.drawn === 0 && app.job?.samples.length === 0) {
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

/** Looks through the camera of a photo, or leaves it. @param {?number} k */
export const look = (k) => {
  const before = app.looking, photo = k === null ? undefined : app.job?.understood?.views[k];
  app.looking = photo ? k : null;
  for (const pane of app.panes) {
    const ratio = photo ? photo.camera.width / photo.camera.height : 4 / 3;
    pane.stage.style.setProperty("--ratio", String(ratio));
    pane.photo.hidden = !photo;
    if (photo && app.job) {
      pane.photo.src = `/jobs/${app.job.id}/views/${k}.png?v=${photo.covers}`;
      pane.viewer.setCamera(photo.camera);
    } else if (pane.viewer.camera) {
      pane.viewer.leaveCamera();
    }
  }
  box("compare").hidden = !photo;
  slide();
  if (before !== app.looking) document.querySelectorAll("#photos .look").forEach((b, i) => b.setAttribute("aria-pressed", String(i === app.looking)));
  if (photo) viewed.dispatchEvent(new Event("viewed"));
};

const slide = () => {
  const share = input("slider").value;
  for (const pane of app.panes) pane.photo.style.clipPath = `inset(0 ${100 - Number(share)}% 0 0)`;
  input("slider").setAttribute("aria-valuetext", `${share} % photo`);
};
input("slider").addEventListener("input", slide);

box("tools").addEventListener("click", (e) => {
  const name = e.target instanceof HTMLElement ? e.target.dataset.do : undefined;
  if (name && app.panes[0]) app.panes[0].viewer.do(name);
});
button("show-cameras").addEventListener("click", () => showCameras(!camerasShown));
const isDark = () => darkBack ?? dark.matches;
const tellBackground = () => button("background").setAttribute("aria-pressed", String(isDark()));
button("background").addEventListener("click", () => {
  darkBack = !isDark();
  tellBackground();
  repaint();
});
dark.addEventListener("change", tellBackground);
tellBackground();
toolbar(box("tools"));
