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
    addEventListener("drop", (event) => this.drop(event));
    addEventListener("paste", (event) => {
      const files = [...(event.clipboardData?.files ?? [])].filter((file) => file.type.startsWith("image/"));
      if (live.opened && files.length) this.send(files);
    });
    for (const link of every("[data-example]", HTMLElement)) {
      link.onclick = (event) => {
        if (!live.opened) return; // before there is a scene it is saved as a file
        event.preventDefault();
        this.example(link.dataset.example ?? "");
      };
    }
    at("add-photograph").onclick = () => at("photographs").click();
    at("photographs").onchange = async () => {
      await this.send(at("photographs").files ?? []);
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
    at("veil").hidden = !(on && this.live.opened);
    at("drop").classList.toggle("over", on);
    return true;
  }

  /** @param {DragEvent} event */
  drop(event) {
    if (!this.over(event, false) || !event.dataTransfer) return;
    if (this.live.opened) this.send(event.dataTransfer.files);
    else this.live.start.drop(event.dataTransfer);
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
   * @param {ArrayLike<File>} files
   */
  async send(files) {
    const all = Array.from(files);
    const some = all.slice(0, MAX_SENT);
    if (some.length < all.length) {
      const rest = all.slice(MAX_SENT).map((file) => file.name).join(", ");
      say(`${all.length} photographs: the first ${MAX_SENT} were taken, which is what fits beside a scene. Left out: ${rest}`, true);
    }
    let join = false;
    for (const [k, file] of some.entries()) {
      const several = some.length > 1;
      wait("photograph", `${file.name} …${several ? ` (${k + 1} of ${some.length})` : ""}`, several ? k / some.length : null);
      try {
        this.live.changed = true;
        await post(`/photograph?name=${encodeURIComponent(file.name)}${join ? "&join=1" : ""}`, file);
        join = true;
      } catch (error) {
        say(`${file.name}: ${wordsOf(error)}`, true);
      }
    }
    wait("photograph");
  }
}
