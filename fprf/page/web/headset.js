// The scene in a headset (WebXR), as large as it is in its own units; one stands where the camera is.

/**
 * What is used of WebXR, which the types of browsers lack.
 * @typedef {{matrix: ArrayLike<number>}} XrTransform
 * @typedef {{transform: XrTransform, projectionMatrix: ArrayLike<number>}} XrEye
 * @typedef {{transform: XrTransform, views: XrEye[]}} XrPose
 * @typedef {{framebuffer: WebGLFramebuffer?, getViewport: (eye: XrEye) => Box}} XrLayer
 * @typedef {{getViewerPose: (space: object) => XrPose?}} XrFrame
 * @typedef {EventTarget & {renderState: {baseLayer: XrLayer}, updateRenderState: (state: object) => void,
 *   requestReferenceSpace: (kind: string) => Promise<object>,
 *   requestAnimationFrame: (draw: (now: number, frame: XrFrame) => void) => number}} XrSession
 * @typedef {{isSessionSupported: (kind: string) => Promise<boolean>,
 *   requestSession: (kind: string, options: object) => Promise<XrSession>}} XrSystem
 * @typedef {new (session: XrSession, gl: WebGL2RenderingContext, options: object) => XrLayer} XrLayerMaker
 */

const SORTED_MS = 5; // between two looks at whether a sort has ended

class Headset {
  /** @param {Place} place @param {Splats} splats */
  constructor(place, splats) {
    this.place = place;
    this.splats = splats;
    this.sorting = false;
  }

  /** @param {XrSystem} xr */
  async enter(xr) {
    const { place } = this;
    const { gl } = this.splats;
    const session = await xr.requestSession("immersive-vr", { optionalFeatures: ["local-floor"] });
    await /** @type {{makeXRCompatible: () => Promise<void>}} */ (/** @type {unknown} */ (gl)).makeXRCompatible();
    const { XRWebGLLayer: Layer } = /** @type {{XRWebGLLayer: XrLayerMaker}} */ (/** @type {unknown} */ (window));
    session.updateRenderState({ baseLayer: new Layer(session, gl, { antialias: false }) });
    const space = await session.requestReferenceSpace("local");
    const start = place.camera.copy();
    place.lost = true; // the page draws nothing meanwhile
    while (place.sorting) await pause(SORTED_MS); // one sort at a time
    session.addEventListener("end", () => {
      place.lost = false;
      place.touch();
    });
    const frame = (/** @type {number} */ _, /** @type {XrFrame} */ shown) => {
      session.requestAnimationFrame(frame);
      const pose = shown.getViewerPose(space);
      if (pose) this.draw(session.renderState.baseLayer, pose, start);
    };
    session.requestAnimationFrame(frame);
  }

  /**
   * Both eyes. The order of the Gaussians is that of the head, found beside the drawing.
   * @param {XrLayer} layer
   * @param {XrPose} pose
   * @param {Camera} start
   */
  draw(layer, pose, start) {
    const { place, splats } = this;
    const { near } = place.scene;
    if (!this.sorting) {
      this.sorting = true;
      splats.sort(this.view(pose.transform, start), near, FEWER[place.fewer]).then(() => { this.sorting = false; });
    }
    if (!splats.kept || !place.look) return;
    const [background, rim] = place.sky;
    for (const eye of pose.views) {
      const box = layer.getViewport(eye);
      const into = { buffer: layer.framebuffer, box };
      splats.draw(this.view(eye.transform, start), this.lens(eye, box), place.look, { near, background, rim, exact: false, into });
    }
  }

  /** @param {XrEye} eye @param {Box} box @returns {Lens} */
  lens({ projectionMatrix: p }, { width, height }) {
    return [p[0] * width / 2, p[5] * height / 2, (1 - p[8]) * width / 2, (1 + p[9]) * height / 2];
  }

  /**
   * World to camera by columns: a transform of the headset (x right, y up, z back) before the camera that one began at.
   * @param {XrTransform} transform
   * @param {Camera} start
   */
  view({ matrix }, start) {
    const [right, down, forward] = start.axes;
    const seen = (/** @type {number} */ k) => plus(plus(times(right, matrix[k]), down, -matrix[k + 1]), forward, -matrix[k + 2]);
    const camera = start.copy();
    camera.place = plus(start.place, seen(12));
    camera.axes = [seen(0), times(seen(4), -1), times(seen(8), -1)];
    return camera.view;
  }
}
