// What is said to whoever looks at the page: notes, how far something is, questions.

const NOTE_MS = 6000; // that a note stays; by eye
const MAX_NOTES = 4; // at the same time; by eye

/**
 * Show a note. What is wrong stays until it is clicked away.
 * @param {string} text
 * @param {boolean} bad
 * @returns {HTMLButtonElement}
 */
const say = (text, bad = false) => {
  const line = make("button", { type: "button", textContent: text, className: bad ? "bad" : "", title: "close" });
  line.onclick = () => line.remove();
  at("said").append(line);
  const notes = [...at("said").querySelectorAll("button")];
  notes.slice(0, -MAX_NOTES).forEach((old) => old.remove());
  if (!bad) setTimeout(() => line.remove(), NOTE_MS);
  return line;
};

/** What takes its time, by its kind: lines that stay until it is done. @type {Map<string, HTMLElement>} */
const waits = new Map();

/**
 * Show how far something is; without words it is done.
 * @param {string} kind
 * @param {string} what
 * @param {number?} share in [0, 1]; null = not known
 */
const wait = (kind, what = "", share = null) => {
  if (!what) {
    waits.get(kind)?.remove();
    waits.delete(kind);
    return;
  }
  const line = waits.get(kind) ?? make("div", { className: "wait" }, make("span"), make("progress", { max: 1 }));
  if (!waits.has(kind)) {
    waits.set(kind, line);
    at("said").prepend(line);
  }
  below(line, "span").textContent = what;
  if (share === null) below(line, "progress").removeAttribute("value");
  else below(line, "progress").setAttribute("value", String(share));
};

/**
 * Ask before something is lost.
 * @param {string} text
 * @param {Object<string, () => void>} answers what is done, by its word
 * @param {...HTMLElement} more fields of the question
 */
const question = (text, answers, ...more) => {
  const box = make("dialog", { className: "ask" }, make("p", { textContent: text }), ...more);
  const row = make("div", { className: "row" });
  for (const [word, act] of Object.entries({ ...answers, Cancel: () => {} })) {
    const button = make("button", { type: "button", className: "pill", textContent: word });
    button.onclick = () => {
      box.close();
      act();
    };
    row.append(button);
  }
  box.append(row);
  box.onclose = () => box.remove();
  (document.fullscreenElement ?? document.body).append(box);
  box.showModal();
};
