// The panel beside a scene: photographs on the shelf, sliders, what a region takes, looks that are kept, keyframes of a film.

const SLIDER_MS = 40; // between two messages of a slider that moves; by eye
const MAX_PICTURE = 16384; // pixels of a side of a picture that is saved here; larger ones take GiB
const MAX_PAINTED = 4096; // of one that the server draws (messages.py)
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
      slider.oninput = () => {
        this.number(slider);
        this.steady(name, () => live.tell("set", { name, value: +slider.value }));
      };
      slider.ondblclick = () => {
        this.pending.delete(name); // of the two clicks
        slider.value = live.state.defaults[name];
        this.number(slider);
        live.tell("set", { name, value: live.state.defaults[name] });
      };
    }
    at("undo").onclick = () => live.tell("undo");
    at("redo").onclick = () => live.tell("undo", { again: true });
    addEventListener("keydown", (event) => {
      if (!(event.ctrlKey || event.metaKey) || !/^Key[YZ]$/.test(event.code) || event.target.closest?.("input:not([type=range])")) return;
      event.preventDefault();
      live.tell("undo", { again: event.code === "KeyY" || event.shiftKey });
    });
    at("map").onchange = () => live.tell("map", { map: at("map").value });
    at("gentle").onclick = () => live.tell("preset", { name: "gentle" });
    at("keep").onsubmit = (event) => {
      event.preventDefault();
      this.keep(at("keep-name").value.trim().replace(/\s+/g, " "));
    };
    at("save-style").onclick = () => this.save("/style", { shown: live.stage.to });
    at("open-style").onclick = () => at("style-file").click();
    at("style-file").onchange = () => this.openStyle(at("style-file").files[0]);
    at("add-key").onclick = () => live.tell("key", { action: "add", camera: live.camera(), shown: live.stage.to });
    at("play").onclick = () => this.play();
    at("make-film").onclick = () => this.makeFilm();
    at("save-ply").onclick = () => this.saveScene();
    at("save-picture").onclick = () => this.savePicture();
  }

  /** Keep the look of now; of a name that is there already it is asked. */
  keep(name) {
    const tell = (more = {}) => this.live.tell("keep", { name, action: "keep", ...more });
    if (!this.live.state.kept.includes(name)) tell();
    else question(`There is a look called “${name}”.`, { "Replace it": () => tell({ replace: true }) });
  }

  /** Numbers outside of a field's range are said, not sent. @returns {?number} */
  limited(field, what) {
    const value = field.valueAsNumber;
    if (value >= +field.min && value <= +field.max) return value;
    say(`${what}: ${field.value || "nothing"} is no number from ${field.min} to ${field.max}.`, true);
    field.focus();
    return null;
  }

  makeFilm() {
    const seconds = this.limited(at("seconds"), "Seconds from key to key");
    if (seconds !== null) this.live.tell("film", { seconds, side: +at("film-side").value, fps: +at("film-fps").value });
  }

  /**
   * Fetch what the server makes and save it; what it says against it is shown.
   * @param {string} path
   * @param {Object<string, string>} query
   * @param {string} what
   */
  async save(path, query, what = "style") {
    wait("save", `Preparing the ${what} …`);
    try {
      const answer = await asked(`${path}?${new URLSearchParams(query)}`);
      if (!answer.ok) throw new Error((await answer.text()).trim());
      const name = /filename\*?=(?:utf-8'')?"?([^";]+)/i.exec(answer.headers.get("content-disposition") ?? "")?.[1] ?? what;
      const blob = await counted(answer, (share) => wait("save", `Fetching the ${what} …`, share));
      download(URL.createObjectURL(blob), decodeURIComponent(name));
    } catch (error) {
      say(error.message, true);
    }
    wait("save");
  }

  /** The scene as it is shown: in its look, or so far on the way to it. */
  saveScene() {
    const { from, to, amount, wiping } = this.live.stage;
    if (this.live.state.map !== "none") say("The file holds the look; the map is on this page alone.");
    const percent = wiping ? 100 : Math.round(100 * amount);
    return this.save("/gaussians", { shown: to, start: from, percent, format: at("format").value.slice(1) }, "scene");
  }

  /** Take up a style that was saved. @param {?File} file */
  async openStyle(file) {
    at("style-file").value = "";
    if (!file) return;
    wait("style", `Taking up ${file.name} …`);
    try {
      this.live.changed = true;
      await post("/style", file);
    } catch (error) {
      say(`${file.name}: ${error.message}`, true);
    }
    wait("style");
  }

  /** The number beside a slider. */
  number(slider) {
    const output = slider.parentElement.querySelector("output");
    if (output) output.textContent = (+slider.value).toFixed(+slider.step < 1 ? 2 : 0);
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
      const moving = slider === document.activeElement && slider.matches(":active");
      if (!moving) slider.value = state.look[name];
      this.number(slider);
    }
    at("undo").disabled = !state.undo;
    at("redo").disabled = !state.redo;
    at("keeps").textContent = state.keeps ? `Looks, photographs and film are kept in ${state.keeps}` : "Nothing is kept of this scene: it has no folder.";
    at("map").value = state.map;
    at("hint").hidden = !state.shelf.length || Boolean(state.picked);
    this.fillRegion(state.picked, state.shelf);
    // Looks that were kept: where browsers draw they come with their colours.
    const { scene, stage } = this.live;
    if (scene && !scene.gaussians && stage) state.kept.forEach((name) => stage.add({ name }));
    for (const { name } of [...(stage?.styles ?? [])]) {
      if (!["Captured", "Now", ...state.kept].includes(name)) stage.remove(name);
    }
    this.fillKept(state.kept);
    this.fillFilm(state.keys, state.film);
  }

  /** Looks that were kept. @param {string[]} names */
  fillKept(names) {
    const button = (text, title, onclick, className = "pill") => make("button", { type: "button", className, textContent: text, title, ariaLabel: title, onclick });
    const remove = (name) => button("×", `forget ${name}`, () => this.live.tell("keep", { name, action: "remove" }), "close");
    at("kept").replaceChildren(...names.map((name) => make("div", { className: "row" },
      make("span", { textContent: name }), button("use", `use ${name}`, () => this.use(name)), remove(name))));
  }

  /** Go on from a look that was kept. */
  use(name) {
    this.live.tell("keep", { name, action: "restore" });
    this.live.stage.choose("Now");
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
    const close = make("button", { type: "button", className: "close", textContent: "×", title: "remove", ariaLabel: `remove ${row.name}`, onclick: () => tell("remove") });
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
    const close = make("button", { type: "button", className: "close", textContent: "×", title: "close", ariaLabel: "close", onclick: () => tell("close") });
    const head = make("p", {}, make("b", { textContent: "This thing" }), ` ${(100 * picked.share).toFixed(1)} % of the scene`, close);
    const taken = new Map(picked.taken.map((row) => [row.name, row.share]));
    const rows = shelf.map(({ name, card }) => {
      const share = taken.has(name) ? `${Math.round(100 * taken.get(name))} %` : "";
      const only = pill("only this", "pin", card, ruled("pin", card));
      const never = pill("never", "forbid", card, ruled("forbid", card));
      const much = make("data", { value: taken.get(name) ?? 0, textContent: share });
      return make("div", { className: "row" }, make("span", { textContent: name, title: name }), much, only, never);
    });
    const keep = pill("keep as it is", "keep", null, ruled("keep", null));
    const free = pill("as the style decides", "free", null, false);
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
    const button = (text, title, onclick) => make("button", { type: "button", textContent: text, title, ariaLabel: `key ${number + 1}: ${title}`, onclick });
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

  /** What is seen, once, twice or four times as large; WebGL keeps no picture, so it is drawn once more. */
  async savePicture() {
    const { place, scene, stage } = this.live;
    const { canvas, splats } = place;
    const by = +at("scale").value;
    const name = `${scene.name}.png`;
    if (!splats) {
      const side = Math.min(MAX_PAINTED, by * Math.max(canvas.width, canvas.height));
      return this.savePainted({ camera: this.live.camera(), side, shown: stage.to, wipe: place.wipe }, name);
    }
    if (place.lost) {
      say(LOST, true);
      return undefined;
    }
    const most = Math.min(MAX_PICTURE, splats.gl.getParameter(splats.gl.MAX_TEXTURE_SIZE));
    const size = [canvas.width * by, canvas.height * by];
    if (Math.max(...size) > most) {
      say(`${size.join(" × ")} pixels are more than the ${most} a side that can be drawn here; choose a smaller size.`, true);
      return undefined;
    }
    wait("picture", `Drawing ${size.join(" × ")} pixels …`);
    await new Promise((done) => setTimeout(done, 50)); // the words come first
    [canvas.width, canvas.height] = size;
    place.paint();
    const blob = await new Promise((done) => canvas.toBlob(done));
    place.resize();
    place.touch();
    wait("picture");
    return download(URL.createObjectURL(blob), name);
  }

  /** A picture of a scene that the server draws. */
  async savePainted(picture, name) {
    wait("picture", `Drawing ${picture.side} pixels …`);
    try {
      const answer = await asked("/picture", { method: "POST", body: JSON.stringify({ type: "picture", ...picture }) });
      if (!answer.ok) throw new Error((await answer.text()).trim());
      download(URL.createObjectURL(await answer.blob()), name);
    } catch (error) {
      say(error.message, true);
    }
    wait("picture");
  }
}
