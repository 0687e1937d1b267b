// @ts-nocheck until its types are told
// The light of a scene of a server: it finds what the sun reaches, and this page what colours that makes (sun.js).

const ON_THE_WAY = 4; // degrees from the day's way within which a sun has a time

/** The panel of the light, and the light of looks. */
class LiveSun {
  /** @param {Live} live */
  constructor(live) {
    this.live = live;
    /** @type {?SunPanel} once what it needs has come */
    this.panel = null;
    /** @type {?Promise<LitSurfaces>} of a step of the scene's training */
    this.surfaces = null;
    this.step = null;
    // While the sun is dragged the panel goes ahead of the server, and so does what is wanted.
    this.moving = false;
    this.wanted = null;
    // Where the slider of the time was last.
    this.hour = null;
    // When the last wish was sent, and how long its light took to be shown.
    this.asked = 0;
    this.milliseconds = 0;
    at("light").hidden = false;
  }

  /** Fetch what all lights need, once for each step of a training. */
  load() {
    const { step } = this.live.scene;
    if (this.step !== step || !this.surfaces) {
      this.step = step;
      this.surfaces = this.fetched().catch((error) => { this.surfaces = null; throw error; });
    }
    return this.surfaces;
  }

  async fetched() {
    const { head, parts } = await unpacked(await asked("/surfaces"));
    const planes = await inflate(parts.planes), count = planes.length / 2;
    if (!this.panel) {
      this.panel = new SunPanel(this.live.place, { ahead: head.ahead, day: head.day, along: false }, {
        move: (sun, moving) => this.wish({ light: this.named === "moonlight" ? "moonlight" : null, sun }, moving),
        time: (hour, moving) => this.time(hour, moving),
        strengthen: (strength, moving) => this.wish({ strength }, moving),
        name: (name) => this.wish({ light: name === "captured" ? null : name, sun: null }, false),
      });
      this.fill(this.live.state.sun);
    }
    return { level: planes.subarray(0, count), open: planes.subarray(count), head };
  }

  /** The panel was opened. */
  open() {
    this.load().catch((error) => say(error.message, true));
  }

  get named() { return this.live.state.sun.light; }

  time(hour, moving) {
    this.hour = hour;
    const sun = sunAt(this.panel.day, hour).map((x) => Math.round(10 * x) / 10);
    if (sun[1] >= LEAST_ELEVATION) this.wish({ light: null, sun }, moving);
    else this.wish({ light: "blue-hour", sun: null }, moving);
  }

  /** Tell the server what light somebody wants. */
  wish(changes, moving) {
    this.moving = moving;
    this.wanted = { ...this.live.state.sun, ...this.wanted, ...changes };
    const { light, sun, strength } = this.wanted;
    this.show(this.wanted);
    const send = () => {
      this.asked = performance.now();
      this.live.tell("sun", { light, sun, strength, moving });
    };
    if (moving) this.live.panel.steady("sun", send);
    else {
      this.live.panel.pending.delete("sun");
      send();
    }
  }

  /** Show the light of a state, unless somebody is changing it. */
  fill(light) {
    if (this.moving) return;
    this.wanted = null;
    if (this.panel) this.show(light);
  }

  show({ light, sun, strength }, place = null) {
    const shown = sun ?? place, { day } = this.panel;
    let hour = light === "blue-hour" ? this.dusk : null;
    if (sun) {
      const near = hourAt(day, sun);
      if (dot(directionOf(sunAt(day, near)), directionOf(sun)) > Math.cos(ON_THE_WAY * Math.PI / 180)) hour = near;
    }
    this.panel.show({ name: light ?? (sun ? "" : "captured"), at: shown, hour, strength });
  }

  /** The time of a blue hour: that of the slider, if it was moved to one of the two, else the evening. */
  get dusk() {
    const { day } = this.panel;
    return this.hour !== null && sunAt(day, this.hour)[1] < LEAST_ELEVATION ? this.hour : day.at(-1).hour;
  }

  /** Fetch the light of a look and show it; without a version it has none. */
  async relight({ name, version }) {
    const { live } = this, { splats } = live.place;
    if (live.remote) live.remote.stale = true;
    if (splats && version === null) splats.light([name], null);
    if (splats && version !== null) {
      const surfaces = await this.load();
      const { head, parts } = await unpacked(await asked(`/light?name=${encodeURIComponent(name)}&version=${version}`));
      const part = { terms: head, met: parts.met ? await inflate(parts.met) : null, share: 1 };
      splats.light([name], gainsOf(surfaces, [part], splats.colours.get("Captured"), head.strength));
      if (name === "Now" && this.panel && !this.moving) this.show(live.state.sun, head.at);
      this.milliseconds = performance.now() - this.asked;
    }
    live.place.touch(false);
  }
}
