// The page of `fprf view`: the same stage with the scene of a server, which hears small messages and answers with colours.
const post = async (path, body) => {
  const answer = await fetch(path, { method: "POST", body });
  if (!answer.ok) throw new Error((await answer.text()).trim() || answer.statusText);
  return answer.json();
};
// What is wrong stays until it is clicked away.
const say = (text, bad = false) => {
  const line = make("button", { type: "button", textContent: text, className: bad ? "bad" : "", title: "close", onclick: () => line.remove() });
  at("said").append(line);
  while (at("said").children.length > 4) at("said").firstChild.remove();
  if (!bad) setTimeout(() => line.remove(), 6000);
  return line;
};
// JSON and sections of one body (pack.py).
const unpacked = async (answer) => {
  if (!answer.ok) throw new Error((await answer.text()).trim());
  const data = new Uint8Array(await answer.arrayBuffer()), length = new DataView(data.buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(data.subarray(4, 4 + length))), parts = {};
  let from = 4 + length;
  for (const [name, size] of Object.entries(head.sizes)) { parts[name] = data.subarray(from, from + size); from += size; }
  return { head, parts };
};

class Live {
  constructor() {
    Object.assign(this, { place: null, stage: null, scene: null, state: null, asked: false, changed: false, last: {}, cards: new Map(), pending: new Map() });
    this.start = new Start();
    this.controls();
    this.connect();
  }

  connect() {
    const socket = this.socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => { this.queue = (this.queue ?? Promise.resolve()).then(() => this.hear(data)).catch((error) => say(error.message, true)); };
    socket.onclose = () => setTimeout(() => this.connect(), 1500);
  }

  tell(type, more = {}) {
    if (["set", "preset", "card", "map", "region"].includes(type)) this.changed = true;
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ type, ...more }));
  }

  async hear(data) {
    if (typeof data !== "string") { await this.paint(new Uint8Array(data)); return; }
    const message = JSON.parse(data);
    if (message.type === "said") say(message.text, message.bad);
    else if (message.type === "start") this.begun(message);
    else if (message.type === "loading") this.mode("loading");
    else if (message.type === "scene") await this.open(message);
    else if (message.type === "state") this.fill(message);
    else if (message.type === "training") this.trained(message);
    else if (message.type === "colours") await this.recolour(message);
  }

  // How far the start is; with a scene of its own, which may still be trained.
  begun(message) {
    if (!this.scene) { this.mode("start"); this.start.fill(message); return; }
    if (message.stage === "idle") { location.reload(); return; }
    at("scenes").hidden = false;
    at("finish").hidden = message.stage !== "training" || Boolean(message.error);
    if (message.error) say(message.error, true);
  }

  mode(name) {
    for (const each of ["start", "scene", "loading"]) at(each).hidden = each !== name;
  }

  async open(scene) {
    const before = this.scene;
    if (before && before.key !== scene.key) { location.reload(); return; }
    if (before && before.step === scene.step) { this.place.touch(); return; } // it was only away for a moment
    const { head, parts } = await unpacked(await fetch("/scene"));
    this.mode("scene");
    this.scene = scene;
    document.title = `${scene.name} - fprf`;
    at("title").textContent = scene.name;
    at("place").classList.toggle("field", !scene.gaussians);
    at("save-ply").hidden = !scene.gaussians;
    head.alone = true;
    const splats = scene.gaussians ? before ? this.place.splats : new Splats(at("canvas")) : null;
    if (splats) {
      await splats.load(head, parts);
      await splats.add("Captured", head.styles[0], parts["style-0"]);
    }
    if (before) { // a newer state of its training
      this.place.scene = head;
      this.place.touch();
      return;
    }
    this.place = new Place(at("canvas"), head, splats, splats ? null : () => this.paintField());
    this.place.listeners.pick = (x, y) => {
      const box = at("canvas").getBoundingClientRect();
      if (this.state?.shelf.length) this.tell("pick", { camera: this.camera(), x: (x - box.left) / box.width, y: (y - box.top) / box.height });
    };
    this.place.listeners.drawn = () => at("place").classList.add("drawn");
    this.stage = new Stage(this.place, [{ name: "Captured" }]);
    this.stage.listeners.chosen = (name) => { if (this.state?.kept.includes(name)) this.tell("keep", { name, action: "restore" }); };
    window.fprf = { place: this.place, stage: this.stage, live: this };
  }

  trained({ step, share, psnr, seconds_left: left }) {
    const clock = `${Math.floor(left / 60)}:${String(left % 60).padStart(2, "0")} left`;
    at("training").hidden = false;
    at("training").children[0].value = share;
    at("training").children[1].textContent = share < 1 ? `training, step ${step} · ${psnr.toFixed(1)} dB · ${clock}` : `trained, ${step} steps`;
  }

  async recolour({ name, version }) {
    const { head, parts } = await unpacked(await fetch(`/colours?name=${encodeURIComponent(name)}&version=${version}`));
    await this.place.splats.add(name, head, parts.rows);
    this.place.touch(false);
    const { styles, from, to, wiping, amount } = this.stage, fresh = !styles.some((style) => style.name === name);
    this.stage.add({ name });
    if (name !== "Now") return;
    // What was changed here is seen here; what others change is not thrust upon this page.
    if (fresh || (this.changed && to !== name && (from !== name || !(wiping || amount < 1)))) this.stage.choose(name);
    this.changed = false;
  }

  // Where the server draws: the newest pictures, and the line between them.
  async paint(data) {
    const kind = data[0] ? "captured" : "look", bitmap = await createImageBitmap(new Blob([data.subarray(1)], { type: "image/jpeg" }));
    this.last[kind]?.close();
    this.last[kind] = bitmap;
    this.drawField();
  }

  drawField() {
    const { canvas, wipe } = this.place, context = canvas.getContext("2d"), { look, captured } = this.last;
    if (!look) return;
    context.drawImage(look, 0, 0, canvas.width, canvas.height);
    if (wipe >= 0 && captured) context.drawImage(captured, 0, 0, wipe * captured.width, captured.height, 0, 0, wipe * canvas.width, canvas.height);
    at("place").classList.add("drawn");
  }

  paintField() {
    const place = this.place, now = performance.now(), captured = place?.wipe >= 0;
    if (!place?.changed && this.captured === captured) return;
    if ((place.moved || this.captured !== captured) && now - (this.sent ?? 0) > 40) {
      Object.assign(this, { sent: now, captured });
      place.moved = false;
      this.tell("view", { camera: this.camera(), captured });
    }
    place.changed = place.moved;
    this.drawField();
  }

  camera() {
    const { camera, canvas, lens } = this.place;
    return { place: camera.place, axes: camera.axes, lens, size: [canvas.width, canvas.height] };
  }

  // The state of the server
  fill(state) {
    this.state = state;
    const now = new Set(state.shelf.map((row) => row.card));
    for (const [card, node] of this.cards) if (!now.has(card)) { node.remove(); this.cards.delete(card); }
    for (const row of state.shelf) {
      if (!this.cards.has(row.card)) { this.cards.set(row.card, this.card(row)); at("shelf").insertBefore(this.cards.get(row.card), at("add-photograph")); }
      const node = this.cards.get(row.card);
      node.classList.toggle("on", row.weight > 0);
      node.style.setProperty("--chip", row.colour ?? "transparent");
      if (node.weight !== document.activeElement) node.weight.value = row.weight;
      node.weight.hidden = state.shelf.length < 2;
    }
    for (const slider of document.querySelectorAll("[data-look]")) {
      slider.parentElement.hidden = !(slider.dataset.look in state.look);  // another stylizer has other fields
      if (slider !== document.activeElement) slider.value = state.look[slider.dataset.look];
    }
    at("map").value = state.map;
    at("hint").hidden = !state.shelf.length || Boolean(state.picked);
    this.fillRegion(state.picked, state.shelf);
    if (this.scene && !this.scene.gaussians && this.stage) state.kept.forEach((name) => this.stage.add({ name }));
    at("keys").replaceChildren(...state.keys.map((key, k) => make("span", { className: "key" },
      make("button", { type: "button", textContent: k + 1, title: "go there", onclick: () => this.place.go(this.keyed(key)) }),
      make("button", { type: "button", textContent: "‹", title: "earlier", onclick: () => this.tell("key", { action: "earlier", at: k }) }),
      make("button", { type: "button", textContent: "×", title: "remove", onclick: () => this.tell("key", { action: "remove", at: k }) }))));
    const busy = state.film.total > 0 && !state.film.ready;
    at("make-film").textContent = busy ? `${state.film.done} / ${state.film.total}` : "Make film";
    at("make-film").disabled = busy || !state.keys.length;
    at("play").disabled = state.keys.length < 2;
    if (this.before && state.film.ready && !this.before.film.ready) this.offer("/film", "download the film");
    this.before = state;
  }

  offer(href, text) {
    const line = say("", true);
    line.classList.remove("bad");
    line.append(make("a", { href, textContent: text, download: "" }));
  }

  download(href, name = "") {
    const link = make("a", { href, download: name });
    document.body.append(link);
    link.click();
    link.remove();
  }

  // What is seen, as large as it is here; WebGL keeps no picture, so it is drawn once more.
  picture() {
    const { canvas, splats, camera, lens, look, scene } = this.place;
    splats?.draw(camera.view, lens, look, { near: scene.near, background: scene.background, exact: true });
    canvas.toBlob((blob) => this.download(URL.createObjectURL(blob), `${this.scene.name}.png`));
  }

  card(row) {
    const picture = make("img", { src: `/card?card=${row.card}`, alt: row.name, draggable: false });
    const alone = make("button", { type: "button", className: "photo", title: `${row.name}: this one alone; with Shift in or out of the mix`, onclick: (event) => (event.shiftKey
      ? this.tell("card", { card: row.card, action: "weight", weight: node.classList.contains("on") ? 0 : 1 }) : this.tell("card", { card: row.card, action: "alone" })) }, picture);
    const weight = make("input", { type: "range", min: 0, max: 2, step: 0.05, title: "weight in the mix" });
    weight.setAttribute("aria-label", `weight of ${row.name}`);
    weight.oninput = () => this.steady(`card ${row.card}`, () => this.tell("card", { card: row.card, action: "weight", weight: +weight.value }));
    const node = make("div", { className: "card" }, alone, make("span", { textContent: row.name }), weight,
      make("button", { type: "button", className: "close", textContent: "×", title: "remove", onclick: () => this.tell("card", { card: row.card, action: "remove" }) }));
    return Object.assign(node, { weight });
  }

  // The last message of a kind in 40 ms.
  steady(kind, send) {
    if (!this.pending.size) setTimeout(() => { this.pending.forEach((each) => each()); this.pending.clear(); }, 40);
    this.pending.set(kind, send);
  }

  fillRegion(picked, rows) {
    at("region").hidden = !picked;
    if (!picked) return;
    const is = (action, card) => picked.rules.some((rule) => rule.action === action && rule.card === card);
    const button = (text, action, card, set) => make("button", { type: "button", className: "pill", textContent: text, ariaPressed: String(set),
      onclick: () => this.tell("region", { action: set ? "free" : action, card }) });
    const share = new Map(picked.taken.map((row) => [row.name, row.share]));
    at("region").replaceChildren(
      make("p", {}, make("b", { textContent: "This thing" }), ` ${(100 * picked.share).toFixed(1)} % of the scene`,
        make("button", { type: "button", className: "close", textContent: "×", title: "close", onclick: () => this.tell("region", { action: "close" }) })),
      ...rows.map((row) => make("div", { className: "row" }, make("span", { textContent: `${row.name} ${share.has(row.name) ? `${Math.round(100 * share.get(row.name))} %` : ""}` }),
        button("only", "pin", row.card, is("pin", row.card)), button("never", "forbid", row.card, is("forbid", row.card)))),
      make("div", { className: "row" }, button("keep as it is", "keep", null, is("keep", null)), button("free", "free", null, false)));
  }

  keyed(key) {
    const view = Object.create(Camera.prototype);
    return Object.assign(view, { axes: key.axes, place: key.place, lens: key.lens, size: key.size, distance: this.place.camera.distance });
  }

  async send(files) {
    for (const file of [...files].slice(0, 12)) {
      const line = say(`${file.name} …`, true);
      line.className = "";
      try {
        this.changed = true;
        await post(`/photograph?name=${encodeURIComponent(file.name)}`, file);
      } catch (error) {
        say(`${file.name}: ${error.message}`, true);
      }
      line.remove();
    }
  }

  controls() {
    const over = (event, on) => {
      if (!event.dataTransfer?.types.includes("Files")) return false;
      event.preventDefault();
      at("veil").hidden = !(on && this.scene);
      at("drop").classList.toggle("over", on);
      return true;
    };
    addEventListener("dragover", (event) => over(event, true));
    addEventListener("dragleave", (event) => { if (!event.relatedTarget) over(event, false); });
    addEventListener("drop", (event) => {
      if (!over(event, false)) return;
      if (this.scene) this.send(event.dataTransfer.files);
      else this.start.drop(event.dataTransfer);
    });
    addEventListener("paste", (event) => {
      const files = [...(event.clipboardData?.files ?? [])].filter((file) => file.type.startsWith("image/"));
      if (this.scene && files.length) this.send(files);
    });
    at("add-photograph").onclick = () => at("photographs").click();
    at("photographs").onchange = () => this.send(at("photographs").files).then(() => { at("photographs").value = ""; });
    for (const slider of document.querySelectorAll("[data-look]")) {
      slider.oninput = () => this.steady(slider.dataset.look, () => this.tell("set", { name: slider.dataset.look, value: +slider.value }));
    }
    at("map").onchange = () => this.tell("map", { map: at("map").value });
    at("gentle").onclick = () => this.tell("preset", { name: "gentle" });
    at("keep").onsubmit = (event) => { event.preventDefault(); this.tell("keep", { name: at("keep-name").value, action: "keep" }); };
    at("add-key").onclick = () => this.tell("key", { action: "add", camera: this.camera() });
    at("play").onclick = async () => {
      for (const key of this.state.keys) {
        this.place.go(this.keyed(key), +at("seconds").value);
        while (this.place.flight) await new Promise((done) => setTimeout(done, 30));
      }
    };
    at("make-film").onclick = () => this.tell("film", { seconds: +at("seconds").value });
    at("save-ply").onclick = () => this.download("/gaussians");
    at("save-picture").onclick = () => this.picture();
    at("finish").onclick = () => this.start.stop();
    at("scenes").onclick = () => post("/start", JSON.stringify({ type: "leave" })).catch((error) => say(error.message, true));
  }
}

const live = () => new Live();
