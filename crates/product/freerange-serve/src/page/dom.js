// Elements of the page, and requests to its server. Text of users and of their files only ever becomes text nodes.

/**
 * @template {HTMLElement} T
 * @param {string} id
 * @param {new () => T} kind
 * @returns {T}
 */
export const get = (id, kind) => {
  const found = document.getElementById(id);
  if (!(found instanceof kind)) throw new Error(`the page has no ${id}`);
  return found;
};
/** @param {string} id */
export const box = (id) => get(id, HTMLElement);
/** @param {string} id */
export const button = (id) => get(id, HTMLButtonElement);
/** @param {string} id */
export const input = (id) => get(id, HTMLInputElement);
/** @param {string} id */
export const select = (id) => get(id, HTMLSelectElement);

/**
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {Record<string, string>} attributes
 * @param {...(Node | string)} children
 * @returns {HTMLElementTagNameMap[K]}
 */
export const make = (tag, attributes, ...children) => {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
};

/** @param {unknown} problem */
export const complain = (problem) => { box("alert").textContent = problem instanceof Error ? problem.message : String(problem ?? ""); };

/**
 * @param {string} method
 * @param {string} path
 * @param {BodyInit} [body]
 */
export const call = async (method, path, body) => {
  const response = await fetch(path, { method, body });
  const answer = await response.json().catch(() => ({}));
  if (!response.ok) throw new Error(answer.error ?? `${method} ${path}: ${response.status}`);
  return answer;
};

/** What a button or a key begins; what goes wrong is said. @param {() => Promise<void>} work */
export const attempt = async (work) => {
  complain("");
  try {
    await work();
  } catch (error) {
    complain(error);
  }
};

/**
 * What a press of a button begins.
 * @param {string} id
 * @param {() => Promise<void>} work
 */
export const on = (id, work) => button(id).addEventListener("click", () => void attempt(work));

/** Buttons in a row are one stop of the Tab key; arrow keys move among them. @param {HTMLElement} bar */
export const toolbar = (bar) => {
  const all = () => [...bar.querySelectorAll("button")].filter((b) => !b.hidden && !b.disabled);
  /** @param {?HTMLButtonElement} one */
  const only = (one) => bar.querySelectorAll("button").forEach((b) => { b.tabIndex = b === one ? 0 : -1; });
  only(bar.querySelector("button"));
  bar.addEventListener("focusin", (e) => { if (e.target instanceof HTMLButtonElement) only(e.target); });
  bar.addEventListener("keydown", (e) => {
    const buttons = all(), at = buttons.findIndex((b) => b === document.activeElement);
    const to = { ArrowRight: at + 1, ArrowDown: at + 1, ArrowLeft: at - 1, ArrowUp: at - 1, Home: 0, End: buttons.length - 1 }[e.key];
    if (at < 0 || to === undefined) return;
    e.preventDefault();
    buttons[(to + buttons.length) % buttons.length].focus();
  });
};

/**
 * Hands a file to the user.
 * @param {Blob} blob
 * @param {string} name
 */
export const save = (blob, name) => {
  const link = make("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
};
