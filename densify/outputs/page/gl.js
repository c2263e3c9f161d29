// SPDX-License-Identifier: MIT
// Drawing of points and lines with WebGL2. Depth edges are shaded as in eye-dome lighting
// (Boucheny 2009): a pixel that lies behind its neighbours gets darker.

const POINTS_VERTEX = `#version 300 es
precision highp float;
layout(location=0) in vec4 place;   // x, y, z in steps, sweep
layout(location=1) in vec4 shift;   // x, y, z in steps, mover
layout(location=2) in vec4 colour;  // RGB, confidence
uniform mat4 viewProjection;
uniform vec3 low; uniform float placeStep, shiftStep, registered, pointScale, leastSize;
uniform int colouring; uniform vec2 heights; uniform float mostMoved;
uniform vec2 sweeps;                // first and last that are shown
uniform bool onlyMoving, withFar;
uniform sampler2D sweepColours, moverColours, palette;
out vec3 shade;
void main() {
  vec3 moved = shift.xyz * shiftStep;
  vec3 p = low + place.xyz * placeStep - registered * moved;
  int sweep = int(place.w + .5), mover = int(shift.w + .5);
  vec4 own = texelFetch(sweepColours, ivec2(sweep, 0), 0);
  bool far = own.a < .5;
  bool hidden = (far && !withFar) || (!far && (place.w < sweeps.x || place.w > sweeps.y))
    || (onlyMoving && mover == 0);
  gl_Position = hidden ? vec4(2., 2., 2., 1.) : viewProjection * vec4(p, 1.);
  // Approximate angle in radians between kept points, from the key.
  float across = max(.05, .0042 * length(p));
  gl_PointSize = hidden ? 0. : clamp(pointScale * across / gl_Position.w, leastSize, 30.);
  if (colouring == 0) shade = colour.rgb;
  else if (colouring == 1) shade = texture(palette, vec2((p.z - heights.x) / (heights.y - heights.x), .25)).rgb;
  else if (colouring == 2) shade = own.rgb;
  else if (colouring == 3) shade = mover == 0 ? vec3(dot(colour.rgb, vec3(.3, .5, .2)) * .55)
    : texelFetch(moverColours, ivec2(mover, 0), 0).rgb;
  else if (colouring == 4) shade = texture(palette, vec2(colour.a, .75)).rgb;
  else shade = mover == 0 ? vec3(dot(colour.rgb, vec3(.3, .5, .2)) * .55)
    : texture(palette, vec2(length(moved) / mostMoved, .25)).rgb;
}`;
const POINTS_FRAGMENT = `#version 300 es
precision mediump float;
in vec3 shade; out vec4 pixel;
void main() {
  vec2 off = gl_PointCoord - .5;
  if (dot(off, off) > .26) discard;
  pixel = vec4(shade, 1.);
}`;
const LINES_VERTEX = `#version 300 es
precision highp float;
layout(location=0) in vec3 from; layout(location=1) in vec3 to; layout(location=2) in vec4 tint;
layout(location=3) in vec2 corner;  // end 0 or 1, side -1 or 1
uniform mat4 viewProjection; uniform vec2 size; uniform float width;
out vec4 shade;
void main() {
  vec4 a = viewProjection * vec4(from, 1.), b = viewProjection * vec4(to, 1.);
  float near = .02;
  if (a.w < near && b.w < near) { gl_Position = vec4(2., 2., 2., 1.); return; }
  if (a.w < near) a = mix(a, b, (near - a.w) / (b.w - a.w));
  if (b.w < near) b = mix(b, a, (near - b.w) / (a.w - b.w));
  vec2 along = (b.xy / b.w - a.xy / a.w) * size;
  vec2 across = length(along) < 1e-6 ? vec2(0., 1.) : normalize(vec2(-along.y, along.x));
  vec4 at = corner.x < .5 ? a : b;
  gl_Position = at + vec4(corner.y * across * width / size * at.w, -.0004 * at.w, 0.);
  shade = tint;
}`;
const LINES_FRAGMENT = `#version 300 es
precision mediump float;
in vec4 shade; out vec4 pixel;
void main() { pixel = shade; }`;
const SCREEN_VERTEX = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3. : -1., gl_VertexID == 2 ? 3. : -1., 0., 1.); }`;
const SCREEN_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D colours, depths; uniform vec2 nearFar; uniform float strength, reach;
out vec4 pixel;
float logDepth(ivec2 at) {
  float d = texelFetch(depths, at, 0).r;
  if (d >= 1.) return 1e3;
  float n = nearFar.x, f = nearFar.y;
  return log2(2. * n * f / (f + n - (2. * d - 1.) * (f - n)));
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy), limit = textureSize(depths, 0) - 1;
  vec4 own = texelFetch(colours, at, 0);
  float here = logDepth(at), darker = 0.;
  if (here > 999.) { pixel = own; return; }
  int r = max(1, int(reach));
  for (int i = 0; i < 4; i++) {
    ivec2 step = i == 0 ? ivec2(r, 0) : i == 1 ? ivec2(-r, 0) : i == 2 ? ivec2(0, r) : ivec2(0, -r);
    darker += min(max(0., here - logDepth(clamp(at + step, ivec2(0), limit))), .35);
  }
  pixel = vec4(own.rgb * exp(-strength * darker), 1.);
}`;

const LOCATIONS = { places: 0, shifts: 1, colours: 2 };

class Painter {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("this browser or machine has no WebGL2; cloud.laz opens in CloudCompare, PDAL and QGIS");
    Object.assign(this, { gl, canvas });
    this.points = this.program(POINTS_VERTEX, POINTS_FRAGMENT);
    this.lines = this.program(LINES_VERTEX, LINES_FRAGMENT);
    this.screen = this.program(SCREEN_VERTEX, SCREEN_FRAGMENT);
    this.empty = gl.createVertexArray();
    this.target = null;
  }
  program(vertex, fragment) {
    const { gl } = this, made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    const at = {};
    const count = gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS);
    for (let i = 0; i < count; i++) {
      const { name } = gl.getActiveUniform(made, i);
      at[name] = gl.getUniformLocation(made, name);
    }
    return { made, at };
  }
  buffer(location, values, size, type, normalised = false, divisor = 0) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, size, type, normalised, 0, 0);
    gl.vertexAttribDivisor(location, divisor);
  }
  // places: Uint16 x 4, shifts: Int16 x 4, colours: Uint8 x 4, a point each.
  setPoints({ places, shifts, colours }) {
    const { gl } = this;
    this.cloud = gl.createVertexArray();
    this.numPoints = places.length / 4;
    gl.bindVertexArray(this.cloud);
    this.buffer(LOCATIONS.places, places, 4, gl.UNSIGNED_SHORT);
    this.buffer(LOCATIONS.shifts, shifts, 4, gl.SHORT);
    this.buffer(LOCATIONS.colours, colours, 4, gl.UNSIGNED_BYTE, true);
  }
  // segments: [from, to, [r, g, b]], one by one.
  setLines(segments) {
    const { gl } = this;
    this.numLines = segments.length;
    if (this.wires) gl.deleteVertexArray(this.wires);
    this.wires = gl.createVertexArray();
    gl.bindVertexArray(this.wires);
    const flat = (k) => new Float32Array(segments.flatMap((s) => s[k]));
    this.buffer(0, flat(0), 3, gl.FLOAT, false, 1);
    this.buffer(1, flat(1), 3, gl.FLOAT, false, 1);
    this.buffer(2, new Uint8Array(segments.flatMap((s) => [...s[2], 255])), 4, gl.UNSIGNED_BYTE, true, 1);
    this.buffer(3, new Float32Array([0, -1, 0, 1, 1, -1, 1, 1]), 2, gl.FLOAT);
  }
  texture(unit, width, height, rgba) {
    const { gl } = this, made = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
    for (const [name, value] of [["MIN_FILTER", gl.LINEAR], ["MAG_FILTER", gl.LINEAR], ["WRAP_S", gl.CLAMP_TO_EDGE], ["WRAP_T", gl.CLAMP_TO_EDGE]]) {
      gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}`], value);
    }
  }
  resize() {
    const { gl, canvas } = this, ratio = Math.min(devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (this.target && canvas.width === width && canvas.height === height) return;
    Object.assign(canvas, { width, height });
    if (this.target) [this.target.colours, this.target.depths].forEach((t) => gl.deleteTexture(t));
    const make = (inner, outer, type, unit) => {
      const t = gl.createTexture();
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, t);
      gl.texImage2D(gl.TEXTURE_2D, 0, inner, width, height, 0, outer, type, null);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      return t;
    };
    const colours = make(gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, 4);
    const depths = make(gl.DEPTH_COMPONENT24, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, 5);
    const frame = this.target?.frame || gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, colours, 0);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depths, 0);
    this.target = { frame, colours, depths };
  }
  // Everything once. u: uniforms of the points; share: of the points that are drawn, 0 to 1.
  draw(viewProjection, u, { share, nearFar, background, withLines }) {
    const { gl, canvas } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.frame);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    const { made, at } = this.points;
    gl.useProgram(made);
    gl.uniformMatrix4fv(at.viewProjection, false, viewProjection);
    gl.uniform3fv(at.low, u.low);
    for (const name of ["placeStep", "shiftStep", "registered", "pointScale", "leastSize", "mostMoved"]) gl.uniform1f(at[name], u[name]);
    for (const name of ["heights", "sweeps"]) gl.uniform2fv(at[name], u[name]);
    for (const name of ["colouring", "onlyMoving", "withFar"]) gl.uniform1i(at[name], Number(u[name]));
    ["sweepColours", "moverColours", "palette"].forEach((name, unit) => gl.uniform1i(at[name], 1 + unit));
    gl.bindVertexArray(this.cloud);
    gl.drawArrays(gl.POINTS, 0, Math.ceil(share * this.numPoints));
    if (withLines && this.numLines) {
      gl.useProgram(this.lines.made);
      gl.uniformMatrix4fv(this.lines.at.viewProjection, false, viewProjection);
      gl.uniform2f(this.lines.at.size, canvas.width, canvas.height);
      gl.uniform1f(this.lines.at.width, 1.6 * Math.min(devicePixelRatio || 1, 2));
      gl.bindVertexArray(this.wires);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.numLines);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.DEPTH_TEST);
    const s = this.screen;
    gl.useProgram(s.made);
    gl.activeTexture(gl.TEXTURE4);
    gl.bindTexture(gl.TEXTURE_2D, this.target.colours);
    gl.activeTexture(gl.TEXTURE5);
    gl.bindTexture(gl.TEXTURE_2D, this.target.depths);
    gl.uniform1i(s.at.colours, 4);
    gl.uniform1i(s.at.depths, 5);
    gl.uniform2fv(s.at.nearFar, nearFar);
    gl.uniform1f(s.at.strength, 1.6);
    gl.uniform1f(s.at.reach, Math.min(devicePixelRatio || 1, 2));
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
  }
  // Whether the last frame is still being drawn. A slow GPU would otherwise be given ever more.
  isBusy() {
    const { gl, fence } = this;
    if (!fence || gl.isContextLost()) return false;
    if (gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) return true;
    gl.deleteSync(fence);
    this.fence = null;
    return false;
  }
}
