// A camera that orbits: drag turns and lets it coast, wheel or pinch zooms, shift-drag or two fingers move.

const COAST = 6, IDLE = 0.02, TURN = 20 * DEGREE;  // 1/s that coasting fades by; radians/s: too slow to see, turning by itself
const NUDGE = 5 * DEGREE;  // of a key

// Right-handed world, y up; azimuth 0 looks from +z, positive towards +x. Camera axes: x right, y down, z forward.
// `half`: half the width and the height of what it shows at least, at a distance of 1.
function cameraOf(state, half, canvas) {
  const { azimuth: a, elevation: e, radius, target } = state;
  const forward = [-Math.cos(e) * Math.sin(a), -Math.sin(e), -Math.cos(e) * Math.cos(a)], right = [Math.cos(a), 0, -Math.sin(a)];
  const down = [forward[1] * right[2] - forward[2] * right[1], forward[2] * right[0] - forward[0] * right[2],
                forward[0] * right[1] - forward[1] * right[0]];
  const rotation = [...right, ...down, ...forward], { width, height } = canvas;
  const shift = [0, 1, 2].map((k) => -(rotation[3 * k] * target[0] + rotation[3 * k + 1] * target[1] + rotation[3 * k + 2] * target[2]));
  shift[2] += radius;
  return { rotation, shift, forward, right, down, width, height, focal: 0.5 * Math.min(width / half[0], height / half[1]) };
}

// Matrices are columns in GLSL.
const asColumns = (R) => [R[0], R[3], R[6], R[1], R[4], R[7], R[2], R[5], R[8]];

// Adds azimuth, elevation, radius and target to the state; `home()` says where the camera begins. `radii`: least and largest radius.
class Stage extends Player {
  constructor(canvas, half, timeline) {
    super(timeline);
    Object.assign(this, { canvas, half, spin: [0, 0], pace: [0, 0], radii: [0.05, 100] });
  }

  get camera() { return cameraOf(this.state, this.half, this.canvas); }

  change(values) {
    const state = Object.assign(this.state, values);
    state.elevation = Math.min(Math.max(state.elevation, -89.9 * DEGREE), 89.9 * DEGREE);
    state.radius = Math.min(Math.max(state.radius, this.radii[0]), this.radii[1]);
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

  get busy() { return super.busy || this.state.turn || this.glide || Math.hypot(...this.spin) > IDLE; }

  advance(seconds) {
    const [across, up] = this.spin, { azimuth, elevation } = this.state;
    if (this.glide) this.approach(seconds);
    if (this.state.turn || across || up) this.change({
      azimuth: azimuth + (across + (this.state.turn ? TURN : 0)) * seconds, elevation: elevation + up * seconds,
    });
    const left = Math.exp(-COAST * seconds);
    this.spin = Math.hypot(across, up) * left > IDLE ? [across * left, up * left] : [0, 0];
    super.advance(seconds);
  }

  // Moves what the camera turns around to a point, quickly first, then slowly.
  lookAt(point) {
    if (CALM) return this.change({ target: point });
    this.glide = point;
    this.wake();
  }

  approach(seconds) {
    const target = mixed(this.state.target, this.glide, 1 - Math.exp(-2 * COAST * seconds));
    const far = Math.hypot(...target.map((value, k) => value - this.glide[k]));
    if (far < 1e-3 * this.state.radius) this.glide = null;
    this.change({ target });
  }

  // Keys that do what dragging and the wheel do.
  get cameraKeys() {
    const nudge = (across, up) => () => this.change({ azimuth: this.state.azimuth + across * NUDGE, elevation: this.state.elevation + up * NUDGE });
    return {
      "Shift+ArrowLeft": nudge(-1, 0), "Shift+ArrowRight": nudge(1, 0), "Shift+ArrowUp": nudge(0, 1), "Shift+ArrowDown": nudge(0, -1),
      r: () => this.goHome(), "+": () => this.zoom(0.9), "=": () => this.zoom(0.9), "-": () => this.zoom(1 / 0.9),
    };
  }

  zoom(factor) { this.change({ radius: this.state.radius * factor }); }

  goHome() {
    Object.assign(this, { spin: [0, 0], glide: null });
    this.change(this.home());
  }

  // A double click or tap at a place of the canvas (CSS pixels).
  pointedAt() { this.goHome(); }

  pan(dx, dy) {
    this.pace = [0, 0];
    const { camera } = this, step = this.state.radius / camera.focal * this.canvas.width / this.canvas.clientWidth;
    this.change({ target: this.state.target.map((value, k) => value - step * (dx * camera.right[k] + dy * camera.down[k])) });
  }

  listenToCanvas() {
    const { canvas } = this, pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      canvas.classList.add("moving");
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      Object.assign(this, { spin: [0, 0], pace: [0, 0], glide: null, moved: event.timeStamp });
    });
    canvas.addEventListener("pointermove", (event) => this.drag(event, pointers));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => {
      pointers.delete(event.pointerId);
      if (!pointers.size) this.letGo(event.timeStamp);
      canvas.classList.toggle("moving", pointers.size > 0);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY * (event.ctrlKey ? 0.01 : 0.001)));  // browsers tell a pinch of a trackpad by 100 log(scale), with ctrl
    }, { passive: false });
    canvas.addEventListener("dblclick", (event) => this.pointedAt(event.offsetX, event.offsetY));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    new ResizeObserver(() => this.fitCanvas()).observe(canvas);
  }

  drag(event, pointers) {
    const before = pointers.get(event.pointerId), { radius } = this.state;
    if (!before) return;
    const now = [event.clientX, event.clientY], dx = now[0] - before[0], dy = now[1] - before[1];
    if (pointers.size === 2) {
      const other = [...pointers].find(([id]) => id !== event.pointerId)[1], span = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
      this.change({ radius: radius * span(before) / Math.max(span(now), 1) });
      this.pan(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons > 1) this.pan(dx, dy);
    else this.orbit(event.timeStamp, -dx * 0.008, dy * 0.008);
    pointers.set(event.pointerId, now);
  }

  // The camera coasts on unless the pointer was held still first.
  letGo(now) {
    if (!CALM && now - this.moved < 60) this.spin = this.pace;
    this.wake();
  }

  // Turns by radians across and up, and remembers how fast.
  orbit(now, across, up) {
    const seconds = Math.max((now - this.moved) / 1000, 0.004), { azimuth, elevation } = this.state;
    this.moved = now;
    this.pace = [across / seconds, up / seconds];
    this.change({ azimuth: azimuth + across, elevation: elevation + up });
  }
}
