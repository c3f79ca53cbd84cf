// The same pictures where there is no WebGL 2: a soft blob for each Gaussian, turned and stretched. Slower.

const BLOB = 32, REACH = 3;  // pixels of a blob's side; standard deviations to its edge

class CanvasPainter {
  constructor(canvas) {
    this.context = canvas.getContext("2d", { alpha: false });
    if (!this.context) throw new Error("this browser can't draw on a canvas");
    this.blobs = new Map();
  }

  // A blob of a color, made once; colors are rounded to 5 bits a channel.
  blob(r, g, b) {
    const key = ((r >> 3) << 10) | ((g >> 3) << 5) | (b >> 3);
    let found = this.blobs.get(key);
    if (!found) {
      found = document.createElement("canvas");
      found.width = found.height = BLOB;
      const context = found.getContext("2d"), picture = context.createImageData(BLOB, BLOB);
      for (let y = 0, o = 0; y < BLOB; y++)
        for (let x = 0; x < BLOB; x++, o += 4) {
          const u = ((x + 0.5) / BLOB - 0.5) * 2 * REACH, v = ((y + 0.5) / BLOB - 0.5) * 2 * REACH;
          picture.data.set([r, g, b, 255 * Math.exp(-0.5 * (u * u + v * v))], o);
        }
      context.putImageData(picture, 0, 0);
      this.blobs.set(key, found);
    }
    return found;
  }

  draw(scene, order, rgba, camera, background) {
    const { context } = this, { mean, covariance } = scene, { rotation: R, shift, focal, width, height, near } = camera;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.globalAlpha = 1;
    context.fillStyle = `rgb(${background})`;
    context.fillRect(0, 0, width, height);
    for (const i of order) {
      const p = [0, 1, 2].map((k) => R[3 * k] * mean[3 * i] + R[3 * k + 1] * mean[3 * i + 1] + R[3 * k + 2] * mean[3 * i + 2] + shift[k]);
      if (p[2] < near || rgba[4 * i + 3] < 2) continue;
      const { axis, large, small } = this.ellipse(covariance.subarray(6 * i, 6 * i + 6), R, p, focal);
      const s = (2 * REACH) / BLOB, x = width / 2 + (focal * p[0]) / p[2], y = height / 2 + (focal * p[1]) / p[2];
      context.setTransform(axis[0] * large * s, axis[1] * large * s, -axis[1] * small * s, axis[0] * small * s, x, y);
      context.globalAlpha = rgba[4 * i + 3] / 255;
      context.drawImage(this.blob(rgba[4 * i], rgba[4 * i + 1], rgba[4 * i + 2]), -BLOB / 2, -BLOB / 2);
    }
  }

  // Longer axis (unit) and the two standard deviations in pixels of a Gaussian's picture.
  ellipse(cov, R, p, focal) {
    const [xx, xy, xz, yy, yz, zz] = cov, rows = [0, 1].map((k) => {
      const t = p[k] / p[2];
      return [0, 1, 2].map((j) => (focal / p[2]) * (R[3 * k + j] - t * R[6 + j]));
    });
    const times = (u) => [xx * u[0] + xy * u[1] + xz * u[2], xy * u[0] + yy * u[1] + yz * u[2], xz * u[0] + yz * u[1] + zz * u[2]];
    const dot = (u, v) => u[0] * v[0] + u[1] * v[1] + u[2] * v[2], first = times(rows[0]);
    const a = dot(rows[0], first) + 0.3, b = dot(rows[1], first), c = dot(rows[1], times(rows[1])) + 0.3;
    const middle = (a + c) / 2, gap = Math.sqrt(Math.max(((a - c) * (a - c)) / 4 + b * b, 1e-12)), large = middle + gap;
    let axis = Math.abs(b) > 1e-6 ? [b, large - a] : a >= c ? [1, 0] : [0, 1];
    const norm = Math.hypot(...axis);
    axis = axis.map((value) => value / norm);
    return { axis, large: Math.sqrt(large), small: Math.sqrt(Math.max(middle - gap, 0.05)) };
  }
}
