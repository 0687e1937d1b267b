// The page of `fprf view`: the same stage with the scene of a server, which hears small messages and answers with colours.
// This file has the connection and the scene that it shows; panel.js has the controls beside it, field.js the pictures
// that a server draws, photographs.js what is dropped, start.js the page before there is a scene.

const RECONNECT_MS = 1500; // until a lost connection is tried again; by eye
const PREVIEW_PIXELS = 320; // longest side of the picture in the list of scenes; by eye
/** @type {[number, number]} pixels of the small picture of a style */
const PORTRAIT = [192, 144];
const MAX_PORTRAYED = 500_000; // Gaussians; more would keep a machine without a graphics card busy for seconds; by eye
/** Messages that change how the scene looks. */
const CHANGES = ["set", "preset", "card", "map", "region", "undo", "sun"];

/**
 * The head of a scene, as the server tells it (session.py).
 * @typedef {{key: string, name: string, step: number, gaussians: boolean}} SceneInfo
 *
 * A camera in messages (messages.py): place and axes in the world, fx fy cx cy, width and height.
 * @typedef {{place: Vector, axes: Vector[], lens: Lens, size: [number, number]}} CameraMessage
 *
 * What all pages share (state.py).
 * @typedef {{card: number, name: string, weight: number, colour: string?}} ShelfRow
 * @typedef {{action: string, card: number?}} Rule
 * @typedef {{region: number, share: number, taken: {name: string, share: number}[], rules: Rule[]}} PickedRegion
 * @typedef {{done: number, total: number, ready: boolean}} FilmState
 * @typedef {{light: string?, sun: [number, number]?, from: string, strength: number}} SunState
 * @typedef {{shelf: ShelfRow[], look: Object<string, number>, map: string, picked: PickedRegion?, kept: string[],
 *   keys: CameraMessage[], film: FilmState, defaults: Object<string, number>, undo: boolean, redo: boolean,
 *   keeps: string, sun: SunState}} SharedState
 *
 * A scene that is shown: what it is, where one stands in it, the controls of its looks.
 * @typedef {{scene: SceneInfo, place: Place, stage: Stage}} Opened
 */

/** The connection to the server, and the scene that it shows. */
class Live {
  constructor() {
    /** @type {Opened?} */
    this.opened = null;
    /** @type {SharedState?} as the server told it last */
    this.state = null;
    /** @type {LiveSun?} of a scene of Gaussians */
    this.sun = null;
    /** @type {Remote?} where this browser draws no Gaussians */
    this.remote = null;
    // What was heard is done one after the other: some of it takes further requests.
    this.queue = Promise.resolve();
    // True from what was changed on this page until its colours have come.
    this.changed = false;
    /** @type {Set<string>} styles whose small pictures are older than their colours */
    this.stale = new Set(["Captured"]);
    this.previewed = -1; // step of the training whose small picture was sent
    this.start = new Start();
    this.field = new Field(this);
    this.panel = new Panel(this);
    this.photographs = new Photographs(this);
    at("finish").onclick = () => this.start.stop();
    at("scenes").onclick = () => this.leave();
    // What fills the screen shows messages too.
    addEventListener("fullscreenchange", () => (document.fullscreenElement ?? document.body).append(at("said"), at("veil")));
    this.mode("loading");
    this.socket = this.connect();
  }

  /** The scene that is shown: asked for where there is one. @returns {Opened} */
  get shown() {
    if (!this.opened) throw new Error("no scene is open");
    return this.opened;
  }

  get scene() { return this.opened?.scene ?? null; }

  get place() { return this.shown.place; }

  get stage() { return this.shown.stage; }

  /** @returns {SharedState} asked for where there is one */
  get known() {
    if (!this.state) throw new Error("the viewer has not said how the scene looks");
    return this.state;
  }

  connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/live`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => {
      this.queue = this.queue.then(() => this.hear(data)).catch((error) => { say(wordsOf(error), true); });
    };
    socket.onopen = () => {
      if (waits.has("connection")) say("Connected again.");
      wait("connection");
    };
    socket.onclose = () => {
      wait("connection", "Connection lost. It is tried again until the viewer answers; nothing can be changed meanwhile.");
      setTimeout(() => { this.socket = this.connect(); }, RECONNECT_MS);
    };
    return socket;
  }

  /** Back to the list of scenes. */
  async leave() {
    wait("leaving", "Closing the scene; what there is is being saved");
    try {
      await post("/start", JSON.stringify({ type: "leave" }));
    } catch (error) {
      wait("leaving");
      say(wordsOf(error), true);
    }
  }

  get connected() { return this.socket.readyState === WebSocket.OPEN; }

  /** Send a message (messages.py). @param {string} type @param {object} more */
  tell(type, more = {}) {
    if (!this.connected) {
      // The camera asks again by itself; what somebody wanted done has to be told.
      if (type !== "view") say("That was not done: there is no connection to the viewer.", true);
      if (this.state) this.panel.fill(this.state);
      return;
    }
    if (CHANGES.includes(type)) this.changed = true;
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
        await this.sun?.relight(message);
        this.stale.add(message.name);
        if (message.name === "Now" && message.version !== null) this.thrust("Now");
        break;
      case "state":
        this.state = message;
        this.panel.fill(message);
        this.sun?.fill();
        break;
    }
  }

  /** How far the start is; with a scene of its own, which may still be trained. @param {StartState} message */
  began(message) {
    if (!this.opened) {
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

  /** Show one part of the page. @param {"start"|"scene"|"loading"} name */
  mode(name) {
    for (const each of ["start", "scene", "loading"]) at(each).hidden = each !== name;
  }

  /**
   * Show a scene, or a newer state of its training.
   * @param {SceneInfo} scene
   */
  async open(scene) {
    const before = this.opened;
    if (before && before.scene.key !== scene.key) {
      location.reload();
      return;
    }
    if (before && before.scene.step === scene.step) { // it was only away for a moment
      before.place.touch();
      return;
    }
    const { head, parts } = await unpacked(await asked("/scene"), (share) => wait("scene", "Fetching the scene", share));
    wait("scene", "Unpacking the scene", 0);
    this.mode("scene");
    head.alone = true;
    if (before) await this.renew(before, scene, head, parts);
    else this.enter(scene, head, await this.splatsOf(scene, head, parts));
    wait("scene");
  }

  /**
   * A newer state of the training of the scene that is shown.
   * @param {Opened} opened
   * @param {SceneInfo} scene
   * @param {SplatHead & PlaceHead & {styles: ColourHead[]}} head
   * @param {Object<string, Uint8Array<ArrayBuffer>>} parts
   */
  async renew(opened, scene, head, parts) {
    opened.scene = scene;
    const { place } = opened;
    await place.splats?.load(head, parts);
    wait("scene", "Unpacking its colours", 0.7);
    await place.splats?.add("Captured", head.styles[0], parts["style-0"]);
    place.scene = head;
    place.touch();
  }

  /**
   * Gaussians that this browser draws; null where the server does.
   * @param {SceneInfo} scene
   * @param {SplatHead & {styles: ColourHead[]}} head
   * @param {Object<string, Uint8Array<ArrayBuffer>>} parts
   */
  async splatsOf(scene, head, parts) {
    if (!scene.gaussians) return null;
    try {
      const splats = new Splats(at("canvas"));
      await splats.load(head, parts);
      wait("scene", "Unpacking its colours", 0.7);
      await splats.add("Captured", head.styles[0], parts["style-0"]);
      return splats;
    } catch (error) {
      this.drawThere(wordsOf(error));
      return null;
    }
  }

  /** Let the server draw what this browser cannot. @param {string} why */
  drawThere(why) {
    explain(at("place"), `${capital(why)}. The machine of the viewer draws the pictures instead; they come more slowly.`);
    const canvas = at("canvas").cloneNode(); // of one that was asked for WebGL nothing else can be had
    at("canvas").replaceWith(canvas);
    this.remote = new Remote(this);
  }

  /**
   * Make the stage of a scene that is shown for the first time.
   * @param {SceneInfo} scene
   * @param {PlaceHead} head
   * @param {Splats?} splats null = the server draws
   */
  enter(scene, head, splats) {
    document.title = `${scene.name} - fprf`;
    at("title").textContent = scene.name;
    at("place").classList.toggle("field", !scene.gaussians);
    at("save-ply-row").hidden = !scene.gaussians;
    const place = new Place(at("canvas"), head, splats, splats ? null : () => (this.remote ?? this.field).step());
    const stage = new Stage(place, [{ name: "Captured" }]);
    this.opened = { scene, place, stage };
    if (scene.gaussians) this.sun = new LiveSun(this);
    this.listen(place, stage);
    if (!splats && !this.remote) {
      stage.add({ name: "Now" });
      stage.choose("Now");
    }
    stage.sending.read();
    // Where others may connect, their address, and its code.
    fetch("/address").then(async (answer) => { if (answer.status === 200) stage.sending.share(await answer.text()); }, () => {});
    if (this.state) this.panel.fill(this.state);
    Object.assign(window, { fprf: { place, stage, live: this } });
  }

  /** Tell the server what is done on the stage. @param {Place} place @param {Stage} stage */
  listen(place, stage) {
    place.listeners.lost = (lost) => {
      at("place").classList.toggle("drawn", !lost);
      explain(at("place"), lost ? LOST : "");
    };
    place.listeners.pick = (x, y) => {
      if (!this.state?.shelf.length) return; // nothing could be said about what is picked
      const box = at("canvas").getBoundingClientRect();
      this.tell("pick", { camera: this.camera(), x: (x - box.left) / box.width, y: (y - box.top) / box.height });
    };
    place.listeners.drawn = (rest) => {
      at("place").classList.add("drawn");
      if (rest) this.preview();
      if (rest) this.portray(place, stage);
    };
    stage.listeners.unfolded = (id) => {
      if (id === "light" && !at("lighting").hidden) this.sun?.open();
    };
    stage.listeners.escape = () => {
      if (this.state?.picked) this.tell("region", { action: "close" });
    };
    stage.listeners.chosen = (name) => {
      if (this.state?.kept.includes(name)) this.tell("keep", { name, action: "restore" });
    };
  }

  /** A small picture of what is shown, once, for the list of scenes. */
  preview() {
    const { place, scene } = this.shown;
    if (this.previewed === scene.step || !place.splats) return;
    this.previewed = scene.step;
    const { canvas } = place;
    const by = PREVIEW_PIXELS / Math.max(canvas.width, canvas.height);
    const width = Math.max(1, Math.round(by * canvas.width));
    const height = Math.max(1, Math.round(by * canvas.height));
    const small = make("canvas", { width, height });
    place.paint();
    small.getContext("2d")?.drawImage(canvas, 0, 0, width, height);
    small.toBlob((blob) => {
      if (!blob) return;
      // It stands in, too, where the graphics card drops the picture.
      for (const still of every(".still.one", HTMLImageElement)) {
        URL.revokeObjectURL(still.src);
        still.src = URL.createObjectURL(blob);
        still.hidden = false;
      }
      post("/preview", blob).catch(() => {});
    }, "image/jpeg");
  }

  /** A small picture of one style that has new colours, from here. @param {Place} place @param {Stage} stage */
  portray({ splats, camera, scene, sky: [background, rim] }, stage) {
    const [name] = this.stale;
    if (!splats?.styles.has(name ?? "") || splats.count > MAX_PORTRAYED) return;
    this.stale.delete(name);
    const look = { first: name, second: name, blend: 1, wipe: -1 };
    const lens = camera.fitted(...PORTRAIT, { fills: scene.fills ? 1 : 0 });
    stage.portray(name, splats.snapshot(camera.view, lens, look, PORTRAIT, { near: scene.near, background, rim }));
    if (this.stale.size) this.place.touch(false);
  }

  /**
   * Progress of the scene's training.
   * @param {{step: number, share: number, psnr: number, seconds_left: number}} message
   */
  trained({ step, share, psnr, seconds_left: left }) {
    const clock = `${Math.floor(left / 60)}:${String(left % 60).padStart(2, "0")} left`;
    const text = below(at("training"), "span");
    at("training").hidden = false;
    below(at("training"), "progress").setAttribute("value", String(share));
    text.textContent = share < 1 ? `training, ${clock}` : "trained";
    text.title = `step ${step}, ${psnr.toFixed(1)} dB on the photographs`;
  }

  /** Fetch colours that the server has made, under a name of the stage. @param {{name: string, version: number}} message */
  async recolour({ name, version }) {
    const { place, stage } = this.shown;
    if (this.remote) this.remote.stale = true;
    if (place.splats) {
      const { head, parts } = await unpacked(await asked(`/colours?name=${encodeURIComponent(name)}&version=${version}`));
      await place.splats.add(name, head, parts.rows);
    }
    this.stale.add(name);
    place.touch(false);
    const fresh = !stage.styles.some((style) => style.name === name);
    stage.add({ name });
    if (fresh && stage.sending.asked === name) stage.choose(name);
    if (name === "Now") this.thrust(name, fresh);
  }

  /** What was changed here is seen here; what others change is not thrust upon this page. @param {string} name */
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

  /** Where a keyframe stands. @param {CameraMessage} key */
  keyed({ axes, place, lens, size }) {
    return Object.assign(this.place.camera.copy(), { axes, place, lens, size });
  }
}

const live = () => new Live();
