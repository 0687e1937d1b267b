// @ts-nocheck until its types are told
// A sun over the scene: what falls on its Gaussians (fprf/page/suns.py), the dome on which the sun is dragged, and the day of a
// page that one sends.

const SUN_STEP = 5; // degrees by which an arrow key moves the sun; by eye
const HOUR_STEP = 0.25; // hours, where the sun goes along a day
const LEAST_ELEVATION = 0.5; // degrees, as `SunConfig` takes them
const DOME_RADIUS = 92; // of the horizon on the dome, whose box is 200 wide
const NEAREST_STEPS = 240; // that a day is divided into, to find the time of a place
const SRGB_OFFSET = 0.055; // IEC 61966-2-1, also that of gains

/**
 * What of the sun, the sky and the ground falls on a surface, times the exposure; colours of the sky at the horizon and overhead.
 * @typedef {{sun: number[], sky: number[], bounce: number[], horizon: number[], zenith: number[]}} LightTerms
 *
 * A light with the bytes of its sun, if it has one, and its share of what is shown.
 * @typedef {{terms: LightTerms, met: ?Uint8Array, share: number}} LightPart
 *
 * Bytes of the Gaussians whatever the light, and constants of its formulas.
 * @typedef {{level: Uint8Array, open: Uint8Array, head: SurfaceHead}} LitSurfaces
 * @typedef {{ahead: number[], fit: ?number[][], shoulder: number, albedo: number, most: number, mostSky: number, leastSky: number}} SurfaceHead
 *
 * A light of a day: degrees of the sun, whether bytes are there of it.
 * @typedef {LightTerms & {hour: number, at: number[], met: boolean}} DayLight
 *
 * What is told of a day (fprf/page/suns.py).
 * @typedef {SurfaceHead & {day: DayLight[], overcast: LightTerms}} DayHead
 */

const linearOf = (c) => (c <= 0.04045 ? c / 12.92 : ((c + SRGB_OFFSET) / (1 + SRGB_OFFSET)) ** 2.4);
const encodedOf = (y) => (y <= 0.0031308 ? 12.92 * y : (1 + SRGB_OFFSET) * y ** (1 / 2.4) - SRGB_OFFSET);
const clamped = (x, low, high) => Math.min(high, Math.max(low, x));

/**
 * Numbers of lights in the mean.
 * @param {LightPart[]} parts
 * @param {keyof LightTerms} name
 */
const meanOf = (parts, name) => [0, 1, 2].map((c) => parts.reduce((sum, { terms, share }) => sum + share * terms[name][c], 0));

/**
 * Factors of colours + 0.055 of all Gaussians in lights that are mixed, as `Illumination.gain` computes them.
 * @param {LitSurfaces} surfaces
 * @param {LightPart[]} parts whose shares sum to 1
 * @param {{rows: Uint8Array, head: {low: number[], high: number[]}}} captured colours
 * @param {number} strength in [0, 1]
 * @returns {Float32Array} four numbers each
 */
const gainsOf = ({ level, open, head }, parts, captured, strength) => {
  const { fit, shoulder, albedo, most, mostSky, leastSky } = head;
  const count = level.length;
  const gains = new Float32Array(4 * count);
  const sky = meanOf(parts, "sky"), bounce = meanOf(parts, "bounce"), horizon = meanOf(parts, "horizon"), zenith = meanOf(parts, "zenith");
  const suns = parts.filter(({ met, share }) => met && share > 0).map(({ met, terms, share }) => ({ met, colour: terms.sun.map((x) => share * x / 255) }));
  // Of each byte of a captured colour: sRGB + 0.055, and what the scene has of light behind the camera's shoulder.
  const before = [], scene = [];
  for (let c = 0; c < 3; c++) {
    const { low, high } = captured.head, colours = Array.from({ length: 256 }, (_, byte) => clamped(low[c] + (high[c] - low[c]) * byte / 255, 0, 1));
    before.push(Float64Array.from(colours, (colour) => colour + SRGB_OFFSET));
    scene.push(Float64Array.from(colours, (colour) => { const y = linearOf(colour); return y / (1 - shoulder * y); }));
  }
  for (let i = 0; i < count; i++) {
    const u = level[i] / 255, unblocked = open[i] / 255, white = u + (1 - u) * albedo;
    for (let c = 0; c < 3; c++) {
      let gain = 1;
      if (!open[i]) {
        const mean = Math.max(leastSky, fit[0][c] + u * fit[1][c]), wanted = horizon[c] + Math.sqrt(u) * (zenith[c] - horizon[c]);
        gain = Math.min(mostSky, wanted / mean) ** (1 / 2.4);
      } else {
        let direct = 0;
        for (const { met, colour } of suns) direct += colour[c] * met[i];
        const ratio = (direct / unblocked + u * sky[c] + (1 - u) * bounce[c]) / white, byte = captured.rows[4 * i + c], lit = ratio * scene[c][byte];
        gain = Math.min(most, (encodedOf(lit / (1 + shoulder * lit)) + SRGB_OFFSET) / before[c][byte]);
      }
      gains[4 * i + c] = 1 + strength * (gain - 1);
    }
  }
  return gains;
};

/** The two lights of a day around a time, and how far it lies on the way from one to the other. */
const aroundHour = (day, hour) => {
  const found = day.findIndex((each) => each.hour >= hour), next = found < 0 ? day.length - 1 : Math.max(1, found);
  const [one, two] = [day[next - 1], day[next]];
  return { at: next - 1, way: clamped((hour - one.hour) / (two.hour - one.hour), 0, 1) };
};

/** Unit vector of a sun: to the right, ahead, up. */
const directionOf = ([azimuth, elevation]) => {
  const a = azimuth * Math.PI / 180, e = elevation * Math.PI / 180;
  return [Math.sin(a) * Math.cos(e), Math.cos(a) * Math.cos(e), Math.sin(e)];
};
const degreesOf = ([x, y, z]) => [Math.atan2(x, y) * 180 / Math.PI, Math.asin(clamped(z, -1, 1)) * 180 / Math.PI];

/** Azimuth and elevation of the sun at a time of a day. */
const sunAt = (day, hour) => {
  const { at: first, way } = aroundHour(day, hour);
  const [one, two] = [day[first], day[first + 1]].map((each) => directionOf(each.at));
  return degreesOf(unit(plus(one.map((x) => (1 - way) * x), two, way)));
};

/** The time of a day at which the sun is nearest to a place. */
const hourAt = (day, at_) => {
  const wanted = directionOf(at_), first = day[0].hour, span = day.at(-1).hour - first;
  let best = first, nearest = -2;
  for (let k = 0; k <= NEAREST_STEPS; k++) {
    const hour = first + span * k / NEAREST_STEPS, near = dot(wanted, directionOf(sunAt(day, hour)));
    if (near > nearest) { nearest = near; best = hour; }
  }
  return best;
};

const clock = (hour) => {
  const minutes = Math.round(60 * hour);
  return `${Math.floor(minutes / 60)}:${String(minutes % 60).padStart(2, "0")}`;
};

/**
 * The panel of the light: a map of the sky with what is ahead at its top and the sun on it; the time of day; the strength;
 * named lights. What it shows is told by `show`; what somebody wants is told to `on`.
 *
 * @typedef {{name: string, at: ?number[], hour: ?number, strength: number}} ShownLight
 *   `name` that of a light, "captured" or ""; azimuth and elevation of the sun in degrees; strength in [0, 1]
 * @typedef {{move: (at: number[], moving: boolean) => void, time: (hour: number, moving: boolean) => void,
 *   strengthen: (strength: number, moving: boolean) => void, name: (name: string) => void}} LightWishes
 */
class SunPanel {
  /**
   * @param {Place} place
   * @param {{ahead: number[], day: DayLight[], along: boolean}} about `along`: the sun stays on the day's way
   * @param {LightWishes} on
   */
  constructor(place, { ahead, day, along }, on) {
    Object.assign(this, { place, ahead, day, along, on });
    /** @type {ShownLight} */
    this.shown = { name: "captured", at: null, hour: null, strength: 1 };
    this.heading = null;
    at("light").hidden = false;
    Object.assign(at("hour"), { min: day[0].hour, max: day.at(-1).hour });
    at("hour").oninput = () => on.time(+at("hour").value, true);
    at("hour").onchange = () => on.time(+at("hour").value, false);
    at("shine").oninput = () => on.strengthen(at("shine").value / 100, true);
    at("shine").onchange = () => on.strengthen(at("shine").value / 100, false);
    for (const button of document.querySelectorAll("[data-light]")) button.onclick = () => on.name(button.dataset.light);
    const dome = at("dome");
    dome.onpointerdown = (event) => {
      dome.setPointerCapture(event.pointerId);
      event.preventDefault();
      at("sun").focus({ preventScroll: true });
      this.drag(event, true);
    };
    dome.onpointermove = (event) => { if (dome.hasPointerCapture(event.pointerId)) this.drag(event, true); };
    dome.onpointerup = (event) => this.drag(event, false);
    at("sun").onkeydown = (event) => this.key(event);
    at("sun").onkeyup = (event) => { if (event.key.startsWith("Arrow") && this.shown.at && !along) this.wish(this.shown.at, false); };
    this.turn();
  }

  /** The sun under a pointer: the rim is the horizon, the middle overhead. */
  drag(event, moving) {
    const box = at("dome").getBoundingClientRect();
    const x = (event.clientX - box.left) / box.width * 200 - 100, y = (event.clientY - box.top) / box.height * 200 - 100;
    const elevation = 90 * (1 - Math.min(1, Math.hypot(x, y) / DOME_RADIUS));
    this.wish([Math.atan2(x, -y) * 180 / Math.PI + this.headed(), elevation], moving);
  }

  key(event) {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!step) return;
    event.preventDefault();
    event.stopPropagation();
    if (this.along) {
      const hour = this.shown.hour ?? this.day[0].hour;
      this.on.time(clamped(hour + HOUR_STEP * (step[0] + step[1]), this.day[0].hour, this.day.at(-1).hour), true);
      return;
    }
    const [azimuth, elevation] = this.shown.at ?? [this.headed(), 45];
    this.wish([azimuth + SUN_STEP * step[0], elevation + SUN_STEP * step[1]], true);
  }

  /** Where somebody wants the sun. */
  wish([azimuth, elevation], moving) {
    const wanted = [(azimuth % 360 + 540) % 360 - 180, clamped(elevation, LEAST_ELEVATION, 90)];
    if (this.along) this.on.time(hourAt(this.day, wanted), moving);
    else this.on.move(wanted.map((x) => Math.round(10 * x) / 10), moving);
  }

  /** Degrees clockwise from the first view's direction to that in which one looks. */
  headed() {
    const { camera, scene } = this.place, right = cross(this.ahead, scene.up), forward = camera.axes[2];
    return Math.atan2(dot(forward, right), dot(forward, this.ahead)) * 180 / Math.PI;
  }

  /** The dome turns with the camera, as long as it is seen. */
  turn() {
    requestAnimationFrame(() => this.turn());
    if (at("lighting").hidden) return;
    const heading = Math.round(this.headed());
    if (heading === this.heading) return;
    this.heading = heading;
    const points = [];
    for (let k = 0; k <= NEAREST_STEPS / 4; k++) {
      const sun = sunAt(this.day, this.day[0].hour + (this.day.at(-1).hour - this.day[0].hour) * 4 * k / NEAREST_STEPS);
      if (sun[1] >= 0) points.push(this.spot(sun).join(","));
    }
    at("day").setAttribute("points", points.join(" "));
    this.show({});
  }

  /** Place of a sun in the dome's box, -100 to 100. */
  spot([azimuth, elevation]) {
    const turned_ = (azimuth - (this.heading ?? 0)) * Math.PI / 180, far = DOME_RADIUS * (1 - clamped(elevation, 0, 90) / 90);
    return [far * Math.sin(turned_), -far * Math.cos(turned_)].map((x) => Math.round(10 * x) / 10);
  }

  /** @param {Partial<ShownLight>} changes */
  show(changes) {
    Object.assign(this.shown, changes);
    const { name, at: sun, hour, strength } = this.shown;
    at("place").dataset.light = name || "sun";
    for (const button of document.querySelectorAll("[data-light]")) button.setAttribute("aria-pressed", String(button.dataset.light === name));
    const handle = at("sun");
    const [x, y] = sun ? this.spot(sun) : [0, 0];
    handle.style.left = `${50 + x / 2}%`;
    handle.style.top = `${50 + y / 2}%`;
    handle.classList.toggle("off", !sun);
    handle.setAttribute("aria-valuenow", String(Math.round(sun?.[0] ?? 0)));
    handle.setAttribute("aria-valuetext", sun ? `${Math.round(sun[0])}° clockwise from the first view, ${Math.round(sun[1])}° above the horizon` : "no sun");
    at("hour").value = hour ?? 12;
    at("hour").setAttribute("aria-valuetext", hour === null ? "no time" : clock(hour));
    at("hour").previousElementSibling.textContent = hour === null ? "" : clock(hour);
    at("shine").value = 100 * strength;
    at("shine").previousElementSibling.textContent = `${Math.round(100 * strength)} %`;
    at("shine").disabled = name === "captured";
  }
}

/** The day of a page that one sends: lights that were computed for it, and blends of two of them. */
class Daylight {
  /**
   * @param {Place} place
   * @param {DayHead} head
   * @param {Uint8Array} bytes inflated
   */
  constructor(place, head, bytes) {
    Object.assign(this, { place, head, names: [], waiting: false });
    const { count } = place.splats, plane = (k) => bytes.subarray(k * count, (k + 1) * count);
    /** @type {LitSurfaces} */
    this.surfaces = { level: plane(0), open: plane(1), head };
    let planes = 2;
    this.met = head.day.map((each) => (each.met ? plane(planes++) : null));
    this.panel = new SunPanel(place, { ahead: head.ahead, day: head.day, along: true }, {
      time: (hour) => this.set({ name: "", hour }),
      strengthen: (strength) => this.set({ strength }),
      name: (name) => this.choose(name),
    });
    this.set({});
  }

  /** A light by its name: noon, the lowest sun after it, the end of the day, clouds, or as captured. */
  choose(name) {
    const { day } = this.head, lit = day.filter(({ met }) => met);
    const hour = { noon: 12, "golden-hour": lit.at(-1).hour, "blue-hour": day.at(-1).hour }[name] ?? null;
    this.set({ name, hour });
  }

  /** A style on which it falls, too. */
  cover(name) {
    this.names.push(name);
    this.apply();
  }

  set(changes) {
    const shown = { ...this.panel.shown, ...changes }, sun = shown.hour === null ? null : sunAt(this.head.day, shown.hour);
    this.panel.show({ ...changes, at: sun && sun[1] > 0 ? sun : null });
    this.apply();
  }

  /** @returns {LightPart[]} the lights of what is shown; none: as captured */
  get parts() {
    const { name, hour } = this.panel.shown, { day, overcast } = this.head;
    if (name === "overcast") return [{ terms: overcast, met: null, share: 1 }];
    if (hour === null) return [];
    const { at: first, way } = aroundHour(day, hour);
    return [[first, 1 - way], [first + 1, way]].map(([k, share]) => ({ terms: day[k], met: this.met[k], share }));
  }

  /** Light the styles, once before the next frame. */
  apply() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      const { splats } = this.place, { parts } = this, start = performance.now();
      splats.light(this.names, parts.length ? gainsOf(this.surfaces, parts, splats.colours.get("Captured"), this.panel.shown.strength) : null);
      this.milliseconds = performance.now() - start;
      this.place.touch(false);
    });
  }

  /** What a link says of it. */
  get hash() {
    const { name, hour } = this.panel.shown;
    return hour === null ? (name === "overcast" ? name : "") : hour.toFixed(2);
  }

  /** Take what a link says. */
  read(text) {
    if (text === "overcast") this.choose(text);
    else if (text && Number.isFinite(+text)) this.set({ name: "", hour: clamped(+text, this.head.day[0].hour, this.head.day.at(-1).hour) });
  }
}
