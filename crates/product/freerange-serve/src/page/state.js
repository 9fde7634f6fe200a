// What is shown now: the job, its panes, and where one looks from.
/**
 * @typedef {{width: number, height: number, fx: number, fy: number, cx: number, cy: number, world_to_camera: number[]}} Camera
 * @typedef {{name: string, camera: Camera, shown: boolean, covers: number, agreement: number, cut_off: boolean, edited: boolean}} Photo
 * @typedef {{center: number[], radius: number, up: number[], views: Photo[], notes: string[], warnings: string[], format: string, masks: string}} Understood
 * @typedef {{number: number, stage: string, parts: {sample: number, gaussians: number}[]}} Estimate
 * @typedef {{id: string, title: string, created: number, state: string, error: ?string, position: ?number, stage: ?string, sample: number, done: number,
 *   total: number, loss: ?number, estimate: ?Estimate, thumbnail: boolean, version: number}} Status
 * @typedef {{samples?: ?number, seed?: ?number, quality?: ?string, init?: ?string, iterations?: ?number}} Options
 * @typedef {Status & {understood: ?Understood, options: Options, passed_over: string[], notes: string[],
 *   seconds: [string, number][], samples: {seed: number, gaussians: number}[], up: number[], may_go: boolean, formats: string[]}} Job
 * @typedef {{viewer: Viewer, figure: HTMLElement, stage: HTMLElement, photo: HTMLImageElement, over: HTMLCanvasElement, caption: HTMLElement}} Pane
 * @typedef {{bytes: number, file_bytes: number, files: number, pixels: number, job_pixels: number, side: number}} Limits
 */

export const app = {
  /** @type {?Job} */
  job: null,
  /** @type {Pane[]} */
  panes: [],
  /** @type {?number} The photo whose camera is looked through. */
  looking: null,
  /** Number of the last estimate that was drawn. */
  drawn: 0,
  /** @type {?Limits} What the server takes. */
  limits: null,
  /** @type {Options} What jobs have that choose nothing, as far as it is known. */
  defaults: {},
  /** @type {?number[][]} The box that a result is cropped to: its lowest and its highest corner. */
  crop: null,
  /** @type {{name?: string, missing?: string}} What finds the cameras of photos that have none, or why nothing does. */
  finder: {},
};

/** Those who want to hear that one looks from elsewhere. */
export const viewed = new EventTarget();
