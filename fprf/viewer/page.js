// Over viser's canvas: photographs are dropped, weighed and removed here, a wipe is dragged, a region is told what to take.
"use strict";
(() => {
  const make = (tag, props = {}, ...inside) => {
    const node = Object.assign(document.createElement(tag), props);
    node.append(...inside);
    return node;
  };
  const ask = async (path, body, raw = false) => {
    const answer = await fetch(path, { method: "POST", body: raw ? body : JSON.stringify(body) });
    if (!answer.ok) throw new Error((await answer.text()).trim() || answer.statusText);
    return answer.json();
  };
  const told = make("div", { id: "fprf-said", className: "fprf" });
  told.setAttribute("role", "status");
  const say = (text, bad = false, seconds = 5) => {
    const line = make("div", { textContent: text, className: bad ? "bad" : "" });
    told.append(line);
    while (told.children.length > 4) told.firstChild.remove();
    if (seconds) setTimeout(() => line.remove(), 1000 * seconds);
    return line;
  };
  const tell = (path, body) => ask(path, body).catch((error) => say(error.message, true));

  // Photographs
  const veil = make("div", { id: "fprf-drop", className: "fprf" },
    make("div", {}, "Drop a photograph", make("small", { textContent: "the scene takes its style" })));
  const send = async (file) => {
    const line = say(`${file.name} …`, false, 0);
    try {
      await ask(`/fprf/photograph?name=${encodeURIComponent(file.name)}`, file, true);
    } catch (error) {
      say(error.message, true, 8);
    }
    line.remove();
  };
  const sendAll = async (files) => {
    for (const file of [...files].slice(0, 12)) await send(file);
  };
  const carries = (event) => [...(event.dataTransfer?.types ?? [])].includes("Files");
  let depth = 0;
  const on = (name, act) => window.addEventListener(name, (event) => {
    if (!carries(event)) return;
    event.preventDefault();
    event.stopPropagation();
    act(event);
  }, true);
  on("dragenter", () => { depth += 1; veil.classList.add("on"); });
  on("dragover", (event) => { event.dataTransfer.dropEffect = "copy"; });
  on("dragleave", () => { depth = Math.max(0, depth - 1); veil.classList.toggle("on", depth > 0); });
  on("drop", (event) => { depth = 0; veil.classList.remove("on"); sendAll(event.dataTransfer.files); });
  window.addEventListener("paste", (event) => {
    const files = [...(event.clipboardData?.files ?? [])].filter((file) => file.type.startsWith("image/"));
    if (files.length) sendAll(files);
  });
  const picker = make("input", { type: "file", accept: "image/*", multiple: true, hidden: true, id: "fprf-files" });
  picker.onchange = () => { sendAll(picker.files).then(() => { picker.value = ""; }); };

  // The shelf
  const shelf = make("div", { id: "fprf-shelf", className: "fprf" });
  const add = make("button", { id: "fprf-add", title: "Choose photographs, or drop them anywhere", onclick: () => picker.click() },
    make("b", { textContent: "+" }), "photograph");
  const press = (text) => [...document.querySelectorAll("button")].find((each) => each.textContent.trim() === text)?.click();
  const download = (href) => { const link = make("a", { href, download: "" }); document.body.append(link); link.click(); link.remove(); };
  let awaited = false;
  const act = (text, title, onclick) => make("button", { textContent: text, title, onclick });
  const acts = make("div", { className: "acts" },
    act("↓ .ply", "the Gaussians in this look, for other viewers", async () => {
      const line = say("writing the Gaussians …", false, 0);
      try {
        const answer = await fetch("/fprf/gaussians");
        if (!answer.ok) throw new Error(await answer.text());
        const name = /filename="(.*)"/.exec(answer.headers.get("content-disposition"))?.[1] ?? "restyled.ply";
        const link = make("a", { href: URL.createObjectURL(await answer.blob()), download: name });
        link.click();
        setTimeout(() => URL.revokeObjectURL(link.href), 60000);
      } catch (error) {
        say(error.message, true);
      }
      line.remove();
    }),
    act("↓ picture", "this view, as large as it is here", () => { awaited = true; press("Save a picture"); }),
    act("⌂ scenes", "another scene", () => ask("/fprf/start/leave", {}).then(() => location.replace("/"), (error) => say(error.message, true))));
  const cards = new Map();
  const card = (row) => {
    const picture = make("img", { src: `/fprf/card?card=${row.card}`, alt: row.name, draggable: false,
      title: `${row.name}\nclick: this one alone; shift-click: in or out of the mix` });
    const weight = make("input", { type: "range", min: 0, max: 2, step: 0.05, title: "weight in the mix" });
    weight.setAttribute("aria-label", `weight of ${row.name}`);
    const swatch = make("i", { hidden: true, title: "its colour in the map" });
    const node = make("div", { className: "fprf-card" }, picture, make("span", {}, swatch, row.name), weight,
      make("button", { textContent: "×", title: "remove", onclick: () => tell("/fprf/shelf", { card: row.card, action: "remove" }) }));
    picture.onclick = (event) => tell("/fprf/shelf", event.shiftKey
      ? { card: row.card, action: "weight", weight: node.classList.contains("on") ? 0 : 1 }
      : { card: row.card, action: "alone" });
    weight.oninput = () => {
      node.moved = Date.now();
      steady(`weight ${row.card}`, () => ask("/fprf/shelf", { card: row.card, action: "weight", weight: +weight.value }));
    };
    return Object.assign(node, { weight, swatch });
  };
  const fillShelf = (rows) => {
    const now = new Set(rows.map((row) => row.card));
    for (const [number, node] of cards) if (!now.has(number)) { node.remove(); cards.delete(number); }
    for (const row of rows) {
      if (!cards.has(row.card)) { cards.set(row.card, card(row)); shelf.insertBefore(cards.get(row.card), add); }
      const node = cards.get(row.card);
      node.classList.toggle("on", row.weight > 0);
      node.swatch.hidden = !row.colour;
      node.swatch.style.display = row.colour ? "" : "none";
      node.swatch.style.background = row.colour ?? "";
      if (Date.now() - (node.moved ?? 0) > 800) node.weight.value = row.weight;
    }
  };

  // One request at a time for what is dragged: the newest value follows the one before.
  const underway = new Map();
  const steady = async (name, act) => {
    if (underway.has(name)) { underway.set(name, act); return; }
    for (let next = act; next; next = underway.get(name)) {
      underway.set(name, null);
      try { await next(); } catch (error) { say(error.message, true); }
    }
    underway.delete(name);
  };

  // The wipe
  const wipe = make("div", { id: "fprf-wipe", className: "fprf" }, make("em", { textContent: "captured" }),
    make("i", { textContent: "⇔" }), make("em", { textContent: "restyled" }));
  let held = false;
  const place = (at) => { wipe.style.left = `${100 * at}vw`; };
  wipe.onpointerdown = (event) => { held = true; wipe.setPointerCapture(event.pointerId); event.preventDefault(); };
  wipe.onpointerup = () => { held = false; };
  wipe.onpointermove = (event) => {
    if (!held) return;
    const at = Math.min(1, Math.max(0, event.clientX / window.innerWidth));
    place(at);
    steady("wipe", () => ask("/fprf/wipe", { at }));
  };

  // A region
  const region = make("div", { id: "fprf-region", className: "fprf" });
  const fillRegion = (picked, rows) => {
    region.classList.toggle("on", picked !== null);
    if (!picked) return;
    const kept = picked.orders.some((order) => order.verb === "keep");
    const set = (verb, number) => picked.orders.some((order) => order.verb === verb && order.card === number);
    const button = (text, verb, number, chosen) => make("button", { textContent: text, className: chosen ? "set" : "",
      onclick: () => tell("/fprf/region", { verb: chosen ? "free" : verb, card: number }) });
    const share = new Map(picked.taken.map((row) => [row.name, row.share]));
    const lines = rows.map((row) => make("div", { className: "row" },
      make("img", { src: `/fprf/card?card=${row.card}`, alt: "" }),
      make("span", { textContent: share.has(row.name) ? `${Math.round(100 * share.get(row.name))} %  ${row.name}` : row.name, title: row.name }),
      button("only", "pin", row.card, set("pin", row.card)), button("never", "forbid", row.card, set("forbid", row.card))));
    region.replaceChildren(
      make("button", { className: "close", textContent: "×", title: "close", onclick: () => tell("/fprf/region", { verb: "close" }) }),
      make("h2", { textContent: `Region ${picked.region}` }),
      make("p", { textContent: `${(100 * picked.share).toFixed(1)} % of the scene${kept ? ", kept as it is" : rows.length ? "; it takes from" : ""}` }),
      ...lines,
      make("div", { className: "all" }, button("keep as it is", "keep", null, kept),
        make("button", { textContent: "free", onclick: () => tell("/fprf/region", { verb: "free" }) })));
  };

  // Training, where it goes on
  const training = make("div", { id: "fprf-training", className: "fprf" }, make("b"), make("span"), make("i"));
  const fillTraining = (now) => {
    training.classList.toggle("on", now !== null);
    if (!now) return;
    const over = now.share >= 1;
    const left = now.seconds_left === null ? "" : ` · ${Math.floor(now.seconds_left / 60)}:${String(Math.round(now.seconds_left) % 60).padStart(2, "0")} left`;
    const quality = now.psnr === null ? "" : ` · ${now.psnr.toFixed(1)} dB`;
    training.classList.toggle("over", over);
    training.children[0].textContent = over ? "trained" : now.what ? `training ${now.what}` : "training";
    training.children[1].textContent = over ? `${now.step} steps` : `step ${now.step}${quality}${left}`;
    training.children[2].style.width = `${100 * now.share}%`;
  };

  // The flight: what a client's own camera does goes by viser's buttons, the rest by requests
  const flight = make("div", { id: "fprf-flight", className: "fprf" });
  const edit = (key, action, after) => ask("/fprf/keys", { key, action }).then(() => after && press(after)).catch((error) => say(error.message, true));
  let flown = "";
  const fillFlight = ({ keys, chosen, film, playing }) => {
    const now = JSON.stringify([keys, chosen, film, playing]);
    if (now === flown) return;
    flown = now;
    flight.classList.toggle("on", keys.length > 0);
    const busy = film.total > 0 && !film.ready;
    const shots = keys.map((number, at) => {
      const small = (text, title, action) => make("button", { textContent: text, title, onclick: (event) => { event.stopPropagation(); action(); } });
      return make("div", { className: at === chosen ? "key on" : "key", title: "go there", onclick: () => edit(at, "choose", "Go to the chosen key") },
        number ? make("img", { src: `/fprf/key?key=${number}`, alt: `key ${at + 1}`, draggable: false }) : make("img", { alt: "" }),
        make("b", { textContent: at + 1 }),
        make("span", {}, small("‹", "earlier", () => edit(at, "earlier")), small("⟳", "replace by this view, in this look", () => edit(at, "choose", "Replace the chosen key")),
          small("×", "remove", () => edit(at, "remove")), small("›", "later", () => edit(at, "later"))));
    });
    flight.replaceChildren(...shots,
      make("div", { className: "acts" },
        make("button", { textContent: "+ key", title: "this view, in this look", onclick: () => press("Add a key here") }),
        make("button", { textContent: playing ? "■ stop" : "▶ play", title: "coarsely, here alone", disabled: keys.length < 2, onclick: () => press("Play the flight") }),
        make("button", { textContent: busy ? `${film.done} / ${film.total}` : "● film", title: "make an mp4", disabled: busy, onclick: () => press("Make the film") })));
  };

  // What has changed
  let version = -1;
  let film = false;
  let pictures = -1;
  const follow = async () => {
    for (;;) {
      try {
        const answer = await fetch(`/fprf/state?after=${version}`);
        if (answer.status === 404) { location.replace("/"); return; }
        if (!answer.ok) throw new Error(await answer.text());
        const state = await answer.json();
        state.said.forEach((text) => say(text, /error|cannot|must|none|not /.test(text)));
        version = state.version;
        fillShelf(state.shelf);
        fillRegion(state.picked, state.shelf);
        fillTraining(state.training);
        fillFlight(state);
        wipe.classList.toggle("on", state.wipe !== null);
        if (state.wipe !== null && !held) place(state.wipe);
        if (state.film.ready && !film && version > 0) {
          const line = say("", false, 60);
          line.append(make("a", { href: "/fprf/film", textContent: "download the film", style: "color:#9cc4ff" }));
        }
        film = state.film.ready;
        acts.children[0].hidden = !state.gaussians;
        acts.children[2].hidden = !state.start;
        if (state.pictures > pictures && pictures >= 0) {
          const href = `/fprf/picture?number=${state.pictures - 1}`;
          if (awaited) download(href);
          else say("", false, 20).append(make("a", { href, textContent: "download the picture", style: "color:#9cc4ff" }));
          awaited = false;
        }
        pictures = state.pictures;
      } catch (error) {
        await new Promise((done) => setTimeout(done, 1500));
      }
    }
  };
  const begin = () => {
    shelf.append(add, acts);
    document.body.append(veil, shelf, wipe, region, flight, training, told, picker);
    follow();
  };
  if (document.body) begin(); else window.addEventListener("DOMContentLoaded", begin);
})();
