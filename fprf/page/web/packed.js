// Sections of packed Gaussians (fprf/page/pack.py), and their order by depth.

/**
 * What is told of the Gaussians (pack.py): how many, coefficients of harmonics a channel, the largest of the palette, whether
 * smaller than a pixel they are fainter; rows of frames that say what was photographed, three rows of a matrix and a place each.
 * @typedef {{count: number, harmonics: number, largest: number, antialiased: boolean, seen?: number[][]}} SplatHead
 *
 * What is told of the colours of a style: least and largest of each channel.
 * @typedef {{low: number[], high: number[]}} ColourHead
 *
 * An order of Gaussians, nearest first: so many of it lie before the camera.
 * @typedef {{order: Uint32Array<ArrayBuffer>, kept: number, milliseconds: number}} Sorted
 *
 * What a sort needs: the row of the camera that gives depths, and an array to be used again.
 * @typedef {{means?: undefined, row: number[], near: number, every: number, spare: Uint32Array<ArrayBuffer>?}} SortRequest
 */

const NEAR_SHARE = 0.4; // how far from here photographs count, in the distance of what they look at; by eye

/**
 * Runs in a worker: a 16-bit counting sort by depth, nearest first, of what lies before the camera. Bits of a positive float
 * grow with it, about as its logarithm does: near things are told apart however far the sky is.
 */
function sorter() {
  let means = new Float32Array(0);
  let depth = new Float32Array(0);
  let bits = new Int32Array(0);
  let key = new Uint16Array(0);

  /** @param {Float32Array<ArrayBuffer>} given centres of the Gaussians */
  const take = (given) => {
    means = given;
    depth = new Float32Array(means.length / 3);
    bits = new Int32Array(depth.buffer);
    key = new Uint16Array(depth.length);
  };

  /** Depths of all, and the range of their bits. @param {SortRequest} request */
  const measure = ({ row: [a, b, c, d], near, every }) => {
    const count = depth.length;
    let least = 0x7fffffff;
    let most = 0;
    let kept = 0;
    for (let i = 0, j = 0; i < count; i += every, j += 3 * every) {
      const z = a * means[j] + b * means[j + 1] + c * means[j + 2] + d;
      depth[i] = z;
      if (z > near) {
        const v = bits[i];
        if (v < least) least = v;
        if (v > most) most = v;
        kept++;
      }
    }
    return { least, most, kept };
  };

  /** @param {SortRequest} request @returns {Sorted} */
  const sort = (request) => {
    const start = performance.now();
    const { near, every, spare } = request;
    const { least, most, kept } = measure(request);
    const count = depth.length;
    const scale = 65535 / Math.max(1, most - least);
    const starts = new Uint32Array(65537);
    for (let i = 0; i < count; i += every) {
      if (!(depth[i] > near)) continue;
      const k = (bits[i] - least) * scale | 0;
      key[i] = k;
      starts[k + 1]++;
    }
    for (let k = 0; k < 65536; k++) starts[k + 1] += starts[k];
    const order = spare && spare.length >= kept ? spare : new Uint32Array(count);
    for (let i = 0; i < count; i += every) {
      if (depth[i] > near) order[starts[key[i]]++] = i;
    }
    return { order, kept, milliseconds: performance.now() - start };
  };

  onmessage = (/** @type {MessageEvent<{means: Float32Array<ArrayBuffer>}|SortRequest>} */ { data }) => {
    if (data.means) {
      take(data.means);
      return;
    }
    const sorted = sort(data);
    postMessage(sorted, { transfer: [sorted.order.buffer] });
  };
}

/** A worker that sorts Gaussians with such centres; they are handed over. @param {Float32Array<ArrayBuffer>} means */
const sortingWorker = (means) => {
  const worker = new Worker(URL.createObjectURL(new Blob([`"use strict";(${sorter})()`], { type: "text/javascript" })));
  worker.postMessage({ means }, [means.buffer]);
  return worker;
};

/** @param {Uint8Array<ArrayBuffer>} bytes deflated */
const inflate = async (bytes) => {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
};

/** Planes of bytes to rows of so many bytes. @param {Uint8Array} planes @param {number} count @param {number} width */
const woven = (planes, count, width) => {
  const rows = new Uint8Array(count * width);
  for (let k = 0; k < width; k++) {
    for (let i = 0, j = k, from = k * count; i < count; i++, j += width) rows[j] = planes[from + i];
  }
  return rows;
};

/** Centres of the Gaussians. @param {Uint32Array} shape @param {Float32Array} chunks @param {number} count */
const decodedMeans = (shape, chunks, count) => {
  const means = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) {
    const c = 12 * (i >> 8);
    const xy = shape[4 * i];
    const z = shape[4 * i + 1] & 65535;
    means[3 * i] = chunks[c] + (chunks[c + 3] - chunks[c]) * (xy & 65535) / 65535;
    means[3 * i + 1] = chunks[c + 1] + (chunks[c + 4] - chunks[c + 1]) * (xy >>> 16) / 65535;
    means[3 * i + 2] = chunks[c + 2] + (chunks[c + 5] - chunks[c + 2]) * z / 65535;
  }
  return means;
};

/** The place of a camera, -R^T t, by its world-to-camera matrix. @param {Float32Array} view @returns {Vector} */
const eyeOf = (view) => {
  const along = (/** @type {number} */ i) => -(view[4 * i] * view[12] + view[4 * i + 1] * view[13] + view[4 * i + 2] * view[14]);
  return [along(0), along(1), along(2)];
};

/**
 * How near photographs were taken: the nearest distance, that by which they count less, and how many there are about.
 * @param {number[][]} frames
 * @param {Vector} eye
 * @param {number} depth of what photographs look at
 */
const nearness = (frames, eye, depth) => {
  const apart = frames.map((frame) => Math.hypot(...eye.map((x, i) => x - frame[12 + i])));
  const nearest = Math.min(...apart);
  const around = NEAR_SHARE * (depth + nearest);
  const count = apart.reduce((sum, each) => sum + Math.exp(-(((each - nearest) / around) ** 2)), 0);
  return { nearest, around, count };
};
