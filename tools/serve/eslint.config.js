import js from "@eslint/js";

const names = (text) => Object.fromEntries(text.split(" ").map((name) => [name, "readonly"]));

export default [
  { ...js.configs.recommended, files: ["**/*.js", "**/*.mjs"] },
  {
    files: ["**/*.js"],
    languageOptions: {
      sourceType: "module",
      globals: names("window document location history navigator fetch URL Blob Event EventTarget EventSource XMLHttpRequest MediaRecorder FormData File OffscreenCanvas HTMLElement "
        + "HTMLButtonElement HTMLInputElement HTMLSelectElement HTMLProgressElement HTMLCanvasElement HTMLFormElement HTMLAnchorElement HTMLDialogElement HTMLDetailsElement ImageData PointerEvent MouseEvent "
        + "createImageBitmap setTimeout clearTimeout requestAnimationFrame cancelAnimationFrame ResizeObserver getComputedStyle performance URLSearchParams atob Viewer BUDGET"),
    },
    rules: { eqeqeq: "error", "no-implicit-globals": "off", "no-var": "error", "prefer-const": "error", "no-eval": "error", "no-unused-vars": ["error", { varsIgnorePattern: "^Viewer$" }] },
  },
  { files: ["**/*.mjs"], languageOptions: { globals: names("process URL console setTimeout fetch Buffer WebSocket FormData Blob") } },
  {
    // The viewer defines what the page uses.
    files: ["**/viewer.js", "**/enter.js"],
    languageOptions: { sourceType: "script" },
    rules: { "no-redeclare": "off" },
  },
];
