// What one sends: a link that holds where one stands and in which style, and a page that shows the scene within another one.

const VIEW_NUMBERS = 9; // of a view in a link: place, direction forward, roll, distance of what is turned about, zoom

/** Axes of a camera that looks forward without a roll: right, down, forward. */
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
    for (const button of document.querySelectorAll("[data-copy]")) button.onclick = () => this.copy(button);
    addEventListener("hashchange", () => this.read());
  }

  /** Take the address that others open, and show its code: it comes from the server. */
  share(address) {
    this.address = address;
    this.coded = true;
  }

  /** @returns {?string} the style that the link names */
  get asked() { return new URLSearchParams(location.hash.slice(1)).get("s"); }

  /** @returns {string} what stands behind # for what is seen now */
  get hash() {
    const { place, to, light } = this.stage, parts = new URLSearchParams();
    if (place instanceof Place) {
      const { camera, zoom, scene } = place, [right, down] = levelled(camera.axes[2], scene.up);
      const roll = Math.atan2(dot(camera.axes[0], down), dot(camera.axes[0], right));
      parts.set("v", [...camera.place, ...camera.axes[2], roll, camera.distance, zoom].map((x) => Number(x.toPrecision(5))).join(","));
    }
    if (to) parts.set("s", to);
    if (light?.hash) parts.set("l", light.hash);
    return parts.toString().replaceAll("%2C", ",");
  }

  /**
   * Go where a link leads, and choose its style.
   * @returns {boolean} whether it names a style that there is
   */
  read() {
    const given = new URLSearchParams(location.hash.slice(1)), { stage } = this, { place } = stage;
    const view = (given.get("v") ?? "").split(",").map(Number);
    if (place instanceof Place && view.length === VIEW_NUMBERS && view.every(Number.isFinite) && view[7] > 0 && view[8] > 0) this.stand(view);
    stage.light?.read?.(given.get("l"));
    const style = stage.styles.find(({ name }) => name === this.asked);
    if (style) stage.set({ to: style.name, amount: 1, wiping: false });
    return Boolean(style);
  }

  /** Stand at a view of a link, no farther than one may go. */
  stand(view) {
    const { place } = this.stage, axes = levelled(unit(view.slice(3, 6)), place.scene.up);
    Object.assign(place.camera, { place: view.slice(0, 3), axes: axes.map((axis) => turned(axis, axes[2], view[6])), distance: view[7] });
    place.zoom = Math.min(8, Math.max(0.2, view[8]));
    place.flight = null;
    place.keep();
  }

  /** Show the link and the page that embeds it. */
  fill() {
    const link = `${this.address}#${this.hash}`;
    at("link").value = link;
    at("embed").value = `<iframe src="${link.replaceAll("&", "&amp;").replaceAll('"', "&quot;")}" width="100%" height="560" style="border:0" allow="fullscreen; xr-spatial-tracking" allowfullscreen></iframe>`;
    at("code").hidden = !this.coded;
    if (this.coded && !at("sending").hidden) at("code").src = `/code?hash=${encodeURIComponent(this.hash)}`;
  }

  /** Copy a field; where the browser forbids it, it is selected, to be copied by hand. */
  async copy(button) {
    const field = at(button.dataset.copy);
    field.select();
    try {
      await navigator.clipboard.writeText(field.value);
      button.textContent = "Copied";
    } catch {
      button.textContent = "Ctrl C";
    }
    setTimeout(() => { button.textContent = "Copy"; }, 2000);
  }
}

/** How it is seen: angle, speed, what fades, turning, headset. */
class Seeing {
  /** @param {Place} place */
  constructor(place) {
    this.place = place;
    at("angle").oninput = () => this.widen(+at("angle").value);
    at("speed").oninput = () => { place.speed = +at("speed").value; this.fill(); };
    at("fading").onchange = () => { place.fading = at("fading").checked; place.touch(false); };
    at("orbiting").onchange = () => { place.orbiting = at("orbiting").checked ? performance.now() : false; };
    place.canvas.addEventListener("pointerdown", () => { place.orbiting = at("orbiting").checked = false; });
    at("fading").parentElement.hidden = !place.splats?.deep;
    if (place.splats && navigator.xr) {
      navigator.xr.isSessionSupported("immersive-vr").then((can) => { at("headset").hidden = !can; }, () => {});
      at("headset").onclick = () => new Headset(place).enter().catch((error) => { at("headset").textContent = error.message; });
    }
  }

  /** The vertical field of view now, in degrees. */
  get angle() { return 360 / Math.PI * Math.atan(this.place.canvas.height / 2 / this.place.lens[1]); }

  widen(degrees) {
    const { place } = this, tangent = Math.tan(degrees * Math.PI / 360);
    place.zoom *= place.canvas.height / 2 / tangent / place.lens[1];
    place.touch();
    this.fill();
  }

  fill() {
    at("angle").value = this.angle;
    at("angle").previousElementSibling.textContent = `${Math.round(this.angle)}°`;
    at("speed").previousElementSibling.textContent = `${this.place.speed.toFixed(1)}×`;
  }
}

/** The scene in a headset, as large as it is in its own units; one stands where the camera is. */
class Headset {
  /** @param {Place} place */
  constructor(place) { this.place = place; }

  async enter() {
    const { place } = this, { gl } = place.splats;
    const session = await navigator.xr.requestSession("immersive-vr", { optionalFeatures: ["local-floor"] });
    await gl.makeXRCompatible();
    session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl, { antialias: false }) });
    const space = await session.requestReferenceSpace("local");
    const start = place.camera.copy();
    place.lost = true; // the page draws nothing meanwhile
    while (place.sorting) await new Promise((done) => setTimeout(done, 5)); // one sort at a time
    session.addEventListener("end", () => { place.lost = false; place.touch(); });
    const frame = (_, xr) => {
      session.requestAnimationFrame(frame);
      const pose = xr.getViewerPose(space);
      if (pose) this.draw(session.renderState.baseLayer, pose, start);
    };
    session.requestAnimationFrame(frame);
  }

  /** Both eyes. The order of the Gaussians is that of the head, found beside the drawing. */
  draw(layer, pose, start) {
    const { place } = this, { splats, scene } = place;
    if (!this.sorting) {
      this.sorting = true;
      splats.sort(this.view(pose.transform, start), scene.near, FEWER[place.fewer]).then(() => { this.sorting = false; });
    }
    if (!splats.kept) return;
    for (const eye of pose.views) {
      const box = layer.getViewport(eye), p = eye.projectionMatrix;
      const lens = [p[0] * box.width / 2, p[5] * box.height / 2, (1 - p[8]) * box.width / 2, (1 + p[9]) * box.height / 2];
      const [background, rim] = place.sky;
      splats.draw(this.view(eye.transform, start), lens, place.look, { near: scene.near, background, rim, exact: false, into: { buffer: layer.framebuffer, box } });
    }
  }

  /** World to camera by columns: a transform of the headset (x right, y up, z back) before the camera that one began at. */
  view({ matrix }, start) {
    const [right, down, forward] = start.axes, frame = [right, down.map((x) => -x), forward.map((x) => -x)];
    const turned = (v) => frame.reduce((sum, axis, i) => plus(sum, axis, v[i]), [0, 0, 0]);
    const at_ = plus(start.place, turned([matrix[12], matrix[13], matrix[14]]));
    const axes = [0, 4, 8].map((k) => turned([matrix[k], matrix[k + 1], matrix[k + 2]]));
    return Object.assign(start.copy(), { place: at_, axes: [axes[0], axes[1].map((x) => -x), axes[2].map((x) => -x)] }).view;
  }
}
