// A canvas that one walks through: camera, controls, and which styles are shown. Frames are drawn when something has changed,
// coarsely while it moves, as fast as the machine is, and exactly at rest.
const FRAME = 90; // milliseconds that a frame of a moving camera may take
const REST = 220; // milliseconds without a move, after which the exact picture is drawn
const SHARES = [1, 0.75, 0.5, 0.35, 0.25];
const TURN_SPEED = 0.12; // radians a second of a scene that turns by itself; by eye
const SWING = 0.3; // radians to either side where it is not turned all the way round; by eye
const AROUND_SHARE = 0.5; // length of the mean direction of cameras, below which they stand around something; by eye
const FEWER = [1, 2, 4, 8]; // of so many neighbouring Gaussians one is drawn while the camera moves
const MOST_MOVING = { software: 200_000, card: 2_000_000 }; // Gaussians of a moving camera to begin with; by eye
const EDGE = 4096; // pixels a side of the canvas, at most
const CLICK_MS = 280; // until a click is known not to be the first half of a double click; by eye

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, by = 1) => [a[0] + by * b[0], a[1] + by * b[1], a[2] + by * b[2]];
const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((x) => x / n); };
const turned = (v, axis, angle) => { // Rodrigues
  const c = Math.cos(angle), s = Math.sin(angle), k = dot(axis, v) * (1 - c), x = cross(axis, v);
  return [0, 1, 2].map((i) => v[i] * c + x[i] * s + axis[i] * k);
};

// Where one stands: place, axes of the camera (right, down, forward), distance of what is turned about, lens of a photograph.
class Camera {
  constructor(data) {
    const v = data.view;
    this.axes = [0, 1, 2].map((r) => [v[r], v[4 + r], v[8 + r]]);
    this.place = [0, 1, 2].map((i) => -(this.axes[0][i] * v[12] + this.axes[1][i] * v[13] + this.axes[2][i] * v[14]));
    Object.assign(this, { distance: data.depth || 1, lens: data.lens, size: data.size });
  }

  get view() {
    const [r, d, f] = this.axes, p = this.place;
    return new Float32Array([r[0], d[0], f[0], 0, r[1], d[1], f[1], 0, r[2], d[2], f[2], 0, -dot(r, p), -dot(d, p), -dot(f, p), 1]);
  }

  // fx fy cx cy for a canvas on which all of the photograph is to be seen: above a strip of such a share (`below`) and, the more
  // it `fills`, the larger and the less of it: from 0 to 1, where nothing is seen but the photograph.
  fitted(width, height, { below = 0, fills = 0, zoom = 1 } = {}) {
    const [w, h] = this.size, free = height * Math.max(1 - below, 0.5), [fx, fy, cx, cy] = this.lens;
    const by = zoom * Math.min(width / w, free / h) ** (1 - fills) * Math.max(width / w, free / h) ** fills;
    return [fx * by, fy * by, width / 2 + (cx - w / 2) * by, free / 2 + (cy - h / 2) * by];
  }

  copy() { return Object.assign(Object.create(Camera.prototype), this, { axes: this.axes.map((a) => [...a]), place: [...this.place] }); }
  turn(axis, angle) { this.axes = this.axes.map((a) => turned(a, axis, angle)); }

  // About the point in front, or about itself where `distance` is 0; never over the top.
  orbit(up, yaw, pitch, distance = this.distance) {
    const centre = plus(this.place, this.axes[2], distance), tilt = Math.asin(Math.max(-1, Math.min(1, dot(this.axes[2], up))));
    this.turn(up, yaw);
    this.turn(this.axes[0], Math.max(-1.45 - tilt, Math.min(1.45 - tilt, pitch)));
    this.axes = this.axes.map(unit);
    this.place = plus(centre, this.axes[2], -distance);
  }

  move(right, down, forward) {
    this.place = [right, down, forward].reduce((p, by, i) => plus(p, this.axes[i], by), this.place);
  }

  // On the way to another camera.
  towards(other, t) {
    const mid = this.copy(), mixed = [2, 1].map((k) => plus(this.axes[k].map((x) => x * (1 - t)), other.axes[k], t));
    const f = unit(mixed[0]), r = unit(cross(mixed[1], f));
    mid.axes = [r, cross(f, r), f];
    mid.place = plus(this.place.map((x) => x * (1 - t)), other.place, t);
    mid.distance = this.distance * (1 - t) + other.distance * t;
    mid.lens = this.lens.map((x, i) => (x / this.size[i % 2]) * (1 - t) * other.size[i % 2] + other.lens[i] * t);
    mid.size = other.size;
    return mid;
  }
}

class Place {
  // `scene`: head of pack.py with cameras, up, near, background and reach; `draw` shows a camera in the place of WebGL where
  // pictures come from elsewhere.
  constructor(canvas, scene, splats, painter = null) {
    Object.assign(this, { canvas, scene, splats, painter, first: null, second: null, blend: 1, wipe: -1, at: 0 });
    this.camera = new Camera(scene.cameras[0]);
    this.full = splats?.software ? 300 : 0; // milliseconds of a frame at full resolution, as far as is known
    this.moved = this.changed = true;
    this.keys = new Set();
    this.still = 0;
    this.flight = null;
    this.listeners = { pick: null, drawn: null };
    this.controls();
    const sizes = new ResizeObserver(() => this.resize());
    for (const each of [canvas, canvas.parentElement.querySelector(".bar")]) if (each) sizes.observe(each);
    if (splats) {
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
    const most = splats?.software ? MOST_MOVING.software : MOST_MOVING.card, first = FEWER.findIndex((every) => (splats?.count ?? 0) / every <= most);
    this.fewer = first < 0 ? FEWER.length - 1 : first;
    Object.assign(this, { zoom: 1, speed: 1, orbiting: false });
    this.fading = true; // what no photograph saw, into the background
    this.readSky();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.readSky());
    this.resize();
    requestAnimationFrame((now) => this.frame(now));
  }

  resize() {
    const box = this.canvas.getBoundingClientRect(), by = Math.min(window.devicePixelRatio || 1, 2, EDGE / Math.max(box.width, box.height, 1));
    const size = [box.width, box.height].map((side) => Math.max(1, Math.round(side * by)));
    const bar = this.canvas.parentElement.querySelector(".bar")?.getBoundingClientRect(); // styles lie over the stage
    const below = bar?.height && box.height ? Math.max(0, box.bottom - bar.top) / box.height : 0;
    if (below !== this.below) { this.below = below; this.touch(); }
    if (size[0] === this.canvas.width && size[1] === this.canvas.height) return;
    [this.canvas.width, this.canvas.height] = size;
    this.touch();
  }

  get lens() { return this.camera.fitted(this.canvas.width, this.canvas.height, { below: this.below, fills: this.scene.fills, zoom: this.zoom }); }
  get look() { return { first: this.first ?? this.second, second: this.second ?? this.first, blend: this.blend, wipe: this.wipe }; }

  // Something else is to be seen: `moved` where the camera is another one.
  touch(moved = true) {
    this.changed = true;
    this.moved ||= moved;
    this.still = performance.now();
  }

  show(changes) {
    Object.assign(this, changes);
    this.touch(false);
  }

  // Fly to a camera, or to where one may go that is nearest to it.
  go(camera, seconds = 0.7) {
    this.within(camera);
    const from = this.camera.copy(), start = performance.now();
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) seconds = 0;
    this.flight = (now) => {
      const t = seconds ? Math.min(1, (now - start) / 1000 / seconds) : 1;
      this.camera = t < 1 ? from.towards(camera, t * t * (3 - 2 * t)) : camera.copy();
      if (t >= 1) this.flight = null;
      this.touch();
    };
  }

  // The captured camera `by` further on.
  step(by) {
    const count = this.scene.cameras.length;
    this.at = (this.at + by + count) % count;
    this.go(new Camera(this.scene.cameras[this.at]));
  }

  // Back to where the page began.
  home() {
    this.at = 0;
    this.step(0);
  }

  frame(now) {
    requestAnimationFrame((next) => this.frame(next));
    this.fly(now);
    this.flight?.(now);
    if (this.painter) { this.painter(this); return; }
    if (this.lost || !this.look.first || !this.splats.styles.has(this.look.first) || this.waiting) return;
    const still = now - this.still > REST, every = still ? 1 : FEWER[this.fewer];
    if (!this.sorting && (this.moved || (still && this.splats.every !== 1))) {
      this.moved = false;
      this.sorting = true;
      this.splats.sort(this.camera.view, this.scene.near, every).then(() => { this.sorting = false; this.changed = true; });
    }
    const rest = still && !this.sorting && !this.moved;
    if (!this.splats.kept || !(this.changed || (rest && !this.exact))) return;
    const share = rest || !this.full ? 1 : SHARES.find((each) => each * each * this.full <= FRAME) ?? SHARES.at(-1);
    this.changed = false;
    this.exact = rest;
    const start = performance.now();
    this.paint({ share, exact: rest });
    this.wait(() => {
      if (!rest) this.spare(performance.now() - start, share);
      if (!rest) this.full = 0.5 * (this.full || (performance.now() - start) / share ** 2) + 0.5 * (performance.now() - start) / share ** 2;
      this.milliseconds = performance.now() - start;
      this.listeners.drawn?.(rest);
    });
  }

  // Draw fewer Gaussians of a moving camera where the fewest pixels take too long, and more where there is time.
  spare(milliseconds, share) {
    if (milliseconds > 2 * FRAME && share === SHARES.at(-1)) this.fewer = Math.min(this.fewer + 1, FEWER.length - 1);
    else if (milliseconds < FRAME / 3 && share === 1) this.fewer = Math.max(this.fewer - 1, 0);
  }

  // Draw what is to be seen into the canvas, over the page's own background.
  paint({ share = 1, exact = true } = {}) {
    const { near, cameras } = this.scene, [background, rim] = this.sky;
    this.splats.draw(this.camera.view, this.lens, this.look, { near, background, rim, depth: this.fading ? cameras[0].depth : 0, share, exact });
  }

  // Colours behind all things, in the middle and at the rim: those of the page's theme.
  readSky() {
    const style = getComputedStyle(this.canvas);
    this.sky = ["--near-sky", "--far-sky"].map((name) => style.getPropertyValue(name).trim().match(/[0-9a-f]{2}/gi).map((pair) => parseInt(pair, 16) / 255));
    this.touch(false);
  }

  // Until the graphics card has drawn: frames never queue.
  wait(done) {
    const gl = this.splats.gl, sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.waiting = true;
    const ask = () => {
      if (!gl.isContextLost() && gl.getSyncParameter(sync, gl.SYNC_STATUS) !== gl.SIGNALED) { setTimeout(ask, 4); return; }
      gl.deleteSync(sync);
      this.waiting = false;
      done();
    };
    setTimeout(ask, 0);
  }

  // World point under a pixel of the page; null where there is nothing.
  point(x, y) {
    if (this.lost) return null;
    const box = this.canvas.getBoundingClientRect(), by = this.canvas.width / box.width, lens = this.lens;
    const at = [(x - box.left) * by, (y - box.top) * by];
    const depth = this.splats?.pick(this.camera.view, lens, this.look, ...at, this.scene.near);
    this.changed = true;
    if (!depth) return null;
    const local = [(at[0] - lens[2]) / lens[0], (at[1] - lens[3]) / lens[1], 1];
    return local.reduce((p, v, i) => plus(p, this.camera.axes[i], v * depth), this.camera.place);
  }

  // Turn about what is under a pixel, and come a little nearer.
  focus(x, y) {
    const point = this.point(x, y);
    if (!point) return;
    const camera = this.camera.copy(), to = plus(point, camera.place, -1), forward = unit(to);
    camera.axes[2] = forward;
    camera.axes[0] = unit(cross(camera.axes[1], forward));
    camera.axes[1] = cross(forward, camera.axes[0]);
    // Of the sky, and of all that lies beyond where one may go, the direction alone counts.
    camera.distance = Math.min(Math.hypot(...to), this.scene.reach.radius);
    camera.move(0, 0, 0.25 * camera.distance);
    camera.distance *= 0.75;
    this.go(camera);
  }

  // Nobody leaves what was captured by more than its own size.
  within(camera) {
    const { centre, radius } = this.scene.reach, away = plus(camera.place, centre, -1), far = Math.hypot(...away);
    if (far > radius) camera.place = plus(centre, away, radius / far);
  }

  keep() {
    this.within(this.camera);
    this.touch();
  }

  // Keys that steer, wherever the focus is on a page that is the stage alone, else within the stage. A slider keeps its arrows.
  steers({ target, code }) {
    if (!(target instanceof Element) || target.closest("input:not([type=range]), select, textarea")) return false;
    if (target !== this.canvas && target.closest("[type=range], [role=slider]") && code.startsWith("Arrow")) return false;
    return this.scene.alone || Boolean(target.closest(".place"));
  }

  controls() {
    const { canvas } = this, pointers = new Map();
    let pressed = null, gap = 0;
    const turn = (dx, dy) => this.camera.orbit(this.scene.up, -3 * dx / canvas.clientHeight, 2 * dy / canvas.clientHeight, this.scene.within ? 0 : this.camera.distance);
    const pan = (dx, dy) => { const by = this.camera.distance * this.canvas.width / canvas.clientWidth / this.lens[0]; this.camera.move(-dx * by, -dy * by, 0); };
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.focus({ preventScroll: true });
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      pressed = pointers.size === 1 ? { x: event.clientX, y: event.clientY, far: 0 } : null;
      gap = 0;
      this.flight = null;
      clearTimeout(this.picking);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const dx = event.clientX - before[0], dy = event.clientY - before[1];
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      if (pressed) pressed.far += Math.hypot(dx, dy);
      if (pointers.size === 2) { // two fingers: pan and pinch
        const [[ax, ay], [bx, by]] = [...pointers.values()], now = Math.hypot(ax - bx, ay - by);
        if (gap) this.camera.move(0, 0, this.camera.distance * (1 - gap / now));
        gap = now;
        pan(dx / 2, dy / 2);
      } else if (event.shiftKey || event.buttons & 6) pan(dx, dy);
      else turn(dx, dy);
      this.keep();
    });
    const up = (event) => {
      pointers.delete(event.pointerId);
      if (event.type === "pointerup" && pressed && pressed.far < 5) {
        const { clientX, clientY } = event;
        this.picking = setTimeout(() => this.listeners.pick?.(clientX, clientY), CLICK_MS);
      }
      pressed = null;
    };
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("dblclick", (event) => {
      clearTimeout(this.picking);
      this.focus(event.clientX, event.clientY);
    });
    canvas.addEventListener("wheel", (event) => {
      if (!this.scene.alone && document.activeElement !== canvas) return; // a page is scrolled past it
      event.preventDefault();
      this.camera.move(0, 0, this.camera.distance * (1 - Math.exp(event.deltaY * (event.deltaMode ? 0.03 : 0.0012))));
      this.keep();
    }, { passive: false });
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || !KEYS[event.code] || !this.steers(event)) return;
      event.preventDefault();
      this.flight = null;
      this.keys.add(event.code);
    });
    addEventListener("keyup", (event) => this.keys.delete(event.code));
    addEventListener("blur", () => this.keys.clear());
  }

  // Turn by itself: all the way round what cameras stand around, else to and fro before it.
  turnOn(now, seconds) {
    const ahead = this.scene.cameras.map((each) => new Camera(each).axes[2]).reduce((sum, axis) => plus(sum, axis));
    const around = Math.hypot(...ahead) < AROUND_SHARE * this.scene.cameras.length;
    const speed = around ? 1 : Math.cos((now - this.orbiting) / 1000 * TURN_SPEED / SWING);
    this.camera.orbit(this.scene.up, TURN_SPEED * seconds * speed, 0);
    this.keep();
  }

  // Keys that are held.
  fly(now) {
    const seconds = Math.min(0.1, (now - (this.last ?? now)) / 1000);
    this.last = now;
    if (this.orbiting && !this.keys.size && !this.flight) this.turnOn(now, seconds);
    if (!this.keys.size) return;
    const by = seconds * this.camera.distance * 0.6 * this.speed;
    for (const code of this.keys) {
      const [kind, a, b, c] = KEYS[code];
      if (kind === "turn") this.camera.orbit(this.scene.up, a * seconds, b * seconds, this.scene.within ? 0 : this.camera.distance);
      else this.camera.move(a * by, b * by, c * by);
    }
    this.keep();
  }
}

const KEYS = {
  KeyW: ["move", 0, 0, 1], KeyS: ["move", 0, 0, -1], KeyA: ["move", -1, 0, 0], KeyD: ["move", 1, 0, 0], KeyQ: ["move", 0, 1, 0], KeyE: ["move", 0, -1, 0],
  ArrowLeft: ["turn", 0.9, 0], ArrowRight: ["turn", -0.9, 0], ArrowUp: ["turn", 0, 0.6], ArrowDown: ["turn", 0, -0.6],
};
