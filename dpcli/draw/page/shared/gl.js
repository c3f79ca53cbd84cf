// WebGL 2: a context that is built again after the browser took it away, programs, attributes.

// Throws "no WebGL 2" where there is none. `build` sets up programs and buffers, now and after each loss; then `drawn` is called.
// Meanwhile the page says so.
function glContext(canvas, options, build, drawn) {
  const gl = canvas.getContext("webgl2", options);
  if (!gl) throw new Error("no WebGL 2");
  canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); warn("the graphics card was taken away; the picture comes back with it"); });
  canvas.addEventListener("webglcontextrestored", () => { build(gl); warn(""); drawn(); });
  build(gl);
  return gl;
}

function glProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(`shader: ${gl.getShaderInfoLog(shader)}`);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(`program: ${gl.getProgramInfoLog(program)}`);
  return program;
}
