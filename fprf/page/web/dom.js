// Elements of the page, by the names that its HTML gives them.

/**
 * Elements that are more than an HTMLElement, by their id.
 * @typedef {{
 *   canvas: HTMLCanvasElement, code: HTMLImageElement, panel: HTMLElement,
 *   line: HTMLButtonElement, back: HTMLButtonElement, next: HTMLButtonElement, reset: HTMLButtonElement,
 *   see: HTMLButtonElement, send: HTMLButtonElement, full: HTMLButtonElement, more: HTMLButtonElement, how: HTMLButtonElement,
 *   mix: HTMLInputElement, from: HTMLSelectElement, wiping: HTMLButtonElement,
 *   angle: HTMLInputElement, speed: HTMLInputElement, fading: HTMLInputElement, orbiting: HTMLInputElement,
 *   headset: HTMLButtonElement, link: HTMLInputElement, embed: HTMLInputElement,
 *   undo: HTMLButtonElement, redo: HTMLButtonElement, scenes: HTMLButtonElement, finish: HTMLButtonElement,
 *   photographs: HTMLInputElement, keep: HTMLFormElement, gentle: HTMLButtonElement, map: HTMLSelectElement,
 *   play: HTMLButtonElement, seconds: HTMLInputElement, format: HTMLSelectElement, scale: HTMLSelectElement,
 *   files: HTMLInputElement, folder: HTMLInputElement, minutes: HTMLInputElement, path: HTMLFormElement,
 *   stop: HTMLButtonElement, hour: HTMLInputElement, shine: HTMLInputElement,
 *   'keep-name': HTMLInputElement, 'style-file': HTMLInputElement, 'film-side': HTMLSelectElement,
 *   'film-fps': HTMLSelectElement, 'make-film': HTMLButtonElement, 'path-of': HTMLInputElement,
 * }} Elements
 */

/**
 * The element with an id: the HTML of each page has all that its scripts ask for.
 * @template {string} K
 * @param {K} id
 * @returns {K extends keyof Elements ? Elements[K] : HTMLElement}
 */
const at = (id) => {
  const found = /** @type {any} */ (document.getElementById(id)); // getElementById knows no types
  return found;
};

/**
 * An element below another one, which the HTML has there.
 * @param {ParentNode} root
 * @param {string} selector
 * @returns {HTMLElement}
 */
const below = (root, selector) => {
  const found = root.querySelector(selector);
  if (!(found instanceof HTMLElement)) throw new Error(`this page has no ${selector}`);
  return found;
};

/**
 * All elements of a kind.
 * @template {Element} T
 * @param {string} selector
 * @param {new () => T} kind
 * @returns {T[]}
 */
const every = (selector, kind) => [...document.querySelectorAll(selector)].flatMap((node) => (node instanceof kind ? [node] : []));

/**
 * A new element with properties and what lies inside.
 * @template {keyof HTMLElementTagNameMap} T
 * @param {T} tag
 * @param {Partial<HTMLElementTagNameMap[T]>} props
 * @param {...(Node|string)} inside
 * @returns {HTMLElementTagNameMap[T]}
 */
const make = (tag, props = {}, ...inside) => {
  const node = Object.assign(document.createElement(tag), props);
  node.append(...inside);
  return node;
};

/** What an error says. @param {unknown} error */
const wordsOf = (error) => (error instanceof Error ? error.message : String(error));

/** With a capital at its beginning. @param {string} text */
const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

/** Whether somebody writes there, or a field's own keys are its own. @param {EventTarget?} target */
const writes = (target) => target instanceof Element && Boolean(target.closest("input:not([type=range]), select, textarea"));

/** Whether motion is not wanted. */
const calm = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

/** From 0 to 1, slowly at both ends. @param {number} t */
const eased = (t) => t * t * (3 - 2 * t);

/** @param {number} x @param {number} low @param {number} high */
const bounded = (x, low, high) => Math.min(high, Math.max(low, x));

/** Wait. @param {number} milliseconds @returns {Promise<void>} */
const pause = (milliseconds) => new Promise((done) => { setTimeout(done, milliseconds); });

/**
 * One plain sentence on the stage, where it cannot be what it should be; without words there is none.
 * @param {HTMLElement} root
 * @param {string} text
 */
const explain = (root, text = "") => {
  root.querySelector(".why")?.remove();
  root.dataset.why = text;
  if (text) below(root, ".view").append(make("p", { className: "why", role: "status", textContent: text }));
};
const LOST = "The graphics card has dropped the picture. It comes back by itself; if it does not, reload the page.";
