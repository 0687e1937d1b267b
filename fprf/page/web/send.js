// What one sends: a link that holds where one stands and in which style, and a page that shows the scene within another one.

const VIEW_NUMBERS = 9; // of a view in a link: place, direction forward, roll, distance of what is turned about, zoom
const VIEW_DIGITS = 5; // of each
const MIN_ZOOM = 0.2; // of a link
const MAX_ZOOM = 8;
const COPIED_MS = 2000; // that a button says so; by eye

/** Axes of a camera that looks forward without a roll: right, down, forward. @param {Vector} forward @param {Vector} up */
const levelled = (forward, up) => {
  const right = unit(cross(forward, up));
  return [right, cross(forward, right), forward];
};

/** The part of a link behind #: the view and the style. */
class Sending {
  /** @param {Stage} stage */
  constructor(stage) {
    this.stage = stage;
    /** @type {string} address of the page, for others */
    this.address = location.href.split("#")[0];
    this.coded = false; // whether the server draws a code of it
    for (const button of document.querySelectorAll("button")) {
      const field = button.dataset.copy;
      if (field) button.onclick = () => this.copy(button, at(field === "link" ? "link" : "embed"));
    }
    addEventListener("hashchange", () => this.read());
  }

  /** Take the address that others open, and show its code: it comes from the server. @param {string} address */
  share(address) {
    this.address = address;
    this.coded = true;
  }

  /** The style that the link names. @returns {string?} */
  get asked() { return new URLSearchParams(location.hash.slice(1)).get("s"); }

  /** What stands behind # for what is seen now. @returns {string} */
  get hash() {
    const { place, to, light } = this.stage;
    const parts = new URLSearchParams();
    if (place instanceof Place) parts.set("v", this.viewOf(place).map((x) => Number(x.toPrecision(VIEW_DIGITS))).join(","));
    parts.set("s", to);
    if (light?.hash) parts.set("l", light.hash);
    return parts.toString().replaceAll("%2C", ",");
  }

  /** Numbers of a link. @param {Place} place */
  viewOf({ camera, zoom, scene }) {
    const [right, down] = levelled(camera.axes[2], scene.up);
    const roll = Math.atan2(dot(camera.axes[0], down), dot(camera.axes[0], right));
    return [...camera.place, ...camera.axes[2], roll, camera.distance, zoom];
  }

  /**
   * Go where a link leads, and choose its style.
   * @returns {boolean} whether it names a style that there is
   */
  read() {
    const { place, styles, light } = this.stage;
    const given = new URLSearchParams(location.hash.slice(1));
    const view = (given.get("v") ?? "").split(",").map(Number);
    const whole = view.length === VIEW_NUMBERS && view.every(Number.isFinite);
    if (place instanceof Place && whole && view[7] > 0 && view[8] > 0) this.stand(place, view);
    light?.read(given.get("l") ?? "");
    const style = styles.find(({ name }) => name === this.asked);
    if (style) this.stage.set({ to: style.name, amount: 1, wiping: false });
    return Boolean(style);
  }

  /** Stand at a view of a link, no farther than one may go. @param {Place} place @param {number[]} view */
  stand(place, [x, y, z, right, up, forward, roll, distance, zoom]) {
    const axes = levelled(unit([right, up, forward]), place.scene.up);
    Object.assign(place.camera, { place: [x, y, z], axes: axes.map((axis) => turned(axis, axes[2], roll)), distance });
    place.zoom = bounded(zoom, MIN_ZOOM, MAX_ZOOM);
    place.flight = null;
    place.keep();
  }

  /** Show the link and the page that embeds it. */
  fill() {
    const link = `${this.address}#${this.hash}`;
    const source = link.replaceAll("&", "&amp;").replaceAll('"', "&quot;");
    at("link").value = link;
    at("embed").value = `<iframe src="${source}" width="100%" height="560" style="border:0" allow="fullscreen; xr-spatial-tracking" allowfullscreen></iframe>`;
    at("code").hidden = !this.coded;
    if (this.coded && !at("sending").hidden) at("code").src = `/code?hash=${encodeURIComponent(this.hash)}`;
  }

  /**
   * Copy a field; where the browser forbids it, it is selected, to be copied by hand.
   * @param {HTMLButtonElement} button
   * @param {HTMLInputElement} field
   */
  async copy(button, field) {
    field.select();
    try {
      await navigator.clipboard.writeText(field.value);
      button.textContent = "Copied";
    } catch {
      button.textContent = "Ctrl C";
    }
    setTimeout(() => { button.textContent = "Copy"; }, COPIED_MS);
  }
}

/** How it is seen: angle, speed, what fades, turning, headset. */
class Seeing {
  /** @param {Place} place */
  constructor(place) {
    this.place = place;
    at("angle").oninput = () => this.widen(at("angle").valueAsNumber);
    at("speed").oninput = () => {
      place.speed = at("speed").valueAsNumber;
      this.fill();
    };
    at("fading").onchange = () => {
      place.fading = at("fading").checked;
      place.touch(false);
    };
    at("orbiting").onchange = () => { place.orbiting = at("orbiting").checked && performance.now(); };
    place.canvas.addEventListener("pointerdown", () => {
      place.orbiting = false;
      at("orbiting").checked = false;
    });
    const fading = at("fading").closest("label");
    if (fading) fading.hidden = !place.splats?.deep;
    if (place.splats) this.offerHeadset(place.splats);
  }

  /** @param {Splats} splats */
  offerHeadset(splats) {
    const { xr } = /** @type {{xr?: XrSystem}} */ (navigator);
    if (!xr) return;
    xr.isSessionSupported("immersive-vr").then((can) => { at("headset").hidden = !can; }, () => {});
    at("headset").onclick = () => new Headset(this.place, splats).enter(xr).catch((error) => { at("headset").textContent = wordsOf(error); });
  }

  /** The vertical field of view now, in degrees. */
  get angle() { return 360 / Math.PI * Math.atan(this.place.canvas.height / 2 / this.place.lens[1]); }

  /** @param {number} degrees */
  widen(degrees) {
    const { place } = this;
    const tangent = Math.tan(degrees * Math.PI / 360);
    place.zoom *= place.canvas.height / 2 / tangent / place.lens[1];
    place.touch();
    this.fill();
  }

  fill() {
    at("angle").value = String(this.angle);
    below(at("seeing"), "output[for=angle]").textContent = `${Math.round(this.angle)}°`;
    below(at("seeing"), "output[for=speed]").textContent = `${this.place.speed.toFixed(1)}×`;
  }
}
