// The start page: files are sent in pieces, then the progress of the scene is shown until the viewer takes this page's place.
"use strict";
(() => {
  const PIECE = 8 << 20;
  const at = (id) => document.getElementById(id);
  const make = (tag, props = {}, ...inside) => {
    const node = Object.assign(document.createElement(tag), props);
    node.append(...inside);
    return node;
  };
  const post = async (path, body) => {
    const answer = await fetch(path, { method: "POST", body });
    if (!answer.ok) throw new Error((await answer.text()).trim() || answer.statusText);
    return answer.json();
  };
  const ask = (path, value) => post(path, JSON.stringify(value));
  const fault = (text) => { at("fault").textContent = text; at("fault").hidden = !text; if (text) scrollTo(0, 0); };
  const attempt = (act) => act().catch((error) => fault(error.message));
  const minutes = () => Number(at("minutes").value) || 2;

  // Files to be sent, each with its name below the folder that was given
  const within = async (entry, folder) => {
    if (entry.isFile) {
      return [{ name: folder + entry.name, file: await new Promise((done, failed) => entry.file(done, failed)) }];
    }
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

  let sending = null;
  const strip = at("strip");
  const thumbnails = (rows) => {
    const pictures = rows.filter(({ file }) => /^image\/(jpeg|png|webp|avif|bmp)$/.test(file.type));
    const step = Math.max(1, Math.ceil(pictures.length / 24));
    strip.replaceChildren(...pictures.filter((_, k) => k % step === 0).map(({ file }) =>
      make("img", { src: URL.createObjectURL(file), alt: "", onload: (event) => URL.revokeObjectURL(event.target.src),
        onerror: (event) => event.target.remove() })));
  };
  const send = async (given) => {
    const { rows, top } = tidy(given);
    if (!rows.length || sending) return;
    fault("");
    const total = rows.reduce((sum, { file }) => sum + file.size, 0) || 1;
    const refused = [];
    let done = 0;
    sending = { name: top || rows[0].name.replace(/\.[^.]*$/, ""), stage: "files", what: "sending", share: 0, detail: "" };
    thumbnails(rows);
    try {
      const { scene } = await ask("/fprf/start/new", { name: rows.length > 1 && !top ? "photographs" : sending.name });
      sending.name = scene;
      for (const [k, { name, file }] of rows.entries()) {
        try {
          for (let begin = 0; begin < file.size || begin === 0; begin += PIECE) {
            if (sending.stopped) return;
            const place = new URLSearchParams({ scene, name, at: begin, size: file.size });
            await post(`/fprf/start/piece?${place}`, file.slice(begin, begin + PIECE));
            Object.assign(sending, { share: (done + Math.min(file.size, begin + PIECE)) / total, detail: `${k + 1} of ${rows.length}` });
            fill(sending);
          }
        } catch (error) {
          refused.push(error.message);
        }
        done += file.size;
      }
      if (refused.length === rows.length) throw new Error(refused[0]);
      await ask("/fprf/start/make", { scene, minutes: minutes() });
      if (refused.length) fault(`Left out: ${refused.slice(0, 3).join("; ")}${refused.length > 3 ? `; and ${refused.length - 3} more` : ""}`);
    } finally {
      sending = null;
    }
  };

  // How far it is
  const ORDER = ["files", "poses", "training", "opening", "open"];
  let drawn = -1, listed = "";
  const fill = (state) => {
    const idle = state.stage === "idle";
    at("choose").hidden = !idle;
    at("making").hidden = idle;
    if (idle) { strip.replaceChildren(); at("picture").hidden = true; drawn = -1; list(state.recent); return; }
    at("name").textContent = state.name;
    for (const item of at("stages").children) {
      const place = ORDER.indexOf(item.dataset.stage), now = ORDER.indexOf(state.stage);
      item.className = place < now ? "done" : place === now ? "now" : "";
    }
    if (state.error) fault(state.error);
    at("what").hidden = at("bar").hidden = Boolean(state.error);
    at("what").children[0].textContent = state.what;
    at("what").children[1].textContent = state.detail;
    at("bar").className = state.share === null ? "busy" : "";
    at("bar").firstChild.style.width = `${100 * (state.share ?? 0)}%`;
    at("show").hidden = state.stage !== "training" || !(state.picture >= 0) || Boolean(state.error);
    at("stop").textContent = state.error ? "Back" : "Stop";
    at("stop").hidden = ["opening", "open"].includes(state.stage) && !state.error;
    at("said").hidden = !state.lines?.length;
    at("said").querySelector("pre").textContent = (state.lines ?? []).join("\n");
    document.querySelector(".where").hidden = !state.folder;
    document.querySelector(".where code").textContent = state.folder ?? "";
    if (state.picture > drawn) {
      drawn = state.picture;
      const next = new Image();
      next.onload = () => { at("picture").src = next.src; at("picture").hidden = false; strip.replaceChildren(); };
      next.src = `/fprf/start/picture?step=${drawn}`;
    }
  };
  const list = (rows) => {
    const now = JSON.stringify(rows);
    if (now === listed) return;
    listed = now;
    at("recent").hidden = !rows.length;
    at("recent").querySelector("ul").replaceChildren(...rows.map((row) => make("li", {}, make("button", {
      type: "button", title: row.path, onclick: () => open(row.path) },
      make("b", { textContent: row.name }), make("small", { textContent: `${row.kind}, ${row.when}` })))));
  };
  const open = (path) => attempt(async () => { fault(""); await ask("/fprf/start/open", { path, minutes: minutes() }); });
  const stop = (then) => attempt(async () => {
    fault("");
    if (sending) { sending.stopped = true; return; }
    await ask("/fprf/start/stop", { then });
  });

  // What the user does
  at("pick-files").onclick = () => at("files").click();
  at("pick-folder").onclick = () => at("folder").click();
  for (const id of ["files", "folder"]) {
    at(id).onchange = (event) => {
      const rows = [...event.target.files].map((file) => ({ name: file.webkitRelativePath || file.name, file }));
      attempt(() => send(rows)).then(() => { event.target.value = ""; });
    };
  }
  at("path").onsubmit = (event) => { event.preventDefault(); open(at("place").value); };
  at("show").onclick = () => stop("show");
  at("stop").onclick = () => stop("leave");
  addEventListener("dragover", (event) => { event.preventDefault(); at("drop").classList.add("over"); });
  addEventListener("dragleave", (event) => { if (!event.relatedTarget) at("drop").classList.remove("over"); });
  addEventListener("drop", (event) => {
    event.preventDefault();
    at("drop").classList.remove("over");
    if (!at("choose").hidden) attempt(async () => send(await carried(event.dataTransfer)));
  });

  const follow = async () => {
    for (;;) {
      try {
        const answer = await fetch("/fprf/start");
        if (answer.ok) {
          const state = await answer.json();
          if (state.stage === "open") { location.replace("/"); return; }
          fill(sending ?? state);
        }
      } catch (error) { /* the server is busy or ends; ask again */ }
      await new Promise((done) => setTimeout(done, 700));
    }
  };
  follow();
})();
