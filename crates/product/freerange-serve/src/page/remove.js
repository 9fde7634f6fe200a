// A job gets another title, is removed, and is brought back.
import { attempt, box, button, call, get, input, on } from "./dom.js";
import { leave, reload } from "./jobs.js";
import { app } from "./state.js";

const renaming = get("rename-dialog", HTMLDialogElement), removing = get("remove-dialog", HTMLDialogElement);
button("rename").addEventListener("click", () => {
  input("new-title").value = app.job?.title ?? "";
  renaming.showModal();
  input("new-title").select();
});
get("rename-form", HTMLFormElement).addEventListener("submit", (e) => {
  e.preventDefault();
  renaming.close();
  void attempt(async () => {
    if (!app.job) return;
    await call("PUT", `/jobs/${app.job.id}/title`, JSON.stringify({ title: input("new-title").value }));
    await reload(app.job.id);
  });
});
button("rename-close").addEventListener("click", () => renaming.close());

button("remove").addEventListener("click", () => {
  box("remove-title").textContent = `Remove ${app.job?.title || "this object"}?`;
  removing.showModal();
});
button("remove-no").addEventListener("click", () => removing.close());
/** @type {?string} */
let removed = null;
on("remove-yes", async () => {
  removing.close();
  if (!app.job) return;
  const { id, title } = app.job;
  leave();
  await call("DELETE", `/jobs/${id}`);
  removed = id;
  box("removed-text").textContent = `${title || "The object"} was removed.`;
  box("removed").hidden = false;
  // The focused button is gone: what one may want next has the focus.
  button("undo").focus();
  location.hash = "";
});
on("undo", async () => {
  if (!removed) return;
  await call("POST", `/jobs/${removed}/restore`);
  box("removed").hidden = true;
  location.hash = `job=${removed}`;
  removed = null;
  box("main").focus();
});
