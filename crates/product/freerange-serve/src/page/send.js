// New jobs: files that are chosen or dropped, what the server takes of them, and how far they are.
/** @typedef {{path: string, file: File}} Picked */
import { attempt, box, button, complain, get, input, on, select } from "./dom.js";
import { app } from "./state.js";

const OF_USE = /\.(png|jpe?g|webp|json|bin|txt|xml|csv)$/i;
const PHOTO = /\.(png|jpe?g|webp)$/i;
/** Gaussians, to be looked at and converted. */
const SPLATS = /\.(ply|splat|spz|sog|glb|usd[az]|html)$/i;
/** Photos that nobody here can read. */
const OTHERS = /\.(heic|heif|avif|tiff?|dng|raw|cr[23]|nef|arw|exr|mp4|mov)$/i;
/** What has cameras, by its name. */
const CAMERAS = /\.(json|bin|xml|csv)$|(^|\/)(cameras|images)\.txt$/i;
/** What lies in captures and is not read: smaller copies, points, a data base. */
const UNREAD = /(^|\/)(images_[248]\/|points3D\.(bin|txt)$)/;

/** @param {number} bytes */
const megabytes = (bytes) => `${(bytes / 2 ** 20).toFixed(bytes < 10 * 2 ** 20 ? 1 : 0)} MB`;

const INSTALL = "Whoever runs this server can add one: pip install pycolmap, or apt install colmap.";

/** What the server takes, and what it does by itself, is told before anyone chooses. */
export const tellServer = () => {
  for (const id of /** @type {const} */ (["quality", "init"])) {
    const [first, ...others] = select(id).options, known = others.find((o) => o.value === app.defaults[id]);
    if (known) first.text += ` (${known.text})`;
  }
  const limits = app.limits;
  if (!limits) return;
  box("limits").textContent = `At most ${limits.files.toLocaleString("en")} files, ${megabytes(limits.bytes)} together, `
    + `${Math.round(limits.pixels / 1e6)} megapixels a photo. Photos are used at ${limits.side} pixels at most.`;
  const { name, missing } = app.finder;
  box("bare").hidden = !name;
  box("finder").textContent = name ? `Photos without cameras: ${name} finds the cameras, which takes minutes.` : `Photos need cameras; ${missing}. ${INSTALL}`;
};

/** What can be sent of these files; an error where that is nothing, or more than the server takes. @param {Picked[]} picked */
const chosenOf = (picked) => {
  const seen = picked.filter(({ path }) => !path.split("/").some((part) => part.startsWith(".")));
  const others = seen.filter(({ path }) => OTHERS.test(path));
  let fine = seen.filter(({ path }) => OF_USE.test(path) && !UNREAD.test(path));
  if (!fine.some(({ path }) => PHOTO.test(path))) {
    if (others.length) throw new Error(`${others.length} photos are ${others[0].path.split(".").pop()?.toUpperCase()} files, which cannot be read here: save them as JPEG or PNG`);
    fine = seen.filter(({ path }) => SPLATS.test(path));
    if (!fine.length) throw new Error("no photo and no file of Gaussians is among these files. Photos are .jpg, .png or .webp, with their cameras; Gaussians .ply, .splat, .spz, .sog, .glb, .usda, .usdz or .html.");
    if (fine.length > 1) throw new Error(`these are ${fine.length} files of Gaussians: one at a time`);
  }
  const limits = app.limits, bytes = fine.reduce((sum, { file }) => sum + file.size, 0);
  if (limits && fine.length > limits.files) throw new Error(`these are ${fine.length} files: this server takes at most ${limits.files}`);
  if (limits && bytes > limits.bytes) throw new Error(`these files have ${megabytes(bytes)}: this server takes at most ${megabytes(limits.bytes)}`);
  const large = limits && fine.find(({ file, path }) => file.size > limits.file_bytes && !SPLATS.test(path));
  if (large) throw new Error(`${large.path} has ${megabytes(large.file.size)}: this server takes at most ${megabytes(limits.file_bytes)} a file`);
  return { fine, left: others.map(({ path }) => path), bytes };
};

/** @type {?XMLHttpRequest} */
let sending = null;

/**
 * Sends a form, and shows how far it is.
 * @param {FormData} form
 * @returns {Promise<string>} the job's id
 */
const upload = (form) => new Promise((done, fail) => {
  const request = new XMLHttpRequest(), bar = get("sent", HTMLProgressElement);
  sending = request;
  box("sending").hidden = false;
  const begin = performance.now();
  let said = -1;
  request.upload.addEventListener("progress", ({ loaded, total }) => {
    bar.value = total ? loaded / total : 0;
    const seconds = (performance.now() - begin) / 1000, more = loaded ? seconds * (total - loaded) / loaded : 0;
    const left = seconds > 1 && loaded < total ? `, about ${Math.max(1, Math.round(more))} s left` : "";
    box("sent-text").textContent = loaded < total ? `Sent ${megabytes(loaded)} of ${megabytes(total)}${left}` : "Sent. The server looks at the files.";
    // A screen reader hears of every quarter.
    const quarter = Math.floor(4 * bar.value);
    box("sent-text").setAttribute("aria-live", quarter === said ? "off" : "polite");
    said = quarter;
  });
  request.addEventListener("loadend", () => {
    sending = null;
    box("sending").hidden = true;
    if (request.status === 201) return done(request.response.id);
    return fail(new Error(stopped ? "nothing was sent" : request.response?.error ?? `the server did not take the files (${request.status || "no answer"})`));
  });
  let stopped = false;
  request.addEventListener("abort", () => { stopped = true; });
  request.open("POST", "/jobs");
  request.responseType = "json";
  request.send(form);
});
button("stop-sending").addEventListener("click", () => sending?.abort());

const asking = get("cameras-dialog", HTMLDialogElement);
/** @type {(yes: boolean) => void} */
let answered = () => {};
get("cameras-form", HTMLFormElement).addEventListener("submit", (e) => {
  e.preventDefault();
  answered(true);
  asking.close();
});
asking.addEventListener("close", () => answered(false));
button("cameras-close").addEventListener("click", () => asking.close());

/**
 * What is asked of the server for photos that come without cameras; null: they are not to be sent.
 * @param {Picked[]} fine
 * @returns {Promise<?object>}
 */
const search = async (fine) => {
  const photos = fine.filter(({ path }) => PHOTO.test(path) && !/(^|\/)masks\//.test(path));
  if (!photos.length || fine.some(({ path }) => CAMERAS.test(path)) || input("scene-turntable").value.trim()) return {};
  const what = photos.length === 1 ? "This photo has no camera" : `These ${photos.length} photos have no cameras`, { name, missing } = app.finder;
  if (!name) {
    get("reading", HTMLDetailsElement).open = true;
    throw new Error(`${what}, and ${missing}. Turntable is under “How the photos are read”, which is open now. ${INSTALL}`);
  }
  box("cameras-text").textContent = `${what}. ${name} can look for them on this server, which takes minutes.`;
  asking.showModal();
  const yes = await new Promise((/** @type {(yes: boolean) => void} */ done) => { answered = done; });
  return yes ? { find_cameras: true, uneven: input("uneven").checked } : null;
};

/**
 * @param {FormData} form
 * @param {object} [more] what else is said of the scene
 */
const post = async (form, more) => {
  const turntable = input("scene-turntable").value.trim();
  const scene = { masks: select("scene-masks").value, up: select("scene-up").value, cameras: select("scene-cameras").value, invert_masks: input("scene-invert").checked, ...(turntable ? { turntable } : {}), ...more };
  // What is small comes first: the server need not take the rest to refuse it.
  const whole = new FormData();
  whole.append("scene", JSON.stringify(scene));
  for (const [name, value] of form) {
    if (value instanceof File) whole.append(name, value, value.name);
    else whole.append(name, value);
  }
  complain("");
  const id = await upload(whole);
  location.hash = `job=${id}`;
  box("main").focus();
};

/** @param {Picked[]} picked */
const send = async (picked) => {
  const { fine, left } = chosenOf(picked), form = new FormData(), more = await search(fine);
  if (!more) return;
  for (const { path, file } of fine) form.append("files", file, path);
  await post(form, more);
  if (left.length) complain(`${left.length} files are left out, since they cannot be read here: ${left.slice(0, 5).join(", ")}. Save them as JPEG or PNG.`);
};

/** @param {string} name */
export const offerExample = (name) => {
  button("example").hidden = false;
  button("example").textContent = `Take the example (${name})`;
  on("example", async () => {
    const form = new FormData();
    form.append("example", name);
    await post(form);
  });
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
