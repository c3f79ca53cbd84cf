// Below the points: the ground as a grid whose squares have a round size, and the file's axes.

class Floor {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
  }

  // axes: where the file's x, y and z point.
  draw(clip, axes, camera, dark) {
    const { canvas, pen } = this, { square, side } = clip.ground, ratio = camera.width / Math.max(canvas.clientWidth, 1), y = clip.floor;
    canvas.width = camera.width;
    canvas.height = camera.height;
    pen.strokeStyle = dark ? "#dfe6f2" : "#26324a";
    pen.lineWidth = ratio;
    for (let n = Math.round(-side / square); n <= Math.round(side / square); n++) {
      const at = n * square, alpha = n % 5 === 0 ? 0.28 : 0.14;
      this.line(camera, [at, y, -side], [at, y, side], alpha);
      this.line(camera, [-side, y, at], [side, y, at], alpha);
    }
    this.drawAxes(axes, camera, ratio, dark);
  }

  // A line of the world, cut where it comes too near to the camera.
  line(camera, from, to, alpha) {
    const { pen } = this, { rotation: R, shift, focal, width, height } = camera;
    let [a, b] = [from, to].map((p) => [0, 1, 2].map((k) => R[3 * k] * p[0] + R[3 * k + 1] * p[1] + R[3 * k + 2] * p[2] + shift[k]));
    if (a[2] < b[2]) [a, b] = [b, a];
    if (a[2] < 0.05) return;
    if (b[2] < 0.05) b = mixed(a, b, (a[2] - 0.05) / (a[2] - b[2]));
    pen.globalAlpha = alpha;
    pen.beginPath();
    for (const p of [a, b]) pen.lineTo(width / 2 + focal * p[0] / p[2], height / 2 + focal * p[1] / p[2]);
    pen.stroke();
    pen.globalAlpha = 1;
  }

  drawAxes(axes, camera, ratio, dark) {
    const { pen } = this, R = camera.rotation, length = 26 * ratio, x = 46 * ratio, y = camera.height - 46 * ratio;
    const rows = [R.slice(0, 3), R.slice(3, 6), R.slice(6)], arms = axes.map((axis, k) => ({ name: "xyz"[k], way: times(rows, axis) }));
    arms.sort((a, b) => b.way[2] - a.way[2]);
    pen.lineWidth = 2 * ratio;
    pen.lineCap = "round";
    pen.font = `600 ${12 * ratio}px system-ui, sans-serif`;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    const colors = dark ? { x: "#ff8f85", y: "#7fdc9c", z: "#82b7ff" } : { x: "#c2352b", y: "#1a7f45", z: "#2563c9" };
    for (const { name, way } of arms) {
      pen.strokeStyle = pen.fillStyle = colors[name];
      pen.beginPath();
      pen.moveTo(x, y);
      pen.lineTo(x + length * way[0], y + length * way[1]);
      pen.stroke();
      const long = Math.hypot(way[0], way[1]), out = long > 0.12 ? length + 10 * ratio / long : 0;
      if (out) pen.fillText(name, x + out * way[0], y + out * way[1]);
    }
  }
}
