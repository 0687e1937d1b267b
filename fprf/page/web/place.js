// A canvas that one walks through: its camera, and which styles are shown. Frames are drawn when something has changed, coarsely
// while it moves, as fast as the machine is, and exactly at rest.

const FRAME_MS = 90; // that a frame of a moving camera may take
const REST_MS = 220; // without a move, after which the exact picture is drawn
const SHARES = [1, 0.75, 0.5, 0.35, 0.25]; // of the canvas's sides, that a moving camera is drawn at
const LEAST_SHARE = 0.25;
const SOFTWARE_FRAME_MS = 300; // of a frame at full resolution where the processor draws, until it is known
const FEWER = [1, 2, 4, 8]; // of so many neighbouring Gaussians one is drawn while the camera moves
const MAX_MOVING = { software: 200_000, card: 2_000_000 }; // Gaussians of a moving camera to begin with; by eye
const MAX_SIDE = 4096; // pixels a side of the canvas
const MAX_PIXEL_RATIO = 2; // pixels of the canvas for one of the page; by eye
const ASK_MS = 4; // between two looks at whether the graphics card has drawn
const FLIGHT_SECONDS = 0.7; // to another camera; by eye
const AMBIENCE = 0.9; // how far a place that photographs fill carries on to where nobody photographed; by eye
const NEARER_SHARE = 0.25; // of the way to what was double clicked; by eye

/**
 * A style over the other: names, how much of the second from 0 to 1, where the line stands from 0 to 1 or -1 without one.
 * @typedef {{first: string?, second: string?, blend: number, wipe: number}} Shown
 *
 * The head of a scene (writer.py): where one begins and may go, what is near and behind, what was photographed. `alone` on a page
 * that is the stage alone.
 * @typedef {{cameras: CapturedCamera[], up: Vector, near: number, background: Vector, reach: {centre: Vector, radius: number},
 *   fills?: number, alone?: boolean}} PlaceHead
 */

class Place {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {PlaceHead} scene
   * @param {Splats?} splats
   * @param {(() => void)?} painter shows a camera in the place of WebGL where pictures come from elsewhere
   */
  constructor(canvas, scene, splats, painter = null) {
    this.canvas = canvas;
    this.scene = scene;
    this.splats = splats;
    this.painter = painter;
    /** @type {Shown} */
    this.shown = { first: null, second: null, blend: 1, wipe: -1 };
    this.at = 0; // captured camera that was gone to last
    this.camera = new Camera(scene.cameras[0]);
    this.zoom = 1;
    this.speed = 1;
    this.below = 0; // share of the canvas under the bar of styles
    /** @type {number|false} since when it turns by itself */
    this.orbiting = false;
    this.fading = true; // what no photograph saw, into the background
    /** @type {((now: number) => void)?} */
    this.flight = null;
    /** @type {{pick: ((x: number, y: number) => void)?, drawn: ((rest: boolean) => void)?, lost: ((lost: boolean) => void)?}} */
    this.listeners = { pick: null, drawn: null, lost: null };
    this.changed = true; // something else is to be seen
    this.moved = true; // by another camera
    this.still = 0; // since when nothing has changed
    this.exact = false; // what is on the canvas is drawn with all Gaussians and pixels
    this.sorting = false;
    this.waiting = false; // for the graphics card
    this.lost = false; // the graphics card has dropped it
    this.milliseconds = 0; // of the last frame
    this.full = splats?.software ? SOFTWARE_FRAME_MS : 0; // milliseconds of a frame at full resolution, as far as is known
    this.fewer = this.firstFewer();
    /** @type {[Vector, Vector]} colours behind all things, in the middle and at the rim */
    this.sky = [[0, 0, 0], [0, 0, 0]];
    this.steering = new Steering(this);
    this.watch();
    this.readSky();
    this.resize();
    requestAnimationFrame((now) => this.frame(now));
  }

  /** What of FEWER a moving camera begins with. */
  firstFewer() {
    const most = this.splats?.software ? MAX_MOVING.software : MAX_MOVING.card;
    const count = this.splats?.count ?? 0;
    const first = FEWER.findIndex((every) => count / every <= most);
    return first < 0 ? FEWER.length - 1 : first;
  }

  /** Sizes, the theme and the graphics card change by themselves. */
  watch() {
    const { canvas, splats } = this;
    const sizes = new ResizeObserver(() => this.resize());
    for (const each of [canvas, canvas.parentElement?.querySelector(".bar")]) if (each) sizes.observe(each);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.readSky());
    if (!splats) return;
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.lost = true;
      this.listeners.lost?.(true);
    });
    canvas.addEventListener("webglcontextrestored", () => {
      this.lost = false;
      splats.compile();
      splats.fill();
      this.touch();
      this.listeners.lost?.(false);
    });
  }

  resize() {
    const { canvas } = this;
    const box = canvas.getBoundingClientRect();
    const by = Math.min(window.devicePixelRatio || 1, MAX_PIXEL_RATIO, MAX_SIDE / Math.max(box.width, box.height, 1));
    const width = Math.max(1, Math.round(box.width * by));
    const height = Math.max(1, Math.round(box.height * by));
    const bar = canvas.parentElement?.querySelector(".bar")?.getBoundingClientRect(); // styles lie over the stage
    const strip = bar?.height && box.height ? Math.max(0, box.bottom - bar.top) / box.height : 0;
    canvas.parentElement?.style.setProperty("--bar", `${bar?.height ?? 0}px`);
    if (strip !== this.below) {
      this.below = strip;
      this.touch();
    }
    if (width === canvas.width && height === canvas.height) return;
    canvas.width = width;
    canvas.height = height;
    this.touch();
  }

  get lens() {
    const { canvas, below: strip, scene, zoom } = this;
    return this.camera.fitted(canvas.width, canvas.height, { below: strip, fills: scene.fills, zoom });
  }

  /** What is shown; where it is one style alone, both are that. @returns {Look?} null before there is any */
  get look() {
    const { first, second, blend, wipe } = this.shown;
    const one = first ?? second;
    if (one === null) return null;
    return { first: one, second: second ?? one, blend, wipe };
  }

  /** Where the line stands, or -1. */
  get wipe() { return this.shown.wipe; }

  /** Something else is to be seen: `moved` where the camera is another one. */
  touch(moved = true) {
    this.changed = true;
    this.moved ||= moved;
    this.still = performance.now();
  }

  /** @param {Partial<Shown>} changes */
  show(changes) {
    Object.assign(this.shown, changes);
    this.touch(false);
  }

  /** Fly to a camera, or to where one may go that is nearest to it. @param {Camera} camera */
  go(camera, seconds = FLIGHT_SECONDS) {
    this.within(camera);
    const from = this.camera.copy();
    const start = performance.now();
    const whole = calm() ? 0 : 1000 * seconds;
    this.flight = (now) => {
      const t = whole ? Math.min(1, (now - start) / whole) : 1;
      this.camera = t < 1 ? from.towards(camera, eased(Math.max(0, t))) : camera.copy();
      if (t >= 1) this.flight = null;
      this.touch();
    };
  }

  /** To the captured camera `by` further on. @param {number} by */
  step(by) {
    const count = this.scene.cameras.length;
    this.at = (this.at + by + count) % count;
    this.go(new Camera(this.scene.cameras[this.at]));
  }

  /** Back to where the page began. */
  home() {
    this.at = 0;
    this.step(0);
  }

  /** Once a frame of the browser. @param {number} now */
  frame(now) {
    requestAnimationFrame((next) => this.frame(next));
    this.steering.step(now);
    this.flight?.(now);
    if (this.painter) this.painter();
    else if (this.splats && this.ready(this.splats)) this.renew(this.splats, now);
  }

  /** Whether the next frame may be drawn. @param {Splats} splats */
  ready(splats) {
    return Boolean(!this.lost && !this.waiting && this.look && splats.styles.has(this.look.first));
  }

  /** Order the Gaussians and draw them, where something has changed. @param {Splats} splats @param {number} now */
  renew(splats, now) {
    const still = now - this.still > REST_MS;
    if (!this.sorting && (this.moved || (still && splats.every !== 1))) {
      this.moved = false;
      this.sorting = true;
      splats.sort(this.camera.view, this.scene.near, still ? 1 : FEWER[this.fewer]).then(() => {
        this.sorting = false;
        this.changed = true;
      });
    }
    const rest = still && !this.sorting && !this.moved;
    if (!splats.kept || !(this.changed || (rest && !this.exact))) return;
    this.changed = false;
    this.exact = rest;
    const share = rest || !this.full ? 1 : SHARES.find((each) => each * each * this.full <= FRAME_MS) ?? LEAST_SHARE;
    const start = performance.now();
    this.paint({ share, exact: rest });
    this.wait(splats.gl, () => {
      this.milliseconds = performance.now() - start;
      if (!rest) this.learn(this.milliseconds, share);
      this.listeners.drawn?.(rest);
    });
  }

  /** Know how long frames take by one of a moving camera. @param {number} milliseconds @param {number} share of its sides */
  learn(milliseconds, share) {
    this.spare(milliseconds, share);
    const whole = milliseconds / share ** 2;
    this.full = 0.5 * (this.full || whole) + 0.5 * whole;
  }

  /**
   * Draw fewer Gaussians of a moving camera where the fewest pixels take too long, and more where there is time.
   * @param {number} milliseconds
   * @param {number} share
   */
  spare(milliseconds, share) {
    if (milliseconds > 2 * FRAME_MS && share === LEAST_SHARE) this.fewer = Math.min(this.fewer + 1, FEWER.length - 1);
    else if (milliseconds < FRAME_MS / 3 && share === 1) this.fewer = Math.max(this.fewer - 1, 0);
  }

  /** Draw what is to be seen into the canvas, over the page's own background. */
  paint({ share = 1, exact = true } = {}) {
    const { near, cameras, fills } = this.scene;
    const [background, rim] = this.sky;
    const depth = this.fading ? cameras[0].depth : 0;
    const ambience = fills && this.fading ? AMBIENCE : 0;
    if (this.look) this.splats?.draw(this.camera.view, this.lens, this.look, { near, background, rim, ambience, depth, share, exact });
  }

  /** Take the colours behind all things from the page's theme. */
  readSky() {
    const style = getComputedStyle(this.canvas);
    const part = (/** @type {string} */ name, /** @type {number} */ k) => parseInt(style.getPropertyValue(name).trim().slice(1 + 2 * k, 3 + 2 * k), 16) / 255;
    const colour = (/** @type {string} */ name) => /** @type {Vector} */ ([part(name, 0), part(name, 1), part(name, 2)]);
    this.sky = [colour("--near-sky"), colour("--far-sky")];
    this.touch(false);
  }

  /** Until the graphics card has drawn: frames never queue. @param {WebGL2RenderingContext} gl @param {() => void} done */
  wait(gl, done) {
    const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.waiting = true;
    const ask = () => {
      if (sync && !gl.isContextLost() && gl.getSyncParameter(sync, gl.SYNC_STATUS) !== gl.SIGNALED) {
        setTimeout(ask, ASK_MS);
        return;
      }
      gl.deleteSync(sync);
      this.waiting = false;
      done();
    };
    setTimeout(ask, 0);
  }

  /**
   * World point under a pixel of the page; null where there is nothing.
   * @param {number} x
   * @param {number} y
   * @returns {Vector?}
   */
  point(x, y) {
    if (this.lost || !this.look) return null;
    const box = this.canvas.getBoundingClientRect();
    const by = this.canvas.width / box.width;
    const [fx, fy, cx, cy] = this.lens;
    const right = (x - box.left) * by;
    const down = (y - box.top) * by;
    const depth = this.splats?.pick(this.camera.view, this.lens, this.look, right, down, this.scene.near);
    this.changed = true;
    if (!depth) return null;
    const there = this.camera.copy();
    there.move((right - cx) / fx * depth, (down - cy) / fy * depth, depth);
    return there.place;
  }

  /** Turn about what is under a pixel, and come a little nearer. @param {number} x @param {number} y */
  focus(x, y) {
    const point = this.point(x, y);
    if (!point) return;
    const camera = this.camera.copy();
    camera.face(point);
    // Of the sky, and of all that lies beyond where one may go, the direction alone counts.
    const far = Math.min(Math.hypot(...plus(point, camera.place, -1)), this.scene.reach.radius);
    camera.move(0, 0, NEARER_SHARE * far);
    camera.distance = (1 - NEARER_SHARE) * far;
    this.go(camera);
  }

  /** Nobody leaves what was captured by more than its own size. @param {Camera} camera */
  within(camera) {
    const { centre, radius } = this.scene.reach;
    const away = plus(camera.place, centre, -1);
    const far = Math.hypot(...away);
    if (far > radius) camera.place = plus(centre, away, radius / far);
  }

  keep() {
    this.within(this.camera);
    this.touch();
  }
}
