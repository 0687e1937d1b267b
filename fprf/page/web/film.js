// Keyframes of a film, and the film that is made of them.

const FLIGHT_MS = 30; // between looks at whether a flight has ended; by eye

/** Numbers outside of a field's range are said, not sent. @param {HTMLInputElement} field @param {string} what @returns {number?} */
const limited = (field, what) => {
  const value = field.valueAsNumber;
  if (value >= Number(field.min) && value <= Number(field.max)) return value;
  say(`${what}: ${field.value || "nothing"} is no number from ${field.min} to ${field.max}.`, true);
  field.focus();
  return null;
};

class Film {
  /** @param {Live} live */
  constructor(live) {
    this.live = live;
    this.ready = true; // in the last state
    at("add-key").onclick = () => live.tell("key", { action: "add", camera: live.camera(), shown: live.stage.to });
    at("play").onclick = () => this.play();
    at("make-film").onclick = () => this.make();
  }

  make() {
    const seconds = limited(at("seconds"), "Seconds between two views");
    if (seconds === null) return;
    this.live.tell("film", { seconds, side: Number(at("film-side").value), fps: Number(at("film-fps").value) });
  }

  /** @param {CameraMessage[]} keys @param {FilmState} film */
  fill(keys, { done, total, ready }) {
    at("keys").replaceChildren(...keys.map((key, number) => this.key(key, number)));
    const busy = total > 0 && !ready;
    at("make-film").textContent = busy ? `${done} / ${total}` : "Make film";
    at("make-film").disabled = busy || !keys.length;
    at("play").disabled = keys.length < 2;
    if (ready && !this.ready) this.offer();
    this.ready = ready;
  }

  /** The buttons of a keyframe. @param {CameraMessage} key @param {number} number */
  key(key, number) {
    const tell = (/** @type {string} */ action) => this.live.tell("key", { action, at: number });
    /** @param {string} text @param {string} title @param {() => void} onclick */
    const button = (text, title, onclick) => make("button", { type: "button", textContent: text, title, ariaLabel: `view ${number + 1}: ${title}`, onclick });
    return make("span", { className: "key" },
      button(String(number + 1), "go there", () => this.live.place.go(this.live.keyed(key))),
      button("‹", "earlier", () => tell("earlier")),
      button("×", "remove", () => tell("remove")));
  }

  offer() {
    const line = say("", true);
    line.classList.remove("bad");
    line.append(make("a", { href: "/film", textContent: "Download the film", download: "" }));
  }

  /** Fly from keyframe to keyframe. */
  async play() {
    const { place, known } = this.live;
    for (const key of known.keys) {
      place.go(this.live.keyed(key), at("seconds").valueAsNumber);
      while (place.flight) await pause(FLIGHT_MS);
    }
  }
}
