// Files that one saves of what is shown: the scene, a picture, a style; and styles that are taken up again.

const MAX_PICTURE = 16384; // pixels of a side of a picture that is saved here; larger ones take GiB
const MAX_PAINTED = 4096; // of one that the server draws (messages.py)
const WORDS_MS = 50; // until words are seen, before a large picture is drawn; by eye

class Saving {
  /** @param {Live} live */
  constructor(live) {
    this.live = live;
    at("save-style").onclick = () => this.fetch("/style", { shown: live.stage.to }, "style");
    at("open-style").onclick = () => at("style-file").click();
    at("style-file").onchange = () => this.openStyle();
    at("save-ply").onclick = () => this.saveScene();
    at("save-picture").onclick = () => this.savePicture();
  }

  /**
   * Fetch what the server makes and save it; what it says against it is shown.
   * @param {string} path
   * @param {Object<string, string>} query
   * @param {string} what
   */
  async fetch(path, query, what) {
    wait("save", `Preparing the ${what} …`);
    try {
      const answer = await granted(await asked(`${path}?${new URLSearchParams(query)}`));
      const [, name = what] = /filename\*?=(?:utf-8'')?"?([^";]+)/i.exec(answer.headers.get("content-disposition") ?? "") ?? [];
      const blob = await counted(answer, (share) => wait("save", `Fetching the ${what} …`, share));
      download(URL.createObjectURL(blob), decodeURIComponent(name));
    } catch (error) {
      say(wordsOf(error), true);
    }
    wait("save");
  }

  /** The scene as it is shown: in its look, or so far on the way to it. */
  saveScene() {
    const { from, to, amount, wiping } = this.live.stage;
    if (this.live.known.map !== "none") say("The file holds the look; the map is on this page alone.");
    const percent = String(wiping ? 100 : Math.round(100 * amount));
    return this.fetch("/gaussians", { shown: to, start: from, percent, format: at("format").value.slice(1) }, "scene");
  }

  /** Take up a style that was saved. */
  async openStyle() {
    const file = at("style-file").files?.[0];
    if (!file) return;
    wait("style", `Taking up ${file.name} …`);
    try {
      this.live.changed = true;
      await post("/style", file);
    } catch (error) {
      say(`${file.name}: ${wordsOf(error)}`, true);
    }
    at("style-file").value = "";
    wait("style");
  }

  /** What is seen, once, twice or four times as large. */
  async savePicture() {
    const { place, scene, stage } = this.live.shown;
    const name = `${scene.name}.png`;
    const by = Number(at("scale").value);
    const { canvas, splats } = place;
    if (splats) {
      await this.saveDrawn(place, splats, by, name);
      return;
    }
    const side = Math.min(MAX_PAINTED, by * Math.max(canvas.width, canvas.height));
    await this.savePainted({ camera: this.live.camera(), side, shown: stage.to, wipe: place.wipe }, name);
  }

  /** A picture of Gaussians; WebGL keeps none, so it is drawn once more. @param {Place} place @param {Splats} splats @param {number} by @param {string} name */
  async saveDrawn(place, { gl }, by, name) {
    const { canvas } = place;
    const most = Math.min(MAX_PICTURE, gl.getParameter(gl.MAX_TEXTURE_SIZE));
    const width = canvas.width * by;
    const height = canvas.height * by;
    if (place.lost) {
      say(LOST, true);
      return;
    }
    if (Math.max(width, height) > most) {
      say(`${width} × ${height} pixels are more than the ${most} a side that can be drawn here; choose a smaller size.`, true);
      return;
    }
    wait("picture", `Drawing ${width} × ${height} pixels …`);
    await pause(WORDS_MS);
    canvas.width = width;
    canvas.height = height;
    place.paint();
    canvas.toBlob((blob) => {
      place.resize();
      place.touch();
      wait("picture");
      if (blob) download(URL.createObjectURL(blob), name);
    });
  }

  /** A picture of a scene that the server draws. @param {PictureRequest} request @param {string} name */
  async savePainted(request, name) {
    wait("picture", `Drawing ${request.side} pixels …`);
    try {
      download(URL.createObjectURL(await painted(request)), name);
    } catch (error) {
      say(wordsOf(error), true);
    }
    wait("picture");
  }
}
