// The page of `freerange serve`.
import { attempt, box, call } from "./dom.js";
import { open } from "./jobs.js";
import "./record.js";
import "./remove.js";
import { offerExample, tellServer } from "./send.js";
import { app } from "./state.js";

// What followed a link of another site has one mark more in its address.
if (location.search) history.replaceState(null, "", `/${location.hash}`);

void attempt(async () => {
  const about = await call("GET", "/server");
  Object.assign(app, { limits: about.limits, finder: about.camera_finder, defaults: about.defaults });
  tellServer();
  if (about.example) offerExample(about.example);
  await open();
  box("engine").textContent = about.engine;
});
