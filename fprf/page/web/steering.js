// Pointers, wheel and keys that move a camera.

const CLICK_MS = 280; // until a click is known not to be the first half of a double click; by eye
const CLICK_PIXELS = 5; // that a pointer goes at most between down and up of a click; by eye
const MAX_FLY_SECONDS = 0.1; // of a held key that count in one frame: none flies far while the page was away
const DRAG_YAW = 3; // radians by a drag as long as the canvas is high; by eye
const DRAG_PITCH = 2;
const FLY_SPEED = 0.6; // distances of what is turned about, a second; by eye
const TURN_SPEED = 0.12; // radians a second of a scene that turns by itself; by eye
const SWING = 0.3; // radians to either side where it is not turned all the way round; by eye
const AROUND_SHARE = 0.5; // length of the mean direction of cameras, below which they stand around something; by eye
const LINE_PIXELS = 25; // of a wheel that counts lines; by eye
const WHEEL_RATE = 0.0012; // of a pixel of the wheel, in logarithms of the distance; by eye

/** Keys that move along the axes right, down, forward. @type {Object<string, Vector>} */
const MOVES = {
  KeyW: [0, 0, 1], KeyS: [0, 0, -1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyQ: [0, 1, 0], KeyE: [0, -1, 0],
};
/** Keys that turn: radians a second to the side and up. @type {Object<string, [number, number]>} */
const TURNS = {
  ArrowLeft: [0.9, 0], ArrowRight: [-0.9, 0], ArrowUp: [0, 0.6], ArrowDown: [0, -0.6],
};

/** A pointer that may still be a click. @typedef {{x: number, y: number, far: number}} Press */

/** What moves the camera of a place. */
class Steering {
  /** @param {Place} place */
  constructor(place) {
    this.place = place;
    /** @type {Map<number, [number, number]>} fingers and mice that are down, by their numbers */
    this.pointers = new Map();
    /** @type {Press?} */
    this.pressed = null;
    this.gap = 0; // between two fingers, in pixels
    /** @type {Set<string>} */
    this.keys = new Set();
    this.picking = 0;
    this.last = 0; // when held keys were asked for
    this.listen();
  }

  listen() {
    const { canvas } = this.place;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    canvas.addEventListener("pointerup", (event) => this.up(event));
    canvas.addEventListener("pointercancel", (event) => this.up(event));
    canvas.addEventListener("dblclick", (event) => {
      clearTimeout(this.picking);
      this.place.focus(event.clientX, event.clientY);
    });
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    addEventListener("keydown", (event) => this.press(event));
    addEventListener("keyup", (event) => this.keys.delete(event.code));
    addEventListener("blur", () => this.keys.clear());
  }

  /** @param {PointerEvent} event */
  down(event) {
    const { place, pointers } = this;
    place.canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    this.pressed = pointers.size === 1 ? { x: event.clientX, y: event.clientY, far: 0 } : null;
    this.gap = 0;
    place.flight = null;
    clearTimeout(this.picking);
  }

  /** @param {PointerEvent} event */
  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const right = event.clientX - before[0];
    const down = event.clientY - before[1];
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.pressed) this.pressed.far += Math.hypot(right, down);
    if (this.pointers.size === 2) {
      this.pinch();
      this.pan(right / 2, down / 2);
    } else if (event.shiftKey || event.buttons & 6) this.pan(right, down);
    else this.turn(right, down);
    this.place.keep();
  }

  /** Two fingers that come nearer to each other, or part. */
  pinch() {
    const { camera } = this.place;
    const [[ax, ay], [bx, by]] = [...this.pointers.values()];
    const now = Math.hypot(ax - bx, ay - by);
    if (this.gap) camera.move(0, 0, camera.distance * (1 - this.gap / now));
    this.gap = now;
  }

  /** @param {number} right @param {number} down pixels of the page */
  pan(right, down) {
    const { camera, canvas, lens } = this.place;
    const by = camera.distance * canvas.width / canvas.clientWidth / lens[0];
    camera.move(-right * by, -down * by, 0);
  }

  /** @param {number} right @param {number} down pixels of the page */
  turn(right, down) {
    const { camera, canvas, scene } = this.place;
    camera.orbit(scene.up, -DRAG_YAW * right / canvas.clientHeight, DRAG_PITCH * down / canvas.clientHeight);
  }

  /** @param {PointerEvent} event */
  up(event) {
    this.pointers.delete(event.pointerId);
    if (event.type === "pointerup" && this.pressed && this.pressed.far < CLICK_PIXELS) {
      const { clientX, clientY } = event;
      this.picking = window.setTimeout(() => this.place.listeners.pick?.(clientX, clientY), CLICK_MS);
    }
    this.pressed = null;
  }

  /** @param {WheelEvent} event */
  wheel(event) {
    const { canvas, scene, camera } = this.place;
    if (!scene.alone && document.activeElement !== canvas) return; // a page is scrolled past it
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode ? LINE_PIXELS : 1);
    camera.move(0, 0, camera.distance * (1 - Math.exp(pixels * WHEEL_RATE)));
    this.place.keep();
  }

  /** @param {KeyboardEvent} event */
  press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (!(event.code in MOVES || event.code in TURNS) || !this.steers(event)) return;
    event.preventDefault();
    this.place.flight = null;
    this.keys.add(event.code);
  }

  /**
   * Keys that steer, wherever the focus is on a page that is the stage alone, else within the stage. A slider keeps its arrows.
   * @param {KeyboardEvent} event
   */
  steers({ target, code }) {
    const { canvas, scene } = this.place;
    if (!(target instanceof Element) || writes(target)) return false;
    if (target !== canvas && target.closest("[type=range], [role=slider]") && code.startsWith("Arrow")) return false;
    return Boolean(scene.alone || target.closest(".place"));
  }

  /** Once a frame: keys that are held, and a scene that turns by itself. @param {number} now */
  step(now) {
    const { place, keys } = this;
    const seconds = Math.min(MAX_FLY_SECONDS, (now - (this.last || now)) / 1000);
    this.last = now;
    if (place.orbiting && !keys.size && !place.flight) this.turnOn(now - place.orbiting, seconds);
    if (!keys.size) return;
    const { camera, scene } = place;
    const far = seconds * camera.distance * FLY_SPEED * place.speed;
    for (const code of keys) {
      if (code in MOVES) camera.move(...times(MOVES[code], far));
      else camera.orbit(scene.up, TURNS[code][0] * seconds, TURNS[code][1] * seconds);
    }
    place.keep();
  }

  /**
   * Turn by itself: all the way round what cameras stand around, else to and fro before it.
   * @param {number} since milliseconds that it has turned
   * @param {number} seconds of this step
   */
  turnOn(since, seconds) {
    const { cameras, up } = this.place.scene;
    const ahead = cameras.map((each) => new Camera(each).axes[2]).reduce((sum, axis) => plus(sum, axis));
    const around = Math.hypot(...ahead) < AROUND_SHARE * cameras.length;
    const speed = around ? 1 : Math.cos(since / 1000 * TURN_SPEED / SWING);
    this.place.camera.orbit(up, TURN_SPEED * seconds * speed, 0);
    this.place.keep();
  }
}
