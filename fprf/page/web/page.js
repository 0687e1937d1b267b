// The stage of a page: a scene in 3D with its styles, or pictures of it where there is no WebGL 2 or no Gaussians.
const make = (tag, props = {}, ...inside) => {
  const node = Object.assign(document.createElement(tag), props);
  node.append(...inside);
  return node;
};
const at = (id) => document.getElementById(id);

// Pictures in the place of a scene: views by styles, one over the other.
class Pictures {
  constructor(stage, stills) {
    Object.assign(this, { stills, at: 0, first: null, second: null, blend: 1, wipe: -1, listeners: {} });
    this.images = ["one", "two"].map((name) => stage.querySelector(`.still.${name}`));
    this.images.forEach((image) => { image.hidden = false; });
  }

  show(changes) {
    Object.assign(this, changes);
    const first = this.first ?? this.second, second = this.second ?? first;
    [first, second].forEach((name, i) => {
      const rows = this.stills[name] ?? Object.values(this.stills)[0];
      this.images[i].src = rows[this.at % rows.length];
    });
    const [one, two] = this.images;
    two.style.opacity = this.wipe >= 0 ? 1 : this.blend;
    two.style.clipPath = this.wipe >= 0 ? `inset(0 0 0 ${100 * this.wipe}%)` : "none";
    one.alt = `${first}, ${second}`;
  }

  step(by) {
    const count = Math.max(...Object.values(this.stills).map((rows) => rows.length));
    this.at = (this.at + by + count) % count;
    this.show({});
  }

  home() {
    this.at = 0;
    this.show({});
  }
}

const MOST_SHOWN = 4; // photographs beside a style that is of several; by eye
const PANELS = { light: "lighting", see: "seeing", send: "sending", how: "help" }; // buttons and what they open
const SWEEP_MS = 4200; // that the line takes on its way across, once; by eye

// One plain sentence on the stage, where it cannot be what it should be; without words there is none.
const explain = (root, text = "") => {
  root.querySelector(".why")?.remove();
  root.dataset.why = text;
  if (text) root.querySelector(".view").append(make("p", { className: "why", role: "status", textContent: text }));
};
const LOST = "The graphics card has dropped the picture. It comes back by itself; if it does not, reload the page.";

// The controls of a stage: which style, from which other one, how far, or a line between both.
class Stage {
  constructor(place, styles) {
    Object.assign(this, { place, root: at("place"), styles: [], from: null, to: null, amount: 1, wiping: false, line: 0.5, listeners: {} });
    at("mix").oninput = () => this.set({ amount: at("mix").value / 100 });
    at("from").onchange = () => this.set({ from: at("from").value });
    at("wiping").onclick = () => this.compare();
    at("back").onclick = () => this.place.step(-1);
    at("next").onclick = () => this.place.step(1);
    at("reset").onclick = () => this.place.home();
    at("full").onclick = () => (document.fullscreenElement ? document.exitFullscreen() : this.root.requestFullscreen?.());
    at("full").hidden = !this.root.requestFullscreen;
    this.sending = new Sending(this);
    if (place instanceof Place) this.seeing = new Seeing(place);
    at("see").hidden = !this.seeing;
    for (const id of Object.keys(PANELS)) at(id).onclick = () => this.unfold(id);
    const handle = at("line");
    const drag = (event) => {
      const box = this.root.querySelector(".view").getBoundingClientRect();
      this.set({ line: Math.min(1, Math.max(0, (event.clientX - box.left) / box.width)) });
    };
    handle.onpointerdown = (event) => { handle.setPointerCapture(event.pointerId); event.preventDefault(); handle.focus(); };
    handle.onpointermove = (event) => { if (handle.hasPointerCapture(event.pointerId)) drag(event); };
    handle.onkeydown = (event) => {
      const by = { ArrowLeft: -0.02, ArrowRight: 0.02, Home: -1, End: 1 }[event.key];
      if (by) { event.preventDefault(); event.stopPropagation(); this.set({ line: Math.min(1, Math.max(0, this.line + by)) }); }
    };
    addEventListener("keydown", (event) => this.key(event));
    styles.forEach((style) => this.add(style));
  }

  // `style` has a name and, where there are any, a small picture of the scene in it (`thumb`) and of its photographs (`of`).
  add(style) {
    if (this.styles.some((each) => each.name === style.name)) return;
    const picture = (src) => make("img", { src, alt: "", draggable: false });
    const card = make("button", { type: "button", className: "look", title: style.name, onclick: () => this.choose(style.name) },
      ...(style.thumb ? [picture(style.thumb)] : []), make("span", { className: "name", textContent: style.name }),
      ...(style.of?.length ? [make("span", { className: "of" }, ...style.of.slice(0, MOST_SHOWN).map(picture))] : []));
    this.styles.push({ ...style, card });
    at("looks").insertBefore(card, at("add"));
    at("from").append(make("option", { value: style.name, textContent: style.name }));
    this.set(this.from === null ? { from: style.name, to: style.name } : {});
  }

  // A line between two styles, or none: never between one and itself.
  compare() {
    const [first, second] = this.styles;
    if (!this.wiping && this.from === this.to && second) this.set(this.to === first.name ? { to: second.name } : { from: first.name });
    this.set({ wiping: !this.wiping, ...(this.wiping ? {} : { line: 0.5 }) });
  }

  remove(name) {
    const style = this.styles.find((each) => each.name === name);
    if (!style) return;
    style.card.remove();
    [...at("from").options].find((option) => option.value === name)?.remove();
    this.styles = this.styles.filter((each) => each !== style);
    const instead = (kept) => (kept === name ? this.styles[0].name : kept);
    this.set({ from: instead(this.from), to: instead(this.to) });
  }

  // From the captured colours to a style, without a jump.
  choose(name) {
    const before = this.to;
    this.set({ to: name, amount: 1, wiping: this.wiping && name !== this.from });
    this.listeners.chosen?.(name);
    if (this.wiping || before === name || !(this.place instanceof Place) || matchMedia("(prefers-reduced-motion: reduce)").matches) return;
    const start = performance.now();
    const step = (now) => {
      const t = Math.min(1, (now - start) / 450);
      if (this.to !== name || this.amount !== 1 || this.wiping) return;
      this.place.show(t < 1 ? { first: before, second: name, blend: t * t * (3 - 2 * t), wipe: -1 } : {});
      if (t < 1) requestAnimationFrame(step);
      else this.set({});
    };
    requestAnimationFrame(step);
  }

  // Begin in a style: the line draws it from the right across the scene and comes to rest in the middle, unless motion is
  // not wanted or somebody takes over.
  begin(name) {
    this.set({ to: name, wiping: true, line: 0.5 });
    if (!(this.place instanceof Place) || matchMedia("(prefers-reduced-motion: reduce)").matches) return;
    const controller = new AbortController(), stop = () => controller.abort();
    for (const kind of ["pointerdown", "keydown", "wheel"]) addEventListener(kind, stop, { signal: controller.signal, capture: true });
    const start = performance.now(), eased = (t) => t * t * (3 - 2 * t);
    const step = (now) => {
      if (controller.signal.aborted) return;
      const t = Math.min(1, (now - start) / SWEEP_MS);
      this.set({ line: t < 0.7 ? 1 - 0.94 * eased(t / 0.7) : 0.06 + 0.44 * eased((t - 0.7) / 0.3) });
      if (t < 1) requestAnimationFrame(step);
      else stop();
    };
    this.set({ line: 1 });
    requestAnimationFrame(step);
  }

  set(changes) {
    Object.assign(this, changes);
    const { from, to, amount, wiping, line } = this, alone = this.styles.length < 2;
    this.place.show({ first: from, second: to, blend: amount, wipe: wiping ? line : -1 });
    this.styles.forEach(({ name, card }) => card.setAttribute("aria-pressed", String(name === to)));
    at("mix").value = 100 * amount;
    at("mix").setAttribute("aria-valuetext", `${Math.round(100 * amount)} % ${to}`);
    at("from").value = from;
    at("towards").textContent = to;
    at("blending").hidden = alone && !this.root.classList.contains("field");
    at("mix").disabled = wiping || from === to;
    at("wiping").setAttribute("aria-pressed", String(wiping));
    const handle = at("line");
    handle.hidden = !wiping;
    handle.style.left = `${100 * line}%`;
    handle.setAttribute("aria-valuenow", String(Math.round(100 * line)));
    handle.dataset.left = from;
    handle.dataset.right = to;
  }

  // Open the panel of a button, or close it; one is open at a time.
  unfold(id) {
    for (const [button, panel] of Object.entries(PANELS)) {
      const open = button === id && at(panel).hidden;
      at(panel).hidden = !open;
      at(button).setAttribute("aria-expanded", String(open));
    }
    this.sending.fill();
    this.seeing?.fill();
    this.listeners.unfolded?.(id);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.("input:not([type=range]), select, textarea")) return;
    const digit = /^Digit(\d)$/.exec(event.code);
    const style = digit && this.styles[Number(digit[1])];
    if (style) this.choose(style.name);
    else if (event.key === "[" || event.key === "]") this.set({ amount: Math.min(1, Math.max(0, this.amount + (event.key === "]" ? 0.1 : -0.1))) });
    else if (event.code === "KeyC") this.compare();
    else if (event.code === "KeyV") this.place.step(event.shiftKey ? -1 : 1);
    else if (event.code === "KeyR") this.place.home();
    else if (event.code === "KeyL" && !at("light").hidden) this.unfold("light");
    else if (event.key === "?" || event.code === "KeyH") this.unfold("how");
    else if (event.key === "Escape") {
      this.unfold(null);
      this.listeners.escape?.();
    } else return;
    event.preventDefault();
  }
}

// A page of one file: everything lies in it.
const open = async (data) => {
  const styles = data.styles.map(({ name, of }) => ({ name, thumb: data.stills[name][0], of: of.map((each) => data.references[each]) })), root = at("place");
  const fall = (why) => {
    root.classList.add("pictures");
    explain(root, why && `${why[0].toUpperCase()}${why.slice(1)}. Pictures stand in the place of the scene.`);
    at("canvas").hidden = true;
    const count = Math.max(1, ...Object.values(data.stills).map((rows) => rows.length));
    for (const id of ["back", "next"]) at(id).hidden = count < 2;
    return new Pictures(root, data.stills);
  };
  const section = (name) => {
    const text = atob(at(`data-${name}`).textContent.trim()), data = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) data[i] = text.charCodeAt(i);
    return data;
  };
  let place = null;
  if (data.scene) {
    try {
      const splats = new Splats(at("canvas"));
      await splats.load(data.scene, Object.fromEntries(["shape", "chunks", "palette"].map((name) => [name, section(name)])));
      await splats.add(styles[0].name, data.styles[0], section("style-0"));
      place = new Place(at("canvas"), data.scene, splats);
    } catch (error) {
      place = fall(error.message);
    }
  } else place = fall("");
  const stage = new Stage(place, styles.slice(0, 1));
  if (place.splats && data.scene.light) {
    stage.light = new Daylight(place, data.scene.light, await inflate(section("light")));
    document.querySelector("[data-light=moonlight]").hidden = true; // of it nothing was computed
    stage.light.cover(styles[0].name);
  }
  window.fprf = { place, stage };
  if (place.splats) {
    place.listeners.lost = (lost) => {
      root.classList.toggle("drawn", !lost);
      explain(root, lost ? LOST : "");
    };
  }
  if (place.splats) {
    // Other styles are read after the first picture; a page in the background draws none.
    await new Promise((done) => {
      place.listeners.drawn = () => { root.classList.add("drawn"); done(); };
      setTimeout(done, 3000);
    });
  }
  for (const [k, style] of data.styles.entries()) {
    if (!k) continue;
    if (place.splats) {
      await place.splats.add(style.name, style, section(`style-${k}`));
      await new Promise((done) => setTimeout(done, 0)); // a picture between two styles
    }
    stage.add(styles[k]);
    if (!style.lit) stage.light?.cover(style.name);
    if (k === 1 && !location.hash) stage.begin(styles[k].name);
  }
  if (location.hash && !stage.sending.read() && styles[1]) stage.begin(styles[1].name);
  root.classList.add("ready");
};
