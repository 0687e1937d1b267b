// Scenes that the server draws: the newest pictures on the canvas, and requests for others where the camera moves.

const VIEW_MS = 40; // between two requests; by eye
const REMOTE_PIXELS = 960; // longest side of pictures of Gaussians that the server draws; by eye
const MIN_REMOTE_PIXELS = 64; // of it (messages.py)

/**
 * What a picture of the server is to show (messages.py).
 * @typedef {{camera: CameraMessage, side: number, shown: string, wipe: number}} PictureRequest
 */

/** Draw pictures of the server over the whole canvas. @param {HTMLCanvasElement} canvas @param {ImageBitmap} picture_ */
const cover = (canvas, picture_) => canvas.getContext("2d")?.drawImage(picture_, 0, 0, canvas.width, canvas.height);

/** Pictures of a scene without Gaussians. */
class Field {
  /** @param {Live} live */
  constructor(live) {
    this.live = live;
    /** @type {{look: ImageBitmap?, captured: ImageBitmap?}} the newest picture of each kind */
    this.last = { look: null, captured: null };
    // The last request: when it was sent, and whether it asked for the captured colours too.
    this.sent = 0;
    /** @type {boolean?} */
    this.captured = null;
  }

  /**
   * Show a picture that has come.
   * @param {Uint8Array<ArrayBuffer>} data one byte for its kind, and a JPEG
   */
  async paint(data) {
    const kind = data[0] ? "captured" : "look";
    const bitmap = await createImageBitmap(new Blob([data.subarray(1)], { type: "image/jpeg" }));
    this.last[kind]?.close();
    this.last[kind] = bitmap;
    if (this.live.opened) this.draw(this.live.opened);
  }

  /** Whether the scene as it was captured is shown, and nothing else. @param {Stage} stage */
  plain({ to, wiping }) { return to === "Captured" && !wiping; }

  /** Draw the look, and left of the line what was captured. @param {Opened} opened */
  draw({ place: { canvas, wipe }, stage }) {
    const { look, captured } = this.last;
    if (!look) return;
    cover(canvas, this.plain(stage) && captured ? captured : look);
    if (wipe >= 0 && captured) {
      const { width, height } = captured;
      canvas.getContext("2d")?.drawImage(captured, 0, 0, wipe * width, height, 0, 0, wipe * canvas.width, canvas.height);
    }
    at("place").classList.add("drawn");
  }

  /** Once a frame: ask for what the camera sees where it has moved, at most every `VIEW_MS`. */
  step() {
    const { opened } = this.live;
    if (!opened) return;
    const { place, stage } = opened;
    const captured = place.wipe >= 0 || this.plain(stage);
    if (!place.changed && this.captured === captured) return;
    const now = performance.now();
    if ((place.moved || this.captured !== captured) && now - this.sent > VIEW_MS) {
      this.sent = now;
      this.captured = captured;
      place.moved = false;
      this.live.tell("view", { camera: this.live.camera(), captured });
    }
    place.changed = place.moved;
    this.draw(opened);
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
    const { opened } = this.live;
    if (!opened) return;
    const { place, stage } = opened;
    if (place.changed || place.moved) this.stale = true;
    if (!this.stale || this.busy) return;
    place.changed = false;
    place.moved = false;
    this.stale = false;
    this.busy = true;
    const side = bounded(Math.max(place.canvas.width, place.canvas.height), MIN_REMOTE_PIXELS, REMOTE_PIXELS);
    const request = { camera: this.live.camera(), side, shown: stage.to, wipe: place.wipe };
    this.draw(place.canvas, request).catch((error) => say(wordsOf(error), true)).finally(() => { this.busy = false; });
  }

  /** @param {HTMLCanvasElement} canvas @param {PictureRequest} request */
  async draw(canvas, request) {
    const bitmap = await createImageBitmap(await painted(request));
    cover(canvas, bitmap);
    bitmap.close();
    at("place").classList.add("drawn");
  }
}

/** A picture that the server draws. @param {PictureRequest} request */
const painted = async (request) => {
  const answer = await asked("/picture", { method: "POST", body: JSON.stringify({ type: "picture", ...request }) });
  return (await granted(answer)).blob();
};
