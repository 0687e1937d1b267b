// The panel beside a scene: photographs on the shelf, sliders, what a region takes, looks that are kept, keyframes of a film.

const SLIDER_MS = 40; // between two messages of a slider that moves; by eye
const FLIGHT_MS = 30; // between looks at whether a flight has ended; by eye

/** Controls of what all pages share; what they show comes from the server. */
class Panel {
  /** @param {Live} live */
  constructor(live) {
    this.live = live;
    /** @type {Map<number, HTMLElement>} nodes of the shelf by the number of their photograph */
    this.cards = new Map();
    /** @type {Map<string, () => void>} messages that are sent soon, by what they change */
    this.pending = new Map();
    // Whether the film was ready in the last state.
    this.filmed = true;
    for (const slider of document.querySelectorAll("[data-look]")) {
      const name = slider.dataset.look;
      slider.oninput = () => this.steady(name, () => live.tell("set", { name, value: +slider.value }));
    }
    at("map").onchange = () => live.tell("map", { map: at("map").value });
    at("gentle").onclick = () => live.tell("preset", { name: "gentle" });
    at("keep").onsubmit = (event) => {
      event.preventDefault();
      live.tell("keep", { name: at("keep-name").value, action: "keep" });
    };
    at("add-key").onclick = () => live.tell("key", { action: "add", camera: live.camera() });
    at("play").onclick = () => this.play();
    at("make-film").onclick = () => live.tell("film", { seconds: +at("seconds").value });
    at("save-ply").onclick = () => download("/gaussians");
    at("save-picture").onclick = () => this.savePicture();
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
    for (const slider of document.querySelectorAll("[data-look]")) {
      const name = slider.dataset.look;
      slider.parentElement.hidden = !(name in state.look); // another stylizer has other fields
      if (slider !== document.activeElement) slider.value = state.look[name];
    }
    at("map").value = state.map;
    at("hint").hidden = !state.shelf.length || Boolean(state.picked);
    this.fillRegion(state.picked, state.shelf);
    // Looks that were kept: where browsers draw they come with their colours.
    const { scene, stage } = this.live;
    if (scene && !scene.gaussians && stage) state.kept.forEach((name) => stage.add({ name }));
    this.fillFilm(state.keys, state.film);
  }

  /** @param {ShelfRow[]} shelf */
  fillShelf(shelf) {
    at("examples").hidden = shelf.length > 0;
    const now = new Set(shelf.map((row) => row.card));
    for (const [card, node] of this.cards) {
      if (now.has(card)) continue;
      node.remove();
      this.cards.delete(card);
    }
    for (const row of shelf) {
      if (!this.cards.has(row.card)) {
        this.cards.set(row.card, this.card(row));
        at("shelf").insertBefore(this.cards.get(row.card), at("add-photograph"));
      }
      const node = this.cards.get(row.card);
      node.classList.toggle("on", row.weight > 0);
      node.style.setProperty("--chip", row.colour ?? "transparent");
      if (node.weight !== document.activeElement) node.weight.value = row.weight;
      node.weight.hidden = shelf.length < 2;
    }
  }

  /**
   * A photograph on the shelf.
   * @param {ShelfRow} row
   * @returns {HTMLElement} with its slider as `weight`
   */
  card(row) {
    const tell = (action, more = {}) => this.live.tell("card", { card: row.card, action, ...more });
    const choose = (event) => {
      if (event.shiftKey) tell("weight", { weight: node.classList.contains("on") ? 0 : 1 });
      else tell("alone");
    };
    const title = `${row.name}: this one alone; with Shift in or out of the mix`;
    const picture = make("img", { src: `/card?card=${row.card}`, alt: row.name, draggable: false });
    const alone = make("button", { type: "button", className: "photo", title, onclick: choose }, picture);
    const weight = make("input", { type: "range", min: 0, max: 2, step: 0.05, title: "weight in the mix" });
    weight.setAttribute("aria-label", `weight of ${row.name}`);
    weight.oninput = () => this.steady(`card ${row.card}`, () => tell("weight", { weight: +weight.value }));
    const close = make("button", { type: "button", className: "close", textContent: "×", title: "remove", onclick: () => tell("remove") });
    const node = make("div", { className: "card" }, alone, make("span", { textContent: row.name }), weight, close);
    return Object.assign(node, { weight });
  }

  /**
   * What the picked region takes, and what it may take.
   * @param {?PickedRegion} picked
   * @param {ShelfRow[]} shelf
   */
  fillRegion(picked, shelf) {
    at("region").hidden = !picked;
    if (!picked) return;
    const tell = (action, more = {}) => this.live.tell("region", { action, ...more });
    const pill = (text, action, card, set) => make("button", {
      type: "button", className: "pill", textContent: text, ariaPressed: String(set),
      onclick: () => tell(set ? "free" : action, { card }),
    });
    const ruled = (action, card) => picked.rules.some((rule) => rule.action === action && rule.card === card);
    const close = make("button", { type: "button", className: "close", textContent: "×", title: "close", onclick: () => tell("close") });
    const head = make("p", {}, make("b", { textContent: "This thing" }), ` ${(100 * picked.share).toFixed(1)} % of the scene`, close);
    const taken = new Map(picked.taken.map((row) => [row.name, row.share]));
    const rows = shelf.map(({ name, card }) => {
      const share = taken.has(name) ? `${Math.round(100 * taken.get(name))} %` : "";
      const only = pill("only", "pin", card, ruled("pin", card));
      const never = pill("never", "forbid", card, ruled("forbid", card));
      return make("div", { className: "row" }, make("span", { textContent: `${name} ${share}` }), only, never);
    });
    const keep = pill("keep as it is", "keep", null, ruled("keep", null));
    const free = pill("free", "free", null, false);
    at("region").replaceChildren(head, ...rows, make("div", { className: "row" }, keep, free));
  }

  /**
   * @param {CameraMessage[]} keys
   * @param {{done: number, total: number, ready: boolean}} film
   */
  fillFilm(keys, film) {
    at("keys").replaceChildren(...keys.map((key, number) => this.key(key, number)));
    const busy = film.total > 0 && !film.ready;
    at("make-film").textContent = busy ? `${film.done} / ${film.total}` : "Make film";
    at("make-film").disabled = busy || !keys.length;
    at("play").disabled = keys.length < 2;
    if (film.ready && !this.filmed) this.offerFilm();
    this.filmed = film.ready;
  }

  /** The buttons of a keyframe. */
  key(key, number) {
    const button = (text, title, onclick) => make("button", { type: "button", textContent: text, title, onclick });
    return make("span", { className: "key" },
      button(number + 1, "go there", () => this.live.place.go(this.live.keyed(key))),
      button("‹", "earlier", () => this.live.tell("key", { action: "earlier", at: number })),
      button("×", "remove", () => this.live.tell("key", { action: "remove", at: number })));
  }

  offerFilm() {
    const line = say("", true);
    line.classList.remove("bad");
    line.append(make("a", { href: "/film", textContent: "download the film", download: "" }));
  }

  /** Fly from keyframe to keyframe. */
  async play() {
    const { place, state } = this.live;
    for (const key of state.keys) {
      place.go(this.live.keyed(key), +at("seconds").value);
      while (place.flight) await new Promise((done) => setTimeout(done, FLIGHT_MS));
    }
  }

  /** What is seen, as large as it is here; WebGL keeps no picture, so it is drawn once more. */
  savePicture() {
    const { canvas, splats, camera, lens, look, scene } = this.live.place;
    splats?.draw(camera.view, lens, look, { near: scene.near, background: scene.background, exact: true });
    canvas.toBlob((blob) => download(URL.createObjectURL(blob), `${this.live.scene.name}.png`));
  }
}
