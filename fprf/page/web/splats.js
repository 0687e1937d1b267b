// Draw packed 3D Gaussians (fprf/page/pack.py) in WebGL 2 as fprf's rasteriser does, in colours that blend between two styles.
//
// Two passes: each Gaussian is projected and coloured once (transform feedback), then drawn as a quad that just holds it, the
// nearest first, under what is there: colour += (1 - a) alpha c, a += (1 - a) alpha. Eight bits a channel lose what faint ones
// add (37 dB on the garden against 42 with half floats), so they are for cameras that move. Where the processor draws, whole
// floats take half the time of half floats, and no more than bytes.
"use strict";

const WIDTH = 2048; // texels a row
const MANY = 1024; // quads of an instance: one quad each costs software, and most cards, more than what it covers
const COARSE = 8; // pixels a side of what is found out about depths: the edges that they make are soft
const EVERY = 2; // of the Gaussians, one is asked for its depth
const SEEN_BY = 3; // photographs that shall have seen a thing, where so many were taken around here
const UNSEEN = 0.5; // share of them, up to which nothing is shown; by eye: single dark things stand out at the rim
const BORDER = 0.12; // of a frame's side, within which it counts less; by eye
const AROUND = 0.4; // how far from here photographs count, in the distance of what they look at; by eye
const FARTHEST = 1.5; // beyond so many of these distances nothing is told apart: through gaps one sees what nobody photographed
const COMMON = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D;
`;
const VERTEX = `${COMMON}
uniform usampler2D shape;               // a texel a Gaussian, see pack.py
uniform sampler2D chunks, palette;
uniform sampler2D first, second;        // a texel a Gaussian: mean colour, number of the map
uniform sampler2D maps0, maps1;         // three texels a map
uniform sampler2D gains0, gains1; uniform bool lit0, lit1; // of light: factors of colours + 0.055
uniform mat4 range0, range1;            // columns 0 and 1: least colour and width
uniform mat4 view; uniform vec4 lens; uniform vec2 size; uniform float near, blend, wipe, largest; uniform vec3 eye;
uniform int bands; uniform bool depth; uniform bool sharp; uniform float wider;
layout(location = 0) in uint index;
flat out uvec4 place; // bits of the floats: centre in the picture, longer half axis at one standard deviation
flat out uvec4 look;  // half floats: colour, opacity; shorter half axis over the longer, how many deviations the quad reaches; depth
ivec2 texel(int i) { return ivec2(i % ${WIDTH}, i / ${WIDTH}); }
vec3 shaded(vec4 texel4, mat4 range, sampler2D maps, vec3 rest, vec3 gain) {
  vec3 mean = range[0].xyz + texel4.rgb * range[1].xyz;
  if (bands > 1) {
    int m = int(texel4.a * 255. + .5) * 3;
    mean += rest.x * texelFetch(maps, ivec2(m, 0), 0).rgb + rest.y * texelFetch(maps, ivec2(m + 1, 0), 0).rgb
      + rest.z * texelFetch(maps, ivec2(m + 2, 0), 0).rgb;
  }
  return max(gain * (mean + .055) - .055, 0.);
}
vec3 entry(int i) { vec3 v = texelFetch(palette, texel(i), 0).rgb; return largest * v * abs(v); }
void main() {
  place = uvec4(0u); look = uvec4(0u); // a quad without size is not drawn
  uvec4 w = texelFetch(shape, texel(int(index)), 0);
  int chunk = int(index >> 8u) * 3;
  vec4 a = texelFetch(chunks, texel(chunk), 0), b = texelFetch(chunks, texel(chunk + 1), 0), c = texelFetch(chunks, texel(chunk + 2), 0);
  vec3 mean = mix(a.xyz, vec3(a.w, b.xy), vec3(w.x & 65535u, w.x >> 16u, w.y & 65535u) / 65535.);
  vec3 p = (view * vec4(mean, 1.)).xyz; // x right, y down, z forward
  if (p.z <= near) return;
  vec3 scale = wider * exp(mix(vec3(b.zw, c.x), c.yzw, vec3(w.w & 255u, (w.w >> 8u) & 255u, (w.w >> 16u) & 255u) / 255.));
  vec3 three = (vec3(w.z & 1023u, (w.z >> 10u) & 1023u, (w.z >> 20u) & 1023u) / 1023. * 2. - 1.) * .70710678;
  float four = sqrt(max(0., 1. - dot(three, three)));
  uint out4 = w.z >> 30u; // component left out: w x y z
  vec4 q = out4 == 0u ? vec4(four, three) : out4 == 1u ? vec4(three.x, four, three.yz) : out4 == 2u ? vec4(three.xy, four, three.z) : vec4(three, four);
  float r = q.x, x = q.y, y = q.z, z = q.w;
  mat3 turn = mat3(1. - 2. * (y * y + z * z), 2. * (x * y + r * z), 2. * (x * z - r * y),
    2. * (x * y - r * z), 1. - 2. * (x * x + z * z), 2. * (y * z + r * x),
    2. * (x * z + r * y), 2. * (y * z - r * x), 1. - 2. * (x * x + y * y));
  mat3 axes = mat3(view) * turn; // columns: own axes in the camera
  vec2 t = p.xy / p.z, beyond = .15 * size / lens.xy;
  vec2 n = clamp(t, -lens.zw / lens.xy - beyond, (size - lens.zw) / lens.xy + beyond);
  vec3 across = lens.x / p.z * scale * vec3(axes[0].x - n.x * axes[0].z, axes[1].x - n.x * axes[1].z, axes[2].x - n.x * axes[2].z);
  vec3 down = lens.y / p.z * scale * vec3(axes[0].y - n.y * axes[0].z, axes[1].y - n.y * axes[1].z, axes[2].y - n.y * axes[2].z);
  float xx = dot(across, across), yy = dot(down, down), xy = dot(across, down);
  vec3 normal = cross(across, down);
  float thin = dot(normal, normal), whole = thin + .3 * (xx + yy) + .09;
  float alpha = float(w.w >> 24u) / 255.;
  if (sharp) alpha *= sqrt(thin / whole + 1e-8);
  if (!(alpha > 1. / 255.) || xx + yy > 1e16) return;
  xx += .3; yy += .3;
  float mid = .5 * (xx + yy), gap = length(vec2(.5 * (xx - yy), xy));
  float l1 = mid + gap, l2 = max(whole / l1, 1e-3);
  vec2 axis = gap < 1e-6 * mid ? vec2(1., 0.) : xx > yy ? normalize(vec2(l1 - yy, xy)) : normalize(vec2(xy, l1 - xx));
  float reach = 2. * log(255. * alpha);
  vec2 centre = lens.zw + lens.xy * t, half_ = sqrt(reach * vec2(xx, yy));
  if (any(lessThan(centre + half_, vec2(0.))) || any(greaterThan(centre - half_, size))) return;
  place = floatBitsToUint(vec4(centre, sqrt(l1) * axis));
  uint wide = packHalf2x16(vec2(sqrt(l2 / l1), sqrt(reach)));
  uint far = packHalf2x16(vec2(min(p.z, 65504.)));
  if (depth) { look = uvec4(far, packHalf2x16(vec2(min(p.z, 65504.), alpha)), wide, far); return; }
  vec3 rest = vec3(0.);
  if (bands > 1) {
    vec3 d = normalize(mean - eye);
    int e = int(w.y >> 16u) * (bands * bands - 1);
    rest = .48860251 * (-d.y * entry(e) + d.z * entry(e + 1) - d.x * entry(e + 2));
    if (bands > 2) {
      vec3 s = d * d;
      rest += 1.09254843 * (d.x * d.y * entry(e + 3) - d.y * d.z * entry(e + 4) - d.x * d.z * entry(e + 6))
        + .31539157 * (2. * s.z - s.x - s.y) * entry(e + 5) + .54627422 * (s.x - s.y) * entry(e + 7);
    }
  }
  float m = wipe >= 0. ? step(wipe * size.x, centre.x) : blend;
  vec3 shown = m < 1. ? shaded(texelFetch(first, texel(int(index)), 0), range0, maps0, rest, lit0 ? texelFetch(gains0, texel(int(index)), 0).rgb : vec3(1.)) : vec3(0.);
  if (m > 0.) shown = mix(shown, shaded(texelFetch(second, texel(int(index)), 0), range1, maps1, rest, lit1 ? texelFetch(gains1, texel(int(index)), 0).rgb : vec3(1.)), m);
  look = uvec4(packHalf2x16(shown.rg), packHalf2x16(vec2(shown.b, alpha)), wide, far);
}`;
const NOTHING = `${COMMON}void main() {}`;
const QUAD = `${COMMON}
uniform vec2 size; uniform usampler2D projected; uniform int kept, every; uniform bool deep;
out vec2 at; flat out vec4 colour;
void main() {
  gl_Position = vec4(2., 2., 2., 1.);
  at = vec2(0.); colour = vec4(0.);
  int i = (gl_InstanceID * ${MANY} + (gl_VertexID >> 2)) * every; // four vertices a quad
  if (i >= kept) return;
  ivec2 from = ivec2(i % ${WIDTH / 2} * 2, i / ${WIDTH / 2});
  uvec4 a = texelFetch(projected, from, 0), b = texelFetch(projected, from + ivec2(1, 0), 0);
  vec4 place = uintBitsToFloat(a);
  vec2 wide = unpackHalf2x16(b.z), reach = vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) * 2. * wide.y - wide.y;
  vec2 px = place.xy + reach.x * place.zw + reach.y * wide.x * vec2(-place.w, place.z);
  gl_Position = vec4(2. * px / size - 1., 0., 1.);
  at = reach * .84932180; // exp(-x^2 / 2) = exp2(-(.849 x)^2)
  colour = vec4(unpackHalf2x16(b.x), unpackHalf2x16(b.y));
  if (deep) colour.rgb = unpackHalf2x16(b.w).xxx;
}`;
const FRAGMENT = `${COMMON}
in vec2 at; flat in vec4 colour; out vec4 o;
void main() {
  float a = min(.99, colour.a * exp2(-dot(at, at)));
  if (a < 1. / 255.) discard;
  o = vec4(colour.rgb * a, a);
}`;
const FULL = `${COMMON}void main() { gl_Position = vec4(float(gl_VertexID & 1) * 4. - 1., float(gl_VertexID >> 1) * 4. - 1., -1., 1.); }`;
// How well photographs that were taken around here saw what a pixel shows: of the point at its depth, in how many of their frames
// it lies, and how far within.
const COVER = `${COMMON}
uniform sampler2D depths, seen; uniform mat4 view; uniform vec4 lens; uniform vec2 size; uniform vec3 eye;
uniform float farthest, nearest, around, needed; uniform int frames; out vec4 o;
void main() {
  vec4 d = texelFetch(depths, ivec2(gl_FragCoord.xy), 0);
  float far = d.a > .02 ? min(d.r / d.a, farthest) : farthest;
  vec2 at = gl_FragCoord.xy / vec2(textureSize(depths, 0)) * size;
  vec4 point = vec4(eye + far * (transpose(mat3(view)) * vec3((at - lens.zw) / lens.xy, 1.)), 1.);
  float sum = 0.;
  for (int k = 0; k < frames && sum < needed; k++) {
    vec3 f = vec3(dot(texelFetch(seen, ivec2(0, k), 0), point), dot(texelFetch(seen, ivec2(1, k), 0), point), dot(texelFetch(seen, ivec2(2, k), 0), point));
    vec2 within = clamp(min(f.xy / f.z, 1. - f.xy / f.z) / ${BORDER}, 0., 1.);
    float apart = max(0., distance(eye, texelFetch(seen, ivec2(3, k), 0).xyz) - nearest) / around;
    if (f.z > 0.) sum += within.x * within.y * exp(-apart * apart);
  }
  o = vec4(smoothstep(${UNSEEN}, 1., sum / needed));
}`;
const SHOW = `${COMMON}
uniform sampler2D picture, cover; uniform vec2 scale, whole, corner; uniform vec3 background, rim; uniform bool faded; out vec4 o;
void main() {
  vec2 at = gl_FragCoord.xy - corner;
  at.y = whole.y - at.y;
  vec4 c = texture(picture, at * scale / vec2(textureSize(picture, 0)));
  if (faded) c *= texture(cover, at / whole).r;
  // The background: lighter behind the middle of the picture; eight bits would show its steps without the noise.
  float away = smoothstep(0., 1.1, length((at / whole - vec2(.5, .42)) * vec2(1.1, 1.3)));
  float noise = fract(52.9829189 * fract(dot(gl_FragCoord.xy, vec2(.06711056, .00583715)))) - .5;
  vec3 behind = background == rim ? background : mix(background, rim, away) + noise / 255.;
  o = vec4(c.rgb + (1. - c.a) * behind, 1.);
}`;

// Runs in a worker: a 16-bit counting sort by depth, nearest first, of what lies before the camera. Bits of a positive float
// grow with it, about as its logarithm does: near things are told apart however far the sky is.
function sorter() {
  let means, depth, bits, key, order;
  onmessage = ({ data }) => {
    if (data.means) {
      means = data.means;
      const count = means.length / 3;
      depth = new Float32Array(count); bits = new Int32Array(depth.buffer); key = new Uint16Array(count);
      return;
    }
    const [a, b, c, d] = data.row, count = depth.length, { near, every } = data, start = performance.now();
    let least = 0x7fffffff, most = 0, kept = 0;
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
    const scale = 65535 / Math.max(1, most - least), starts = new Uint32Array(65537);
    for (let i = 0; i < count; i += every) {
      if (!(depth[i] > near)) continue;
      const k = (bits[i] - least) * scale | 0;
      key[i] = k;
      starts[k + 1]++;
    }
    for (let k = 0; k < 65536; k++) starts[k + 1] += starts[k];
    order = data.spare && data.spare.length >= kept ? data.spare : new Uint32Array(count);
    for (let i = 0; i < count; i += every) if (depth[i] > near) order[starts[key[i]]++] = i;
    postMessage({ order, kept, milliseconds: performance.now() - start }, [order.buffer]);
  };
}

const inflate = async (bytes) => new Uint8Array(await new Response(
  new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer());

// Planes of bytes to rows of so many bytes.
const woven = (planes, count, width) => {
  const rows = new Uint8Array(count * width);
  for (let k = 0; k < width; k++) for (let i = 0, j = k, from = k * count; i < count; i++, j += width) rows[j] = planes[from + i];
  return rows;
};

class Splats {
  // Throws where WebGL 2 is missing. Shaders compile in the graphics process while this one inflates what is loaded.
  constructor(canvas) {
    Object.assign(this, { canvas, styles: new Map(), colours: new Map(), lights: new Map(), textures: {} });
    this.compile();
  }

  // Gaussians, in the place of any from before; styles are added then. `head` is that of pack.py; `parts` are its deflated sections.
  async load(head, parts) {
    const most = this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE) * WIDTH / 2; // what is projected takes two texels each
    if (most && head.count > most) throw new Error(`this device draws ${most} Gaussians at most, and these are ${head.count}: open it on another one`);
    const [planes, floats, palette] = await Promise.all([parts.shape, parts.chunks, parts.palette].map(inflate));
    const shape = new Uint32Array(woven(planes, head.count, 16).buffer), chunks = new Float32Array(floats.buffer);
    const coloured = [...this.styles.values()].flatMap(({ rows, maps }) => [rows, maps]);
    [...Object.values(this.textures), ...coloured].forEach((texture) => this.gl.deleteTexture(texture));
    this.colours.clear();
    this.light([...this.lights.keys()], null);
    this.worker?.terminate();
    this.sorted?.(); // a sort that was under way is never answered
    Object.assign(this, { head, count: head.count, order: null, kept: 0, every: 1, sortMilliseconds: 0 });
    this.source = { shape, chunks, palette }; // to come back from a lost context
    this.worker = new Worker(URL.createObjectURL(new Blob([`"use strict";(${sorter})()`], { type: "text/javascript" })));
    const means = decodedMeans(shape, chunks, head.count);
    this.worker.postMessage({ means }, [means.buffer]);
    this.fill();
  }

  // Begin with a canvas, or begin again after a lost context and call `fill`.
  compile() {
    const gl = this.gl = this.canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("this browser has no WebGL 2");
    const floats = gl.getExtension("EXT_color_buffer_float"), names = gl.getExtension("WEBGL_debug_renderer_info");
    this.software = /swiftshader|llvmpipe|software/i.test(gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    const whole = floats && this.software && gl.getExtension("EXT_float_blend") && gl.getExtension("OES_texture_float_linear");
    this.formats = { exact: whole ? gl.RGBA32F : floats ? gl.RGBA16F : gl.RGBA8, coarse: whole ? gl.RGBA32F : gl.RGBA8 };
    this.programs = { project: this.link(VERTEX, NOTHING, ["place", "look"]), splat: this.link(QUAD, FRAGMENT), cover: this.link(FULL, COVER), show: this.link(FULL, SHOW) };
    this.deep = Boolean(floats); // else there is no place for depths
  }

  // Textures and buffers of what was loaded.
  fill() {
    const gl = this.gl;
    Object.values(this.programs).forEach((each) => this.check(each));
    const { shape, chunks, palette } = this.source;
    this.textures = {
      shape: this.texture(shape, gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT),
      chunks: this.texture(chunks, gl.RGBA32F, gl.RGBA, gl.FLOAT),
      palette: this.texture(palette.length ? new Int8Array(palette.buffer) : new Int8Array(4), gl.RGBA8_SNORM, gl.RGBA, gl.BYTE),
    };
    const rows = Math.ceil(this.count / (WIDTH / 2));
    this.textures.projected = this.texture(null, gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, WIDTH, WIDTH * rows);
    const filled = (place, data, use) => {
      const buffer = gl.createBuffer();
      gl.bindBuffer(place, buffer);
      gl.bufferData(place, data, use);
      return buffer;
    };
    this.projected = filled(gl.ARRAY_BUFFER, 16 * WIDTH * rows, gl.DYNAMIC_COPY);
    this.quads = gl.createVertexArray(); // no attributes
    gl.bindVertexArray(this.quads);
    filled(gl.ELEMENT_ARRAY_BUFFER, Uint16Array.from({ length: 6 * MANY }, (_, i) => 4 * Math.floor(i / 6) + [0, 1, 2, 2, 1, 3][i % 6]), gl.STATIC_DRAW);
    this.ordered = gl.createVertexArray();
    gl.bindVertexArray(this.ordered);
    this.buffer = filled(gl.ARRAY_BUFFER, 4 * this.count, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.bindVertexArray(null);
    this.feedback = gl.createTransformFeedback();
    const seen = Float32Array.from((this.head.seen ?? []).flatMap((frame) => [...frame, 0])); // three rows and a place
    this.textures.seen = this.texture(seen.length ? seen : new Float32Array(16), gl.RGBA32F, gl.RGBA, gl.FLOAT, 4);
    this.targets = {};
    this.styles.clear();
    for (const [name, style] of this.colours) this.upload(name, style);
    for (const [name, { gains }] of this.lights) this.light([name], gains);
    if (this.order) this.put();
  }

  link(vertex, fragment, varyings = null) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    if (varyings) gl.transformFeedbackVaryings(program, varyings, gl.INTERLEAVED_ATTRIBS);
    gl.linkProgram(program);
    return { program, places: {} };
  }

  // Wait until a program is linked, and find its uniforms.
  check({ program, places }) {
    const gl = this.gl;
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(gl.getAttachedShaders(program).map((each) => gl.getShaderInfoLog(each)).join(" ") + gl.getProgramInfoLog(program));
    }
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(program, i);
      places[name] = gl.getUniformLocation(program, name);
    }
  }

  // A texture of four values a texel; without data an empty one.
  texture(data, inner, format, type, width = WIDTH, texels = data.length / 4) {
    const gl = this.gl, rows = Math.max(1, Math.ceil(texels / width)), full = Math.floor(texels / width);
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, inner, width, rows);
    // Whole rows as they lie, then what is left: no padded copy of all.
    if (data && full) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, full, format, type, data.subarray(0, 4 * width * full));
    if (full < rows) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, full, texels - width * full, 1, format, type, data.subarray(4 * width * full));
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    return texture;
  }

  // A style: `head` with low, high and the number of maps, `part` its deflated section.
  async add(name, head, part) {
    const data = await inflate(part), rows = woven(data, this.count, 4);
    const style = { head, rows, maps: new Float32Array(data.slice(4 * this.count).buffer) };
    this.colours.set(name, style);
    this.upload(name, style);
  }

  upload(name, { head, rows, maps }) {
    const gl = this.gl, padded = new Float32Array(maps.length / 3 * 4), before = this.styles.get(name);
    for (let i = 0; i < maps.length / 3; i++) padded.set(maps.subarray(3 * i, 3 * i + 3), 4 * i);
    if (before) { gl.deleteTexture(before.rows); gl.deleteTexture(before.maps); }
    const range = new Float32Array(16);
    head.low.forEach((low, i) => { range[i] = low; range[4 + i] = head.high[i] - low; });
    this.styles.set(name, {
      range, rows: this.texture(rows, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE),
      maps: this.texture(padded, gl.RGBA32F, gl.RGBA, gl.FLOAT, padded.length / 4),
    });
  }

  // Light on the Gaussians of some styles (sun.js): four floats each; null = none.
  light(names, gains) {
    const texture = gains && this.texture(gains, this.gl.RGBA32F, this.gl.RGBA, this.gl.FLOAT), before = new Set();
    for (const name of names) {
      before.add(this.lights.get(name)?.texture);
      if (gains) this.lights.set(name, { gains, texture });
      else this.lights.delete(name);
    }
    for (const each of this.lights.values()) before.delete(each.texture);
    before.forEach((each) => { if (each) this.gl.deleteTexture(each); });
  }

  // Order the Gaussians for a camera; `view` is world to camera by columns. One at a time. Of `every` so many neighbours one is
  // drawn, as much larger: they lie in Morton order.
  sort(view, near, every = 1) {
    return new Promise((done) => {
      this.sorted = done;
      this.worker.onmessage = ({ data }) => {
        this.order = data.order;
        this.kept = data.kept;
        this.every = every;
        this.sortMilliseconds = data.milliseconds;
        this.put();
        done();
      };
      const spare = this.order;
      this.order = null;
      this.worker.postMessage({ row: [view[2], view[6], view[10], view[14]], near, every, spare }, spare ? [spare.buffer] : []);
    });
  }

  put() {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, this.order, 0, this.kept);
  }

  // A picture to draw into: `exact` ones and `depth` hold floats.
  frame(width, height, kind) {
    const gl = this.gl, before = this.targets[kind];
    if (before?.width === width && before.height === height) return before;
    if (before) { gl.deleteTexture(before.picture); gl.deleteFramebuffer(before.buffer); }
    const picture = gl.createTexture(), buffer = gl.createFramebuffer();
    gl.bindTexture(gl.TEXTURE_2D, picture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, { ...this.formats, depth: this.formats.exact, cover: gl.RGBA8 }[kind], width, height);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, picture, 0);
    return this.targets[kind] = { width, height, picture, buffer };
  }

  // Draw into the canvas at a share of its resolution. `look`: first and second style, blend in [0, 1], wipe in [0, 1] or -1.
  // `background` becomes `rim` away from the middle; what no photograph saw fades where `depth` is given, the distance of what they
  // look at. `into` is a framebuffer and a box of it, in the place of the canvas.
  draw(view, lens, look, { near = 0.01, background = [0, 0, 0], rim = background, depth = 0, share = 1, exact = true, into = null } = {}) {
    const gl = this.gl, { width, height } = into?.box ?? this.canvas;
    const small = [Math.max(1, Math.round(share * width)), Math.max(1, Math.round(share * height))];
    const scale = [small[0] / width, small[1] / height], scaled = [lens[0] * scale[0], lens[1] * scale[1], lens[2] * scale[0], lens[3] * scale[1]];
    const target = this.frame(...small, exact && this.formats.exact !== this.formats.coarse ? "exact" : "coarse");
    this.splat(target, view, scaled, look, near, null);
    const faded = Boolean(depth && this.deep && this.head.seen?.length);
    const cover = faded ? this.cover(target, view, scaled, depth) : target;
    const { program, places } = this.programs.show;
    gl.bindFramebuffer(gl.FRAMEBUFFER, into?.buffer ?? null);
    gl.viewport(into?.box.x ?? 0, into?.box.y ?? 0, width, height);
    gl.disable(gl.BLEND);
    gl.useProgram(program);
    [target, cover].forEach(({ picture }, i) => { gl.activeTexture(gl.TEXTURE0 + i); gl.bindTexture(gl.TEXTURE_2D, picture); });
    gl.uniform1i(places.picture, 0);
    gl.uniform1i(places.cover, 1);
    gl.uniform1i(places.faded, faded ? 1 : 0);
    gl.uniform2f(places.scale, ...scale);
    gl.uniform2f(places.whole, width, height);
    gl.uniform2f(places.corner, into?.box.x ?? 0, into?.box.y ?? 0);
    gl.uniform3f(places.background, ...background);
    gl.uniform3f(places.rim, ...rim);
    gl.bindVertexArray(this.quads);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // How well photographs saw what was just drawn into a target, on a coarse grid.
  cover(target, view, lens, depth) {
    const eye = eyeOf(view), apart = this.head.seen.map((frame) => Math.hypot(...eye.map((x, i) => x - frame[12 + i])));
    const nearest = Math.min(...apart), around = AROUND * (depth + nearest);
    const about = apart.reduce((sum, each) => sum + Math.exp(-(((each - nearest) / around) ** 2)), 0);
    const gl = this.gl, sides = [target.width, target.height].map((side) => Math.max(1, Math.ceil(side / COARSE)));
    const depths = this.frame(...sides, "depth"), found = this.frame(...sides, "cover");
    this.quadded(depths, [target.width, target.height], EVERY, true);
    const { program, places } = this.programs.cover;
    gl.bindFramebuffer(gl.FRAMEBUFFER, found.buffer);
    gl.disable(gl.BLEND);
    gl.useProgram(program);
    [depths.picture, this.textures.seen].forEach((texture, i) => { gl.activeTexture(gl.TEXTURE0 + i); gl.bindTexture(gl.TEXTURE_2D, texture); });
    gl.uniform1i(places.depths, 0);
    gl.uniform1i(places.seen, 1);
    gl.uniform1i(places.frames, this.head.seen.length);
    gl.uniformMatrix4fv(places.view, false, view);
    gl.uniform4f(places.lens, ...lens);
    gl.uniform2f(places.size, target.width, target.height);
    gl.uniform3f(places.eye, ...eye);
    const floats = { farthest: nearest + FARTHEST * depth, nearest, around, needed: Math.min(SEEN_BY, about) };
    for (const [name, value] of Object.entries(floats)) gl.uniform1f(places[name], value);
    gl.bindVertexArray(this.quads);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    return found;
  }

  // Draw into a target, or, into one pixel of it, depths in the place of colours.
  splat(target, view, lens, look, near, pixel) {
    const gl = this.gl, { program, places } = this.programs.project;
    const one = this.styles.get(look.first), two = this.styles.get(look.second) ?? one;
    const { shape, chunks, palette, projected } = this.textures, lights = [look.first, look.second].map((name) => this.lights.get(name));
    const all = { shape, chunks, palette, first: one.rows, second: two.rows, maps0: one.maps, maps1: two.maps, gains0: lights[0]?.texture ?? one.rows, gains1: lights[1]?.texture ?? one.rows };
    gl.useProgram(program);
    Object.entries(all).forEach(([name, texture], i) => {
      gl.activeTexture(gl.TEXTURE0 + i);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(places[name], i);
    });
    gl.uniformMatrix4fv(places.range0, false, one.range);
    gl.uniformMatrix4fv(places.range1, false, two.range);
    gl.uniform1i(places.lit0, lights[0] ? 1 : 0);
    gl.uniform1i(places.lit1, lights[1] ? 1 : 0);
    gl.uniformMatrix4fv(places.view, false, view);
    gl.uniform4f(places.lens, ...lens);
    gl.uniform2f(places.size, target.width, target.height);
    gl.uniform1f(places.near, near);
    gl.uniform1f(places.blend, look.blend ?? 0);
    gl.uniform1f(places.wipe, look.wipe ?? -1);
    gl.uniform1f(places.wider, Math.sqrt(this.every)); // as much area as all of them
    gl.uniform1f(places.largest, this.head.largest);
    gl.uniform1i(places.bands, Math.round(Math.sqrt(this.head.harmonics)));
    gl.uniform1i(places.depth, pixel ? 1 : 0);
    gl.uniform1i(places.sharp, this.head.antialiased ? 1 : 0);
    gl.uniform3f(places.eye, ...eyeOf(view));
    gl.bindVertexArray(this.ordered);
    gl.enable(gl.RASTERIZER_DISCARD);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, this.feedback);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, this.projected);
    gl.beginTransformFeedback(gl.POINTS);
    gl.drawArrays(gl.POINTS, 0, this.kept);
    gl.endTransformFeedback();
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, null);
    gl.disable(gl.RASTERIZER_DISCARD);

    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, projected);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, this.projected);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, Math.ceil(this.kept / (WIDTH / 2)), gl.RGBA_INTEGER, gl.UNSIGNED_INT, 0);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, null);

    this.quadded(target, [target.width, target.height], 1, false, pixel);
  }

  // Draw one of `every` so many projected Gaussians into a target, or into one pixel of it: colours, or `deep` their depths.
  // `size` is that of the picture that they were projected for.
  quadded(target, size, every, deep, pixel = null) {
    const gl = this.gl, { program, places } = this.programs.splat;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, target.width, target.height);
    if (pixel) { gl.enable(gl.SCISSOR_TEST); gl.scissor(...pixel, 1, 1); }
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(program);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.textures.projected);
    gl.uniform2f(places.size, ...size);
    gl.uniform1i(places.projected, 0);
    gl.uniform1i(places.kept, this.kept);
    gl.uniform1i(places.every, every);
    gl.uniform1i(places.deep, deep ? 1 : 0);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
    gl.bindVertexArray(this.quads);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * MANY, gl.UNSIGNED_SHORT, 0, Math.ceil(this.kept / (MANY * every)));
    gl.bindVertexArray(null);
    gl.disable(gl.SCISSOR_TEST);
  }

  // Depth along the camera's axis at a pixel of the canvas, the mean by weight; null where there is nothing to see.
  pick(view, lens, look, x, y, near = 0.01) {
    const gl = this.gl, target = this.frame(this.canvas.width, this.canvas.height, this.formats.exact === this.formats.coarse ? "coarse" : "exact"), pixel = [Math.floor(x), Math.floor(y)];
    this.splat(target, view, lens, look, near, pixel);
    const found = new Float32Array(4);
    gl.readPixels(...pixel, 1, 1, gl.RGBA, gl.FLOAT, found);
    return found[3] > 0.3 ? found[0] / found[3] : null;
  }
}

// The place of a camera, -R^T t, by its world-to-camera matrix.
const eyeOf = (view) => [0, 1, 2].map((i) => -(view[4 * i] * view[12] + view[4 * i + 1] * view[13] + view[4 * i + 2] * view[14]));

const decodedMeans = (shape, chunks, count) => {
  const means = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) {
    const c = 12 * (i >> 8), x = shape[4 * i], z = shape[4 * i + 1] & 65535;
    means[3 * i] = chunks[c] + (chunks[c + 3] - chunks[c]) * (x & 65535) / 65535;
    means[3 * i + 1] = chunks[c + 1] + (chunks[c + 4] - chunks[c + 1]) * (x >>> 16) / 65535;
    means[3 * i + 2] = chunks[c + 2] + (chunks[c + 5] - chunks[c + 2]) * z / 65535;
  }
  return means;
};
