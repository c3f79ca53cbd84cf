// A camera that orbits: drag turns, wheel or pinch zooms, shift-drag or two fingers move.

// Right-handed world, y up; azimuth 0 looks from +z, positive towards +x. Camera axes: x right, y down, z forward.
function cameraOf(state, fovy, canvas) {
  const { azimuth: a, elevation: e, radius, target } = state;
  const forward = [-Math.cos(e) * Math.sin(a), -Math.sin(e), -Math.cos(e) * Math.cos(a)], right = [Math.cos(a), 0, -Math.sin(a)];
  const down = [forward[1] * right[2] - forward[2] * right[1], forward[2] * right[0] - forward[0] * right[2],
                forward[0] * right[1] - forward[1] * right[0]];
  const rotation = [...right, ...down, ...forward], { width, height } = canvas;
  const shift = [0, 1, 2].map((k) => -(rotation[3 * k] * target[0] + rotation[3 * k + 1] * target[1] + rotation[3 * k + 2] * target[2]));
  shift[2] += radius;
  return { rotation, shift, forward, right, down, width, height, focal: 0.5 * Math.min(width, height) / Math.tan(fovy / 2) };
}

// Matrices are columns in GLSL.
const asColumns = (R) => [R[0], R[3], R[6], R[1], R[4], R[7], R[2], R[5], R[8]];

// Adds azimuth, elevation, radius and target to the state; `home()` says where the camera begins.
class Stage extends Player {
  constructor(canvas, fovy, timeline) {
    super(timeline);
    Object.assign(this, { canvas, fovy });
  }

  get camera() { return cameraOf(this.state, this.fovy, this.canvas); }

  change(values) {
    const state = Object.assign(this.state, values);
    state.elevation = Math.min(Math.max(state.elevation, -89.9 * DEGREE), 89.9 * DEGREE);
    state.radius = Math.min(Math.max(state.radius, 0.05), 100);
    super.change({});
  }

  // Values of the address; a reader that gives a place wants to see it, not where playing has come to.
  readAddress() {
    const given = addressed(), number = (key) => Number(given.get(key)), values = {};
    if (given.has("time")) Object.assign(values, { time: number("time"), play: false });
    if (given.has("play")) values.play = given.get("play") === "1";
    if (given.has("radius") && number("radius") > 0) values.radius = number("radius");
    for (const key of ["azimuth", "elevation"]) if (given.has(key)) values[key] = number(key) * DEGREE;
    root.toggleAttribute("data-bare", given.get("controls") === "0");
    return values;
  }

  fitCanvas() {
    const { canvas } = this, ratio = Math.min(window.devicePixelRatio || 1, 2);
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    this.wake();
  }

  zoom(factor) { this.change({ radius: this.state.radius * factor }); }
  goHome() { this.change(this.home()); }

  pan(dx, dy) {
    const { camera } = this, step = this.state.radius / camera.focal * this.canvas.width / this.canvas.clientWidth;
    this.change({ target: this.state.target.map((value, k) => value - step * (dx * camera.right[k] + dy * camera.down[k])) });
  }

  listenToCanvas() {
    const { canvas } = this, pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      canvas.classList.add("moving");
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => this.drag(event, pointers));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => {
      pointers.delete(event.pointerId);
      canvas.classList.toggle("moving", pointers.size > 0);
    });
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.zoom(Math.exp(event.deltaY * 0.001)); }, { passive: false });
    canvas.addEventListener("dblclick", () => this.goHome());
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    new ResizeObserver(() => this.fitCanvas()).observe(canvas);
  }

  drag(event, pointers) {
    const before = pointers.get(event.pointerId), { azimuth, elevation, radius } = this.state;
    if (!before) return;
    const now = [event.clientX, event.clientY], dx = now[0] - before[0], dy = now[1] - before[1];
    if (pointers.size === 2) {
      const other = [...pointers].find(([id]) => id !== event.pointerId)[1], span = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
      this.change({ radius: radius * span(before) / Math.max(span(now), 1) });
      this.pan(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons > 1) this.pan(dx, dy);
    else this.change({ azimuth: azimuth - dx * 0.008, elevation: elevation + dy * 0.008 });
    pointers.set(event.pointerId, now);
  }
}
