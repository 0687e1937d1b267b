// Scenes that the server draws: the newest pictures on the canvas, and requests for others where the camera moves.

const VIEW_MS = 40; // between two requests; by eye
const REMOTE_PIXELS = 960; // longest side of pictures of Gaussians that the server draws; by eye

/** Pictures of a scene without Gaussians. */
class Field {
  /** @param {Live} live */
  constructor(live) {
    this.live = live;
    /** @type {{look: ?ImageBitmap, captured: ?ImageBitmap}} the newest picture of each kind */
    this.last = { look: null, captured: null };
    // The last request: when it was sent, and whether it asked for the captured colours too.
    this.sent = 0;
    this.captured = undefined;
  }

  /**
   * Show a picture that has come.
   * @param {Uint8Array} data one byte for its kind, and a JPEG
   */
  async paint(data) {
    const kind = data[0] ? "captured" : "look";
    const bitmap = await createImageBitmap(new Blob([data.subarray(1)], { type: "image/jpeg" }));
    this.last[kind]?.close();
    this.last[kind] = bitmap;
    this.draw();
  }

  /** Whether the scene as it was captured is shown, and nothing else. */
  get plain() { return this.live.stage?.to === "Captured" && !this.live.stage.wiping; }

  /** Draw the look, and left of the line what was captured. */
  draw() {
    const { canvas, wipe } = this.live.place;
    const { look, captured } = this.last;
    const context = canvas.getContext("2d");
    if (!look) return;
    if (this.plain && captured) {
      context.drawImage(captured, 0, 0, canvas.width, canvas.height);
      return;
    }
    context.drawImage(look, 0, 0, canvas.width, canvas.height);
    if (wipe >= 0 && captured) {
      context.drawImage(captured, 0, 0, wipe * captured.width, captured.height, 0, 0, wipe * canvas.width, canvas.height);
    }
    at("place").classList.add("drawn");
  }

  /** Once a frame: ask for what the camera sees where it has moved, at most every `VIEW_MS`. */
  step() {
    const place = this.live.place;
    const captured = place?.wipe >= 0 || this.plain;
    if (!place?.changed && this.captured === captured) return;
    const now = performance.now();
    if ((place.moved || this.captured !== captured) && now - this.sent > VIEW_MS) {
      this.sent = now;
      this.captured = captured;
      place.moved = false;
      this.live.tell("view", { camera: this.live.camera(), captured });
    }
    place.changed = place.moved;
    this.draw();
  }
}

/** Pictures of Gaussians for a browser that cannot draw them: one at a time, of where the camera was last. */
class Remote {
  /** @param {Live} live */
  constructor(live) {
    this.live = live;
    this.busy = false;
    this.stale = true; // what is on the canvas is not what is to be seen
  }

  /** Once a frame: ask for what is to be seen where that has changed and no picture is under way. */
  step() {
    const { place, stage } = this.live;
    if (place?.changed || place?.moved) this.stale = true;
    if (!place || !stage || !this.stale || this.busy) return;
    place.changed = false;
    place.moved = false;
    this.stale = false;
    this.busy = true;
    const { canvas } = place;
    const side = Math.max(64, Math.min(REMOTE_PIXELS, Math.max(canvas.width, canvas.height)));
    const picture = { type: "picture", camera: this.live.camera(), side, shown: stage.to, wipe: place.wipe };
    this.draw(picture).catch((error) => say(error.message, true)).finally(() => { this.busy = false; });
  }

  async draw(picture) {
    const answer = await asked("/picture", { method: "POST", body: JSON.stringify(picture) });
    if (!answer.ok) throw new Error((await answer.text()).trim());
    const bitmap = await createImageBitmap(await answer.blob());
    const { canvas } = this.live.place;
    canvas.getContext("2d").drawImage(bitmap, 0, 0, canvas.width, canvas.height);
    bitmap.close();
    at("place").classList.add("drawn");
  }
}
