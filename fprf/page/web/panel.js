// The panel beside a scene: photographs on the shelf, sliders, what a region takes, looks that are kept.

const SLIDER_MS = 40; // between two messages of a slider that moves; by eye
const MAX_WEIGHT = 2; // of a photograph in the mix (messages.py)

/** A photograph on the shelf, with the slider of its weight and its number. @typedef {{node: HTMLElement, weight: HTMLInputElement, much: HTMLOutputElement}} Card */

/**
 * A button of the panel.
 * @param {string} text
 * @param {string} title
 * @param {() => void} onclick
 */
const labelled = (text, title, onclick, className = "pill") => make("button", {
  type: "button", className, textContent: text, title, ariaLabel: title, onclick,
});

/** The number beside a slider. @param {HTMLInputElement} slider */
const showNumber = (slider) => {
  const output = slider.parentElement?.querySelector("output");
  if (output) output.textContent = slider.valueAsNumber.toFixed(Number(slider.step) < 1 ? 2 : 0);
};

/** Controls of what all pages share; what they show comes from the server. */
class Panel {
  /** @param {Live} live */
  constructor(live) {
    this.live = live;
    /** @type {Map<number, Card>} the shelf by the numbers of its photographs */
    this.cards = new Map();
    /** @type {Map<string, () => void>} messages that are sent soon, by what they change */
    this.pending = new Map();
    this.saving = new Saving(live);
    this.film = new Film(live);
    this.sliders = every("[data-look]", HTMLInputElement);
    this.listen();
  }

  listen() {
    const { live } = this;
    this.sliders.forEach((slider) => this.listenTo(slider, slider.dataset.look ?? ""));
    at("undo").onclick = () => live.tell("undo");
    at("redo").onclick = () => live.tell("undo", { again: true });
    addEventListener("keydown", (event) => {
      if (!(event.ctrlKey || event.metaKey) || !/^Key[YZ]$/.test(event.code) || writes(event.target)) return;
      event.preventDefault();
      live.tell("undo", { again: event.code === "KeyY" || event.shiftKey });
    });
    at("map").onchange = () => live.tell("map", { map: at("map").value });
    at("gentle").onclick = () => live.tell("preset", { name: "gentle" });
    at("keep").onsubmit = (event) => {
      event.preventDefault();
      this.keep(at("keep-name").value.trim().replace(/\s+/g, " "));
    };
  }

  /** @param {HTMLInputElement} slider @param {string} name of what it sets */
  listenTo(slider, name) {
    const { live } = this;
    slider.oninput = () => {
      showNumber(slider);
      this.steady(name, () => live.tell("set", { name, value: slider.valueAsNumber }));
    };
    slider.ondblclick = () => {
      const value = live.known.defaults[name];
      this.pending.delete(name); // of the two clicks
      slider.value = String(value);
      showNumber(slider);
      live.tell("set", { name, value });
    };
  }

  /** Keep the look of now; of a name that is there already it is asked. @param {string} name */
  keep(name) {
    const tell = (more = {}) => this.live.tell("keep", { name, action: "keep", ...more });
    if (!this.live.known.kept.includes(name)) tell();
    else question(`There is a look called “${name}”.`, { "Replace it": () => tell({ replace: true }) });
  }

  /**
   * Send the last message of a kind in `SLIDER_MS`.
   * @param {string} kind
   * @param {() => void} send
   */
  steady(kind, send) {
    if (!this.pending.size) {
      setTimeout(() => {
        this.pending.forEach((each) => each());
        this.pending.clear();
      }, SLIDER_MS);
    }
    this.pending.set(kind, send);
  }

  /**
   * Show a state; what somebody is changing right now stays as it is.
   * @param {SharedState} state
   */
  fill(state) {
    this.fillShelf(state.shelf);
    this.fillSliders(state.look);
    at("undo").disabled = !state.undo;
    at("redo").disabled = !state.redo;
    at("keeps").textContent = state.keeps ? `Looks, photographs and film are kept in ${state.keeps}` : "Nothing is kept of this scene: it has no folder.";
    at("map").value = state.map;
    at("hint").hidden = !state.shelf.length || Boolean(state.picked);
    at("region").hidden = !state.picked;
    if (state.picked) this.fillRegion(state.picked, state.shelf);
    if (this.live.opened) this.fillStage(this.live.opened, state.kept);
    this.fillKept(state.kept);
    this.film.fill(state.keys, state.film);
  }

  /** @param {Object<string, number>} look */
  fillSliders(look) {
    for (const slider of this.sliders) {
      const name = slider.dataset.look ?? "";
      const label = slider.closest("label");
      if (label) label.hidden = !(name in look); // another stylizer has other fields
      const moving = slider === document.activeElement && slider.matches(":active");
      if (!moving && name in look) slider.value = String(look[name]);
      showNumber(slider);
    }
  }

  /** Looks that were kept: where browsers draw they come with their colours. @param {Opened} opened @param {string[]} kept */
  fillStage({ scene, stage }, kept) {
    if (!scene.gaussians) kept.forEach((name) => stage.add({ name }));
    for (const { name } of [...stage.styles]) {
      if (!["Captured", "Now", ...kept].includes(name)) stage.remove(name);
    }
  }

  /** Looks that were kept. @param {string[]} names */
  fillKept(names) {
    at("kept").replaceChildren(...names.map((name) => make("div", { className: "row" },
      make("span", { textContent: name }),
      labelled("Use", `use ${name}`, () => this.use(name)),
      labelled("×", `forget ${name}`, () => this.live.tell("keep", { name, action: "remove" }), "close"))));
  }

  /** Go on from a look that was kept. @param {string} name */
  use(name) {
    this.live.tell("keep", { name, action: "restore" });
    this.live.stage.choose("Now");
  }

  /** @param {ShelfRow[]} shelf */
  fillShelf(shelf) {
    at("examples").hidden = shelf.length > 0;
    at("panel").classList.toggle("bare", !shelf.length); // nothing can be set of a style that there is not
    const now = new Set(shelf.map((row) => row.card));
    for (const [number, card] of this.cards) {
      if (now.has(number)) continue;
      card.node.remove();
      this.cards.delete(number);
    }
    for (const row of shelf) {
      const { node, weight, much } = this.cards.get(row.card) ?? this.add(row);
      node.classList.toggle("on", row.weight > 0);
      node.style.setProperty("--chip", row.colour ?? "transparent");
      if (weight !== document.activeElement) weight.value = String(row.weight);
      weight.hidden = shelf.length < 2;
      much.hidden = shelf.length < 2;
      much.textContent = row.weight.toFixed(1);
    }
  }

  /** Put a photograph on the shelf. @param {ShelfRow} row */
  add(row) {
    const card = this.card(row);
    this.cards.set(row.card, card);
    at("shelf").insertBefore(card.node, at("add-photograph"));
    return card;
  }

  /**
   * A photograph of the shelf.
   * @param {ShelfRow} row
   * @returns {Card}
   */
  card({ card, name }) {
    const tell = (/** @type {string} */ action, more = {}) => this.live.tell("card", { card, action, ...more });
    const weight = make("input", { type: "range", min: "0", max: String(MAX_WEIGHT), step: "0.05", title: "How much of this photograph, in the mix", ariaLabel: `weight of ${name}` });
    weight.oninput = () => {
      much.textContent = weight.valueAsNumber.toFixed(1);
      this.steady(`card ${card}`, () => tell("weight", { weight: weight.valueAsNumber }));
    };
    const image = make("img", { src: `/card?card=${card}`, alt: name, draggable: false });
    const alone = make("button", { type: "button", className: "photo", title: `${name}: this one alone; with Shift in or out of the mix` }, image);
    const much = make("output");
    const node = make("div", { className: "card" }, alone, make("p", {}, make("span", { textContent: name, title: name }), much), weight,
      labelled("×", `remove ${name}`, () => tell("remove"), "close"));
    alone.onclick = (event) => {
      if (event.shiftKey) tell("weight", { weight: node.classList.contains("on") ? 0 : 1 });
      else tell("alone");
    };
    return { node, weight, much };
  }

  /**
   * What the picked region takes, and what it may take.
   * @param {PickedRegion} picked
   * @param {ShelfRow[]} shelf
   */
  fillRegion(picked, shelf) {
    const tell = (/** @type {string} */ action, more = {}) => this.live.tell("region", { action, ...more });
    /** @param {string} text @param {string} action @param {number?} card */
    const pill = (text, action, card) => {
      const set = picked.rules.some((rule) => rule.action === action && rule.card === card);
      const onclick = () => tell(set ? "free" : action, { card });
      return make("button", { type: "button", className: "pill", textContent: text, ariaPressed: String(set), onclick });
    };
    const shares = new Map(picked.taken.map((row) => [row.name, row.share]));
    const head = make("p", {}, make("b", { textContent: "This thing" }), ` ${(100 * picked.share).toFixed(1)} % of the scene`,
      labelled("×", "close", () => tell("close"), "close"));
    const rows = shelf.map(({ name, card }) => {
      const share = shares.get(name);
      const much = make("data", { value: String(share ?? 0), textContent: share === undefined ? "" : `${Math.round(100 * share)} %` });
      return make("div", { className: "row" }, make("span", { textContent: name, title: name }), much, pill("Only this", "pin", card), pill("Never", "forbid", card));
    });
    const rest = make("div", { className: "row" }, pill("Keep as it is", "keep", null), pill("As the style decides", "free", null));
    at("region").replaceChildren(head, ...rows, rest);
  }
}
