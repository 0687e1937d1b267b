// Where one stands. World and camera axes: right, down, forward.

/** Three numbers. @typedef {[number, number, number]} Vector */
/** Four numbers. @typedef {[number, number, number, number]} Lens fx fy cx cy in pixels */

/** @param {Vector} a @param {Vector} b */
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** @param {Vector} a @param {Vector} b @returns {Vector} */
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** a + by b. @param {Vector} a @param {Vector} b @param {number} by @returns {Vector} */
const plus = (a, b, by = 1) => [a[0] + by * b[0], a[1] + by * b[1], a[2] + by * b[2]];

/** @param {Vector} a @param {number} by @returns {Vector} */
const times = (a, by) => [by * a[0], by * a[1], by * a[2]];

/** @param {Vector} a @returns {Vector} */
const unit = (a) => times(a, 1 / (Math.hypot(...a) || 1));

/** Turn a vector about a unit axis (Rodrigues). @param {Vector} v @param {Vector} axis @param {number} angle @returns {Vector} */
const turned = (v, axis, angle) => {
  const along = dot(axis, v) * (1 - Math.cos(angle));
  return plus(plus(times(v, Math.cos(angle)), cross(axis, v), Math.sin(angle)), axis, along);
};

/**
 * A captured camera, as writer.py tells it: world to camera by columns, fx fy cx cy, width and height, distance that it turns about.
 * @typedef {{view: number[], lens: Lens, size: [number, number], depth: number}} CapturedCamera
 */

const MAX_TILT = 1.45; // radians up or down: never over the top; by eye

/** Place, axes (right, down, forward), distance of what is turned about, lens of a photograph. */
class Camera {
  /** @param {CapturedCamera} data */
  constructor({ view, lens, size, depth }) {
    /** @type {Vector[]} */
    this.axes = [0, 1, 2].map((row) => [view[row], view[4 + row], view[8 + row]]);
    const back = this.axes.map((axis, row) => times(axis, -view[12 + row]));
    /** @type {Vector} */
    this.place = plus(plus(back[0], back[1]), back[2]);
    this.distance = depth || 1;
    this.lens = lens;
    this.size = size;
  }

  /** World to camera by columns. */
  get view() {
    const [right, down, forward] = this.axes;
    const columns = [0, 1, 2].flatMap((k) => [right[k], down[k], forward[k], 0]);
    return new Float32Array([...columns, ...this.axes.map((axis) => -dot(axis, this.place)), 1]);
  }

  /**
   * A lens for a canvas on which all of the photograph is to be seen: above a strip of such a share (`below`) and, the more it
   * `fills`, the larger and the less of it: from 0 to 1, where nothing is seen but the photograph.
   * @param {number} width
   * @param {number} height
   * @returns {Lens}
   */
  fitted(width, height, { below: strip = 0, fills = 0, zoom = 1 } = {}) {
    const [w, h] = this.size;
    const free = height * Math.max(1 - strip, 0.5);
    const [fx, fy, cx, cy] = this.lens;
    const least = Math.min(width / w, free / h);
    const most = Math.max(width / w, free / h);
    const by = zoom * least ** (1 - fills) * most ** fills;
    return [fx * by, fy * by, width / 2 + (cx - w / 2) * by, free / 2 + (cy - h / 2) * by];
  }

  /** @returns {Camera} */
  copy() {
    const same = Object.create(Camera.prototype);
    return Object.assign(same, this, { axes: this.axes.map((axis) => [...axis]), place: [...this.place] });
  }

  /** @param {Vector} axis @param {number} angle */
  turn(axis, angle) {
    this.axes = this.axes.map((each) => turned(each, axis, angle));
  }

  /**
   * About the point in front, or about itself where `distance` is 0; never over the top.
   * @param {Vector} up
   * @param {number} yaw
   * @param {number} pitch
   */
  orbit(up, yaw, pitch, distance = this.distance) {
    const centre = plus(this.place, this.axes[2], distance);
    const tilt = Math.asin(bounded(dot(this.axes[2], up), -1, 1));
    this.turn(up, yaw);
    this.turn(this.axes[0], bounded(pitch, -MAX_TILT - tilt, MAX_TILT - tilt));
    this.axes = this.axes.map(unit);
    this.place = plus(centre, this.axes[2], -distance);
  }

  /** @param {number} right @param {number} down @param {number} forward */
  move(right, down, forward) {
    [right, down, forward].forEach((by, k) => { this.place = plus(this.place, this.axes[k], by); });
  }

  /** Look at a point. @param {Vector} point */
  face(point) {
    const forward = unit(plus(point, this.place, -1));
    const right = unit(cross(this.axes[1], forward));
    this.axes = [right, cross(forward, right), forward];
  }

  /** On the way to another camera. @param {Camera} other @param {number} t from 0 to 1 @returns {Camera} */
  towards(other, t) {
    const mid = this.copy();
    const [down, forward] = [1, 2].map((k) => plus(times(this.axes[k], 1 - t), other.axes[k], t));
    const ahead = unit(forward);
    const right = unit(cross(down, ahead));
    mid.axes = [right, cross(ahead, right), ahead];
    mid.place = plus(times(this.place, 1 - t), other.place, t);
    mid.distance = this.distance * (1 - t) + other.distance * t;
    const between = (/** @type {number} */ own, /** @type {number} */ k) => own / this.size[k % 2] * (1 - t) * other.size[k % 2] + other.lens[k] * t;
    mid.lens = [between(this.lens[0], 0), between(this.lens[1], 1), between(this.lens[2], 2), between(this.lens[3], 3)];
    mid.size = other.size;
    return mid;
  }
}
