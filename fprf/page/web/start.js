// Before a scene is open: files are sent in pieces, then the progress of the scene is shown until it takes this place.
const PIECE = 8 << 20;
const ORDER = ["files", "poses", "training", "opening", "open"];

// Files to be sent, each with its name below the folder that was given.
const within = async (entry, folder) => {
  if (entry.isFile) return [{ name: folder + entry.name, file: await new Promise((done, failed) => entry.file(done, failed)) }];
  const reader = entry.createReader(), found = [];
  for (;;) {
    const some = await new Promise((done, failed) => reader.readEntries(done, failed));
    if (!some.length) return found;
    for (const each of some) found.push(...await within(each, `${folder}${entry.name}/`));
  }
};
const carried = async (data) => {
  const entries = [...data.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (!entries.length) return [...data.files].map((file) => ({ name: file.name, file }));
  return (await Promise.all(entries.map((entry) => within(entry, "")))).flat();
};
const tidy = (rows) => {
  const seen = rows.filter(({ name }) => !name.split("/").some((part) => part.startsWith(".")));
  const top = seen.length && seen.every(({ name }) => name.includes("/")) ? seen[0].name.split("/")[0] : "";
  if (!top || !seen.every(({ name }) => name.startsWith(`${top}/`))) return { rows: seen, top: "" };
  return { rows: seen.map(({ name, file }) => ({ name: name.slice(top.length + 1), file })), top };
};

/** The page before a scene is open: what can become one, what was made before, and how far the next one is. */
class Start {
  constructor() {
    // What is being sent from here, as a state; what the server told last; where the photographs of a garden lie.
    Object.assign(this, { sending: null, told: null, garden: "" });
    at("pick-files").onclick = () => at("files").click();
    at("pick-folder").onclick = () => at("folder").click();
    for (const id of ["files", "folder"]) {
      at(id).onchange = (event) => {
        const rows = [...event.target.files].map((file) => ({ name: file.webkitRelativePath || file.name, file }));
        this.attempt(() => this.send(rows)).then(() => { event.target.value = ""; });
      };
    }
    at("path").onsubmit = (event) => { event.preventDefault(); this.open(at("path-of").value); };
    at("open-garden").onclick = () => this.open(this.garden);
    at("stop").onclick = () => this.stop();
    at("minutes").onchange = () => this.attempt(async () => { this.minutes(); this.fault(""); });
    // Leaving would throw away what has been sent so far.
    addEventListener("beforeunload", (event) => { if (this.sending) event.preventDefault(); });
    addEventListener("pagehide", () => {
      if (this.sending?.scene) navigator.sendBeacon("/start", JSON.stringify({ type: "discard", scene: this.sending.scene }));
    });
  }

  /** @returns {number} minutes of training; an error in words for what is none */
  minutes() {
    const field = at("minutes"), value = field.valueAsNumber;
    if (value >= +field.min && value <= +field.max) return value;
    field.focus();
    throw new Error(`Training takes from ${field.min} to ${field.max} minutes; ${field.value || "nothing"} is none of these.`);
  }

  drop(data) { if (!at("choose").hidden) this.attempt(async () => this.send(await carried(data))); }
  fault(text) { at("fault").textContent = text; at("fault").hidden = !text; if (text) scrollTo(0, 0); }
  attempt(act) { return act().catch((error) => this.fault(error.message)); }
  ask(type, more) { return post("/start", JSON.stringify({ type, ...more })); }
  open(path) { return this.attempt(async () => { this.fault(""); await this.ask("open", { path, minutes: this.minutes() }); }); }

  stop() {
    return this.attempt(async () => {
      this.fault("");
      if (this.sending) {
        this.sending.stopped = true;
        return;
      }
      at("what").children[0].textContent = "ending it; what there is is being saved";
      await this.ask("stop");
    });
  }

  async send(given) {
    const { rows, top } = tidy(given);
    if (!rows.length || this.sending) return;
    this.fault("");
    const minutes = this.minutes();
    const total = rows.reduce((sum, { file }) => sum + file.size, 0) || 1, refused = [];
    let done = 0;
    const name = top || rows[0].name.replace(/\.[^.]*$/, "");
    const { scene } = await this.ask("new", { name: rows.length > 1 && !top ? "photographs" : name });
    const sending = this.sending = { scene, name: scene, stage: "files", what: "sending", share: 0, detail: "" };
    const pictures = rows.filter(({ file }) => /^image\/(jpeg|png|webp|avif|bmp)$/.test(file.type)), step = Math.max(1, Math.ceil(pictures.length / 24));
    at("strip").replaceChildren(...pictures.filter((_, k) => k % step === 0).map(({ file }) => make("img", {
      src: URL.createObjectURL(file), alt: "", onload: (event) => URL.revokeObjectURL(event.target.src), onerror: (event) => event.target.remove() })));
    this.fill(sending);
    try {
      for (const [k, { name: place, file }] of rows.entries()) {
        try {
          for (let begin = 0; begin < file.size || begin === 0; begin += PIECE) {
            if (sending.stopped) {
              await this.ask("discard", { scene });
              return;
            }
            await post(`/start/piece?${new URLSearchParams({ scene, name: place, at: begin, size: file.size })}`, file.slice(begin, begin + PIECE));
            Object.assign(sending, { share: (done + Math.min(file.size, begin + PIECE)) / total, detail: `${k + 1} of ${rows.length}` });
            this.fill(sending);
          }
        } catch (error) {
          if (error.message === NO_ANSWER) throw error;
          refused.push(error.message);
        }
        done += file.size;
      }
      if (refused.length === rows.length) {
        await this.ask("discard", { scene });
        throw new Error(refused[0]);
      }
      await this.ask("make", { scene, minutes });
      if (refused.length) this.fault(`Left out: ${refused.slice(0, 3).join("; ")}${refused.length > 3 ? `; and ${refused.length - 3} more` : ""}`);
    } finally {
      this.sending = null;
      this.fill(this.told);
    }
  }

  /** A scene of the list, with what can be done with it. */
  row(row) {
    const picture = make("img", { src: `/start/preview?${new URLSearchParams({ name: row.name })}`, alt: "", loading: "lazy", onerror: () => picture.replaceWith(make("span", { className: "blank" })) });
    const open = make("button", { type: "button", className: "open", title: row.path, onclick: () => this.open(row.path) },
      picture, make("b", { textContent: row.name }), make("small", { textContent: `${row.kind}, ${row.when}` }));
    const small = (textContent, title, onclick) => make("button", { type: "button", className: "small", textContent, title, ariaLabel: `${textContent} ${row.name}`, onclick });
    const acts = make("div", { className: "acts" });
    if (row.more) acts.append(small("Train on", "Go on with its training, for the minutes that are set above", () => this.open(row.more)));
    if (row.scene) {
      acts.append(small("Rename", "Give it another name", () => this.rename(row.scene)), small("Delete", "Delete it with all that was made of it", () => question(
        `Delete “${row.name}”, with its photographs, its training and all that was made of it?`,
        { Delete: () => this.attempt(() => this.ask("remove", { scene: row.scene })) })));
    }
    return make("li", {}, open, acts);
  }

  rename(scene) {
    const field = make("input", { value: scene, maxLength: 40, ariaLabel: "New name" });
    question(`A new name for “${scene}”:`, { Rename: () => this.attempt(async () => { this.fault(""); await this.ask("rename", { scene, name: field.value.trim() }); }) }, field);
    field.select();
  }

  /** How far it is, as the server told or as this page knows of what it sends. */
  fill(told) {
    if (told !== this.sending) this.told = told;
    const state = this.sending ?? told, idle = state.stage === "idle";
    at("choose").hidden = !idle;
    at("making").hidden = idle;
    if (idle) {
      if (state.garden) this.garden = state.garden;
      at("strip").replaceChildren();
      at("busy").hidden = !state.sending;
      at("busy").textContent = state.sending ? `“${state.sending}” is being sent from another page. One scene is made at a time: wait until it is there.` : "";
      at("recent").hidden = !state.recent.length;
      at("recent").querySelector("ul").replaceChildren(...state.recent.map((row) => this.row(row)));
      return;
    }
    at("name").textContent = state.name;
    for (const item of at("stages").children) {
      const place = ORDER.indexOf(item.dataset.stage), now = ORDER.indexOf(state.stage);
      item.className = place < now ? "done" : place === now ? "now" : "";
    }
    if (state.error) this.fault(state.error);
    at("what").hidden = at("bar").hidden = Boolean(state.error);
    at("what").children[0].textContent = state.what;
    at("what").children[1].textContent = state.detail;
    at("bar").className = state.share === null ? "busy" : "";
    at("bar").firstChild.style.width = `${100 * (state.share ?? 0)}%`;
    at("stop").textContent = state.error ? "Back" : "Stop";
    at("stop").hidden = ["opening", "open"].includes(state.stage) && !state.error;
    at("lines").hidden = !state.lines?.length;
    at("lines").querySelector("pre").textContent = (state.lines ?? []).join("\n");
    document.querySelector(".where").hidden = !state.folder;
    document.querySelector(".where code").textContent = state.folder ?? "";
  }
}
