// The light of a scene of a server: it finds what the sun reaches, and this page what colours that makes (sun.js).

const ON_THE_WAY = 4; // degrees from the day's way within which a sun has a time

/** The panel of the light, and the light of looks. */
class LiveSun {
  /** @param {Live} live */
  constructor(live) {
    this.live = live;
    /** @type {SunPanel?} once the surfaces have come */
    this.panel = null;
    /** @type {?Promise<LitSurfaces>} of a step of the scene's training */
    this.surfaces = null;
    /** @type {number?} */
    this.step = null;
    // While the sun is dragged the panel goes ahead of the server.
    this.moving = false;
    /** @type {SunState?} the light that was asked for and has not come */
    this.wanted = null;
    // Azimuth of the first view's direction.
    this.first = 0;
    /** @type {number?} where the slider of the time was last */
    this.hour = null;
    // When the last wish was sent, and how long its light took to be shown.
    this.asked = 0;
    this.milliseconds = 0;
    at("light").hidden = false;
  }

  /** Fetch what all lights need, once for each step of a training. */
  load() {
    const step = this.live.scene?.step ?? null;
    if (this.step !== step || !this.surfaces) {
      this.step = step;
      this.surfaces = this.fetched().catch((error) => { this.surfaces = null; throw error; });
    }
    return this.surfaces;
  }

  async fetched() {
    const { head, parts } = await unpacked(await asked("/surfaces"));
    this.first = head.first;
    const planes = await inflate(parts.planes);
    const count = planes.length / 2;
    if (!this.panel) {
      this.panel = new SunPanel(this.live.place, { ahead: head.ahead, north: head.north, day: head.day, along: false }, {
        move: (sun, moving) => this.wish({ light: this.named === "moonlight" ? "moonlight" : null, sun }, moving),
        time: (hour, moving) => this.time(hour, moving),
        strengthen: (strength, moving) => this.wish({ strength }, moving),
        name: (name) => this.wish({ light: name === "captured" ? null : name, sun: null }, false),
      });
      this.fill();
    }
    return { level: planes.subarray(0, count), open: planes.subarray(count), head };
  }

  /** The panel was opened. */
  open() {
    this.load().catch((error) => say(error.message, true));
  }

  /** The light of the state, its sun as the panel counts azimuths. @returns {SunState} */
  get light() {
    const light = this.live.state?.sun ?? { light: null, sun: null, from: "north", strength: 1 };
    if (!light.sun || light.from !== "view") return light;
    const [azimuth, elevation] = light.sun;
    return { ...light, sun: [(azimuth + this.first + 540) % 360 - 180, elevation], from: "north" };
  }

  get named() {
    return this.light.light;
  }

  /** @param {number} hour @param {boolean} moving */
  time(hour, moving) {
    if (!this.panel) return;
    this.hour = hour;
    const sun = tenths(sunAt(this.panel.day, hour));
    if (sun[1] >= LEAST_ELEVATION) this.wish({ light: null, sun }, moving);
    else this.wish({ light: "blue-hour", sun: null }, moving);
  }

  /** Ask the server for a light. @param {Partial<SunState>} changes @param {boolean} moving */
  wish(changes, moving) {
    this.moving = moving;
    this.wanted = { ...this.light, ...this.wanted, ...changes };
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

  /** Show the light of the state, unless somebody is changing it. */
  fill() {
    if (this.moving) return;
    this.wanted = null;
    if (this.panel) this.show(this.light);
  }

  /**
   * @param {SunState} wanted
   * @param {SunPlace?} place of the sun of a light that does not say where
   */
  show({ light, sun, strength }, place = null) {
    if (!this.panel) return;
    const { day } = this.panel;
    let hour = light === "blue-hour" ? this.dusk(day) : null;
    if (sun) {
      const near = hourAt(day, sun);
      if (dot(directionOf(sunAt(day, near)), directionOf(sun)) > Math.cos(ON_THE_WAY * Math.PI / 180)) hour = near;
    }
    this.panel.show({ name: light ?? (sun ? "" : "captured"), at: sun ?? place, hour, strength });
  }

  /** The time of a blue hour: that of the slider, if it was moved to one of the two, else the evening. @param {DayTime[]} day */
  dusk(day) {
    return this.hour !== null && sunAt(day, this.hour)[1] < LEAST_ELEVATION ? this.hour : timeOf(day, -1).hour;
  }

  /**
   * Fetch the light of a look and show it; without a version it has none.
   * @param {{name: string, version: number?}} message
   */
  async relight({ name, version }) {
    const { live } = this;
    const { splats } = live.place;
    if (live.remote) live.remote.stale = true;
    if (splats && version === null) splats.light([name], null);
    if (splats && version !== null) {
      const surfaces = await this.load();
      const { head, parts } = await unpacked(await asked(`/light?name=${encodeURIComponent(name)}&version=${version}`));
      const part = { terms: head, met: parts.met ? await inflate(parts.met) : null, share: 1 };
      const captured = splats.colours.get("Captured");
      if (captured) splats.light([name], gainsOf(surfaces, [part], captured, head.strength));
      if (name === "Now" && !this.moving) this.show(this.light, head.at);
      this.milliseconds = performance.now() - this.asked;
    }
    live.place.touch(false);
  }
}
