// Photographs that are dropped, pasted or chosen, and sent to the server.

const MAX_SENT = 12; // photographs at once: as many as the shelf holds (messages.py)

/** What comes from the user's machine. */
class Photographs {
  /** @param {Live} live */
  constructor(live) {
    this.live = live;
    addEventListener("dragover", (event) => this.over(event, true));
    addEventListener("dragleave", (event) => {
      if (!event.relatedTarget) this.over(event, false);
    });
    addEventListener("drop", (event) => {
      if (!this.over(event, false)) return;
      if (live.scene) this.send(event.dataTransfer.files);
      else live.start.drop(event.dataTransfer);
    });
    addEventListener("paste", (event) => {
      const files = [...(event.clipboardData?.files ?? [])].filter((file) => file.type.startsWith("image/"));
      if (live.scene && files.length) this.send(files);
    });
    for (const link of document.querySelectorAll("[data-example]")) {
      link.onclick = (event) => {
        if (!live.scene) return; // before there is a scene it is saved as a file
        event.preventDefault();
        this.example(link.dataset.example);
      };
    }
    at("add-photograph").onclick = () => at("photographs").click();
    at("photographs").onchange = async () => {
      await this.send(at("photographs").files);
      at("photographs").value = "";
    };
  }

  /**
   * Show where files may be dropped.
   * @param {DragEvent} event
   * @param {boolean} on
   * @returns {boolean} whether it carries files
   */
  over(event, on) {
    if (!event.dataTransfer?.types.includes("Files")) return false;
    event.preventDefault();
    at("veil").hidden = !(on && this.live.scene);
    at("drop").classList.toggle("over", on);
    return true;
  }

  /**
   * Send one of the photographs that ship with fprf.
   * @param {string} name
   */
  async example(name) {
    const answer = await asked(`/examples/${name}`);
    if (answer.ok) await this.send([new File([await answer.blob()], name)]);
    else say(`${name}: ${answer.statusText}`, true);
  }

  /**
   * Send photographs, one after the other; those after the first join it in the mix, and a refused one is named.
   * @param {Iterable<File>} files
   */
  async send(files) {
    const all = [...files];
    const some = all.slice(0, MAX_SENT);
    if (some.length < all.length) {
      say(`${all.length} photographs: the first ${MAX_SENT} were taken, which is what fits beside a scene. Left out: ${
        all.slice(MAX_SENT).map((file) => file.name).join(", ")}`, true);
    }
    let join = false;
    for (const [k, file] of some.entries()) {
      wait("photograph", `${file.name} …${some.length > 1 ? ` (${k + 1} of ${some.length})` : ""}`, some.length > 1 ? k / some.length : null);
      try {
        this.live.changed = true;
        await post(`/photograph?name=${encodeURIComponent(file.name)}${join ? "&join=1" : ""}`, file);
        join = true;
      } catch (error) {
        say(`${file.name}: ${error.message}`, true);
      }
    }
    wait("photograph");
  }
}
