// A sun over the scene: what falls on its Gaussians (fprf/page/suns.py), the dome on which the sun is dragged, and the day of a
// page that one sends.

const SUN_STEP = 5; // degrees by which an arrow key moves the sun; by eye
const HOUR_STEP = 0.25; // hours, where the sun goes along a day
const LEAST_ELEVATION = 0.5; // degrees, as `SunConfig` takes them
const DOME_RADIUS = 92; // of the horizon on the dome, whose box is 200 wide
const NORTH_RADIUS = 80; // of the letter of north, within the horizon
const NEAREST_STEPS = 240; // that a day is divided into, to find the time of a place
const SRGB_OFFSET = 0.055; // IEC 61966-2-1, also that of gains

/**
 * Light of the sun, the sky and the ground on a surface, times the exposure; colours of the sky at the horizon and overhead.
 * @typedef {{sun: number[], sky: number[], bounce: number[], horizon: number[], zenith: number[]}} LightTerms
 *
 * A light with the bytes of its sun, if it has one, and its share of what is shown.
 * @typedef {{terms: LightTerms, met: ?Uint8Array, share: number}} LightPart
 *
 * Bytes of the Gaussians whatever the light, and constants of its formulas.
 * @typedef {{level: Uint8Array, open: Uint8Array, head: SurfaceHead}} LitSurfaces
 * @typedef {{ahead: Vector, north: boolean, first: number, fit: ?number[][], shoulder: number, albedo: number, most: number, mostSky: number, leastSky: number, leastBlue: number, mostHue: number}} SurfaceHead
 *
 * `ahead` is the direction of azimuth 0: north, or where that is not known the first view's; `first` the azimuth of the latter.
 *
 * Azimuth, clockwise from there, and elevation of a sun in degrees.
 * @typedef {[number, number]} SunPlace
 *
 * A time of a day in hours, and where the sun stands then.
 * @typedef {{hour: number, at: SunPlace}} DayTime
 *
 * A light of a day, and whether there are bytes of its sun.
 * @typedef {LightTerms & DayTime & {met: boolean}} DayLight
 *
 * The head of a day (fprf/page/suns.py).
 * @typedef {SurfaceHead & {day: DayLight[], overcast: LightTerms}} DayHead
 */

/** Linear light of sRGB. @param {number} c */
const linearOf = (c) => (c <= 0.04045 ? c / 12.92 : ((c + SRGB_OFFSET) / (1 + SRGB_OFFSET)) ** 2.4);

/** sRGB of linear light. @param {number} y */
const encodedOf = (y) => (y <= 0.0031308 ? 12.92 * y : (1 + SRGB_OFFSET) * y ** (1 / 2.4) - SRGB_OFFSET);

/**
 * A time of a day, negative ones counted from its end: there are two at least.
 * @template {DayTime} T
 * @param {T[]} day
 * @param {number} k
 */
const timeOf = (day, k) => {
  const found = day.at(k);
  if (!found) throw new Error("a day without lights");
  return found;
};

/**
 * Numbers of lights in the mean.
 * @param {LightPart[]} parts
 * @param {keyof LightTerms} name
 */
const meanOf = (parts, name) => [0, 1, 2].map((c) => parts.reduce((sum, { terms, share }) => sum + share * terms[name][c], 0));

/** @param {number[]} colour linear */
const lumaOf = (colour) => 0.2126 * colour[0] + 0.7152 * colour[1] + 0.0722 * colour[2];

/** Logarithm of blue over red. @param {number[]} colour linear */
const bluenessOf = (colour) => Math.log(colour[2] / colour[0]);

/**
 * Factors of colours + 0.055 of a Gaussian of the sky, as `CapturedSky.gain` computes them.
 * @param {number[]} own linear
 * @param {number} u sine of its height
 * @param {number[]} horizon
 * @param {number[]} zenith
 * @param {number[][]} fit
 * @param {SurfaceHead} head
 */
const skyGain = (own, u, horizon, zenith, fit, { mostSky, leastSky, leastBlue, mostHue }) => {
  const mean = fit[0].map((base, c) => Math.max(leastSky, base + u * fit[1][c]));
  const wanted = horizon.map((low, c) => low + Math.sqrt(u) * (zenith[c] - low));
  const blue = bluenessOf(mean);
  const share = bounded((blue - bluenessOf(wanted)) / Math.max(blue, leastBlue), 0, 1);
  const brighter = lumaOf(own) / lumaOf(mean);
  return wanted.map((light, c) => {
    const kept = Math.min(mostSky, light / mean[c]);
    const oneHue = Math.min(mostHue, light * brighter / Math.max(leastSky, own[c]));
    return (kept ** (1 - share) * oneHue ** share) ** (1 / 2.4);
  });
};

/**
 * Factors of colours + 0.055 of all Gaussians in lights that are mixed, as `Illumination.gain` computes them.
 * @param {LitSurfaces} surfaces
 * @param {LightPart[]} parts whose shares sum to 1
 * @param {{rows: Uint8Array, head: {low: number[], high: number[]}}} captured colours
 * @param {number} strength in [0, 1]
 * @returns {Float32Array} four numbers each
 */
const gainsOf = ({ level, open, head }, parts, captured, strength) => {
  const { fit, shoulder, albedo, most } = head;
  const count = level.length;
  const gains = new Float32Array(4 * count);
  const sky = meanOf(parts, "sky");
  const bounce = meanOf(parts, "bounce");
  const horizon = meanOf(parts, "horizon");
  const zenith = meanOf(parts, "zenith");
  const suns = parts.flatMap(({ met, terms, share }) => (met && share > 0 ? [{ met, colour: terms.sun.map((x) => share * x / 255) }] : []));
  // Of each byte of a captured colour: sRGB + 0.055, and the scene's light behind the camera's shoulder.
  const { low, high } = captured.head;
  /** @type {Float64Array[]} */
  const before = [];
  /** @type {Float64Array[]} */
  const scene = [];
  for (let c = 0; c < 3; c++) {
    const colours = Array.from({ length: 256 }, (_, byte) => bounded(low[c] + (high[c] - low[c]) * byte / 255, 0, 1));
    before.push(Float64Array.from(colours, (colour) => colour + SRGB_OFFSET));
    scene.push(Float64Array.from(colours.map(linearOf), (y) => y / (1 - shoulder * y)));
  }
  const own = [0, 0, 0];
  for (let i = 0; i < count; i++) {
    const u = level[i] / 255;
    if (!open[i] && fit) {
      for (let c = 0; c < 3; c++) own[c] = before[c][captured.rows[4 * i + c]] ** 2.4;
      const found = skyGain(own, u, horizon, zenith, fit, head);
      for (let c = 0; c < 3; c++) gains[4 * i + c] = 1 + strength * (found[c] - 1);
      continue;
    }
    const unblocked = open[i] / 255;
    const white = u + (1 - u) * albedo;
    for (let c = 0; c < 3; c++) {
      let direct = 0;
      for (const { met, colour } of suns) direct += colour[c] * met[i];
      const ratio = (direct / unblocked + u * sky[c] + (1 - u) * bounce[c]) / white;
      const byte = captured.rows[4 * i + c];
      const lit = ratio * scene[c][byte];
      const gain = Math.min(most, (encodedOf(lit / (1 + shoulder * lit)) + SRGB_OFFSET) / before[c][byte]);
      gains[4 * i + c] = 1 + strength * (gain - 1);
    }
  }
  return gains;
};

/**
 * The first of the two times of a day around an hour, and how far it lies on the way from one to the other.
 * @param {DayTime[]} day
 * @param {number} hour
 */
const aroundHour = (day, hour) => {
  const found = day.findIndex((each) => each.hour >= hour);
  const next = found < 0 ? day.length - 1 : Math.max(1, found);
  const one = day[next - 1];
  const two = day[next];
  return { first: next - 1, way: bounded((hour - one.hour) / (two.hour - one.hour), 0, 1) };
};

/** Unit vector of a sun: to the right, ahead, up. @param {SunPlace} place @returns {Vector} */
const directionOf = ([azimuth, elevation]) => {
  const a = azimuth * Math.PI / 180;
  const e = elevation * Math.PI / 180;
  return [Math.sin(a) * Math.cos(e), Math.cos(a) * Math.cos(e), Math.sin(e)];
};

/** Back from `directionOf`. @param {Vector} direction @returns {SunPlace} */
const degreesOf = ([x, y, z]) => [Math.atan2(x, y) * 180 / Math.PI, Math.asin(bounded(z, -1, 1)) * 180 / Math.PI];

/** Rounded to tenths. @param {SunPlace} place @returns {SunPlace} */
const tenths = ([x, y]) => [Math.round(10 * x) / 10, Math.round(10 * y) / 10];

/** Place of the sun at a time of a day. @param {DayTime[]} day @param {number} hour */
const sunAt = (day, hour) => {
  const { first, way } = aroundHour(day, hour);
  const one = directionOf(day[first].at);
  const two = directionOf(day[first + 1].at);
  return degreesOf(unit(plus(times(one, 1 - way), two, way)));
};

/** The time of a day at which the sun is nearest to a place. @param {DayTime[]} day @param {SunPlace} place */
const hourAt = (day, place) => {
  const wanted = directionOf(place);
  const first = day[0].hour;
  const span = timeOf(day, -1).hour - first;
  let best = first;
  let nearest = -2;
  for (let k = 0; k <= NEAREST_STEPS; k++) {
    const hour = first + span * k / NEAREST_STEPS;
    const near = dot(wanted, directionOf(sunAt(day, hour)));
    if (near > nearest) {
      nearest = near;
      best = hour;
    }
  }
  return best;
};

/** @param {number} hour */
const clock = (hour) => {
  const minutes = Math.round(60 * hour);
  return `${Math.floor(minutes / 60)}:${String(minutes % 60).padStart(2, "0")}`;
};

/** The number that a slider says beside itself. @param {HTMLInputElement} slider @param {string} text */
const number = (slider, text) => {
  const beside = slider.previousElementSibling;
  if (beside) beside.textContent = text;
};

/**
 * The panel of the light: a map of the sky with what is ahead at its top and the sun on it; the time of day; the strength;
 * named lights. What it shows is told by `show`; what somebody wants is told to `on`.
 *
 * @typedef {{name: string, at: ?SunPlace, hour: ?number, strength: number}} ShownLight
 *   `name` that of a light, "captured" or ""; azimuth and elevation of the sun in degrees; strength in [0, 1]
 * @typedef {{move: (at: SunPlace, moving: boolean) => void, time: (hour: number, moving: boolean) => void,
 *   strengthen: (strength: number, moving: boolean) => void, name: (name: string) => void}} LightWishes
 */
class SunPanel {
  /**
   * @param {Place} place
   * @param {{ahead: Vector, north: boolean, day: DayTime[], along: boolean}} about `along`: the sun stays on the day's way
   * @param {LightWishes} on
   */
  constructor(place, { ahead, north, day, along }, on) {
    this.place = place;
    this.ahead = ahead;
    this.north = north;
    this.day = day;
    this.along = along;
    this.on = on;
    /** @type {ShownLight} */
    this.shown = { name: "captured", at: null, hour: null, strength: 1 };
    /** @type {?number} degrees by which the dome is turned */
    this.heading = null;
    at("light").hidden = false;
    const hour = at("hour");
    Object.assign(hour, { min: day[0].hour, max: timeOf(day, -1).hour });
    hour.oninput = () => on.time(+hour.value, true);
    hour.onchange = () => on.time(+hour.value, false);
    const shine = at("shine");
    shine.oninput = () => on.strengthen(+shine.value / 100, true);
    shine.onchange = () => on.strengthen(+shine.value / 100, false);
    for (const button of every("[data-light]", HTMLButtonElement)) button.onclick = () => on.name(button.dataset.light ?? "");
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
    // The dome turns with the camera, as long as it is seen.
    new MutationObserver(() => this.turn()).observe(at("lighting"), { attributeFilter: ["hidden"] });
    this.turn();
  }

  /** The sun under a pointer: the rim is the horizon, the middle overhead. @param {PointerEvent} event @param {boolean} moving */
  drag(event, moving) {
    const box = at("dome").getBoundingClientRect();
    const x = (event.clientX - box.left) / box.width * 200 - 100;
    const y = (event.clientY - box.top) / box.height * 200 - 100;
    const elevation = 90 * (1 - Math.min(1, Math.hypot(x, y) / DOME_RADIUS));
    this.wish([Math.atan2(x, -y) * 180 / Math.PI + this.headed(), elevation], moving);
  }

  /** @param {KeyboardEvent} event */
  key(event) {
    /** @type {Object<string, [number, number]>} */
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const step = steps[event.key];
    if (!step) return;
    event.preventDefault();
    event.stopPropagation();
    if (this.along) {
      const hour = this.shown.hour ?? this.day[0].hour;
      this.on.time(bounded(hour + HOUR_STEP * (step[0] + step[1]), this.day[0].hour, timeOf(this.day, -1).hour), true);
      return;
    }
    const [azimuth, elevation] = this.shown.at ?? [this.headed(), 45];
    this.wish([azimuth + SUN_STEP * step[0], elevation + SUN_STEP * step[1]], true);
  }

  /** Tell where somebody wants the sun. @param {SunPlace} place @param {boolean} moving */
  wish([azimuth, elevation], moving) {
    /** @type {SunPlace} */
    const wanted = [(azimuth % 360 + 540) % 360 - 180, bounded(elevation, LEAST_ELEVATION, 90)];
    if (this.along) this.on.time(hourAt(this.day, wanted), moving);
    else this.on.move(tenths(wanted), moving);
  }

  /** Azimuth of the direction in which one looks. */
  headed() {
    const { camera, scene } = this.place;
    const right = cross(this.ahead, scene.up);
    const forward = camera.axes[2];
    return Math.atan2(dot(forward, right), dot(forward, this.ahead)) * 180 / Math.PI;
  }

  /** Turn the dome with the camera, each frame until it is closed. */
  turn() {
    if (at("lighting").hidden) return;
    requestAnimationFrame(() => this.turn());
    const heading = Math.round(this.headed());
    if (heading === this.heading) return;
    this.heading = heading;
    const first = this.day[0].hour;
    const span = timeOf(this.day, -1).hour - first;
    const points = [];
    for (let k = 0; k <= NEAREST_STEPS; k += 4) {
      const sun = sunAt(this.day, first + span * k / NEAREST_STEPS);
      if (sun[1] >= 0) points.push(this.spot(sun).join(","));
    }
    at("day").setAttribute("points", points.join(" "));
    if (this.north) this.mark();
    this.show({});
  }

  /** Mark north on the dome's rim. */
  mark() {
    const letter = at("north");
    const turned = -(this.heading ?? 0) * Math.PI / 180;
    letter.textContent = "N";
    letter.setAttribute("x", (NORTH_RADIUS * Math.sin(turned)).toFixed(1));
    letter.setAttribute("y", (-NORTH_RADIUS * Math.cos(turned)).toFixed(1));
  }

  /** Place of a sun in the dome's box, -100 to 100. @param {SunPlace} place */
  spot([azimuth, elevation]) {
    const turned = (azimuth - (this.heading ?? 0)) * Math.PI / 180;
    const far = DOME_RADIUS * (1 - bounded(elevation, 0, 90) / 90);
    return tenths([far * Math.sin(turned), -far * Math.cos(turned)]);
  }

  /** @param {Partial<ShownLight>} changes */
  show(changes) {
    Object.assign(this.shown, changes);
    const { name, at: sun, hour, strength } = this.shown;
    at("place").dataset.light = name || "sun";
    for (const button of every("[data-light]", HTMLButtonElement)) button.setAttribute("aria-pressed", String(button.dataset.light === name));
    const handle = at("sun");
    const [x, y] = sun ? this.spot(sun) : [0, 0];
    handle.style.left = `${50 + x / 2}%`;
    handle.style.top = `${50 + y / 2}%`;
    handle.classList.toggle("off", !sun);
    handle.setAttribute("aria-valuenow", String(Math.round(sun?.[0] ?? 0)));
    handle.setAttribute("aria-valuetext", sun ? `${Math.round(sun[0])}° clockwise from ${this.north ? "north" : "the first view"}, ${Math.round(sun[1])}° above the horizon` : "no sun");
    at("hour").value = String(hour ?? 12);
    at("hour").setAttribute("aria-valuetext", hour === null ? "no time" : clock(hour));
    number(at("hour"), hour === null ? "" : clock(hour));
    at("shine").value = String(100 * strength);
    number(at("shine"), `${Math.round(100 * strength)} %`);
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
    const { splats } = place;
    if (!splats) throw new Error("a day without Gaussians");
    this.place = place;
    this.splats = splats;
    this.head = head;
    /** @type {string[]} styles that it falls on */
    this.names = [];
    this.waiting = false;
    this.milliseconds = 0;
    const { count } = splats;
    /** @param {number} k */
    const plane = (k) => bytes.subarray(k * count, (k + 1) * count);
    /** @type {LitSurfaces} */
    this.surfaces = { level: plane(0), open: plane(1), head };
    let planes = 2;
    this.met = head.day.map((each) => (each.met ? plane(planes++) : null));
    this.panel = new SunPanel(place, { ahead: head.ahead, north: head.north, day: head.day, along: true }, {
      move: () => undefined, // along the day's way it goes by its time
      time: (hour) => this.set({ name: "", hour }),
      strengthen: (strength) => this.set({ strength }),
      name: (name) => this.choose(name),
    });
    this.set({});
  }

  /**
   * A light by its name: noon, the lowest sun after it, the end of the day, clouds, or as captured.
   * @param {string} name
   */
  choose(name) {
    const { day } = this.head;
    const lit = day.filter(({ met }) => met);
    /** @type {Object<string, number>} */
    const hours = { noon: 12, "golden-hour": timeOf(lit, -1).hour, "blue-hour": timeOf(day, -1).hour };
    this.set({ name, hour: hours[name] ?? null });
  }

  /** Light another style, too. @param {string} name */
  cover(name) {
    this.names.push(name);
    this.apply();
  }

  /** @param {Partial<ShownLight>} changes */
  set(changes) {
    const { hour } = { ...this.panel.shown, ...changes };
    const sun = hour === null ? null : sunAt(this.head.day, hour);
    this.panel.show({ ...changes, at: sun && sun[1] > 0 ? sun : null });
    this.apply();
  }

  /** @returns {LightPart[]} the lights of what is shown; none: as captured */
  get parts() {
    const { name, hour } = this.panel.shown;
    const { day, overcast } = this.head;
    if (name === "overcast") return [{ terms: overcast, met: null, share: 1 }];
    if (hour === null) return [];
    const { first, way } = aroundHour(day, hour);
    return [
      { terms: day[first], met: this.met[first], share: 1 - way },
      { terms: day[first + 1], met: this.met[first + 1], share: way },
    ];
  }

  /** Light the styles, once before the next frame. */
  apply() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      const { splats, parts } = this;
      const captured = splats.colours.get("Captured");
      const start = performance.now();
      splats.light(this.names, parts.length && captured ? gainsOf(this.surfaces, parts, captured, this.panel.shown.strength) : null);
      this.milliseconds = performance.now() - start;
      this.place.touch(false);
    });
  }

  /** The light as a link holds it. */
  get hash() {
    const { name, hour } = this.panel.shown;
    return hour === null ? (name === "overcast" ? name : "") : hour.toFixed(2);
  }

  /** Take the light of a link. @param {string} text */
  read(text) {
    const { day } = this.head;
    if (text === "overcast") this.choose(text);
    else if (text && Number.isFinite(+text)) this.set({ name: "", hour: bounded(+text, day[0].hour, timeOf(day, -1).hour) });
  }
}
