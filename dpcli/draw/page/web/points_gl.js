// Points as small shaded balls. They are drawn with their depth into a texture; then every pixel gets darker the farther it lies
// behind its neighbors (eye-dome lighting, Boucheny 2009), so that shape shows without normals.

const BALL_VERTEX = `#version 300 es
precision highp float;
in vec3 place; in vec4 tint;
uniform mat3 rotation; uniform vec3 shift; uniform vec2 lens; uniform vec2 range; uniform float reach; uniform float focal; uniform float ground; uniform float ahead; uniform bool shadow;
out vec3 color; out float away;
void main() {
  vec3 world = shadow ? vec3(place.x, ground, place.z) : place, p = rotation * world + shift;
  color = tint.rgb;
  away = p.z;
  if (p.z < range.x || tint.a == 0.0) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); gl_PointSize = 1.0; return; }
  float depth = (range.y + range.x) / (range.y - range.x) - 2.0 * range.x * range.y / (range.y - range.x) / max(p.z - ahead, range.x);
  gl_Position = vec4(lens.x * p.x, -lens.y * p.y, depth * p.z, p.z);
  gl_PointSize = clamp(2.0 * reach * focal / p.z, 1.5, 96.0);
}`;

const BALL_FRAGMENT = `#version 300 es
precision highp float;
in vec3 color; in float away;
uniform bool shadow; uniform float darkness; uniform vec3 haze; uniform vec2 depths;
out vec4 result;
void main() {
  vec2 d = 2.0 * gl_PointCoord - 1.0;
  float square = dot(d, d);
  if (square > 1.0) discard;
  if (shadow) { result = vec4(0.0, 0.0, 0.0, darkness * (1.0 - square)); return; }
  float light = max(dot(vec3(d, -sqrt(1.0 - square)), normalize(vec3(-0.35, -0.6, -0.75))), 0.0);
  float far = clamp((away - depths.x) / (depths.y - depths.x), 0.0, 1.0);
  result = vec4(mix(color * (0.66 + 0.4 * light), haze, 0.28 * far), 1.0);
}`;

const LIT_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

const LIT_FRAGMENT = `#version 300 es
precision highp float; precision highp sampler2D;
uniform sampler2D picture; uniform sampler2D depth; uniform vec2 range; uniform int finer; uniform int beside;
out vec4 result;
float distanceAt(ivec2 at) {
  float d = texelFetch(depth, clamp(at, ivec2(0), textureSize(depth, 0) - 1), 0).r;
  return d == 1.0 ? -1.0 : log2(2.0 * range.x * range.y / (range.y + range.x - (2.0 * d - 1.0) * (range.y - range.x)));
}
void main() {
  ivec2 corner = ivec2(gl_FragCoord.xy) * finer;
  vec4 sum = vec4(0.0);
  for (int k = 0; k < finer * finer; k++) {
    ivec2 at = corner + ivec2(k % finer, k / finer);
    vec4 color = texelFetch(picture, at, 0);
    float own = distanceAt(at), behind = 0.0;
    if (own > -1.0) for (int j = 0; j < 8; j++) {
      ivec2 way = ivec2(j < 3 ? -1 : j < 5 ? 0 : 1, j == 0 || j == 3 || j == 5 ? -1 : j == 1 || j == 6 ? 0 : 1);
      float other = distanceAt(at + way * beside);
      if (other > -1.0) behind += clamp(own - other, 0.0, 0.12);
    }
    sum += vec4(color.rgb * exp(-1.5 * behind), color.a);
  }
  result = sum / float(finer * finer);
}`;

class GlPoints {
  constructor(canvas, wake) {
    this.canvas = canvas;
    this.gl = glContext(canvas, { antialias: false, depth: false }, (gl) => this.build(gl), wake);
  }

  build(gl) {
    this.gl = gl;
    this.ball = glProgram(gl, BALL_VERTEX, BALL_FRAGMENT);
    this.lit = glProgram(gl, LIT_VERTEX, LIT_FRAGMENT);
    this.buffers = { place: gl.createBuffer(), tint: gl.createBuffer() };
    this.shape = gl.createVertexArray();
    gl.bindVertexArray(this.shape);
    for (const [name, size, type] of [["place", 3, gl.FLOAT], ["tint", 4, gl.UNSIGNED_BYTE]]) {
      const at = gl.getAttribLocation(this.ball, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[name]);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, size, type, type !== gl.FLOAT, 0, 0);
    }
    gl.bindVertexArray(null);
    this.target = this.places = this.colors = null;
  }

  // Textures of the canvas's size, or twice that on a coarse screen: their pixels are averaged, so edges are smooth.
  aim(width, height) {
    const { gl } = this, finer = width < 1.5 * this.canvas.clientWidth ? 2 : 1;
    if (this.target?.width === width * finer && this.target.height === height * finer) return this.target;
    for (const old of this.target ? [this.target.picture, this.target.depth] : []) gl.deleteTexture(old);
    if (this.target) gl.deleteFramebuffer(this.target.frame);
    const target = { width: width * finer, height: height * finer, finer, frame: gl.createFramebuffer() };
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    for (const [name, format, place] of [["picture", gl.RGBA8, gl.COLOR_ATTACHMENT0], ["depth", gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT]]) {
      target[name] = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, target[name]);
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, target.width, target.height);
      for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, place, gl.TEXTURE_2D, target[name], 0);
    }
    return this.target = target;
  }

  fill(name, values) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[name]);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  }

  setter(program) {
    const { gl } = this;
    gl.useProgram(program);
    return (kind, name, ...values) => gl[`uniform${kind}`](gl.getUniformLocation(program, name), ...values);
  }

  draw(clip, spans, colors, camera, look) {
    const { gl } = this, target = this.aim(camera.width, camera.height), near = Math.max(0.02, look.depths[0] - 2), range = [near, look.depths[1] + 4];
    if (this.places !== clip.places) this.fill("place", this.places = clip.places);
    if (this.colors !== colors) this.fill("tint", this.colors = colors);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.viewport(0, 0, target.width, target.height);
    gl.depthMask(true);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const set = this.setter(this.ball);
    set("Matrix3fv", "rotation", false, asColumns(camera.rotation));
    set("3fv", "shift", camera.shift);
    set("2f", "lens", 2 * camera.focal / camera.width, 2 * camera.focal / camera.height);
    set("2fv", "range", range);
    set("2fv", "depths", look.depths);
    set("1f", "focal", camera.focal * target.finer);
    set("1f", "ground", clip.floor);
    set("3fv", "haze", look.ground.map((value) => value / 255));
    gl.bindVertexArray(this.shape);
    if (look.shadow) this.pass(set, spans, 4 * look.reach, look.shadow);
    this.pass(set, spans, look.reach, 0);
    gl.bindVertexArray(null);
    this.show(target, range);
  }

  // Balls, or for `darkness` > 0 their soft shadow on the ground. A later span hides an earlier one that is hardly nearer.
  pass(set, spans, reach, darkness) {
    const { gl } = this, shadow = darkness > 0;
    gl[shadow ? "disable" : "enable"](gl.DEPTH_TEST);
    gl[shadow ? "enable" : "disable"](gl.BLEND);
    gl.blendEquation(gl.MAX);  // many shadows on one place are as dark as one
    set("1i", "shadow", shadow);
    set("1f", "darkness", darkness);
    set("1f", "reach", reach);
    for (const [k, [first, count]] of spans.entries()) {
      set("1f", "ahead", 2 * reach * k);
      gl.drawArrays(gl.POINTS, first, count);
    }
  }

  show(target, range) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    const set = this.setter(this.lit);
    for (const [unit, name] of ["picture", "depth"].entries()) {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, target[name]);
      set("1i", name, unit);
    }
    set("2fv", "range", range);
    set("1i", "finer", target.finer);
    set("1i", "beside", Math.max(1, Math.round(target.width / this.canvas.clientWidth)));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}
