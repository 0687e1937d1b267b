// Programs of the graphics card that draw packed 3D Gaussians (fprf/page/pack.py) as fprf's rasteriser does, in colours that blend
// between two styles.
//
// Two passes: each Gaussian is projected and coloured once (transform feedback), then drawn as a quad that just holds it, the
// nearest first, under what is there: colour += (1 - a) alpha c, a += (1 - a) alpha. Eight bits a channel lose what faint ones
// add (37 dB on the garden against 42 with half floats), so they are for cameras that move. Where the processor draws, whole
// floats take half the time of half floats, and no more than bytes.
"use strict";

const TEXELS = 2048; // a row of a texture
const INSTANCE_QUADS = 1024; // quads of an instance: one quad each costs software, and most cards, more than what it covers
const UNSEEN_SHARE = 0.5; // of the photographs that shall have seen a thing, up to which nothing is shown; by eye: single dark things stand out at the rim
const AROUND_SIZE = [24, 16]; // pixels of what lies around a picture: it is as soft
const AROUND_ASKED = [20, 12]; // places of a picture that each of them is a mean of
const AROUND_WIDTH = 0.11; // of the picture, over which that mean fades: about half of a wing; by eye
const AROUND_PRIOR = 0.005; // weight of the page's own colour, of one place: where nothing is near; by eye
const FADE_SIDE = 9; // places on each side of one, that say how much about it was seen
const FADE_APART = 0.018; // of the picture's shorter side, from one to the next; by eye
const LEAST_ABOUT = 0.67; // share of it, up to which nothing is shown: more than on a straight rim, so that what stands across it goes; by eye
const BORDER_SHARE = 0.07; // of a frame's side, within which it counts less; by eye
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
ivec2 texel(int i) { return ivec2(i % ${TEXELS}, i / ${TEXELS}); }
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
  vec3 gain0 = lit0 ? texelFetch(gains0, texel(int(index)), 0).rgb : vec3(1.), gain1 = lit1 ? texelFetch(gains1, texel(int(index)), 0).rgb : vec3(1.);
  vec3 shown = m < 1. ? shaded(texelFetch(first, texel(int(index)), 0), range0, maps0, rest, gain0) : vec3(0.);
  if (m > 0.) shown = mix(shown, shaded(texelFetch(second, texel(int(index)), 0), range1, maps1, rest, gain1), m);
  look = uvec4(packHalf2x16(shown.rg), packHalf2x16(vec2(shown.b, alpha)), wide, far);
}`;
const NOTHING = `${COMMON}void main() {}`;
const QUAD = `${COMMON}
uniform vec2 size; uniform usampler2D projected; uniform int kept, every; uniform bool deep;
out vec2 at; flat out vec4 colour;
void main() {
  gl_Position = vec4(2., 2., 2., 1.);
  at = vec2(0.); colour = vec4(0.);
  int i = (gl_InstanceID * ${INSTANCE_QUADS} + (gl_VertexID >> 2)) * every; // four vertices a quad
  if (i >= kept) return;
  ivec2 from = ivec2(i % ${TEXELS / 2} * 2, i / ${TEXELS / 2});
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
    vec2 within = clamp(min(f.xy / f.z, 1. - f.xy / f.z) / ${BORDER_SHARE}, 0., 1.);
    float apart = max(0., distance(eye, texelFetch(seen, ivec2(3, k), 0).xyz) - nearest) / around;
    if (f.z > 0.) sum += within.x * within.y * exp(-apart * apart);
  }
  o = vec4(smoothstep(${UNSEEN_SHARE}, 1., sum / needed));
}`;
// Fade towards what was not seen, within what was; single seen things in the unseen fade too. Once across, once down.
const FADE = `${COMMON}
uniform sampler2D cover; uniform bool down; out vec4 o;
void main() {
  vec2 whole = vec2(textureSize(cover, 0)), sum = vec2(0.), here = gl_FragCoord.xy;
  vec2 apart = ${FADE_APART} * min(whole.x, whole.y) * (down ? vec2(0., 1.) : vec2(1., 0.));
  for (int i = -${FADE_SIDE}; i <= ${FADE_SIDE}; i++) {
    float near = exp(-.5 * pow(2. * float(i) / ${FADE_SIDE}., 2.));
    vec2 there = (here + float(i) * apart) / whole;
    if (clamp(there, 0., 1.) == there) sum += near * vec2(texture(cover, there).r, 1.); // of what lies outside nothing is known
  }
  float about = sum.x / sum.y, own = texture(cover, here / whole).g;
  o = down ? vec4(min(own, smoothstep(${LEAST_ABOUT}, 1., about))) : vec4(about, own, 0., 0.);
}`;
// What lies around a picture: colours of what is drawn near, carried on to where nothing is.
const AROUND = `${COMMON}
uniform sampler2D picture, cover; uniform bool faded; uniform vec3 background; out vec4 o;
void main() {
  vec2 here = gl_FragCoord.xy / vec2(${AROUND_SIZE});
  vec4 sum = ${AROUND_PRIOR} * vec4(background, 1.);
  for (int i = 0; i < ${AROUND_ASKED[0]}; i++) for (int j = 0; j < ${AROUND_ASKED[1]}; j++) {
    vec2 there = (vec2(i, j) + .5) / vec2(${AROUND_ASKED}), apart = (there - here) / ${AROUND_WIDTH};
    vec4 c = texture(picture, there);
    if (faded) c *= texture(cover, there).r;
    sum += exp(-.5 * dot(apart, apart)) * c;
  }
  o = vec4(sum.rgb / sum.a, 1.);
}`;
const SHOW = `${COMMON}
uniform sampler2D picture, cover, around; uniform vec2 whole, corner; uniform vec3 background, rim; uniform bool faded; uniform float ambience;
out vec4 o;
void main() {
  vec2 at = gl_FragCoord.xy - corner;
  at.y = whole.y - at.y;
  vec4 c = texture(picture, at / whole);
  if (faded) c *= texture(cover, at / whole).r;
  // The background: lighter behind the middle of the picture; eight bits would show its steps without the noise.
  float away = smoothstep(0., 1.1, length((at / whole - vec2(.5, .42)) * vec2(1.1, 1.3)));
  float noise = fract(52.9829189 * fract(dot(gl_FragCoord.xy, vec2(.06711056, .00583715)))) - .5;
  vec3 behind = background == rim ? background : mix(background, rim, away) + noise / 255.;
  if (ambience > 0.) behind = mix(behind, texture(around, at / whole).rgb, ambience);
  o = vec4(c.rgb + (1. - c.a) * behind, 1.);
}`;
