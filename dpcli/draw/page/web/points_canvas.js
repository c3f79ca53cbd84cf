// The same points where there is no WebGL 2: shaded discs, far to near.

class CanvasPoints {
  constructor(canvas) {
    this.pen = canvas.getContext("2d");
    if (!this.pen) throw new Error("this browser can't draw on a canvas");
  }

  draw(clip, spans, colors, camera, look) {
    const { pen } = this, { rotation: R, shift, focal, width, height } = camera, { places } = clip, seen = [];
    for (const [k, [first, count]] of spans.entries()) for (let i = first; i < first + count; i++) {
      if (!colors[4 * i + 3]) continue;
      const [x, y, z] = [0, 1, 2].map((row) => R[3 * row] * places[3 * i] + R[3 * row + 1] * places[3 * i + 1] + R[3 * row + 2] * places[3 * i + 2] + shift[row]);
      if (z > 0.02) seen.push([width / 2 + focal * x / z, height / 2 + focal * y / z, z, i, z - 2 * look.reach * k]);
    }
    seen.sort((a, b) => b[4] - a[4]);
    pen.clearRect(0, 0, width, height);
    const [near, far] = look.depths;
    for (const [x, y, z, i] of seen) {
      const size = Math.max(look.reach * focal / z, 1), haze = 0.28 * Math.min(Math.max((z - near) / (far - near), 0), 1);
      for (const [light, share] of [[0.62, 1], [0.95, 0.68]]) {
        pen.fillStyle = `rgb(${mixed([0, 1, 2].map((k) => light * colors[4 * i + k]), look.ground, haze)})`;
        pen.beginPath();
        pen.arc(x - (1 - share) * size * 0.4, y - (1 - share) * size * 0.6, size * share, 0, 2 * Math.PI);
        pen.fill();
      }
    }
  }
}
