// The scene: Gaussians at a time, their order from far to near.

class Scene {
  constructor(header, blob) {
    const { count, frames, starts } = header;
    const cut = (name, length) => blob.slice(starts[name], starts[name] + length);
    Object.assign(this, { header, count, frames, timeline: new Timeline(header.time, header.rate, header.tail) });
    const bytes = cut("position", 6 * frames * count), planes = 3 * frames * count;
    const position = new Uint16Array(planes);
    for (let i = 0; i < planes; i++) position[i] = bytes[i] | (bytes[planes + i] << 8);
    this.position = summed(position, 3 * count);
    this.turn = summed(new Int8Array(cut("turn", 4 * frames * count).buffer), 4 * count);
    this.weight = summed(cut("weight", frames * count), count);
    this.scale = new Float32Array(cut("scale", 12 * count).buffer);
    this.color = cut("color", 4 * count);
    const part = cut("part", 2 * count);
    this.part = Uint16Array.from({ length: count }, (_, i) => part[i] | (part[count + i] << 8));
    this.mean = new Float32Array(3 * count);
    this.covariance = new Float32Array(6 * count);
    this.order = new Uint32Array(count);
    this.buckets = new Uint32Array(65537);
    this.depth = new Uint16Array(count);
    this.now = NaN;
  }

  moveTo(time) {
    if (time === this.now) return;
    this.now = time;
    const { count, position, turn, scale, mean, covariance, header } = this;
    const [a, b, w] = this.timeline.between(time), step = header.extent.map((length) => length / 65535);
    for (let axis = 0; axis < 3; axis++) {
      const one = (3 * a + axis) * count, two = (3 * b + axis) * count;
      for (let i = 0; i < count; i++)
        mean[3 * i + axis] = header.low[axis] + step[axis] * ((1 - w) * position[one + i] + w * position[two + i]);
    }
    const q = [0, 0, 0, 0];
    for (let i = 0; i < count; i++) {
      let norm = 0;
      for (let k = 0; k < 4; k++) {
        q[k] = (1 - w) * turn[(4 * a + k) * count + i] + w * turn[(4 * b + k) * count + i];
        norm += q[k] * q[k];
      }
      norm = Math.sqrt(norm) || 1;
      this.spread(i, q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm, scale[i], scale[count + i], scale[2 * count + i]);
    }
  }

  // Covariance R diag(s^2) R^T of Gaussian i: xx xy xz yy yz zz.
  spread(i, w, x, y, z, s0, s1, s2) {
    const a0 = (1 - 2 * (y * y + z * z)) * s0, a1 = 2 * (x * y - w * z) * s1, a2 = 2 * (x * z + w * y) * s2;
    const b0 = 2 * (x * y + w * z) * s0, b1 = (1 - 2 * (x * x + z * z)) * s1, b2 = 2 * (y * z - w * x) * s2;
    const c0 = 2 * (x * z - w * y) * s0, c1 = 2 * (y * z + w * x) * s1, c2 = (1 - 2 * (x * x + y * y)) * s2;
    const out = this.covariance, o = 6 * i;
    out[o] = a0 * a0 + a1 * a1 + a2 * a2; out[o + 1] = a0 * b0 + a1 * b1 + a2 * b2; out[o + 2] = a0 * c0 + a1 * c1 + a2 * c2;
    out[o + 3] = b0 * b0 + b1 * b1 + b2 * b2; out[o + 4] = b0 * c0 + b1 * c1 + b2 * c2; out[o + 5] = c0 * c0 + c1 * c1 + c2 * c2;
  }

  // Indices of the Gaussians that are shown, far to near along `forward`: a counting sort over 65536 depths.
  sorted(forward, hidden) {
    const { count, mean, part, order, buckets, depth } = this;
    let low = Infinity, high = -Infinity;
    const along = this.along || (this.along = new Float32Array(count));
    for (let i = 0; i < count; i++) {
      const d = mean[3 * i] * forward[0] + mean[3 * i + 1] * forward[1] + mean[3 * i + 2] * forward[2];
      along[i] = d;
      if (d < low) low = d;
      if (d > high) high = d;
    }
    this.reach = [low, high];
    const factor = 65535 / Math.max(high - low, 1e-9);
    buckets.fill(0);
    for (let i = 0; i < count; i++) {
      if (hidden.has(part[i])) continue;
      depth[i] = 65535 - (along[i] - low) * factor;
      buckets[depth[i] + 1]++;
    }
    for (let k = 1; k < buckets.length; k++) buckets[k] += buckets[k - 1];
    let shown = 0;
    for (let i = 0; i < count; i++) {
      if (hidden.has(part[i])) continue;
      order[buckets[depth[i]]++] = i;
      shown++;
    }
    return order.subarray(0, shown);
  }

  // The nearest Gaussian that covers a pixel, as a point [x, y, z]; null where none does. `moveTo` and `sorted` have run.
  seenAt(x, y, camera, hidden) {
    const { mean, part, color, count, scale } = this, { rotation: R, shift, focal, width, height, near } = camera;
    let nearest = Infinity, found = null;
    for (let i = 0; i < count; i++) {
      if (hidden.has(part[i]) || color[3 * count + i] < 76) continue;  // fainter than 0.3
      const [a, b, c] = mean.subarray(3 * i, 3 * i + 3), depth = R[6] * a + R[7] * b + R[8] * c + shift[2];
      if (depth < near || depth >= nearest) continue;
      const u = width / 2 + focal * (R[0] * a + R[1] * b + R[2] * c + shift[0]) / depth;
      const v = height / 2 + focal * (R[3] * a + R[4] * b + R[5] * c + shift[1]) / depth;
      const reach = Math.max(3, focal * Math.max(scale[i], scale[count + i], scale[2 * count + i]) / depth);
      if (Math.hypot(u - x, v - y) < reach) [nearest, found] = [depth, [a, b, c]];
    }
    return found;
  }

  // Where Gaussian i is at a frame.
  placeAt(i, frame) {
    const { count, position, header } = this;
    return header.low.map((low, axis) => low + header.extent[axis] / 65535 * position[(3 * frame + axis) * count + i]);
  }

  // r g b a (0..255) of all Gaussians; of depth: as `sorted` measured it.
  colors(kind) {
    const { count, color, part, header, along } = this, out = this.rgba || (this.rgba = new Uint8ClampedArray(4 * count));
    const byPart = new Map(header.parts.map((one) => [one.id + 1, one.color]));
    const [a, b, w] = this.timeline.between(this.now), [low, high] = this.reach;
    for (let i = 0; i < count; i++) {
      let rgb;
      if (kind === "part") rgb = byPart.get(part[i]);
      else if (kind === "rigid") {
        rgb = ramped(header.weights, ((1 - w) * this.weight[a * count + i] + w * this.weight[b * count + i]) / 255);
      } else if (kind === "depth") rgb = ramped(header.weights, (high - along[i]) / Math.max(high - low, 1e-9));
      else rgb = [color[i], color[count + i], color[2 * count + i]];
      out[4 * i] = rgb[0]; out[4 * i + 1] = rgb[1]; out[4 * i + 2] = rgb[2]; out[4 * i + 3] = color[3 * count + i];
    }
    return out;
  }
}
