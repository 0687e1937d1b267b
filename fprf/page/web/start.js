// Before a scene is open: files are sent in pieces, then the progress of the scene is shown until it takes this place.

const PIECE_BYTES = 8 << 20;
const ORDER = ["files", "poses", "training", "opening", "open"];
const MAX_STRIP = 24; // small pictures of what is sent; by eye
const MAX_REFUSED = 3; // files that were left out, and are named

/**
 * A scene of the list (start.py): its names, its kind, when it was made; what can be done with it.
 * @typedef {{name: string, path: string, kind: string, when: string, more?: string, scene?: string}} RecentScene
 *
 * How far a scene is (start.py).
 * @typedef {{stage: string, name: string, what: string, share: number?, detail: string, error?: string, lines?: string[],
 *   folder?: string, garden?: string, sending?: string, recent: RecentScene[]}} StartState
 *
 * What is being sent from here.
 * @typedef {StartState & {scene: string, stopped: boolean}} SendingState
 */

/** The page before a scene is open: what can become one, what was made before, and how far the next one is. */
class Start {
  constructor() {
    /** @type {SendingState?} */
    this.sending = null;
    /** @type {StartState?} as the server told it last */
    this.told = null;
    this.garden = ""; // where its photographs lie
    at("pick-files").onclick = () => at("files").click();
    at("pick-folder").onclick = () => at("folder").click();
    at("files").onchange = () => this.take(at("files"));
    at("folder").onchange = () => this.take(at("folder"));
    at("path").onsubmit = (event) => {
      event.preventDefault();
      this.open(at("path-of").value);
    };
    at("open-garden").onclick = () => this.open(this.garden);
    at("stop").onclick = () => this.stop();
    at("minutes").onchange = () => this.attempt(async () => { this.minutes(); });
    // Leaving would throw away what has been sent so far.
    addEventListener("beforeunload", (event) => { if (this.sending) event.preventDefault(); });
    addEventListener("pagehide", () => {
      if (this.sending?.scene) navigator.sendBeacon("/start", JSON.stringify({ type: "discard", scene: this.sending.scene }));
    });
  }

  /** Minutes of training; an error in words for what is none. @returns {number} */
  minutes() {
    const field = at("minutes");
    const value = field.valueAsNumber;
    if (value >= Number(field.min) && value <= Number(field.max)) return value;
    field.focus();
    throw new Error(`Training takes from ${field.min} to ${field.max} minutes; ${field.value || "nothing"} is none of these.`);
  }

  /** @param {HTMLInputElement} field */
  async take(field) {
    await this.attempt(() => this.send(chosen(field.files)));
    field.value = "";
  }

  /** @param {DataTransfer} data */
  drop(data) {
    if (!at("choose").hidden) this.attempt(async () => this.send(await carried(data)));
  }

  /** Say what is wrong; without words nothing is. @param {string} text */
  fault(text) {
    at("fault").textContent = text;
    at("fault").hidden = !text;
    if (text) scrollTo(0, 0);
  }

  /** Do something, or say what is wrong with it. @param {() => Promise<void>} act */
  async attempt(act) {
    this.fault("");
    try {
      await act();
    } catch (error) {
      this.fault(wordsOf(error));
    }
  }

  /** @param {string} type @param {object} more */
  ask(type, more = {}) { return post("/start", JSON.stringify({ type, ...more })); }

  /** @param {string} path */
  open(path) { return this.attempt(() => this.ask("open", { path, minutes: this.minutes() })); }

  stop() {
    return this.attempt(async () => {
      if (this.sending) {
        this.sending.stopped = true;
        return;
      }
      below(at("what"), "b").textContent = "ending it; what there is is being saved";
      await this.ask("stop");
    });
  }

  /** Send files, and make a scene of them. @param {NamedFile[]} given */
  async send(given) {
    const { rows, top } = tidy(given);
    if (!rows.length || this.sending) return;
    const minutes = this.minutes();
    const name = top || rows[0].name.replace(/\.[^.]*$/, "");
    const { scene } = await this.ask("new", { name: rows.length > 1 && !top ? "photographs" : name });
    /** @type {SendingState} */
    const sending = { scene, name: scene, stage: "files", what: "sending", share: 0, detail: "", recent: [], stopped: false };
    this.sending = sending;
    this.fillStrip(rows);
    this.fill(sending);
    try {
      const refused = await this.sendAll(rows, sending);
      if (sending.stopped || refused.length === rows.length) await this.ask("discard", { scene });
      if (sending.stopped) return;
      if (refused.length === rows.length) throw new Error(refused[0]);
      await this.ask("make", { scene, minutes });
      const more = refused.length > MAX_REFUSED ? `; and ${refused.length - MAX_REFUSED} more` : "";
      if (refused.length) this.fault(`Left out: ${refused.slice(0, MAX_REFUSED).join("; ")}${more}`);
    } finally {
      this.sending = null;
      if (this.told) this.fill(this.told);
    }
  }

  /**
   * Send all files, until somebody stops it.
   * @param {NamedFile[]} rows
   * @param {SendingState} sending
   * @returns {Promise<string[]>} what was said against those that were refused
   */
  async sendAll(rows, sending) {
    const total = rows.reduce((sum, { file }) => sum + file.size, 0) || 1;
    const refused = [];
    let done = 0;
    for (const [k, { name, file }] of rows.entries()) {
      if (sending.stopped) break;
      sending.detail = `${k + 1} of ${rows.length}`;
      try {
        await this.sendOne(name, file, sending, (bytes) => {
          sending.share = (done + bytes) / total;
          this.fill(sending);
        });
      } catch (error) {
        if (wordsOf(error) === NO_ANSWER) throw error;
        refused.push(wordsOf(error));
      }
      done += file.size;
    }
    return refused;
  }

  /**
   * Send a file in pieces.
   * @param {string} name
   * @param {File} file
   * @param {SendingState} sending
   * @param {(bytes: number) => void} tell how much of it was sent
   */
  async sendOne(name, file, sending, tell) {
    for (let begin = 0; begin < file.size || begin === 0; begin += PIECE_BYTES) {
      if (sending.stopped) return;
      const query = new URLSearchParams({ scene: sending.scene, name, at: String(begin), size: String(file.size) });
      await post(`/start/piece?${query}`, file.slice(begin, begin + PIECE_BYTES));
      tell(Math.min(file.size, begin + PIECE_BYTES));
    }
  }

  /** Small pictures of what is sent. @param {NamedFile[]} rows */
  fillStrip(rows) {
    const pictures = rows.filter(({ file }) => /^image\/(jpeg|png|webp|avif|bmp)$/.test(file.type));
    const step = Math.max(1, Math.ceil(pictures.length / MAX_STRIP));
    const some = pictures.filter((_, k) => k % step === 0);
    at("strip").replaceChildren(...some.map(({ file }) => {
      const image = make("img", { src: URL.createObjectURL(file), alt: "" });
      image.onload = () => URL.revokeObjectURL(image.src);
      image.onerror = () => image.remove();
      return image;
    }));
  }

  /** A scene of the list, with what can be done with it. @param {RecentScene} row */
  row(row) {
    const image = make("img", { src: `/start/preview?${new URLSearchParams({ name: row.name })}`, alt: "", loading: "lazy" });
    image.onerror = () => image.replaceWith(make("span", { className: "blank" }));
    const open = make("button", { type: "button", className: "open", title: row.path, onclick: () => this.open(row.path) },
      image, make("b", { textContent: row.name }), make("small", { textContent: `${row.kind}, ${row.when}` }));
    const acts = make("div", { className: "acts" });
    const offer = (/** @type {string} */ word, /** @type {string} */ title, /** @type {() => void} */ onclick) => acts.append(
      make("button", { type: "button", className: "small", textContent: word, title, ariaLabel: `${word} ${row.name}`, onclick }));
    const { more, scene } = row;
    if (more) offer("Train on", "Go on with its training, for the minutes that are set above", () => this.open(more));
    if (scene) {
      offer("Rename", "Give it another name", () => this.rename(scene));
      offer("Delete", "Delete it with all that was made of it", () => this.remove(row.name, scene));
    }
    return make("li", {}, open, acts);
  }

  /** @param {string} name @param {string} scene */
  remove(name, scene) {
    question(`Delete “${name}”, with its photographs, its training and all that was made of it?`, {
      Delete: () => this.attempt(() => this.ask("remove", { scene })),
    });
  }

  /** @param {string} scene */
  rename(scene) {
    const field = make("input", { value: scene, maxLength: 40, ariaLabel: "New name" });
    question(`A new name for “${scene}”:`, {
      Rename: () => this.attempt(() => this.ask("rename", { scene, name: field.value.trim() })),
    }, field);
    field.select();
  }

  /** How far it is, as the server told or as this page knows of what it sends. @param {StartState} told */
  fill(told) {
    if (told !== this.sending) this.told = told;
    const state = this.sending ?? told;
    const idle = state.stage === "idle";
    at("choose").hidden = !idle;
    at("making").hidden = idle;
    if (idle) this.fillChoice(state);
    else this.fillMaking(state);
  }

  /** What can become a scene. @param {StartState} state */
  fillChoice({ garden, sending, recent }) {
    if (garden) this.garden = garden;
    at("strip").replaceChildren();
    at("busy").hidden = !sending;
    at("busy").textContent = sending ? `“${sending}” is being sent from another page. One scene is made at a time: wait until it is there.` : "";
    at("recent").hidden = !recent.length;
    below(at("recent"), "ul").replaceChildren(...recent.map((row) => this.row(row)));
  }

  /** How far a scene is. @param {StartState} state */
  fillMaking({ name, stage, error, what, detail, share, lines = [], folder = "" }) {
    at("name").textContent = name;
    for (const item of every("#stages li", HTMLElement)) {
      const place = ORDER.indexOf(item.dataset.stage ?? "");
      const now = ORDER.indexOf(stage);
      item.className = place < now ? "done" : "";
      if (place === now) item.className = "now";
    }
    if (error) this.fault(error);
    at("what").hidden = Boolean(error);
    at("bar").hidden = Boolean(error);
    below(at("what"), "b").textContent = what;
    below(at("what"), "span").textContent = detail;
    at("bar").className = share === null ? "busy" : "";
    below(at("bar"), "i").style.width = `${100 * (share ?? 0)}%`;
    at("stop").textContent = error ? "Back" : "Stop";
    at("stop").hidden = ["opening", "open"].includes(stage) && !error;
    at("lines").hidden = !lines.length;
    below(at("lines"), "pre").textContent = lines.join("\n");
    below(at("making"), ".where").hidden = !folder;
    below(at("making"), ".where code").textContent = folder;
  }
}
