// What is asked of the server, and files that it answers with.

const NO_ANSWER = "the viewer does not answer; is `fprf view` still running? This is tried again by itself.";

/**
 * Ask the server.
 * @param {string} path
 * @param {RequestInit=} init
 * @returns {Promise<Response>} an error in words where nobody answers
 */
const asked = async (path, init) => {
  try {
    return await fetch(path, init);
  } catch {
    throw new Error(NO_ANSWER);
  }
};

/** An error with the server's words where it refuses. @param {Response} answer */
const granted = async (answer) => {
  if (!answer.ok) throw new Error((await answer.text()).trim() || answer.statusText);
  return answer;
};

/**
 * Send a body to the server.
 * @param {string} path
 * @param {BodyInit} body
 * @returns {Promise<any>} the JSON that it answers
 */
const post = async (path, body) => (await granted(await asked(path, { method: "POST", body }))).json();

/**
 * The body of an answer, with how much of it has come.
 * @param {Response} answer
 * @param {(share: number?) => void} tell
 * @returns {Promise<Blob>}
 */
const counted = async (answer, tell) => {
  const total = Number(answer.headers.get("content-length"));
  const parts = [];
  let done = 0;
  const reader = answer.body?.getReader();
  for (;;) {
    const part = await reader?.read();
    if (!part?.value) return new Blob(parts);
    parts.push(part.value);
    done += part.value.length;
    tell(total ? done / total : null);
  }
};

/**
 * JSON and sections of one body (pack.py): bytes of the head as a number of four bytes, the head, the sections.
 * @param {Response} answer
 * @param {(share: number?) => void} tell how much of it has come
 * @returns {Promise<{head: any, parts: Object<string, Uint8Array<ArrayBuffer>>}>} the head is the server's JSON
 */
const unpacked = async (answer, tell = () => {}) => {
  const data = new Uint8Array(await (await counted(await granted(answer), tell)).arrayBuffer());
  const length = new DataView(data.buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(data.subarray(4, 4 + length)));
  /** @type {Object<string, Uint8Array<ArrayBuffer>>} */
  const parts = {};
  let from = 4 + length;
  for (const [name, size] of Object.entries(head.sizes)) {
    parts[name] = data.subarray(from, from + size);
    from += size;
  }
  return { head, parts };
};

/** Let the browser save a file. @param {string} href @param {string} name */
const download = (href, name = "") => {
  const link = make("a", { href, download: name });
  document.body.append(link);
  link.click();
  link.remove();
};
