// The controls of a stage: which style, from which other one, how far, or a line between both.

const MAX_SHOWN = 4; // photographs beside a style that is of several; by eye
/** What buttons open, by their ids. @type {Object<string, string>} */
const PANELS = { light: "lighting", see: "seeing", send: "sending", how: "help" };
const SWEEP_MS = 4200; // that the line takes on its way across, once; by eye
const SWEEP_TURN = 0.7; // of that time, after which the line comes back; by eye
const SWEEP_LEAST = 0.06; // where it turns; by eye
const FADE_MS = 450; // from one style to another; by eye
const LINE_STEP = 0.02; // of the width, by an arrow key
const BLEND_STEP = 0.1; // by a bracket key

/**
 * A style on the stage: its name and, where there are any, a small picture of the scene in it and of its photographs.
 * @typedef {{name: string, thumb?: string, of?: string[]}} StageStyle
 *
 * What is shown: from which style, to which, how far from 0 to 1, whether there is a line between both, where it stands.
 * @typedef {{from: string, to: string, amount: number, wiping: boolean, line: number}} StageState
 */

/** What a style is called on the page: the one that is being made has no name yet. @param {string} name */
const called = (name) => (name === "Now" ? "Your style" : capital(name));

/** @param {string} src */
const picture = (src) => make("img", { src, alt: "", draggable: false });

class Stage {
  /** @param {Place|Pictures} place @param {StageStyle[]} styles of which there is one at least */
  constructor(place, styles) {
    this.place = place;
    this.root = at("place");
    /** @type {(StageStyle & {card: HTMLButtonElement})[]} */
    this.styles = [];
    this.from = styles[0].name;
    this.to = styles[0].name;
    this.amount = 1;
    this.wiping = false;
    this.line = 0.5;
    /** @type {{chosen: ((name: string) => void)?, escape: (() => void)?, unfolded: ((id: string?) => void)?}} */
    this.listeners = { chosen: null, escape: null, unfolded: null };
    this.sending = new Sending(this);
    this.seeing = place instanceof Place ? new Seeing(place) : null;
    /** @type {Daylight?} the day of a page that one sends */
    this.light = null;
    this.listen();
    styles.forEach((style) => this.add(style));
  }

  listen() {
    const { place, root } = this;
    at("mix").oninput = () => {
      const share = at("mix").valueAsNumber / 100;
      this.set(this.wiping ? { line: share } : { amount: share });
    };
    at("from").onchange = () => this.set({ from: at("from").value });
    at("wiping").onclick = () => this.compare();
    at("back").onclick = () => place.step(-1);
    at("next").onclick = () => place.step(1);
    at("reset").onclick = () => place.home();
    at("full").onclick = () => (document.fullscreenElement ? document.exitFullscreen() : root.requestFullscreen());
    at("full").hidden = !root.requestFullscreen;
    at("see").hidden = !this.seeing;
    for (const id of Object.keys(PANELS)) at(id).onclick = () => this.unfold(id);
    at("more").onclick = () => {
      const open = below(root, ".tools").classList.toggle("open");
      at("more").setAttribute("aria-expanded", String(open));
    };
    this.listenToLine();
    addEventListener("keydown", (event) => this.key(event));
  }

  listenToLine() {
    const handle = at("line");
    handle.onpointerdown = (event) => {
      handle.setPointerCapture(event.pointerId);
      event.preventDefault();
      handle.focus();
    };
    handle.onpointermove = (event) => {
      if (!handle.hasPointerCapture(event.pointerId)) return;
      const box = below(this.root, ".view").getBoundingClientRect();
      this.draw((event.clientX - box.left) / box.width);
    };
    handle.onkeydown = (event) => {
      const by = { ArrowLeft: -LINE_STEP, ArrowRight: LINE_STEP, Home: -1, End: 1 }[event.key];
      if (!by) return;
      event.preventDefault();
      event.stopPropagation();
      this.draw(this.line + by);
    };
  }

  /** Put the line there. @param {number} line */
  draw(line) {
    this.set({ line: bounded(line, 0, 1) });
  }

  /** @param {StageStyle} style */
  add(style) {
    const { name, thumb, of = [] } = style;
    if (this.styles.some((each) => each.name === name)) return;
    const card = make("button", { type: "button", className: "look", title: name, onclick: () => this.choose(name) });
    if (thumb) card.append(picture(thumb));
    card.append(make("span", { className: "name", textContent: called(name) }));
    if (of.length) card.append(make("span", { className: "of" }, ...of.slice(0, MAX_SHOWN).map(picture)));
    this.styles.push({ ...style, card });
    at("looks").insertBefore(card, at("add"));
    at("from").append(make("option", { value: name, textContent: called(name) }));
    this.set({});
  }

  /** Show what the scene looks like in a style. @param {string} name @param {HTMLCanvasElement} drawn */
  portray(name, drawn) {
    const card = this.styles.find((each) => each.name === name)?.card;
    card?.querySelector("canvas")?.remove();
    card?.prepend(drawn);
  }

  /** A line between two styles, or none: never between one and itself. */
  compare() {
    const [first, second] = this.styles;
    if (this.wiping) {
      this.set({ wiping: false });
      return;
    }
    if (this.from === this.to && second) this.set(this.to === first.name ? { to: second.name } : { from: first.name });
    this.set({ wiping: true, line: 0.5 });
  }

  /** @param {string} name */
  remove(name) {
    const style = this.styles.find((each) => each.name === name);
    if (!style) return;
    style.card.remove();
    [...at("from").options].find((option) => option.value === name)?.remove();
    this.styles = this.styles.filter((each) => each !== style);
    const instead = (/** @type {string} */ kept) => (kept === name ? this.styles[0].name : kept);
    this.set({ from: instead(this.from), to: instead(this.to) });
  }

  /** From the captured colours to a style, without a jump. @param {string} name */
  choose(name) {
    const before = this.to;
    this.set({ to: name, amount: 1, wiping: this.wiping && name !== this.from });
    this.listeners.chosen?.(name);
    if (!this.wiping && before !== name && this.place instanceof Place && !calm()) this.fade(before, name);
  }

  /** @param {string} before @param {string} name */
  fade(before, name) {
    const start = performance.now();
    const step = (/** @type {number} */ now) => {
      if (this.to !== name || this.amount !== 1 || this.wiping) return;
      const t = bounded((now - start) / FADE_MS, 0, 1);
      if (t < 1) {
        this.place.show({ first: before, second: name, blend: eased(t), wipe: -1 });
        requestAnimationFrame(step);
      } else this.set({});
    };
    requestAnimationFrame(step);
  }

  /**
   * Begin in a style: the line draws it from the right across the scene and comes to rest in the middle, unless motion is not
   * wanted or somebody takes over.
   * @param {string} name
   */
  begin(name) {
    this.set({ to: name, wiping: true, line: 0.5 });
    if (!(this.place instanceof Place) || calm()) return;
    const controller = new AbortController();
    const { signal } = controller;
    for (const kind of ["pointerdown", "keydown", "wheel"]) addEventListener(kind, () => controller.abort(), { signal, capture: true });
    const start = performance.now();
    const step = (/** @type {number} */ now) => {
      if (signal.aborted) return;
      const t = bounded((now - start) / SWEEP_MS, 0, 1);
      const there = 1 - (1 - SWEEP_LEAST) * eased(Math.min(1, t / SWEEP_TURN));
      const back = (0.5 - SWEEP_LEAST) * eased(Math.max(0, (t - SWEEP_TURN) / (1 - SWEEP_TURN)));
      this.set({ line: there + back });
      if (t < 1) requestAnimationFrame(step);
      else controller.abort();
    };
    this.set({ line: 1 });
    requestAnimationFrame(step);
  }

  /** @param {Partial<StageState>} changes */
  set(changes) {
    Object.assign(this, changes);
    const { from, to, amount, wiping, line } = this;
    this.place.show({ first: from, second: to, blend: amount, wipe: wiping ? line : -1 });
    this.styles.forEach(({ name, card }) => card.setAttribute("aria-pressed", String(name === to)));
    const share = Math.round(100 * (wiping ? line : amount));
    at("mix").value = String(share);
    at("mix").setAttribute("aria-valuetext", wiping ? `line at ${share} %` : `${share} % ${to}`);
    at("mix").disabled = from === to;
    at("from").value = from;
    at("towards").textContent = from === to ? "" : called(to);
    at("much").textContent = from === to ? "" : `${share} %`;
    this.root.classList.toggle("alone", this.styles.length < 2);
    at("blending").hidden = this.styles.length < 2 && !this.root.classList.contains("field");
    at("wiping").setAttribute("aria-pressed", String(wiping));
    this.fillLine();
  }

  fillLine() {
    const handle = at("line");
    handle.hidden = !this.wiping;
    handle.style.left = `${100 * this.line}%`;
    handle.setAttribute("aria-valuenow", String(Math.round(100 * this.line)));
    handle.dataset.left = called(this.from);
    handle.dataset.right = called(this.to);
  }

  /** Open the panel of a button, or close it; one is open at a time. @param {string?} id null closes all */
  unfold(id) {
    for (const [button, panel] of Object.entries(PANELS)) {
      const open = button === id && at(panel).hidden;
      const focused = at(panel).contains(document.activeElement);
      at(panel).hidden = !open;
      if (focused && !open) at(button).focus(); // who was in it goes on where it was opened
      at(button).setAttribute("aria-expanded", String(open));
    }
    this.sending.fill();
    this.seeing?.fill();
    this.listeners.unfolded?.(id);
  }

  /** @param {KeyboardEvent} event */
  key(event) {
    const leaves = event.key === "Escape" && event.target instanceof Element && event.target.closest(".panel");
    if (event.ctrlKey || event.metaKey || event.altKey || (writes(event.target) && !leaves)) return;
    const act = this.actOf(event);
    if (!act) return;
    act();
    event.preventDefault();
  }

  /** What a key does, if anything. @param {KeyboardEvent} event @returns {(() => void)?} */
  actOf({ code, key, shiftKey }) {
    const style = code.startsWith("Digit") ? this.styles[Number(code.slice(-1))] : undefined;
    if (style) return () => this.choose(style.name);
    if (key === "[") return () => this.set({ amount: Math.max(0, this.amount - BLEND_STEP) });
    if (key === "]") return () => this.set({ amount: Math.min(1, this.amount + BLEND_STEP) });
    if (code === "KeyC") return () => this.compare();
    if (code === "KeyV") return () => this.place.step(shiftKey ? -1 : 1);
    if (code === "KeyR") return () => this.place.home();
    if (code === "KeyL" && !at("light").hidden) return () => this.unfold("light");
    if (key === "?" || code === "KeyH") return () => this.unfold("how");
    if (key === "Escape") {
      return () => {
        this.unfold(null);
        this.listeners.escape?.();
      };
    }
    return null;
  }
}
