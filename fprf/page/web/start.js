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

class Start {
  constructor() {
    Object.assign(this, { sending: null, garden: "" });
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
  }

  get minutes() { return Number(at("minutes").value) || 2; }
  drop(data) { if (!at("choose").hidden) this.attempt(async () => this.send(await carried(data))); }
  fault(text) { at("fault").textContent = text; at("fault").hidden = !text; if (text) scrollTo(0, 0); }
  attempt(act) { return act().catch((error) => this.fault(error.message)); }
  ask(type, more) { return post("/start", JSON.stringify({ type, ...more })); }
  open(path) { return this.attempt(async () => { this.fault(""); await this.ask("open", { path, minutes: this.minutes }); }); }

  stop() {
    return this.attempt(async () => {
      this.fault("");
      if (this.sending) { this.sending.stopped = true; this.fill({ stage: "idle", recent: [] }); } else await this.ask("stop");
    });
  }

  async send(given) {
    const { rows, top } = tidy(given);
    if (!rows.length || this.sending) return;
    this.fault("");
    const total = rows.reduce((sum, { file }) => sum + file.size, 0) || 1, refused = [];
    let done = 0;
    const sending = this.sending = { name: top || rows[0].name.replace(/\.[^.]*$/, ""), stage: "files", what: "sending", share: 0, detail: "" };
    const pictures = rows.filter(({ file }) => /^image\/(jpeg|png|webp|avif|bmp)$/.test(file.type)), step = Math.max(1, Math.ceil(pictures.length / 24));
    at("strip").replaceChildren(...pictures.filter((_, k) => k % step === 0).map(({ file }) => make("img", {
      src: URL.createObjectURL(file), alt: "", onload: (event) => URL.revokeObjectURL(event.target.src), onerror: (event) => event.target.remove() })));
    try {
      const { scene } = await this.ask("new", { name: rows.length > 1 && !top ? "photographs" : sending.name });
      for (const [k, { name, file }] of rows.entries()) {
        try {
          for (let begin = 0; begin < file.size || begin === 0; begin += PIECE) {
            if (sending.stopped) return;
            await post(`/start/piece?${new URLSearchParams({ scene, name, at: begin, size: file.size })}`, file.slice(begin, begin + PIECE));
            Object.assign(sending, { name: scene, share: (done + Math.min(file.size, begin + PIECE)) / total, detail: `${k + 1} of ${rows.length}` });
            this.fill(sending);
          }
        } catch (error) {
          refused.push(error.message);
        }
        done += file.size;
      }
      if (refused.length === rows.length) throw new Error(refused[0]);
      await this.ask("make", { scene, minutes: this.minutes });
      if (refused.length) this.fault(`Left out: ${refused.slice(0, 3).join("; ")}${refused.length > 3 ? `; and ${refused.length - 3} more` : ""}`);
    } catch (error) {
      this.sending = null;
      this.fill({ stage: "idle", recent: [] });
      throw error;
    } finally {
      this.sending = null;
    }
  }

  // How far it is
  fill(told) {
    const state = this.sending && told !== this.sending ? this.sending : told, idle = state.stage === "idle";
    at("choose").hidden = !idle;
    at("making").hidden = idle;
    if (idle) {
      if (state.garden) this.garden = state.garden;
      at("strip").replaceChildren();
      at("recent").hidden = !state.recent.length;
      at("recent").querySelector("ul").replaceChildren(...state.recent.map((row) => make("li", {}, make("button", { type: "button", title: row.path, onclick: () => this.open(row.path) },
        make("b", { textContent: row.name }), make("small", { textContent: `${row.kind}, ${row.when}` })))));
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
