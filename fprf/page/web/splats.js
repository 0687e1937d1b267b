// Packed 3D Gaussians (packed.js) in WebGL 2, by the programs of shaders.js.

const COARSE_PIXELS = 8; // a side of what is found out about depths: the edges that they make are soft
const ASKED_EVERY = 2; // of the Gaussians, one is asked for its depth
const SEEN_BY = 3; // photographs that shall have seen a thing, where so many were taken around here
const MAX_TOLD_DEPTHS = 1.5; // beyond so many of these distances nothing is told apart: through gaps one sees what nobody photographed
const MIN_PICKED = 0.3; // share of a pixel that is covered, where something is there to be picked; by eye
const MIN_NEAR = 0.01; // distance before which nothing is drawn, where none is given
const FRAME_NUMBERS = 16; // of a frame of a photograph, in four texels

/**
 * Names of two styles, how much of the second from 0 to 1, a line between them from 0 to 1 of the width or -1.
 * @typedef {{first: string, second: string, blend: number, wipe: number}} Look
 *
 * A rectangle of a picture in pixels.
 * @typedef {{x: number, y: number, width: number, height: number}} Box
 *
 * Colours behind all things, that at the rim too, and how far what is drawn carries on to where nothing is, from 0 to 1; what no photograph saw fades where `depth` is given, the distance of what they look
 * at; the share of the resolution; whether exactly; a framebuffer and a box of it, in the place of the canvas.
 * @typedef {{near?: number, background?: Vector, rim?: Vector, ambience?: number, depth?: number, share?: number, exact?: boolean,
 *   into?: {buffer: WebGLFramebuffer?, box: Box}?}} DrawOptions
 *
 * @typedef {{head: ColourHead, rows: Uint8Array, maps: Float32Array}} Colours
 * @typedef {{range: Float32Array, rows: WebGLTexture, maps: WebGLTexture}} UploadedStyle
 */

class Splats {
  /**
   * Throws where WebGL 2 is missing. Shaders compile in the graphics process while this one inflates what is loaded.
   * @param {HTMLCanvasElement} canvas
   */
  constructor(canvas) {
    this.canvas = canvas;
    /** @type {Map<string, UploadedStyle>} */
    this.styles = new Map();
    /** @type {Map<string, Colours>} to come back from a lost context */
    this.colours = new Map();
    /** @type {Map<string, {gains: Float32Array, texture: WebGLTexture}>} light on styles, by their names */
    this.lights = new Map();
    /** @type {Object<string, WebGLTexture>} */
    this.textures = {};
    /** @type {Object<string, Target>} */
    this.targets = {};
    /** @type {SplatHead} */
    this.head = { count: 0, harmonics: 1, largest: 0, antialiased: false };
    this.count = 0;
    /** @type {Uint32Array<ArrayBuffer>?} */
    this.order = null;
    this.kept = 0; // of the order, that lie before the camera
    this.every = 1; // of so many neighbours one is drawn
    this.sortMilliseconds = 0;
    /** @type {Worker?} */
    this.worker = null;
    /** @type {(() => void)?} ends a sort that is under way */
    this.sorted = null;
    this.source = { shape: new Uint32Array(0), chunks: new Float32Array(0), palette: new Uint8Array(0) };
    this.gl = graphicsOf(canvas);
    this.card = cardOf(this.gl);
    this.programs = programsOf(this.gl);
    this.buffers = buffersOf(this.gl, 0); // of none yet
  }

  /**
   * Gaussians, in the place of any from before; styles are added then.
   * @param {SplatHead} head
   * @param {Object<string, Uint8Array<ArrayBuffer>>} parts deflated sections
   */
  async load(head, parts) {
    const { gl } = this;
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE) * TEXELS / 2; // what is projected takes two texels each
    if (most && head.count > most) {
      throw new Error(`this device draws ${most} Gaussians at most, and these are ${head.count}: open it on another one`);
    }
    const [planes, floats, palette] = await Promise.all([inflate(parts.shape), inflate(parts.chunks), inflate(parts.palette)]);
    this.empty();
    const shape = new Uint32Array(woven(planes, head.count, 16).buffer);
    const chunks = new Float32Array(floats.buffer);
    this.head = head;
    this.count = head.count;
    this.source = { shape, chunks, palette };
    this.worker = sortingWorker(decodedMeans(shape, chunks, head.count));
    this.fill();
  }

  /** Drop what was loaded before. */
  empty() {
    const coloured = [...this.styles.values()].flatMap(({ rows, maps }) => [rows, maps]);
    [...Object.values(this.textures), ...coloured].forEach((texture) => this.gl.deleteTexture(texture));
    this.colours.clear();
    this.light([...this.lights.keys()], null);
    this.worker?.terminate();
    this.sorted?.(); // a sort that was under way is never answered
    this.order = null;
    this.kept = 0;
    this.every = 1;
    this.sortMilliseconds = 0;
  }

  /** Begin again after a lost context; `fill` comes next. */
  compile() {
    this.card = cardOf(this.gl);
    this.programs = programsOf(this.gl);
  }

  /** Whether the processor draws. */
  get software() { return this.card.software; }

  /** Whether there is a place for depths. */
  get deep() { return this.card.deep; }

  /** Textures and buffers of what was loaded. */
  fill() {
    Object.values(this.programs).forEach((each) => checkProgram(this.gl, each));
    this.fillTextures();
    this.buffers = buffersOf(this.gl, this.count);
    this.targets = {};
    this.styles.clear();
    for (const [name, style] of this.colours) this.upload(name, style);
    for (const [name, { gains }] of this.lights) this.light([name], gains);
    this.put();
  }

  fillTextures() {
    const { gl } = this;
    const { shape, chunks, palette } = this.source;
    const entries = palette.length ? new Int8Array(palette.buffer) : new Int8Array(4);
    const seen = Float32Array.from((this.head.seen ?? []).flatMap((frame) => [...frame, 0])); // three rows and a place
    this.textures = {
      shape: textureOf(gl, shape, gl.RGBA32UI),
      chunks: textureOf(gl, chunks, gl.RGBA32F),
      palette: textureOf(gl, entries, gl.RGBA8_SNORM),
      projected: emptyTexture(gl, gl.RGBA32UI, TEXELS, projectedRows(this.count), gl.NEAREST),
      seen: textureOf(gl, seen.length ? seen : new Float32Array(FRAME_NUMBERS), gl.RGBA32F, FRAME_NUMBERS / 4),
    };
  }

  /**
   * A style: `head` with low, high and the number of maps, `part` its deflated section.
   * @param {string} name
   * @param {ColourHead} head
   * @param {Uint8Array<ArrayBuffer>} part
   */
  async add(name, head, part) {
    const data = await inflate(part);
    const style = { head, rows: woven(data, this.count, 4), maps: new Float32Array(data.slice(4 * this.count).buffer) };
    this.colours.set(name, style);
    this.upload(name, style);
  }

  /** @param {string} name @param {Colours} colours */
  upload(name, { head, rows, maps }) {
    const { gl } = this;
    const before = this.styles.get(name);
    if (before) {
      gl.deleteTexture(before.rows);
      gl.deleteTexture(before.maps);
    }
    const padded = new Float32Array(Math.max(4, maps.length / 3 * 4));
    for (let i = 0; i < maps.length / 3; i++) padded.set(maps.subarray(3 * i, 3 * i + 3), 4 * i);
    const range = new Float32Array(16);
    range.set(head.low, 0);
    range.set(head.high.map((high, i) => high - head.low[i]), 4);
    this.styles.set(name, {
      range,
      rows: textureOf(gl, rows, gl.RGBA8),
      maps: textureOf(gl, padded, gl.RGBA32F, padded.length / 4),
    });
  }

  /** Light on the Gaussians of some styles (sun.js). @param {string[]} names @param {Float32Array?} gains four a Gaussian; null = none */
  light(names, gains) {
    const before = new Set(names.map((name) => this.lights.get(name)?.texture));
    const texture = gains && textureOf(this.gl, gains, this.gl.RGBA32F);
    for (const name of names) {
      if (gains && texture) this.lights.set(name, { gains, texture });
      else this.lights.delete(name);
    }
    for (const each of this.lights.values()) before.delete(each.texture);
    before.forEach((each) => this.gl.deleteTexture(each ?? null));
  }

  /**
   * Order the Gaussians for a camera, one at a time. Of `every` so many neighbours one is drawn, as much larger: they lie in Morton
   * order.
   * @param {Float32Array} view world to camera by columns
   * @param {number} near
   * @returns {Promise<void>}
   */
  sort(view, near, every = 1) {
    const { worker } = this;
    if (!worker) return Promise.resolve();
    return new Promise((done) => {
      this.sorted = done;
      worker.onmessage = (/** @type {MessageEvent<Sorted>} */ { data }) => {
        this.order = data.order;
        this.kept = data.kept;
        this.every = every;
        this.sortMilliseconds = data.milliseconds;
        this.put();
        done();
      };
      const spare = this.order;
      this.order = null;
      const request = { row: [view[2], view[6], view[10], view[14]], near, every, spare };
      worker.postMessage(request, spare ? [spare.buffer] : []);
    });
  }

  /** Hand the order to the graphics card. */
  put() {
    const { gl } = this;
    if (!this.order) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers.order);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, this.order, 0, this.kept);
  }
  /** A picture to draw into: `exact` ones and `depth` hold floats. @param {number} width @param {number} height @param {string} kind */
  frame(width, height, kind) {
    const { gl, card } = this;
    const before = this.targets[kind];
    if (before?.width === width && before.height === height) return before;
    if (before) {
      gl.deleteTexture(before.picture);
      gl.deleteFramebuffer(before.buffer);
    }
    const format = { exact: card.exact, coarse: card.coarse, depth: card.exact }[kind] ?? gl.RGBA8;
    this.targets[kind] = targetOf(gl, format, width, height);
    return this.targets[kind];
  }

  /** That which colours are drawn into. @param {boolean} exact */
  kindOf(exact) {
    return exact && this.card.exact !== this.card.coarse ? "exact" : "coarse";
  }

  /**
   * Draw into the canvas.
   * @param {Float32Array} view world to camera by columns
   * @param {Lens} lens
   * @param {Look} look
   * @param {DrawOptions} options
   */
  draw(view, lens, look, { near = MIN_NEAR, background = [0, 0, 0], rim = background, ambience = 0, depth = 0, share = 1, exact = true, into = null } = {}) {
    const { width, height } = into?.box ?? this.canvas;
    const target = this.frame(Math.max(1, Math.round(share * width)), Math.max(1, Math.round(share * height)), this.kindOf(exact));
    const right = target.width / width;
    const down = target.height / height;
    /** @type {Lens} */
    const scaled = [lens[0] * right, lens[1] * down, lens[2] * right, lens[3] * down];
    this.splat(target, view, scaled, look, near, null);
    const faded = Boolean(depth && this.deep && this.head.seen?.length);
    const cover = faded ? this.cover(target, view, scaled, depth) : null;
    const around = ambience ? this.around(target, cover, background) : null;
    this.present({ target, cover, around }, [background, rim], ambience, into);
  }

  /**
   * A small picture of what is to be seen, as a canvas of its own.
   * @param {Float32Array} view
   * @param {Lens} lens
   * @param {Look} look
   * @param {[number, number]} size
   * @param {DrawOptions} options
   */
  snapshot(view, lens, look, [width, height], options) {
    const { gl } = this;
    const { buffer } = this.frame(width, height, "small");
    this.draw(view, lens, look, { ...options, into: { buffer, box: { x: 0, y: 0, width, height } } });
    const bytes = new Uint8ClampedArray(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    const canvas = make("canvas", { width, height });
    const context = canvas.getContext("2d");
    for (let row = 0; row < height; row++) { // the lowest comes first
      context?.putImageData(new ImageData(bytes.slice(4 * width * row, 4 * width * (row + 1)), width), 0, height - 1 - row);
    }
    return canvas;
  }

  /** Colours around a picture. @param {Target} target @param {Target?} cover @param {Vector} background */
  around(target, cover, background) {
    const { gl } = this;
    const found = this.frame(AROUND_SIZE[0], AROUND_SIZE[1], "around");
    const { places } = this.pass("around", { picture: target.picture, cover: (cover ?? target).picture }, found);
    gl.uniform1i(places.faded, cover ? 1 : 0);
    gl.uniform3f(places.background, ...background);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    return found;
  }

  /**
   * Bring a picture into the canvas, or into a box of another framebuffer.
   * @param {{target: Target, cover: Target?, around: Target?}} pictures also what photographs saw of it, and what lies around it
   * @param {[Vector, Vector]} sky
   * @param {number} ambience
   * @param {{buffer: WebGLFramebuffer?, box: Box}?} into
   */
  present({ target, cover, around }, [background, rim], ambience, into) {
    const { gl } = this;
    const { x, y, width, height } = into?.box ?? { x: 0, y: 0, width: this.canvas.width, height: this.canvas.height };
    const pictures = { picture: target.picture, cover: (cover ?? target).picture, around: (around ?? target).picture };
    const { places } = this.pass("show", pictures, { buffer: into?.buffer ?? null, x, y, width, height });
    gl.uniform1i(places.faded, cover ? 1 : 0);
    gl.uniform1f(places.ambience, ambience);
    gl.uniform2f(places.whole, width, height);
    gl.uniform2f(places.corner, x, y);
    gl.uniform3f(places.background, ...background);
    gl.uniform3f(places.rim, ...rim);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /**
   * Begin a pass over a whole picture.
   * @param {"show"|"cover"|"fade"|"around"} name of its program
   * @param {Object<string, WebGLTexture>} textures
   * @param {{buffer: WebGLFramebuffer?, x?: number, y?: number, width: number, height: number}} into
   */
  pass(name, textures, { buffer, x = 0, y = 0, width, height }) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.viewport(x, y, width, height);
    gl.disable(gl.BLEND);
    gl.useProgram(this.programs[name].program);
    bindTextures(gl, this.programs[name], textures);
    gl.bindVertexArray(this.buffers.quads);
    return this.programs[name];
  }

  /**
   * How well photographs saw what was just drawn into a target, on a coarse grid.
   * @param {Target} target
   * @param {Float32Array} view
   * @param {Lens} lens of the target
   * @param {number} depth
   */
  cover(target, view, lens, depth) {
    const { gl } = this;
    const frames = this.head.seen ?? [];
    const eye = eyeOf(view);
    const near = nearness(frames, eye, depth);
    const width = Math.max(1, Math.ceil(target.width / COARSE_PIXELS));
    const height = Math.max(1, Math.ceil(target.height / COARSE_PIXELS));
    const depths = this.frame(width, height, "depth");
    const found = this.frame(width, height, "cover");
    this.drawQuads(depths, target, ASKED_EVERY, true, null);
    const { places } = this.pass("cover", { depths: depths.picture, seen: this.textures.seen }, found);
    gl.uniform1i(places.frames, frames.length);
    gl.uniformMatrix4fv(places.view, false, view);
    gl.uniform4f(places.lens, ...lens);
    gl.uniform2f(places.size, target.width, target.height);
    gl.uniform3f(places.eye, ...eye);
    gl.uniform1f(places.farthest, near.nearest + MAX_TOLD_DEPTHS * depth);
    gl.uniform1f(places.nearest, near.nearest);
    gl.uniform1f(places.around, near.around);
    gl.uniform1f(places.needed, Math.min(SEEN_BY, near.count));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    return this.fade(found);
  }

  /** Let what was seen fade towards what was not. @param {Target} found */
  fade(found) {
    const { gl } = this;
    const across = this.frame(found.width, found.height, "across");
    for (const [from, to] of [[found, across], [across, found]]) {
      const { places } = this.pass("fade", { cover: from.picture }, to);
      gl.uniform1i(places.down, to === found ? 1 : 0);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    return found;
  }

  /**
   * Draw into a target, or, into one pixel of it, depths in the place of colours.
   * @param {Target} target
   * @param {Float32Array} view
   * @param {Lens} lens of the target
   * @param {Look} look
   * @param {number} near
   * @param {[number, number]?} pixel
   */
  splat(target, view, lens, look, near, pixel) {
    const one = this.styles.get(look.first);
    if (!one) return;
    this.aim(target, view, lens, near);
    this.dress(one, this.styles.get(look.second) ?? one, look, pixel !== null);
    this.project();
    this.drawQuads(target, target, 1, false, pixel);
  }

  /** Say from where Gaussians are projected. @param {Target} target @param {Float32Array} view @param {Lens} lens @param {number} near */
  aim(target, view, lens, near) {
    const { gl } = this;
    const { program, places } = this.programs.project;
    gl.useProgram(program);
    gl.uniformMatrix4fv(places.view, false, view);
    gl.uniform4f(places.lens, ...lens);
    gl.uniform2f(places.size, target.width, target.height);
    gl.uniform1f(places.near, near);
    gl.uniform3f(places.eye, ...eyeOf(view));
    gl.uniform1f(places.wider, Math.sqrt(this.every)); // as much area as all of them
  }

  /** Say in which colours, or that depths are wanted. @param {UploadedStyle} one @param {UploadedStyle} two @param {Look} look @param {boolean} deep */
  dress(one, two, look, deep) {
    const { gl, head } = this;
    const { places } = this.programs.project;
    const { shape, chunks, palette } = this.textures;
    const lights = [this.lights.get(look.first)?.texture, this.lights.get(look.second)?.texture];
    const colours = { first: one.rows, second: two.rows, maps0: one.maps, maps1: two.maps };
    const gains = { gains0: lights[0] ?? one.rows, gains1: lights[1] ?? one.rows };
    bindTextures(gl, this.programs.project, { shape, chunks, palette, ...colours, ...gains });
    gl.uniform1i(places.lit0, lights[0] ? 1 : 0);
    gl.uniform1i(places.lit1, lights[1] ? 1 : 0);
    gl.uniformMatrix4fv(places.range0, false, one.range);
    gl.uniformMatrix4fv(places.range1, false, two.range);
    gl.uniform1f(places.blend, look.blend ?? 0);
    gl.uniform1f(places.wipe, look.wipe ?? -1);
    gl.uniform1f(places.largest, head.largest);
    gl.uniform1i(places.bands, Math.round(Math.sqrt(head.harmonics)));
    gl.uniform1i(places.depth, deep ? 1 : 0);
    gl.uniform1i(places.sharp, head.antialiased ? 1 : 0);
  }

  /** Project the Gaussians in their order, into a texture that quads are drawn from. */
  project() {
    const { gl } = this;
    const { projected, ordered, feedback } = this.buffers;
    gl.bindVertexArray(ordered);
    gl.enable(gl.RASTERIZER_DISCARD);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, feedback);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, projected);
    gl.beginTransformFeedback(gl.POINTS);
    gl.drawArrays(gl.POINTS, 0, this.kept);
    gl.endTransformFeedback();
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, null);
    gl.disable(gl.RASTERIZER_DISCARD);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.textures.projected);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, projected);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXELS, Math.ceil(this.kept / (TEXELS / 2)), gl.RGBA_INTEGER, gl.UNSIGNED_INT, 0);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, null);
  }

  /**
   * Draw one of `every` so many projected Gaussians into a target, or into one pixel of it: colours, or `deep` their depths.
   * @param {Target} target
   * @param {{width: number, height: number}} size of the picture that they were projected for
   * @param {number} every
   * @param {boolean} deep
   * @param {[number, number]?} pixel
   */
  drawQuads(target, size, every, deep, pixel) {
    const { gl } = this;
    const { program, places } = this.programs.splat;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, target.width, target.height);
    if (pixel) {
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(...pixel, 1, 1);
    }
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(program);
    bindTextures(gl, this.programs.splat, { projected: this.textures.projected });
    gl.uniform2f(places.size, size.width, size.height);
    gl.uniform1i(places.kept, this.kept);
    gl.uniform1i(places.every, every);
    gl.uniform1i(places.deep, deep ? 1 : 0);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
    gl.bindVertexArray(this.buffers.quads);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * INSTANCE_QUADS, gl.UNSIGNED_SHORT, 0, Math.ceil(this.kept / (INSTANCE_QUADS * every)));
    gl.bindVertexArray(null);
    gl.disable(gl.SCISSOR_TEST);
  }

  /**
   * Depth along the camera's axis at a pixel of the canvas, the mean by weight; null where there is nothing to see.
   * @param {Float32Array} view
   * @param {Lens} lens
   * @param {Look} look
   * @param {number} x
   * @param {number} y
   */
  pick(view, lens, look, x, y, near = MIN_NEAR) {
    const { gl } = this;
    const target = this.frame(this.canvas.width, this.canvas.height, this.kindOf(true));
    this.splat(target, view, lens, look, near, [Math.floor(x), Math.floor(y)]);
    const found = new Float32Array(4);
    gl.readPixels(Math.floor(x), Math.floor(y), 1, 1, gl.RGBA, gl.FLOAT, found);
    return found[3] > MIN_PICKED ? found[0] / found[3] : null;
  }
}
