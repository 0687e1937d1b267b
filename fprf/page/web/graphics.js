// Programs, textures and buffers of WebGL 2.

/**
 * A program and its uniforms by name.
 * @typedef {{program: WebGLProgram, places: Object<string, WebGLUniformLocation?>}} Program
 *
 * A texture that can be drawn into.
 * @typedef {{width: number, height: number, picture: WebGLTexture, buffer: WebGLFramebuffer}} Target
 */

/** @param {HTMLCanvasElement} canvas */
const graphicsOf = (canvas) => {
  const settings = { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" };
  const gl = /** @type {WebGL2RenderingContext?} */ (canvas.getContext("webgl2", settings));
  if (!gl) throw new Error("this browser has no WebGL 2");
  return gl;
};

/** @param {WebGL2RenderingContext} gl @param {WebGLProgram} program @param {number} kind @param {string} text */
const attachShader = (gl, program, kind, text) => {
  const shader = gl.createShader(kind);
  if (!shader) return; // of a lost context, which comes back
  gl.shaderSource(shader, text);
  gl.compileShader(shader);
  gl.attachShader(program, shader);
};

/**
 * A program that is being linked; its uniforms are found by `checkProgram`.
 * @param {WebGL2RenderingContext} gl
 * @param {string} vertex
 * @param {string} fragment
 * @param {string[]} varyings that are kept
 * @returns {Program}
 */
const linkProgram = (gl, vertex, fragment, varyings = []) => {
  const program = gl.createProgram();
  attachShader(gl, program, gl.VERTEX_SHADER, vertex);
  attachShader(gl, program, gl.FRAGMENT_SHADER, fragment);
  if (varyings.length) gl.transformFeedbackVaryings(program, varyings, gl.INTERLEAVED_ATTRIBS);
  gl.linkProgram(program);
  return { program, places: {} };
};

/** Wait until a program is linked, and find its uniforms. @param {WebGL2RenderingContext} gl @param {Program} linked */
const checkProgram = (gl, { program, places }) => {
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const said = (gl.getAttachedShaders(program) ?? []).map((each) => gl.getShaderInfoLog(each));
    throw new Error(`${said.join(" ")}${gl.getProgramInfoLog(program)}`);
  }
  for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
    const name = gl.getActiveUniform(program, i)?.name;
    if (name) places[name] = gl.getUniformLocation(program, name);
  }
};

/** Bind textures to uniforms, each to a unit of its own. @param {WebGL2RenderingContext} gl @param {Program} program @param {Object<string, WebGLTexture>} textures */
const bindTextures = (gl, { places }, textures) => {
  Object.entries(textures).forEach(([name, texture], unit_) => {
    gl.activeTexture(gl.TEXTURE0 + unit_);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.uniform1i(places[name], unit_);
  });
};

/** A buffer with data, or of so many bytes. @param {WebGL2RenderingContext} gl @param {number} kind @param {number|Uint16Array<ArrayBuffer>} data @param {number} use */
const bufferOf = (gl, kind, data, use) => {
  const buffer = gl.createBuffer();
  gl.bindBuffer(kind, buffer);
  if (typeof data === "number") gl.bufferData(kind, data, use);
  else gl.bufferData(kind, data, use);
  return buffer;
};

/** @param {WebGL2RenderingContext} gl @param {number} inner format @param {number} width @param {number} height @param {number} filter */
const emptyTexture = (gl, inner, width, height, filter) => {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, inner, width, height);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  return texture;
};

/** Of the graphics card's own formats, that of data: of four values a texel. @param {WebGL2RenderingContext} gl @param {number} inner @returns {[number, number]} */
const formatOf = (gl, inner) => {
  if (inner === gl.RGBA32UI) return [gl.RGBA_INTEGER, gl.UNSIGNED_INT];
  if (inner === gl.RGBA32F) return [gl.RGBA, gl.FLOAT];
  if (inner === gl.RGBA8_SNORM) return [gl.RGBA, gl.BYTE];
  return [gl.RGBA, gl.UNSIGNED_BYTE];
};

/**
 * A texture of four values a texel.
 * @param {WebGL2RenderingContext} gl
 * @param {Uint32Array|Float32Array|Int8Array|Uint8Array} data
 * @param {number} inner format
 */
const textureOf = (gl, data, inner, width = TEXELS) => {
  const texels = data.length / 4;
  const full = Math.floor(texels / width);
  const rest = texels - width * full;
  const [format, type] = formatOf(gl, inner);
  const texture = emptyTexture(gl, inner, width, Math.max(1, Math.ceil(texels / width)), gl.NEAREST);
  // Whole rows as they lie, then what is left: no padded copy of all.
  if (full) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, full, format, type, data.subarray(0, 4 * width * full));
  if (rest) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, full, rest, 1, format, type, data.subarray(4 * width * full));
  return texture;
};

/** @param {WebGL2RenderingContext} gl @param {number} inner format @param {number} width @param {number} height @returns {Target} */
const targetOf = (gl, inner, width, height) => {
  const picture = emptyTexture(gl, inner, width, height, gl.LINEAR);
  const buffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, picture, 0);
  return { width, height, picture, buffer };
};

/** What a graphics card can do: whether it is the processor, whether depths have a place, formats of exact and of coarse pictures. @param {WebGL2RenderingContext} gl */
const cardOf = (gl) => {
  const floats = gl.getExtension("EXT_color_buffer_float");
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  const software = /swiftshader|llvmpipe|software/i.test(gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
  const whole = floats && software && gl.getExtension("EXT_float_blend") && gl.getExtension("OES_texture_float_linear");
  const half = floats ? gl.RGBA16F : gl.RGBA8;
  return { software, deep: Boolean(floats), exact: whole ? gl.RGBA32F : half, coarse: whole ? gl.RGBA32F : gl.RGBA8 };
};

/** @param {WebGL2RenderingContext} gl */
const programsOf = (gl) => ({
  project: linkProgram(gl, VERTEX, NOTHING, ["place", "look"]),
  splat: linkProgram(gl, QUAD, FRAGMENT),
  cover: linkProgram(gl, FULL, COVER),
  fade: linkProgram(gl, FULL, FADE),
  around: linkProgram(gl, FULL, AROUND),
  show: linkProgram(gl, FULL, SHOW),
});

/** Rows of texels that so many projected Gaussians take, two each. @param {number} count */
const projectedRows = (count) => Math.max(1, Math.ceil(count / (TEXELS / 2)));

/** Of so many Gaussians: what is projected, quads to draw it with, their order. @param {WebGL2RenderingContext} gl @param {number} count */
const buffersOf = (gl, count) => {
  const projected = bufferOf(gl, gl.ARRAY_BUFFER, 16 * TEXELS * projectedRows(count), gl.DYNAMIC_COPY);
  const quads = gl.createVertexArray(); // no attributes
  gl.bindVertexArray(quads);
  const corners = [0, 1, 2, 2, 1, 3];
  const indices = Uint16Array.from({ length: 6 * INSTANCE_QUADS }, (_, i) => 4 * Math.floor(i / 6) + corners[i % 6]);
  bufferOf(gl, gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
  const ordered = gl.createVertexArray();
  gl.bindVertexArray(ordered);
  const order = bufferOf(gl, gl.ARRAY_BUFFER, 4 * count, gl.DYNAMIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
  gl.bindVertexArray(null);
  return { projected, quads, ordered, order, feedback: gl.createTransformFeedback() };
};
