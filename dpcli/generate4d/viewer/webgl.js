// Gaussians as blended quads, far to near (EWA splatting, Zwicker 2001; constants as in the fit's rasterizer).

const VERTEX = `#version 300 es
precision highp float;
in vec2 corner; in vec3 center; in vec3 spreadA; in vec3 spreadB; in vec4 color;
uniform mat3 rotation; uniform vec3 shift; uniform vec2 focal; uniform vec2 size; uniform float near;
out vec2 place; out vec4 tint;
void main() {
  vec3 p = rotation * center + shift;
  tint = color;
  float reach = sqrt(max(2.0 * log(255.0 * color.a), 0.0));
  if (p.z < near || reach == 0.0) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); return; }
  vec2 limit = 1.3 * 0.5 * size / focal;
  vec2 t = clamp(p.xy / p.z, -limit, limit);
  mat3 jacobian = mat3(focal.x / p.z, 0.0, 0.0, 0.0, focal.y / p.z, 0.0, -focal.x * t.x / p.z, -focal.y * t.y / p.z, 0.0);
  mat3 spread = mat3(spreadA.x, spreadA.y, spreadA.z, spreadA.y, spreadB.x, spreadB.y, spreadA.z, spreadB.y, spreadB.z);
  mat3 m = jacobian * rotation;
  mat3 flat2 = m * spread * transpose(m);
  float a = flat2[0][0] + 0.3, b = flat2[0][1], c = flat2[1][1] + 0.3;
  float middle = 0.5 * (a + c), gap = sqrt(max(0.25 * (a - c) * (a - c) + b * b, 1e-12));
  float large = middle + gap, small = max(middle - gap, 0.05);
  vec2 axis = abs(b) > 1e-6 ? normalize(vec2(b, large - a)) : (a >= c ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  place = corner * reach;
  vec2 pixel = focal * p.xy / p.z + place.x * sqrt(large) * axis + place.y * sqrt(small) * vec2(-axis.y, axis.x);
  gl_Position = vec4(2.0 * pixel / size * vec2(1.0, -1.0), 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 place; in vec4 tint; out vec4 result;
void main() {
  float alpha = min(0.999, tint.a * exp(-0.5 * dot(place, place)));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(tint.rgb * alpha, alpha);
}`;

const FLOATS = 13;  // of one Gaussian: center, covariance, color

class GlPainter {
  constructor(canvas, count, wake) {
    this.rows = new Float32Array(FLOATS * count);
    this.gl = glContext(canvas, { antialias: false, depth: false }, (gl) => this.build(gl), wake);
  }

  build(gl) {
    this.gl = gl;
    this.program = glProgram(gl, VERTEX, FRAGMENT);
    gl.useProgram(this.program);
    this.attribute("corner", 2, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), 0, 0, 0);
    this.buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, this.rows.byteLength, gl.DYNAMIC_DRAW);
    let offset = 0;
    for (const [name, size] of [["center", 3], ["spreadA", 3], ["spreadB", 3], ["color", 4]]) {
      this.attribute(name, size, null, 4 * FLOATS, 4 * offset, 1);
      offset += size;
    }
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  attribute(name, size, values, stride, offset, divisor) {
    const gl = this.gl, place = gl.getAttribLocation(this.program, name);
    if (values) {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    }
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, gl.FLOAT, false, stride, offset);
    gl.vertexAttribDivisor(place, divisor);
  }

  draw(scene, order, rgba, camera, background) {
    const { gl, rows, program } = this, { mean, covariance } = scene;
    for (let k = 0, o = 0; k < order.length; k++, o += FLOATS) {
      const i = order[k];
      for (let j = 0; j < 3; j++) rows[o + j] = mean[3 * i + j];
      for (let j = 0; j < 6; j++) rows[o + 3 + j] = covariance[6 * i + j];
      for (let j = 0; j < 4; j++) rows[o + 9 + j] = rgba[4 * i + j] / 255;
    }
    const uniform = (name) => gl.getUniformLocation(program, name);
    gl.viewport(0, 0, camera.width, camera.height);
    gl.clearColor(...background.map((value) => value / 255), 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniformMatrix3fv(uniform("rotation"), false, asColumns(camera.rotation));
    gl.uniform3fv(uniform("shift"), camera.shift);
    gl.uniform2f(uniform("focal"), camera.focal, camera.focal);
    gl.uniform2f(uniform("size"), camera.width, camera.height);
    gl.uniform1f(uniform("near"), camera.near);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, rows, 0, FLOATS * order.length);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, order.length);
  }
}
