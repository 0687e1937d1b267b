// The page of `fprf view`: the same stage with the scene of a server, which hears small messages and answers with colours.
// This file has the connection and the scene that it shows; panel.js has the controls beside it, field.js the pictures
// that a server draws, photographs.js what is dropped, start.js the page before there is a scene.

const RECONNECT_MS = 1500; // until a lost connection is tried again; by eye
const NOTE_MS = 6000; // that a note stays; by eye
const MAX_NOTES = 4; // at the same time; by eye
const PREVIEW_PIXELS = 320; // longest side of the picture in the list of scenes; by eye

/**
 * The head of a scene, as the server tells it (session.py).
 * @typedef {{key: string, name: string, step: number, gaussians: boolean}} SceneInfo
 *
 * A camera in messages (messages.py): place and axes in the world, fx fy cx cy, width and height.
 * @typedef {{place: number[], axes: number[][], lens: number[], size: number[]}} CameraMessage
 *
 * What all pages share (state.py).
 * @typedef {{card: number, name: string, weight: number, colour: ?string}} ShelfRow
 * @typedef {{region: number, share: number, taken: {name: string, share: number}[], rules: {action: string, card: ?number}[]}} PickedRegion
 * @typedef {{shelf: ShelfRow[], look: Object<string, number>, map: string, picked: ?PickedRegion, kept: string[],
 *   keys: CameraMessage[], film: {done: number, total: number, ready: boolean}, defaults: Object<string, number>,
 *   undo: boolean, redo: boolean, keeps: string}} SharedState
 */

const NO_ANSWER = "the viewer does not answer; is `fprf view` still running? This is tried again by itself.";

/**
 * Ask the server.
 * @param {string} path
 * @param {RequestInit=} init
 * @returns {Promise<Response>} an error in words where nobody answers
 */
const asked = async (path, init) => {
  try {
    return await fetch(path, init);
  } catch {
    throw new Error(NO_ANSWER);
  }
};

/**
 * Send a body to the server.
 * @param {string} path
 * @param {BodyInit=} body
 * @returns {Promise<any>} the JSON that it answers; an error with its words where it refuses
 */
const post = async (path, body) => {
  const answer = await asked(path, { method: "POST", body });
  if (!answer.ok) throw new Error((await answer.text()).trim() || answer.statusText);
  return answer.json();
};

/**
 * Show a note. What is wrong stays until it is clicked away.
 * @param {string} text
 * @param {boolean=} bad
 * @returns {HTMLButtonElement}
 */
const say = (text, bad = false) => {
  const close = () => line.remove();
  const line = make("button", { type: "button", textContent: text, className: bad ? "bad" : "", title: "close", onclick: close });
  at("said").append(line);
  const notes = at("said").querySelectorAll("button");
  for (const old of [...notes].slice(0, -MAX_NOTES)) old.remove();
  if (!bad) setTimeout(close, NOTE_MS);
  return line;
};

/** What takes its time, by its kind: lines that stay until it is done. @type {Map<string, HTMLElement>} */
const waits = new Map();

/**
 * Show how far something is; without words it is done.
 * @param {string} kind
 * @param {string=} what
 * @param {?number=} share in [0, 1]; null = not known
 */
const wait = (kind, what = "", share = null) => {
  let line = waits.get(kind);
  if (!what) {
    line?.remove();
    waits.delete(kind);
    return;
  }
  if (!line) {
    line = make("div", { className: "wait" }, make("span"), make("progress", { max: 1 }));
    waits.set(kind, line);
    at("said").prepend(line);
  }
  const [text, bar] = line.children;
  text.textContent = what;
  if (share === null) bar.removeAttribute("value");
  else bar.value = share;
};

/**
 * Ask before something is lost.
 * @param {string} question
 * @param {Object<string, () => void>} answers what is done, by its word
 * @param {...HTMLElement} more fields of the question
 */
const question = (text, answers, ...more) => {
  const box = make("dialog", { className: "ask" }, make("p", { textContent: text }), ...more);
  const row = make("div", { className: "row" });
  for (const [word, act] of Object.entries({ ...answers, Cancel: () => {} })) {
    row.append(make("button", { type: "button", className: "pill", textContent: word, onclick: () => { box.close(); act(); } }));
  }
  box.append(row);
  box.onclose = () => box.remove();
  (document.fullscreenElement ?? document.body).append(box);
  box.showModal();
};

/**
 * JSON and sections of one body (pack.py): bytes of the head as a number of four bytes, the head, the sections.
 * @param {Response} answer
 * @param {(share: ?number) => void=} tell how much of it has come
 * @returns {Promise<{head: any, parts: Object<string, Uint8Array>}>}
 */
const unpacked = async (answer, tell = () => {}) => {
  if (!answer.ok) throw new Error((await answer.text()).trim());
  const data = new Uint8Array(await (await counted(answer, tell)).arrayBuffer());
  const length = new DataView(data.buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(data.subarray(4, 4 + length)));
  const parts = {};
  let from = 4 + length;
  for (const [name, size] of Object.entries(head.sizes)) {
    parts[name] = data.subarray(from, from + size);
    from += size;
  }
  return { head, parts };
};

/**
 * The body of an answer, with how much of it has come.
 * @param {Response} answer
 * @param {(share: ?number) => void} tell
 * @returns {Promise<Blob>}
 */
const counted = async (answer, tell) => {
  const total = Number(answer.headers.get("content-length"));
  const parts = [];
  let done = 0;
  for (const reader = answer.body.getReader(); ;) {
    const { value, done: ended } = await reader.read();
    if (ended) return new Blob(parts);
    parts.push(value);
    done += value.length;
    tell(total ? done / total : null);
  }
};

/** Let the browser save a file. */
const download = (href, name = "") => {
  const link = make("a", { href, download: name });
  document.body.append(link);
  link.click();
  link.remove();
};

/** The connection to the server, and the scene that it shows. */
class Live {
  constructor() {
    /** @type {?Place} where one stands in the scene */
    this.place = null;
    /** @type {?Stage} the controls of its looks */
    this.stage = null;
    /** @type {?SceneInfo} */
    this.scene = null;
    /** @type {?SharedState} as the server told it last */
    this.state = null;
    // What was heard is done one after the other: some of it takes further requests.
    this.queue = Promise.resolve();
    // True from what was changed on this page until its colours have come.
    this.changed = false;
    this.start = new Start();
    this.field = new Field(this);
    this.panel = new Panel(this);
    this.photographs = new Photographs(this);
    at("finish").onclick = () => this.start.stop();
    at("scenes").onclick = () => this.leave();
    // What fills the screen shows messages too.
    addEventListener("fullscreenchange", () => (document.fullscreenElement ?? document.body).append(at("said"), at("veil")));
    this.mode("loading");
    this.connect();
  }

  connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.socket = new WebSocket(`${scheme}://${location.host}/live`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = ({ data }) => {
      this.queue = this.queue.then(() => this.hear(data)).catch((error) => say(error.message, true));
    };
    this.socket.onopen = () => {
      if (waits.has("connection")) say("Connected again.");
      wait("connection");
    };
    this.socket.onclose = () => {
      wait("connection", "Connection lost. It is tried again until the viewer answers; nothing can be changed meanwhile.");
      setTimeout(() => this.connect(), RECONNECT_MS);
    };
  }

  /** Back to the list of scenes. */
  async leave() {
    wait("leaving", "Closing the scene; what there is is being saved");
    try {
      await post("/start", JSON.stringify({ type: "leave" }));
    } catch (error) {
      wait("leaving");
      say(error.message, true);
    }
  }

  get connected() { return this.socket.readyState === WebSocket.OPEN; }

  /** Send a message (messages.py). */
  tell(type, more = {}) {
    if (!this.connected) {
      // The camera asks again by itself; what somebody wanted done has to be told.
      if (type !== "view") say("That was not done: there is no connection to the viewer.", true);
      if (this.state) this.panel.fill(this.state);
      return;
    }
    if (["set", "preset", "card", "map", "region", "undo", "sun"].includes(type)) this.changed = true;
    this.socket.send(JSON.stringify({ type, ...more }));
  }

  /**
   * Do what a message says: bytes are a picture, all others JSON.
   * @param {string|ArrayBuffer} data
   */
  async hear(data) {
    if (typeof data !== "string") {
      await this.field.paint(new Uint8Array(data));
      return;
    }
    const message = JSON.parse(data);
    switch (message.type) {
      case "said": say(message.text, message.bad); break;
      case "start": this.began(message); break;
      case "wait": wait(message.kind, message.what, message.share); break;
      case "loading": this.mode("loading"); break;
      case "scene": await this.open(message); break;
      case "training": this.trained(message); break;
      case "colours": await this.recolour(message); break;
      case "light":
        await this.sun.relight(message);
        if (message.name === "Now" && message.version !== null) this.thrust("Now");
        break;
      case "state":
        this.state = message;
        this.panel.fill(message);
        this.sun?.fill(message.sun);
        break;
    }
  }

  /** How far the start is; with a scene of its own, which may still be trained. */
  began(message) {
    if (!this.scene) {
      this.mode("start");
      this.start.fill(message);
      return;
    }
    if (message.stage === "idle") {
      location.reload();
      return;
    }
    at("scenes").hidden = false;
    at("finish").hidden = message.stage !== "training" || Boolean(message.error);
    if (message.error) say(message.error, true);
  }

  /** Show one part of the page: start, scene or loading. */
  mode(name) {
    for (const each of ["start", "scene", "loading"]) at(each).hidden = each !== name;
  }

  /**
   * Show a scene, or a newer state of its training.
   * @param {SceneInfo} scene
   */
  async open(scene) {
    const before = this.scene;
    if (before && before.key !== scene.key) {
      location.reload();
      return;
    }
    if (before && before.step === scene.step) { // it was only away for a moment
      this.place.touch();
      return;
    }
    const { head, parts } = await unpacked(await asked("/scene"), (share) => wait("scene", "Fetching the scene", share));
    wait("scene", "Unpacking the scene", 0);
    this.mode("scene");
    this.scene = scene;
    document.title = `${scene.name} - fprf`;
    at("title").textContent = scene.name;
    at("place").classList.toggle("field", !scene.gaussians);
    at("save-ply").hidden = !scene.gaussians;
    head.alone = true;
    let splats = null;
    if (scene.gaussians && !this.remote) {
      try {
        splats = before ? this.place.splats : new Splats(at("canvas"));
        await splats.load(head, parts);
        wait("scene", "Unpacking its colours", 0.7);
        await splats.add("Captured", head.styles[0], parts["style-0"]);
      } catch (error) {
        if (before) throw error;
        splats = null;
        this.drawThere(error.message);
      }
    }
    wait("scene");
    if (before) {
      this.place.scene = head;
      this.place.touch();
    } else this.enter(head, splats);
  }

  /** Let the server draw what this browser cannot. */
  drawThere(why) {
    explain(at("place"), `${why[0].toUpperCase()}${why.slice(1)}. The machine of the viewer draws the pictures instead; they come more slowly.`);
    const canvas = at("canvas").cloneNode(); // of one that was asked for WebGL nothing else can be had
    at("canvas").replaceWith(canvas);
    this.remote = new Remote(this);
  }

  /** Make the stage of a scene that is shown for the first time; `splats` null = the server draws. */
  enter(head, splats) {
    this.place = new Place(at("canvas"), head, splats, splats ? null : () => (this.remote ?? this.field).step());
    this.place.listeners.lost = (lost) => {
      at("place").classList.toggle("drawn", !lost);
      explain(at("place"), lost ? LOST : "");
    };
    this.place.listeners.pick = (x, y) => {
      if (!this.state?.shelf.length) return; // nothing could be said about what is picked
      const box = at("canvas").getBoundingClientRect();
      this.tell("pick", { camera: this.camera(), x: (x - box.left) / box.width, y: (y - box.top) / box.height });
    };
    this.place.listeners.drawn = (rest) => {
      at("place").classList.add("drawn");
      if (rest) this.preview();
    };
    this.stage = new Stage(this.place, [{ name: "Captured" }]);
    if (!splats && !this.remote) {
      this.stage.add({ name: "Now" });
      this.stage.choose("Now");
    }
    if (this.scene.gaussians) this.sun = new LiveSun(this);
    this.stage.listeners.unfolded = (id) => { if (id === "light" && !at("lighting").hidden) this.sun?.open(); };
    this.stage.listeners.escape = () => {
      if (this.state?.picked) this.tell("region", { action: "close" });
    };
    this.stage.listeners.chosen = (name) => {
      if (this.state?.kept.includes(name)) this.tell("keep", { name, action: "restore" });
    };
    this.stage.sending.read();
    // Where others may connect, their address, and its code.
    fetch("/address").then(async (answer) => { if (answer.ok) this.stage.sending.share(await answer.text()); }, () => {});
    window.fprf = { place: this.place, stage: this.stage, live: this };
  }

  /** A small picture of what is shown, once, for the list of scenes. */
  preview() {
    const { place, scene } = this;
    if (this.previewed === scene.step || !place.splats) return;
    this.previewed = scene.step;
    const { canvas } = place;
    const by = PREVIEW_PIXELS / Math.max(canvas.width, canvas.height);
    const small = make("canvas", { width: Math.max(1, Math.round(by * canvas.width)), height: Math.max(1, Math.round(by * canvas.height)) });
    place.paint();
    small.getContext("2d").drawImage(canvas, 0, 0, small.width, small.height);
    small.toBlob((blob) => {
      // It stands in, too, where the graphics card drops the picture.
      const still = document.querySelector(".still.one");
      URL.revokeObjectURL(still.src);
      still.src = URL.createObjectURL(blob);
      still.hidden = false;
      post("/preview", blob).catch(() => {});
    }, "image/jpeg");
  }

  /** Progress of the scene's training. */
  trained({ step, share, psnr, seconds_left: left }) {
    const clock = `${Math.floor(left / 60)}:${String(left % 60).padStart(2, "0")} left`;
    const [bar, text] = at("training").children;
    at("training").hidden = false;
    bar.value = share;
    text.textContent = share < 1 ? `training, ${clock}` : "trained";
    text.title = `step ${step}, ${psnr.toFixed(1)} dB on the photographs`;
  }

  /** Fetch colours that the server has made, under a name of the stage. */
  async recolour({ name, version }) {
    if (this.remote) this.remote.stale = true;
    const address = `/colours?name=${encodeURIComponent(name)}&version=${version}`;
    if (this.place.splats) {
      const { head, parts } = await unpacked(await asked(address));
      await this.place.splats.add(name, head, parts.rows);
    }
    this.place.touch(false);
    const fresh = !this.stage.styles.some((style) => style.name === name);
    this.stage.add({ name });
    if (fresh && this.stage.sending.asked === name) this.stage.choose(name);
    if (name === "Now") this.thrust(name, fresh);
  }

  /** What was changed here is seen here; what others change is not thrust upon this page. */
  thrust(name, fresh = false) {
    const { styles, from, to, wiping, amount } = this.stage;
    if (!styles.some((style) => style.name === name)) return; // its colours come later
    const compared = from === name && (wiping || amount < 1);
    if (fresh || (this.changed && to !== name && !compared)) this.stage.choose(name);
    this.changed = false;
  }

  /** @returns {CameraMessage} where one stands now */
  camera() {
    const { camera, canvas, lens } = this.place;
    return { place: camera.place, axes: camera.axes, lens, size: [canvas.width, canvas.height] };
  }

  /**
   * @param {CameraMessage} key
   * @returns {Camera} to go to
   */
  keyed(key) {
    const { axes, place, lens, size } = key;
    const view = Object.create(Camera.prototype);
    return Object.assign(view, { axes, place, lens, size, distance: this.place.camera.distance });
  }
}

const live = () => new Live();
